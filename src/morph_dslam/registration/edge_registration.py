"""What speaks for a place of an object that was laid by its edges: edges, points of the map, landmarks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from morph_dslam.geometry import SimilarityTransform
from morph_dslam.registration.dense_points import INDEPENDENT
from morph_dslam.registration.edges import EdgeEvidence
from morph_dslam.registration.point_evidence import PointEvidence

Array = NDArray[np.float64]
#: Log likelihood for a point that agrees, and against one that does not.
AGREES = 0.5
#: Where there are too few points to agree, edges decide among such places.
NO_POINTS = 0.05


@dataclass(frozen=True)
class EdgeRegistration:
    """An object laid by its edges.

    Attributes
    ----------
    place : metres to the map's unit.
    covariance : (7, 7) of log scale, rotation vector and translation about the mean node.
    edges : how much of its edges the keyframes show there.
    points : what the points of the map say.
    clicked : log likelihood of the landmarks of the hints.
    """

    place: SimilarityTransform
    covariance: Array
    edges: EdgeEvidence
    points: PointEvidence
    clicked: float = 0.0

    @property
    def rank(self) -> float:
        """What speaks for it, by which places are compared that have nothing in common."""
        return rank_of(self.edges, self.points)

    @property
    def likelihood(self) -> float:
        """Log likelihood of edges, points and landmarks over that by chance, to compare places near each other.

        These have nearly the same points. Of a body of one colour that are few, and chance decides how many of them lie
        outside of one plane, on which the rank depends.
        """
        of_points = AGREES * self.points.balance(INDEPENDENT * self.edges.n_views)
        return self.edges.log_likelihood + of_points + self.clicked


def as_well_seen(other: EdgeRegistration, found: EdgeRegistration) -> bool:
    """Whether keyframes show as much of the outline at another place, as far as they agree on it.

    Edges place an object more exactly than points do, so that these choose among places where as many edges are seen.
    """
    return other.edges.gain >= found.edges.gain - found.edges.gain_std


def rank_of(edges: EdgeEvidence, points: PointEvidence) -> float:
    """What speaks for a place, at most 1: its edges beyond chance and the points that agree must both do so."""
    return edges.total * max(points.agreement, NO_POINTS)
