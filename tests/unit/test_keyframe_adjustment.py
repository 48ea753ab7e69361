"""Keyframes compared on an object and adjusted about it: known displacements, poses and deviations."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from morph_dslam.geometry import RigidTransform, SimilarityTransform, rotation_log
from morph_dslam.registration.adjusted_keyframes import AdjustedKeyframes, similarity_of_path
from morph_dslam.registration.increments import moved_pose, moved_similarity, pose_jacobian, similarity_jacobian
from morph_dslam.registration.keyframe_adjustment import KeyframeAdjustment, KnownPlace
from morph_dslam.registration.registration import Axis
from morph_dslam.registration.scene import MapPoints, View, camera_from_object
from morph_dslam.registration.texture import align_patches, carry
from morph_dslam.render.rasteriser import rasterise
from morph_dslam.render.texture import render_textured
from morph_dslam.tracking.patches import normalize_contrast
from tests.support.bent_sheet import grid_triangles
from tests.support.rendered_object import CAMERA, cameras, scanned, wedge
from tests.support.rendered_sequence import printed_texture

WORLD = SimilarityTransform(3.7, Rotation.from_rotvec([0.4, -0.9, 1.3]).as_matrix(), np.array([0.5, -1.2, 2.0]))


@pytest.fixture(scope="module")
def disturbed():
    """Points, and views whose poses are off by 0.6 mm and 0.1 degrees each, of a scan with exact images."""
    points, views = scanned(WORLD, with_images=True)
    rng = np.random.default_rng(1)
    moved = []
    for view in views:
        turn = Rotation.from_rotvec(rng.normal(0.0, np.radians(0.1), 3)).as_matrix()
        shift = rng.normal(0.0, 6e-4, 3) * WORLD.scale
        pose = RigidTransform(turn, shift) @ view.camera_from_world
        noisy = view.pixels + rng.normal(0.0, 0.3, view.pixels.shape)
        moved.append(replace(view, camera_from_world=pose, pixels=noisy))
    return points, moved


@pytest.fixture(scope="module")
def adjusted(disturbed):
    nodes, triangles, _ = wedge()
    points, views = disturbed
    return KeyframeAdjustment(nodes, triangles, CAMERA, points, views, None).adjust(WORLD)


def pose_errors(found, true):
    turns = rotation_log(found.rotation @ true.rotation.T)
    return np.concatenate([turns, found.translation - true.translation])


def test_poses_of_a_path_that_is_off_are_found_by_the_images(disturbed, adjusted):
    _, views = disturbed
    truth = cameras()
    before = [pose_errors(camera_from_object(view, WORLD), true) for view, true in zip(views, truth, strict=True)]
    after = np.array([pose_errors(found, true) for found, true in zip(adjusted.poses, truth, strict=True)])
    assert np.sqrt(np.mean(np.square(before)[:, 3:])) > 4e-4
    # Of how far all keyframes are from the object, the images tell least.
    assert np.sqrt(np.mean(after[:, 3:] ** 2)) < 3e-4
    assert np.sqrt(np.mean(after[:, 3:5] ** 2)) < 0.5e-4
    assert np.sqrt(np.mean(after[:, :3] ** 2)) < np.radians(0.05)
    assert adjusted.rms_px < 0.04


def test_the_covariance_is_of_the_size_of_the_errors(adjusted):
    errors = [pose_errors(found, true) for found, true in zip(adjusted.poses, cameras(), strict=True)]
    deviations = [np.sqrt(np.diag(adjusted.covariance_of(view))) for view in range(len(errors))]
    normalised = np.array(errors) / np.array(deviations)
    assert 0.2 < np.sqrt(np.mean(normalised**2)) < 3.0


def test_the_similarity_of_the_path_has_the_scale_of_the_map(adjusted):
    nodes, _, _ = wedge()
    start = moved_similarity(WORLD, np.array([0.01, 0.01, 0, 0, 0.01, 0, 0]), nodes.mean(axis=0))
    placed, covariance = similarity_of_path(adjusted, start, nodes.mean(axis=0))
    error = np.log(placed.scale / WORLD.scale)
    # Eight views of a path that is off by 0.6 mm everywhere do not tell its scale any better.
    assert abs(error) < 5e-3
    assert abs(error) < 4.0 * np.sqrt(covariance[0, 0])


def test_what_is_known_of_the_scale_counts_by_its_variance(adjusted):
    centre = wedge()[0].mean(axis=0)
    free, of_free = similarity_of_path(adjusted, WORLD, centre)
    known = np.sqrt(of_free[0, 0])
    both, of_both = similarity_of_path(adjusted, WORLD, centre, scale_std=known)
    # The product of two normal distributions of one variance.
    assert np.log(both.scale) == pytest.approx(0.5 * np.log(free.scale))
    assert of_both[0, 0] == pytest.approx(0.5 * known**2)


def test_an_axis_of_revolution_leaves_its_turn_alone(disturbed):
    nodes, triangles, _ = wedge()
    points, views = disturbed
    axis = Axis(nodes.mean(axis=0), np.array([0.0, 0.0, 1.0]))
    found = KeyframeAdjustment(nodes, triangles, CAMERA, points, views, axis).adjust(WORLD)
    turns = [
        np.concatenate([pose.rotation @ axis.direction, np.cross(pose.rotation @ axis.direction, arm)])
        for pose in found.poses
        for arm in [pose.translation - pose.apply(axis.point)]
    ]
    turn = np.concatenate(turns)
    # All poses turned together is what no image can tell.
    units = np.tile([1.0] * 3 + [np.linalg.norm(np.ptp(nodes, axis=0))] * 3, len(found.poses))
    along = (turn / units) @ (found.covariance / np.outer(units, units)) @ (turn / units)
    assert along < 1e-6 * np.trace(found.covariance / np.outer(units, units)) * (turn / units) @ (turn / units)


def corner():
    """Three square faces of a cube of 6 cm that meet in (0, 0, 0.06): nodes, triangles, texture coordinates."""
    u, v = (axis.ravel() / 8.0 for axis in np.meshgrid(np.arange(9), np.arange(9)))
    one = np.ones_like(u)
    faces = [(u, v, one), (v, 0 * u, u), (0 * u, u, v)]
    nodes = 0.06 * np.concatenate([np.column_stack(face) for face in faces])
    triangles = np.concatenate([grid_triangles(9, 9) + 81 * k for k in range(3)])
    coordinates = np.concatenate([np.column_stack([u, v]) * 110.0 + [120.0 * k + 20.0, 20.0] for k in range(3)])
    return nodes, triangles, coordinates


def seen_corner(world):
    """Points of the map beside the faces, and views with images of them."""
    nodes, triangles, coordinates = corner()
    texture = normalize_contrast(printed_texture(400, 520, 3), 31)
    rng = np.random.default_rng(4)
    table = np.column_stack([rng.uniform(-0.15, 0.25, (300, 2)), np.zeros(300)])
    views = []
    for frame, pose in enumerate(cameras(6, turn=0.7)):
        local = pose.apply(nodes)
        drawn = rasterise(CAMERA.project(local), local[:, 2], triangles, CAMERA.height, CAMERA.width)
        image = np.where(drawn.covered, render_textured(drawn, triangles, coordinates, texture), np.uint8(128))
        rotation = pose.rotation @ world.rotation.T
        in_map = RigidTransform(rotation, world.scale * pose.translation - rotation @ world.translation)
        pixels = CAMERA.project(pose.apply(table)) + rng.normal(0.0, 0.1, (300, 2))
        views.append(View(frame, image.astype(np.uint8), in_map, np.arange(300), pixels))
    return MapPoints(world.apply(table), np.zeros((300, 3))), views


def test_a_corner_has_the_size_that_was_known_before_and_no_more_exactly():
    """Scaled about the corner where they meet, plane faces stay where they are: no image of them tells the size."""
    nodes, triangles, _ = corner()
    points, views = seen_corner(WORLD)
    adjustment, centre = KeyframeAdjustment(nodes, triangles, CAMERA, points, views, None), nodes.mean(axis=0)
    top = np.array([0.0, 0.0, 0.06])
    larger = moved_similarity(WORLD, np.array([0.03, 0, 0, 0, 0, 0, 0]), top)
    for place in (WORLD, larger):
        known = KnownPlace(place, np.diag([0.02, 0.05, 0.05, 0.05, 0.02, 0.02, 0.02]) ** 2)
        found, covariance = similarity_of_path(adjustment.adjust(place, known), place, centre)
        assert np.log(found.scale / place.scale) == pytest.approx(0.0, abs=0.004)
        np.testing.assert_allclose(found.apply(top), WORLD.apply(top), atol=2e-3 * WORLD.scale)
        assert np.sqrt(covariance[0, 0]) == pytest.approx(0.02, rel=0.3)


def test_what_was_known_before_gives_way_to_what_images_tell(disturbed):
    """The wedge's warped faces tell its size; before, it was known to 10 %, and off by 1 %."""
    nodes, triangles, _ = wedge()
    points, views = disturbed
    centre = nodes.mean(axis=0)
    adjustment = KeyframeAdjustment(nodes, triangles, CAMERA, points, views, None)
    larger = moved_similarity(WORLD, np.array([0.01, 0, 0, 0, 0, 0, 0]), centre)
    found, covariance = similarity_of_path(adjustment.adjust(larger, KnownPlace(larger)), larger, centre)
    assert abs(np.log(found.scale / WORLD.scale)) < min(0.006, 3.0 * np.sqrt(covariance[0, 0]))


def test_nothing_to_compare_is_no_adjustment():
    nodes, triangles, _ = wedge()
    points, views = scanned(WORLD)
    assert KeyframeAdjustment(nodes, triangles, CAMERA, points, views, None).adjust(WORLD) is None


def test_derivatives_of_points_and_poses_are_those_of_differences():
    nodes, _, _ = wedge()
    pose, step = cameras()[2], np.array([0.3, -0.2, 0.4, 0.02, 0.01, -0.03])
    points, h = pose.apply(nodes), 1e-6
    numeric = (moved_pose(pose, h * step).apply(nodes) - moved_pose(pose, -h * step).apply(nodes)) / (2 * h)
    np.testing.assert_allclose(pose_jacobian(points, pose) @ step, numeric, atol=1e-8)
    _, views = scanned(WORLD)
    seven, centre = np.array([0.1, 0.2, -0.3, 0.1, 0.4, 0.2, -0.5]), nodes.mean(axis=0)
    pair = [camera_from_object(views[2], moved_similarity(WORLD, s * h * seven, centre)) for s in (1, -1)]
    slope = similarity_jacobian(camera_from_object(views[2], WORLD), WORLD, centre) @ seven
    turn = rotation_log(pair[0].rotation @ pair[1].rotation.T) / (2 * h)
    np.testing.assert_allclose(slope[:3], turn, atol=1e-6)
    np.testing.assert_allclose(slope[3:], (pair[0].translation - pair[1].translation) / (2 * h), atol=1e-8)


def test_the_causes_that_keyframes_share_make_up_each_covariance_and_what_two_have_in_common():
    """Poses of eight keyframes err by seven error factors in common, and each a little by itself."""
    rng = np.random.default_rng(5)
    scale = np.tile([1e-3, 1e-3, 1e-3, 3e-4, 3e-4, 3e-4], 8)
    common = scale[:, None] * rng.standard_normal((48, 7))
    own = 0.2 * scale
    covariance = common @ common.T + np.diag(own**2)
    adjusted = AdjustedKeyframes([], [RigidTransform(np.eye(3), np.zeros(3))] * 8, covariance, 0.1)
    error_factors = adjusted.error_factors()
    assert error_factors.shape == (8, 6, 8)
    for k in range(8):
        expected = adjusted.covariance_of(k)
        np.testing.assert_allclose(error_factors[k] @ error_factors[k].T, expected, atol=1e-6 * np.abs(expected).max())
    between = error_factors[1] @ error_factors[6].T / np.outer(scale[:6], scale[:6])
    expected = (common[6:12] @ common[36:42].T) / np.outer(scale[:6], scale[:6])
    assert np.abs(between - expected).max() < 0.15 * np.abs(expected).max()


def test_causes_of_a_body_of_revolution_hold_nothing_of_its_turn():
    rng = np.random.default_rng(6)
    rows = rng.standard_normal((24, 9))
    rows[[2, 8, 14, 20]] = 0.0
    adjusted = AdjustedKeyframes([], [RigidTransform(np.eye(3), np.zeros(3))] * 4, rows @ rows.T, 0.1)
    error_factors = adjusted.error_factors()
    assert np.abs(error_factors[:, 2]).max() < 1e-6
    for k in range(4):
        np.testing.assert_allclose(error_factors[k] @ error_factors[k].T, adjusted.covariance_of(k), atol=1e-6)


def pattern(x, y):
    """A smooth texture between 0 and 255."""
    return 128.0 + 40.0 * np.sin(0.31 * x + 0.17 * y) + 35.0 * np.cos(0.23 * y - 0.11 * x) + 20.0 * np.sin(0.4 * y)


ROWS, COLUMNS = np.mgrid[0:120, 0:160].astype(float)
CENTRES = np.array([[40.2, 50.7], [80.0, 60.4], [100.6, 30.1], [120.3, 90.9]])


def test_a_known_displacement_is_measured_whatever_the_contrast():
    carried = pattern(COLUMNS, ROWS).astype(np.float32)
    image = np.rint(20.0 + 0.7 * pattern(COLUMNS - 0.37, ROWS + 0.61)).astype(np.uint8)
    moves, alike = align_patches(carried, np.ones(carried.shape, dtype=bool), image, CENTRES, 8)
    np.testing.assert_allclose(moves, np.tile([0.37, -0.61], (4, 1)), atol=0.03)
    assert (alike > 0.99).all()


def test_pixels_that_are_not_shown_do_not_count():
    rng = np.random.default_rng(0)
    carried = pattern(COLUMNS, ROWS).astype(np.float32)
    image = np.rint(pattern(COLUMNS - 0.4, ROWS)).astype(np.uint8)
    shown = COLUMNS + 0.3 * ROWS < 100.0
    carried[~shown], image[~shown] = 0.0, rng.integers(0, 255, (~shown).sum())
    # The edge runs through the patch; the pixel beside it takes part in the interpolation of the image.
    moves, alike = align_patches(carried, shown, image, np.array([[80.0, 60.0]]), 8)
    np.testing.assert_allclose(moves[0], [0.4, 0.0], atol=0.1)
    assert alike[0] > 0.95
    _, nothing = align_patches(carried, shown, image, np.array([[140.0, 60.0]]), 8)
    assert nothing[0] == -1.0


@pytest.fixture(scope="module")
def two_views():
    nodes, triangles, _ = wedge()
    _, views = scanned(WORLD, with_images=True)
    drawn = []
    for pose in (cameras()[1], cameras()[4]):
        local = pose.apply(nodes)
        pixels = CAMERA.project(local)
        drawn.append((pixels, local[:, 2], rasterise(pixels, local[:, 2], triangles, CAMERA.height, CAMERA.width)))
    return triangles, drawn, views[1].normalized, views[4].normalized


def test_a_carried_texture_is_what_the_other_view_shows(two_views):
    triangles, ((pixels, depths, first), (_, _, second)), normalized, other = two_views
    carried, shown = np.zeros(normalized.shape, np.float32), np.zeros(normalized.shape, dtype=bool)
    carry(second.triangle_ids, second.weights, triangles, pixels, depths, first.depth, normalized, carried, shown)
    assert shown.sum() > 5000
    assert np.corrcoef(carried[shown], other[shown].astype(float))[0, 1] > 0.75
    # What the first view cannot see, at least a face of the wedge, is not carried.
    assert (second.covered & ~shown).sum() > 500


def test_a_texture_carried_into_its_own_view_stays(two_views):
    triangles, ((pixels, depths, first), _), normalized, _ = two_views
    carried, shown = np.zeros(normalized.shape, np.float32), np.zeros(normalized.shape, dtype=bool)
    carry(first.triangle_ids, first.weights, triangles, pixels, depths, first.depth, normalized, carried, shown)
    assert shown.sum() > 5000
    assert np.abs(carried[shown] - normalized[shown].astype(float)).mean() < 0.01
