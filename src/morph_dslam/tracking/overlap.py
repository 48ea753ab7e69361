"""Whether two objects stand in one place, which two bodies cannot: then one of them was taken for the other.

Bodies that touch are not accused: a lid on a box, an instrument in a hollow of the mesh. So points well inside count,
not those of the surface, and a body that is much smaller may be where the mesh of the other shows no hollow: a needle.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numba import njit
from numpy.typing import NDArray

from morph_dslam.model import ReducedModel
from morph_dslam.model.separated import SeparatedField
from morph_dslam.surface_distances import distances_to_surface
from morph_dslam.tracking.binding import DrawnSurface
from morph_dslam.tracking.state import State

Array = NDArray[np.float64]
#: A body is asked at most at so many points; for those of a body without cells so many are tried.
MOST_POINTS, TRIED = 100, 4000
#: Solids stand in one place if more than this share of one is inside of the other, and of the other inside of it.
OF_ONE, OF_OTHER = 0.5, 0.1
#: Sheets do if more than this share of each lies on the other; they may be off by this share of their size.
OF_SHEETS, APART_SHARE = 0.75, 0.03
#: Rays go this way: along no edge of a mesh.
_AXES = np.linalg.qr(np.array([[0.61, 0.23, 0.74], [0.37, 0.91, 0.13], [0.83, 0.29, 0.47]]))[0]


@dataclass(frozen=True)
class Body:
    """An object as that which fills a part of space.

    Attributes
    ----------
    surface : what of it is drawn.
    points : (p, 3) inside of a solid, or on a sheet, undeformed, metres.
    displacement : of the points.
    is_solid : whether it fills a volume.
    """

    surface: ReducedModel
    points: Array
    displacement: SeparatedField
    is_solid: bool

    @classmethod
    def of(cls, model: ReducedModel) -> Body:
        """That of a model: points in its cells, or on its triangles if it is a sheet."""
        drawn = DrawnSurface.of(model)
        is_solid = drawn.closed and (bool(model.cells) or not model.parameters)
        if is_solid and not model.cells:
            points = _points_inside(drawn.model.nodes, drawn.model.triangles)
            modes = np.zeros((len(model.displacement.modes), *points.shape))
        else:
            groups = list(model.cells.values()) if is_solid else [model.triangles]
            parts = [_among(cells, MOST_POINTS // len(groups)) for cells in groups]
            points = np.concatenate([_halfway(model.nodes[None], *part)[0] for part in parts])
            modes = np.concatenate([_halfway(model.displacement.modes, *part) for part in parts], axis=1)
        return cls(drawn.model, points, model.displacement.with_modes(modes), is_solid and len(points) > 0)

    def standing(self, state: State) -> StandingBody:
        """The body in a state, in the frame of the state's pose."""
        return StandingBody(self, state)


@dataclass(frozen=True)
class StandingBody:
    """A body in a state; two that are compared are in one frame.

    Attributes
    ----------
    body : which one.
    state : its own.
    """

    body: Body
    state: State

    def _placed(self, field: SeparatedField, rest: Array) -> Array:
        pose, mu = self.state.camera_from_object, self.body.surface.vector(self.state.parameters)
        return np.asarray(field.placed(rest, mu, pose.rotation, pose.translation), dtype=np.float64)

    @cached_property
    def points(self) -> Array:
        """Its points (p, 3), metres."""
        return self._placed(self.body.displacement, self.body.points)

    @cached_property
    def nodes(self) -> Array:
        """Nodes of its surface (n, 3), metres."""
        return self._placed(self.body.surface.displacement, self.body.surface.nodes)

    def is_where(self, other: StandingBody) -> bool:
        """Whether both stand in one place. A sheet and a solid are not compared: the sheet may lie on it."""
        if self.body.is_solid is not other.body.is_solid or not self._is_near(other):
            return False
        shares = self._share_in(other), other._share_in(self)
        if self.body.is_solid:
            return max(shares) > OF_ONE and min(shares) > OF_OTHER
        return min(shares) > OF_SHEETS

    def _is_near(self, other: StandingBody) -> bool:
        """Whether the boxes around both meet."""
        lower = np.maximum(self.points.min(axis=0), other.points.min(axis=0))
        return bool((lower <= np.minimum(self.points.max(axis=0), other.points.max(axis=0))).all())

    def _share_in(self, other: StandingBody) -> float:
        """Which share of its points is inside of another solid, or lies on another sheet."""
        triangles = other.body.surface.triangles
        if self.body.is_solid:
            return float(np.mean(_inside(self.points @ _AXES, other.nodes @ _AXES, triangles)))
        size = float(np.linalg.norm(np.ptp(other.nodes, axis=0)))
        return float(np.mean(distances_to_surface(self.points, other.nodes, triangles) < APART_SHARE * size))


def _among(cells: NDArray[np.int64], most: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """At most so many pairs of a cell (k, c) and one of its corners (k,), drawn from all."""
    drawn = np.random.default_rng(0).permutation(cells.size)[: max(most, 1)]
    return cells[drawn // cells.shape[1]], cells.ravel()[drawn]


def _halfway(values: NDArray[np.floating], cells: NDArray[np.int64], corners: NDArray[np.int64]) -> Array:
    """Values at nodes (m, n, 3), halfway between cells' centres and corners (m, k, 3)."""
    return np.asarray(0.5 * (values[:, cells].mean(axis=2) + values[:, corners]), dtype=np.float64)


def _points_inside(nodes: Array, triangles: NDArray[np.int64]) -> Array:
    """Points (p, 3) inside of a closed surface, spread evenly."""
    lower, upper = nodes.min(axis=0), nodes.max(axis=0)
    tried = lower + np.random.default_rng(0).random((TRIED, 3)) * (upper - lower)
    return tried[_inside(tried @ _AXES, nodes @ _AXES, triangles)][:MOST_POINTS]


@njit(cache=True, nogil=True)
def _inside(points, nodes, triangles):  # type: ignore[no-untyped-def]
    """Which points (p, 3) a closed surface contains: a ray upwards leaves it once more than it enters it."""
    found = np.zeros(len(points), dtype=np.bool_)
    for k in range(len(points)):
        x, y, z, turns = points[k, 0], points[k, 1], points[k, 2], 0
        for t in range(len(triangles)):
            a, b, c = nodes[triangles[t, 0]], nodes[triangles[t, 1]], nodes[triangles[t, 2]]
            of_c = (b[0] - a[0]) * (y - a[1]) - (b[1] - a[1]) * (x - a[0])
            of_a = (c[0] - b[0]) * (y - b[1]) - (c[1] - b[1]) * (x - b[0])
            of_b = (a[0] - c[0]) * (y - c[1]) - (a[1] - c[1]) * (x - c[0])
            up = of_a > 0.0 and of_b > 0.0 and of_c > 0.0
            if not (up or (of_a < 0.0 and of_b < 0.0 and of_c < 0.0)):
                continue
            if (of_a * a[2] + of_b * b[2] + of_c * c[2]) / (of_a + of_b + of_c) > z:
                turns += 1 if up else -1
        found[k] = turns != 0
    return found
