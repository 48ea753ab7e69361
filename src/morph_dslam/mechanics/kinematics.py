"""Kinematics of a solid whose undeformed shape may itself depend on parameters.

The mesh is posed at fixed points Xi. The undeformed solid has its points at X(Xi) = Xi + sum a_k d_k(Xi),
with amplitudes a_k (expressions of parameters) and given fields d_k; the deformed one at x = X + u. Energies
are integrated over the mesh, with

    G = dX/dXi,   F = 1 + du/dXi G^-1,   dV = det G dXi,   N dA = cof(G) n da.

Without shape parameters G = 1 is never formed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import ngsolve as ngs
import numpy as np
from numpy.typing import NDArray

from morph_dslam.errors import StudyError
from morph_dslam.mechanics.parameters import ParameterSymbols, Scalar
from morph_dslam.mechanics.spaces import DisplacementSpace

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class ShapeField:
    """One way in which the undeformed shape varies, by moving the mesh's nodes.

    Attributes
    ----------
    amplitude : a number or an expression of parameters; zero leaves the mesh as it is.
    field : (n_nodes, 3) how far each node moves for amplitude 1; m if the amplitude is a pure number.
    """

    amplitude: Scalar
    field: Array


class Shape:
    """The undeformed shape: amplitudes with fields in the displacement space.

    Raises StudyError if a field has not one row for each node.
    """

    def __init__(self, space: DisplacementSpace, fields: Sequence[ShapeField]) -> None:
        self.amplitudes = [field.amplitude for field in fields]
        n_nodes = space.geometry.mesh.n_nodes
        for number, field in enumerate(fields):
            if np.shape(field.field) != (n_nodes, 3):
                raise StudyError(
                    f"shape field {number} has shape {np.shape(field.field)}; "
                    f"the mesh needs {(n_nodes, 3)}: one displacement for each node"
                )
        self._space = space
        self.coefficients = [space.coefficients @ np.asarray(field.field) for field in fields]
        self.functions = []
        for coefficients in self.coefficients:
            function = ngs.GridFunction(space.vector)
            function.vec.FV().NumPy()[:] = coefficients.T.ravel()
            self.functions.append(function)

    @property
    def bonus_order(self) -> int:
        """What integrals over cells need beyond NGSolve's own order of quadrature."""
        return self._space.curved_bonus_order if self.functions else self._space.bonus_order

    def coordinates(self, symbols: ParameterSymbols) -> Array:
        """Coefficients (n_scalar, 3) of the undeformed position at the present parameters, m."""
        result = self._space.coordinates.copy()
        for amplitude, coefficients in zip(self.amplitudes, self.coefficients, strict=True):
            result += symbols.value(amplitude) * coefficients
        return result

    def coordinate_slopes(self, symbols: ParameterSymbols) -> Array:
        """Derivatives (d, n_scalar, 3) of `coordinates` by the parameters."""
        result = np.zeros((len(symbols), *self._space.coordinates.shape))
        for amplitude, coefficients in zip(self.amplitudes, self.coefficients, strict=True):
            result += symbols.slopes(amplitude)[:, None, None] * coefficients
        return result


class Kinematics:
    """Coefficient functions of a displacement, a trial function or a grid function.

    Attributes
    ----------
    displacement : u.
    position : undeformed position X.
    gradient : du/dXi.
    """

    def __init__(self, displacement: Any, shape: Shape) -> None:
        self.displacement = displacement
        self.gradient = ngs.Grad(displacement)
        self._shape = shape
        self.position: Any = ngs.CF((ngs.x, ngs.y, ngs.z))
        for amplitude, function in zip(shape.amplitudes, shape.functions, strict=True):
            self.position = self.position + amplitude * function

    def _shape_gradient(self, trace: bool) -> Any | None:
        result = None
        for amplitude, function in zip(self._shape.amplitudes, self._shape.functions, strict=True):
            gradient = ngs.Grad(function).Trace() if trace else ngs.Grad(function)
            result = amplitude * gradient if result is None else result + amplitude * gradient
        return result

    @property
    def displacement_gradient(self) -> Any:
        """du/dX (3x3) in the volume."""
        shape = self._shape_gradient(trace=False)
        return self.gradient if shape is None else self.gradient * ngs.Inv(ngs.Id(3) + shape)

    @property
    def deformation_gradient(self) -> Any:
        """F = dx/dX (3x3) in the volume."""
        return ngs.Id(3) + self.displacement_gradient

    @property
    def volume_ratio(self) -> Any:
        """det G."""
        shape = self._shape_gradient(trace=False)
        return ngs.CF(1.0) if shape is None else ngs.Det(ngs.Id(3) + shape)

    @property
    def _area_vector(self) -> Any:
        normal = ngs.specialcf.normal(3)
        shape = self._shape_gradient(trace=True)
        return normal if shape is None else ngs.Cof(ngs.Id(3) + shape) * normal

    @property
    def area_ratio(self) -> Any:
        """Undeformed area per area of the mesh, on surfaces."""
        return ngs.CF(1.0) if not self._shape.functions else ngs.Norm(self._area_vector)

    @property
    def unit_normal(self) -> Any:
        """Outward normal of the undeformed surface."""
        return self._area_vector if not self._shape.functions else self._area_vector / self.area_ratio

    @property
    def deformed_area_vector(self) -> Any:
        """Outward normal of the deformed surface times its area per area of the mesh: cof(dx/dXi) n.

        Tangential derivatives are all that it takes.
        """
        shape = self._shape_gradient(trace=True)
        tangential = ngs.Id(3) + self.gradient.Trace()
        if shape is not None:
            tangential = tangential + shape
        return ngs.Cof(tangential) * ngs.specialcf.normal(3)
