"""Landmarks in several cameras of a rig: how exactly they place an object, and cameras that contradict each other."""

from dataclasses import replace

import numpy as np
import pytest

from morph_dslam.camera import Camera
from morph_dslam.errors import ArgumentError, RegistrationError
from morph_dslam.geometry import RigidTransform, rotation_exp, rotation_log
from morph_dslam.io.landmarks import Landmarks
from morph_dslam.registration.landmarks import register_landmarks
from morph_dslam.registration.messages import CamerasContradict, PoorFit
from morph_dslam.sources import Frame
from morph_dslam.tracking.rig import RigCamera
from morph_dslam.tracking.setup import TrackedObject
from morph_dslam.tracking.state import State
from morph_dslam.tracking.synchronized import SynchronizedFrames
from tests.support.bent_sheet import bent_sheet_model
from tests.support.measured_points import bound_points

MODEL, SIGMA = bent_sheet_model(22, 16), 0.5
LEFT = RigCamera(Camera(640, 480, 528.0, 528.0, 320.0, 240.0), RigidTransform.identity())
#: 8 cm to the right, turned inwards by 6 degrees, of another make.
RIGHT = RigCamera(
    Camera(800, 600, 700.0, 690.0, 400.0, 290.0),
    RigidTransform(rotation_exp(np.array([0.0, 0.1, 0.0])), np.array([-0.08, 0.0, 0.0])),
)
POSE = RigidTransform(rotation_exp(np.array([0.2, -0.3, 0.05])) @ np.diag([1.0, -1.0, -1.0]), np.array([0, 0, 0.6]))
TRUTH = State(np.array([0.035, 0.3, 0.1]), POSE)


def seen(part, points, parameters=TRUTH.parameters, pose=POSE):
    """Pixels (k, 2), by the camera alone."""
    there = points.rest + points.field.value(parameters)
    return part.camera.project((part.camera_from_rig @ pose).apply(there))


def landmarks(part, points, rng, sigma=SIGMA):
    pixels = seen(part, points)
    return Landmarks(points.rest, pixels + sigma * rng.standard_normal(pixels.shape))


def turned(part, degrees):
    """A camera that is stated to look this much further to the side than it does."""
    turn = RigidTransform(rotation_exp(np.array([0.0, np.deg2rad(degrees), 0.0])), np.zeros(3))
    return RigCamera(part.camera, turn @ part.camera_from_rig)


def steps_of(found):
    """Parameters (3,), rotation vector (3,) and translation (3,) of a state from the true one."""
    pose = found.camera_from_object
    turn, shift = rotation_log(pose.rotation @ POSE.rotation.T), pose.translation - POSE.translation
    return np.concatenate([found.parameters - TRUTH.parameters, turn, shift])


def deviations_by_differences(sights):
    """Standard deviations (9,) of independent errors of pixels, by differences of projections."""

    def pixels(step):
        pose = RigidTransform(rotation_exp(step[3:6]) @ POSE.rotation, POSE.translation + step[6:])
        return np.concatenate(
            [seen(part, points, TRUTH.parameters + step[:3], pose).ravel() for part, points in sights]
        )

    jacobian = np.column_stack([(pixels(h) - pixels(-h)) / 2e-6 for h in 1e-6 * np.eye(9)])
    return SIGMA * np.sqrt(np.diag(np.linalg.inv(jacobian.T @ jacobian)))


def test_two_cameras_place_the_object_as_exactly_as_their_pixels_tell():
    ratios, off = [], []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        first, second = bound_points(MODEL, 14, rng), bound_points(MODEL, 10, rng)
        others = [(RIGHT, landmarks(RIGHT, second, rng))]
        found = register_landmarks(MODEL, LEFT.camera, landmarks(LEFT, first, rng), others=others)
        deviations = np.sqrt(np.diag(found.covariance))
        ratios.append(deviations / deviations_by_differences([(LEFT, first), (RIGHT, second)]))
        off.append(steps_of(found.state) / deviations)
        assert not found.warnings
    np.testing.assert_allclose(np.median(ratios, axis=0), 1.0, atol=0.25)
    assert 0.6 < np.sqrt(np.mean(np.square(off))) < 1.3


def test_a_camera_that_is_turned_is_named_and_a_right_one_is_not():
    rng = np.random.default_rng(3)
    points = bound_points(MODEL, 16, rng)
    first, second = landmarks(LEFT, points, rng), landmarks(RIGHT, points, rng)
    for degrees in (0.0, 0.05):
        right = register_landmarks(MODEL, LEFT.camera, first, others=[(turned(RIGHT, degrees), second)])
        assert right.warnings == ()
    off = register_landmarks(MODEL, LEFT.camera, first, others=[(turned(RIGHT, 0.5), second)])
    said = [warning for warning in off.warnings if isinstance(warning, CamerasContradict)]
    assert said[0].camera == 1
    assert 0.7 * SIGMA < said[0].free_px < 1.3 * SIGMA < said[0].together_px
    assert said[0].turned_deg == pytest.approx(0.5, abs=0.3)
    assert not any(isinstance(warning, PoorFit) for warning in off.warnings)
    with pytest.raises(RegistrationError, match=r"the cameras contradict .* camera 1 is turned by about [23] degrees"):
        register_landmarks(MODEL, LEFT.camera, first, others=[(turned(RIGHT, 3.0), second)])


def test_a_wrong_landmark_is_named_by_its_camera():
    rest = State(MODEL.default, POSE)
    rng = np.random.default_rng(5)
    points = bound_points(MODEL, 12, rng)
    first, second = (
        Landmarks(points.rest, seen(part, points, rest.parameters) + 0.2 * rng.standard_normal((12, 2)))
        for part in (LEFT, RIGHT)
    )
    second.pixels[4] += [60.0, -20.0]
    with pytest.raises(RegistrationError, match=r"landmark 5 of camera 1 is .* from where the other 23 have it"):
        register_landmarks(MODEL, LEFT.camera, first, at_rest=True, others=[(RIGHT, second)])
    second.pixels[4] = [900.0, 10.0]
    with pytest.raises(RegistrationError, match=r"camera 1: landmark 5 has the pixel .* outside the 800x600 image"):
        register_landmarks(MODEL, LEFT.camera, first, others=[(RIGHT, second)])
    with pytest.raises(ArgumentError, match="depth and image correct the landmarks of one camera"):
        register_landmarks(
            MODEL, LEFT.camera, first, image=np.zeros((480, 640), np.uint8), others=[(RIGHT, second)]
        )  # fmt: skip


class Recording:
    """One camera's frames at these times; they show nothing."""

    has_assumed_times = False
    name, fps = "recording", 10.0

    def __init__(self, camera, times):
        self._image, self._times = np.zeros((camera.height, camera.width, 3), dtype=np.uint8), times

    def __len__(self):
        return len(self._times)

    def __iter__(self):
        return iter([Frame(k, time, self._image) for k, time in enumerate(self._times)])


def test_landmarks_of_a_further_camera_have_the_numbers_of_its_own_recording():
    """It begins two frames earlier, and frames go together by their times."""
    both = [Recording(LEFT.camera, [0.2, 0.3, 0.4]), Recording(RIGHT.camera, [0.0, 0.1, 0.2, 0.3])]
    frames, rng = SynchronizedFrames(both).at(0), np.random.default_rng(0)
    first = landmarks(LEFT, bound_points(MODEL, 14, rng), rng)
    second = landmarks(RIGHT, bound_points(MODEL, 10, rng), rng)
    other = replace(second, frames=np.full(10, 2))
    part = TrackedObject("sheet", MODEL, replace(first, frames=np.full(14, 0)), other_landmarks=(other,))
    placed = part.register((LEFT, RIGHT), frames)
    expected = register_landmarks(MODEL, LEFT.camera, first, others=[(RIGHT, second)])
    np.testing.assert_array_equal(placed.state.parameters, expected.state.parameters)
    wrong = replace(part, other_landmarks=(replace(second, frames=np.full(10, 0)),))
    with pytest.raises(RegistrationError, match="landmarks of camera 1 that were set in frame 0 are used in frame 2"):
        wrong.register((LEFT, RIGHT), frames)
