"""Starts of a registration that one view gives."""

import numpy as np
import pytest

from morph_dslam.geometry import RigidTransform, rotation_exp
from morph_dslam.registration.scene import View
from morph_dslam.registration.view_search import placed

POSE = RigidTransform(rotation_exp(np.array([0.4, -0.3, 0.8])), np.array([0.1, -0.05, 0.9]))
CAMERA_FROM_WORLD = RigidTransform(rotation_exp(np.array([-0.2, 0.5, 0.1])), np.array([0.3, 0.2, -0.4]))
VIEW = View(0, np.zeros((2, 2), np.uint8), CAMERA_FROM_WORLD, np.empty(0, np.int64), np.empty((0, 2)))
NODES = np.random.default_rng(0).uniform(-0.05, 0.05, (20, 3))


@pytest.mark.parametrize("metric", [True, False])
def test_an_object_is_placed_on_its_sight_line_wherever_its_mesh_has_its_origin(metric):
    """0.95 map units a metre: its middle is seen in the same direction at 0.95 of the distance, in its own size."""
    places = []
    for origin in (np.zeros(3), np.array([2.0, -1.0, 0.5])):
        nodes, pose = NODES - origin, RigidTransform(POSE.rotation, POSE.translation + POSE.rotation @ origin)
        local = CAMERA_FROM_WORLD.apply(placed(pose, VIEW, 0.95, nodes.mean(axis=0), metric).apply(nodes))
        places.append(local)
        np.testing.assert_allclose(local.mean(axis=0), 0.95 * POSE.apply(NODES.mean(axis=0)), atol=1e-12)
    np.testing.assert_allclose(places[1], places[0], atol=1e-12)
    size = np.linalg.norm(np.ptp(places[0], axis=0))
    turned = NODES @ POSE.rotation.T
    assert size == pytest.approx((1.0 if metric else 0.95) * np.linalg.norm(np.ptp(turned, axis=0)))
