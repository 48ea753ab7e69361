"""Products of functions of some parameters with functions of others."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from morph_dslam.model.functions import Functions

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ProductFunctions(Functions):
    """All products H_i(mu) K_j(nu), function i n_second + j, or linear combinations of them.

    Attributes
    ----------
    first, second : functions of the first parameters and of those that follow.
    mixing : (products, n_functions), or None where they stand as they are.
    """

    first: Functions
    second: Functions
    mixing: Array | None = None

    def __post_init__(self) -> None:
        if self.mixing is not None and len(self.mixing) != self._n_products:
            raise ValueError(f"{self._n_products} products are mixed by a matrix {self.mixing.shape}")

    @property
    def _n_products(self) -> int:
        return self.first.n_functions * self.second.n_functions

    @property
    def n_functions(self) -> int:
        return self._n_products if self.mixing is None else self.mixing.shape[1]

    @property
    def n_floats(self) -> int:
        mixing = 0 if self.mixing is None else self.mixing.size
        return self.first.n_floats + self.second.n_floats + mixing

    @property
    def bounds(self) -> tuple[Array, Array]:
        lower, upper = zip(self.first.bounds, self.second.bounds, strict=True)
        return np.concatenate(lower), np.concatenate(upper)

    def _compiled(self, mu: Array) -> Array:
        split = self.first.dimension
        first, second = self.first.rows(mu[:split]), self.second.rows(mu[split:])
        by_first = np.einsum("ki,j->kij", first, second[0])
        by_second = np.einsum("i,kj->kij", first[0], second[1:])
        rows = np.concatenate([by_first, by_second]).reshape(1 + len(mu), -1)
        return rows if self.mixing is None else rows @ self.mixing

    def partial(self, mu: ArrayLike, orders: tuple[int, ...]) -> Array:
        mu, split = np.asarray(mu, dtype=np.float64), self.first.dimension
        first = self.first.partial(mu[:split], orders[:split])
        values = np.outer(first, self.second.partial(mu[split:], orders[split:])).ravel()
        return values if self.mixing is None else values @ self.mixing

    def mixed(self, matrix: Array) -> Self:
        return replace(self, mixing=matrix if self.mixing is None else self.mixing @ matrix)
