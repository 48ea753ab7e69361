"""Images of a rolling shutter as of one instant: against motions and pictures in closed form."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from morph_dslam.camera import Camera
from morph_dslam.registration.rectification import inverse_depths_at, rectified_image
from morph_dslam.slam.rolling_shutter import middle_row_pixels

CAMERA = Camera(160, 120, 140.0, 145.0, 80.0, 58.0, readout_s=0.04)
#: Radians and metres a second: the picture moves by up to 16 pixels between its first row and its last.
TWIST = np.array([0.5, -0.9, 1.2, 0.8, 1.1, -0.4])
DEPTH = 0.6


def moved(points, seconds):
    """Points that stand still, in the axes of the camera after some time."""
    return points @ Rotation.from_rotvec(seconds * TWIST[:3]).as_matrix().T + seconds * TWIST[3:]


def pattern(x, y):
    """A smooth print of the plane z = DEPTH."""
    return 128.0 + 50.0 * np.sin(40.0 * x) + 50.0 * np.cos(35.0 * y + 9.0 * x)


def pictured(seconds):
    """The plane's picture (h, w), each row at its instant (h,) after the middle row's: by rays through the pixels."""
    v, u = np.mgrid[0 : CAMERA.height, 0 : CAMERA.width]
    image = np.empty(v.shape)
    for row, time in enumerate(seconds):
        turn, shift = Rotation.from_rotvec(time * TWIST[:3]).as_matrix(), time * TWIST[3:]
        rays = CAMERA.rays(np.column_stack([u[row], v[row]]).astype(float)) @ turn
        eye = -turn.T @ shift
        reach = (DEPTH - eye[2]) / rays[:, 2]
        image[row] = pattern(eye[0] + reach * rays[:, 0], eye[1] + reach * rays[:, 1])
    return image


def test_the_motion_is_that_of_projected_points():
    points = np.random.default_rng(0).uniform([-0.3, -0.2, 0.4], [0.3, 0.2, 2.0], (50, 3))
    pixels, step = CAMERA.project(points), 1e-5
    expected = (CAMERA.project(moved(points, step)) - CAMERA.project(moved(points, -step))) / (2.0 * step)
    quick = replace(CAMERA, readout_s=1e-7)
    rows = (pixels[:, 1] - 0.5 * (CAMERA.height - 1)) / CAMERA.height
    moves = pixels - middle_row_pixels(quick, np.eye(4), TWIST, points, pixels)
    assert moves / (quick.readout_s * rows[:, None]) == pytest.approx(expected, rel=1e-6, abs=1e-4)


def test_a_picture_and_its_pixels_are_those_of_the_middle_row():
    rows = (np.arange(CAMERA.height) - 0.5 * (CAMERA.height - 1)) / CAMERA.height
    recorded, expected = pictured(CAMERA.readout_s * rows), pictured(0.0 * rows)
    known = np.array([[40.0, 30.0], [120.0, 90.0]])
    found = rectified_image(np.rint(recorded).astype(np.uint8), CAMERA, TWIST, known, np.full(2, DEPTH)).astype(float)
    inside = (slice(12, -12), slice(12, -12))
    assert np.abs(recorded - expected)[inside].mean() > 5.0
    assert np.abs(found - expected)[inside].mean() < 1.5
    points = CAMERA.rays(np.array([[40.0, 20.0], [100.0, 70.0], [130.0, 100.0]])) * DEPTH
    before, seen = CAMERA.project(points), CAMERA.project(points)
    for _ in range(20):  # a point is seen in the row that it has moved to
        seconds = CAMERA.readout_s * (seen[:, 1] - 0.5 * (CAMERA.height - 1)) / CAMERA.height
        seen = np.vstack([CAMERA.project(moved(p[None], t)) for p, t in zip(points, seconds, strict=True)])
    assert np.linalg.norm(seen - before, axis=1).max() > 3.0
    found = middle_row_pixels(CAMERA, np.eye(4), TWIST, CAMERA.rays(seen) * DEPTH, seen)
    assert found == pytest.approx(before, abs=0.5)


def test_depths_are_those_of_the_points_around_and_far_away_without_any():
    known = np.array([[10.0, 10.0], [12.0, 10.0], [11.0, 12.0], [100.0, 90.0], [102.0, 90.0], [101.0, 92.0]])
    depths = np.array([1.0, 1.0, 1.1, 4.0, 4.0, 4.2])
    near = np.array([True, True, True, False, False, False])
    assert inverse_depths_at(np.array([[11.0, 11.0]]), known[near], depths[near]) == pytest.approx([1.0])
    assert inverse_depths_at(np.array([[0.0, 0.0]]), known, -depths) == pytest.approx([0.0])
