"""Attitudes in which a surface starts, against directions that they must hold."""

import numpy as np
import pytest

from morph_dslam.registration.icp import Axis, find_planes
from morph_dslam.registration.mesh import TURNS, attitudes

NORMAL = np.array([2.0, -3.0, 6.0]) / 7.0


def test_body_stands_on_each_of_its_six_sides_in_all_turns():
    rotations = attitudes(None, NORMAL)
    for side in (*np.eye(3), *-np.eye(3)):
        upright = [rotation for rotation in rotations if np.allclose(rotation @ side, NORMAL, atol=1e-9)]
        assert len(upright) >= TURNS
        relative = [np.trace(upright[0].T @ other) for other in upright[:TURNS]]
        turns = 1.0 + 2.0 * np.cos(2.0 * np.pi * np.arange(TURNS) / TURNS)
        np.testing.assert_allclose(np.sort(relative), np.sort(turns), atol=1e-9)
    for rotation in rotations:
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(rotation) == pytest.approx(1.0)


def test_axis_of_revolution_stands_upright_either_way_and_points_everywhere_once():
    axis = Axis(np.zeros(3), np.array([0.0, 0.6, 0.8]))
    directions = np.array([rotation @ axis.direction for rotation in attitudes(axis, NORMAL)])
    for sign in (1.0, -1.0):
        assert np.linalg.norm(directions - sign * NORMAL, axis=1).min() < 1e-9
    between = np.linalg.norm(directions[:, None] - directions[None], axis=2)
    assert between[~np.eye(len(between), dtype=bool)].min() > 0.09
    everywhere = np.random.default_rng(0).normal(size=(500, 3))
    everywhere /= np.linalg.norm(everywhere, axis=1)[:, None]
    nearest = np.linalg.norm(everywhere[:, None] - directions[None], axis=2).min(axis=1)
    assert np.degrees(2.0 * np.arcsin(nearest.max() / 2.0)) < 40.0


def test_largest_plane_is_found_among_clutter_and_none_where_there_is_none():
    rng = np.random.default_rng(1)
    basis = np.linalg.svd(NORMAL[None])[2][1:]
    table = rng.uniform(-1.0, 1.0, (400, 2)) @ basis + 0.002 * rng.normal(size=(400, 1)) * NORMAL
    clutter = rng.uniform(-1.0, 1.0, (150, 3))
    points = np.concatenate([table, clutter])
    planes = find_planes(points)
    found = planes.largest_normal(points)
    assert found is not None
    assert abs(found @ NORMAL) > np.cos(np.radians(1.0))
    # What is taken out is the table, and of the clutter only what lies in it.
    assert np.mean(np.isin(np.arange(400), planes.taken_out[0])) > 0.95
    assert np.all(np.abs(points[planes.taken_out[0]] @ NORMAL) < 0.05)
    cloud = rng.normal(size=(400, 3))
    assert find_planes(cloud).largest_normal(cloud) is None
