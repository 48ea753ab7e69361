"""Kinematics of the grips against closed forms and finite differences."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from morph_dslam.mechanics.gripped_sheet import mesh_lines
from morph_dslam.mechanics.grips import ARC_SLOPE, Grips

GRIPS = Grips(length=0.42, depth=0.012, height=0.034, centre_left=0.05, centre_right=0.06)


def test_arc_slope_is_that_of_a_shallow_parabola() -> None:
    """z = h (1 - 4 x^2 / L^2): end slope 4 h / L over the weighted mean height, integrated numerically."""
    x = np.linspace(-0.5, 0.5, 200_001) * GRIPS.free_length
    height = 1.0 - 4.0 * x**2 / GRIPS.free_length**2
    weight = np.cos(np.pi * x / GRIPS.free_length) ** 2
    mean = np.sum(weight * height) / np.sum(weight)
    assert pytest.approx(4.0 / mean, rel=1e-6) == ARC_SLOPE


def test_prescribed_motion_gradient_matches_differences() -> None:
    coordinates = np.array([0.03, 0.7, 0.1, -0.2])
    gradient = GRIPS.prescribed_motion_gradient(coordinates)
    for k in range(4):
        step = np.zeros(4)
        step[k] = 1e-6
        forward, backward = (GRIPS.prescribed_motion(coordinates + step), GRIPS.prescribed_motion(coordinates - step))
        assert gradient[:, k] == pytest.approx((forward - backward) / 2e-6, abs=1e-8)


def test_grips_move_rigidly_about_their_inner_edges() -> None:
    left = np.array([[-0.21, 0.03, 0.0], [-0.198, 0.067, 0.0]])
    right = np.array([[0.21, 0.05, 0.0], [0.198, 0.07, 0.0]])
    motion = np.array([0.3, 0.2, 0.4, 0.01, 0.05])
    moved = GRIPS.positions(motion, left, right)
    # Arching to +z: the left grip's slope rises towards the middle.
    rotation = Rotation.from_euler("x", -0.2) * Rotation.from_euler("z", 0.05) * Rotation.from_euler("y", -0.3)
    centre = np.array([-0.198, 0.05, 0.0])
    assert moved[:2] == pytest.approx(rotation.apply(left - centre) + centre + [0.005, 0.0, 0.0], abs=1e-14)
    assert np.linalg.norm(moved[3] - moved[2]) == pytest.approx(np.linalg.norm(right[1] - right[0]), rel=1e-12)


def test_grips_approach_each_other() -> None:
    left, right = np.array([[-0.198, 0.05, 0.0]]), np.array([[0.198, 0.06, 0.0]])
    moved = GRIPS.positions(np.array([0.1, 0.2, 0.3, 0.02, 0.0]), left, right)
    assert moved[1, 0] - moved[0, 0] == pytest.approx(0.396 - 0.02, abs=1e-14)


def test_velocity_matches_differences_of_another_step() -> None:
    left, right = np.array([[-0.21, 0.03, 0.0]]), np.array([[0.21, 0.07, 0.0]])
    motion = np.array([0.3, 0.2, 0.4, 0.01, 0.05])
    velocity = GRIPS.velocity(motion, left, right)
    for k in range(5):
        step = np.zeros(5)
        step[k] = 1e-3
        # A fourth-order stencil on a step a hundred times as long.
        at = [GRIPS.positions(motion + n * step, left, right) for n in (-2, -1, 1, 2)]
        slope = (at[0] - 8.0 * at[1] + 8.0 * at[2] - at[3]) / 12e-3
        assert velocity[..., k] == pytest.approx(slope, abs=1e-9)


def test_mesh_lines_follow_the_grips() -> None:
    x, y = mesh_lines(GRIPS, 0.297, (12, 10))
    assert x[[0, 1, -2, -1]] == pytest.approx([-0.21, -0.198, 0.198, 0.21])
    for line in (0.05 - 0.017, 0.05 + 0.017, 0.06 - 0.017, 0.06 + 0.017):
        assert np.abs(y - line).min() < 1e-12
    assert np.all(np.diff(x) > 0)
    assert np.all(np.diff(y) > 0)
