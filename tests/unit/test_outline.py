"""The contour of surfaces with a closed form, and the outline search against drawn edges whose place is known."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from scipy.spatial import KDTree

from morph_dslam.camera import Camera
from morph_dslam.geometry import RigidTransform, rotation_exp
from morph_dslam.meshing.generators import block
from morph_dslam.model import Parameter, ReducedModel, SeparatedField
from morph_dslam.tracking.binding import DrawnSurface
from morph_dslam.tracking.estimator import State, moved
from morph_dslam.tracking.outline import Outline, nearest_to_each_other
from morph_dslam.tracking.outline_weight import OutlineBalance, beside_found
from tests.support.bent_sheet import bent_sheet_model
from tests.support.bent_tube import polynomial

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


def outline_of(model, image=None, state=None):
    outline = Outline(model, CAMERA, DrawnSurface.of(model))
    if image is not None and state is not None:
        outline.take_brightness(image, state)
    return outline


def rigid(nodes, triangles) -> ReducedModel:
    """A body that keeps its shape."""
    still = SeparatedField(np.zeros((1, len(nodes), 3)), polynomial([[1.0], [1.0]]))
    return ReducedModel("body", nodes, triangles, (Parameter("load", "ratio", "1", 0.0, 2.0, 0.0),), still)


def inflated(cells, radius):
    """A cube's surface drawn onto a sphere."""
    mesh = block((2.0, 2.0, 2.0), (cells, cells, cells), "hex8")
    used, triangles = np.unique(mesh.surface_triangles(), return_inverse=True)
    nodes = mesh.nodes[used] - mesh.nodes[used].mean(axis=0)
    return rigid(radius * nodes / np.linalg.norm(nodes, axis=1)[:, None], triangles.reshape(-1, 3))


def expected(model, state, occluder_depth=None):
    """Pixels and normals of the points that are looked for in a blank image, of a state."""
    seen = outline_of(model).measure(np.zeros((480, 640), np.uint8), state, 4, occluder_depth)
    pixels = CAMERA.project(seen.points.in_camera(state))
    return pixels[seen.expected], seen.normals[seen.expected]


def test_the_contour_of_a_sphere_is_its_tangent_cone():
    """At distance d a sphere of radius r is seen as a disc of f r / sqrt(d² - r²), wherever it is turned to."""
    model, distance, radius = inflated(40, 0.05), 0.3, 0.05
    for turn in ([0.0, 0.0, 0.0], [0.4, 0.7, -0.3]):
        pose = RigidTransform(rotation_exp(np.array(turn)), np.array([0.0, 0.0, distance]))
        pixels, normals = expected(model, State(np.zeros(1), pose))
        away = pixels - [320.0, 240.0]
        radii = np.hypot(*away.T)
        # A mesh of chords lies inside of its sphere, by a fraction of a pixel.
        assert np.all(np.abs(radii - 520.0 * radius / np.sqrt(distance**2 - radius**2)) < 0.3)
        assert np.all(np.einsum("pk,pk->p", away / radii[:, None], normals) > 0.8)
        angles = np.sort(np.arctan2(*away.T))
        assert len(pixels) > 100
        assert np.diff(angles).max() < 4 * 2.0 * np.pi / len(pixels)


@pytest.mark.parametrize("angle", [0.0, 0.1, 0.25, 0.4, 0.55])
def test_points_on_straight_rims_are_as_far_apart_as_asked_whatever_the_rounding(angle):
    """Rims of 400 and 240 pixels, 1280 in all, hold 160 points 8 pixels apart: exactly 4 steps between candidates.

    A bend of the long rims by a twentieth of a pixel leaves that as it is.
    """
    turn = rotation_exp(np.array([0.0, 0.0, angle]))
    state = State(np.zeros(1), RigidTransform(turn, np.array([0.0003, 0.0002, 0.52])))
    triangles = np.array([[0, 4, 3], [4, 5, 3], [4, 1, 5], [1, 2, 5]])
    corners = [[-0.2, -0.12, 0.0], [0.2, -0.12, 0.0], [0.2, 0.12, 0.0], [-0.2, 0.12, 0.0]]
    for bend in (0.0, 5e-5):
        middles = [[0.0, -0.12 - bend, 0.0], [0.0, 0.12 + bend, 0.0]]
        pixels, normals = expected(rigid(np.array([*corners, *middles]), triangles), state)
        assert len(pixels) == 160
        away, across = (pixels - [320.3, 240.2]) @ turn[:2, :2], normals @ turn[:2, :2]
        for along, outwards, count in ((0, -1.0, 50), (0, 1.0, 50), (1, -1.0, 30), (1, 1.0, 30)):
            places = np.sort(away[outwards * across[:, 1 - along] > 0.9, along])
            assert len(places) == count
            np.testing.assert_allclose(np.diff(places), 8.0, atol=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("ground", [30.0, 90.0], ids=["as bright as the rim", "as bright as within"])
def test_the_outline_of_a_shaded_ball_is_where_it_turns_away(ground):
    """Lit from the camera (Lambert), it is darkest at its rim, which may be as bright as the ground.

    Its disc has a radius of f r / sqrt(d² - r²), and a sight line meets it at an angle whose cosine is in closed form.
    """
    model, distance, radius = inflated(60, 0.05), 0.3, 0.05
    u, v = (np.arange(4 * n) / 4.0 - 0.375 for n in (640, 480))
    squared = ((u[None] - 320.0) ** 2 + (v[:, None] - 240.0) ** 2) / 520.0**2
    # Of sight lines a t with |a|² = 1 + squared, those that meet the ball: its normal there is (a t - c) / r.
    inner = distance**2 - (1.0 + squared) * (distance**2 - radius**2)
    cosine = np.sqrt(np.maximum(inner, 0.0)) / radius / np.sqrt(1.0 + squared)
    fine = np.where(inner > 0.0, 30.0 + 180.0 * cosine, ground).reshape(480, 4, 640, 4).mean(axis=(1, 3))
    noise = np.random.default_rng(2).normal(0.0, 1.0, fine.shape)
    grey = np.clip(np.rint(cv2.GaussianBlur(fine, (0, 0), 0.6) + noise), 0, 255).astype(np.uint8)
    off = RigidTransform(np.eye(3), np.array([0.0005, -0.0005, distance + 0.002]))
    seen = outline_of(model).measure(grey, State(np.zeros(1), off), 14)
    radii = np.hypot(*(seen.pixels[seen.valid] - [320.0, 240.0]).T)
    errors = radii - 520.0 * radius / np.sqrt(distance**2 - radius**2)
    # The steepest place is off by 0.9 pixels, and by 2.8 on the ground that the surface is as bright as within the rim.
    # What is known less well than to half a pixel is left out, so that few errors are larger than twice that.
    assert seen.valid.sum() > 0.5 * seen.expected.sum() > 50
    assert abs(np.mean(errors)) < 0.2
    assert np.percentile(np.abs(errors), 95) < 1.1


def test_the_rims_of_a_hole_and_what_lies_behind_it_count_as_they_are_seen():
    """Of a plate with a square hole, seen from the front, the rims nearer to the camera; the far ones are hidden."""
    mesh = block((0.12, 0.12, 0.01), (12, 12, 1), "hex8")
    nodes = mesh.nodes - mesh.nodes.mean(axis=0)
    corners = mesh.blocks[0].connectivity
    kept = (np.abs(nodes[corners].mean(axis=1)[:, :2]) > 0.02).any(axis=1)
    plate = rigid(nodes, _surface(corners[kept]))
    state = State(np.zeros(1), RigidTransform(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, 0.4])))
    pixels, normals = expected(plate, state)
    off = np.abs(pixels - [320.0, 240.0]).max(axis=1)
    # The near rims outside, at 0.395 m; the hole narrows with the distance, to its far rim at 0.405 m.
    outer, inner = 520.0 * 0.06 / 0.395, 520.0 * 0.02 / 0.405
    is_inner = off < 50.0
    assert 0.15 < is_inner.mean() < 0.45
    np.testing.assert_allclose(off[~is_inner], outer, atol=1e-6)
    np.testing.assert_allclose(off[is_inner], inner, atol=1e-6)
    inwards = np.einsum("pk,pk->p", pixels - [320.0, 240.0], normals) < 0.0
    np.testing.assert_array_equal(inwards, is_inner)
    hidden = np.where(np.arange(640) < 320, np.float32(0.2), np.float32(np.inf)) * np.ones((480, 1), np.float32)
    assert expected(plate, state, hidden)[0][:, 0].min() > 319.0


def _surface(cells):
    """Triangles of the faces (m, 3) that only one of hexahedra (k, 8) has, anticlockwise seen from outside."""
    sides = np.array([[0, 3, 2, 1], [4, 5, 6, 7], [0, 1, 5, 4], [1, 2, 6, 5], [2, 3, 7, 6], [3, 0, 4, 7]])
    faces = cells[:, sides].reshape(-1, 4)
    _, first, count = np.unique(np.sort(faces, axis=1), axis=0, return_index=True, return_counts=True)
    outer = faces[first[count == 1]]
    return np.concatenate([outer[:, [0, 1, 2]], outer[:, [0, 2, 3]]])


def boundary(model, state):
    """The rim of the sheet in the image, as segments (k, 2, 2)."""
    nodes = CAMERA.project(state.camera_from_object.apply(model.positions(state.parameters)))
    edges = np.concatenate([model.triangles[:, [0, 1]], model.triangles[:, [1, 2]], model.triangles[:, [2, 0]]])
    _, first, count = np.unique(np.sort(edges, axis=1), axis=0, return_index=True, return_counts=True)
    return nodes[edges[first[count == 1]]]


def test_outline_is_found_where_it_was_drawn(model):
    """Searched for from a state some pixels off, it lies on the projected rim of the true state."""
    true = State(model.default, POSE)
    outline = outline_of(model, drawn(model, true), true)
    off = moved(true, np.r_[np.zeros(len(model.parameters)), 0.0, 0.0, 0.01, 0.004, -0.003, 0.0])
    shown = State(np.where(np.arange(len(model.parameters)) == 0, 0.03, model.default), POSE)
    for state in (true, shown):
        start = State(state.parameters, moved(off, np.zeros(len(model.parameters) + 6)).camera_from_object)
        seen = outline.measure(drawn(model, state), start, 14)
        assert seen.valid.sum() > 0.9 * seen.expected.sum() > 100
        distance = np.array([_to_segments(pixel, boundary(model, state)) for pixel in seen.pixels[seen.valid]])
        assert np.median(distance) < 0.15
        assert np.percentile(distance, 95) < 0.6


@pytest.mark.parametrize("shift", [0.003, 0.03], ids=["along the same points", "too far for these"])
def test_outline_is_found_again_where_it_has_moved_to(model, shift):
    """The contour of the state before serves as long as it is near; the outline is that of the new state."""
    before = State(model.default, POSE)
    true = moved(before, np.r_[np.zeros(len(model.parameters)), 0.0, 0.0, 0.005, shift, 0.5 * shift, 0.0])
    outline = outline_of(model, drawn(model, before), before)
    first = outline.measure(drawn(model, before), before, 14)
    seen = outline.measure_again(drawn(model, true), true, 7)
    assert seen.valid.sum() > 0.9 * seen.expected.sum() > 100
    distance = np.array([_to_segments(pixel, boundary(model, true)) for pixel in seen.pixels[seen.valid]])
    assert np.median(distance) < 0.15
    assert np.percentile(distance, 95) < 0.6
    assert (seen.points is first.points) == (shift < 0.01)


def test_normals_point_outwards_on_either_side(model):
    for rotation in (np.diag([1.0, -1.0, -1.0]), np.diag([-1.0, -1.0, 1.0])):
        state = State(model.default, RigidTransform(rotation, np.array([0.0, 0.0, 0.55])))
        image = drawn(model, state)
        seen = outline_of(model, image, state).measure(image, state, 6)
        pixels, normals = seen.pixels[seen.valid], seen.normals[seen.valid]
        ahead, behind = (np.round(pixels + away * normals).astype(int) for away in (5.0, -5.0))
        assert (image[ahead[:, 1], ahead[:, 0]] == 70).mean() > 0.95
        assert (image[behind[:, 1], behind[:, 0]] > 200).mean() > 0.95


def test_wrong_brightness_inside_is_not_taken_for_the_sheet(model):
    """A sheet half as bright as in the reference view is something else."""
    state = State(model.default, POSE)
    outline = outline_of(model, drawn(model, state), state)
    assert not outline.measure(drawn(model, state, inner=100, outer=20), state, 14).valid.any()
    assert not outline.measure(np.full((480, 640), 210, np.uint8), state, 14).valid.any()


def test_errors_of_the_outline_are_alike_by_distance_where_points_count(model):
    state = State(model.default, POSE)
    seen = outline_of(model, drawn(model, state), state).measure(drawn(model, state), state, 6)
    seen = seen.weighted(1.0, np.arange(len(seen.pixels)) % 3 > 0)
    balance, counts = OutlineBalance(), np.flatnonzero(seen.valid)
    correlation = balance.correlation(seen).toarray()
    apart = np.linalg.norm(seen.pixels[counts, None] - seen.pixels[counts], axis=2)
    np.testing.assert_allclose(correlation[np.ix_(counts, counts)], np.exp(-apart / balance.outline.length), atol=1e-15)
    others = np.setdiff1d(np.arange(len(seen.pixels)), counts)
    np.testing.assert_array_equal(correlation[others], np.eye(len(correlation))[others])


def test_places_are_matched_that_are_nearest_to_each_other():
    first, second = np.random.default_rng(3).uniform(0.0, 50.0, (2, 40, 2))
    ahead, back = np.asarray(KDTree(second).query(first)[1]), np.asarray(KDTree(first).query(second)[1])
    expected = np.where(back[ahead] == np.arange(40), ahead, -1)
    assert 10 < (expected >= 0).sum() < 40
    np.testing.assert_array_equal(nearest_to_each_other(first, second), expected)
    gone = np.where(np.arange(40)[:, None] % 2 == 0, second, np.nan)
    assert not set(nearest_to_each_other(first, gone)) & set(range(1, 40, 2))


def _to_segments(point: np.ndarray, segments: np.ndarray) -> float:
    """Distance in pixels of a point (2,) to the nearest of segments (k, 2, 2)."""
    start, along = segments[:, 0], segments[:, 1] - segments[:, 0]
    share = np.clip(((point - start) * along).sum(axis=1) / (along**2).sum(axis=1), 0.0, 1.0)
    return float(np.linalg.norm(start + share[:, None] * along - point, axis=1).min())


def test_what_covers_the_texture_beside_a_point_is_told_by_its_five_nearest():
    """Against scipy's search; points of the texture that should not be seen say nothing."""
    rng = np.random.default_rng(2)
    pixels, texture, found = rng.uniform(0, 90, (40, 2)), rng.uniform(0, 90, (200, 2)), rng.random(200) < 0.3
    hidden = rng.random(200) < 0.2
    nearest = KDTree(texture[~hidden]).query(pixels, 5)[1]
    expected = found[~hidden][nearest].sum(axis=1) >= 2
    assert 5 < expected.sum() < 35
    places = np.where(hidden[:, None], np.nan, texture)
    np.testing.assert_array_equal(beside_found(pixels, places, found), expected)
    # Without texture nothing says that something is there; of a single point it is enough.
    assert beside_found(pixels, places[:0], found[:0]).all()
    assert beside_found(pixels, texture[:1], np.array([True])).all()
    assert not beside_found(pixels, texture[:1], np.array([False])).any()
