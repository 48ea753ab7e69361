"""Newton's method, load stepping and sensitivities on structures of one or two dofs with known solutions."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import brentq

from morph_dslam.errors import SolverError
from morph_dslam.mechanics.solvers.newton import PathError, State, advance, sensitivities, solve
from tests.support.small_systems import SmallSystem, spring_column, von_mises_truss

HEIGHT = 0.3
CUBE = (1.0 + HEIGHT**2) ** 1.5
LIMIT_LOAD = 2.0 * HEIGHT**3 / (3.0 * np.sqrt(3.0) * CUBE)
LIMIT_DEPTH = HEIGHT * (1.0 - 1.0 / np.sqrt(3.0))


def truss_force(depth: float) -> float:
    return depth * (2.0 * HEIGHT - depth) * (HEIGHT - depth) / CUBE


def at_rest(n: int = 1, d: int = 1) -> State:
    return State(np.zeros(d), np.zeros(n))


def test_truss_below_its_limit_point() -> None:
    state = advance(von_mises_truss(HEIGHT), at_rest(), np.array([0.9 * LIMIT_LOAD])).states[-1]
    depth = brentq(lambda w: truss_force(w) - 0.9 * LIMIT_LOAD, 0.0, LIMIT_DEPTH, xtol=1e-14)
    assert state.dofs[0] == pytest.approx(depth, rel=1e-9)
    assert state.negative_pivots == 0


def test_a_load_past_the_limit_point_names_the_last_that_converged_and_keeps_it() -> None:
    with pytest.raises(PathError, match=r"last parameters that converged are .*needs arc length") as caught:
        advance(von_mises_truss(HEIGHT), at_rest(), np.array([1.2 * LIMIT_LOAD]))
    states = caught.value.path.states
    assert str(states[-1].mu) in str(caught.value)
    assert 0.95 * LIMIT_LOAD < states[-1].mu[0] < LIMIT_LOAD
    for state in states:
        assert truss_force(state.dofs[0]) == pytest.approx(state.mu[0], abs=1e-9)


def test_imposed_motion_passes_where_a_load_cannot() -> None:
    """Through a spring of stiffness 1, stiffer than the truss is unstable, to beyond the truss' limit."""
    path = advance(von_mises_truss(HEIGHT, moved=True), at_rest(2), np.array([0.5]))
    state = path.states[-1]
    depth = brentq(lambda w: truss_force(w) + w - 0.5, 0.0, 1.0, xtol=1e-14)
    assert depth > LIMIT_DEPTH
    assert state.dofs == pytest.approx([depth, 0.5], rel=1e-9)


def test_sensitivities_against_closed_forms() -> None:
    load = np.array([0.8 * LIMIT_LOAD])
    truss = von_mises_truss(HEIGHT)
    state = advance(truss, at_rest(), load).states[-1]
    w = state.dofs[0]
    slope = (2.0 * HEIGHT**2 - 6.0 * HEIGHT * w + 3.0 * w**2) / CUBE
    assert sensitivities(truss, state)[0, 0] == pytest.approx(1.0 / slope, rel=1e-8)

    moved = von_mises_truss(HEIGHT, moved=True)
    state = advance(moved, at_rest(2), np.array([0.2])).states[-1]
    w = state.dofs[0]
    slope = (2.0 * HEIGHT**2 - 6.0 * HEIGHT * w + 3.0 * w**2) / CUBE
    assert sensitivities(moved, state)[0] == pytest.approx([1.0 / (1.0 + slope), 1.0], rel=1e-8)


def test_a_bifurcation_passed_unseen_is_reported() -> None:
    path = advance(spring_column(), State(np.array([0.5]), np.zeros(1), 0), np.array([1.5]))
    assert path.states[-1].dofs[0] == 0.0
    (missed,) = path.missed_bifurcations
    assert missed.pivots == (0, 1)
    assert missed.before[0] < 1.0 < missed.after[0]
    assert "buckling mode" in str(missed)
    leaning = solve(spring_column(0.5), np.array([0.5]), at_rest())
    assert not advance(spring_column(0.5), leaning, np.array([1.2])).missed_bifurcations


def broken_spring() -> SmallSystem:
    """Stiffness 1 up to x = 1, where it breaks: nothing beyond is a number."""

    def residual(x: np.ndarray, mu: np.ndarray) -> np.ndarray:
        return np.array([x[0] - mu[0] if x[0] <= 1.0 else np.nan])

    return SmallSystem(1, residual, lambda *_: np.array([[0.5]]), lambda *_: np.array([[-1.0]]))


def test_values_that_are_not_numbers_are_avoided_or_refused() -> None:
    # The tangent is half as stiff as it should be: full steps overshoot to where nothing is a number.
    state = solve(broken_spring(), np.array([0.9]), at_rest())
    assert state.dofs[0] == pytest.approx(0.9, abs=1e-7)
    with pytest.raises(PathError, match=r"converged are \[(1\.|0\.9\d+)\]"):
        advance(broken_spring(), at_rest(), np.array([2.0]))


def test_divergence_is_noticed_early() -> None:
    runaway = SmallSystem(
        1,
        lambda x, mu: np.array([np.arctan(x[0]) - mu[0]]),
        lambda x, _: np.array([[1.0 / (1.0 + x[0] ** 2)]]),
        lambda *_: np.array([[-1.0]]),
    )
    with pytest.raises(SolverError, match="diverges"):
        solve(runaway, np.array([0.0]), State(np.zeros(1), np.array([20.0])))
    # From 1.5 undamped steps run away too (the classical example); damped ones come back.
    assert solve(runaway, np.array([0.0]), State(np.zeros(1), np.array([1.5]))).dofs[0] == pytest.approx(0.0, abs=1e-8)


class Ratchet(SmallSystem):
    """A spring whose rest length follows its extension: the answer counts the steps taken."""

    def __init__(self) -> None:
        self.rest = 0.0
        super().__init__(
            1,
            lambda x, mu: np.array([x[0] - self.rest - mu[0]]),
            lambda *_: np.array([[1.0]]),
            lambda *_: np.array([[-1.0]]),
        )

    def advance_history(self, x: np.ndarray, _: np.ndarray) -> None:
        self.rest = float(x[0])


def test_history_advances_once_a_solution() -> None:
    ratchet = Ratchet()
    first = advance(ratchet, at_rest(), np.array([1.0])).states[-1]
    second = advance(ratchet, first, np.array([2.0])).states[-1]
    assert (first.dofs[0], second.dofs[0]) == pytest.approx((1.0, 3.0))
