"""What several keyframes say of hypotheses that one keyframe gave.

A hypothesis of one keyframe has a unit of the map by the points in its outline, and so a place in the map: its edges
are expected somewhere in every keyframe. What looks like the object from one side by chance seldom does from another.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from morph_dslam.geometry import RigidTransform
from morph_dslam.registration.mesh_edges import move_point, turn_vector
from morph_dslam.registration.scene import View
from morph_dslam.registration.view_search import HALF, N_DIRECTIONS, N_PARTS, PER_GAIN, InView, edge_gains
from morph_dslam.small_arrays import dot
from morph_dslam.threads import on_all_cores

Array = NDArray[np.float64]
#: An edge is met within so many pixels of the halved image: a hypothesis is as exact as the steps of the search.
LOOSE = 4.0


@dataclass(frozen=True)
class AskedView:
    """A keyframe that is asked for edges.

    Attributes
    ----------
    camera_from_world : its pose.
    gains : (d, h / 2, w / 2) of `edge_gains`.
    """

    camera_from_world: RigidTransform
    gains: NDArray[np.int8]

    @classmethod
    def of(cls, view: View) -> AskedView:
        return cls(view.camera_from_world, edge_gains(view, LOOSE))


def gains_in(found: InView, rows: NDArray[np.int64], units: Array, view: View, asked: Sequence[AskedView]) -> Array:
    """Sums (k,) of what speaks for the edges of hypotheses in some keyframes, as `InView.gains` in their own.

    Parameters
    ----------
    found : hypotheses of a view.
    rows : (k,) which of them.
    units : (k,) of the map per metre, by each.
    view : theirs.
    asked : keyframes.
    """
    rotations, centres = found.poses(rows)
    sights, points, tangents = found.drawings.rotations[:, 2], found.drawings.points, found.drawings.tangents
    total = np.zeros(len(rows))
    for each in asked:
        between = each.camera_from_world @ view.camera_from_world.inverse
        turns = np.ascontiguousarray(between.rotation @ rotations)
        middles = centres @ between.rotation.T + between.translation / units[:, None]

        def of_part(part: NDArray[np.int64], gains=each.gains, turns=turns, middles=middles) -> Array:
            return added_gains(gains, turns[part], middles[part], sights, points, tangents, found.camera.intrinsics)

        parts = np.array_split(np.arange(len(rows)), N_PARTS)
        total += np.concatenate(on_all_cores(of_part, parts)) / PER_GAIN
    return total


@njit(cache=True, nogil=True)
def added_gains(gains, rotations, middles, sights, points, tangents, intrinsics):
    """Sums (k,) of gains (d, h, w) at the edges of an object in k poses; nothing for those beside the image.

    Parameters
    ----------
    rotations, middles : (k, 3, 3) camera_from_object and (k, 3) the object's middle in the camera, metres.
    sights : (s, 3) directions from the camera to the object, in its frame, of which its edges are known.
    points, tangents : (s, p, 3) of these, from its middle, and along them.
    """
    fx, fy, cx, cy = intrinsics
    _, height, width = gains.shape
    result = np.zeros(len(rotations))
    for h in range(len(rotations)):
        turn, middle = rotations[h], middles[h]
        if not middle[2] > 0.0:
            continue
        sight = turn_vector(turn.T, middle)
        side, most = 0, -np.inf
        for s in range(len(sights)):
            along = dot(sights[s], sight)
            if along > most:
                side, most = s, along
        total = 0
        for p in range(points.shape[1]):
            x, y, z = move_point(turn, middle, points[side, p])
            if not z > 0.0:
                continue
            column = int(np.rint((fx * x / z + cx + 0.5) / HALF - 0.5))
            row = int(np.rint((fy * y / z + cy + 0.5) / HALF - 0.5))
            if not (0 <= column < width and 0 <= row < height):
                continue
            u, v, _ = turn_vector(turn, tangents[side, p])
            direction = int(np.rint(np.arctan2(u, -v) / np.pi * N_DIRECTIONS)) % N_DIRECTIONS
            total += gains[direction, row, column]
        result[h] = total
    return result
