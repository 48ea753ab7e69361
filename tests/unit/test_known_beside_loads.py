"""Whether images refute a sensor beside unknown loads: a cantilever strip, in closed form (Euler and Bernoulli)."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from morph_dslam.camera import Camera
from morph_dslam.geometry import RigidTransform
from morph_dslam.model import Parameter, ReducedModel, SeparatedField
from morph_dslam.model.functions import ParameterFunctions
from morph_dslam.model.reduced_model import spread_over
from morph_dslam.model.unknown_loads import UnknownLoads, packed_root, with_unknown_loads
from morph_dslam.tracking.covariance import BoundPart
from morph_dslam.tracking.estimator import BoundPoints, Estimator, Prior, State
from morph_dslam.tracking.frame_estimation import FrameEstimation
from morph_dslam.tracking.hypothesis import PoseHypothesis
from morph_dslam.tracking.known_check import refuted_values
from morph_dslam.tracking.measurement import PATCH_WINDOW, Measurement
from morph_dslam.tracking.options import TrackerOptions
from morph_dslam.tracking.systematic_errors import SystematicErrors

LENGTH, STIFFNESS, MOST = 0.06, 6.4e-5, 0.01  # m, N m2, N
CAMERA = Camera(640, 480, 560.0, 560.0, 320.0, 240.0)
POSE = RigidTransform(np.array([[1.0, 0.0, 0.0], [0.0, -0.8, -0.6], [0.0, 0.6, -0.8]]), np.array([-0.03, 0.0, 0.12]))
NOISE_PX, SENSOR_STD = 0.05, 1e-4


def deflection(x, place):
    """Of a strip that is clamped at x = 0, by a unit force at a place."""
    near = np.minimum(x, place)
    return near**2 * (3.0 * np.maximum(x, place) - near) / (6.0 * STIFFNESS)


def strip(places):
    """Pulled down at its end, with unknown forces at some places, m, each of a compliance of 1 J."""
    x, y = (grid.ravel() for grid in np.meshgrid(np.linspace(0.0, LENGTH, 13), [0.0, 0.006, 0.012], indexing="ij"))
    first = np.array([3 * i + j for i in range(12) for j in range(2)])
    triangles = np.concatenate([first[:, None] + [0, 3, 4], first[:, None] + [0, 4, 1]])
    mode, upper = np.zeros((1, 39, 3)), np.array([MOST])
    mode[0, :, 2] = -deflection(x, LENGTH)
    linear = ParameterFunctions(-upper, upper, np.ones((1, 1), dtype=np.int64), np.array([[MOST]]))
    constant = ParameterFunctions(-upper, upper, np.zeros((1, 1), dtype=np.int64), np.ones((1, 1)))
    units = 1.0 / np.sqrt([deflection(place, place) for place in places])
    moved = np.zeros((39, len(places), 3))
    moved[:, :, 2] = -units * deflection(x[:, None], np.array(places))
    compliance = np.outer(units, units) * deflection(np.array(places)[:, None], np.array(places))
    responses = {
        "displacement": SeparatedField(moved.reshape(1, 39, -1), constant),
        "compliance_root": SeparatedField(packed_root(compliance).reshape(1, 1, -1), constant),
    }
    count = len(places)
    loads = UnknownLoads("", False, np.arange(39), np.ones((39, 3, count)), np.ones((count, 6)), responses)
    pull = Parameter("pull", "force", "mN", -MOST, MOST, 0.0, "force at the end")
    nodes, field = np.column_stack([x, y, np.zeros(39)]), SeparatedField(mode, linear)
    return with_unknown_loads(replace(ReducedModel("strip", nodes, triangles, (pull,), field), unknown_loads=loads))


def refuted_frames(model, offset, push, seed, frames=8):
    """In how many frames a sensor that is off by ``offset``, N, is refuted, and halfway a load of ``push`` begins."""
    points = BoundPoints.from_surface(model, spread_over(model.nodes, model.triangles, 150))
    n, ones, random = len(model.parameters), np.ones(150), np.random.default_rng(seed)
    held = Prior(np.zeros(n), np.zeros((n, n)), POSE, np.diag([1e8] * 3 + [1e10] * 3))
    estimator, state, found = Estimator(model, CAMERA), State(model.default, POSE), 0
    reference: Any = SimpleNamespace(points=points, all_points=points)
    estimation = FrameEstimation(estimator, reference, TrackerOptions())
    part = BoundPart(slice(None), state, np.zeros((n + 6, 1)))
    systematic = SystematicErrors(estimator, points, [part], PATCH_WINDOW)
    for k in range(frames):
        truth = model.default.copy()
        truth[0], truth[2] = 0.4 * MOST * np.sin(k), push if k >= frames // 2 else 0.0
        exact = CAMERA.project(points.in_camera(State(truth, POSE)))
        pixels = exact + NOISE_PX * random.standard_normal(exact.shape)
        estimator.known.tell({"pull": (truth[0] + offset + SENSOR_STD * random.standard_normal(), SENSOR_STD)})
        estimator.known.learn(NOISE_PX)
        estimate = estimator.estimate(points, pixels, ones, state, prior=held)
        measurement = Measurement(pixels, pixels, ones > 0.0, ones > 0.0, ones)
        hypothesis = PoseHypothesis(estimate, ones > 0.0, measurement, ones, held)
        found += len(refuted_values(hypothesis, estimation.beside, systematic, None, 0.0, False))
        assert estimator.loads is not None
        estimator.loads.learn(estimate.state.parameters, estimate.covariance, estimate.sigma_px)
        state = estimate.state
    return found


@pytest.mark.parametrize("places", [(0.01, 0.02, 0.03, 0.04, 0.05, 0.06), (0.01, 0.02)])
def test_a_right_sensor_is_not_refuted_where_something_begins_to_press(places):
    model = strip(places)
    assert [refuted_frames(model, 0.0, 3e-3, seed) for seed in range(3)] == [0, 0, 0]


def test_a_wrong_sensor_is_refuted_where_no_load_does_what_its_parameter_does():
    """Loads near the clamp leave the outer part straight, which a force at the end bends."""
    model = strip((0.01, 0.02))
    assert [refuted_frames(model, 0.3 * MOST, 3e-3, seed) for seed in range(3)] == [8, 8, 8]


def test_a_sensor_of_a_force_is_not_refuted_where_an_unknown_one_may_act_at_the_same_place():
    """A wrong one and a force of the difference, which nobody knows, are the same to all images."""
    assert refuted_frames(strip((0.02, 0.04, 0.06)), 0.3 * MOST, 0.0, 0) == 0
