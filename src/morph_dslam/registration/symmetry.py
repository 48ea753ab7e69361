"""Whether an object looks the same in several attitudes, and deforms the same in them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar
from scipy.spatial import KDTree

from morph_dslam.model import ReducedModel, SurfacePoints
from morph_dslam.model.reduced_model import spread_over
from morph_dslam.registration.icp import SYMMETRY_TOLERANCE, Surface
from morph_dslam.registration.messages import Ambiguity, Ambiguous, AttitudeArbitrary, RegistrationWarning
from morph_dslam.registration.registration import Axis
from morph_dslam.surface_distances import distances_to_surface, nearest_triangles
from morph_dslam.tracking.binding import nearest_in_triangles

Array = NDArray[np.float64]
#: Parts of a turn by which a body may lie where it was.
PARTS = (2, 3, 4, 5, 6)
#: A point of a surface is hardly ever farther from its nearest sample.
FARTHEST_SPACINGS = 6.0
#: Cosine from which two axes are one.
ABOUT_THE_SAME = 0.99
#: Turned displacements are the same if they differ by less than this share of what they are, on average.
SAME_DISPLACEMENTS = 0.1
#: States of a model that are compared, and points of its surface.
N_STATES, N_POINTS = 6, 4000
#: The part of them that moves most is one of so many.
PART = 4
#: Turns about an axis of revolution are tried so far apart, and the best one found to so much, rad.
COARSE, FINE = np.radians(3.0), np.radians(0.1)


def turn_warning(model: ReducedModel, axis: Axis | None) -> RegistrationWarning | None:
    """That a registration by shape alone may have the object turned, and whether that matters; None if it may not.

    Parameters
    ----------
    model : of the object.
    axis : of revolution of its surface, turns about which are no concern here; None if it has none.
    """
    nodes = model.positions(model.default)
    turns = turns_alike(nodes, model.triangles, axis)
    if not turns:
        return None
    for about, angle in _apart_from(axis, turns):
        if not deforms_alike(model, about, angle, axis):
            return Ambiguous(Ambiguity.TURNED, float(np.degrees(angle)))
    return AttitudeArbitrary(float(np.degrees(turns[0][1])))


def _apart_from(axis: Axis | None, turns: list[tuple[Axis, float]]) -> list[tuple[Axis, float]]:
    """Those turns of which none is another one and a turn about the axis of revolution.

    Turns by one angle about any two axes across it are.
    """
    return turns if axis is None else list({angle: (about, angle) for about, angle in reversed(turns)}.values())


def turns_alike(nodes: Array, triangles: NDArray[np.int64], axis: Axis | None) -> list[tuple[Axis, float]]:
    """Axes and angles (rad) by which a surface can be turned and lies where it was.

    Parameters
    ----------
    nodes : (n, 3) metres.
    triangles : (m, 3) node indices.
    axis : of revolution, about which no turns are tried.
    """
    surface = Surface.of_mesh(nodes, triangles)
    found = []
    for direction in surface.axes:
        if axis is not None and abs(direction @ axis.direction) > ABOUT_THE_SAME:
            continue
        about = Axis(surface.centre, direction)
        angles = (2.0 * np.pi / part for part in PARTS)
        found += [(about, angle) for angle in angles if _fits(about, angle, nodes, triangles, surface)]
    return found


def _fits(about: Axis, angle: float, nodes: Array, triangles: NDArray[np.int64], surface: Surface) -> bool:
    """Whether all of a surface, turned about an axis by an angle (rad), is on itself up to the tolerance."""
    allowed = SYMMETRY_TOLERANCE * surface.size
    # Samples of the surface, no farther apart than some spacings, decide for most nodes and most turns.
    spacing = float(np.median(surface.tree.query(surface.points[::10], k=2)[0][:, 1]))
    turned = about.turned(nodes[np.unique(triangles)], angle)
    off = surface.tree.query(turned)[0]
    if off.max() > allowed + FARTHEST_SPACINGS * spacing:
        return False
    return bool((distances_to_surface(turned[off > allowed], nodes, triangles) <= allowed).all())


def deforms_alike(model: ReducedModel, about: Axis, angle: float, axis: Axis | None = None) -> bool:
    """Whether an object that is turned about an axis by an angle (rad) deforms as if it had not been turned.

    Parameters
    ----------
    model : of the object.
    about, angle : the turn, after which its surface lies where it was.
    axis : of revolution of its surface. The angle about it is found as a parameter, so that any further turn about it
        may make good what the turn changes.
    """
    fields = _TurnedFields.of(model, about, angle)
    if axis is None:
        return fields.apart() <= SAME_DISPLACEMENTS
    # Where it moves most decides about the further turn, all of it whether that is good enough.
    most = fields.where_most_moves
    coarse = np.arange(0.0, 2.0 * np.pi, COARSE)
    nearly = [most.nearly_apart(fields, axis, further) for further in coarse]
    best = coarse[int(np.argmin(nearly))]
    found: Any = minimize_scalar(
        lambda further: most.apart(axis, further), bounds=(best - COARSE, best + COARSE), options={"xatol": FINE}
    )
    return fields.apart(axis, float(found.x)) <= SAME_DISPLACEMENTS


@dataclass(frozen=True)
class _TurnedFields:
    """Displacements of an object's surface in states of its model, against those of the object that is turned.

    Attributes
    ----------
    nodes, triangles : (n, 3) at rest, metres, and (m, 3) node indices.
    samples : points of the surface.
    moved : (s, n, 3) displacements in each state that has any, metres.
    about, angle : the turn, rad.
    """

    nodes: Array
    triangles: NDArray[np.int64]
    samples: SurfacePoints
    moved: Array
    about: Axis
    angle: float

    @classmethod
    def of(cls, model: ReducedModel, about: Axis, angle: float) -> _TurnedFields:
        nodes, triangles = model.positions(model.default), model.triangles
        moved = np.array([model.positions(parameters) - nodes for parameters in model.spread_parameters(N_STATES)])
        return cls(nodes, triangles, spread_over(nodes, triangles, N_POINTS), moved, about, angle)

    def apart(self, axis: Axis | None = None, further: float = 0.0) -> float:
        """How far apart the displacements are with a ``further`` turn (rad) about another axis.

        Means over the surface, as a share of the mean displacement, in the state in which it is the largest.
        """
        turned = self._turned(self._on_samples(self.nodes), axis, further)
        rows, _ = nearest_triangles(turned, self.nodes, self.triangles)
        weights = nearest_in_triangles(self.nodes[self.triangles[rows]], turned)
        there = np.einsum("pc,spcx->spx", weights, self.moved[:, self.triangles[rows]])
        return self._largest_share(there, axis, further)

    def nearly_apart(self, samples: _TurnedFields, axis: Axis, further: float) -> float:
        """`apart` by the means of samples nearby, which is quick."""
        _, near = samples.tree.query(self._turned(self._on_samples(self.nodes), axis, further), k=3)
        return self._largest_share(samples.moved_samples[:, near].mean(axis=2), axis, further)

    @property
    def where_most_moves(self) -> _TurnedFields:
        """The same on that part of the samples that moves most."""
        rows = np.argsort(np.linalg.norm(self.moved_samples, axis=2).max(axis=0, initial=0.0))[-N_POINTS // PART :]
        return replace(self, samples=SurfacePoints(self.samples.triangles[rows], self.samples.weights[rows]))

    def _largest_share(self, there: Array, axis: Axis | None, further: float) -> float:
        """Of displacements (s, p, 3) where the turned samples are."""
        turn = Axis(np.zeros(3), self.about.direction)
        own = turn.turned(self.moved_samples, self.angle)
        if axis is not None:
            own = Axis(np.zeros(3), axis.direction).turned(own, further)
        moved = np.linalg.norm(self.moved_samples, axis=2).mean(axis=1)
        apart = np.linalg.norm(own - there, axis=2).mean(axis=1)
        return float(np.max(apart[moved > 0.0] / moved[moved > 0.0], initial=0.0))

    def _turned(self, points: Array, axis: Axis | None, further: float) -> Array:
        turned = self.about.turned(points, self.angle)
        return turned if axis is None else axis.turned(turned, further)

    def _on_samples(self, values: Array) -> Array:
        """Values (..., p, 3) on the samples from those of the nodes (..., n, 3)."""
        return np.einsum(
            "pc,...pcx->...px", self.samples.weights, values[..., self.triangles[self.samples.triangles], :]
        )

    @cached_property
    def moved_samples(self) -> Array:
        """Displacements (s, p, 3) of the samples, metres."""
        return self._on_samples(self.moved)

    @cached_property
    def tree(self) -> KDTree:
        """Nearest-sample search."""
        return KDTree(self._on_samples(self.nodes))
