"""What a registration tells a pose that is one over the sequence, and how that is sharpened while frames come."""

from dataclasses import dataclass, replace
from threading import Event
from time import sleep
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

import morph_dslam as md
from morph_dslam import TrackerOptions
from morph_dslam.camera import Camera
from morph_dslam.geometry import RigidTransform
from morph_dslam.io.landmarks import Landmarks, save_landmarks
from morph_dslam.registration.landmark_binding import bind_landmarks
from morph_dslam.registration.registration import Registration
from morph_dslam.tracking import still_run, track as track_module
from morph_dslam.tracking.frame_estimation import FrameEstimation
from morph_dslam.tracking.known_state import LandmarkTerm
from morph_dslam.tracking.reregistration import Reregistration
from morph_dslam.tracking.state import State
from morph_dslam.tracking.still import StillFit
from morph_dslam.tracking.still_notices import LandmarksAlone, PoseAwayFromLandmarks, still_notices
from morph_dslam.tracking.still_run import Sharpening, known_state
from morph_dslam.tracking.tracker import Tracker
from tests.support.bent_sheet import bent_sheet_model
from tests.support.rendered_sequence import CAMERA, SheetFilm, sheet_state, write_recording
from tests.support.tracked_rig import placed_objects

MODEL = bent_sheet_model(7, 5)
#: As a registration at rest has it: parameters known, the pose to so much.
POSE_VARIANCES = np.array([1e-4, 1e-4, 1e-4, 1e-6, 1e-6, 1e-6])


@pytest.mark.parametrize("at_rest", [True, False])
def test_a_frame_at_rest_says_nothing_of_a_per_sequence_parameter(at_rest):
    """A modulus has no effect there: it is anywhere in its range, while the other parameters are known."""
    name = MODEL.parameters[1].name
    registration = SimpleNamespace(
        state=State(MODEL.default, RigidTransform(np.eye(3), np.array([0.0, 0.0, 1.0]))),
        covariance=np.diag([*np.zeros(3), *POSE_VARIANCES]),
        facts={"corrected_by_outline": True},
    )
    part = SimpleNamespace(
        object=SimpleNamespace(start=None, at_rest=at_rest),
        registration=registration,
        model=MODEL,
        options=TrackerOptions(per_sequence=(name,)),
    )
    found = known_state(part).covariance  # type: ignore[arg-type]
    half = 0.5 * (MODEL.upper - MODEL.lower)[1]
    np.testing.assert_allclose(np.diag(found), [0.0, half**2 if at_rest else 0.0, 0.0, *POSE_VARIANCES])


@pytest.mark.parametrize(("fitted", "counted"), [(0.08, 0.5), (1.2, 1.2), (np.nan, 0.5)])
def test_landmarks_count_with_half_a_pixel_at_least(fitted, counted):
    """As in their registration: residuals do not show what the mesh is off by, which the pose takes up."""
    nodes = MODEL.nodes[::4]
    pose = RigidTransform(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, 1.0]))
    part = SimpleNamespace(
        object=SimpleNamespace(start=Landmarks(nodes, CAMERA.project(pose.apply(nodes))), click_px=0.5),
        registration=SimpleNamespace(state=State(MODEL.default, pose), facts={"sigma_px": fitted}),
        model=MODEL,
        depth=None,
    )
    assert known_state(part).sigma_px == counted  # type: ignore[arg-type]


class Sharpened:
    """Stands for an object with its pose from more frames, which a thread estimates until it is let go.

    Attributes
    ----------
    batches : how many frames each estimate is from.
    goes_on : set to let the thread go.
    """

    def __init__(self, new_tracker):
        self.frame, self.object, self.new_tracker = 0, SimpleNamespace(reregister_at=()), new_tracker
        self.batches, self.goes_on = [], Event()

    def estimated(self, part, keyframes, estimated):
        self.batches.append(len(keyframes))
        assert self.goes_on.wait(10.0)
        return self


@pytest.fixture
def sharpened(monkeypatch):
    film = SheetFilm(bent_sheet_model(22, 16))
    state, image = sheet_state(0.1), film.frame(sheet_state(0.1))

    def new_tracker():
        known = Registration(film.model, state, covariance=np.diag([1e-4] * 9) ** 2)
        return Tracker(film.model, CAMERA, known, TrackerOptions(pose="still"), reference=image)

    part = Sharpened(new_tracker)
    monkeypatch.setattr(still_run, "with_still_pose", part.estimated)
    return part, image


def replaced(sharpening, tracker):
    """The tracker that takes the place of one, once its thread was let go."""
    for _ in range(1000):
        new = sharpening.tracker((SimpleNamespace(index=99),), tracker)
        if new is not tracker:
            return new
        sleep(0.01)
    raise AssertionError("no other tracker came")


def test_what_a_sensor_was_said_to_tell_holds_when_the_pose_is_sharpened(sharpened):
    """The sensor is a millimetre off: the images alone would have the arch elsewhere."""
    part, image = sharpened
    told = sheet_state(0.1).parameters[0] + 1e-3
    sharpening, tracker = Sharpening(part), part.new_tracker()
    tracker.know({"arch": (told, 1e-5)})
    for number in range(11):
        assert sharpening.tracker((SimpleNamespace(index=number),), tracker) is tracker
        assert tracker.track(image).parameters["arch"] == pytest.approx(told, abs=4e-5)
    part.goes_on.set()
    assert replaced(sharpening, tracker).track(image).parameters["arch"] == pytest.approx(told, abs=4e-5)


@pytest.mark.parametrize("is_lost", [False, True])
def test_a_tracker_in_another_pose_goes_on_where_the_one_before_it_was(sharpened, monkeypatch, is_lost):
    """The sheet has straightened since the reference picture, and its points were looked for 7 pixels away."""
    part, image = sharpened
    film, bent, offsets = SheetFilm(bent_sheet_model(22, 16)), sheet_state(0.1), []
    shapes = [replace(bent, parameters=share * bent.parameters) for share in (1.0, 0.6, 0.2, -0.2)]
    before, new = part.new_tracker(), part.new_tracker()
    for shape in shapes[:3]:
        assert before.track(film.frame(shape)).tracked
    if is_lost:
        assert not before.track(np.full_like(image, 128)).tracked
    new.take_over(before)
    correct = FrameEstimation.correct

    def looking(self, picture, state, away, prior):
        offsets.append(away)
        return correct(self, picture, state, away, prior)

    monkeypatch.setattr(FrameEstimation, "correct", looking)
    found = new.track(film.frame(shapes[3]))
    assert (found.tracked, found.recovered) == (True, is_lost)
    assert (offsets[0] is None) if is_lost else (np.abs(offsets[0]).max() < 0.1)


@dataclass(frozen=True)
class Registered:
    """Stands for an object that is registered anew in frame 3."""

    model: object = None
    initializer: object = None
    reregister_at: tuple = ((3, None),)

    def register(self, cameras, frame, landmarks):
        return SimpleNamespace(warnings=())


def test_what_a_sensor_was_said_to_tell_holds_when_the_object_is_registered_anew(sharpened):
    part, image = sharpened
    told = sheet_state(0.1).parameters[0] + 1e-3
    placed = SimpleNamespace(
        frame=0, object=Registered(), model=None, cameras=(), in_frames=lambda registration, frames: part
    )
    again, tracker = Reregistration(placed), part.new_tracker()
    tracker.know({"arch": (told, 1e-5)})
    new = again.tracker((SimpleNamespace(index=3),), tracker)
    assert new is not tracker
    assert new.track(image).parameters["arch"] == pytest.approx(told, abs=4e-5)


def test_the_pose_is_not_sharpened_by_next_to_no_frames(sharpened):
    """While an estimate took long, so many frames came that the next is due, but the new tracker has seen none."""
    part, image = sharpened
    sharpening, tracker = Sharpening(part), part.new_tracker()
    result = tracker.track(image)
    assert result.tracked

    def frames_come(tracker, count):
        for number in range(count):
            tracker.last_seen = replace(tracker.last_seen)
            assert sharpening.tracker((SimpleNamespace(index=number),), tracker) is tracker

    frames_come(tracker, 40)
    part.goes_on.set()
    tracker = replaced(sharpening, tracker)
    assert sharpening.tracker((SimpleNamespace(index=41),), tracker) is tracker
    assert tracker.track(image).tracked
    frames_come(tracker, 9)
    assert part.batches == [10]
    frames_come(tracker, 1)
    replaced(sharpening, tracker)
    assert part.batches == [10, 10]


@pytest.fixture(scope="module")
def bending(tmp_path_factory):
    """Pictures of a sheet that bends in one pose, and landmarks half a pixel off."""
    model, folder, bent = bent_sheet_model(22, 16), tmp_path_factory.mktemp("still"), sheet_state(0.1)
    film, states = SheetFilm(model), [replace(bent, parameters=k * bent.parameters) for k in (1.0, 0.5, 0.0)]
    write_recording(folder, {number: film.frame(state) for number, state in enumerate(states)}, model)
    rng = np.random.default_rng(1)
    nodes = rng.choice(len(model.nodes), 24, replace=False)
    pixels = CAMERA.project(bent.camera_from_object.apply(model.positions(bent.parameters)[nodes]))
    pixels += 0.5 * rng.standard_normal(pixels.shape)
    save_landmarks(folder / "landmarks.csv", Landmarks(model.nodes[nodes], pixels))
    return {
        "frames": folder / "frames",
        "camera": folder / "camera.yaml",
        "model": folder / "sheet.morph",
        "landmarks": folder / "landmarks.csv",
        "tracker": TrackerOptions(pose="still"),
        "video": False,
    }


#: Of so many pixels that landmarks of a part that differs from its drawing are off by some.
FINE = Camera(3 * CAMERA.width, 3 * CAMERA.height, 3 * CAMERA.fx, 3 * CAMERA.fy, 3 * CAMERA.cx, 3 * CAMERA.cy)


@pytest.mark.parametrize("seed", range(4))
def test_a_pose_in_which_landmarks_fit_much_worse_than_alone_is_named_with_what_lengths_are_off_by(seed):
    """Of a part that differs from its drawing by 4 px, 3 % too near: twelve misses of two to three deviations each.

    The deviation by which they count says nothing of that: it is by a median, and may be far smaller.
    """
    rng, pose = np.random.default_rng(seed), RigidTransform(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, 0.8]))
    points = np.ascontiguousarray(MODEL.nodes[rng.choice(len(MODEL.nodes), 12, replace=False)])
    pixels = FINE.project(pose.apply(points)) + 4.0 * rng.standard_normal((12, 2))
    _, rotation, translation = cv2.solvePnP(points, pixels, FINE.matrix, None)
    alone = cv2.projectPoints(points, rotation, translation, FINE.matrix, None)[0][:, 0] - pixels
    term = LandmarkTerm(bind_landmarks(MODEL, points), pixels, 1.5)
    landmarks = LandmarksAlone(term, float(np.sqrt(np.sum(alone**2) / 12.0)), n_unknowns=6, click_px=1.5)

    def said(distance):
        at = State(MODEL.default, RigidTransform(pose.rotation, np.array([0.0, 0.0, distance])))
        return list(still_notices(StillFit(at, np.eye(9), FINE, {}), landmarks, FINE))

    assert said(0.8) == []
    (away,) = said(0.8 / 1.03)
    assert isinstance(away, PoseAwayFromLandmarks)
    shifted = FINE.project(pose.apply(points) - [0.0, 0.0, 0.8 - 0.8 / 1.03]) - pixels
    assert away.off_px == pytest.approx(np.sqrt(np.mean(np.sum(shifted**2, axis=1))))
    assert away.off_mm == pytest.approx(1e3 * away.off_px * 0.8 / 1.03 / FINE.fx)
    assert away.length_percent == pytest.approx(-3.0, abs=1.0)


STALE = PoseAwayFromLandmarks(40.0, 2.0, 0.5, 3, 90.0, -1.0)


def test_an_estimate_that_rests_on_another_says_what_holds_now(bending):
    """The landmarks fit in the pose of all frames; those of the estimate before did not."""
    (part,) = placed_objects(**bending)
    tracker = part.new_tracker()
    seen = []
    for frame in md.open_source(bending["frames"]):
        tracker.track(frame)
        seen.append(tracker.last_seen)
    placed = replace(part.registration, warnings=(*part.registration.warnings, STALE))
    found = still_run.with_still_pose(replace(part, registration=placed), seen, estimated=20).registration
    assert not any(isinstance(warning, PoseAwayFromLandmarks) for warning in found.warnings)
    assert found.facts["pose"] == "one for the whole sequence, from 23 frames"
    assert found.facts["sigma_px"] == part.registration.facts["sigma_px"]


def test_a_live_run_says_what_its_last_estimate_of_the_pose_does(bending, tmp_path, monkeypatch):
    """What the landmarks alone left open is not said any more."""

    class AtOnce(Sharpening):
        def tracker(self, frames, current):
            facts = self.part.registration.facts | {"pose": "from frames"}
            self.part = replace(self.part, registration=replace(self.part.registration, facts=facts, warnings=(STALE,)))
            return current

    monkeypatch.setattr(track_module, "Sharpening", AtOnce)
    summary = md.track(md.TrackOptions(output=tmp_path / "run", live=True, **bending))
    assert summary["registration"]["pose"] == "from frames"
    assert [notice for notice in summary["notices"] if notice["kind"] == "pose_away_from_landmarks"]
