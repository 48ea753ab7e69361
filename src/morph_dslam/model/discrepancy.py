"""What an object's displacement has beyond its model's: a smooth field, as a Gaussian process on the shape.

No reduced model holds all that a real object does: its loads, its supports, its material differ. The
discrepancy between model and object (Kennedy and O'Hagan, J. R. Stat. Soc. B 63, 2001) is described by the
displacements at a few points spread over the surface, with a Matern covariance (5/2) of the points' distance
in the undeformed object. Between them it is the process's conditional mean. Inside, the surface leaves it open: the
deeper a place, the more of the process's own deviation comes back.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import h5py
import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve

from morph_dslam.geometry import fit_similarity
from morph_dslam.model.field_storage import read_array

Array = NDArray[np.float64]
#: For so many arrays of positions a basis keeps its influence: points, drawn nodes and inner structures.
KEPT = 8
#: On so many positions the influence is found as fast as kept: they push out no others.
FEW = 16
#: Added to the covariance's diagonal, relative: points that lie close together make it nearly singular.
JITTER = 1e-6


@dataclass(frozen=True)
class DiscrepancyBasis:
    """Where the discrepancy is given, and how it goes on between.

    Attributes
    ----------
    centres : (m, 3) points of the undeformed object, metres.
    length : correlation length of the process, metres.
    """

    centres: Array
    length: float

    @classmethod
    def spread_over(cls, nodes: Array, count: int, length: float) -> DiscrepancyBasis:
        """Centres spread evenly over nodes (n, 3), metres; at most ``count``, ``length`` in metres."""
        return cls(nodes[farthest_points(nodes, count)], length)

    @cached_property
    def precision(self) -> Array:
        """Inverse (m, m) of the covariance of a component at the centres, for a process of unit variance."""
        covariance = self.covariance(self.centres)
        return np.asarray(cho_solve(cho_factor(covariance), np.eye(len(covariance))))

    def influence(self, positions: Array) -> Array:
        """What each centre's displacement gives (n, m) at positions (n, 3) of the undeformed object.

        It is kept for the arrays that were asked for last, which must stay as they are.
        """
        if len(positions) <= FEW:
            return self.influence_on(positions)
        known = self._known.get(id(positions))
        if known is not None and known[0] is positions:
            return known[1]
        found = self.influence_on(positions)
        if len(self._known) >= KEPT:
            self._known.clear()
        self._known[id(positions)] = positions, found
        return found

    @cached_property
    def _known(self) -> dict[int, tuple[Array, Array]]:
        """Positions and the influence on them, by the array that they are."""
        return {}

    def influence_on(self, positions: Array) -> Array:
        """`influence` that nobody keeps."""
        return self.covariance(positions) @ self.precision

    def covariance(self, positions: Array) -> Array:
        """Of a component at positions (n, 3) and at the centres (n, m), for a process of unit variance."""
        return matern(np.ascontiguousarray(positions), self.centres, self.length)


@njit(cache=True, nogil=True)
def matern(points, centres, length):
    """Matern covariance (n, m) of order 5/2 between points (n, 3) and centres (m, 3), of unit variance."""
    found = np.empty((len(points), len(centres)))
    for i in range(len(points)):
        for j in range(len(centres)):
            squared = 0.0
            for k in range(3):
                squared += (points[i, k] - centres[j, k]) ** 2
            scaled = np.sqrt(5.0 * squared) / length
            found[i, j] = (1.0 + scaled + scaled * scaled / 3.0) * np.exp(-scaled)
            if squared == 0.0:
                found[i, j] += JITTER
    return found


@dataclass(frozen=True)
class DiscrepancyDeviation:
    """How well a discrepancy is known.

    Attributes
    ----------
    covariance : (3 m, 3 m) of the centres' displacements, component by component, square metres.
    amplitude : standard deviation of the process, metres.
    surface : points all over the surface: what the process does inside is taken to follow from what it does there.
    """

    covariance: Array
    amplitude: float
    surface: DiscrepancyBasis

    def left(self, positions: Array, others: Array | None = None) -> Array:
        """Variance (n,) of a component that the whole surface leaves at positions (n, 3), or covariance (n, k)."""
        influence = self.surface.influence(positions)
        if others is None:
            told = np.sum(influence * self.surface.covariance(positions), axis=1)
            return np.asarray(self.amplitude**2 * np.maximum(1.0 + JITTER - told, 0.0), dtype=np.float64)
        alike = matern(np.ascontiguousarray(positions), np.ascontiguousarray(others), self.surface.length)
        return self.amplitude**2 * (alike - influence @ self.surface.covariance(others).T)


@dataclass(frozen=True)
class Discrepancy:
    """The discrepancy in one frame.

    Attributes
    ----------
    values : (m, 3) displacements of the basis's centres beyond the model's, in the object's frame, metres.
    deviation : how well it is known; None where that was not estimated.
    """

    basis: DiscrepancyBasis
    values: Array
    deviation: DiscrepancyDeviation | None = None

    def displacement(self, positions: Array) -> Array:
        """The displacement (n, 3) at positions (n, 3) of the undeformed object, both metres."""
        return self.basis.influence(positions) @ self.values

    def covariances(self, positions: Array) -> Array:
        """Covariance (n, 3, 3) of the displacement at each of positions (n, 3), square metres; zero if not known."""
        if self.deviation is None:
            return np.zeros((len(positions), 3, 3))
        influence, m = self.basis.influence(positions), len(self.values)
        found = np.empty((len(positions), 3, 3))
        for a, b in np.ndindex(3, 3):
            block = self.deviation.covariance[a * m : (a + 1) * m, b * m : (b + 1) * m]
            found[:, a, b] = np.sum((influence @ block) * influence, axis=1)
        return found + self.deviation.left(positions)[:, None, None] * np.eye(3)

    def joint_covariance(self, positions: Array) -> Array:
        """Covariance (3 n, 3 n) of the displacements at few positions (n, 3), point by point; zero if not known."""
        if self.deviation is None:
            return np.zeros((3 * len(positions), 3 * len(positions)))
        influence, m = self.basis.influence(positions), len(self.values)
        of_centres = self.deviation.covariance.reshape(3, m, 3, m)
        found = np.einsum("nm,ambk,lk->nalb", influence, of_centres, influence, optimize=True)
        found += np.einsum("nl,ab->nalb", self.deviation.left(positions, positions), np.eye(3))
        return found.reshape(3 * len(positions), -1)


def farthest_points(nodes: Array, count: int, first: int | None = None) -> NDArray[np.int64]:
    """Indices of at most ``count`` of the nodes (n, 3), each as far as can be from those before it.

    Without a ``first`` one it begins with the node that is farthest from the middle (Gonzalez, Theor. Comput. Sci. 38,
    1985).
    """
    if first is None:
        first = int(np.linalg.norm(nodes - nodes.mean(axis=0), axis=1).argmax())
    chosen, gaps = [first], np.linalg.norm(nodes - nodes[first], axis=1)
    while len(chosen) < min(count, len(nodes)) and gaps.max() > 0.0:
        chosen.append(int(gaps.argmax()))
        gaps = np.minimum(gaps, np.linalg.norm(nodes - nodes[chosen[-1]], axis=1))
    return np.array(chosen)


def largest_deformation(nodes: Array, discrepancy: Discrepancy) -> float:
    """Largest displacement that is left of a discrepancy after the rigid motion nearest to it, metres.

    Parameters
    ----------
    nodes : (n, 3) of the undeformed object, metres.
    """
    moved = nodes + discrepancy.displacement(nodes)
    rigid = fit_similarity(nodes, moved, with_scale=False).apply(nodes)
    return float(np.linalg.norm(moved - rigid, axis=1).max())


def save_discrepancies(file: h5py.File, found: Sequence[Discrepancy | None]) -> None:
    """Write the group ``discrepancy`` of a run: nothing where none was found.

    It holds ``centres`` (m, 3), metres, with the attribute ``length``; ``values`` (k, m, 3), metres, and
    ``row`` (k,): which frames of the run they are of.
    """
    known = {row: d for row, d in enumerate(found) if d is not None}
    if not known:
        return
    basis, group = next(iter(known.values())).basis, file.create_group("discrepancy")
    group.attrs["length"], group["centres"] = basis.length, basis.centres
    group["row"], group["values"] = list(known), np.array([d.values for d in known.values()])


def load_discrepancies(file: h5py.File) -> dict[int, Discrepancy]:
    """The discrepancies of a run by row; empty where the file has none."""
    if "discrepancy" not in file:
        return {}
    centres = read_array(file, "discrepancy/centres", 2)
    values, rows = read_array(file, "discrepancy/values", 3), read_array(file, "discrepancy/row", 1, np.int64)
    length = float(file["discrepancy"].attrs["length"])  # type: ignore[arg-type]
    if values.shape != (len(rows), *centres.shape) or centres.shape[1] != 3 or not length > 0.0:
        raise ValueError("its discrepancies do not belong to their centres")
    basis = DiscrepancyBasis(centres, length)
    return {int(row): Discrepancy(basis, v) for row, v in zip(rows, values, strict=True)}
