"""Where unknown loads have taken over from the load of the study, another start leads back to it."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from morph_dslam import Camera, build, make_study
from morph_dslam.geometry import RigidTransform
from morph_dslam.mechanics.solvers.continuation import advance
from morph_dslam.model.reduced_model import spread_over
from morph_dslam.model.unknown_loads import with_unknown_loads
from morph_dslam.registration.starts import shape_starts
from morph_dslam.tracking.anchoring import points_on_object
from morph_dslam.tracking.estimator import BoundPoints, Estimator, Prior, State
from morph_dslam.tracking.frame_estimation import FrameEstimation
from morph_dslam.tracking.hypothesis import PoseHypothesis
from morph_dslam.tracking.measurement import Measurement
from morph_dslam.tracking.options import TrackerOptions

STUDY = {
    "name": "soft block",
    "mesh": {"generator": "block", "size": ["60 mm", "60 mm", "20 mm"], "divisions": [8, 8, 3], "cells": "hex8"},
    "materials": {"silicone": {"law": "neo_hookean", "young": "50 kPa", "poisson": "0.45"}},
    "supports": [{"kind": "fixed", "on": "z_min"}],
    "loads": [
        {
            "kind": "moving_patch",
            "on": "z_max",
            "centre": ["place", "30 mm", "20 mm"],
            "width": "9 mm",
            "force": ["0 N", "0 N", "-1 * push"],
        }
    ],
    "parameters": {
        "push": {"range": ["-2 N", "2 N"], "default": "0 N"},
        "place": {"range": ["10 mm", "50 mm"], "default": "30 mm"},
    },
    "solver": {"threads": 1},
    "sampling": {"training": 32, "held_out": 4, "refined": 0},
    "unknown_loads": {"on": "z_max", "direction": "any", "modes": 25},
}
CAMERA = Camera(640, 480, 560.0, 560.0, 320.0, 240.0)
POSE = RigidTransform(np.array([[1.0, 0.0, 0.0], [0.0, -0.8, -0.6], [0.0, 0.6, -0.8]]), np.array([-0.03, 0.03, 0.25]))
PULL = np.array([-1.5, 0.015])


@pytest.fixture(scope="module")
def pulled():
    """The model, and points of its top where finite elements have them under a pull, before a camera."""
    study = make_study(STUDY)
    model = with_unknown_loads(build(study))
    problem = study.problem()
    moved = problem.nodal_displacement(advance(problem, problem.initial_state(), PULL)[-1].dofs)
    upper = (model.nodes[model.triangles][:, :, 2] > 0.0199).all(axis=1)
    spread = spread_over(model.nodes, model.triangles[upper], 300)
    surface = type(spread)(np.flatnonzero(upper)[spread.triangles], spread.weights)
    points = BoundPoints.from_surface(model, surface)
    places = points.rest + np.einsum("pc,pcx->px", surface.weights, moved[model.triangles[surface.triangles]])
    pixels = CAMERA.project(POSE.apply(places)) + np.random.default_rng(0).normal(0.0, 0.05, (300, 2))
    return model, points, pixels


@pytest.mark.slow
def test_the_load_of_the_study_is_found_where_unknown_loads_have_taken_over(pulled):
    """A start at another place ends with a push there, and a larger unknown pull; all is explained to a tenth pixel."""
    model, points, pixels = pulled
    n, ones = len(model.parameters), np.ones(len(points))
    known = Prior(np.zeros(n), np.zeros((n, n)), POSE, np.diag([1e6] * 3 + [1e8] * 3))
    estimator, every = Estimator(model, CAMERA), ones > 0.0
    assert estimator.loads is not None
    estimator.loads.squared_px = 0.05**2
    start = State(np.array([0.3, 0.045, *np.zeros(25)]), POSE)
    stuck = estimator.estimate(points, pixels, ones, start, prior=known)
    assert stuck.state.parameters[0] > 0.0
    assert stuck.sigma_px < 0.1
    measured = Measurement(pixels, pixels, every, every, ones)
    estimation = FrameEstimation(estimator, SimpleNamespace(points=points), TrackerOptions())  # type: ignore[arg-type]
    found = estimation.search_other_shapes(PoseHypothesis(stuck, every, measured, ones, known)).estimate
    assert found.cost < 0.9 * stuck.cost
    push, place = found.state.parameters[:2]
    assert push == pytest.approx(PULL[0], rel=0.1)
    assert place == pytest.approx(PULL[1], abs=1e-3)
    # What is right stays.
    right = PoseHypothesis(found, every, measured, ones, known)
    assert estimation.search_other_shapes(right) is right


@pytest.mark.slow
def test_shapes_to_start_from_are_the_study_s_without_unknown_loads(pulled):
    model, _, _ = pulled
    shapes = np.array(shape_starts(model))
    assert shapes.shape == (1 + 3**2, 2 + 25)
    assert not shapes[:, 2:].any()
    np.testing.assert_allclose(shapes[1:, 0].max(), 4.0 / 3.0)


def test_no_map_point_that_an_unknown_load_may_move_holds_the_camera():
    """Points of the top near its edge, which the study's load moves little, and of the bottom, which is held."""
    coarse = {
        "mesh": STUDY["mesh"] | {"divisions": [4, 4, 2]},
        "sampling": {"training": 12, "held_out": 4, "refined": 0},
        "unknown_loads": STUDY["unknown_loads"] | {"modes": 12},
    }
    model = with_unknown_loads(build(make_study(STUDY | coarse)))
    where = np.array([[0.002, 0.002, 0.02], [0.03, 0.03, 0.02], [0.03, 0.03, 0.0]])
    place = SimpleNamespace(world_from_object=RigidTransform(np.eye(3), np.zeros(3)))
    on_object, movable = points_on_object(where, place, model)  # type: ignore[arg-type]
    np.testing.assert_array_equal(on_object, [True, True, True])
    np.testing.assert_array_equal(movable, [True, True, False])
