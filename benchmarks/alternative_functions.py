"""Functions of the parameters as simpler models would have them, made from those of a reduced model."""

from __future__ import annotations

from itertools import product
from typing import Self

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from morph_dslam.extend.models import Functions

Array = NDArray[np.float64]

#: Shift of a parameter for a difference, in shares of its range.
SHIFT = 1e-6


class _Stand(Functions):
    """Stands in for functions that have been given."""

    def __init__(self, given: Functions) -> None:
        self.given = given
        self.width = given.bounds[1] - given.bounds[0]

    @property
    def n_functions(self) -> int:
        return self.given.n_functions

    @property
    def n_floats(self) -> int:
        return self.given.n_floats

    @property
    def bounds(self) -> tuple[Array, Array]:
        return self.given.bounds

    def partial(self, mu: ArrayLike, orders: tuple[int, ...]) -> Array:
        if sum(orders) > 1:
            raise NotImplementedError("first derivatives only")
        return self.rows(mu)[1 + orders.index(1) if sum(orders) else 0]

    def mixed(self, matrix: Array) -> Self:
        raise NotImplementedError


class Differenced(_Stand):
    """The same values; derivatives by forward differences of values."""

    def _compiled(self, mu: Array) -> Array:
        base = self.given.rows(mu)[0]
        rows = [base]
        for k, width in enumerate(self.width):
            # Inwards, because values are defined in the box only.
            step = SHIFT * width * (-1.0 if mu[k] + SHIFT * width > self.bounds[1][k] else 1.0)
            shifted = mu.copy()
            shifted[k] += step
            rows.append((self.given.rows(shifted)[0] - base) / step)
        return np.stack(rows)


class Linearised(_Stand):
    """The tangent at a state."""

    def __init__(self, given: Functions, state: Array) -> None:
        super().__init__(given)
        self._state, self._rows = state, given.rows(state)

    def _compiled(self, mu: Array) -> Array:
        return np.vstack([self._rows[0] + (mu - self._state) @ self._rows[1:], self._rows[1:]])


class Hats(_Stand):
    """Interpolated linearly between ``count`` values of each parameter."""

    def __init__(self, given: Functions, count: int) -> None:
        super().__init__(given)
        self._count = count
        axes = [np.linspace(low, high, count) for low, high in zip(*given.bounds, strict=True)]
        self._values = np.array([given.rows(np.array(mu))[0] for mu in product(*axes)])

    def _compiled(self, mu: Array) -> Array:
        return _interpolate(mu, self.bounds[0], self.width, self._values, self._count)


@njit(cache=True, nogil=True)
def _interpolate(mu, lower, width, values, count):
    """Values and derivatives (1 + d, m) of the multilinear interpolation of a grid's values (count^d, m)."""
    d, m = len(mu), values.shape[1]
    cell, share = np.empty(d, np.int64), np.empty(d)
    for k in range(d):
        place = (mu[k] - lower[k]) / width[k] * (count - 1)
        cell[k] = min(max(int(np.floor(place)), 0), count - 2)
        share[k] = place - cell[k]
    result = np.zeros((1 + d, m))
    for corner in range(1 << d):
        index = 0
        for k in range(d):
            index = index * count + cell[k] + ((corner >> k) & 1)
        for row in range(1 + d):
            weight = 1.0
            for k in range(d):
                upper = (corner >> k) & 1
                if row == k + 1:
                    weight *= (1.0 if upper else -1.0) * (count - 1) / width[k]
                else:
                    weight *= share[k] if upper else 1.0 - share[k]
            for i in range(m):
                result[row, i] += weight * values[index, i]
    return result
