"""The shell against the elastica and the published cantilever of Sze et al."""

from __future__ import annotations

import csv

import ngsolve as ngs
import numpy as np
import pytest
from scipy.integrate import solve_bvp

from morph_dslam.mechanics.shell import KoiterSheet, OrthotropicSheet, rectangle_mesh
from tests.support.real_data import real_data


def isotropic(young: float, poisson: float, thickness: float) -> OrthotropicSheet:
    return OrthotropicSheet(young, young, poisson, young / (2.0 * (1.0 + poisson)), thickness)


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
    tip = cantilever_path(3, 12, loads, 4.0)
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
