"""The outline search against drawn edges whose place is known."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from morph_dslam.camera import Camera
from morph_dslam.geometry import RigidTransform
from morph_dslam.tracking.estimator import State, moved
from morph_dslam.tracking.outline import Outline, rim
from tests.support.bent_sheet import bent_sheet_model

CAMERA = Camera(640, 480, 520.0, 520.0, 320.0, 240.0)
POSE = RigidTransform(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, 0.55]))


@pytest.fixture(scope="module")
def model():
    return bent_sheet_model()


def drawn(model, state, inner=210, outer=70) -> np.ndarray:
    """A bright sheet on a dark ground, drawn by OpenCV with 1/16 pixel corners and smoothed by 0.7 pixels."""
    nodes = state.camera_from_object.apply(model.positions(state.parameters))
    pixels = CAMERA.project(nodes)
    # Eight times the size: pixel centres go from x to 8 x + 3.5.
    image = np.full((480 * 8, 640 * 8), outer, np.uint8)
    for triangle in model.triangles:
        corners = np.round((8.0 * pixels[triangle] + 3.5) * 16).astype(np.int32)
        cv2.fillConvexPoly(image, corners, inner, shift=4)
    small = cv2.resize(image, (640, 480), interpolation=cv2.INTER_AREA)
    return cv2.GaussianBlur(small, (0, 0), 0.7)


def test_rim_of_a_grid_is_its_boundary(model):
    edges = rim(model.triangles)
    lower, upper = model.nodes.min(axis=0), model.nodes.max(axis=0)
    on_side = [(model.nodes[edges][:, :, k] == side[k]).all(axis=1) for k in range(2) for side in (lower, upper)]
    assert np.any(on_side, axis=0).all()
    length = np.linalg.norm(np.diff(model.nodes[edges], axis=1), axis=2).sum()
    assert length == pytest.approx(2.0 * (upper - lower)[:2].sum(), rel=1e-12)


def test_outline_is_found_where_it_was_drawn(model):
    """Searched for from a state some pixels off, it lies on the projected rim of the true state."""
    true = State(model.default, POSE)
    outline = Outline(model, CAMERA, drawn(model, true), true)
    off = moved(true, np.r_[np.zeros(len(model.parameters)), 0.0, 0.0, 0.01, 0.004, -0.003, 0.0])
    shown = State(np.where(np.arange(len(model.parameters)) == 0, 0.03, model.default), POSE)
    for state in (true, shown):
        start = State(state.parameters, moved(off, np.zeros(len(model.parameters) + 6)).camera_from_object)
        seen = outline.measure(drawn(model, state), start, 14)
        assert seen.valid.mean() > 0.9
        nodes = state.camera_from_object.apply(model.positions(state.parameters))
        edges = CAMERA.project(nodes)[rim(model.triangles)]
        distance = np.array([_to_segments(pixel, edges) for pixel in seen.pixels[seen.valid]])
        assert np.median(distance) < 0.15
        assert np.percentile(distance, 95) < 0.6


def test_normals_point_outwards_on_either_side(model):
    for rotation in (np.diag([1.0, -1.0, -1.0]), np.diag([-1.0, -1.0, 1.0])):
        state = State(model.default, RigidTransform(rotation, np.array([0.0, 0.0, 0.55])))
        image = drawn(model, state)
        seen = Outline(model, CAMERA, image, state).measure(image, state, 6)
        ahead = np.round(seen.pixels + 5.0 * seen.normals).astype(int)
        behind = np.round(seen.pixels - 5.0 * seen.normals).astype(int)
        assert (image[ahead[:, 1], ahead[:, 0]] == 70).mean() > 0.95
        assert (image[behind[:, 1], behind[:, 0]] == 210).mean() > 0.95


def test_wrong_brightness_inside_is_not_taken_for_the_sheet(model):
    """A sheet half as bright as in the reference view is something else."""
    state = State(model.default, POSE)
    outline = Outline(model, CAMERA, drawn(model, state), state)
    assert not outline.measure(drawn(model, state, inner=100, outer=20), state, 14).valid.any()
    assert not outline.measure(np.full((480, 640), 210, np.uint8), state, 14).valid.any()


def _to_segments(point: np.ndarray, segments: np.ndarray) -> float:
    """Distance in pixels of a point (2,) to the nearest of segments (k, 2, 2)."""
    start, along = segments[:, 0], segments[:, 1] - segments[:, 0]
    share = np.clip(((point - start) * along).sum(axis=1) / (along**2).sum(axis=1), 0.0, 1.0)
    return float(np.linalg.norm(start + share[:, None] * along - point, axis=1).min())
