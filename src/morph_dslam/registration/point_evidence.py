"""What the points of a map say of a place of an object: which lie on its visible side, and which it would hide.

The object is drawn into the keyframes and its depth compared with that of the points seen there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from morph_dslam.camera import Camera
from morph_dslam.geometry import SimilarityTransform
from morph_dslam.registration.scene import View
from morph_dslam.registration.search_space import plane_points
from morph_dslam.render.rasteriser import draw_depth

Array = NDArray[np.float64]
#: A point that the object would occlude counts against it as much as so many that it explains.
VIOLATION = 2.0
#: So many points are few, and such a part of them outside of one plane are enough.
FEW, LEAST_SOLID = 50, 0.2
#: A point on the surface lies within the first of these times what is allowed, the closer the better.
WIDTHS = (2.0, 1.0, 0.5, 0.25)
#: The views are drawn this much smaller.
SHRINK = 4


@dataclass(frozen=True)
class PointEvidence:
    """What speaks for a place.

    Attributes
    ----------
    explained : (n,) points that lie on the visible side of the object.
    occluded : (n,) points that it would occlude.
    solid : (n,) points explained without those of the one plane that holds most of them. Any flat face fits
        on any table or wall, in any size.
    hidden_by : (n,) points in front of it, which hide it.
    closeness : (n,) how near those explained are to the surface, 0 to 1.
    """

    explained: NDArray[np.bool_]
    occluded: NDArray[np.bool_]
    solid: NDArray[np.bool_]
    hidden_by: NDArray[np.bool_]
    closeness: Array

    @property
    def score(self) -> float:
        """Points explained, but for one plane, less those occluded, these `VIOLATION` times."""
        return float(self.solid.sum() - VIOLATION * self.occluded.sum())

    @property
    def contradicts(self) -> bool:
        """Whether the object would occlude more of the points than it explains."""
        return bool(self.occluded.sum() > self.explained.sum())

    @property
    def agreement(self) -> float:
        """How far the points where it is seen agree, -1 to 1; near 0 where there are few or they lie in one plane."""
        explained = float(self.explained.sum())
        not_flat = min(1.0, float(self.solid.sum()) / max(LEAST_SOLID * explained, 1.0))
        agreeing = not_flat * float(self.closeness[self.explained].sum())
        occluded = VIOLATION * float(self.occluded.sum())
        return (agreeing - occluded) / (explained + float(self.hidden_by.sum()) + occluded + FEW)


def gather_evidence(
    world_from_object: SimilarityTransform,
    nodes: Array,
    triangles: NDArray[np.int64],
    positions: Array,
    views: Sequence[View],
    camera: Camera,
    tolerance: float,
    noise: float = 0.0,
) -> PointEvidence:
    """Draw the object into every view and compare its depth with that of the points (p, 3) seen there.

    Parameters
    ----------
    world_from_object : the place.
    nodes : (n, 3) metres.
    triangles : (m, 3) node indices.
    positions : (p, 3) of the points, world.
    views : that see them.
    camera : of the views, without distortion.
    tolerance : how far from the surface a point may lie that it explains, world unit.
    noise : the same over its depth; the larger one counts.
    """
    votes, closeness = np.zeros((3, len(positions)), dtype=np.int64), np.zeros(len(positions))
    small, thickness = _shrunk(camera), tolerance
    world = world_from_object.apply(nodes)
    for view in views:
        local = view.camera_from_world.apply(world)
        drawn = draw_depth(small.project(local), local[:, 2].copy(), triangles, False, small.height, small.width)[1]
        depths = view.camera_from_world.apply(positions[view.point_ids])[:, 2].copy()
        _compare(drawn, view.pixels, depths, view.point_ids, tolerance, noise, votes, closeness)
        if noise > 0.0 and len(depths):
            thickness = max(thickness, 2.0 * noise * float(np.median(depths)))
    explained, occluded = votes[0] > votes[1], votes[1] > votes[0]
    solid = explained.copy()
    found = np.flatnonzero(explained)
    if len(found) >= 3:
        solid[found] = ~plane_points(positions[found], thickness, np.random.default_rng(0))
    return PointEvidence(
        explained, occluded, solid, votes[2] > votes[0] + votes[1], closeness / np.maximum(votes[0], 1)
    )


@njit(cache=True, nogil=True)
def _compare(drawn, pixels, depths, ids, tolerance, noise, votes, closeness):
    """Count each of a view's points as explained, occluded or hidden by the object, and how near it is.

    Parameters
    ----------
    drawn : (h, w) depth of the object, inf beside it.
    pixels : (k, 2) of the points, `SHRINK` times larger.
    depths : (k,) of the points.
    ids : (k,) their numbers.
    tolerance, noise : see `gather_evidence`.
    votes : (3, n) counted up.
    closeness : (n,) likewise.
    """
    height, width = drawn.shape
    for p in range(len(depths)):
        column, row = np.rint((pixels[p, 0] + 0.5) / SHRINK - 0.5), np.rint((pixels[p, 1] + 0.5) / SHRINK - 0.5)
        if not (column >= 0.0 and column < width and row >= 0.0 and row < height):
            continue
        there, depth, point = drawn[int(row), int(column)], depths[p], ids[p]
        if not np.isfinite(there):
            continue
        allowed = max(tolerance, noise * depth)
        # A grazing surface changes its depth within a pixel: what is occluded must be so by more.
        away, near = abs(depth - there) / allowed, 0
        for width_allowed in WIDTHS:
            near += away <= width_allowed
        votes[0, point] += away <= WIDTHS[0]
        votes[1, point] += there < depth - 4.0 * allowed
        votes[2, point] += there > depth + 4.0 * allowed
        closeness[point] += near / len(WIDTHS)


def _shrunk(camera: Camera) -> Camera:
    return Camera(
        camera.width // SHRINK,
        camera.height // SHRINK,
        camera.fx / SHRINK,
        camera.fy / SHRINK,
        (camera.cx + 0.5) / SHRINK - 0.5,
        (camera.cy + 0.5) / SHRINK - 0.5,
    )
