"""Where the surface opens or slips along a line and the model does not: a crack that grows, a part that comes off.

Around places spread over the surface a plane is fitted to the residuals of the points nearby, with a step across a
line through the place, in several directions, and with the opening of a crack that ends there. A law, load or shape
that differs from the model's leaves residuals that are smooth over the surface and has no step; a step where the model
itself is cut, as by a notch, follows the deformation. So a jump is a step that differs from those of earlier frames in
which the object had nearly the same shape, by many of its deviations and by a share of the object's size.

Near the end of a crack there is no step of one size: its sides part by the root of the distance from there (Williams,
J. Appl. Mech. 24, 1957). A notch that opens otherwise than the model's does so too, and that may grow faster than the
deformation does; hence such an opening has to be larger.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.spatial import KDTree

from morph_dslam.even_rows import evenly
from morph_dslam.model.discrepancy import farthest_points
from morph_dslam.row_products import FAST
from morph_dslam.small_arrays import median

Array = NDArray[np.float64]
#: Places, as many as there may be, and how far the points of one reach, as a share of the object's diagonal.
PLACES, REACH = 350, 0.08
#: Directions of the line; there are twice as many in which a crack may end.
DIRECTIONS = 6
PATTERNS = 3 * DIRECTIONS
#: Points on each side of the line, and of a crack behind its end.
LEAST_POINTS, LEAST_BEHIND = 5, 3
#: A jump is so many deviations of the step, and this share of the diagonal, and so many pixels.
LEAST_DEVIATIONS, LEAST_SHARE, LEAST_PX = 6.0, 0.005, 2.0
#: So many times that is the opening of a crack that ends at the place, as far from there as its points reach.
END_OPENING = 1.5
#: Near it there is another place with a step that is the same but for this share, and so many deviations.
ALIKE, ALSO_DEVIATIONS = 0.5, 3.0
#: A shape is nearly the same at a distance between these shares of the largest displacement so far; so many are needed.
LIKE, LEAST_LIKE = (0.08, 0.25), 5
#: The object is looked at again when it has moved by this share of the largest displacement so far.
AGAIN = 0.01
#: So many times in turn a place must show a jump.
IN_TURN = 5
#: Earlier frames that are kept, and those of them that a frame is compared with.
KEPT, COMPARED = 256, 9
#: A point that does not support the estimate counts if so many of its nearest ones are off alike.
NEAREST, LEAST_ALIKE = 8, 3
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
        self._samples, self._nearest = _spread(rest, SAMPLES), _nearest(rest)
        self._shapes = np.empty((KEPT + 1, len(self._samples), 3))
        self._steps = np.empty((KEPT + 1, len(self._places), PATTERNS, 2))
        self._count, self._largest = 0, 0.0
        self._in_turn = np.zeros(len(self._places), dtype=int)
        self._sizes = np.zeros(len(self._places))

    @property
    def jumps(self) -> tuple[DisplacementJump, ...]:
        """Those found so far, each with its largest size: a crack does not heal."""
        rows = np.flatnonzero(self._sizes)
        return tuple(DisplacementJump(self._places[k], float(self._sizes[k]), self._reach) for k in rows)

    def learn(
        self, residuals: Array, found: NDArray[np.bool_], used: NDArray[np.bool_], displacement: Array, px: float
    ) -> None:
        """Take in a frame.

        Parameters
        ----------
        residuals : (p, 2) of the points, pixels.
        found : (p,) those that were measured.
        used : (p,) those of them that support the estimate.
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
        usable = self._believed(residuals, found, used)
        values = np.where(usable[:, None], residuals, 0.0)
        steps, deviations = _fit_steps(self._rows, self._first, self._plane, values, usable)
        steps, deviations = px * steps, px * deviations
        like = self._like(away)
        if len(like) >= LEAST_LIKE:
            least = max(self._limit, LEAST_PX * px)
            self._note(_grown_steps(self._steps, like, steps, deviations, self._near > 0.0, least), least)
        self._shapes[count], self._steps[count] = shape, steps
        self._count += 1
        if self._count > KEPT:  # the first shape stays: it is what displacements are measured from
            kept = np.arange(0, self._count, 2)
            self._count = len(kept)
            self._shapes[: self._count], self._steps[: self._count] = self._shapes[kept], self._steps[kept]

    def _believed(self, residuals: Array, found: NDArray[np.bool_], used: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Points (p,) that support the estimate, and those beside a crack, which do not.

        These are off as their neighbours are, and a point that was taken for another one is not.
        """
        known = np.isfinite(residuals).all(axis=1)
        found, used = found & known, used & known
        others = np.flatnonzero(found & ~used)
        if not len(others) or not used.any():
            return used
        near, limit = self._nearest[others], np.linalg.norm(residuals[used], axis=1).max()
        alike = np.linalg.norm(residuals[near] - residuals[others, None], axis=2) < limit
        used[others] = (alike & found[near]).sum(axis=1) >= LEAST_ALIKE
        return used

    def _like(self, away: Array) -> NDArray[np.int64]:
        """Which earlier frames (f,) have nearly this shape, by how far ``away`` (h,) theirs are."""
        rows = np.flatnonzero((away > LIKE[0] * self._largest) & (away < LIKE[1] * self._largest))
        return rows[evenly(len(rows), COMPARED)]

    def _note(self, sizes: Array, least: float) -> None:
        """Note the places at which steps have grown (k,) by ``least``."""
        jumps = np.where(sizes > least, sizes, 0.0)
        self._in_turn = np.where(self._near @ (jumps > 0.0) > 0, self._in_turn + 1, 0)
        found = (self._in_turn >= IN_TURN) & (jumps > 0.0)
        self._sizes[found] = np.maximum(self._sizes[found], jumps[found])


@njit(cache=True, nogil=True)
def _grown_steps(before, rows, steps, deviations, near, least):
    """How far each place's step (k,), in the direction in which that is farthest, is from what it was before.

    What is less than ``least``, at the end of a crack than `END_OPENING` times that, or `LEAST_DEVIATIONS` of the
    difference, or is seen at no other place near it, is zero: a line has several places along it, at which the step is
    about as large. That one needs fewer deviations, as it is one of a few, and a step beside the line leaves more.

    Parameters
    ----------
    before : (h, k, d, 2) steps in earlier frames, metres.
    rows : (f,) those to compare with, by their median.
    steps, deviations : (k, d, 2) and (k, d) now; NaN where there are too few points.
    near : (k, k) which places are near which.
    """
    sizes, u, v = np.zeros(len(steps)), np.empty(len(rows)), np.empty(len(rows))
    for k in range(steps.shape[0]):
        for d in range(steps.shape[1]):
            right, down, deviation = _change(before, rows, steps, deviations, k, d, max(least, sizes[k]), u, v)
            size = np.sqrt(right**2 + down**2)
            needed = least if d < DIRECTIONS else END_OPENING * least
            if not (size > max(needed, sizes[k]) and size > LEAST_DEVIATIONS * deviation):
                continue
            if _is_seen_near(before, rows, steps, deviations, near[k], k, right, down, u, v):
                sizes[k] = size
    return sizes


@njit(cache=True, nogil=True)
def _is_seen_near(before, rows, steps, deviations, near, k, right, down, u, v):
    """Whether the change (right, down) at a place k is seen at another one of those ``near`` (k,) it; the sides of
    places have no common order, so neither has it a sign."""
    size = np.sqrt(right**2 + down**2)
    for other in range(steps.shape[0]):
        if other == k or not near[other]:
            continue
        for d in range(steps.shape[1]):
            there = _change(before, rows, steps, deviations, other, d, ALIKE * size, u, v)
            apart = min(
                (there[0] - right) ** 2 + (there[1] - down) ** 2, (there[0] + right) ** 2 + (there[1] + down) ** 2
            )
            if apart < (ALIKE * size) ** 2 and there[0] ** 2 + there[1] ** 2 > (ALSO_DEVIATIONS * there[2]) ** 2:
                return True
    return False


@njit(cache=True, nogil=True)
def _change(before, rows, steps, deviations, k, d, least, u, v):
    """How far (right, down) a step is from what it was before, and the deviation of that; see `_grown_steps`.

    Zero and infinite if it is surely less than ``least``. ``u`` and ``v`` (f,) are overwritten.
    """
    right, down, count = 0.0, 0.0, len(rows)
    for f in range(count):
        u[f], v[f] = steps[k, d, 0] - before[rows[f], k, d, 0], steps[k, d, 1] - before[rows[f], k, d, 1]
        right, down = max(right, abs(u[f])), max(down, abs(v[f]))
    # A median is no larger than the largest, so that hardly any is needed.
    if not right**2 + down**2 > least**2 or np.isnan(np.sum(u)):
        return 0.0, 0.0, np.inf
    middle_u, middle_v = median(u), median(v)
    # The deviation of a median is 1.25 times that of a mean, and the median distance 1.18 deviations.
    spread = median(np.sqrt((u - middle_u) ** 2 + (v - middle_v) ** 2)) * 1.25 / 1.18 / np.sqrt(count)
    return middle_u, middle_v, np.sqrt(deviations[k, d] ** 2 + spread**2)


def _spread(points: Array, most: int) -> NDArray[np.int64]:
    """Rows of as many of the points (p, 3) as there may be, far apart; of an outline alone there are none."""
    return np.arange(len(points)) if len(points) <= most else farthest_points(points, most)


def _nearest(points: Array) -> NDArray[np.int64]:
    """Rows (p, `NEAREST`) of the points (p, 3) that are nearest to each, fewer where there are not as many."""
    count = min(NEAREST, max(len(points) - 1, 0))
    if not count:
        return np.zeros((len(points), 0), dtype=np.int64)
    found = np.asarray(KDTree(points).query(points, count + 1)[1], dtype=np.int64)
    return found[:, 1:]


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
def _fit_steps(rows, first, plane, values, usable):
    """Steps (k, d, 2) of ``values`` (p, 2) across lines through places, then openings of cracks that end there, a
    reach behind the end, and their deviations (k, d); NaN where there are too few points. Each is from the least
    squares fit of a plane and the pattern; what the plane takes of the pattern is taken from that first (Frisch and
    Waugh, Econometrica 1, 1933). None is larger than the values differ: where there are no points near the line, as
    between the folds of a bellows, it would be extrapolated."""
    count, most = len(first) - 1, 0
    for k in range(count):
        most = max(most, first[k + 1] - first[k])
    steps, deviations = np.full((count, PATTERNS, 2), np.nan), np.full((count, PATTERNS), np.nan)
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
        if n < 2 * LEAST_POINTS + 2:
            continue
        right, down = work[1, :n].copy(), work[2, :n].copy()
        most_u, most_v = most_u - least_u, most_v - least_v
        for row in range(5):
            _take_from(work, n, row)
        squares = _product(work[3], work[3], n) + _product(work[4], work[4], n)
        for d in range(PATTERNS):
            if not _pattern(d, right, down, sides[:n]):
                continue
            # The values are free of the plane already: of the pattern only the size matters.
            size = _product(sides, sides, n)
            for row in range(3):
                size -= _product(work[row], sides, n) ** 2
            if not size > LEAST_WIDTH:  # no more than what a plane could be
                continue
            along_u, along_v = _product(work[3], sides, n), _product(work[4], sides, n)
            steps[k, d, 0] = min(max(along_u / size, -most_u), most_u)
            steps[k, d, 1] = min(max(along_v / size, -most_v), most_v)
            unexplained = max(squares - (along_u**2 + along_v**2) / size, 0.0) / (2 * (n - 4))
            deviations[k, d] = np.sqrt(unexplained / size)
    return steps, deviations


@njit(cache=True, nogil=True)
def _pattern(d, right, down, values):
    """Write what a jump of one is at points ``right`` and ``down`` (n,) of a place to ``values`` (n,); false where too
    few of them are on a side of it."""
    cosine, sine = np.cos(np.pi * d / DIRECTIONS), np.sin(np.pi * d / DIRECTIONS)
    ends, in_front, behind = d >= DIRECTIONS, 0, 0
    for i in range(len(values)):
        across, along = right[i] * cosine + down[i] * sine, down[i] * cosine - right[i] * sine
        size = 0.5
        if ends:  # sqrt(r) |sin(angle / 2)|, the angle that to the crack's way
            size *= np.sqrt(0.5 * max(np.sqrt(across**2 + along**2) - along, 0.0))
        values[i] = size if across > 0.0 else -size
        if not ends or along < 0.0:
            in_front, behind = in_front + (across > 0.0), behind + (across <= 0.0)
    return min(in_front, behind) >= (LEAST_BEHIND if ends else LEAST_POINTS)


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
