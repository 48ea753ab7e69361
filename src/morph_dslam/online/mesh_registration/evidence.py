"""What keyframes say for and against an object in a place: points it explains, and points it would hide."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from morph_dslam.camera import PinholeCamera
from morph_dslam.online.mesh_registration.regions import plane_points
from morph_dslam.online.mesh_registration.scene import View
from morph_dslam.render.rasteriser import rasterise
from morph_dslam.similarity import SimilarityTransform

Array = NDArray[np.float64]

#: A point that the object would hide counts against it as much as so many that it explains.
VIOLATION = 2.0
#: The views are drawn this much smaller.
SHRINK = 4


@dataclass(frozen=True)
class Evidence:
    """What speaks for a place.

    Attributes
    ----------
    explained : (n,) points that lie on the visible side of the object. hidden : (n,) those it would hide.
    solid : (n,) points explained without those of the one plane that holds most of them. Any flat face fits
        on any table or wall, in any size.
    """

    explained: NDArray[np.bool_]
    hidden: NDArray[np.bool_]
    solid: NDArray[np.bool_]

    @property
    def score(self) -> float:
        """Points explained, but for one plane, less those hidden, these `VIOLATION` times."""
        return float(self.solid.sum() - VIOLATION * self.hidden.sum())


def gather_evidence(
    world_from_object: SimilarityTransform,
    nodes: Array,
    triangles: NDArray[np.int64],
    positions: Array,
    views: Sequence[View],
    camera: PinholeCamera,
    tolerance: float,
) -> Evidence:
    """Draw the object into every view and compare its depth with that of the points seen there.

    Parameters
    ----------
    nodes : (n, 3) of the mesh, object frame. positions : (p, 3) of all map points, world.
    tolerance : how far from the surface a point may lie that it explains, world unit.
    """
    votes = np.zeros((2, len(positions)), dtype=np.int64)
    small = _shrunk(camera)
    world = world_from_object.apply(nodes)
    for view in views:
        local = view.camera_from_world.apply(world)
        buffers = rasterise(small.project(local), local[:, 2], triangles, small.height, small.width)
        depth = view.camera_from_world.apply(positions[view.point_ids])[:, 2]
        columns, rows = np.rint((view.pixels + 0.5) / SHRINK - 0.5).astype(np.int64).T
        inside = (columns >= 0) & (columns < small.width) & (rows >= 0) & (rows < small.height)
        drawn = np.full(len(depth), np.inf)
        drawn[inside] = buffers.depth[rows[inside], columns[inside]]
        # A grazing surface changes its depth within a pixel: what is hidden must be so by more.
        votes[0, view.point_ids] += np.abs(depth - drawn) <= 2.0 * tolerance
        votes[1, view.point_ids] += drawn < depth - 4.0 * tolerance
    explained, hidden = votes[0] > votes[1], votes[1] > votes[0]
    solid = explained.copy()
    found = np.flatnonzero(explained)
    if len(found) >= 3:
        solid[found] = ~plane_points(positions[found], tolerance, np.random.default_rng(0))
    return Evidence(explained, hidden, solid)


def _shrunk(camera: PinholeCamera) -> PinholeCamera:
    return PinholeCamera(
        camera.width // SHRINK,
        camera.height // SHRINK,
        camera.fx / SHRINK,
        camera.fy / SHRINK,
        (camera.cx + 0.5) / SHRINK - 0.5,
        (camera.cy + 0.5) / SHRINK - 0.5,
    )
