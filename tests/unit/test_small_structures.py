"""Newton's method, load stepping, arc length and buckling of structures of one or two dofs with known solutions."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import brentq

from morph_dslam.errors import SolverError
from morph_dslam.mechanics.solvers.arc_length import ArcLength, ArcOptions, missed_bifurcations
from morph_dslam.mechanics.solvers.buckling import buckling_modes
from morph_dslam.mechanics.solvers.continuation import PathError, advance
from morph_dslam.mechanics.solvers.newton import Linearisation, State, sensitivities, solve, solve_with_kept_tangent
from tests.support.small_systems import SmallSystem, link_chain, spring_column, von_mises_truss

HEIGHT = 0.3
CUBE = (1.0 + HEIGHT**2) ** 1.5
LIMIT_LOAD = 2.0 * HEIGHT**3 / (3.0 * np.sqrt(3.0) * CUBE)
LIMIT_DEPTH = HEIGHT * (1.0 - 1.0 / np.sqrt(3.0))


def truss_force(depth: float) -> float:
    return depth * (2.0 * HEIGHT - depth) * (HEIGHT - depth) / CUBE


def at_rest(n: int = 1, d: int = 1) -> State:
    return State(np.zeros(d), np.zeros(n))


def test_truss_below_its_limit_point() -> None:
    state = advance(von_mises_truss(HEIGHT), at_rest(), np.array([0.9 * LIMIT_LOAD]))[-1]
    depth = brentq(lambda w: truss_force(w) - 0.9 * LIMIT_LOAD, 0.0, LIMIT_DEPTH, xtol=1e-14)
    assert state.dofs[0] == pytest.approx(depth, rel=1e-9)
    assert state.negative_pivots == 0


def test_a_load_past_the_limit_point_names_the_last_that_converged_and_keeps_it() -> None:
    with pytest.raises(PathError, match=r"last parameters that converged are .*needs arc length") as caught:
        advance(von_mises_truss(HEIGHT), at_rest(), np.array([1.2 * LIMIT_LOAD]))
    states = caught.value.states
    assert str(states[-1].mu) in str(caught.value)
    assert 0.95 * LIMIT_LOAD < states[-1].mu[0] < LIMIT_LOAD
    for state in states:
        assert truss_force(state.dofs[0]) == pytest.approx(state.mu[0], abs=1e-9)


def test_a_path_whose_end_has_the_wrong_sign_is_refused() -> None:
    with pytest.raises(SolverError, match="`end` is positive at the path's start"):
        list(ArcLength(von_mises_truss(HEIGHT)).follow(at_rest(), lambda state: 0.01 - state.mu[0]))


def test_a_path_whose_end_is_a_condition_is_refused() -> None:
    """False is no place on the path: it would end where it starts."""
    with pytest.raises(SolverError, match="`end` returns False: it has to return a number"):
        list(ArcLength(von_mises_truss(HEIGHT)).follow(at_rest(), lambda state: state.mu[0] > 0.01))


def test_imposed_motion_passes_where_a_load_cannot() -> None:
    """Through a spring of stiffness 1, stiffer than the truss is unstable, to beyond the truss' limit."""
    state = advance(von_mises_truss(HEIGHT, moved=True), at_rest(2), np.array([0.5]))[-1]
    depth = brentq(lambda w: truss_force(w) + w - 0.5, 0.0, 1.0, xtol=1e-14)
    assert depth > LIMIT_DEPTH
    assert state.dofs == pytest.approx([depth, 0.5], rel=1e-9)


def test_sensitivities_against_closed_forms() -> None:
    load = np.array([0.8 * LIMIT_LOAD])
    truss = von_mises_truss(HEIGHT)
    state = advance(truss, at_rest(), load)[-1]
    w = state.dofs[0]
    slope = (2.0 * HEIGHT**2 - 6.0 * HEIGHT * w + 3.0 * w**2) / CUBE
    assert sensitivities(truss, state)[0, 0] == pytest.approx(1.0 / slope, rel=1e-8)

    moved = von_mises_truss(HEIGHT, moved=True)
    state = advance(moved, at_rest(2), np.array([0.2]))[-1]
    w = state.dofs[0]
    slope = (2.0 * HEIGHT**2 - 6.0 * HEIGHT * w + 3.0 * w**2) / CUBE
    assert sensitivities(moved, state)[0] == pytest.approx([1.0 / (1.0 + slope), 1.0], rel=1e-8)


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


def test_history_advances_once_a_solution() -> None:
    """A spring whose rest length follows its extension: the answer counts the steps taken."""
    rest = np.zeros(1)
    ratchet = SmallSystem(
        1, lambda x, mu: x - rest - mu[:1], lambda *_: np.array([[1.0]]), lambda *_: np.array([[-1.0]])
    )
    ratchet.advance_history = lambda x, _: rest.__setitem__(0, x[0])  # type: ignore[attr-defined]
    first = advance(ratchet, at_rest(), np.array([1.0]))[-1]
    second = advance(ratchet, first, np.array([2.0]))[-1]
    assert (first.dofs[0], second.dofs[0]) == pytest.approx((1.0, 3.0))


def cubic(tangents: list[float]) -> SmallSystem:
    """x^3 + x = mu; ``tangents`` takes in where tangents are made."""

    def tangent(x: np.ndarray, _: np.ndarray) -> np.ndarray:
        tangents.append(float(x[0]))
        return np.array([[3.0 * x[0] ** 2 + 1.0]])

    return SmallSystem(1, lambda x, mu: x**3 + x - mu, tangent, lambda *_: np.array([[-1.0]]))


def root_of_cubic(load: float) -> float:
    (root,) = [r.real for r in np.roots([1.0, 0.0, 1.0, -load]) if abs(r.imag) < 1e-12]
    return root


def test_a_smooth_path_takes_one_tangent_a_step_where_single_steps_take_two() -> None:
    loads, tangents = np.linspace(2.0, 10.0, 9), []
    states = advance(cubic(tangents), State(np.array([2.0]), np.array([1.0])), loads[1:, None])
    assert [state.dofs[0] for state in states] == pytest.approx([root_of_cubic(load) for load in loads], abs=1e-8)
    assert len(tangents) <= 10
    alone: list[float] = []
    for load, before in zip(loads[1:], states, strict=False):
        solve(cubic(alone), np.array([load]), before)
    assert len(alone) >= 15


def test_a_path_with_a_corner_is_followed_to_its_end() -> None:
    """What is foretold beyond the corner is wrong, and lies beyond where the residual is a number at all."""
    loads = np.concatenate([np.linspace(0.0, 2.0, 9), np.linspace(1.5, -2.0, 8)])
    system = cubic([])
    system.residual = lambda x, mu: np.full(1, np.nan) if x[0] > 1.05 else x**3 + x - mu
    states = advance(system, at_rest(), loads[1:, None])
    assert len(states) == len(loads)
    assert [state.dofs[0] for state in states] == pytest.approx([root_of_cubic(load) for load in loads], abs=1e-8)


def slope(value: float) -> Linearisation:
    """A tangent of one unknown."""
    system = SmallSystem(1, lambda x, _: x, lambda *_: np.array([[value]]), lambda *_: np.zeros((1, 1)))
    return system.linearise(np.zeros(1), np.zeros(1))


@pytest.mark.parametrize(("guess", "kept"), [(1.05, 4.0), (0.9, 2.5), (0.9, 8.0)])
def test_a_kept_tangent_leads_to_the_root_and_is_made_anew_only_if_too_far_off(guess: float, kept: float) -> None:
    tangents: list[float] = []
    state = solve_with_kept_tangent(cubic(tangents), np.array([2.2]), np.array([guess]), slope(kept))
    assert state is not None
    assert state.dofs[0] == pytest.approx(root_of_cubic(2.2), abs=1e-8)
    assert len(tangents) == (0 if kept == 4.0 else 1)


def test_an_iteration_with_a_kept_tangent_that_leads_away_is_given_up() -> None:
    system = cubic([])
    system.residual = lambda x, mu: np.full(1, np.nan) if abs(x[0]) > 3.0 else x**3 + x - mu
    assert solve_with_kept_tangent(system, np.array([2.2]), np.array([0.5]), slope(-0.5)) is None


def test_truss_snaps_through_both_limit_points() -> None:
    arc = ArcLength(von_mises_truss(HEIGHT), options=ArcOptions(first=1e-3, largest=0.01))
    points = list(arc.follow(at_rest(), lambda state: state.dofs[0] - 2.2 * HEIGHT))
    depths = np.array([point.state.dofs[0] for point in points])
    loads = np.array([point.state.mu[0] for point in points])
    np.testing.assert_allclose(loads, [truss_force(w) for w in depths], atol=1e-10)
    assert depths[-1] == pytest.approx(2.2 * HEIGHT, rel=1e-8)
    # Steps of 0.01 bracket the extremes closely.
    assert loads[depths < HEIGHT].max() == pytest.approx(LIMIT_LOAD, rel=2e-3)
    assert loads[depths < 1.9 * HEIGHT].min() == pytest.approx(-LIMIT_LOAD, rel=2e-3)
    unstable = np.abs(depths / HEIGHT - 1.0) < 1.0 / np.sqrt(3.0)
    assert [point.state.negative_pivots for point in points] == unstable.astype(int).tolist()
    assert [point.rate < 0.0 for point in points] == unstable.tolist()
    assert not missed_bifurcations(points)


def test_path_lands_on_a_value_of_its_parameter_in_either_sense() -> None:
    arc = ArcLength(von_mises_truss(HEIGHT), options=ArcOptions(first=1e-3))
    *_, last = arc.follow(at_rest(), lambda state: state.mu[0] - 0.9 * LIMIT_LOAD)
    assert last.state.mu[0] == pytest.approx(0.9 * LIMIT_LOAD, rel=1e-8)
    *_, last = arc.follow(at_rest(), lambda state: -0.01 - state.mu[0], sense=-1.0)
    assert last.state.mu[0] == pytest.approx(-0.01, rel=1e-8)
    assert truss_force(last.state.dofs[0]) == pytest.approx(-0.01, abs=1e-10)


def test_an_imposed_motion_is_the_parameter_too() -> None:
    """The spring carries the apex along: motion = depth + force, all the way through."""
    arc = ArcLength(von_mises_truss(HEIGHT, moved=True), options=ArcOptions(first=0.01))
    *_, last = arc.follow(at_rest(2), lambda state: state.dofs[0] - 0.5)
    assert last.state.mu[0] == pytest.approx(0.5 + truss_force(0.5), rel=1e-9)
    assert last.state.dofs[1] == pytest.approx(last.state.mu[0], rel=1e-12)


def test_imperfect_column_follows_the_bent_path_and_the_perfect_one_reports_its_bifurcation() -> None:
    arc = ArcLength(spring_column(0.01), options=ArcOptions(first=0.01))
    points = list(arc.follow(State(np.zeros(1), np.array([0.01])), lambda state: state.dofs[0] - 1.0))
    for point in points[1:]:
        x = point.state.dofs[0]
        assert point.state.mu[0] == pytest.approx((x - 0.01) / np.sin(x), rel=1e-7)
    assert not missed_bifurcations(points)

    # A second, loaded dof keeps the upright column's path from standing still.
    column = SmallSystem(
        2,
        lambda x, mu: np.array([x[0] - mu[0] * np.sin(x[0]), x[1] - mu[0]]),
        lambda x, mu: np.diag([1.0 - mu[0] * np.cos(x[0]), 1.0]),
        lambda x, _: np.array([[-np.sin(x[0]), -1.0]]),
    )
    points = list(ArcLength(column).follow(at_rest(2), lambda state: state.mu[0] - 1.3))
    (missed,) = missed_bifurcations(points)
    assert missed.pivots == (0, 1)
    assert missed.before[0] < 1.0 < missed.after[0]


def test_a_path_that_ends_says_where() -> None:
    def residual(x: np.ndarray, mu: np.ndarray) -> np.ndarray:
        return np.array([x[0] - mu[0] if x[0] <= 0.5 else np.nan])

    torn = SmallSystem(1, residual, lambda *_: np.array([[1.0]]), lambda *_: np.array([[-1.0]]))
    with pytest.raises(SolverError, match=r"last parameters that converged are \[0\.(5|49999)"):
        list(ArcLength(torn).follow(at_rest(), lambda state: state.mu[0] - 1.0))


def test_buckling_loads_and_modes_of_a_chain_of_links() -> None:
    modes = buckling_modes(link_chain(stiffness=6.0, length=0.5), at_rest(2), 0, step=0.1, count=2)
    assert [mode.change for mode in modes] == pytest.approx([1.0, 3.0], rel=1e-9)
    assert modes[0].shape == pytest.approx([1.0, -1.0]) or modes[0].shape == pytest.approx([-1.0, 1.0])
    assert modes[1].shape == pytest.approx([1.0, 1.0])


def test_a_structure_that_does_not_buckle_is_refused() -> None:
    with pytest.raises(SolverError, match="no buckling mode"):
        buckling_modes(link_chain(stiffness=6.0, length=-0.5), at_rest(2), 0, step=0.1)
