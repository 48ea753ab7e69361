"""When points that agree may be off together, or agree by chance: against what is usual in other frames."""

from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from morph_dslam.camera import Camera
from morph_dslam.geometry import RigidTransform
from morph_dslam.tracking.covariance import LEAST_SPREAD_PX
from morph_dslam.tracking.hypothesis import Image, reject
from morph_dslam.tracking.options import TrackerOptions
from morph_dslam.tracking.outcomes import Rejection, RejectionReason
from morph_dslam.tracking.patches import NEUTRAL
from morph_dslam.tracking.recovery import Recovery
from morph_dslam.tracking.state import State

CAMERA = Camera(200, 160, 200.0, 200.0, 100.0, 80.0)


def attempt(share, sigma_px, prior=None, visible=1.0, alike=False) -> Any:
    """Residuals are independent, or ``alike`` in neighbours as where the model is wrong."""
    inliers, seen = np.arange(200) < 200 * share, np.arange(200) < 200 * visible
    rng = np.random.default_rng(0)
    pixels, noise = rng.uniform(0.0, 200.0, (200, 2)), rng.standard_normal((200, 2))
    residuals = np.sqrt(2.0) * np.sin(pixels / 60.0 + 1.0) + 0.1 * noise if alike else noise
    measurement = SimpleNamespace(visible=seen, valid=inliers, pixels=pixels)
    estimate = SimpleNamespace(sigma_px=sigma_px, residuals=sigma_px * residuals)
    counts = int(seen.sum()), int(inliers.sum())
    return SimpleNamespace(
        inliers=inliers, estimate=estimate, prior=prior, measurement=measurement, counts=counts, outline_alone=False
    )


def new(options: TrackerOptions | None = None) -> Recovery:
    anything: Any = None
    return Recovery(anything, anything, anything, anything, options or TrackerOptions())


@pytest.fixture
def recovery():
    found = new()
    for _ in range(3):
        found.learn(attempt(0.9, 0.3))
    return found


def test_a_frame_before_anything_was_followed_is_not_doubted():
    assert new().doubt(attempt(0.2, 2.0)) == 0.0


@pytest.mark.parametrize(("share", "sigma_px", "visible"), [(0.8, 2.0, 1.0), (0.6, 2.0, 0.7), (0.3, 0.44, 1.0)])
def test_most_points_or_close_ones_are_not_doubted(recovery, share, sigma_px, visible):
    assert recovery.doubt(attempt(share, sigma_px, visible=visible)) == 0.0


def test_points_beside_something_that_hides_others_are_doubted(recovery):
    assert recovery.doubt(attempt(0.6, 0.5)) == pytest.approx(0.4)
    assert recovery.doubt(attempt(0.6, 0.5, visible=0.7)) == 0.0  # the others are hidden by the object itself


def test_what_is_usual_is_not_learnt_beside_something_that_hides_others(recovery):
    for _ in range(100):
        recovery.learn(attempt(0.6, 2.0))
    assert recovery.doubt(attempt(0.6, 0.5)) == pytest.approx(0.4)


def test_few_points_that_agree_less_closely_are_doubted_by_what_is_unusual(recovery):
    assert recovery.doubt(attempt(0.3, 0.5)) == pytest.approx(0.4)  # 0.5² = 0.3² + 0.4²


def test_an_object_that_leaves_the_picture_or_turns_away_is_not_doubted_for_that(recovery):
    """Nine tenths of the points in sight agree, of which a third of all is left."""
    assert recovery.doubt(attempt(0.3, 0.5, visible=0.33)) == 0.0
    assert recovery.doubt(attempt(0.3, 0.5, visible=0.33, prior=object())) == 0.0


def test_a_state_that_has_most_points_out_of_sight_is_doubted_where_the_others_agree_as_what_looks_alike(recovery):
    assert recovery.doubt(attempt(0.3, 1.7, visible=0.33)) == pytest.approx(np.sqrt(1.7**2 - 0.3**2))
    lost = recovery.reject(attempt(0.1, 0.5, visible=0.12), followed=True)
    assert lost is not None
    assert lost.reason is RejectionReason.FEW_POINTS
    lost = recovery.reject(attempt(0.2, 3.5, visible=0.22, alike=True), followed=True)
    assert lost is not None
    assert lost.reason is RejectionReason.LOOSE_AGREEMENT


def test_with_a_pose_from_the_map_fewer_points_will_do(recovery):
    assert recovery.doubt(attempt(0.4, 2.0, prior=object())) == 0.0
    assert recovery.doubt(attempt(0.2, 0.5, prior=object())) == pytest.approx(0.4)


@pytest.mark.parametrize(("share", "sigma_px", "believed"), [(0.4, 0.9, True), (0.4, 2.5, False), (0.6, 2.5, True)])
def test_few_points_that_do_not_agree_closely_agree_by_chance(share, sigma_px, believed):
    assert (reject(attempt(share, sigma_px), TrackerOptions()) is None) == believed


def test_few_points_that_err_as_their_neighbours_do_are_those_of_an_object_that_the_model_does_not_describe():
    assert reject(attempt(0.4, 2.5, alike=True), TrackerOptions()) is None
    rejection = reject(attempt(0.4, 2.5), TrackerOptions())
    assert rejection is not None
    assert rejection.spread_px == 2.5


FOUND = [(0.4, True, True), (0.2, True, False), (0.4, False, False)]


@pytest.mark.parametrize(("share", "followed", "believed"), FOUND)
def test_a_followed_object_is_lost_where_very_few_points_agree_loosely(recovery, share, followed, believed):
    """Half of a sheet that is covered, with a model that is wrong by pixels, has more than that."""
    assert (recovery.reject(attempt(share, 3.5, alike=True), followed) is None) == believed


@pytest.mark.parametrize(("share", "followed", "believed"), FOUND)
def test_a_pose_that_is_held_says_nothing_of_a_frame(share, followed, believed):
    """Where a specimen has torn, one of its halves agrees with the pose that both had."""
    still = new(TrackerOptions(pose="still"))
    still.learn(attempt(0.9, 0.3, prior=object()))
    torn = attempt(share, 3.5, prior=object(), alike=True)
    assert (still.reject(torn, followed) is None) == believed
    assert still.doubt(attempt(0.4, 0.5, prior=object())) == pytest.approx(0.4)


def test_the_reference_picture_itself_does_not_say_what_is_usual():
    """It agrees with itself to a hundredth of a pixel; later frames spread by more than a pixel, all of them alike."""
    first = new()
    first.learn(attempt(1.0, LEAST_SPREAD_PX))
    assert not first.is_loose(attempt(0.95, 2.0))
    first.learn(attempt(0.95, 2.0))
    assert not first.is_loose(attempt(0.95, 2.0))
    assert first.is_loose(attempt(0.95, 21.0))


def test_points_too_few_to_have_a_spread_say_nothing_of_what_they_have_in_common(recovery):
    few = attempt(0.05, np.inf, prior=object())
    assert recovery.doubt(few) == 0.0
    assert not recovery.is_loose(few)


def test_places_where_no_point_agrees_when_they_are_compared_again_are_no_places():
    """Seen from where a print's period puts the object, the shape found there may have nothing in common with it."""
    rng = np.random.default_rng(3)
    tile = cv2.GaussianBlur(rng.integers(0, 255, (40, 40), dtype=np.uint8), (0, 0), 2.0)
    shown = np.full((160, 200), NEUTRAL, np.uint8)
    frame, depth = shown.copy(), np.full(shown.shape, np.inf, np.float32)
    shown[20:60, 20:60] = frame[100:140, 20:60] = frame[20:60, 140:180] = tile
    depth[20:60, 20:60] = 1.0
    pose = RigidTransform(np.eye(3), np.array([0.0, 0.0, 1.0]))
    compared = iter([attempt(0.8, 0.3), attempt(0.0, np.nan), attempt(0.8, 0.3), attempt(0.0, np.nan)])

    def correct(picture, state, offsets, held):
        found = next(compared)
        found.estimate.state = state
        found.measurement.pixels = found.measurement.pixels + CAMERA.project(state.camera_from_object.translation)
        return found

    lost = Rejection(RejectionReason.FEW_POINTS, 0, 200, 20)
    reference: Any = SimpleNamespace(
        rendered=lambda state: SimpleNamespace(image=shown, depth=depth),
        points=SimpleNamespace(in_camera=lambda state: np.ones((5, 3))),
        relocaliser=SimpleNamespace(find=lambda grey, shapes, mask: (None, 3)),
        redundancy=1.0,
    )
    model: Any = SimpleNamespace(lower=np.zeros(1), upper=np.ones(1), default=np.zeros(1))
    estimation: Any = SimpleNamespace(correct=correct)
    recovery = Recovery(model, CAMERA, reference, estimation, TrackerOptions())
    found, rejection = recovery.recover(Image(grey=frame, normalized=frame), State(np.zeros(1), pose), lost)
    assert found is None
    assert rejection is not None
    assert rejection.then == Rejection(RejectionReason.FEW_FEATURES, 3)
    assert next(compared, None) is None  # both places were compared twice
