"""Prony series: relaxation of cells and of a block in closed form, variables that can be restored, checks."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from morph_dslam.errors import ArgumentError, SolverError, StudyError
from morph_dslam.mechanics.contact import RigidPlane
from morph_dslam.mechanics.loads import DeadTraction
from morph_dslam.mechanics.materials.isotropic import NeoHookean
from morph_dslam.mechanics.materials.viscoelastic import Prony
from morph_dslam.mechanics.solid import SolidProblem
from morph_dslam.mechanics.solvers.continuation import advance
from morph_dslam.mechanics.supports import PrescribedDisplacement, fixed
from morph_dslam.meshing.generators import block
from tests.support import closed_form_stress as exact
from tests.support.material_laws import BULGED as F_HELD
from tests.support.solids import ROLLERS, PrescribedCells, distorted, load_parameter

ELASTIC = NeoHookean(young=3.0, poisson=0.3)
MATERIAL = NeoHookean(young=3.0, poisson=0.3, prony=Prony((0.3, 0.2), (0.5, 4.0), (0.0, 0.0)))


def split_stress(F):
    """P of the remainder and of the volumetric part of MATERIAL."""
    lam, _ = exact.lame(3.0, 0.3)
    volumetric = lam * np.log(np.linalg.det(F)) * np.linalg.inv(F).T
    return exact.neo_hookean(F, 3.0, 0.3) - volumetric, volumetric


def remaining(g, times, t):
    return 1.0 - sum(gi * (1.0 - np.exp(-t / tau)) for gi, tau in zip(g, times, strict=True))


@pytest.mark.parametrize("bulk", [(0.0, 0.0), (0.1, 0.4), None])
def test_a_held_deformation_relaxes_as_the_series_says(bulk):
    prony = Prony((0.3, 0.2), (0.5, 4.0), bulk)
    cell = PrescribedCells(NeoHookean(young=3.0, poisson=0.3, prony=prony))
    shape, volume = split_stress(F_HELD)
    np.testing.assert_allclose(cell.step(F_HELD, 1e-12)[0], shape + volume, rtol=1e-9)
    for duration, t in ((0.3, 0.3), (0.5, 0.8), (3.0, 3.8)):
        # Steps of different lengths: the recurrence is exact while the strain rests.
        g, k = (remaining(part, (0.5, 4.0), t) for part in (prony.relative_moduli, prony.bulk))
        np.testing.assert_allclose(cell.step(F_HELD, duration)[0], g * shape + k * volume, rtol=1e-9, atol=1e-13)


def test_regions_relax_each_by_its_own_series():
    cells = PrescribedCells(MATERIAL, ELASTIC)
    cells.step(F_HELD, 1e-12)
    shape, volume = split_stress(F_HELD)
    viscous, elastic = cells.step(F_HELD, 1e4)
    np.testing.assert_allclose(viscous, 0.5 * shape + volume, rtol=1e-9, atol=1e-13)
    np.testing.assert_allclose(elastic, shape + volume, rtol=1e-9, atol=1e-13)


def test_a_state_can_be_restored_and_a_step_repeated():
    cell = PrescribedCells(MATERIAL)
    cell.step(F_HELD, 0.2)
    kept, time = cell.problem.history.values(), cell.time
    first = cell.step(np.diag([1.2, 0.9, 1.0]), 0.4)
    cell.problem.history.restore(kept)
    cell.time = time
    np.testing.assert_array_equal(cell.step(np.diag([1.2, 0.9, 1.0]), 0.4), first)


@pytest.mark.parametrize(
    ("prony", "message"),
    [
        (Prony((0.3, 0.2), (1.0,)), "as many relative moduli as times"),
        (Prony((), ()), "as many relative moduli as times"),
        (Prony((0.3,), (0.0,)), "times"),
        (Prony((-0.1,), (1.0,)), "relative_moduli"),
        (Prony((0.6, 0.4), (1.0, 2.0)), "relative_moduli"),
        (Prony((0.3,), (1.0,), (1.0,)), "bulk_moduli"),
    ],
)
def test_series_that_are_no_relaxation_are_refused(prony, message):
    with pytest.raises(StudyError, match=message):
        prony.check()


#: g_inf = 0.4, g_1 = 0.6, tau = 2 s.
LAW = NeoHookean(young=3e6, poisson=0.45, prony=Prony((0.6,), (2.0,)))


@pytest.mark.parametrize("cell_type", ["hex8", "tet10", "prism15"])
def test_relaxation(cell_type: str) -> None:
    symbols = load_parameter(pull=0.0, time=0.0)
    supports = [*ROLLERS, PrescribedDisplacement("x_max", x=symbols["pull"])]
    mesh = distorted(block((1.0, 1.0, 1.0), (2, 2, 2), cell_type), 0.05)
    problem = SolidProblem(mesh, {"all": LAW}, supports, parameters=symbols, time=symbols["time"])
    state = advance(problem, problem.initial_state(), np.array([0.5, 0.0]))[-1]
    at_once = problem.reactions(state.dofs, state.mu, "x_max")[0][0]
    assert at_once == pytest.approx(1.075843e6, rel=1e-6)
    for time, remaining in ((1.0, 0.763918), (4.0, 0.481201)):
        state = advance(problem, state, np.array([0.5, time]))[-1]
        force = problem.reactions(state.dofs, state.mu, "x_max")[0][0]
        assert force / at_once == pytest.approx(remaining, rel=1e-5)
        fields = problem.recovery.at_nodes(state.dofs, state.mu, ("first_piola_kirchhoff", "stress"))
        np.testing.assert_allclose(fields["first_piola_kirchhoff"][:, 0], force, rtol=1e-5)
        np.testing.assert_allclose(fields["von_mises"], force / 0.830679**2, rtol=1e-5)
    with pytest.raises(SolverError, match="time goes back by 1 s"):
        problem.residual(state.dofs, np.array([0.5, 3.0]))


def test_a_viscous_material_needs_a_time() -> None:
    with pytest.raises(StudyError, match="which parameter is the time"):
        SolidProblem(block((1.0, 1.0, 1.0), (1, 1, 1), "hex8"), {"all": LAW}, [fixed("x_min")])


@pytest.mark.parametrize("remembered", [None, 3.0, -20.0])
def test_contact_with_a_viscous_solid_is_as_stiff_as_with_one_that_has_no_time_to_relax(
    remembered: float | None,
) -> None:
    """Walls confine a block; whether it remembers an earlier or a later time when the penalty is first needed."""
    symbols, load = load_parameter(time=0.0), DeadTraction("z_max", (0.0, 0.0, -1e4))
    walls = [
        RigidPlane("x_max", (1.0, 0.0, 0.0), (-1.0, 0.0, 0.0)),
        RigidPlane("y_max", (0.0, 1.0, 0.0), (0.0, -1.0, 0.0)),
    ]
    mesh, elastic = block((1.0, 1.0, 1.0), (2, 2, 2), "hex8"), NeoHookean(young=1e6, poisson=0.499)
    viscous = replace(elastic, prony=Prony((0.6,), (2.0,), (0.0,)))
    alike = SolidProblem(mesh, {"all": elastic}, ROLLERS, [load], contacts=walls)
    problem = SolidProblem(mesh, {"all": viscous}, ROLLERS, [load], symbols, time=symbols["time"], contacts=walls)
    assert problem.history is not None
    if remembered is not None:
        problem.history.restore(np.append(np.zeros(len(problem.history.values()) - 1), remembered))
    kept = problem.history.values()
    assert problem.in_contact == pytest.approx(alike.in_contact, rel=1e-9)
    np.testing.assert_array_equal(problem.history.values(), kept)


@pytest.mark.parametrize("cell_type", ["hex8", "tet10"])
def test_derivatives_by_the_constants_of_a_series_at_a_fixed_history(cell_type: str) -> None:
    symbols = load_parameter(pull=0.0, time=0.0, g=0.3, tau=2.0)
    law = NeoHookean(young=3.0, poisson=0.3, prony=Prony((symbols["g"],), (symbols["tau"],)))
    supports = [*ROLLERS, PrescribedDisplacement("x_max", x=symbols["pull"])]
    mesh = block((1.0, 1.0, 1.0), (1, 1, 1), cell_type)
    problem = SolidProblem(mesh, {"all": law}, supports, parameters=symbols, time=symbols["time"])
    state = advance(problem, problem.initial_state(), np.array([0.5, 0.0, 0.3, 2.0]))[-1]
    mu, steps = np.array([0.6, 1.5, 0.4, 3.0]), 1e-5 * np.eye(4)
    slopes = problem.residual_slopes(state.dofs, mu)
    for k in (2, 3):
        ends = [problem.residual(state.dofs, mu + sign * steps[k]) for sign in (1.0, -1.0)]
        np.testing.assert_allclose(slopes[k], (ends[0] - ends[1]) / 2e-5, atol=1e-8)
        assert np.abs(slopes[k]).max() > 1e-3
    with pytest.raises(ArgumentError, match="they depend on its history"):
        problem.sample_slopes(state.dofs, state.mu, slopes)
    with pytest.raises(StudyError, match="a Prony series changes along a path"):
        advance(problem, state, mu)
