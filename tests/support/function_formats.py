"""Random functions of three parameters in every format, with every one-dimensional basis among them."""

from __future__ import annotations

import numpy as np

from morph_dslam.model.basis_functions import (
    Basis,
    chebyshev_basis,
    cubic_spline_basis,
    fourier_basis,
    hat_basis,
    kriging_basis,
    p_spline_basis,
)
from morph_dslam.model.functions import Functions, ParameterFunctions, total_degree_indices
from morph_dslam.model.tensor_functions import CPFunctions, TensorTrainFunctions, TuckerFunctions

FORMATS = ("polynomial", "cp", "tucker", "tensor_train")
LOWER, UPPER = np.array([-1.0, 0.0, 0.0]), np.array([1.0, 1.0, 2.0])
#: C1 bases on the box; the last row has those that are not C1 or have no outside.
SMOOTH = (cubic_spline_basis(np.linspace(-1.0, 1.0, 6)), chebyshev_basis(0.0, 1.0, 4), p_spline_basis(0.0, 2.0, 7))
OTHERS = (
    hat_basis(np.linspace(-1.0, 1.0, 5)),
    fourier_basis(0.0, 1.0, 2),
    kriging_basis(0.0, 2.0, np.linspace(0.0, 2.0, 4), 0.7),
)


def make_functions(form: str, n_functions: int = 7, bases: tuple[Basis, ...] = SMOOTH, seed: int = 0) -> Functions:
    """Functions of a format with random coefficients of size one; polynomials have their own basis."""
    rng = np.random.default_rng(seed)
    ranks = (2, 3, 2)
    if form == "polynomial":
        indices = total_degree_indices(3, 4)
        return ParameterFunctions(LOWER, UPPER, indices, rng.normal(size=(len(indices), n_functions)))
    if form == "cp":
        factors = tuple(rng.normal(size=(b.size, 5)) for b in bases)
        return CPFunctions(bases, factors, rng.normal(size=(5, n_functions)))
    if form == "tucker":
        factors = tuple(rng.normal(size=(b.size, r)) for b, r in zip(bases, ranks, strict=True))
        return TuckerFunctions(bases, factors, rng.normal(size=(n_functions, *ranks)))
    left, right = (n_functions, *ranks[1:]), (*ranks[1:], 1)
    cores = (rng.normal(size=(a, b.size, c)) for a, b, c in zip(left, bases, right, strict=True))
    return TensorTrainFunctions(bases, tuple(cores))
