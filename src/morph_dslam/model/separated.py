"""Separated fields: modes in space times functions of the parameters."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from morph_dslam.model.functions import ParameterFunctions

Array = NDArray[np.float64]


@dataclass(frozen=True)
class SeparatedField:
    """U(X, mu) = sum_i F_i(X) H_i(mu), the paper's separated representation.

    Attributes
    ----------
    modes : (n_modes, n_points, n_components), the functions F_i at the points, in the field's SI unit.
    functions : the n_modes functions H_i.
    """

    modes: Array
    functions: ParameterFunctions

    @property
    def n_modes(self) -> int:
        return self.modes.shape[0]

    def value(self, mu: Array) -> Array:
        """The field (n_points, n_components) at parameters ``mu`` (d,)."""
        values, _ = self.functions.evaluate(mu)
        return np.tensordot(values, self.modes, axes=1)

    def value_and_sensitivities(self, mu: Array) -> tuple[Array, Array]:
        """The field (n_points, n_components) and its derivatives (d, n_points, n_components)."""
        values, gradient = self.functions.evaluate(mu)
        return np.tensordot(values, self.modes, axes=1), np.tensordot(gradient, self.modes, axes=1)

    def restrict(self, corners: NDArray[np.integer], weights: Array) -> SeparatedField:
        """The same field at p points interpolated from mesh nodes.

        Parameters
        ----------
        corners : (p, 3) node indices. weights : (p, 3) interpolation weights.
        """
        modes = np.einsum("pc,mpcx->mpx", weights, self.modes[:, corners])
        return replace(self, modes=np.ascontiguousarray(modes))
