"""Random functions of three parameters in every format, and what bases and functions are by scipy and numpy."""

from __future__ import annotations

import numpy as np
from numpy.polynomial import chebyshev
from scipy.interpolate import BSpline

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


def basis_values(basis, x, order=0):
    """`Basis.evaluate`: the functions (n, size) or their derivative of ``order`` at ``x`` (n,)."""
    x = np.atleast_1d(np.asarray(x, dtype=float))
    if basis.kind == "fourier":
        harmonic = np.arange(1, (basis.size - 1) // 2 + 1) * 2.0 * np.pi / (basis.upper - basis.lower)
        phase = np.outer(x - basis.lower, harmonic) + order * np.pi / 2.0
        out = np.full((len(x), basis.size), 1.0 if order == 0 else 0.0)
        out[:, 1::2], out[:, 2::2] = harmonic**order * np.cos(phase), harmonic**order * np.sin(phase)
        return out
    at = np.clip(x, basis.lower, basis.upper)
    if order == 0:
        return _inside(basis, at, 0) + (x - at)[:, None] * _inside(basis, at, 1)
    return _inside(basis, at, order) * ((at == x)[:, None] if order == 2 else 1.0)


def _inside(basis, x, order):
    if basis.kind == "chebyshev":
        scale = 2.0 / (basis.upper - basis.lower)
        series = chebyshev.chebder(np.eye(basis.size), order) if order < basis.size else np.zeros((1, basis.size))
        return scale**order * chebyshev.chebval((x - basis.lower) * scale - 1.0, series).T
    if basis.kind == "spline":
        spline = BSpline(basis.knots, np.eye(basis.size), basis.degree)
        return spline(x, nu=order) if order <= basis.degree else np.zeros((len(x), basis.size))
    a = np.sqrt(5.0) / basis.knots[0]
    difference = x[:, None] - basis.knots[None, 1:]
    ar = a * np.abs(difference)
    factor = [1.0 + ar + ar**2 / 3.0, -(a**2) / 3.0 * difference * (1.0 + ar), -(a**2) / 3.0 * (1 + ar - ar**2)]
    return factor[order] * np.exp(-ar)


def function_values(functions, mu, orders=(0, 0, 0)):
    """The sums that define functions (n,) of a format, or their mixed derivatives of ``orders``, at ``mu``."""
    if isinstance(functions, ParameterFunctions):
        ends, degrees = zip(functions.lower, functions.upper, strict=True), functions.multi_indices.T
        bases = [chebyshev_basis(*end, int(degree.max())) for end, degree in zip(ends, degrees, strict=True)]
    else:
        bases = functions.bases
    vectors = [basis_values(basis, x, order)[0] for basis, x, order in zip(bases, mu, orders, strict=False)]
    if isinstance(functions, ParameterFunctions):
        return np.prod([v[degree] for v, degree in zip(vectors, degrees, strict=True)], axis=0) @ functions.coefficients
    if isinstance(functions, CPFunctions):
        full = np.einsum("at,bt,ct,ti->iabc", *functions.factors, functions.mixing)
    elif isinstance(functions, TuckerFunctions):
        full = np.einsum("ixyz,ax,by,cz->iabc", functions.core, *functions.factors)
    else:
        full = np.einsum("iax,xby,ycz->iabc", *functions.cores)
    return np.einsum("iabc,a,b,c->i", full, *vectors)
