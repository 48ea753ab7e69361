"""Where the surface opens or slips along a line and the model does not: a crack that grows, a part that comes off.

Around places spread over the surface a plane is fitted to the residuals of the points nearby, with a step across a
line through the place, in several directions. A law, load or shape that differs from the model's leaves residuals
that are smooth over the surface and has no step; a step where the model itself is cut, as by a notch, follows the
deformation. So a jump is a step that differs from those of earlier frames in which the object had nearly the same
shape, by many of its deviations and by a share of the object's size.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from morph_dslam.even_rows import evenly
from morph_dslam.model.discrepancy import farthest_points
from morph_dslam.row_products import FAST
from morph_dslam.small_arrays import median

Array = NDArray[np.float64]
#: Places, as many as there may be, and how far the points of one reach, as a share of the object's diagonal.
PLACES, REACH = 350, 0.08
#: Directions of the line.
DIRECTIONS = 6
#: Points on each side of the line.
LEAST_POINTS = 5
#: A jump is so many deviations of the step, and this share of the diagonal, and so many pixels.
LEAST_DEVIATIONS, LEAST_SHARE, LEAST_PX = 6.0, 0.005, 2.0
#: A shape is nearly the same at a distance between these shares of the largest displacement so far; so many are needed.
LIKE, LEAST_LIKE = (0.08, 0.25), 5
#: The object is looked at again when it has moved by this share of the largest displacement so far.
AGAIN = 0.01
#: So many times in turn a place must show a jump.
IN_TURN = 5
#: Earlier frames that are kept, and those of them that a frame is compared with.
KEPT, COMPARED = 256, 9
#: Points that are spread less than this across a line, in reaches, are in it.
LEAST_WIDTH = 1e-4
#: Points by whose displacement shapes are compared.
SAMPLES = 40


@dataclass(frozen=True)
class DisplacementJump:
    """A place of the surface that opens or slips along a line.

    Attributes
    ----------
    place : (3,) of the undeformed object, metres.
    size : of the jump, as it has grown since earlier frames of nearly the same shape, metres in the image's plane.
    reach : distance from the place within which points were compared, metres.
    """

    place: Array
    size: float
    reach: float

    @property
    def text(self) -> str:
        """For people: how large it is, and where."""
        x, y, z = 1e3 * self.place
        return f"{1e3 * self.size:.2g} mm near x = {x:.1f}, y = {y:.1f}, z = {z:.1f} mm"


def near_jumps(jumps: Sequence[DisplacementJump], points: Array) -> NDArray[np.bool_]:
    """Which points (n, 3) of the undeformed object are within reach of a jump: stress does not hold there."""
    near = np.zeros(len(points), dtype=bool)
    for jump in jumps:
        near |= np.linalg.norm(points - jump.place, axis=1) < jump.reach
    return near


def largest_jump(jumps: Sequence[DisplacementJump]) -> DisplacementJump:
    """The one that a reader is told of."""
    return max(jumps, key=lambda jump: jump.size)


class JumpDetector:
    """Looks for jumps in the displacement of a surface, frame after frame.

    Parameters
    ----------
    rest : (p, 3) points on the undeformed surface, metres.
    diagonal : of the undeformed object, metres.
    """

    def __init__(self, rest: Array, diagonal: float) -> None:
        self._limit, self._reach = LEAST_SHARE * diagonal, REACH * diagonal
        self._places, self._rows, self._first, self._plane = _surroundings(rest, self._reach)
        apart = np.linalg.norm(self._places[:, None] - self._places, axis=2)
        self._near = (apart < self._reach).astype(np.float64)
        self._samples = _spread(rest, SAMPLES)
        self._shapes = np.empty((KEPT + 1, len(self._samples), 3))
        self._steps = np.empty((KEPT + 1, len(self._places), DIRECTIONS, 2))
        self._count, self._largest = 0, 0.0
        self._in_turn = np.zeros(len(self._places), dtype=int)
        self._sizes = np.zeros(len(self._places))

    @property
    def jumps(self) -> tuple[DisplacementJump, ...]:
        """Those found so far, each with its largest size: a crack does not heal."""
        rows = np.flatnonzero(self._sizes)
        return tuple(DisplacementJump(self._places[k], float(self._sizes[k]), self._reach) for k in rows)

    def learn(self, residuals: Array, used: NDArray[np.bool_], displacement: Array, px: float) -> None:
        """Take in a frame.

        Parameters
        ----------
        residuals : (p, 2) of the points, pixels.
        used : (p,) those that support the estimate.
        displacement : (p, 3) by the model, metres.
        px : metres that a pixel is wide at the object.
        """
        if not len(self._places):
            return
        shape, count = displacement[self._samples], self._count
        apart = self._shapes[:count] - shape
        away = np.sqrt(np.einsum("fsk,fsk->fs", apart, apart)).mean(axis=1)
        if count:
            self._largest = max(self._largest, float(away[0]))
            if away[-1] <= AGAIN * self._largest:
                return
        usable = used & np.isfinite(residuals).all(axis=1)
        values = np.where(usable[:, None], residuals, 0.0)
        steps, deviations = _fit_steps(self._rows, self._first, self._plane, values, usable, DIRECTIONS, LEAST_POINTS)
        steps, deviations = px * steps, px * deviations
        like = self._like(away)
        if len(like) >= LEAST_LIKE:
            least = max(self._limit, LEAST_PX * px)
            self._note(_grown_steps(self._steps, like, steps, deviations, 0.5 * least), least)
        self._shapes[count], self._steps[count] = shape, steps
        self._count += 1
        if self._count > KEPT:  # the first shape stays: it is what displacements are measured from
            kept = np.arange(0, self._count, 2)
            self._count = len(kept)
            self._shapes[: self._count], self._steps[: self._count] = self._shapes[kept], self._steps[kept]

    def _like(self, away: Array) -> NDArray[np.int64]:
        """Which earlier frames (f,) have nearly this shape, by how far ``away`` (h,) theirs are."""
        rows = np.flatnonzero((away > LIKE[0] * self._largest) & (away < LIKE[1] * self._largest))
        return rows[evenly(len(rows), COMPARED)]

    def _note(self, sizes: Array, least: float) -> None:
        """Note the places at which steps have grown (k,) by ``least``."""
        # A line has several places along it, at which the step is about as large.
        jumps = np.where((sizes > least) & (self._near @ (sizes > 0.5 * least) > 1), sizes, 0.0)
        self._in_turn = np.where(self._near @ (jumps > 0.0) > 0, self._in_turn + 1, 0)
        found = (self._in_turn >= IN_TURN) & (jumps > 0.0)
        self._sizes[found] = np.maximum(self._sizes[found], jumps[found])


@njit(cache=True, nogil=True)
def _grown_steps(before, rows, steps, deviations, least):
    """How far each place's step (k,), in the direction in which that is farthest, is from what it was before.

    What is less than ``least``, or `LEAST_DEVIATIONS` of the difference, is zero.

    Parameters
    ----------
    before : (h, k, d, 2) steps in earlier frames, metres.
    rows : (f,) those to compare with, by their median.
    steps, deviations : (k, d, 2) and (k, d) now; NaN where there are too few points.
    """
    sizes, u, v, count = np.zeros(len(steps)), np.empty(len(rows)), np.empty(len(rows)), len(rows)
    for k in range(steps.shape[0]):
        for d in range(steps.shape[1]):
            right, down = 0.0, 0.0
            for f in range(count):
                u[f], v[f] = steps[k, d, 0] - before[rows[f], k, d, 0], steps[k, d, 1] - before[rows[f], k, d, 1]
                right, down = max(right, abs(u[f])), max(down, abs(v[f]))
            # A median is no larger than the largest, so that hardly any is needed.
            if not right**2 + down**2 > max(least, sizes[k]) ** 2 or np.isnan(np.sum(u)):
                continue
            middle_u, middle_v = median(u), median(v)
            change = np.sqrt(middle_u**2 + middle_v**2)
            # The deviation of a median is 1.25 times that of a mean, and the median distance 1.18 deviations.
            spread = median(np.sqrt((u - middle_u) ** 2 + (v - middle_v) ** 2)) * 1.25 / 1.18 / np.sqrt(count)
            clear = change > LEAST_DEVIATIONS * np.sqrt(deviations[k, d] ** 2 + spread**2)
            if clear and change > max(least, sizes[k]):
                sizes[k] = change
    return sizes


def _spread(points: Array, most: int) -> NDArray[np.int64]:
    """Rows of as many of the points (p, 3) as there may be, far apart; of an outline alone there are none."""
    return np.arange(len(points)) if len(points) <= most else farthest_points(points, most)


def _surroundings(rest: Array, reach: float) -> tuple[Array, NDArray[np.int64], NDArray[np.int64], Array]:
    """Places (k, 3) with enough points around them, the points of all (m,), where each begins (k + 1,), and the
    points' coordinates (m, 2) in the plane of those around a place, in reaches."""
    places, rows, plane = [], [], []
    for place in rest[_spread(rest, PLACES)]:
        near = np.flatnonzero(np.linalg.norm(rest - place, axis=1) < reach)
        if len(near) < 2 * LEAST_POINTS + 2:
            continue
        axes = np.linalg.svd(rest[near] - rest[near].mean(axis=0), full_matrices=False)[2]
        places.append(place)
        rows.append(near)
        plane.append((rest[near] - place) @ axes[:2].T / reach)
    first = np.cumsum([0, *(len(near) for near in rows)])
    if not places:
        return np.zeros((0, 3)), np.zeros(0, dtype=np.int64), first, np.zeros((0, 2))
    return np.array(places), np.concatenate(rows), first, np.concatenate(plane)


@njit(cache=True, nogil=True)
def _fit_steps(rows, first, plane, values, usable, directions, least):
    """Steps (k, d, 2) of ``values`` (p, 2) across lines through places, and their deviations (k, d); NaN where there
    are too few points. Each is from the least squares fit of a plane and a step; what the plane takes of the step's
    own pattern is taken from that first (Frisch and Waugh, Econometrica 1, 1933). A step is no larger than the values
    differ: where there are no points near the line, as between the folds of a bellows, it would be extrapolated."""
    count, most = len(first) - 1, 0
    for k in range(count):
        most = max(most, first[k + 1] - first[k])
    steps, deviations = np.full((count, directions, 2), np.nan), np.full((count, directions), np.nan)
    # By rows: ones and the place's two coordinates, made orthonormal, then the two values, less what these explain.
    work, sides = np.empty((5, most)), np.empty(most)
    for k in range(count):
        n, least_u, least_v, most_u, most_v = 0, np.inf, np.inf, -np.inf, -np.inf
        for m in range(first[k], first[k + 1]):
            if usable[rows[m]]:
                u, v = values[rows[m], 0], values[rows[m], 1]
                work[0, n], work[1, n], work[2, n], work[3, n], work[4, n] = 1.0, plane[m, 0], plane[m, 1], u, v
                least_u, least_v, most_u, most_v = min(least_u, u), min(least_v, v), max(most_u, u), max(most_v, v)
                n += 1
        if n < 2 * least + 2:
            continue
        right, down = work[1, :n].copy(), work[2, :n].copy()
        most_u, most_v = most_u - least_u, most_v - least_v
        for row in range(5):
            _take_from(work, n, row)
        squares = _product(work[3], work[3], n) + _product(work[4], work[4], n)
        for d in range(directions):
            cosine, sine, ahead = np.cos(np.pi * d / directions), np.sin(np.pi * d / directions), 0
            for i in range(n):
                in_front = right[i] * cosine + down[i] * sine > 0.0
                sides[i] = 0.5 if in_front else -0.5
                ahead += in_front
            if min(ahead, n - ahead) < least:
                continue
            # The values are free of the plane already: of the pattern only the size matters.
            size = 0.25 * n
            for row in range(3):
                size -= _product(work[row], sides, n) ** 2
            along_u, along_v = _product(work[3], sides, n), _product(work[4], sides, n)
            steps[k, d, 0] = min(max(along_u / size, -most_u), most_u)
            steps[k, d, 1] = min(max(along_v / size, -most_v), most_v)
            unexplained = max(squares - (along_u**2 + along_v**2) / size, 0.0) / (2 * (n - 4))
            deviations[k, d] = np.sqrt(unexplained / size)
    return steps, deviations


@njit(cache=True, nogil=True, fastmath=FAST)
def _product(a, b, n):
    """Sum of the products of the first ``n`` numbers."""
    total = 0.0
    for i in range(n):
        total += a[i] * b[i]
    return total


@njit(cache=True, nogil=True)
def _take_from(work, n, row):
    """Take the plane, which the first three rows span, from the first ``n`` numbers of a row; one of these becomes
    a unit vector, or zero where all points are in a line."""
    for other in range(min(row, 3)):
        share = _product(work[other], work[row], n)
        for i in range(n):
            work[row, i] -= share * work[other, i]
    if row < 3:
        length = np.sqrt(_product(work[row], work[row], n))
        for i in range(n):
            work[row, i] *= 1.0 / length if length > LEAST_WIDTH else 0.0
