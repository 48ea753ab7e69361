"""Functions of one parameter, by the names that study files give them."""

from __future__ import annotations

import numpy as np

from morph_dslam.errors import StudyError
from morph_dslam.model import Parameter
from morph_dslam.model.basis_functions import (
    Basis,
    chebyshev_basis,
    cubic_spline_basis,
    fourier_basis,
    hat_basis,
    kriging_basis,
    p_spline_basis,
)
from morph_dslam.offline.studies.study_sections import BasisName

#: Correlation length of kriging over the size of the range.
CORRELATION = 0.5


def is_periodic(parameter: Parameter) -> bool:
    """Whether the parameter is an angle that covers one full turn."""
    return parameter.quantity == "angle" and bool(
        np.isclose(parameter.upper - parameter.lower, 2.0 * np.pi, rtol=1e-9)
    )


def parameter_basis(name: BasisName, parameter: Parameter, size: int) -> Basis:
    """About ``size`` functions on a parameter's range.

    Splines have at least four functions; Fourier functions come in pairs beside the constant. Where "fourier"
    is asked for, parameters that are no full turn have Chebyshev polynomials.
    """
    lower, upper = parameter.lower, parameter.upper
    nodes = np.linspace(lower, upper, max(size, 2 if name == "hat" else 4))
    if name == "fourier" and is_periodic(parameter):
        return fourier_basis(lower, upper, max(size // 2, 1))
    if name == "cubic_spline":
        return cubic_spline_basis(nodes)
    if name == "p_spline":
        return p_spline_basis(lower, upper, len(nodes))
    if name == "kriging":
        return kriging_basis(lower, upper, nodes, CORRELATION * (upper - lower))
    if name == "hat":
        return hat_basis(nodes)
    return chebyshev_basis(lower, upper, max(size, 1) - 1)


def parameter_bases(
    name: BasisName, parameters: tuple[Parameter, ...], sizes: tuple[int, ...]
) -> tuple[Basis, ...]:
    """A basis for each parameter (`parameter_basis`).

    Raises
    ------
    StudyError
        If Fourier functions are asked for and no parameter is a full turn.
    """
    if name == "fourier" and not any(is_periodic(parameter) for parameter in parameters):
        raise StudyError(
            'reduction.basis = "fourier" is for angles whose range is a full turn (360 deg), and this '
            'study has none: use "chebyshev"'
        )
    return tuple(parameter_basis(name, p, size) for p, size in zip(parameters, sizes, strict=True))
