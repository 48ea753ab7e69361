"""What the sequence filter keeps from frame to frame, and how it goes over to the points of another view."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from morph_dslam.online.uncertainty.measurement_noise import Correlation

Array = NDArray[np.float64]


@dataclass(frozen=True)
class PointChange:
    """Another reference view is followed from now on.

    Attributes
    ----------
    left, taken : numbers of the view so far and of the next one. correlation : (p, p) of the points so far.
    n_points : of the next view, with those of the outline. kept : numbers of the views that can come back.
    besides : (n, n) covariance of the state so far from errors that the filter does not know of; zero where
        no frame was taken in since the last change.
    """

    left: int
    taken: int
    correlation: Correlation
    n_points: int
    kept: Collection[int]
    besides: Array


@dataclass(frozen=True)
class LeftPoints:
    """How the lasting errors of a view's points had entered the past when the view was left.

    Attributes
    ----------
    by_point : (p, 2, k), as in `Errors`. covariance : (k, k) from it.
    """

    by_point: Array
    covariance: Array


@dataclass(frozen=True)
class Errors:
    """How errors enter an estimate.

    Attributes
    ----------
    by_point : (p, 2, n) derivative by the part that stays with a point, in its standard deviations.
    by_frames : (n, n) covariance from what is new in each frame.
    by_cause : (c, n) derivative by what is the same in all frames of a known pose; see `Prior.lasting`.
    unseen : (n, n) covariance of what nothing tells of. covariance : (n, n) from all of it.
    inverse : (n, n) of the cost's Hessian.
    by_views : (k, n) by the number of a view that was left: derivative by what its points had put into the
        k parameters then.
    """

    by_point: Array
    by_frames: Array
    by_cause: Array
    unseen: Array
    covariance: Array
    inverse: Array
    by_views: dict[int, Array] = field(default_factory=dict)


@dataclass(frozen=True)
class Past:
    """What the frames so far said of the k parameters that are one per sequence.

    Attributes
    ----------
    mean : (k,), SI. covariance : (k, k). by_point, by_frames, by_cause, unseen, by_views : as in `Errors`,
        (p, 2, k), (k, k), (c, k), (k, k) and (k, k) each.
    left : the views of ``by_views``, by number.
    """

    mean: Array
    covariance: Array
    by_point: Array
    by_frames: Array
    by_cause: Array
    unseen: Array
    by_views: dict[int, Array] = field(default_factory=dict)
    left: dict[int, LeftPoints] = field(default_factory=dict)

    def with_points(self, change: PointChange, kept: NDArray[np.int64]) -> Past:
        """The same past, for measurements of another view's points.

        What the points so far have put into it is kept apart, so that their errors are known as the same when
        their view comes back; of views that cannot, only the covariance is left. Errors that the filter does
        not know of, such as the old view's own, are added as ones that no later frame tells of.

        Parameters
        ----------
        kept : indices of the parameters (k,).
        """
        besides = change.besides[np.ix_(kept, kept)]
        covariance = quadratic(self.by_point, change.correlation)
        left = self.left | {change.left: LeftPoints(self.by_point, covariance)}
        by_views = self.by_views | {change.left: np.eye(len(kept))}
        by_point, unseen = np.zeros((change.n_points, 2, len(kept))), self.unseen + besides
        if change.taken in left:
            # Later frames have carried on, in the same way for all points, what these had put in.
            by_point = left.pop(change.taken).by_point @ by_views.pop(change.taken)
        for view in [view for view in left if view not in change.kept]:
            rows = by_views.pop(view)
            unseen = unseen + rows.T @ left.pop(view).covariance @ rows
        return replace(
            self,
            covariance=self.covariance + besides,
            by_point=by_point,
            unseen=unseen,
            by_views=by_views,
            left=left,
        )


def quadratic(scores: Array, correlation: Correlation, others: Array | None = None) -> Array:
    """sum_ij K_ij W_i' V_j (n, n) of scores (p, 2, n), twice the same or two, and correlation K (p, p)."""
    others = scores if others is None else others
    spread = np.asarray(correlation @ others.reshape(len(others), -1)).reshape(others.shape)
    return np.tensordot(scores, spread, axes=([0, 1], [0, 1]))
