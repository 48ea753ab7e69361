"""Levenberg-Marquardt in a box, on costs whose minimum is known in closed form."""

import numpy as np
import pytest
from scipy.optimize import lsq_linear

from morph_dslam.geometry import RigidTransform
from morph_dslam.tracking.levenberg_marquardt import Box, bounded_step, minimise
from morph_dslam.tracking.state import State

SCALE = np.ones(8)


def valley(steepness):
    """Rosenbrock's function of two parameters as a sum of squares, and the translation's square; its minimum is 0.

    The bottom of the valley is b = a², and the minimum lies at (1, 1).
    """

    def evaluate(state):
        a, b = state.parameters
        residuals = np.concatenate([[steepness * (b - a**2), 1.0 - a], state.camera_from_object.translation])
        jacobian = np.zeros((5, 8))
        jacobian[0, :2], jacobian[1, 0] = (-2.0 * steepness * a, steepness), -1.0
        jacobian[2:, 5:] = np.eye(3)
        hessian = jacobian.T @ jacobian + 1e-12 * np.eye(8)
        return 0.5 * float(residuals @ residuals), hessian, jacobian.T @ residuals, residuals

    return evaluate


def minimum_from(start, evaluate, half_width=2.0):
    box = Box(np.full(2, -half_width), np.full(2, half_width), SCALE)
    return minimise(evaluate, State(np.array(start), RigidTransform.identity()), box)


def test_bounded_step_is_the_least_square_between_bounds():
    """Against SciPy's bounded linear least squares: the quadratic model is |A x - b|² with A the Hessian's root."""
    rng = np.random.default_rng(14)
    n_at_bound = 0
    for n in (2, 6, 12) * 20:
        root = np.vstack([rng.standard_normal((n - 1, n)) * 10.0 ** rng.uniform(-2, 2, n), 0.1 * np.eye(n)])
        goal = rng.standard_normal(len(root)) * 10.0 ** rng.uniform(-1, 1)
        lower, upper = -rng.uniform(0.0, 0.8, n), rng.uniform(0.0, 0.8, n)
        lower[0], upper[1] = 0.0, 0.0
        step = bounded_step(root.T @ root, -root.T @ goal, lower, upper)
        least = lsq_linear(root, goal, (lower, upper), method="bvls", tol=1e-14).x
        assert ((step >= lower) & (step <= upper)).all()
        np.testing.assert_allclose(np.sum((root @ step - goal) ** 2), np.sum((root @ least - goal) ** 2), rtol=1e-9)
        n_at_bound += int(((step == lower) | (step == upper)).sum())
    assert n_at_bound > 100


@pytest.mark.parametrize("steepness", [10.0, 100.0])
@pytest.mark.parametrize("start", [(-1.2, 1.0), (-1.5, 2.0), (0.0, 0.0), (1.9, -1.5)])
def test_narrow_curved_valley_is_followed_to_its_end(steepness, start):
    found = minimum_from(start, valley(steepness))
    assert found.converged
    np.testing.assert_allclose(found.state.parameters, 1.0, atol=2e-3)


def test_minimum_outside_the_box_is_sought_along_its_bounds():
    # Within |a|, |b| <= 0.5 the valley's bottom b = a² is left free by a = 0.5: (1 - a)² falls until then.
    found = minimum_from((-0.4, 0.1), valley(100.0), half_width=0.5)
    assert found.converged
    np.testing.assert_allclose(found.state.parameters, (0.5, 0.25), atol=1e-6)
