"""A depth image that does not belong to the colour image's pixels is named, and one that does is not."""

from dataclasses import replace

import numpy as np
import pytest

from morph_dslam.geometry import RigidTransform, rotation_exp
from morph_dslam.io.landmarks import Landmarks
from morph_dslam.registration.landmarks import register_landmarks
from morph_dslam.registration.messages import DepthAgainstLandmarks, DepthBehindObject, PoorFit
from morph_dslam.tracking.depth_registration import share_behind
from morph_dslam.tracking.estimator import Estimator, State
from tests.support.bent_sheet import bent_sheet_model
from tests.support.rendered_sequence import CAMERA, UPRIGHT, mean_error, sheet_depth

MODEL = bent_sheet_model(22, 16)
#: Turned far from the image plane, so that depth that is shifted is of another distance.
POSE = RigidTransform(rotation_exp(np.array([0.1, 0.7, 0.0])) @ UPRIGHT, np.array([0.0, 0.0, 0.7]))
BENT = State(np.array([0.04, 0.2, 0.1]), POSE)


#: What lies behind the sheet, and what is before it where something is, metres.
BEHIND, BEFORE = 1.5, 0.4


def registered(seed, shift_px, landmark_px=0.5, count=16, covered=0.0, scale=1.0, turned=0.0, **known):
    """Landmarks, and a depth image whose columns are shifted, with something before this share of its width.

    All its depths are too large by the factor ``scale``; the sheet had turned by ``turned``, rad, when it was taken.
    ``known`` is what is known of the depth camera.
    """
    rng = np.random.default_rng(seed)
    rows = rng.choice(len(MODEL.nodes), count, replace=False)
    pixels = CAMERA.project(POSE.apply(MODEL.positions(BENT.parameters)[rows]))
    landmarks = Landmarks(MODEL.nodes[rows], pixels + landmark_px * rng.standard_normal(pixels.shape))
    rotation = POSE.rotation @ rotation_exp(np.array([0.0, turned, 0.0]))
    then = replace(BENT, camera_from_object=RigidTransform(rotation, POSE.translation))
    depth = np.roll(sheet_depth(MODEL, then, rng, background=BEHIND), shift_px, axis=1)
    left, right = np.flatnonzero((depth < 0.5 * BEHIND).any(axis=0))[[0, -1]]
    depth[:, left : left + int(covered * (right - left))] = BEFORE
    return register_landmarks(MODEL, CAMERA, landmarks, depth=np.float32(scale) * depth, **known)


@pytest.mark.parametrize("scale", [0.976, 1.024])
def test_depth_of_another_scale_is_taken_where_the_object_is_far_for_its_size(scale):
    """All depths are off by more than a twentieth of the object's size; what they say is stated with their scale."""
    rng, far = np.random.default_rng(0), RigidTransform(POSE.rotation, np.array([0.0, 0.0, 1.3]))
    state = State(BENT.parameters, far)
    rows = rng.choice(len(MODEL.nodes), 16, replace=False)
    pixels = CAMERA.project(far.apply(MODEL.positions(state.parameters)[rows])) + 0.3 * rng.standard_normal((16, 2))
    depth = np.float32(scale) * sheet_depth(MODEL, state, rng, background=2.5)
    found = register_landmarks(MODEL, CAMERA, Landmarks(MODEL.nodes[rows], pixels), depth=depth)
    away = found.state.camera_from_object.translation[2] - 1.3
    assert 0.0 < away / (scale - 1.0) < 1.3 + 0.1  # landmarks know the distance too
    assert abs(away) < 3.0 * np.sqrt(found.covariance[-1, -1])
    assert not kinds(found)


def kinds(registration):
    named = {DepthAgainstLandmarks, DepthBehindObject, PoorFit}
    return {type(warning) for warning in registration.warnings} & named


def test_depth_that_is_shifted_is_named_and_not_the_landmarks():
    found = registered(0, 25)
    assert kinds(found) & {DepthAgainstLandmarks, DepthBehindObject}
    assert PoorFit not in kinds(found)
    assert all(
        "not aligned" in w.text for w in found.warnings if isinstance(w, DepthAgainstLandmarks | DepthBehindObject)
    )


@pytest.mark.parametrize("seed", range(1, 3))
def test_depth_of_another_instant_is_named_and_not_the_landmarks(seed):
    """The object was turned by some degrees since: no scale of the depths makes landmarks fit."""
    found = registered(seed, 0, turned=0.06)
    assert kinds(found) == {DepthAgainstLandmarks}
    (said,) = (w for w in found.warnings if isinstance(w, DepthAgainstLandmarks))
    assert said.alone_px == pytest.approx(0.5, rel=0.5)
    assert said.with_depth_px > 1.5 * said.alone_px


@pytest.mark.parametrize("seed", range(5))
def test_depth_that_is_aligned_is_not_named(seed):
    """On a surface turned far from the image plane too, where landmarks alone leave some millimetres."""
    found = registered(seed, 0, depth_scale_std=0.0)
    assert kinds(found) == set()
    assert mean_error(MODEL, found.state, BENT) < 0.6e-3
    away = found.state.camera_from_object.translation - POSE.translation
    assert (np.abs(away) < 3.5 * np.sqrt(np.diag(found.covariance)[-3:])).all()


def test_landmarks_that_do_not_fit_alone_are_named_themselves():
    assert kinds(registered(1, 0, landmark_px=3.0)) == {PoorFit}


@pytest.mark.parametrize("shift_px", [18, 25])
@pytest.mark.parametrize("seed", range(2))
def test_depth_that_many_landmarks_take_up_is_named_too(seed, shift_px):
    """They fit nearly as well with it, and another scale of the depths makes good of most."""
    found = registered(seed, shift_px, count=40)
    assert len(kinds(found) & {DepthAgainstLandmarks, DepthBehindObject}) == 1
    assert PoorFit not in kinds(found)
    assert mean_error(MODEL, found.state, BENT) < 4e-3  # 4 to 6 mm and more where the scale counts as exact


@pytest.mark.parametrize("shift_px", [12, 25])
def test_depth_that_is_shifted_sees_what_is_behind_the_object(shift_px):
    facing = State(np.zeros(3), RigidTransform(UPRIGHT, POSE.translation))  # shifted depths are as far away
    depth = sheet_depth(MODEL, facing, np.random.default_rng(0), background=BEHIND)
    sheet = depth < 0.5 * BEHIND
    bared = sheet & ~np.roll(sheet, shift_px, axis=1)
    found = share_behind(Estimator(MODEL, CAMERA), facing, np.roll(depth, shift_px, axis=1))
    # But for what is near the rim, or at the jump, where there is no depth.
    assert found == pytest.approx(bared.sum() / sheet.sum(), rel=0.5)
    assert share_behind(Estimator(MODEL, CAMERA), facing, depth) == 0.0


@pytest.mark.parametrize("seed", range(3))
def test_what_is_before_the_object_is_not_taken_for_depth_that_is_shifted(seed):
    found = registered(seed, 0, covered=0.3, depth_scale_std=0.0)
    assert kinds(found) == set()
    assert mean_error(MODEL, found.state, BENT) < 1e-3


@pytest.mark.parametrize("seed", range(4))
def test_landmarks_that_know_the_distance_better_find_the_scale_of_depths(seed):
    """Depths that are too large by their deviation, 7 mm, do not contradict ten landmarks. They move it by less."""
    found = registered(seed, 0, count=10, scale=1.01)
    assert kinds(found) == set()
    away = found.state.camera_from_object.translation - POSE.translation
    assert (np.abs(away) < 3.0 * np.sqrt(np.diag(found.covariance)[-3:])).all()
    assert abs(away[2]) < 0.3 * 0.01 * POSE.translation[2]
    assert found.depth_scale.factor == pytest.approx(1.0 / 1.01, abs=3.0 * found.depth_scale.std)
    assert found.depth_scale.std < 0.4 * 0.01


@pytest.mark.slow
@pytest.mark.parametrize("n_landmarks", [8, 16])
def test_the_distance_is_off_by_as_much_as_stated(n_landmarks):
    """By depths whose scale is off by what is stated, a draw for each recording."""
    away = []
    for seed in range(40):
        scale = 1.0 + 0.01 * np.random.default_rng(100 + seed).standard_normal()
        found = registered(seed, 0, count=n_landmarks, scale=scale)
        error = found.state.camera_from_object.translation[2] - POSE.translation[2]
        away.append(error / np.sqrt(found.covariance[-1, -1]))
    # The root mean square of 40 normal numbers is within 0.7 and 1.35 in 997 of 1000 cases.
    assert 0.7 < np.sqrt(np.mean(np.square(away))) < 1.35
