"""Prescribed rotations beyond half a turn: the body in between takes the same turn, by whichever way it is solved."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from morph_dslam.errors import SolverError
from morph_dslam.mechanics.loads import DeadTraction
from morph_dslam.mechanics.materials.isotropic import NeoHookean
from morph_dslam.mechanics.solid import SolidProblem
from morph_dslam.mechanics.solvers.arc_length import ArcLength
from morph_dslam.mechanics.solvers.continuation import advance, loaded_state, stable_state
from morph_dslam.mechanics.solvers.newton import State
from morph_dslam.mechanics.solvers.relaxation import relaxed_state
from morph_dslam.mechanics.supports import RigidRotation
from morph_dslam.meshing.generators import tube
from morph_dslam.studies.solid_sweep import SolidSweep
from tests.support.shells import shell_study
from tests.support.small_systems import SmallSystem
from tests.support.solids import load_parameter

Array = NDArray[np.float64]
INNER, OUTER, LENGTH, SHEAR = 0.004, 0.008, 0.08, 1e6


def pipe(top: float, bottom: float = 0.0, loads: tuple[DeadTraction, ...] = (), fine: bool = True) -> SolidProblem:
    """A rubber tube whose ends are turned about its axis by default angles, degrees; the top's is the parameter."""
    symbols = load_parameter(turn=np.radians(top))
    return SolidProblem(
        tube(INNER, OUTER, LENGTH, (3, 1, 12), "hex20") if fine else tube(INNER, OUTER, LENGTH, (4, 1, 4), "hex8"),
        {"all": NeoHookean(young=2.8 * SHEAR, poisson=0.4)},
        [RigidRotation("bottom", (0, 0, 1), np.radians(bottom)), RigidRotation("top", (0, 0, 1), symbols["turn"])],
        loads,
        symbols,
    )


def turned(problem: SolidProblem, dofs: Array) -> float:
    """Mean angle by which nodes in the middle of the tube have turned about its axis, degrees, -180 to 180."""
    nodes = problem.mesh.nodes
    middle = np.abs(nodes[:, 2] - LENGTH / 2.0) < 1e-9
    before, after = (x[middle, 0] + 1j * x[middle, 1] for x in (nodes, nodes + problem.nodal_displacement(dofs)))
    return float(np.degrees(np.angle(np.mean(after / before))))


def torque(problem: SolidProblem, dofs: Array, mu: Array) -> float:
    """Moment about the axis on the top, over that of torsion with radii kept: shear pi/2 (B^4 - A^4) per length."""
    polar = np.pi / 2.0 * (OUTER**4 - INNER**4)
    return float(problem.reactions(dofs, mu, "top")[1][2] / (SHEAR * polar / LENGTH))


@pytest.mark.parametrize(("top", "bottom"), [(200.0, 0.0), (300.0, 0.0), (-240.0, 0.0), (120.0, -120.0)])
def test_the_middle_turns_by_the_mean_of_both_ends(top: float, bottom: float) -> None:
    problem = pipe(top, bottom)
    state = loaded_state(problem, problem.symbols.default)
    assert turned(problem, state.dofs) == pytest.approx((top + bottom) / 2.0, abs=1e-3)
    # The wall grows thinner as it is twisted, so that the torque falls behind by a few percent.
    assert torque(problem, state.dofs, state.mu) == pytest.approx(np.radians(top - bottom), rel=0.05)


def test_from_one_sample_to_the_next() -> None:
    sweep = SolidSweep(pipe(0.0))
    state = sweep.first_state()
    for angle in (300.0, 10.0, -240.0):
        state = sweep.advance(state, np.radians([angle]))
        assert turned(sweep.problem, state.dofs) == pytest.approx(angle / 2.0, abs=1e-3)
        assert torque(sweep.problem, state.dofs, state.mu) == pytest.approx(np.radians(angle), rel=0.05)


def test_what_has_turned_already_does_not_turn_again() -> None:
    """The rotation acts first, a traction along the axis after it."""
    problem = pipe(240.0, loads=(DeadTraction("outer", (0.0, 0.0, 1e3)),))
    problem.applied_first = lambda: pipe(240.0)
    state = loaded_state(problem, problem.symbols.default)
    assert turned(problem, state.dofs) == pytest.approx(120.0, abs=1.0)
    assert torque(problem, state.dofs, state.mu) == pytest.approx(np.radians(240.0), rel=0.05)


@pytest.mark.slow
@pytest.mark.parametrize("start", [None, 100.0])
def test_by_arc_length(start: float | None) -> None:
    problem = pipe(220.0, fine=False)
    begin = None if start is None else loaded_state(problem, np.radians([start]))
    state = stable_state(problem, problem.symbols.default, begin)
    assert state is not None
    assert turned(problem, state.dofs) == pytest.approx(110.0, abs=1e-3)


def test_a_step_of_arc_length_turns_by_no_more_than_a_quarter() -> None:
    """One dof x = mu, whose support turns by so many radians."""
    spring = SmallSystem(1, lambda x, mu: x - mu, lambda x, mu: np.eye(1), lambda x, mu: -np.eye(1))
    spring.turn = lambda begin, end: abs(end - begin)[0]  # type: ignore[attr-defined]
    arc = ArcLength(spring)
    begin = arc.begin(State(np.zeros(1), np.zeros(1)))
    assert arc.step(begin, 1.5).state.mu == pytest.approx(1.5)
    with pytest.raises(SolverError, match="in one increment"):
        arc.step(begin, 1.6)


def test_a_path_turns_by_no_more_than_a_quarter_in_one_increment() -> None:
    problem = pipe(0.0)
    angles = np.degrees([state.mu[0] for state in advance(problem, problem.initial_state(), np.radians([-300.0]))])
    assert np.abs(np.diff(angles)).max() <= 90.0 + 1e-6
    # Up to there one increment still does.
    assert len(advance(problem, problem.initial_state(), np.radians([80.0]))) == 2


def twisted_strip(default: float) -> str:
    return f"""
        mesh = {{ generator = "plate", size = ["100 mm", "20 mm"], divisions = [4, 1], cells = "quad9" }}
        shell = {{ thickness = "2 mm" }}
        material = {{ young = "2 GPa", poisson = 0.0 }}
        [[supports]]
        kind = "clamped"
        on = "x_min"
        [[supports]]
        kind = "rotation"
        on = "x_max"
        axis = [1, 0, 0]
        angle = "turn"
        [parameters.turn]
        range = ["0 deg", "300 deg"]
        default = "{default} deg"
    """


@pytest.mark.slow
def test_a_shell_takes_the_same_turn() -> None:
    """The middle of a strip turns by half of what its end does."""
    sweep = shell_study(twisted_strip(240.0)).sweep_problem()
    problem, state = sweep.problem, sweep.first_state()
    nodes = problem.mesh.nodes
    across = [np.argmin(np.abs(nodes - [0.05, y, 0.0]).sum(axis=1)) for y in (nodes[:, 1].min(), nodes[:, 1].max())]
    for angle in (240.0, 20.0):
        if angle != 240.0:
            state = sweep.advance(state, np.radians([angle]))
        first, last = (nodes + problem.sample(state.dofs, state.mu)["displacement"])[across]
        found = np.degrees(np.arctan2(*(last - first)[[2, 1]]))
        assert found == pytest.approx(angle / 2.0, abs=1e-2)


def test_a_shell_that_is_let_go_is_not_turned_that_far() -> None:
    problem = shell_study(twisted_strip(240.0)).problem()
    with pytest.raises(SolverError, match="90"):
        relaxed_state(problem, problem.symbols.default)
