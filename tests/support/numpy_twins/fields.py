"""Functions of the parameters and separated fields, by scipy's B-splines and numpy's Chebyshev series."""

from __future__ import annotations

import numpy as np
from numpy.polynomial import chebyshev
from scipy.interpolate import BSpline

from morph_dslam.model.basis_functions import chebyshev_basis
from morph_dslam.model.functions import ParameterFunctions
from morph_dslam.model.tensor_functions import CPFunctions, ProductFunctions, TensorTrainFunctions, TuckerFunctions


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


def partial(functions, mu, orders):
    """The mixed derivative (n_functions,) of ``orders`` (0, 1 or 2 for each parameter) at ``mu`` (d,)."""
    mu = np.asarray(mu, dtype=float)
    if isinstance(functions, ProductFunctions):
        split = functions.first.dimension
        first = partial(functions.first, mu[:split], orders[:split])
        values = np.outer(first, partial(functions.second, mu[split:], orders[split:])).ravel()
        return values if functions.mixing is None else values @ functions.mixing
    if isinstance(functions, ParameterFunctions):
        terms = np.ones(len(functions.coefficients))
        ends = zip(functions.lower, functions.upper, strict=True)
        for x, (low, high), degrees, order in zip(mu, ends, functions.multi_indices.T, orders, strict=True):
            terms = terms * basis_values(chebyshev_basis(low, high, int(degrees.max())), x, order)[0, degrees]
        return terms @ functions.coefficients
    vectors = [basis_values(b, x, order)[0] for b, x, order in zip(functions.bases, mu, orders, strict=True)]
    if isinstance(functions, CPFunctions):
        return np.prod([v @ f for v, f in zip(vectors, functions.factors, strict=True)], axis=0) @ functions.mixing
    if isinstance(functions, TuckerFunctions):
        result = functions.core
        for v, factor in zip(vectors[::-1], functions.factors[::-1], strict=True):
            result = result @ (v @ factor)
        return result
    assert isinstance(functions, TensorTrainFunctions)
    result = np.ones(1)
    for v, core in zip(vectors[::-1], functions.cores[::-1], strict=True):
        result = np.einsum("j,ijq,q->i", v, core, result)
    return result


def evaluate(functions, mu):
    """`Functions.evaluate`: values (n_functions,) and gradient (d, n_functions)."""
    slopes = [partial(functions, mu, tuple(row)) for row in np.eye(functions.dimension, dtype=int)]
    return partial(functions, mu, (0,) * functions.dimension), np.stack(slopes)


def value_and_sensitivities(field, mu):
    """`SeparatedField.value_and_sensitivities` with the tangents outside the box."""
    values, gradient = evaluate(field.functions, mu)
    return np.tensordot(values, field.modes, axes=1), np.tensordot(gradient, field.modes, axes=1)
