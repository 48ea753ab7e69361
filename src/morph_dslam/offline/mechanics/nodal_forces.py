"""Point loads as forces on the dofs of the displacements."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from morph_dslam.offline.mechanics.displacement_space import DisplacementSpace
from morph_dslam.offline.mechanics.loads import PointLoad
from morph_dslam.offline.mechanics.parameters import ParameterSymbols

Array = NDArray[np.float64]


class NodalForces:
    """The point loads of a solid.

    Raises
    ------
    StudyError
        If a load names an unknown set.
    """

    def __init__(
        self, space: DisplacementSpace, loads: Sequence[PointLoad], symbols: ParameterSymbols
    ) -> None:
        self._loads, self._symbols, self._n_scalar = loads, symbols, space.n_scalar
        mesh = space.geometry.mesh
        # Work that each load's unit force does on each scalar dof.
        self._shares = [
            np.asarray(space.node_values[mesh.set_nodes(load.on)].mean(axis=0)).ravel() for load in loads
        ]

    def values(self) -> Array:
        """(3 n_scalar,) forces at the present parameters, N."""
        forces = np.zeros((3, self._n_scalar))
        for load, share in zip(self._loads, self._shares, strict=True):
            forces += np.outer([self._symbols.value(f) for f in load.force], share)
        return forces.ravel()

    def slopes(self) -> Array:
        """(d, 3 n_scalar) derivatives of `values` by the parameters."""
        slopes = np.zeros((len(self._symbols), 3, self._n_scalar))
        for load, share in zip(self._loads, self._shares, strict=True):
            slopes += np.column_stack([self._symbols.slopes(f) for f in load.force])[:, :, None] * share
        return slopes.reshape(len(self._symbols), -1)
