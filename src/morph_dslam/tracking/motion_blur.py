"""Whether a picture is blurred by the object's motion, and over which paths.

A picture shows the mean over its exposure. A point that moves meanwhile is smeared along its path, and where its patch
is found on it depends on the texture: there is no single instant that all points are measured at. How long the shutter
was open nobody tells, so the picture is asked: patches of the rendered reference view, which is as sharp as it was, are
averaged along shares of the way that each point has gone since the last frame. Where one share makes them much more
alike to the frame's, the points moved by that while the frame was exposed. Normalized correlation asks this, which gain
and offset of the brightness do not change. What softens a picture all around, as a lens out of focus does or another
distance, is as well explained by averages across the way, and does not count.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numba import njit
from numpy.typing import NDArray

from morph_dslam.row_products import FAST
from morph_dslam.tracking.measurement import PATCH_HALF, PATCH_WINDOW
from morph_dslam.tracking.patches import fill_patch

Array = NDArray[np.float64]
#: Blur over shorter paths, root mean square, pixels, does no harm: matching averages over a window three times as wide.
LEAST_PATH_PX = PATCH_WINDOW / 3.0
#: Shares of the way since the last frame go from 0 to this, in so many steps. A faster start needs more than 1.
LARGEST_SHARE, N_STEPS = 2.0, 8
#: Averages along the path leave less than this share of what averages across it, or none, leave different.
CLEARLY_LESS = 0.9
#: At most about so many points are asked.
MOST_ASKED = 20
#: So many frames tell how the object left the reference picture; where a frame shows it longer by this factor does not.
FRAMES_AFTER, LARGEST_STRETCH = 2, 1.5

_F32 = np.float32


def blurred_paths(
    rendered: NDArray[np.uint8], frame: NDArray[np.uint8], places: Array, found: Array, ways: Array
) -> Array | None:
    """The paths (p, 2), pixels, over which a frame shows points smeared; None where that does no harm or is not seen.

    Parameters
    ----------
    rendered, frame : (h, w), the reference view in the frame's state, and the frame, both with contrast normalized.
    places, found : (p, 2) where points are in either, pixels.
    ways : (p, 2) by which they moved since the last frame, pixels.
    """
    way = path_length(ways) if len(ways) else 0.0
    if not LARGEST_SHARE * way > LEAST_PATH_PX:
        return None
    rows = slice(None, None, 1 + (len(ways) - 1) // MOST_ASKED)
    asked = [np.ascontiguousarray(each[rows]) for each in (places, found, ways)]  # of one layout, compiled once
    along = left_different(rendered, frame, *asked)
    share = LARGEST_SHARE * int(np.argmin(along)) / N_STEPS
    if not (along.min() < CLEARLY_LESS * along[0] and share * way > LEAST_PATH_PX):
        return None
    across = left_different(rendered, frame, asked[0], asked[1], asked[2] @ np.array([[0.0, 1.0], [-1.0, 0.0]]))
    return share * ways if along.min() < CLEARLY_LESS * across.min() else None


def path_length(paths: Array) -> float:
    """Root mean square length of paths (p, 2), at least one."""
    return float(np.sqrt(np.mean(np.sum(paths**2, axis=1))))


class ReferenceBlur:
    """Whether motion blurs the reference picture itself, with the motion by which the object left it.

    Where frames, averaged along shares of the way from the reference frame to the next one, become more like the
    rendered reference view, that is smeared over such paths on the surface.
    """

    def __init__(self) -> None:
        self._ways, self._n_frames = np.zeros((0, 2)), 0

    def learn(self, ways: Array) -> None:
        """Take in by what the points (p, 2) moved since the last frame, pixels, 0 where that is not known.

        The first frame may be the reference frame itself: the second one's count.
        """
        if self._n_frames < FRAMES_AFTER:
            self._ways, self._n_frames = ways, self._n_frames + 1

    def paths(
        self, warped: Callable[[Array], Array], rendered: NDArray[np.uint8], frame: NDArray[np.uint8],
        places: Array, found: Array, used: NDArray[np.bool_],
    ) -> Array | None:  # fmt: skip
        """The paths (k, 2), pixels, over which the reference picture shows points smeared, as a frame would show them.

        Parameters
        ----------
        warped : where motions (p, 2) in the reference view lead to in the frame.
        rendered, frame, places, found : as of `blurred_paths`, of all points.
        used : (p,) which of these count.
        """
        if self._n_frames < FRAMES_AFTER or not LARGEST_SHARE * path_length(self._ways) > LEAST_PATH_PX:
            return None
        ways = warped(self._ways)
        # Where the frame shows the surface larger, the rendering is softer than the frame whatever moved.
        larger = np.linalg.norm(ways, axis=1) > LARGEST_STRETCH * np.linalg.norm(self._ways, axis=1)
        used = used & ~larger & np.isfinite(ways).all(axis=1)
        return blurred_paths(frame, rendered, found[used], places[used], ways[used])


@njit(cache=True, nogil=True, fastmath=FAST)
def left_different(rendered, frame, places, found, ways):
    """What of patches (s,) is unlike the frame's, each averaged along s shares of a way; see `blurred_paths`.

    It is the sum of the frame's squared grey levels, about their means, that the patches leave: 1 - r² of them, with
    their correlation r.
    """
    different, size = np.zeros(N_STEPS + 1), 2 * PATCH_HALF + 1
    height, width = frame.shape
    ours, total = np.empty((size, size), _F32), np.empty((size, size), _F32)
    first, second = np.empty((size, size), _F32), np.empty((size, size), _F32)
    for j in range(len(places)):
        x, y = places[j, 0] - PATCH_HALF, places[j, 1] - PATCH_HALF
        u, v = found[j, 0] - PATCH_HALF, found[j, 1] - PATCH_HALF
        far_x, far_y = 0.5 * LARGEST_SHARE * abs(ways[j, 0]), 0.5 * LARGEST_SHARE * abs(ways[j, 1])
        inside = min(x - far_x, y - far_y, u, v) >= 0.0
        inside &= max(x + far_x, u) + size < width and max(y + far_y, v) + size < height
        if not inside:
            continue
        fill_patch(frame, u, v, ours)
        total[:] = 0.0
        for step in range(N_STEPS + 1):
            share = 0.5 * LARGEST_SHARE * step / N_STEPS
            fill_patch(rendered, x + share * ways[j, 0], y + share * ways[j, 1], first)
            fill_patch(rendered, x - share * ways[j, 0], y - share * ways[j, 1], second)
            different[step] += _unlike(ours, total, first, second)
            if step == 0:
                total *= _F32(0.5)  # both ends are the middle
    return different


@njit(cache=True, nogil=True, fastmath=FAST)
def _unlike(ours, total, first, second):
    """The squares of ``ours``, about their mean, that ``total`` with the mean of both ends does not explain.

    Both ends are added to ``total``: in it they count in full, where the path goes on.
    """
    sum_a = sum_b = aa = bb = ab = _F32(0.0)
    for row in range(len(ours)):
        left, right, inner, line = first[row], second[row], total[row], ours[row]
        for column in range(len(line)):
            ends = left[column] + right[column]
            p, q = line[column], inner[column] + _F32(0.5) * ends
            inner[column] += ends
            sum_a += p
            sum_b += q
            aa += p * p
            bb += q * q
            ab += p * q
    count = _F32(ours.size)
    aa -= sum_a * sum_a / count
    bb -= sum_b * sum_b / count
    ab -= sum_a * sum_b / count
    return aa - ab * ab / bb if bb > _F32(1e-6) else aa
