"""Koiter sheets against the elastica, closed forms and a published cantilever, derivatives against differences."""

from __future__ import annotations

import csv

import ngsolve as ngs
import numpy as np
import pytest
from scipy.integrate import solve_bvp

from morph_dslam.mechanics.sheet_equations import SheetEquations
from morph_dslam.mechanics.shell import KoiterSheet, OrthotropicSheet, rectangle_mesh
from morph_dslam.mechanics.solvers.arc_length import ArcLength, ArcOptions, missed_bifurcations
from morph_dslam.mechanics.solvers.continuation import advance
from morph_dslam.mechanics.solvers.newton import State, sensitivities
from tests.support.real_data import real_data

#: For differences of solutions.
PRECISE = 1e-12


def isotropic(young: float, poisson: float, thickness: float, **more: float) -> OrthotropicSheet:
    return OrthotropicSheet(young, young, poisson, young / (2.0 * (1.0 + poisson)), thickness, **more)


def small_sheet(condensed: bool = True) -> SheetEquations:
    """A few elements, clamped at both ends, fibres askew, loaded sideways at one of its free edges."""
    material = OrthotropicSheet(5e9, 2.5e9, 0.3, 1.4e9, 1e-3, fibre_angle=0.4, offset=2e-4)
    mesh = rectangle_mesh(np.linspace(-0.15, 0.15, 5), np.linspace(-0.1, 0.1, 4))
    load = {"top": np.array([0.0, 0.0, 5.0])}
    shell = KoiterSheet(mesh, material, order=2, clamped="left|right", dead_load=load)
    motion = {"left": np.array([0.5, 0.0, 0.0]), "right": np.array([-0.5, 0.0, 0.0])}
    return SheetEquations(shell, motion, length=0.3, condensed=condensed)


def arched(equations: SheetEquations) -> State:
    start = State(np.zeros(2), np.zeros(equations.n_dofs))
    return advance(equations, start, np.array([1e-4, 1.0]), PRECISE)[-1]


def test_condensed_and_whole_tangents_agree_and_match_differences() -> None:
    condensed, whole = small_sheet(), small_sheet(condensed=False)
    state = arched(condensed)
    one = condensed.linearise(state.dofs, state.mu)
    other = whole.linearise(state.dofs, state.mu)
    rng = np.random.default_rng(0)
    vector = 1e-4 * rng.standard_normal(condensed.n_dofs)
    product = other.apply(vector)
    np.testing.assert_allclose(one.apply(vector), product, atol=1e-8 * np.abs(product).max())
    solution = other.solve(product)
    np.testing.assert_allclose(one.solve(product), solution, atol=1e-8 * np.abs(solution).max())
    # An older linearisation is restored before it is used.
    condensed.linearise(np.zeros_like(vector), np.zeros(2)).solve(product)
    np.testing.assert_allclose(one.solve(product), solution, atol=1e-8 * np.abs(solution).max())
    step = 1e-3
    residuals = [whole.residual(state.dofs + s * vector, state.mu) for s in (step, -step)]
    difference = (residuals[0] - residuals[1]) / (2.0 * step)
    np.testing.assert_allclose(product, difference, atol=1e-6 * np.abs(product).max())


def test_sensitivities_match_differences() -> None:
    equations = small_sheet()
    state = arched(equations)
    slopes = sensitivities(equations, state)
    up = equations.shell.displacement_dofs(2)
    for parameter, step in ((0, 1e-7), (1, 1e-4)):
        change = np.zeros(2)
        change[parameter] = step
        above, below = (advance(equations, state, state.mu + sign * change, PRECISE)[-1].dofs for sign in (1.0, -1.0))
        difference = (above - below) / (2.0 * step)
        error = np.abs(slopes[parameter] - difference)[up].max()
        assert error < 1e-5 * np.abs(difference[up]).max()


@pytest.mark.slow
def test_post_buckled_cantilever_follows_the_elastica() -> None:
    """P / P_cr at tip offsets of the elastica whose end has turned by 20, 40, 60 and 90 degrees."""
    length, width, thickness, young = 0.1, 0.01, 1e-4, 1e9
    mesh = rectangle_mesh(np.linspace(0.0, length, 9), np.array([0.0, width]))
    euler = np.pi**2 * young * width * thickness**3 / 12.0 / (4.0 * length**2)
    push = {"right": np.array([-euler / width, 0.0, 0.0])}
    shell = KoiterSheet(mesh, isotropic(young, 0.0, thickness), 3, clamped="left", dead_load=push)
    equations = SheetEquations(shell, {}, length)
    bow = ngs.GridFunction(shell.scalar_space)
    bow.Set(1e-6 * (1.0 - ngs.cos(0.5 * np.pi * ngs.x / length)))
    shape = np.zeros(equations.n_dofs)
    shape[shell.displacement_dofs(2)] = bow.vec.FV().NumPy()
    equations.set_imperfection(shape)
    tip = shell.mesh(length, width / 2.0)

    def offset(state: State) -> float:
        field = ngs.GridFunction(shell.scalar_space)
        field.vec.FV().NumPy()[:] = state.dofs[shell.displacement_dofs(2)]
        return float(field(tip)) / length

    arc = ArcLength(equations, 1, ArcOptions(first=1e-5, largest=0.03, corrections=8))
    start: State = State(np.zeros(2), equations.unloaded)
    for wanted, load in ((0.219413, 1.01540), (0.422240, 1.06366), (0.593208, 1.15172), (0.762760, 1.39320)):
        points = list(arc.follow(start, lambda state, wanted=wanted: offset(state) - wanted))
        assert points[-1].state.mu[1] == pytest.approx(load, rel=5e-4)
        assert not missed_bifurcations(points)
        assert {point.state.negative_pivots for point in points} == {0}
        start = points[-1]  # type: ignore[assignment]


def test_fibres_askew_give_the_off_axis_modulus() -> None:
    angle, c, s = 0.5, np.cos(0.5), np.sin(0.5)
    material = OrthotropicSheet(5e9, 2.5e9, 0.3, 1.4e9, 1e-4, fibre_angle=angle)
    # Jones, Mechanics of Composite Materials (1999), eq. 2.97.
    along = c**4 / 5e9 + (1.0 / 1.4e9 - 0.6 / 5e9) * c**2 * s**2 + s**4 / 2.5e9
    assert 1.0 / np.linalg.inv(material.stiffness)[0, 0] == pytest.approx(1.0 / along, rel=1e-12)
    turned = OrthotropicSheet(5e9, 2.5e9, 0.3, 1.4e9, 1e-4, fibre_angle=np.pi / 2.0).stiffness
    straight = OrthotropicSheet(5e9, 2.5e9, 0.3, 1.4e9, 1e-4).stiffness
    np.testing.assert_allclose(turned, straight[np.ix_([1, 0, 2], [1, 0, 2])], atol=1.0)


def test_a_strip_pulled_off_its_middle_bends() -> None:
    """Pulled at the meshed surface, offset e from the middle: moment P e, tip rising by P e L^2 / 2 E I."""
    length, thickness, young, offset, pull = 0.1, 1e-3, 1e9, 3e-4, 0.01
    mesh = rectangle_mesh(np.linspace(0.0, length, 5), np.array([0.0, 0.02]))
    material = isotropic(young, 0.0, thickness, offset=offset)
    load = {"right": np.array([pull, 0.0, 0.0])}
    equations = SheetEquations(KoiterSheet(mesh, material, 3, clamped="left", dead_load=load), {}, length)
    state = advance(equations, State(np.zeros(2), np.zeros(equations.n_dofs)), np.array([0.0, 1.0]))[-1]
    displacement, stress = equations.shell.sample(state.dofs, np.array([[length, 0.01], [0.05, 0.01]]))
    stiffness = young * thickness**3 / 12.0
    # The middle lies above the pull, so that the tip turns up.
    assert displacement[0, 2] == pytest.approx(pull * offset * length**2 / (2.0 * stiffness), rel=2e-3)
    direct, bending = pull / thickness, 6.0 * pull * offset / thickness**2
    assert stress["top"][1, 0] == pytest.approx(direct - bending, rel=5e-3)
    assert stress["bottom"][1, 0] == pytest.approx(direct + bending, rel=5e-3)


def equilibrate(shell: KoiterSheet, load: float) -> None:
    """Newton's method at a dead load, on NGSolve's own pieces."""
    shell.load_factor.Set(load)
    shell.refresh_normals()
    form, state = shell.form, shell.state.vec
    residual, update = state.CreateVector(), state.CreateVector()
    for _ in range(30):
        form.Apply(state, residual)
        form.AssembleLinearization(state)
        inverse = form.mat.Inverse(shell.space.FreeDofs(True), inverse="sparsecholesky")
        residual.data += form.harmonic_extension_trans * residual
        update.data = inverse * residual
        update.data += form.harmonic_extension * update
        update.data += form.inner_solve * residual
        state.data -= update
        if np.abs(update.FV().NumPy()[shell.displacement_dofs(2)]).max() < 1e-10:
            return
    raise AssertionError("no convergence")


def cantilever_path(order: int, divisions: int, loads: np.ndarray, force: float) -> np.ndarray:
    """Tip displacement (n, 2) as (shortening, deflection) of Sze's strip under a shear force at its end."""
    mesh = rectangle_mesh(np.linspace(0.0, 10.0, divisions + 1), np.array([0.0, 1.0]))
    load = {"right": np.array([0.0, 0.0, force])}
    shell = KoiterSheet(mesh, isotropic(1.2e6, 0.0, 0.1), order, clamped="left", dead_load=load)
    tip = []
    for factor in loads:
        equilibrate(shell, factor)
        displacement, _ = shell.sample(shell.state_vector(), np.array([[10.0, 0.5]]))
        tip.append([-displacement[0, 0], displacement[0, 2]])
    return np.array(tip)


def elastica_tip(load: float) -> tuple[float, float]:
    """(u/L, w/L) of an inextensible cantilever under P L^2 / EI = load, by a boundary value solver."""

    def slope(_, y):
        return np.vstack([y[1], -load * np.cos(y[0]), np.cos(y[0]), np.sin(y[0])])

    s = np.linspace(0.0, 1.0, 60)
    guess = np.vstack([s, 1.0 - s, s, s**2 / 2.0])
    solution = solve_bvp(slope, lambda a, b: np.array([a[0], b[1], a[2], a[3]]), s, guess, tol=1e-9, max_nodes=50_000)
    return 1.0 - solution.y[2, -1], solution.y[3, -1]


@pytest.mark.slow
def test_cantilever_follows_the_elastica() -> None:
    # EI = 100 for Sze's strip, so a force of 4 at length 10 is P L^2 / EI = 4.
    tip = cantilever_path(3, 12, np.linspace(0.1, 1.0, 10), 4.0)[-1] / 10.0
    assert tip == pytest.approx([0.328941, 0.669964], rel=2e-4)
    assert tip == pytest.approx(elastica_tip(4.0), rel=2e-4)


def test_cantilever_matches_the_published_table() -> None:
    table = real_data("fem_reference") / "sze2004_cantilever_end_shear.csv"
    rows = list(csv.DictReader(table.read_text().splitlines()))
    loads = np.array([float(row["P_over_Pmax"]) for row in rows])
    published = np.array([[float(row["minus_u_tip"]), float(row["w_tip"])] for row in rows])
    tip = cantilever_path(3, 6, loads, 4.0)
    # Three decimals are printed: half a unit of the last one, or 0.5 %.
    assert np.all(np.abs(tip - published) <= np.maximum(0.005 * published, 6e-4))


def test_moment_free_strip_rolls_into_a_circle() -> None:
    """A pure end moment of 2 pi EI / (4 L) bends a strip into a quarter circle."""
    length, young, thickness = 1.0, 1e6, 0.01
    mesh = rectangle_mesh(np.linspace(0.0, length, 9), np.array([0.0, 0.2]))
    shell = KoiterSheet(mesh, isotropic(young, 0.0, thickness), 3, clamped="left")
    hybrid = shell.space.TrialFunction()[4]
    moment = 0.5 * np.pi * young * thickness**3 / 12.0 / length / shell.energy_scale
    factor = shell.load_factor
    shell.form += ngs.Variation(factor * moment * (hybrid.Trace() * ngs.specialcf.normal(2)) * ngs.ds("right"))
    for load in np.linspace(0.125, 1.0, 8):
        equilibrate(shell, load)
    displacement, stress = shell.sample(shell.state_vector(), np.array([[length, 0.1], [0.4, 0.1]]))
    radius = 2.0 * length / np.pi
    assert np.abs(displacement[0, 2]) == pytest.approx(radius, rel=1e-3)
    assert displacement[0, 0] == pytest.approx(radius - length, rel=1e-3)
    # Bending stress E t / (2 R) with opposite signs on the faces; the theory itself is only good to t / R.
    bending = (stress["bottom"][1, 0] - stress["top"][1, 0]) / 2.0
    assert np.abs(bending) == pytest.approx(young * thickness / (2.0 * radius), rel=1e-3)
    assert np.abs(stress["bottom"][1, 0] + stress["top"][1, 0]) < thickness / radius * np.abs(bending)
