"""Patches of map points as they look from about where the camera is, and where they are in a new picture.

Lucas and Kanade's least squares with the slopes of the patch (the inverse compositional form of Baker and Matthews,
Lucas-Kanade 20 Years On, 2004, for motion alone), offset and gain of its brightness free. A patch is cut out once and
serves for many frames; the pyramid of a frame is built once for all points. Where the view has changed much since a
point's keyframe, its patch is warped as if the surface were parallel to the keyframe's image (Klein and Murray 2007).
"""

from __future__ import annotations

import math

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from morph_dslam.row_products import FAST
from morph_dslam.slam.bundle_adjustment import LEAST_DEPTH
from morph_dslam.slam.options import PATCH_HALF
from morph_dslam.tracking.patches import FLOW_WINDOW, LEVELS, NEUTRAL

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
Image = NDArray[np.uint8]
#: An image, and smaller ones, each framed by a margin.
Pyramid = tuple[Image, ...]
#: Levels that images have: one more than points are usually followed on.
N_LEVELS = LEVELS + 2
#: Pixels around each level of a pyramid: half a window about a point at the border, its slopes, and interpolation.
MARGIN = FLOW_WINDOW // 2 + 3
#: Steps shorter than this end the search on the image itself and on coarser levels, pixels there; steps at most.
LAST_STEP, LAST_COARSE_STEP, MOST_STEPS = 0.05, 0.3, 20
#: Steps shorter than this are near enough to the end that each shows which share of the way it goes; within bounds.
NEAR_STEP, LEAST_SHARE, MOST_SHARE = 0.3, 0.25, 1.5
#: Mean square slope, in the direction in which it is least, below which a patch has no place.
LEAST_SLOPE = 0.1
#: Patches that are turned by less and scaled by less, along either axis, are followed as they are.
MOST_TURN, MOST_STRETCH = math.radians(14.0), 1.25
#: A warped patch is used again while what it lacks is this part of those.
REUSE = 0.5

_SIDE, _FRAMED = FLOW_WINDOW, FLOW_WINDOW + 2
#: A patch lies in one row, line after line of its frame, so that a loop over all its pixels is one loop of many
#: pixels at once. What belongs to the frame counts nothing; as much is added as makes the length a multiple of 16.
_SPAN = -(-_SIDE * _FRAMED // 16) * 16
#: Bytes of a patch: the pixel at the lower right of the last one is read, too.
_ROOM = _SPAN + 2 * _FRAMED + 2
_F32 = np.float32
#: Which pixels of the span are inside the frame.
_INSIDE = ((np.arange(_SPAN) % _FRAMED < _SIDE) & (np.arange(_SPAN) < _SIDE * _FRAMED)).astype(_F32)


def image_pyramid(normalized: Image) -> Pyramid:
    """An image (h, w), and smaller ones of half the size each, framed by `MARGIN`."""
    levels = [normalized]
    for _ in range(N_LEVELS - 1):
        levels.append(np.asarray(cv2.pyrDown(levels[-1]), dtype=np.uint8))
    m = MARGIN
    framed = [cv2.copyMakeBorder(level, m, m, m, m, cv2.BORDER_REPLICATE) for level in levels]
    return tuple(np.asarray(level, dtype=np.uint8) for level in framed)


def shape_of(pyramid: Pyramid) -> tuple[int, int]:
    """Height and width of an image."""
    height, width = pyramid[0].shape
    return height - 2 * MARGIN, width - 2 * MARGIN


@njit(cache=True, nogil=True)
def _fill(matrix, a, b, c, d):
    """Set a matrix (2, 2); numba takes seconds to compile the assignment of one array to a part of another."""
    matrix[0, 0], matrix[0, 1], matrix[1, 0], matrix[1, 1] = a, b, c, d


@njit(cache=True, nogil=True)
def change_of_view(pose, keyframe, position, pixel, camera, out):
    """Derivative (2, 2) of pixels seen from ``pose`` by the keyframe's, on a plane parallel to its image."""
    fx, fy, cx, cy = camera[0], camera[1], camera[2], camera[3]
    depth = keyframe[2, 3]
    for k in range(3):
        depth += keyframe[2, k] * position[k]
    depth = max(depth, LEAST_DEPTH)
    there = np.empty(3)
    there[0], there[1], there[2] = (pixel[0] - cx) / fx * depth, (pixel[1] - cy) / fy * depth, depth
    turn, here = np.zeros((3, 3)), np.empty(3)
    for i in range(3):
        here[i] = pose[i, 3]
        for j in range(3):
            for k in range(3):
                turn[i, j] += pose[i, k] * keyframe[j, k]
            here[i] += turn[i, j] * (there[j] - keyframe[j, 3])
    if here[2] < LEAST_DEPTH:
        _fill(out, 1.0, 0.0, 0.0, 1.0)
        return
    for j, focal in enumerate((fx, fy)):
        size = depth / (focal * here[2])
        out[0, j] = fx * size * (turn[0, j] - here[0] / here[2] * turn[2, j])
        out[1, j] = fy * size * (turn[1, j] - here[1] / here[2] * turn[2, j])


@njit(cache=True, nogil=True)
def is_small(a, b, c, d, part):
    """Whether patches changed by the matrix ((a, b), (c, d)) can be followed as they are."""
    # The turn of the nearest rotation, and the singular values of a 2 x 2 matrix.
    turn, sheared = math.hypot(a + d, c - b), math.hypot(a - d, c + b)
    largest, smallest = 0.5 * (turn + sheared), 0.5 * (turn - sheared)
    limit = MOST_STRETCH**part
    return abs(math.atan2(c - b, a + d)) < part * MOST_TURN and largest < limit and smallest > 1.0 / limit


@njit(cache=True, nogil=True)
def _is_identity(matrix):
    return matrix[0, 0] == 1.0 and matrix[1, 1] == 1.0 and matrix[0, 1] == 0.0 and matrix[1, 0] == 0.0


@njit(cache=True, nogil=True)
def _still_serves(now, before):
    """Whether a patch that was warped by a matrix (2, 2) can stand for one warped by another."""
    determinant = before[0, 0] * before[1, 1] - before[0, 1] * before[1, 0]
    a = (now[0, 0] * before[1, 1] - now[0, 1] * before[1, 0]) / determinant
    b = (now[0, 1] * before[0, 0] - now[0, 0] * before[0, 1]) / determinant
    c = (now[1, 0] * before[1, 1] - now[1, 1] * before[1, 0]) / determinant
    d = (now[1, 1] * before[0, 0] - now[1, 0] * before[0, 1]) / determinant
    return is_small(a, b, c, d, 1.0 if _is_identity(before) else REUSE)


@njit(cache=True, nogil=True)
def _choose_changes(ids, views, held_views, held, pose, keyframes, rows, positions, pixels, camera, outdated):
    """Set the matrix (2, 2) that each point's patch is to be warped by, and whether it has to be made anew."""
    now = np.empty((2, 2))
    for i in range(len(ids)):
        point = ids[i]
        change_of_view(pose, keyframes[rows[i]], positions[point], pixels[i], camera, now)
        determinant = now[0, 0] * now[1, 1] - now[0, 1] * now[1, 0]
        if not determinant > 0.0 or not np.isfinite(determinant):
            _fill(now, 1.0, 0.0, 0.0, 1.0)
        outdated[i] = held_views[point] != views[i] or not _still_serves(now, held[point])
        if outdated[i]:
            held_views[point] = views[i]
            if is_small(now[0, 0], now[0, 1], now[1, 0], now[1, 1], 1.0):
                _fill(now, 1.0, 0.0, 0.0, 1.0)
            _fill(held[point], now[0, 0], now[0, 1], now[1, 0], now[1, 1])


@njit(cache=True, nogil=True, fastmath=FAST)
def _copy_patch(level, x, y, patch):
    """Fill a framed patch with the image about a point (x, y)."""
    x, y = x - _FRAMED // 2, y - _FRAMED // 2
    x0, y0 = int(x), int(y)
    right, down = _F32(x - x0), _F32(y - y0)
    left, up = _F32(1.0) - right, _F32(1.0) - down
    for row in range(_FRAMED):
        above, below = level[y0 + row, x0 : x0 + _FRAMED + 1], level[y0 + row + 1, x0 : x0 + _FRAMED + 1]
        line = patch[row * _FRAMED : (row + 1) * _FRAMED]
        for column in range(_FRAMED):
            first = left * _F32(above[column]) + right * _F32(above[column + 1])
            second = left * _F32(below[column]) + right * _F32(below[column + 1])
            line[column] = np.uint8(up * first + down * second + _F32(0.5))


@njit(cache=True, nogil=True, fastmath=FAST)
def _warp_patch(level, x, y, change, patch):
    """The same, so that it looks as the image does after its pixels were moved by a matrix (2, 2)."""
    determinant = change[0, 0] * change[1, 1] - change[0, 1] * change[1, 0]
    a, b = _F32(change[1, 1] / determinant), _F32(-change[0, 1] / determinant)
    c, d = _F32(-change[1, 0] / determinant), _F32(change[0, 0] / determinant)
    middle, last_u, last_v = _F32(_FRAMED // 2), level.shape[1] - 2, level.shape[0] - 2
    x, y = _F32(x), _F32(y)
    for row in range(_FRAMED):
        below = _F32(row) - middle
        line = patch[row * _FRAMED : (row + 1) * _FRAMED]
        for column in range(_FRAMED):
            right = _F32(column) - middle
            u, v = x + a * right + b * below, y + c * right + d * below
            # Beyond the margin the image goes on as it is there.
            u0, v0 = min(max(int(u), 0), last_u), min(max(int(v), 0), last_v)
            du, dv = min(max(u - _F32(u0), _F32(0.0)), _F32(1.0)), min(max(v - _F32(v0), _F32(0.0)), _F32(1.0))
            first = (_F32(1.0) - du) * _F32(level[v0, u0]) + du * _F32(level[v0, u0 + 1])
            second = (_F32(1.0) - du) * _F32(level[v0 + 1, u0]) + du * _F32(level[v0 + 1, u0 + 1])
            line[column] = np.uint8((_F32(1.0) - dv) * first + dv * second + _F32(0.5))


@njit(cache=True, nogil=True)
def _cut_out(pyramid, ids, pixels, changes, patches):
    """Make the patches (levels, room) of points from the pyramid of their keyframe."""
    for i in range(len(ids)):
        change = changes[ids[i]]
        unwarped = _is_identity(change)
        for number in range(len(pyramid)):
            level, patch = pyramid[number], patches[ids[i], number]
            x, y = pixels[i, 0] / (1 << number) + MARGIN, pixels[i, 1] / (1 << number) + MARGIN
            if unwarped:
                _copy_patch(level, x, y, patch)
            else:
                _warp_patch(level, x, y, change, patch)


@njit(cache=True, nogil=True, fastmath=FAST)
def _prepare(patch, greys, across, along):
    """The inner part of a framed patch, its slopes by Scharr's operator, and the sums of their products.

    What an offset and a gain of the brightness explain is taken out of the slopes: those that are orthogonal to both
    give the motion that least squares with both free give.
    """
    near, far = _F32(10.0 / 32.0), _F32(3.0 / 32.0)
    for p in range(_SPAN):
        inside, here, below = _INSIDE[p], p + _FRAMED, p + 2 * _FRAMED
        falling = _F32(patch[below + 2]) - _F32(patch[p])
        rising = _F32(patch[p + 2]) - _F32(patch[below])
        beside, over = _F32(patch[here + 2]) - _F32(patch[here]), _F32(patch[below + 1]) - _F32(patch[p + 1])
        across[p] = inside * (far * (falling + rising) + near * beside)
        along[p] = inside * (far * (falling - rising) + near * over)
        greys[p] = inside * (_F32(patch[here + 1]) - _F32(NEUTRAL))
    t = tt = x = y = xt = yt = _F32(0.0)
    for p in range(_SPAN):
        grey, a, b = greys[p], across[p], along[p]
        t += grey
        tt += grey * grey
        x += a
        y += b
        xt += a * grey
        yt += b * grey
    count = _F32(_SIDE * _SIDE)
    mean_t, mean_x, mean_y = t / count, x / count, y / count
    square = max(tt - t * mean_t, _F32(1.0))
    gain_x, gain_y = (xt - x * mean_t) / square, (yt - y * mean_t) / square
    offset_x, offset_y = mean_x - gain_x * mean_t, mean_y - gain_y * mean_t
    for p in range(_SPAN):
        across[p] -= _INSIDE[p] * offset_x + gain_x * greys[p]
        along[p] -= _INSIDE[p] * offset_y + gain_y * greys[p]
    xx = xy = yy = _F32(0.0)
    for p in range(_SPAN):
        a, b = across[p], along[p]
        xx += a * a
        xy += a * b
        yy += b * b
    return xx, xy, yy


@njit(cache=True, nogil=True)
def _copy_seen(level, column, row, seen):
    """Copy the pixels that a patch is compared with, its first one between this pixel and the next."""
    for i in range(_SIDE + 1):
        pixels, start = level[row + i, column : column + _SIDE + 1], i * _FRAMED
        for j in range(_SIDE + 1):
            seen[start + j] = pixels[j]


@njit(cache=True, nogil=True, fastmath=FAST)
def _difference(seen, right, down, greys, across, along):
    """Sums of the slopes of a patch times what the image differs from it, this part of a pixel to the right and down.

    The slopes are orthogonal to a constant, so that it makes no difference that `NEUTRAL` is taken from the greys.
    """
    left, up = _F32(1.0) - right, _F32(1.0) - down
    by_x, by_y = _F32(0.0), _F32(0.0)
    for p in range(_SPAN):
        above = left * _F32(seen[p]) + right * _F32(seen[p + 1])
        below = left * _F32(seen[p + _FRAMED]) + right * _F32(seen[p + _FRAMED + 1])
        differs = up * above + down * below - greys[p]
        by_x += differs * across[p]
        by_y += differs * along[p]
    return by_x, by_y


@njit(cache=True, nogil=True)
def _approach(level, x, y, xx, xy, yy, greys, across, along, last_step, reach, seen):
    """Where in an image a prepared patch is, from a point (x, y) on, and whether it stays in reach.

    With the slopes of the patch in place of those of the image each step goes a certain share of the way that is left.
    What a step leaves of the next one tells the share; then the next one goes the whole way (Aitken's extrapolation).
    """
    determinant = float(xx) * yy - float(xy) * xy
    first_x, first_y, half = x, y, _SIDE // 2 - MARGIN
    last_x, last_y = level.shape[1] - 2.0 * MARGIN - 1.0, level.shape[0] - 2.0 * MARGIN - 1.0
    before_x = before_y = moved_x = moved_y = moved = 0.0
    column = row = -1
    for _ in range(MOST_STEPS):
        if not (0.0 <= x <= last_x and 0.0 <= y <= last_y and max(abs(x - first_x), abs(y - first_y)) <= reach):
            return x, y, False
        left, top = x - half, y - half
        if int(left) != column or int(top) != row:
            column, row = int(left), int(top)
            _copy_seen(level, column, row, seen)
        by_x, by_y = _difference(seen, _F32(left - column), _F32(top - row), greys, across, along)
        step_x = (xy * by_y - yy * by_x) / determinant
        step_y = (xy * by_x - xx * by_y) / determinant
        share = 1.0
        if 0.0 < moved < NEAR_STEP * NEAR_STEP:
            share = ((before_x - step_x) * moved_x + (before_y - step_y) * moved_y) / moved
            share = min(max(share, LEAST_SHARE), MOST_SHARE)
        before_x, before_y, moved_x, moved_y = step_x, step_y, step_x / share, step_y / share
        moved = moved_x * moved_x + moved_y * moved_y
        x += moved_x
        y += moved_y
        if step_x * step_x + step_y * step_y < last_step * last_step:
            break
    return x, y, True


@njit(cache=True, nogil=True, fastmath=FAST)
def _likeness(level, x, y, greys):
    """Correlation of the middle of a patch with the image about a point (x, y) of it."""
    first, size = _SIDE // 2 - PATCH_HALF, 2 * PATCH_HALF + 1
    x, y = x - PATCH_HALF, y - PATCH_HALF
    x0, y0 = int(x), int(y)
    right, down = _F32(x - x0), _F32(y - y0)
    left, up = _F32(1.0) - right, _F32(1.0) - down
    sum_a = sum_b = aa = bb = ab = _F32(0.0)
    for row in range(size):
        pixels, next_pixels = level[y0 + row, x0 : x0 + size + 1], level[y0 + row + 1, x0 : x0 + size + 1]
        start = (first + row) * _FRAMED + first
        template = greys[start : start + size]
        for column in range(size):
            a = template[column]
            above = left * _F32(pixels[column]) + right * _F32(pixels[column + 1])
            below = left * _F32(next_pixels[column]) + right * _F32(next_pixels[column + 1])
            b = up * above + down * below - _F32(NEUTRAL)
            sum_a += a
            sum_b += b
            aa += a * a
            bb += b * b
            ab += a * b
    count = _F32(size * size)
    squares = (aa - sum_a * sum_a / count) * (bb - sum_b * sum_b / count)
    return (ab - sum_a * sum_b / count) / math.sqrt(squares) if squares > 1e-6 else 0.0


@njit(cache=True, nogil=True)
def _align(patches, ids, pyramid, first, reach, pixels, likeness):
    """Move each point to where its patch is in an image; ``likeness`` is -1 where it is nowhere.

    Parameters
    ----------
    patches : (p, levels, room) of all points.
    ids : (n,) the points to look for.
    pyramid : of the image.
    first : level to begin on.
    reach : pixels along either axis that a point may go on a level.
    pixels : (n, 2) where to begin; where they are.
    likeness : (n,) correlation of the patch there.
    """
    greys, across, along = np.empty(_SPAN, _F32), np.empty(_SPAN, _F32), np.empty(_SPAN, _F32)
    seen, lowest = np.zeros(_ROOM, np.uint8), LEAST_SLOPE * _SIDE * _SIDE
    height, width = pyramid[0].shape[0] - 2 * MARGIN, pyramid[0].shape[1] - 2 * MARGIN
    for i in range(len(ids)):
        x, y = pixels[i, 0], pixels[i, 1]
        found = False
        for number in range(first, -1, -1):
            xx, xy, yy = _prepare(patches[ids[i], number], greys, across, along)
            found = 0.5 * (xx + yy) - math.hypot(0.5 * (xx - yy), xy) > lowest
            if found:
                size, last = float(1 << number), LAST_STEP if number == 0 else LAST_COARSE_STEP
                x, y, found = _approach(
                    pyramid[number], x / size, y / size, xx, xy, yy, greys, across, along, last, reach / size, seen
                )
                x, y = x * size, y * size
                if not found:
                    break
        pixels[i, 0], pixels[i, 1], likeness[i] = x, y, -1.0
        inside = min(x, y) >= PATCH_HALF and x < width - 1 - PATCH_HALF and y < height - 1 - PATCH_HALF
        if found and inside:
            likeness[i] = _likeness(pyramid[0], x + MARGIN, y + MARGIN, greys)


class Templates:
    """The patches of a map's points, each kept until its keyframe or the view of it has changed much."""

    def __init__(self, intrinsics: Array) -> None:
        self._intrinsics = intrinsics
        self._patches = np.empty((0, N_LEVELS, _ROOM), dtype=np.uint8)
        self._views, self._changes = np.empty(0, dtype=np.int64), np.empty((0, 2, 2))

    def outdated(
        self,
        ids: Indices,
        views: Indices,
        pose: Array,
        keyframes: tuple[Array, Indices],
        positions: Array,
        pixels: Array,
    ) -> NDArray[np.bool_]:
        """Which points' patches (n,) have to be made anew, for views from a pose (4, 4).

        Parameters
        ----------
        ids : (n,) the points.
        views : (n,) keyframes that they are looked for from.
        pose : (4, 4) camera from world.
        keyframes : poses (k, 4, 4) of some keyframes, and the row (n,) of each point's.
        positions : (p, 3) of all points of the map.
        pixels : (n, 2) where the points are in their keyframes.
        """
        self._make_room(len(positions))
        result = np.empty(len(ids), dtype=np.bool_)
        _choose_changes(
            ids, views, self._views, self._changes, pose, *keyframes, positions, pixels, self._intrinsics, result
        )
        return result

    def make(self, ids: Indices, pixels: Array, keyframe: Pyramid) -> None:
        """Make the patches of points (n,), which are at ``pixels`` (n, 2) of a keyframe."""
        _cut_out(keyframe, ids, pixels, self._changes, self._patches)

    def align(
        self, ids: Indices, image: Pyramid, guesses: Array, levels: int, reach: float = np.inf
    ) -> tuple[Array, Array]:
        """Where points (n,) are in an image.

        Parameters
        ----------
        ids : (n,) points that have patches.
        image : its pyramid.
        guesses : (n, 2) pixels to begin at.
        levels : above the image itself, on which to begin.
        reach : pixels along either axis, per level, that a point may go from where it begins.

        Returns
        -------
        pixels : (n, 2).
        likeness : (n,) correlation of the patches there; -1 where a point was not found.
        """
        pixels, likeness = guesses.copy(), np.empty(len(ids))
        _align(self._patches, ids, image, levels, reach, pixels, likeness)
        return pixels, likeness

    def _make_room(self, n_points: int) -> None:
        """Have places for all points of the map."""
        n = len(self._views)
        if n_points <= n:
            return
        room = max(n_points, 2 * n) - n
        self._patches = np.concatenate([self._patches, np.empty((room, *self._patches.shape[1:]), dtype=np.uint8)])
        self._views = np.concatenate([self._views, np.full(room, -1)])
        self._changes = np.concatenate([self._changes, np.zeros((room, 2, 2))])
