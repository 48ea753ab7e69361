"""Where a registered object is in a camera that was found in the map, and how well that is known."""

from dataclasses import replace

import numpy as np
import pytest

from morph_dslam.camera import Camera
from morph_dslam.errors import RegistrationError
from morph_dslam.geometry import RigidTransform, SimilarityTransform, rotation_exp
from morph_dslam.model import SeparatedField
from morph_dslam.model.functions import ParameterFunctions
from morph_dslam.registration.registration import MapRegistration
from morph_dslam.slam.pose import PoseEstimate
from morph_dslam.slam.rigid_map import GOOD, Keyframe, RigidMap
from morph_dslam.tracking.anchoring import Anchor, points_on_object
from morph_dslam.tracking.state import State, moved
from tests.support.bent_sheet import bent_sheet_model

CENTRE = np.array([0.01, 0.02, 0.05])


def similarity(rng):
    return SimilarityTransform(2.3, rotation_exp(rng.normal(size=3)), rng.normal(size=3))


def camera_pose(rng):
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation_exp(rng.normal(size=3)), [0.1, 0.2, 1.5]
    return pose


def test_a_point_of_the_object_is_seen_where_the_map_has_it():
    """Its direction in the camera is that of its place in the map; its distance is that in metres."""
    rng = np.random.default_rng(0)
    placed, pose = similarity(rng), camera_pose(rng)
    place = MapRegistration(placed, CENTRE, np.eye(7) * 1e-8)
    known = place.pose_prior(PoseEstimate(pose, np.eye(6) * 1e-8, np.ones(5, dtype=bool), 0.3))
    points = 0.1 * rng.normal(size=(6, 3))
    in_map_units = placed.apply(points) @ pose[:3, :3].T + pose[:3, 3]
    np.testing.assert_allclose(known.pose.apply(points), in_map_units / 2.3, atol=1e-12)


def test_the_covariance_is_that_of_samples():
    """30 000 registrations and cameras with normally distributed errors, moved one by one."""
    rng = np.random.default_rng(1)
    placed, pose = similarity(rng), camera_pose(rng)
    of_place = np.diag(rng.uniform(1.0, 3.0, 7)) * 1e-8
    of_place[0, 3] = of_place[3, 0] = 0.8e-8
    of_camera = np.diag(rng.uniform(1.0, 3.0, 6)) * 1e-8
    found = PoseEstimate(pose, of_camera, np.ones(5, dtype=bool), 0.3)
    known = MapRegistration(placed, CENTRE, of_place).pose_prior(found)
    middle, away = placed.apply(CENTRE), []
    for place_error, camera_error in zip(
        rng.multivariate_normal(np.zeros(7), of_place, 30_000),
        rng.multivariate_normal(np.zeros(6), of_camera, 30_000),
        strict=True,
    ):
        scale = placed.scale * np.exp(place_error[0])
        rotation = rotation_exp(place_error[1:4]) @ placed.rotation
        shift = middle + place_error[4:] - scale * rotation @ CENTRE
        turn = rotation_exp(camera_error[:3])
        camera_rotation = turn @ pose[:3, :3]
        camera_shift = turn @ pose[:3, 3] + camera_error[3:]
        sample = RigidTransform(camera_rotation @ rotation, (camera_rotation @ shift + camera_shift) / scale)
        away.append(known.away(sample))
    expected = np.cov(np.array(away).T)
    np.testing.assert_allclose(known.covariance, expected, atol=0.03 * np.abs(expected).max())
    lasting = known.lasting @ known.lasting.T
    assert (np.linalg.eigvalsh(known.covariance - lasting) > 0.0).all()


def test_the_increment_to_another_pose_is_the_one_that_leads_there():
    rng = np.random.default_rng(2)
    known = MapRegistration(similarity(rng), CENTRE, np.eye(7) * 1e-8).pose_prior(
        PoseEstimate(camera_pose(rng), np.eye(6) * 1e-8, np.ones(5, dtype=bool), 0.3)
    )
    step = 0.1 * rng.normal(size=6)
    there = moved(State(np.zeros(0), known.pose), step).camera_from_object
    np.testing.assert_allclose(known.away(there), step, atol=1e-12)


def sheet_map():
    """A sheet of 420 mm that turns about one end, points along it, and points off it, in map units."""
    sheet = bent_sheet_model(5, 3)
    powers = np.array([[0, 0, 0], [1, 0, 0]])
    functions = ParameterFunctions(-np.ones(3), np.ones(3), powers, np.array([[0.0], [1.0]]))
    lift = np.zeros((1, len(sheet.nodes), 3))
    lift[0, :, 2] = 0.1 * (sheet.nodes[:, 0] + 0.21)
    parameters = tuple(replace(p, lower=-1.0, upper=1.0, default=0.0) for p in sheet.parameters)
    model = replace(sheet, displacement=SeparatedField(lift, functions), parameters=parameters)
    x = np.concatenate([np.linspace(-0.2, 0.2, 41), np.linspace(-0.2, 0.2, 10)])
    points = np.column_stack([x, np.zeros(51), np.r_[np.zeros(41), np.full(10, -0.03)]])
    place = MapRegistration(
        SimilarityTransform(3.0, rotation_exp(np.array([0.3, -0.2, 0.5])), np.array([1.0, 2.0, 3.0])),
        np.zeros(3),
        np.eye(7) * 1e-8,
    )
    return model, place, place.world_from_object.apply(points), x


def test_only_what_can_move_is_taken_out_of_the_scene():
    model, place, positions, x = sheet_map()
    on_object, movable = points_on_object(positions, place, model)
    # The sheet is 514 mm large. What lies 30 mm off it is not on it; what moves by less than 2.6 mm does not
    # move: that is 39 mm from the end at two thirds of the largest turn. Samples are a few mm apart.
    assert on_object[:41].all()
    assert not on_object[41:].any()
    assert movable[:41][x[:41] > -0.165].all()
    assert not movable[:41][x[:41] < -0.177].any()


def test_an_anchor_keeps_the_scene_and_needs_to_know_how_well_the_place_is_known():
    model, place, positions, _ = sheet_map()
    camera = Camera(320, 240, 300.0, 300.0, 160.0, 120.0)
    rigid_map = RigidMap()
    ids = rigid_map.add_points(positions, np.zeros((51, 2)), 0, GOOD)
    normalized = np.full((240, 320), 128, dtype=np.uint8)
    rigid_map.add_keyframe(Keyframe(0, 0.0, normalized, np.eye(4), ids, np.zeros((51, 2))))
    expected = points_on_object(positions, place, model)[1]
    blind = MapRegistration(place.world_from_object, place.centre, None)
    with pytest.raises(RegistrationError, match="does not say how well the object's place is known"):
        Anchor(rigid_map, camera, {"sheet": (blind, model)})
    assert blind.pose_covariance(RigidTransform.identity()) is None
    with pytest.raises(RegistrationError, match="'sheet' and 'again' are registered in the same place"):
        Anchor(rigid_map, camera, {"sheet": (place, model), "again": (place, model)})
    anchor = Anchor(rigid_map, camera, {"sheet": (place, model)})
    assert (anchor.n_movable, anchor.n_scene) == (expected.sum(), (~expected).sum())
    np.testing.assert_array_equal(rigid_map.good, ids[~expected])
