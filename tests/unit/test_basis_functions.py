"""One-dimensional bases against scipy, closed forms and finite differences."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import quad

from morph_dslam.model.basis_functions import (
    Basis,
    chebyshev_basis,
    cubic_spline_basis,
    fourier_basis,
    hat_basis,
    hermite_basis,
    kriging_basis,
    p_spline_basis,
)
from tests.support.function_formats import basis_values

BASES = {
    "chebyshev": chebyshev_basis(-1.0, 3.0, 7),
    "constant": chebyshev_basis(-1.0, 3.0, 0),
    "cubic spline": cubic_spline_basis([-1.0, -0.5, 0.0, 0.7, 2.0, 2.2, 3.0]),
    "hermite": hermite_basis([-1.0, -0.4, 0.0, 2.0, 3.0]),
    "p-spline": p_spline_basis(-1.0, 3.0, 9),
    "hats": hat_basis([-1.0, 0.0, 0.5, 2.0, 3.0]),
    "fourier": fourier_basis(-1.0, 3.0, 3),
    "kriging": kriging_basis(-1.0, 3.0, np.linspace(-1.0, 3.0, 6), 1.3),
}
every_basis = pytest.mark.parametrize("basis", BASES.values(), ids=BASES.keys())


@every_basis
@pytest.mark.parametrize("order", [0, 1, 2])
def test_values_are_those_of_scipy_and_numpy_inside_and_outside(basis: Basis, order: int) -> None:
    x = np.linspace(-2.5, 4.5, 301)
    np.testing.assert_allclose(basis.evaluate(x, order), basis_values(basis, x, order), atol=1e-11)


@every_basis
def test_derivatives_follow_finite_differences(basis: Basis) -> None:
    """Between the breaks of the hats, and outside the range."""
    x, h = np.array([-1.7, -0.83, 0.31, 1.12, 2.61, 3.4]), 1e-5
    for order in (1, 2):
        slope = (basis.evaluate(x + h, order - 1) - basis.evaluate(x - h, order - 1)) / (2.0 * h)
        np.testing.assert_allclose(basis.evaluate(x, order), slope, atol=1e-7)


@every_basis
def test_outside_the_range_functions_go_on_as_tangents_or_periodically(basis: Basis) -> None:
    if basis.kind == "fourier":
        np.testing.assert_allclose(basis.evaluate([3.7]), basis.evaluate([-0.3]), atol=1e-12)
        assert basis.inside([-1.5, 0.0, 3.5]).tolist() == [True, True, True]
    else:
        value, slope = basis.evaluate([3.0]), basis.evaluate([3.0], 1)
        np.testing.assert_allclose(basis.evaluate([3.9]), value + 0.9 * slope, atol=1e-12)
        value, slope = basis.evaluate([-1.0]), basis.evaluate([-1.0], 1)
        np.testing.assert_allclose(basis.evaluate([-1.4]), value - 0.4 * slope, atol=1e-12)
        assert basis.inside([-1.5, -1.0, 0.0, 3.0, 3.5]).tolist() == [False, True, True, True, False]


@pytest.mark.parametrize("name", ["cubic spline", "p-spline"])
def test_splines_are_twice_continuously_differentiable(name: str) -> None:
    """The jump of the second derivative across a knot vanishes; that of the third does not."""
    basis, h = BASES[name], 1e-9
    for knot in np.unique(basis.knots[(basis.knots > -1.0) & (basis.knots < 3.0)]):
        assert basis.evaluate([knot + h], 2) == pytest.approx(basis.evaluate([knot - h], 2), abs=1e-5)


@pytest.mark.parametrize("name", ["cubic spline", "p-spline", "chebyshev"])
def test_cubics_are_reproduced_with_their_derivatives(name: str) -> None:
    basis = BASES[name]
    nodes = np.linspace(-1.0, 3.0, 12)
    a = basis.interpolate(nodes, nodes**3 - 2.0 * nodes)
    x = np.array([-0.9, 0.1, 1.7, 2.9])
    np.testing.assert_allclose(basis.evaluate(x) @ a, x**3 - 2.0 * x, atol=1e-11)
    np.testing.assert_allclose(basis.evaluate(x, 1) @ a, 3.0 * x**2 - 2.0, atol=1e-10)
    np.testing.assert_allclose(basis.evaluate(x, 2) @ a, 6.0 * x, atol=1e-9)


def test_interpolation_goes_through_the_nodes_and_keeps_trailing_axes() -> None:
    nodes = np.array([-1.0, -0.5, 0.0, 0.7, 2.0, 2.2, 3.0])
    values = np.random.default_rng(0).normal(size=(7, 2, 3))
    for basis in (cubic_spline_basis(nodes), hat_basis(nodes), kriging_basis(-1.0, 3.0, nodes, 1.0)):
        a = basis.interpolate(nodes, values)
        assert a.shape == (7, 2, 3)
        np.testing.assert_allclose(np.tensordot(basis.evaluate(nodes), a, axes=1), values, atol=1e-9)


def test_spline_interpolation_of_a_sine_is_of_fourth_order() -> None:
    errors = []
    x = np.linspace(0.0, np.pi, 500)
    for n in (9, 17, 33):
        nodes = np.linspace(0.0, np.pi, n)
        basis = cubic_spline_basis(nodes)
        errors.append(np.abs(basis.evaluate(x) @ basis.interpolate(nodes, np.sin(nodes)) - np.sin(x)).max())
    assert errors[0] / errors[1] > 12.0
    assert errors[1] / errors[2] > 12.0


@every_basis
@pytest.mark.parametrize("order", [0, 2])
def test_gram_matrices_are_the_integrals(basis: Basis, order: int) -> None:
    gram = basis.gram(order)
    breaks = np.unique(np.clip(basis.knots, -1.0, 3.0)) if basis.kind == "spline" else None
    for i, j in [(0, 0), (0, basis.size - 1), (basis.size // 2, basis.size // 2)]:

        def product(x: float, i: int = i, j: int = j) -> float:
            values = basis_values(basis, x, order)[0]
            return float(values[i] * values[j])

        expected = quad(product, -1.0, 3.0, points=breaks, limit=400, epsabs=1e-10)[0]
        assert gram[i, j] == pytest.approx(expected, rel=1e-6, abs=1e-7)


@pytest.mark.parametrize("name", ["chebyshev", "cubic spline", "p-spline", "hats", "fourier"])
def test_the_penalty_vanishes_for_straight_lines_and_measures_curvature(name: str) -> None:
    """int (x^2)'' ^2 = 4 times the length; the hats' differences leave out half a cell at each end."""
    basis = BASES[name]
    nodes = np.linspace(-1.0, 3.0, 41) if name != "hats" else basis.knots[1:-1]
    constant = basis.interpolate(nodes, np.ones(len(nodes)))
    assert constant @ basis.penalty() @ constant == pytest.approx(0.0, abs=1e-9)
    if name == "fourier":  # cos(pi x / 2) over its period 4: (pi/2)^4 * 2
        wave = basis.interpolate(nodes, np.cos(np.pi * (nodes + 1.0) / 2.0))
        assert wave @ basis.penalty() @ wave == pytest.approx((np.pi / 2.0) ** 4 * 2.0, rel=1e-9)
        return
    line = basis.interpolate(nodes, 3.0 * nodes - 1.0)
    assert line @ basis.penalty() @ line == pytest.approx(0.0, abs=1e-9)
    parabola = basis.interpolate(nodes, nodes**2)
    length = 4.0 if name != "hats" else (3.0 + 2.0 - 0.0 + 1.0) / 2.0
    assert parabola @ basis.penalty() @ parabola == pytest.approx(4.0 * length, rel=1e-9)


def test_the_kriging_penalty_is_the_kernel_between_its_centres() -> None:
    basis = BASES["kriging"]
    r = np.sqrt(5.0) * 0.8 / 1.3
    penalty = basis.penalty()
    assert penalty[0, 1] == pytest.approx((1.0 + r + r**2 / 3.0) * np.exp(-r), rel=1e-12)
    assert np.linalg.eigvalsh(penalty)[0] > 0.0


def test_mistaken_bases_are_refused() -> None:
    with pytest.raises(ValueError, match="must grow"):
        chebyshev_basis(1.0, 1.0, 3)
    with pytest.raises(ValueError, match="at least 4 growing nodes"):
        cubic_spline_basis([0.0, 1.0, 2.0])
    with pytest.raises(ValueError, match="growing"):
        hat_basis([0.0, 1.0, 1.0])
    with pytest.raises(ValueError, match="not 'wavelet'"):
        Basis("wavelet", 0.0, 1.0, 3)
