"""Sheets between grips against closed forms, mirror symmetry and finite differences of the solver."""

from __future__ import annotations

import numpy as np
import pytest

from morph_dslam.errors import SolverError
from morph_dslam.mechanics.gripped_sheet import GrippedSheet
from morph_dslam.mechanics.grips import Grips
from morph_dslam.mechanics.shell import OrthotropicSheet

LENGTH, WIDTH, DEPTH = 0.42, 0.297, 0.01
YOUNG, THICKNESS = 5e9, 5e-4
FREE = LENGTH - 2.0 * DEPTH


@pytest.fixture(scope="module")
def planar() -> GrippedSheet:
    """Grips over the whole edges and no contraction: every state without twist is a plane elastica."""
    material = OrthotropicSheet(YOUNG, YOUNG, 0.0, YOUNG / 2.0, THICKNESS)
    return GrippedSheet(material, Grips(LENGTH, DEPTH, WIDTH, 0.0, 0.0), WIDTH, (10, 2), 3)


@pytest.fixture(scope="module")
def held() -> GrippedSheet:
    """Small grips off the middle, orthotropic: nothing is symmetric but the two sides, in a coarse mesh."""
    material = OrthotropicSheet(YOUNG, 0.5 * YOUNG, 0.3, 1.4e9, THICKNESS)
    return GrippedSheet(material, Grips(LENGTH, 0.012, 0.04, 0.05, 0.02), WIDTH, (4, 2), 2)


def test_clamped_buckling_shape_and_energy(planar: GrippedSheet) -> None:
    """bend = 0 is Euler's column: w = A cos^2(pi x / L), bulge 3 A / 4.

    Its approach is that of the curve, pi^2 A^2 / 4 L, and the compression under Euler's force,
    (4 pi^2 E I / L^2) L / E A = pi^2 t^2 / 3 L.
    """
    start = planar.first_state(0.004)
    state = planar.advance(start, np.array([0.003, 0.0, 0.0, 0.0]))
    amplitude = 4.0 / 3.0 * 0.003
    stiffness = YOUNG * THICKNESS**3 / 12.0
    approach = np.pi**2 * (amplitude**2 / (4.0 * FREE) + THICKNESS**2 / (3.0 * FREE))
    assert state.motion[3] == pytest.approx(approach, rel=1e-3)
    energy = stiffness * WIDTH * amplitude**2 * np.pi**4 / FREE**3
    assert planar.shell.bending_energy() == pytest.approx(energy, rel=1e-3)


def test_circular_arc(planar: GrippedSheet) -> None:
    """bend = 1 is a shallow circular arc of height h = bulge / 0.8693: constant stress E t 4 h / L^2."""
    planar.first_state(0.004)
    height = 0.004 / 0.869311
    points = np.array([[-0.1, 0.0], [0.0, 0.1], [0.15, -0.1]])
    displacement, stress = planar.shell.sample(planar.shell.state_vector(), points)
    assert displacement[:, 2] == pytest.approx(height * (1.0 - 4.0 * points[:, 0] ** 2 / FREE**2), rel=1e-3)
    assert stress["top"][:, 0] == pytest.approx(YOUNG * THICKNESS / 2.0 * 8.0 * height / FREE**2, rel=2e-3)
    assert stress["bottom"][:, 0] == pytest.approx(-stress["top"][:, 0], rel=2e-3)


@pytest.mark.slow
def test_both_sides_are_mirror_images(held: GrippedSheet) -> None:
    points = np.array([[-0.1, 0.05], [0.0, -0.1], [0.12, 0.1]])
    result = []
    for sign in (1.0, -1.0):
        start = held.first_state(sign * 0.012)
        state = held.advance(start, np.array([sign * 0.02, 0.8, sign * 0.05, 0.1]))
        result.append(held.shell.sample(state.dofs, points)[0] * [1.0, 1.0, sign])
        assert held.bulge() == pytest.approx(sign * 0.02, abs=1e-8)
    assert result[0] == pytest.approx(result[1], abs=1e-7)


@pytest.mark.slow
def test_sensitivities_match_differences_of_solutions(held: GrippedSheet) -> None:
    coordinates = np.array([0.02, 0.8, 0.05, 0.1])
    state = held.advance(held.first_state(0.012), coordinates)
    slopes, motions = held.sensitivities(state)
    displacements = slice(0, 3 * held.shell.scalar_space.ndof)
    for k, step in enumerate([1e-5, 1e-3, 1e-3, 1e-3]):
        change = np.zeros(4)
        change[k] = step
        forward = held.solve(coordinates + change, state)
        backward = held.solve(coordinates - change, state)
        difference = (forward.dofs - backward.dofs)[displacements] / (2.0 * step)
        assert np.linalg.norm(slopes[k][displacements] - difference) < 1e-3 * np.linalg.norm(difference)
        assert motions[k] == pytest.approx((forward.motion - backward.motion) / (2.0 * step), rel=1e-3, abs=1e-4)


@pytest.mark.slow
def test_unreachable_coordinates_are_named() -> None:
    material = OrthotropicSheet(YOUNG, YOUNG, 0.0, YOUNG / 2.0, THICKNESS)
    held = GrippedSheet(material, Grips(LENGTH, 0.012, 0.04, 0.0, 0.0), WIDTH, (4, 2), 2)
    with pytest.raises(SolverError, match=r"no equilibrium found at bulge .* % of the way"):
        held.advance(held.first_state(0.012), np.array([0.5, 1.0, 0.0, 0.0]))


def test_a_column_is_pushed_with_eulers_force(planar: GrippedSheet) -> None:
    """Held straight at a small bulge: 4 pi^2 E I / L^2 along the line of the grips, and moments P A / 2 at the ends."""
    state = planar.advance(planar.first_state(0.004), np.array([0.002, 0.0, 0.0, 0.0]))
    (left, right), _ = planar.reactions(state)
    euler = 4.0 * np.pi**2 * YOUNG * THICKNESS**3 / 12.0 * WIDTH / FREE**2
    assert left[0] == pytest.approx(euler, rel=2e-3)
    assert right[:3] == pytest.approx(-left[:3], abs=1e-6 * euler)
    # The grips lie at z = 0 and are pushed inwards: about a point on that line the moments are those at the ends.
    amplitude = 4.0 / 3.0 * 0.002
    assert abs(left[4]) == pytest.approx(euler * amplitude / 2.0, rel=1e-2)
    # Equilibrium holds as far as Newton's method took it: some 1e-6 of the moments.
    assert right[4] == pytest.approx(-left[4], rel=1e-5)


def test_an_arc_is_bent_by_moments_alone(planar: GrippedSheet) -> None:
    """bend = 1: the moment E I 8 h / L^2 of a shallow arc, and a force that is small beside Euler's."""
    state = planar.first_state(0.004)
    (left, right), _ = planar.reactions(state)
    rigidity = YOUNG * THICKNESS**3 / 12.0 * WIDTH
    assert abs(left[4]) == pytest.approx(rigidity * 8.0 * 0.004 / 0.869311 / FREE**2, rel=5e-3)
    assert np.linalg.norm(right[:3]) < 0.01 * 4.0 * np.pi**2 * rigidity / FREE**2


def test_grips_hold_the_sheet_in_balance_and_their_forces_have_derivatives(held: GrippedSheet) -> None:
    coordinates = np.array([0.02, 0.8, 0.05, 0.1])
    state = held.advance(held.first_state(0.012), coordinates)
    both, slopes = held.reactions(state)
    assert both.sum(axis=0) == pytest.approx(np.zeros(6), abs=1e-5 * np.abs(both).max())
    for k, step in enumerate([1e-5, 1e-3, 1e-3, 1e-3]):
        change = step * np.eye(4)[k]
        after, before = (held.reactions(held.solve(coordinates + sign * change, state))[0] for sign in (1.0, -1.0))
        difference = (after - before) / (2.0 * step)
        assert np.linalg.norm(slopes[k] - difference) < 2e-3 * np.linalg.norm(difference)
