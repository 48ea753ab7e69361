"""Points of a complete map measured once more in its keyframes, each from one reference view.

While a map grows, a point is followed from the keyframe before, as a patch that only moves: small errors add up as the
view changes. Once the map is complete, each point's patch is cut out of one keyframe and matched in all others with an
affine warp, offset and gain of its brightness free: adaptive least squares correlation (Gruen 1985), in the inverse
compositional form of Baker and Matthews, Lucas-Kanade 20 Years On, 2004.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numba import njit
from numpy.typing import NDArray

from morph_dslam.row_products import FAST
from morph_dslam.slam.pose import inverse
from morph_dslam.slam.result import SlamFrame
from morph_dslam.slam.rigid_map import GOOD, Followed, Indices, RigidMap
from morph_dslam.slam.templates import change_of_view
from morph_dslam.small_arrays import cholesky_solve
from morph_dslam.tracking.patches import NEUTRAL

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
#: Half the side of a patch, pixels, and the standard deviation of the weights that fall off from its middle.
HALF, WEIGHT_STD_PX = 10, 6.0
#: A shorter step ends the search, pixels; steps at most; and how far a point may be from where it was followed to.
LAST_STEP, MOST_STEPS, MOST_MOVE_PX = 0.01, 20, 3.0
#: What a match explains of the patch's contrast, as a correlation.
LEAST_MATCH = 0.85
#: A match whose place has a larger standard deviation, by what it does not explain, is none; pixels.
MOST_STD_PX = 0.25
#: Axes of a patch are stretched by at most this factor, and shrunk by as much.
MOST_STRETCH = 3.0
#: What could not be matched is taken out of a point that was matched in so many other keyframes.
LEAST_OTHERS = 2
_SIDE = 2 * HALF + 1
_N = _SIDE * _SIDE
#: Unknowns: two of the place, four of the warp, gain and offset.
_N_UNKNOWNS = 8
_F32 = np.float32


@njit(cache=True, nogil=True, fastmath=FAST)
def _sample(image, x, y):
    """Bilinear value at a point at least a pixel inside the image."""
    x0, y0 = int(x), int(y)
    right, down = x - _F32(x0), y - _F32(y0)
    above = _F32(image[y0, x0]) + right * (_F32(image[y0, x0 + 1]) - _F32(image[y0, x0]))
    below = _F32(image[y0 + 1, x0]) + right * (_F32(image[y0 + 1, x0 + 1]) - _F32(image[y0 + 1, x0]))
    return above + down * (below - above)


@njit(cache=True, nogil=True, fastmath=FAST)
def _prepare(image, x, y, weights, patch, slopes):
    """Fill a patch (n,) and the weighted derivatives (8, n) of its brightness by the unknowns; their inverse normal."""
    for row in range(_SIDE):
        for column in range(_SIDE):
            u, v = _F32(x + column - HALF), _F32(y + row - HALF)
            i = row * _SIDE + column
            patch[i] = _sample(image, u, v)
            gx = _F32(0.5) * (_sample(image, u + _F32(1.0), v) - _sample(image, u - _F32(1.0), v))
            gy = _F32(0.5) * (_sample(image, u, v + _F32(1.0)) - _sample(image, u, v - _F32(1.0)))
            dx, dy = _F32(column - HALF), _F32(row - HALF)
            slopes[0, i], slopes[1, i] = gx, gy
            slopes[2, i], slopes[3, i], slopes[4, i], slopes[5, i] = gx * dx, gx * dy, gy * dx, gy * dy
            slopes[6, i], slopes[7, i] = patch[i] - _F32(NEUTRAL), _F32(1.0)
    normal = np.zeros((_N_UNKNOWNS, _N_UNKNOWNS))
    for a in range(_N_UNKNOWNS):
        for b in range(a + 1):
            value = 0.0
            for i in range(_N):
                value += weights[i] * slopes[a, i] * slopes[b, i]
            normal[a, b] = normal[b, a] = value
    for a in range(_N_UNKNOWNS):
        for i in range(_N):
            slopes[a, i] *= weights[i]
    result, unit = np.empty((_N_UNKNOWNS, _N_UNKNOWNS)), np.zeros(_N_UNKNOWNS)
    for a in range(_N_UNKNOWNS):
        unit[a] = 1.0
        column_of = cholesky_solve(normal, unit)
        for b in range(_N_UNKNOWNS):
            result[b, a] = column_of[b]
        unit[a] = 0.0
    return result


@njit(cache=True, nogil=True, fastmath=FAST)
def _warped(image, x, y, warp, out):
    """Sample an image about a point at the places of a patch's pixels warped by a matrix (2, 2); whether all are in."""
    a, b, c, d = _F32(warp[0, 0]), _F32(warp[0, 1]), _F32(warp[1, 0]), _F32(warp[1, 1])
    reach_x, reach_y = HALF * (abs(a) + abs(b)), HALF * (abs(c) + abs(d))
    height, width = image.shape
    if x < reach_x or y < reach_y or x + reach_x >= width - 2 or y + reach_y >= height - 2:
        return False
    x, y = _F32(x), _F32(y)
    for row in range(_SIDE):
        dy = _F32(row - HALF)
        for column in range(_SIDE):
            dx = _F32(column - HALF)
            out[row * _SIDE + column] = _sample(image, x + a * dx + b * dy, y + c * dx + d * dy)
    return True


@njit(cache=True, nogil=True)
def _is_sound(warp):
    """Whether a warp mirrors nothing and stretches by little."""
    turn = math.hypot(warp[0, 0] + warp[1, 1], warp[1, 0] - warp[0, 1])
    sheared = math.hypot(warp[0, 0] - warp[1, 1], warp[1, 0] + warp[0, 1])
    return turn - sheared > 2.0 / MOST_STRETCH and turn + sheared < 2.0 * MOST_STRETCH


@njit(cache=True, nogil=True, fastmath=FAST)
def _left_over(differences, patch, weights, slopes, step):
    """Of the brightness of an image that differs from a patch: the part of its contrast, and the variance, that the
    unknowns' step does not explain."""
    total = left = mean = square = _F32(0.0)
    for i in range(_N):
        rest = weights[i] * differences[i]
        for a in range(_N_UNKNOWNS):
            rest -= _F32(step[a]) * slopes[a, i]
        seen = patch[i] + differences[i] - _F32(NEUTRAL)
        total += weights[i]
        left += rest * rest / weights[i]
        mean += weights[i] * seen
        square += weights[i] * seen * seen
    return left / max(square - mean * mean / total, 1e-6), left / (total - _N_UNKNOWNS)


@njit(cache=True, nogil=True)
def _compose(warp, step):
    """Change a warp (2, 2) to what it is after the inverse of a step; whether there is one."""
    p, q, r, s = 1.0 + step[2], step[3], step[4], 1.0 + step[5]
    determinant = p * s - q * r
    if not determinant > 0.1:
        return False
    for row in range(2):
        first, second = warp[row, 0], warp[row, 1]
        warp[row, 0], warp[row, 1] = (first * s - second * r) / determinant, (second * p - first * q) / determinant
    return True


@njit(cache=True, nogil=True, fastmath=FAST)
def _find(image, guess, warp, patch, slopes, inverse_normal, weights):
    """Move a guess (2,) in an image to where a patch is, if it is there; from its warp (2, 2), which is changed."""
    differences, step, right = np.empty(_N, _F32), np.zeros(_N_UNKNOWNS), np.empty(_N_UNKNOWNS)
    u, v = guess
    for _ in range(MOST_STEPS):
        if not (_is_sound(warp) and _warped(image, u, v, warp, differences)):
            return False
        for k in range(_N):
            differences[k] -= patch[k]
        for a in range(_N_UNKNOWNS):
            value = _F32(0.0)
            for k in range(_N):
                value += slopes[a, k] * differences[k]
            right[a] = value
        for a in range(_N_UNKNOWNS):
            step[a] = 0.0
            for b in range(_N_UNKNOWNS):
                step[a] += inverse_normal[a, b] * right[b]
        if not _compose(warp, step):
            return False
        move_x = warp[0, 0] * step[0] + warp[0, 1] * step[1]
        move_y = warp[1, 0] * step[0] + warp[1, 1] * step[1]
        u, v = u - move_x, v - move_y
        if math.hypot(u - guess[0], v - guess[1]) > MOST_MOVE_PX:
            return False
        if math.hypot(move_x, move_y) < LAST_STEP:
            part, variance = _left_over(differences, patch, weights, slopes, step)
            spread = variance * (inverse_normal[0, 0] + inverse_normal[1, 1])
            guess[0], guess[1] = u, v
            return part < 1.0 - LEAST_MATCH**2 and spread < MOST_STD_PX**2
    return False


@njit(cache=True, nogil=True)
def _match(reference, image, places, guesses, warps, weights, found):
    """Move the guesses (n, 2) in an image to where the patches about ``places`` (n, 2) of a reference are.

    Parameters
    ----------
    warps : (n, 2, 2) to begin with, changed.
    found : (n,) which were matched; the guesses of the others mean nothing.
    """
    patch, slopes = np.empty(_N, _F32), np.empty((_N_UNKNOWNS, _N), _F32)
    height, width = reference.shape
    for i in range(len(places)):
        x, y = places[i, 0], places[i, 1]
        found[i] = min(x, y) >= HALF + 2 and x <= width - HALF - 4 and y <= height - HALF - 4
        if found[i]:
            inverse_normal = _prepare(reference, x, y, weights, patch, slopes)
            found[i] = _find(image, guesses[i], warps[i], patch, slopes, inverse_normal, weights)


#: By how much points moved (n, 2) in a keyframe, with their numbers (n,), by the keyframe's number.
Moves = dict[int, tuple[Indices, Array]]


def measure_again(rigid_map: RigidMap, intrinsics: Array) -> Moves:
    """Measure the points of a complete map again in all of its keyframes that see them; by how much they moved.

    Observations that cannot be matched are taken out where a point has enough others; where it has not, all of them
    stay as they were.

    Parameters
    ----------
    rigid_map : whose keyframes' pixels are replaced, not its poses and points
    intrinsics : (4,) of the keyframes' images
    """
    kept = rigid_map.kept_keyframes.tolist()
    references = _reference_views(rigid_map, kept)
    found = {k: np.zeros(len(rigid_map.keyframes[k].point_ids), dtype=bool) for k in kept}
    pixels = {k: rigid_map.keyframes[k].pixels.copy() for k in kept}
    offsets = np.arange(_SIDE) - HALF
    weights = np.exp(-(offsets[:, None] ** 2 + offsets**2) / (2.0 * WEIGHT_STD_PX**2)).ravel().astype(_F32)
    for reference in kept:
        at = rigid_map.keyframes[reference]
        for k in kept:
            keyframe = rigid_map.keyframes[k]
            rows = np.flatnonzero(references[keyframe.point_ids] == reference)
            if k == reference:
                found[k][rows] = True
            elif len(rows):
                ids = keyframe.point_ids[rows]
                places, poses = at.pixels[at.rows_of(ids)[0]], (keyframe.camera_from_world, at.camera_from_world)
                warps = _warps(*poses, rigid_map.positions[ids], places, intrinsics)
                moved, is_found = pixels[k][rows], np.zeros(len(rows), dtype=bool)
                _match(at.normalized, keyframe.normalized, places, moved, warps, weights, is_found)
                pixels[k][rows], found[k][rows] = moved, is_found
    return _take_over(rigid_map, found, pixels)


def _reference_views(rigid_map: RigidMap, kept: list[int]) -> Indices:
    """The keyframe (n,) that sees each map point most from the middle of the directions that it is seen from; or -1."""
    keyframes = [rigid_map.keyframes[k] for k in kept]
    numbers = np.repeat(kept, [len(keyframe.point_ids) for keyframe in keyframes])
    ids = np.concatenate([keyframe.point_ids for keyframe in keyframes])
    centres = {k: inverse(rigid_map.keyframes[k].camera_from_world)[:3, 3] for k in kept}
    directions = np.array([centres[k] for k in numbers.tolist()]).reshape(-1, 3) - rigid_map.positions[ids]
    directions /= np.maximum(np.linalg.norm(directions, axis=1, keepdims=True), 1e-12)
    means = np.zeros((len(rigid_map.state), 3))
    np.add.at(means, ids, directions)
    order = np.argsort(np.einsum("ni,ni->n", directions, means[ids]), kind="stable")
    result = np.full(len(rigid_map.state), -1)
    result[ids[order]] = numbers[order]
    return np.where(rigid_map.state == GOOD, result, -1)


def _warps(pose: Array, reference: Array, positions: Array, places: Array, intrinsics: Array) -> Array:
    """Matrices (n, 2, 2) that patches change by from a reference view to another, parallel to its image."""
    result = np.empty((len(positions), 2, 2))
    for position, place, warp in zip(positions, places, result, strict=True):
        change_of_view(pose, reference, position, place, intrinsics, warp)
    return result


def _take_over(rigid_map: RigidMap, found: dict[int, Mask], pixels: dict[int, Array]) -> Moves:
    """Let keyframes have the matched pixels, and drop what could not be matched of points that were in two others."""
    n_found, moves = np.zeros(len(rigid_map.state), dtype=np.int64), Moves()
    for k, matched in found.items():
        n_found[rigid_map.keyframes[k].point_ids[matched]] += 1
    for k, matched in found.items():
        keyframe = rigid_map.keyframes[k]
        enough = n_found[keyframe.point_ids] > LEAST_OTHERS
        new = matched & enough
        shifts = np.where(new[:, None], pixels[k] - keyframe.pixels, 0.0)
        moves[k] = keyframe.point_ids, shifts
        keyframe.pixels, keyframe.right = keyframe.pixels + shifts, keyframe.right + shifts[:, 0]
        keyframe.keep(new | ~enough)
        of_template = rigid_map.template_keyframe[keyframe.point_ids] == k
        rigid_map.template_pixels[keyframe.point_ids[of_template]] = keyframe.pixels[of_template]
    return moves


def moved_along(frames: Sequence[SlamFrame], moves: Moves, n_points: int) -> list[SlamFrame]:
    """Frames whose points have moved as in the keyframes that they were followed from.

    A frame's points were followed from the newest keyframe that saw them, and missed as they did there.

    Parameters
    ----------
    frames : in their order, of the map whose keyframes' points moved
    moves : of the keyframes
    n_points : of the map
    """
    shifts, result, numbers = np.zeros((n_points, 2)), list[SlamFrame](), sorted(moves)
    for frame in frames:
        while numbers and numbers[0] <= frame.keyframe:
            ids, moved = moves[numbers.pop(0)]
            shifts[ids] = moved
        seen = frame.points
        moved = shifts[seen.ids]
        points = Followed(seen.ids, seen.pixels + moved, seen.right + moved[:, 0])
        result.append(replace(frame, points=points.without_unmeasured()))
    return result
