"""Compiled evaluation of CP, Tucker and tensor-train functions against plain sums and finite differences."""

from __future__ import annotations

import numpy as np
import pytest

from morph_dslam.model.basis_functions import (
    chebyshev_basis,
    cubic_spline_basis,
    evaluate_numpy,
    fourier_basis,
    kriging_basis,
    p_spline_basis,
)
from morph_dslam.model.separated import SeparatedField
from morph_dslam.model.tensor_functions import CPFunctions, TensorFunctions, TensorTrainFunctions, TuckerFunctions

N_FUNCTIONS = 7
BASES = {
    1: (cubic_spline_basis(np.linspace(-1.0, 1.0, 6)),),
    3: (cubic_spline_basis(np.linspace(-1.0, 1.0, 6)), chebyshev_basis(0.0, 1.0, 4), p_spline_basis(0.0, 2.0, 7)),
    4: (
        chebyshev_basis(0.0, 1.0, 3),
        fourier_basis(-np.pi, np.pi, 2),
        kriging_basis(0.0, 1.0, np.linspace(0.0, 1.0, 4), 0.7),
        p_spline_basis(-1.0, 1.0, 6),
    ),
}
POINTS = {1: [[0.3]], 3: [[0.1, 0.2, 0.3], [1.3, -0.2, 0.5]], 4: [[0.2, 1.1, 0.7, -0.6], [1.2, 4.0, -0.1, 1.5]]}


def make(form: str, d: int) -> TensorFunctions:
    rng = np.random.default_rng(d)
    bases = BASES[d]
    if form == "cp":
        return CPFunctions(bases, tuple(rng.normal(size=(b.size, 5)) for b in bases), rng.normal(size=(5, N_FUNCTIONS)))
    if form == "tucker":
        ranks = [2, 3, 2, 4][:d]
        factors = tuple(rng.normal(size=(b.size, r)) for b, r in zip(bases, ranks, strict=True))
        return TuckerFunctions(bases, factors, rng.normal(size=(N_FUNCTIONS, *ranks)))
    ranks = [*[N_FUNCTIONS, 3, 4, 2][:d], 1]
    return TensorTrainFunctions(
        bases, tuple(rng.normal(size=(ranks[k], b.size, ranks[k + 1])) for k, b in enumerate(bases))
    )


every_form = pytest.mark.parametrize("form", ["cp", "tucker", "tensor train"])
every_d = pytest.mark.parametrize("d", [1, 3, 4])


@every_form
@every_d
def test_compiled_and_plain_evaluation_agree(form: str, d: int) -> None:
    functions = make(form, d)
    for mu in POINTS[d]:
        for compiled, plain in zip(functions.evaluate(mu), functions.evaluate_numpy(mu), strict=True):
            np.testing.assert_allclose(compiled, plain, rtol=1e-10, atol=1e-10)


@every_form
def test_values_are_the_sums_that_define_the_format(form: str) -> None:
    """Element by element over the full coefficient tensor, for three parameters."""
    functions = make(form, 3)
    if isinstance(functions, CPFunctions):
        full = np.einsum("at,bt,ct,ti->iabc", *functions.factors, functions.mixing)
    elif isinstance(functions, TuckerFunctions):
        full = np.einsum("ixyz,ax,by,cz->iabc", functions.core, *functions.factors)
    else:
        assert isinstance(functions, TensorTrainFunctions)
        full = np.einsum("iax,xby,ycz->iabc", *functions.cores)
    mu = POINTS[3][0]
    vectors = [evaluate_numpy(b, m)[0] for b, m in zip(functions.bases, mu, strict=True)]
    np.testing.assert_allclose(functions.evaluate(mu)[0], np.einsum("iabc,a,b,c->i", full, *vectors), rtol=1e-10)
    assert functions.n_functions == N_FUNCTIONS
    assert functions.n_floats < full.size or form == "cp"


@every_form
@every_d
def test_gradients_follow_finite_differences(form: str, d: int) -> None:
    functions, h = make(form, d), 1e-6
    for mu in POINTS[d]:
        _, gradient = functions.evaluate(mu)
        for k, step in enumerate(h * np.eye(d)):
            slope = (functions.evaluate(mu + step)[0] - functions.evaluate(mu - step)[0]) / (2.0 * h)
            np.testing.assert_allclose(gradient[k], slope, rtol=1e-6, atol=1e-6)


@every_form
def test_mixed_second_derivatives_follow_finite_differences(form: str) -> None:
    functions, h = make(form, 3), 1e-5
    mu = np.array(POINTS[3][0])
    step = np.array([0.0, h, 0.0])
    up, down = functions.evaluate(mu + step)[1], functions.evaluate(mu - step)[1]
    for k, orders in enumerate([(1, 1, 0), (0, 2, 0), (0, 1, 1)]):
        np.testing.assert_allclose(functions.partial(mu, orders), (up[k] - down[k]) / (2.0 * h), rtol=1e-6, atol=1e-5)


@every_form
def test_a_wrong_number_of_parameters_is_refused(form: str) -> None:
    with pytest.raises(ValueError, match="3 parameters are needed"):
        make(form, 3).evaluate([0.1, 0.2])


def test_arrays_that_do_not_fit_are_refused() -> None:
    bases, rng = BASES[3], np.random.default_rng(0)
    factors = tuple(rng.normal(size=(b.size, 2)) for b in bases)
    with pytest.raises(ValueError, match="functions, the coefficients"):
        CPFunctions(bases, factors[::-1], np.eye(2))
    with pytest.raises(ValueError, match="terms, the mixing 3"):
        CPFunctions(bases, factors, np.eye(3))
    with pytest.raises(ValueError, match="ranks"):
        TuckerFunctions(bases, factors, rng.normal(size=(4, 2, 2, 3)))
    with pytest.raises(ValueError, match="do not follow each other"):
        TensorTrainFunctions(bases, tuple(rng.normal(size=(2, b.size, 2)) for b in bases))


@every_form
def test_mixed_functions_are_the_linear_combinations_of_the_old(form: str) -> None:
    functions, mixing = make(form, 3), np.random.default_rng(3).normal(size=(N_FUNCTIONS, 4))
    mu = POINTS[3][0]
    for new, old in zip(functions.mixed(mixing).evaluate(mu), functions.evaluate(mu), strict=True):
        np.testing.assert_allclose(new, old @ mixing, rtol=1e-10, atol=1e-12)


def test_leaving_the_box_is_flagged_for_each_parameter() -> None:
    functions = make("cp", 4)
    assert functions.inside([0.5, 9.0, 0.5, 0.0]).tolist() == [True, True, True, True]  # an angle has no end
    assert functions.inside([1.5, 9.0, -0.5, 0.0]).tolist() == [False, True, False, True]


@every_form
def test_fields_combine_the_modes_and_restrict_to_points(form: str) -> None:
    rng = np.random.default_rng(9)
    field = SeparatedField(rng.normal(size=(N_FUNCTIONS, 11, 3)), make(form, 3))
    mu = np.array(POINTS[3][0])
    value, sensitivities = field.value_and_sensitivities(mu)
    plain, plain_sensitivities = field.value_and_sensitivities_numpy(mu)
    np.testing.assert_allclose(value, plain, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(sensitivities, plain_sensitivities, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(field.value(mu), plain, rtol=1e-9, atol=1e-9)
    corners, weights = np.array([[0, 3, 5], [10, 2, 2]]), np.array([[0.2, 0.3, 0.5], [1.0, 0.0, 0.0]])
    points = field.restrict(corners, weights).value(mu)
    expected = [0.2 * plain[0] + 0.3 * plain[3] + 0.5 * plain[5], plain[10]]
    np.testing.assert_allclose(points, expected, rtol=1e-9, atol=1e-9)
