"""Fields over a common spatial basis whose coefficients are CP, Tucker or tensor-train functions."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from morph_dslam.model.tensor_functions import TensorFunctions

Array = NDArray[np.float64]


@njit(cache=True, nogil=True)
def combine_modes(rows, modes):
    """``rows`` (r, m) times ``modes`` (m, n); four modes at a pass, which spares traffic to the result."""
    n_rows, m = rows.shape
    n = modes.shape[1]
    result = np.zeros((n_rows, n))
    whole = m - m % 4
    for i in range(0, whole, 4):
        for row in range(n_rows):
            a, b, c, d = rows[row, i], rows[row, i + 1], rows[row, i + 2], rows[row, i + 3]
            for p in range(n):
                result[row, p] += (
                    a * modes[i, p] + b * modes[i + 1, p] + c * modes[i + 2, p] + d * modes[i + 3, p]
                )
    for i in range(whole, m):
        for row in range(n_rows):
            a = rows[row, i]
            for p in range(n):
                result[row, p] += a * modes[i, p]
    return result


@dataclass(frozen=True)
class TensorField:
    """U(X, mu) = sum_i F_i(X) H_i(mu), the paper's separated representation.

    Attributes
    ----------
    modes : (n_modes, n_points, n_components), the functions F_i at the points, in the field's SI unit.
    functions : the n_modes functions H_i.
    """

    modes: Array
    functions: TensorFunctions

    @property
    def n_modes(self) -> int:
        return self.modes.shape[0]

    def value(self, mu: ArrayLike) -> Array:
        """The field (n_points, n_components) at parameters ``mu`` (d,)."""
        rows = self.functions.rows(mu)
        return combine_modes(rows[:1], self.modes.reshape(self.n_modes, -1)).reshape(self.modes.shape[1:])

    def value_and_sensitivities(self, mu: ArrayLike) -> tuple[Array, Array]:
        """The field (n_points, n_components) and its derivatives (d, n_points, n_components)."""
        rows = self.functions.rows(mu)
        result = combine_modes(rows, self.modes.reshape(self.n_modes, -1))
        result = result.reshape(len(rows), *self.modes.shape[1:])
        return result[0], result[1:]

    def value_and_sensitivities_numpy(self, mu: ArrayLike) -> tuple[Array, Array]:
        """The plain twin of `value_and_sensitivities`."""
        values, gradient = self.functions.evaluate_numpy(mu)
        return np.tensordot(values, self.modes, axes=1), np.tensordot(gradient, self.modes, axes=1)

    def restrict(self, corners: NDArray[np.integer], weights: Array) -> TensorField:
        """The same field at p points interpolated from mesh nodes.

        Parameters
        ----------
        corners : (p, c) node indices. weights : (p, c) interpolation weights.
        """
        modes = np.einsum("pc,mpcx->mpx", weights, self.modes[:, corners])
        return replace(self, modes=np.ascontiguousarray(modes))
