"""What other keyframes say of hypotheses that one keyframe gave.

A hypothesis of one keyframe has a unit of the map by the points in its outline, and so a place in the map: its edges
are expected somewhere in every other keyframe. What looks like the object from one side by chance does so from no
other.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numba import njit
from numpy.typing import NDArray

from morph_dslam.registration.scene import View
from morph_dslam.registration.view_search import HALF, N_DIRECTIONS, N_PARTS, PER_GAIN, InView, edge_gains
from morph_dslam.threads import on_all_cores

Array = NDArray[np.float64]
#: An edge is met within so many pixels of the halved image: a hypothesis is as exact as the steps of the search.
LOOSE = 4.0


def gains_in(found: InView, rows: NDArray[np.int64], units: Array, view: View, others: Sequence[View]) -> Array:
    """Sums (k,) of what speaks for the edges of hypotheses in some keyframes, as `InView.gains` in their own.

    Parameters
    ----------
    found : hypotheses of a view.
    rows : (k,) which of them.
    units : (k,) of the map per metre, by each.
    view : theirs.
    others : keyframes to ask.
    """
    rotations, centres = found.poses(rows)
    camera, drawings = found.camera, found.drawings
    total = np.zeros(len(rows))
    for other in others:
        between = other.camera_from_world @ view.camera_from_world.inverse
        turned = between.rotation @ rotations
        middles = centres @ between.rotation.T + between.translation / units[:, None]
        gains = edge_gains(other, LOOSE)

        def of_part(part: NDArray[np.int64], turned=turned, middles=middles, gains=gains) -> Array:
            return added_gains(
                gains, np.ascontiguousarray(turned[part]), middles[part], drawings.rotations[:, 2], drawings.points,
                drawings.tangents, camera.intrinsics,
            )  # fmt: skip

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
        sight = turn.T @ middle
        side, most = 0, -np.inf
        for s in range(len(sights)):
            along = sights[s, 0] * sight[0] + sights[s, 1] * sight[1] + sights[s, 2] * sight[2]
            if along > most:
                side, most = s, along
        total = 0
        for p in range(points.shape[1]):
            a, b = points[side, p], tangents[side, p]
            x = turn[0, 0] * a[0] + turn[0, 1] * a[1] + turn[0, 2] * a[2] + middle[0]
            y = turn[1, 0] * a[0] + turn[1, 1] * a[1] + turn[1, 2] * a[2] + middle[1]
            z = turn[2, 0] * a[0] + turn[2, 1] * a[1] + turn[2, 2] * a[2] + middle[2]
            if not z > 0.0:
                continue
            column = int(np.rint((fx * x / z + cx + 0.5) / HALF - 0.5))
            row = int(np.rint((fy * y / z + cy + 0.5) / HALF - 0.5))
            if not (0 <= column < width and 0 <= row < height):
                continue
            u = turn[0, 0] * b[0] + turn[0, 1] * b[1] + turn[0, 2] * b[2]
            v = turn[1, 0] * b[0] + turn[1, 1] * b[1] + turn[1, 2] * b[2]
            direction = int(np.rint(np.arctan2(u, -v) / np.pi * N_DIRECTIONS)) % N_DIRECTIONS
            total += gains[direction, row, column]
        result[h] = total
    return result
