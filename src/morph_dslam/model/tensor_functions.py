"""Functions of several parameters in separated form: CP, Tucker and tensor-train coefficients.

Each class holds ``n_functions`` functions H_i(mu), one per spatial mode, built from one-dimensional bases:

- `CPFunctions`: H_i = sum_t C[t, i] prod_k (phi_k(mu_k) . A_k[:, t]), the paper's sum of products;
- `TuckerFunctions`: H_i = sum_abc core[i, a, b, c] u_a(mu_1) v_b(mu_2) w_c(mu_3);
- `TensorTrainFunctions`: H_i = [G_1(mu_1) G_2(mu_2) ... G_d(mu_d)]_i, a product of small matrices.

Values and all first derivatives come from one compiled pass. `partial` gives any mixed derivative (up to the
second in each parameter) by plain numpy, and is the twin that the compiled pass is tested against.
"""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from morph_dslam.model.basis_functions import Basis, evaluate_numpy
from morph_dslam.model.functions import Functions
from morph_dslam.model.tensor_kernels import (
    PackedBases,
    evaluate_cp,
    evaluate_tensor_train,
    evaluate_tucker,
    pack_bases,
)

Array = NDArray[np.float64]


@dataclass(frozen=True)
class TensorFunctions(Functions):
    """``n_functions`` functions of ``d`` parameters; the common part of the three formats."""

    bases: tuple[Basis, ...]

    @abstractmethod
    def _contract(self, vectors: list[Array]) -> Array:
        """The functions (n_functions,) from the basis values of each parameter [(size_k,)]."""

    @cached_property
    def _packed(self) -> PackedBases:
        return pack_bases(self.bases)

    @cached_property
    def bounds(self) -> tuple[Array, Array]:
        lower, upper = np.array([b.bounds for b in self.bases]).T
        return np.ascontiguousarray(lower), np.ascontiguousarray(upper)

    def _check_sizes(self, arrays: tuple[Array, ...], axis: int) -> None:
        sizes, found = [b.size for b in self.bases], [a.shape[axis] for a in arrays]
        if sizes != found:
            raise ValueError(f"the bases have {sizes} functions, the coefficients {found}")

    def partial(self, mu: ArrayLike, orders: tuple[int, ...]) -> Array:
        mu = np.asarray(mu, dtype=float)
        return self._contract([evaluate_numpy(b, mu[k], orders[k])[0] for k, b in enumerate(self.bases)])


@dataclass(frozen=True)
class CPFunctions(TensorFunctions):
    """Sums of products of one-dimensional functions (canonical polyadic form).

    Attributes
    ----------
    factors : one (size_k, n_terms) per parameter, coefficients in its basis.
    mixing : (n_terms, n_functions); the unit matrix, which files leave out, where each term is one mode.
    """

    factors: tuple[Array, ...]
    mixing: Array

    @property
    def n_functions(self) -> int:
        return self.mixing.shape[1]

    @property
    def n_floats(self) -> int:
        return sum(f.size for f in self.factors) + (0 if self.is_unmixed else self.mixing.size)

    @cached_property
    def is_unmixed(self) -> bool:
        """Whether each term is one function, so that ``mixing`` need not be kept."""
        return np.array_equal(self.mixing, np.eye(*self.mixing.shape))

    @cached_property
    def _stacked(self) -> Array:
        return np.ascontiguousarray(np.concatenate(self.factors))

    def __post_init__(self) -> None:
        self._check_sizes(self.factors, axis=0)
        terms = {f.shape[1] for f in self.factors}
        if terms != {len(self.mixing)}:
            raise ValueError(f"the factors have {terms} terms, the mixing {len(self.mixing)}")

    def _compiled(self, mu: Array) -> Array:
        return evaluate_cp(self._packed, mu, self._stacked, self.mixing)

    def _contract(self, vectors: list[Array]) -> Array:
        terms = np.prod([v @ f for v, f in zip(vectors, self.factors, strict=True)], axis=0)
        return terms @ self.mixing

    def mixed(self, matrix: Array) -> Self:
        mixing = self.mixing @ matrix
        if len(self.factors) == 1:  # a sum of functions of one parameter is such a function
            factor = np.ascontiguousarray(self.factors[0] @ mixing)
            return replace(self, factors=(factor,), mixing=np.eye(mixing.shape[1]))
        return replace(self, mixing=mixing)


@dataclass(frozen=True)
class TuckerFunctions(TensorFunctions):
    """A small core tensor over a few functions of each parameter.

    Attributes
    ----------
    factors : one (size_k, rank_k) per parameter, coefficients in its basis.
    core : (n_functions, rank_1, ..., rank_d).
    """

    factors: tuple[Array, ...]
    core: Array

    @property
    def n_functions(self) -> int:
        return self.core.shape[0]

    @property
    def n_floats(self) -> int:
        return sum(f.size for f in self.factors) + self.core.size

    @cached_property
    def _flat(self) -> tuple[NDArray[np.int64], Array, Array]:
        ranks = np.array(self.core.shape[1:])
        return ranks, np.concatenate([f.ravel() for f in self.factors]), self.core.ravel()

    def __post_init__(self) -> None:
        self._check_sizes(self.factors, axis=0)
        ranks = tuple(f.shape[1] for f in self.factors)
        if self.core.shape[1:] != ranks:
            raise ValueError(f"the factors have ranks {ranks}, the core {self.core.shape[1:]}")

    def _compiled(self, mu: Array) -> Array:
        return evaluate_tucker(self._packed, mu, *self._flat, self.n_functions)

    def _contract(self, vectors: list[Array]) -> Array:
        result = self.core
        for v, factor in zip(vectors[::-1], self.factors[::-1], strict=True):
            result = result @ (v @ factor)
        return result

    def mixed(self, matrix: Array) -> Self:
        return replace(self, core=np.ascontiguousarray(np.tensordot(matrix.T, self.core, axes=1)))


@dataclass(frozen=True)
class TensorTrainFunctions(TensorFunctions):
    """A product of small matrices, one for each parameter.

    Attributes
    ----------
    cores : one (rank_k, size_k, rank_k+1) per parameter; the first rank is n_functions, the last is 1.
    """

    cores: tuple[Array, ...]

    @property
    def n_functions(self) -> int:
        return self.cores[0].shape[0]

    @property
    def n_floats(self) -> int:
        return sum(c.size for c in self.cores)

    @cached_property
    def _flat(self) -> tuple[NDArray[np.int64], Array]:
        ranks = np.array([c.shape[0] for c in self.cores] + [1])
        return ranks, np.concatenate([c.ravel() for c in self.cores])

    def __post_init__(self) -> None:
        self._check_sizes(self.cores, axis=1)
        left, right = [c.shape[0] for c in self.cores], [c.shape[2] for c in self.cores]
        if right != [*left[1:], 1]:
            raise ValueError(f"the cores' ranks {left} and {right} do not follow each other")

    def _compiled(self, mu: Array) -> Array:
        return evaluate_tensor_train(self._packed, mu, *self._flat)

    def _contract(self, vectors: list[Array]) -> Array:
        result = np.ones(1)
        for v, core in zip(vectors[::-1], self.cores[::-1], strict=True):
            result = np.einsum("j,ijq,q->i", v, core, result)
        return result

    def mixed(self, matrix: Array) -> Self:
        first = np.ascontiguousarray(np.tensordot(matrix.T, self.cores[0], axes=1))
        return replace(self, cores=(first, *self.cores[1:]))
