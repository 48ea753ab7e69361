"""The chord method on a scalar equation whose convergence is known."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from morph_dslam.mechanics.solvers.newton import solve_with_kept_tangent


@dataclass
class Slope:
    """A tangent of one unknown."""

    value: float
    residual: np.ndarray
    negative_pivots = 0

    def solve(self, right):
        return right / self.value

    def apply(self, vectors):
        return vectors * self.value


class Cubic:
    """x^3 + x = mu."""

    n_dofs, free, scale = 1, np.array([True]), 1.0

    def __init__(self):
        self.residuals = self.tangents = 0

    def prescribed(self, mu):
        return np.zeros(1)

    def prescribed_slopes(self, mu):
        return np.zeros((1, 1))

    def residual(self, x, mu):
        self.residuals += 1
        return x**3 + x - mu

    def residual_slopes(self, x, mu):
        return -np.ones((1, 1))

    def linearise(self, x, mu):
        self.tangents += 1
        return Slope(float(3.0 * x[0] ** 2 + 1.0), self.residual(x, mu))


def test_a_near_tangent_leads_to_the_root():
    """From x = 1 with its slope 4 to the root of x^3 + x = 2.2, by numpy's polynomial roots."""
    equations = Cubic()
    state = solve_with_kept_tangent(equations, np.array([2.2]), np.array([1.05]), Slope(4.0, np.zeros(1)))
    assert state is not None
    (root,) = [r.real for r in np.roots([1.0, 0.0, 1.0, -2.2]) if abs(r.imag) < 1e-12]
    assert state.dofs[0] == pytest.approx(root, abs=1e-9)
    assert equations.residuals == state.iterations <= 10


@pytest.mark.parametrize("slope", [2.5, 8.0])
def test_a_tangent_that_is_too_far_off_is_made_anew(slope):
    equations = Cubic()
    state = solve_with_kept_tangent(equations, np.array([2.2]), np.array([0.9]), Slope(slope, np.zeros(1)))
    assert state is not None
    assert state.dofs[0] ** 3 + state.dofs[0] == pytest.approx(2.2, abs=1e-8)
    assert equations.tangents >= 1


def test_an_iteration_that_leads_away_is_given_up():
    """With the sign of the tangent wrong, then values that are not numbers."""
    equations = Cubic()
    equations.residual = lambda x, mu: np.full(1, np.nan) if abs(x[0]) > 3.0 else x**3 + x - mu
    assert solve_with_kept_tangent(equations, np.array([2.2]), np.array([0.5]), Slope(-0.5, np.zeros(1))) is None
