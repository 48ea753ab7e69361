"""Arc length and buckling modes on small structures with closed-form paths."""

from __future__ import annotations

import numpy as np
import pytest

from morph_dslam.errors import SolverError
from morph_dslam.mechanics.solvers.arc_length import ArcLength, ArcOptions, buckling_modes, missed_bifurcations
from morph_dslam.mechanics.solvers.newton import State
from tests.support.small_systems import SmallSystem, link_chain, spring_column, von_mises_truss

HEIGHT = 0.3
CUBE = (1.0 + HEIGHT**2) ** 1.5
LIMIT_LOAD = 2.0 * HEIGHT**3 / (3.0 * np.sqrt(3.0) * CUBE)


def truss_force(depth: float) -> float:
    return depth * (2.0 * HEIGHT - depth) * (HEIGHT - depth) / CUBE


def at_rest(n: int = 1, d: int = 1) -> State:
    return State(np.zeros(d), np.zeros(n))


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


def test_fixed_length_is_covered_in_shorter_steps_where_need_be() -> None:
    arc = ArcLength(von_mises_truss(HEIGHT), options=ArcOptions(max_corrections=2))
    point = arc.advance(arc.begin(at_rest()), 0.2)
    assert point.length == pytest.approx(0.2, rel=1e-12)
    assert point.state.dofs[0] == pytest.approx(0.2, rel=1e-9)


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
