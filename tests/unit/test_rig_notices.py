"""What the cameras of a rig say of a frame, in the common result."""

from dataclasses import replace

import numpy as np
import pytest

from morph_dslam.geometry import RigidTransform, rotation_exp
from morph_dslam.registration.registration import Registration
from morph_dslam.sources import Frame
from morph_dslam.tracking.depth_scale import DepthScale
from morph_dslam.tracking.multi_camera import RigTracker
from morph_dslam.tracking.options import TrackerOptions
from morph_dslam.tracking.outcomes import DepthNotUsed, FewPointsAgree, ReadoutNotUsed
from morph_dslam.tracking.rig import RigCamera
from tests.support.bent_sheet import bent_sheet_model
from tests.support.rendered_sequence import CAMERA, SheetFilm, sheet_depth, sheet_state

MODEL = bent_sheet_model(22, 16)
TURN = rotation_exp(np.array([0.02, 0.3, -0.05]))
RIG = (
    RigCamera(CAMERA, RigidTransform.identity()),
    RigCamera(CAMERA, RigidTransform(TURN, np.array([0.0, 0.0, 0.6]) - TURN @ np.array([0.0, 0.0, 0.6]))),
)
STD = np.array([2e-4, 2e-3, 5e-4, 3e-4, 3e-4, 3e-4, 2e-4, 2e-4, 5e-4])


class Scene:
    """Pictures of both cameras: in the reference state, and later."""

    def __init__(self) -> None:
        film = SheetFilm(MODEL)
        self.references, self.later = ([film.frame(part.seen(sheet_state(t))) for part in RIG] for t in (0.3, 0.32))

    def tracker(self, **options):
        known = Registration(MODEL, sheet_state(0.3), covariance=np.diag(STD**2))
        return RigTracker(MODEL, RIG, known, TrackerOptions(**options), references=self.references)


@pytest.fixture(scope="module")
def scene():
    return Scene()


def test_few_points_of_a_camera_are_named_and_what_they_may_have_in_common_is_in_the_deviations(scene, monkeypatch):
    results = []
    for doubt_px in (0.0, 3.0):
        rig = scene.tracker()
        second = rig.trackers[1]

        def doubted(*told, second=second, track=second.track, doubt_px=doubt_px):
            result = track(*told)
            second.last_doubt_px = doubt_px
            return replace(result, warnings=(*result.warnings, FewPointsAgree(3.5))) if doubt_px else result

        monkeypatch.setattr(second, "track", doubted)
        results.append(rig.track(scene.later))
    plain, found = results
    assert plain.warning(FewPointsAgree) is None
    assert found.warning(FewPointsAgree) == FewPointsAgree(3.5)
    np.testing.assert_allclose(found.estimate.state.parameters, plain.estimate.state.parameters)
    assert (found.estimate.parameter_std > 2.0 * plain.estimate.parameter_std).all()


@pytest.mark.parametrize(
    ("factor", "ratio"), [(None, None), (1.0, 0.0), (1000.0, pytest.approx(1000.0, rel=0.01))], ids=str
)
def test_depth_that_does_not_count_is_named_and_a_camera_beside_one_that_has_depth_needs_none(scene, factor, ratio):
    """No camera has depth, the first one has it in metres, or in millimetres; 0 where nothing is to be said."""
    frames = [Frame(0, 0.0, image) for image in scene.later]
    if factor is not None:
        depth = np.float32(factor) * sheet_depth(MODEL, sheet_state(0.32), np.random.default_rng(0))
        frames[0] = replace(frames[0], depth=depth)
    found = scene.tracker(use_depth=True).track(frames).warning(DepthNotUsed)
    assert found is None if ratio == 0.0 else found is not None and found.ratio == ratio


@pytest.mark.parametrize("factor", [1.005, 1.01, 1.02])
def test_the_scale_of_the_second_cameras_depths_is_not_known_with_that_of_the_first(scene, factor):
    """Held by the first one's, the sheet would be off by half a millimetre from half a deviation on.

    The texture of both cameras and the first one's depths tell the second scale.
    """
    rng, middle = np.random.default_rng(0), MODEL.nodes.mean(axis=0)[None]
    frames = [
        Frame(0, 0.0, image, np.float32(scale) * sheet_depth(MODEL, part.seen(sheet_state(0.32)), rng))
        for scale, image, part in zip((1.0, factor), scene.later, RIG, strict=True)
    ]
    scale = DepthScale(1.0, 0.003)
    known = Registration(MODEL, sheet_state(0.3), covariance=np.diag((0.1 * STD) ** 2), depth_scale=scale)
    rig = RigTracker(MODEL, RIG, known, TrackerOptions(use_depth=True), references=scene.references)
    found = rig.track(frames)
    off = found.estimate.state.camera_from_object.apply(middle) - sheet_state(0.32).camera_from_object.apply(middle)
    assert abs(off[0, 2]) < min(0.05e-3, 3.0 * found.pose_std[5])


@pytest.mark.parametrize("start", ["previous", "constant-velocity"])
def test_frames_of_a_rig_start_where_the_common_states_lead_to(scene, monkeypatch, start):
    """In each camera's frame, as the cameras stand to each other; after a loss the object has no velocity."""
    rig, told = scene.tracker(start=start), [[], []]
    for camera, own in zip(rig.trackers, told, strict=True):

        def go_on(state, start=None, own=own, go_on=camera.continue_from):
            own.append(state if start is None else start)
            go_on(state, start)

        monkeypatch.setattr(camera, "continue_from", go_on)
    blank = np.full_like(scene.later[0], 120)
    last, *lost, again = [rig.track(frames) for frames in (scene.later, [blank] * 2, [blank] * 2, scene.later)]
    assert [result.tracked for result in (last, *lost, again)] == [True, False, False, True]
    for result, before, number in ((last, sheet_state(0.3), 0), (again, again.estimate.state, 1)):
        now = result.estimate.state
        going = 0.0 if start == "previous" else 1.0
        parameters = now.parameters + going * (now.parameters - before.parameters)
        shift = now.camera_from_object.translation - before.camera_from_object.translation
        for part, own in zip(RIG, told, strict=True):
            np.testing.assert_allclose(own[number].parameters, parameters, atol=1e-9)
            position = part.camera_from_rig.apply(now.camera_from_object.translation + going * shift)
            np.testing.assert_allclose(own[number].camera_from_object.translation, position, atol=1e-9)


def rolling(scene, times):
    """The rig with cameras that take 30 ms to read their rows out, and its results in both instants."""
    cameras = [RigCamera(replace(part.camera, readout_s=0.03), part.camera_from_rig) for part in RIG]
    known = Registration(MODEL, sheet_state(0.3), covariance=np.diag(STD**2))
    rig = RigTracker(MODEL, cameras, known, TrackerOptions(), references=scene.references)
    instants = [scene.references, scene.later]
    return [
        rig.track([Frame(k, time, image) for image in images])
        for k, (images, time) in enumerate(zip(instants, times, strict=True))
    ]


def test_a_rig_is_drawn_where_the_rows_of_the_first_camera_show_the_object(scene):
    """Its centre goes on evenly, from the middle row's instant to that of the row that shows it."""
    before, found = rolling(scene, (0.0, 1.0 / 30.0))
    assert before.shown_state is before.estimate.state
    centre = MODEL.nodes.mean(axis=0)[None]
    earlier, now, shown = (
        state.camera_from_object.apply(centre)
        for state in (before.estimate.state, found.estimate.state, found.shown_state)
    )
    row = CAMERA.project(now)[0, 1]
    seconds = 0.03 * (row - 0.5 * (CAMERA.height - 1)) / CAMERA.height
    assert np.linalg.norm(shown - now) > 1e-5
    np.testing.assert_allclose(shown - now, 30.0 * seconds * (now - earlier), rtol=0.1, atol=2e-6)


def test_a_rig_says_that_its_readout_time_does_not_count(scene):
    """The frame before is a second ago, which tells nothing of the motion while rows are read."""
    _, found = rolling(scene, (0.0, 1.0))
    assert found.warning(ReadoutNotUsed) == ReadoutNotUsed(1.0)
    assert found.shown_state is found.estimate.state


def test_a_parameter_walks_on_over_instants_that_no_camera_has(scene):
    """As in a scalar Kalman filter: nothing came of eleven instants, as where live frames are dropped."""
    film, twist, step = SheetFilm(MODEL), 2, 5e-5
    seen = [[film.frame(part.seen(sheet_state(0.3)), noise=12.0) for part in RIG] for _ in range(5)]

    def deviations(n_missing, walks):
        """Of the twist before and after these instants."""
        known, options = Registration(MODEL, sheet_state(0.3)), TrackerOptions(random_walk=walks)
        rig = RigTracker(MODEL, RIG, known, options, references=scene.references)
        numbers = [0, 1, 2, 3, 4 + n_missing]
        found = [rig.track([Frame(k, k / 30.0, i) for i in images]) for k, images in zip(numbers, seen, strict=True)]
        return [result.estimate.parameter_std[twist] for result in found[-2:]]

    own = deviations(0, ())[1]
    for n_missing in (0, 11):
        before, after = deviations(n_missing, (("twist", step),))
        predicted = before**2 + (n_missing + 1) * step**2
        assert after == pytest.approx(np.sqrt(1.0 / (1.0 / own**2 + 1.0 / predicted)), rel=0.05)
