"""An anchored object, by the camera in the map: recorded and live, covered, moved, and without a camera."""

import _thread
import json
import signal
from contextlib import ExitStack
from dataclasses import replace

import cv2
import h5py
import numpy as np
import pytest

import morph_dslam as md
from morph_dslam.cli.app import main
from morph_dslam.errors import MapError, RegistrationError, TrackingError
from morph_dslam.evaluation.run_folder import load_run
from morph_dslam.geometry import RigidTransform
from morph_dslam.registration.registration import PosePrior
from morph_dslam.sources import open_source
from morph_dslam.tracking.anchoring import CameraLocalization
from morph_dslam.tracking.outcomes import CameraLost, ObjectMoved
from morph_dslam.tracking.placement import new_anchor
from morph_dslam.tracking.sinks import VideoSink
from morph_dslam.tracking.track import new_session, prepare
from tests.support.rendered_anchored import SCAN

#: What the map made from the scan is off by, and the registration with it, metres.
MAP_ERROR = 2.5e-3


@pytest.fixture(scope="module")
def recording(anchored_recording):
    return anchored_recording


def options(folder, output, **others):
    known = {"registration": folder / "registration.json", "first": SCAN} | others
    files = {"frames": folder / "sequence" / "frames", "camera": folder / "sequence" / "camera.yaml"}
    return md.TrackOptions(**files, model=folder / "sheet.morph", output=output, **known)


class OneObject:
    """A session of the sheet, frame by frame."""

    def __init__(self, folder, **others):
        self.placed = prepare(options(folder, folder, **others), ExitStack())[2]
        self.session = new_session(self.placed, ())
        (self.model, self.camera), (self.name, self.tracker) = (
            (self.placed[0].model, self.placed[0].camera),
            *self.session.trackers.items(),
        )

    def locate(self, frame):
        return self.session.locate((frame,)).get(self.name, CameraLocalization())

    def track(self, frame):
        return self.session.track((frame,), self.session.locate((frame,))).results[self.name]


def frames_of(folder, first, last):
    return list(open_source(folder / "sequence" / "frames", first, last))


def true_pose(truth, frame):
    return RigidTransform.from_matrix(truth["camera_from_object"][frame])


def pixels_of(sheet, truth, frame):
    nodes = sheet.model.positions(truth["parameters"][frame])
    return sheet.camera.project(true_pose(truth, frame).apply(nodes))


def test_a_recording_is_tracked_with_the_camera_in_the_map(recording, tmp_path):
    folder, truth = recording
    summary = md.track(options(folder, tmp_path / "run", video=False))
    # The map is the one beside the registration.
    assert summary["inputs"]["map"] == str(folder / "map.h5")
    assert (summary["pose"], summary["n_tracked"], summary["n_hidden"]) == ("map", 20, 0)
    run = load_run(tmp_path / "run")
    with h5py.File(tmp_path / "run" / "result.h5") as file:
        assert set(file["pose_from"].asstr()[()]) == {"points and map"}
        assert (file["pose_std"][:] > 0.0).all()
    expected = truth["parameters"][run.frames]
    np.testing.assert_allclose(run.parameters[:, 0], expected[:, 0], atol=0.5e-3)
    apart = run.camera_from_object[:, :3, 3] - truth["camera_from_object"][run.frames][:, :3, 3]
    assert np.linalg.norm(apart, axis=1).max() < MAP_ERROR


def test_two_threads_find_what_one_finds(recording):
    folder, _ = recording
    ahead, alone = OneObject(folder), OneObject(folder)
    frames = frames_of(folder, 44, 51)
    session = new_session(ahead.placed, frames)
    for tracked, frame in zip(session, frames, strict=True):
        mine, others = tracked.results[ahead.name].estimate, alone.track(frame).estimate
        assert np.array_equal(mine.state.parameters, others.state.parameters)
        assert np.array_equal(mine.covariance, others.covariance)


def test_a_covered_object_is_hidden_in_its_place_and_few_points_tell_its_shape(recording):
    folder, truth = recording
    sheet = OneObject(folder)
    rng = np.random.default_rng(2)
    seen = {}
    for frame in frames_of(folder, 44, 57):
        image = frame.image.copy()
        left, top = np.floor(pixels_of(sheet, truth, frame.index).min(axis=0)).astype(int) - 12
        right, bottom = np.ceil(pixels_of(sheet, truth, frame.index).max(axis=0)).astype(int) + 12
        if 48 <= frame.index < 52:  # a cloth with a pattern of its own over all of it
            cloth = rng.integers(30, 220, (60, 80, 3), dtype=np.uint8)
            cloth = cv2.resize(cloth, (right - left, bottom - top), interpolation=cv2.INTER_CUBIC)
            image[top:bottom, left:right] = cloth
        if frame.index >= 54:  # and over most of it
            image[top:bottom, left : left + round(0.86 * (right - left))] = 120
        seen[frame.index] = sheet.track(replace(frame, image=image))
    for index in range(48, 52):
        result = seen[index]
        assert (result.status, result.pose_from, result.estimate) == ("hidden", "map", None)
        apart = result.pose.translation - truth["camera_from_object"][index][:3, 3]
        assert np.linalg.norm(apart) < MAP_ERROR
        assert 0.0 < result.pose_std[5] < 5e-3
    for index in (53, 55, 56, 57):
        result = seen[index]
        assert (result.status, result.pose_from) == ("tracked", "points and map"), result.reason
        error = result.estimate.state.parameters[0] - truth["parameters"][index, 0]
        assert abs(error) < (0.5e-3 if index == 53 else 3.0 * result.estimate.parameter_std[0])
    # Fewer than a free object needs, and all at one end: they tell the arch, and that they tell it worse.
    assert seen[57].n_inliers < 30
    assert 1e-3 < seen[57].estimate.parameter_std[0] < 10e-3


def test_where_the_camera_is_lost_the_points_alone_tell_the_pose(recording):
    folder, truth = recording
    sheet = OneObject(folder)
    for frame in frames_of(folder, 44, 51):
        image = frame.image
        if frame.index >= 47:
            outline = cv2.convexHull(np.rint(pixels_of(sheet, truth, frame.index)).astype(np.int32))
            mask = cv2.fillConvexPoly(np.zeros(image.shape[:2], dtype=np.uint8), outline, 1)
            image = np.where(mask[:, :, None] > 0, image, np.uint8(110))
        result = sheet.track(replace(frame, image=image))
        assert result.status == "tracked", result.reason
        assert abs(result.estimate.state.parameters[0] - truth["parameters"][frame.index, 0]) < 1e-3
    assert result.pose_from == "points"
    assert result.warning(CameraLost).why


def test_an_object_that_was_moved_is_said_to_be_and_is_followed_by_its_points(recording):
    """The map's pose is shifted, as if the object had been pushed by 15 mm, and later back."""
    folder, truth = recording
    sheet = OneObject(folder)
    push = np.array([0.015, 0.0, 0.0])
    moved, sources = {}, {}
    for frame in frames_of(folder, 40, 55):
        known = sheet.locate(frame).pose_prior
        if 44 <= frame.index < 50:
            pose = known.pose
            there = RigidTransform(pose.rotation, pose.translation + pose.rotation @ push)
            known = PosePrior(there, known.from_camera, known.lasting)
        result = sheet.tracker.track(frame.image, CameraLocalization(known))
        assert result.status == "tracked", result.reason
        apart = result.pose.translation - truth["camera_from_object"][frame.index][:3, 3]
        assert np.linalg.norm(apart) < MAP_ERROR
        moved[frame.index], sources[frame.index] = result.warning(ObjectMoved) is not None, result.pose_from
    assert sources[43] == "points and map"
    assert {sources[index] for index in range(44, 50)} == {"points"}
    # Three frames on end make it sure, both ways.
    assert [index for index, told in moved.items() if told] == list(range(46, 52))
    assert sources[54] == "points and map"


def test_a_pose_that_is_held_is_the_maps(recording):
    folder, _ = recording
    sheet = OneObject(folder, tracker=md.TrackerOptions(pose="fixed"))
    for frame in frames_of(folder, 44, 46):
        located = sheet.locate(frame)
        result = sheet.tracker.track(frame, located)
        np.testing.assert_allclose(result.pose.matrix, located.pose_prior.pose.matrix, atol=1e-5)
        assert result.pose_from == "points and map"


def test_a_free_object_is_known_by_the_maps_pictures_wherever_it_is(recording):
    """The camera stands on its head, where the map would not have the object."""
    folder, truth = recording
    sheet = OneObject(folder, tracker=md.TrackerOptions(pose="free"))
    assert new_anchor(sheet.placed) is None
    half_turn = RigidTransform(np.diag([-1.0, -1.0, 1.0]), np.zeros(3))
    width, height = sheet.camera.width, sheet.camera.height
    middle = np.array([2.0 * sheet.camera.cx, 2.0 * sheet.camera.cy])
    moves = np.array([[-1.0, 0.0, middle[0]], [0.0, -1.0, middle[1]]])
    for frame in frames_of(folder, 40, 52):
        image = cv2.warpAffine(frame.image, moves, (width, height), borderMode=cv2.BORDER_REFLECT)
        result = sheet.track(replace(frame, image=np.asarray(image, dtype=np.uint8)))
    assert (result.status, result.pose_from) == ("tracked", "points"), result.reason
    assert result.estimate.state.parameters[0] == pytest.approx(truth["parameters"][52, 0], abs=1e-3)
    found, true = result.estimate.state.camera_from_object, half_turn @ true_pose(truth, 52)
    apart = (found.apply(sheet.model.nodes) - true.apply(sheet.model.nodes)).mean(axis=0)
    assert np.linalg.norm(apart) < 2.0 * MAP_ERROR


def test_a_tracker_knows_from_the_scene_what_an_object_looks_like_and_where_it_is(recording):
    """Frame by frame from Python; the first frame that is tracked is not the reference."""
    folder, truth = recording
    model, camera = md.load_model(folder / "sheet.morph"), md.load_camera(folder / "sequence" / "camera.yaml")
    scene = md.load_scene(folder / "map.h5", camera)
    n_points = len(scene.points)
    registration = md.load_registration(folder / "registration.json", model, scene)
    tracker = md.Tracker(model, camera, registration)
    for frame in frames_of(folder, 44, 47):
        result = tracker.track(frame)
        assert (result.status, result.pose_from) == ("tracked", "points and map"), result.reason
        assert result.estimate.state.parameters[0] == pytest.approx(truth["parameters"][frame.index, 0], abs=0.5e-3)
        assert np.linalg.norm(result.pose.translation - true_pose(truth, frame.index).translation) < MAP_ERROR
    assert len(scene.points) == n_points  # what can move was taken out of a copy


@pytest.mark.parametrize("pose", ["map", "free"])
def test_a_registration_in_a_map_is_refused_without_its_scene(recording, pose):
    """The first frame that is tracked is not the one that it was made in; a picture of that one is enough."""
    folder, _ = recording
    model, camera = md.load_model(folder / "sheet.morph"), md.load_camera(folder / "sequence" / "camera.yaml")
    registration = md.load_registration(folder / "registration.json", model)
    with pytest.raises(RegistrationError, match=rf"made in a map.*load_scene.*of frame {registration.frame} as ref"):
        md.Tracker(model, camera, registration, md.TrackerOptions(pose=pose))
    (first,) = frames_of(folder, registration.frame, registration.frame)
    tracker = md.Tracker(model, camera, registration, reference=first.image)
    (second,) = frames_of(folder, registration.frame + 1, registration.frame + 1)
    assert tracker.track(second).tracked


@pytest.mark.slow
def test_the_outline_counts_where_only_keyframes_show_what_the_object_looks_like(recording):
    """They hold no grey values, so how bright the object is inside is learnt from the first frame."""
    folder, truth = recording
    model, camera = md.load_model(folder / "sheet.morph"), md.load_camera(folder / "sequence" / "camera.yaml")
    registration = md.load_registration(folder / "registration.json", model, md.load_scene(folder / "map.h5", camera))
    tracker = md.Tracker(model, camera, registration, md.TrackerOptions(use_outline=True))
    for frame in frames_of(folder, 44, 47):
        result = tracker.track(frame)
        assert result.estimate.state.parameters[0] == pytest.approx(truth["parameters"][frame.index, 0], abs=0.5e-3)
        assert (tracker.last_measured.weights[len(tracker.reference.points) :] > 0.0).sum() > 50


def test_a_recording_is_tracked_from_its_first_frame(recording, tmp_path):
    """Not from the last keyframe of the scan, in which the object is registered."""
    folder, truth = recording
    run, _, placed = prepare(options(folder, tmp_path, first=None), ExitStack())
    assert placed[0].frame > 0
    assert run.first is None
    summary = md.track(options(folder, tmp_path / "run", first=None, last=8, video=False))
    assert summary["n_tracked"] == summary["n_frames"] == 9
    found = load_run(tmp_path / "run")
    assert found.frames.tolist() == list(range(9))
    assert found.parameters[:, 0] == pytest.approx(truth["parameters"][:9, 0], abs=1e-3)


@pytest.mark.parametrize("pose", ["map", "free"])
def test_another_recording_than_the_scans_is_tracked_whole(recording, tmp_path, pose):
    """The number of the map's keyframe, which this one is too short to have, says nothing about its frames."""
    folder, truth = recording
    frames = tmp_path / "frames"
    frames.mkdir()
    for number, name in enumerate(sorted((folder / "sequence" / "frames").iterdir())[40:46]):
        (frames / f"{number:04d}{name.suffix}").write_bytes(name.read_bytes())
    known = {"frames": frames, "first": None, "video": False, "tracker": md.TrackerOptions(pose=pose)}
    summary = md.track(replace(options(folder, tmp_path / "run"), **known))
    assert summary["n_frames"] == summary["n_tracked"] == 6
    found = load_run(tmp_path / "run")
    assert found.frames.tolist() == list(range(6))
    assert found.parameters[:, 0] == pytest.approx(truth["parameters"][40:46, 0], abs=1e-3)


def test_a_live_run_keeps_the_pace_and_everything_it_found(recording, tmp_path):
    folder, truth = recording
    summary = md.track(options(folder, tmp_path / "live", first=30, live=True, serve=0))
    drawn, dropped = summary["n_frames"], summary["live"]["n_dropped"]
    assert drawn + dropped == 30
    assert summary["live"]["latency_p95_ms"] >= summary["live"]["latency_median_ms"] > 0.0
    run = load_run(tmp_path / "live")
    assert (np.diff(run.frames) > 0).all()
    assert (run.frames[-1], run.status[-1]) == (59, "tracked")
    assert run.parameters[-1, 0] == pytest.approx(truth["parameters"][59, 0], abs=1e-3)
    rows = (tmp_path / "live" / "latency.csv").read_text().splitlines()
    assert rows[0] == "frame,captured_s,latency_ms"
    assert len(rows) == 1 + drawn
    # Where frames were dropped the video stands still.
    capture = cv2.VideoCapture(str(tmp_path / "live" / "augmented.mp4"))
    assert int(capture.get(cv2.CAP_PROP_FRAME_COUNT)) == run.frames[-1] - run.frames[0] + 1
    capture.release()


@pytest.mark.parametrize("shown", [[0, 10, 20], [0, 12, 13, 14, 20]])
def test_a_free_object_that_jumps_without_a_gap_is_found_by_its_features(recording, tmp_path, shown):
    """Followed at the last velocity, few points would agree in the last of these frames, several millimetres off."""
    folder, truth = recording
    known = {"landmarks": folder / "sequence" / "landmarks.csv", "registration": None, "first": None}
    sheet = OneObject(folder, **known)
    frames = frames_of(folder, 0, 20)
    found = [sheet.tracker.track(frames[number].image) for number in shown]
    assert all(result.status == "tracked" for result in found)
    apart = found[-1].pose.translation - truth["camera_from_object"][20][:3, 3]
    assert np.linalg.norm(apart) < 0.5e-3


def test_a_free_object_starts_live_from_landmarks_in_the_first_frame(recording, tmp_path):
    folder, truth = recording
    start = {"landmarks": folder / "sequence" / "landmarks.csv", "registration": None}
    summary = md.track(options(folder, tmp_path, **start, first=None, last=20, live=True, video=False))
    assert (summary["pose"], summary["reference_frame"]) == ("free", 0)
    run = load_run(tmp_path)
    assert (run.frames[-1], run.status[-1]) == (20, "tracked")
    apart = run.camera_from_object[-1][:3, 3] - truth["camera_from_object"][20][:3, 3]
    assert np.linalg.norm(apart) < 3e-3
    assert not (tmp_path / "augmented.mp4").exists()


@pytest.mark.slow
def test_an_interrupt_keeps_a_live_run(recording, monkeypatch, capsys, tmp_path):
    folder, _ = recording
    show, shown = VideoSink.__call__, []

    def interrupted(self, tracked):
        show(self, tracked)
        shown.append(tracked.frame.index)
        if len(shown) == 1:  # many more are to come, also where the machine is slow
            _thread.interrupt_main(signal.SIGTERM)  # shells make background jobs deaf to SIGINT

    monkeypatch.setattr(VideoSink, "__call__", interrupted)
    command = ["live", str(folder / "sequence" / "frames"), "--model", str(folder / "sheet.morph")]
    command += ["--camera", str(folder / "sequence" / "camera.yaml"), "--show", "displacement"]
    command += ["--registration", str(folder / "registration.json"), "-o", str(tmp_path)]
    assert main(command) == 130
    said = capsys.readouterr()
    assert "everything until then is kept" in said.err
    frames = load_run(tmp_path).frames.tolist()
    assert f"tracked={len(frames)}/{len(frames)} fps=" in said.out  # as at any other end
    assert frames == shown
    assert 1 <= len(frames) < 39
    assert (tmp_path / "augmented.mp4").is_file()


def test_inputs_that_do_not_fit_are_refused(recording, tmp_path):
    folder, _ = recording
    content = json.loads((folder / "registration.json").read_text())
    (tmp_path / "registration.json").write_text(
        json.dumps(content | {"frame": 1234, "keyframes": [content["keyframes"][0] | {"frame": 1234}]})
    )
    moved = {"registration": tmp_path / "registration.json"}
    with pytest.raises(MapError, match="it has no keyframe 1234"):
        OneObject(folder, **moved, map_path=folder / "map.h5")
    with pytest.raises(TrackingError, match="a registration needs the map"):
        md.track(options(folder, tmp_path / "run", **moved, tracker=md.TrackerOptions(pose="free"), live=True))
    (tmp_path / "registration.json").write_text(json.dumps(content))
    alone = OneObject(folder, **moved)
    assert new_anchor(alone.placed) is None
    assert "no map" in alone.placed[0].registration.warnings[-1].text
