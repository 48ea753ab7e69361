"""Separated fields: modes in space times functions of the parameters."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from morph_dslam.errors import ParameterError
from morph_dslam.model.functions import Functions

Array = NDArray[np.float64]
#: What a field is outside the box of its parameters. "bounded": that of the nearest state in the box;
#: "linear": continued from there by its tangents (C1, linear in each parameter), see `SeparatedField.inside`.
Outside = Literal["bounded", "linear"]


def check_outside(outside: str) -> None:
    """Raise ParameterError unless it says what a field is outside of the box."""
    if outside not in ("bounded", "linear"):
        raise ParameterError(f"outside={outside!r} is not known: give 'bounded' or 'linear'")


#: Numbers that are added up at a time: they stay in the processor's nearest memory meanwhile.
_AT_A_TIME = 384


@njit(cache=True, nogil=True)
def combine_modes(rows, modes):
    """``rows`` (r, m) times ``modes`` (m, n); a part of the numbers and four modes at a pass, which spares traffic."""
    n_rows, m = rows.shape
    n = modes.shape[1]
    result = np.zeros((n_rows, n))
    whole = m - m % 4
    for begin in range(0, n, _AT_A_TIME):
        end = min(begin + _AT_A_TIME, n)
        for i in range(0, whole, 4):
            first, second = modes[i, begin:end], modes[i + 1, begin:end]
            third, fourth = modes[i + 2, begin:end], modes[i + 3, begin:end]
            for row in range(n_rows):
                a, b, c, d = rows[row, i], rows[row, i + 1], rows[row, i + 2], rows[row, i + 3]
                if a == 0.0 and b == 0.0 and c == 0.0 and d == 0.0:  # a load's response does not depend on other loads
                    continue
                line = result[row, begin:end]
                for p in range(end - begin):
                    line[p] += a * first[p] + b * second[p] + c * third[p] + d * fourth[p]
        for i in range(whole, m):
            first = modes[i, begin:end]
            for row in range(n_rows):
                a, line = rows[row, i], result[row, begin:end]
                for p in range(end - begin):
                    line[p] += a * first[p]
    return result


@njit(cache=True, nogil=True)
def interpolate(modes, corners, weights, found):
    """Fill modes (m, p, k) at points of a mesh from those at its nodes (n,).

    Parameters
    ----------
    modes : (m, n, k).
    corners, weights : (p, c) node indices and what each counts.
    found : (m, p, k), to be filled.
    """
    if corners.shape[1] == 3:
        _interpolate_on_triangles(modes, corners, weights, found)
        return
    for i in range(found.shape[0]):
        for j in range(found.shape[1]):
            for k in range(found.shape[2]):
                total = 0.0
                for c in range(corners.shape[1]):
                    total += weights[j, c] * modes[i, corners[j, c], k]
                found[i, j, k] = total


@njit(cache=True, nogil=True)
def _interpolate_on_triangles(modes, corners, weights, found):
    """`interpolate` with three corners written out: more of the modes' numbers are then on their way at a time."""
    for i in range(found.shape[0]):
        of_mode, line = modes[i], found[i]
        for j in range(found.shape[1]):
            # Without a sign: no index is looked at for whether it counts from the end.
            a, b, c = np.uint64(corners[j, 0]), np.uint64(corners[j, 1]), np.uint64(corners[j, 2])
            of_a, of_b, of_c = weights[j, 0], weights[j, 1], weights[j, 2]
            for k in range(found.shape[2]):
                line[j, k] = of_a * of_mode[a, k] + of_b * of_mode[b, k] + of_c * of_mode[c, k]


@njit(cache=True, nogil=True)
def placed_points(row, rest, modes, rotation, translation):
    """Points moved by a field and then by a rigid motion (n, 3), compiled; sums are in the modes' precision.

    Parameters
    ----------
    row : (m,) values of the functions.
    rest : (n, 3) points
    modes : (m, n, 3) at them, same unit.
    rotation, translation : (3, 3) and (3,).
    """
    m, size = len(row), 3 * len(rest)
    result, flat_rest, flat_modes = np.empty((len(rest), 3)), rest.reshape(size), modes.reshape(m, size)
    numbers, sums = row.astype(modes.dtype), np.empty(_AT_A_TIME, modes.dtype)
    whole = m - m % 4
    for begin in range(0, size, _AT_A_TIME):
        count = min(_AT_A_TIME, size - begin)
        end = begin + count
        sums[:] = 0.0
        for i in range(0, whole, 4):
            a, b, c, d = numbers[i], numbers[i + 1], numbers[i + 2], numbers[i + 3]
            first, second = flat_modes[i, begin:end], flat_modes[i + 1, begin:end]
            third, fourth = flat_modes[i + 2, begin:end], flat_modes[i + 3, begin:end]
            for k in range(count):
                sums[k] += a * first[k] + b * second[k] + c * third[k] + d * fourth[k]
        for i in range(whole, m):
            a, first = numbers[i], flat_modes[i, begin:end]
            for k in range(count):
                sums[k] += a * first[k]
        for k in range(0, count, 3):
            x, y, z = (flat_rest[begin + k] + sums[k], flat_rest[begin + k + 1] + sums[k + 1],
                       flat_rest[begin + k + 2] + sums[k + 2])  # fmt: skip
            for j in range(3):
                moved = rotation[j, 0] * x + rotation[j, 1] * y + rotation[j, 2] * z + translation[j]
                result[(begin + k) // 3, j] = moved
    return result


@dataclass(frozen=True)
class SeparatedField:
    """U(X, mu) = sum_i F_i(X) H_i(mu), the paper's separated representation.

    Attributes
    ----------
    modes : (n_modes, n_points, n_components), the functions F_i at the points, in the field's SI unit; in double or
        single precision, sums are in double but for `placed`.
    functions : the n_modes functions H_i, in any format.
    """

    modes: NDArray[np.floating]
    functions: Functions

    @property
    def n_modes(self) -> int:
        return self.modes.shape[0]

    @property
    def n_floats(self) -> int:
        """Numbers stored, for the compression factor."""
        return self.modes.size + self.functions.n_floats

    def inside(self, mu: ArrayLike) -> NDArray[np.bool_]:
        """Which parameters (d,) of ``mu`` (d,) lie in their range; always so for a periodic one."""
        return self.functions.inside(mu)

    def _state(self, mu: ArrayLike, outside: Outside) -> ArrayLike:
        check_outside(outside)
        return mu if outside == "linear" else self.functions.nearest_inside(mu)

    def value(self, mu: ArrayLike, outside: Outside = "bounded") -> Array:
        """The field (n_points, n_components) at parameters ``mu`` (d,)."""
        rows = self.functions.rows(self._state(mu, outside))
        return combine_modes(rows[:1], self.modes.reshape(self.n_modes, -1)).reshape(self.modes.shape[1:])

    def placed(self, rest: Array, mu: ArrayLike, rotation: Array, translation: Array) -> Array:
        """Points (n_points, 3) moved by the bounded field at ``mu`` (d,), then turned and shifted.

        Parameters
        ----------
        rest : (n_points, 3), in the field's unit.
        rotation, translation : (3, 3), and (3,) in the field's unit.
        """
        row = self.functions.rows(self._state(mu, "bounded"))[0]
        rest, rotation, translation = map(np.ascontiguousarray, (rest, rotation, translation))
        return placed_points(row, rest, np.ascontiguousarray(self.modes), rotation, translation)

    def value_and_sensitivities(self, mu: ArrayLike, outside: Outside = "bounded") -> tuple[Array, Array]:
        """The field (n_points, n_components) and its derivatives (d, n_points, n_components).

        Outside the box a bounded field gives the value and the derivatives of the nearest state in it.
        """
        rows = self.functions.rows(self._state(mu, outside))
        result = combine_modes(rows, self.modes.reshape(self.n_modes, -1))
        result = result.reshape(len(rows), *self.modes.shape[1:])
        return result[0], result[1:]

    def with_modes(self, modes: NDArray[np.floating]) -> SeparatedField:
        """The same functions with other modes (n_modes, any points, any components)."""
        return SeparatedField(np.ascontiguousarray(modes), self.functions)

    def restrict(
        self, corners: NDArray[np.integer], weights: Array, precision: type[np.floating] = np.float64
    ) -> SeparatedField:
        """The same field at p points interpolated from mesh nodes.

        Parameters
        ----------
        corners : (p, c) node indices.
        weights : (p, c) interpolation weights.
        precision : of the modes at the points.
        """
        modes = np.empty((self.n_modes, len(corners), self.modes.shape[2]), precision)
        interpolate(self.modes, corners, weights, modes)
        return self.with_modes(modes)
