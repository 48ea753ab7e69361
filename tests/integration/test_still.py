"""A camera and a support that stand still: one pose over the sequence, with a camera known badly."""

import json
from dataclasses import replace

import cv2
import h5py
import numpy as np
import pytest

import morph_dslam as md
from morph_dslam.camera import Camera
from morph_dslam.evaluation.run_folder import load_run
from morph_dslam.geometry import RigidTransform, rotation_exp, rotation_log
from morph_dslam.io.camera_files import load_camera, save_camera
from morph_dslam.io.landmarks import Landmarks, save_landmarks
from morph_dslam.registration.landmark_binding import bind_landmarks
from morph_dslam.sources import open_source
from morph_dslam.tracking.displacement_jumps import DisplacementJump
from morph_dslam.tracking.estimator import EstimationOptions, Estimator, State
from morph_dslam.tracking.hypothesis import Image
from morph_dslam.tracking.known_state import LandmarkTerm
from morph_dslam.tracking.outcomes import Rejection, RejectionReason
from morph_dslam.tracking.patches import normalize_contrast
from morph_dslam.tracking.reference import PosedImage, ReferenceView
from morph_dslam.tracking.refinement import Keyframe
from morph_dslam.tracking.session import Session
from morph_dslam.tracking.still import StillFit, StillProblem, fit_still, held
from morph_dslam.tracking.still_notices import (
    FocalLengthEstimated,
    FocalLengthFarFromGiven,
    LandmarksAlone,
    still_notices,
)
from morph_dslam.tracking.still_run import OpenedSurface
from morph_dslam.tracking.views import ActiveView
from tests.support.bent_sheet import bent_sheet_model
from tests.support.rendered_sequence import UPRIGHT, SheetFilm, mean_error, write_recording
from tests.support.tracked_rig import placed_objects

#: A long lens with a radial term that shifts the corners by some 17 pixels.
CAMERA = Camera(640, 480, 1500.0, 1500.0, 320.0, 240.0, (0.6, 0.0, 0.0, 0.0))
POSE = RigidTransform(rotation_exp(np.array([0.10, -0.15, 0.02])) @ UPRIGHT, np.array([0.005, -0.004, 1.25]))
TIMES = np.linspace(0.0, 1.0, 16)


def state(time):
    parameters = [0.05 * np.sin(3.0 * time), 0.4 * np.sin(4.0 * time), np.radians(15) * np.sin(2.0 * time)]
    return State(np.array(parameters), POSE)


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    """Frames of a sheet that bends in one pose, and landmarks set to 0.7 pixels."""
    folder = tmp_path_factory.mktemp("still")
    model = bent_sheet_model(43, 31)
    film = SheetFilm(model, replace(CAMERA, distortion=()))
    film.background[:] = 128
    seen_at = ideal_pixels()
    images = [recorded(film.frame(state(time)), seen_at) for time in TIMES]
    write_recording(folder, dict(enumerate(images)), model)
    save_camera(folder / "camera.yaml", CAMERA)
    rng = np.random.default_rng(3)
    nodes = rng.choice(len(model.nodes), 24, replace=False)
    pixels = CAMERA.distort_pixels(CAMERA.project(POSE.apply(model.nodes[nodes])))
    save_landmarks(
        folder / "landmarks.csv", Landmarks(model.nodes[nodes], pixels + 0.7 * rng.standard_normal(pixels.shape))
    )
    return folder


def ideal_pixels():
    """Where a pinhole has what each pixel of the lens shows: columns and rows (h, w)."""
    rows, columns = np.mgrid[: CAMERA.height, : CAMERA.width].astype(float)
    ideal = CAMERA.undistort_pixels(np.column_stack([columns.ravel(), rows.ravel()])).astype(np.float32)
    return ideal.reshape(CAMERA.height, CAMERA.width, 2).transpose(2, 0, 1)


def recorded(image, seen_at):
    """A pinhole's image (h, w, 3) as the lens gives it."""
    return cv2.remap(image, *seen_at, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)


def track(recording, output, pose, camera="camera.yaml", **options):
    md.track(
        md.TrackOptions(
            frames=recording / "frames",
            model=recording / "sheet.morph",
            camera=recording / camera,
            landmarks=recording / "landmarks.csv",
            output=output,
            video=False,
            tracker=md.TrackerOptions(pose=pose),
            **options,
        )
    )
    return load_run(output)


def errors(run):
    """Mean distance of the nodes from the truth in each frame, metres."""
    states = [
        State(p, RigidTransform(m[:3, :3], m[:3, 3]))
        for p, m in zip(run.parameters, run.camera_from_object, strict=True)
    ]
    return np.array([mean_error(run.model, found, state(t)) for found, t in zip(states, TIMES, strict=True)])


def away(run):
    """Rotation vector (rad) and translation (m) of the run's pose from the true one (6,)."""
    pose = run.camera_from_object[0]
    return np.concatenate([rotation_log(pose[:3, :3] @ POSE.rotation.T), pose[:3, 3] - POSE.translation])


def test_one_pose_from_all_frames_is_nearer_to_the_truth(recording, tmp_path):
    free, still = track(recording, tmp_path / "free", "free"), track(recording, tmp_path / "still", "still")
    assert np.ptp(still.camera_from_object, axis=0).max() < 1e-4
    assert errors(still).mean() < 0.5 * errors(free).mean()
    assert errors(still).mean() < 1.0e-3
    with h5py.File(tmp_path / "still" / "result.h5") as file:
        spread = file["pose_std"][-1]
    assert (np.abs(away(still)) < 3.5 * spread).all()


@pytest.mark.slow
def test_a_lens_that_is_not_known_is_estimated(recording, tmp_path):
    save_camera(recording / "plain.yaml", replace(CAMERA, distortion=()))
    run = track(recording, tmp_path / "run", "still", "plain.yaml", refine_camera=("radial",))
    k1 = load_camera(tmp_path / "run" / "camera.yaml").distortion[0]
    assert k1 == pytest.approx(0.6, rel=0.2)
    assert errors(run).mean() < 2.5e-3  # nearly all of it along the sight line, as a longer lens would be
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    notices = {notice["kind"]: notice for notice in summary["notices"]}
    assert notices["radial_term_estimated"]["value"] == pytest.approx(k1)
    corner = np.array([[0.0, 0.0]])
    moved_by = np.linalg.norm(CAMERA.undistort_pixels(corner) - corner)  # 0.6 of the true lens
    assert notices["radial_term_estimated"]["corner_px"] == pytest.approx(moved_by * k1 / 0.6, rel=0.2)
    assert "pose_away_from_landmarks" not in notices


@pytest.mark.parametrize("factor", [0.6, 1.0, 3.0])
def test_a_focal_length_is_the_same_from_wherever_it_starts(factor):
    """Bent states show it from nearby; start and distance are off together, as they are where a lens is guessed."""
    model, camera = bent_sheet_model(43, 31), Camera(640, 480, 700.0, 700.0, 320.0, 240.0)
    pose = RigidTransform(POSE.rotation, np.array([0.005, -0.004, 0.5]))
    rows, rng = np.arange(0, len(model.nodes), 7), np.random.default_rng(2)

    def seen(parameters):
        pixels = camera.project(pose.apply(model.positions(parameters)[rows]))
        return pixels + 0.1 * rng.standard_normal(pixels.shape)

    shapes = [State(2.0 * state(time).parameters, pose) for time in np.linspace(0.2, 1.0, 8)]
    landmarks = Landmarks(model.nodes[rows[::9]], seen(model.default)[::9])
    known = LandmarkTerm(bind_landmarks(model, landmarks.points), landmarks.pixels, 0.5)
    frames = [Keyframe(seen(shape.parameters), np.ones(len(rows)), shape, 0.3) for shape in shapes]
    stated = replace(camera, fx=factor * camera.fx, fy=factor * camera.fy)
    start = State(model.default, RigidTransform(pose.rotation, pose.translation * [1.0, 1.0, factor]))
    known_shape = range(len(model.default))
    problem = StillProblem(model, stated, start, seen(model.default), frames, known, (), known_shape, ("focal",))
    found = fit_still(problem)
    value, std = found.terms["focal"]
    assert std < 0.03 * camera.fx
    assert abs(value - camera.fx) < 3.0 * std
    away_by = np.abs(found.state.camera_from_object.translation - pose.translation)
    assert (away_by < 3.5 * np.sqrt(np.diag(found.covariance)[-3:])).all()
    (notice,) = still_notices(found, LandmarksAlone(known, 0.0, 6, 1.0), stated)
    assert isinstance(notice, FocalLengthEstimated)
    assert isinstance(notice, FocalLengthFarFromGiven) == (factor == 3.0)


def test_a_pose_away_from_the_landmarks_is_said():
    model, camera = bent_sheet_model(43, 31), Camera(640, 480, 1500.0, 1500.0, 320.0, 240.0)
    points = model.nodes[::97]
    known = LandmarkTerm(bind_landmarks(model, points), camera.project(POSE.apply(points)), 1.0)
    # Errors of a pixel, or what is of no account, are not said; 2.4 px and 12 px of all landmarks are.
    for shift, expected, click_px in ((0.0, 0, 0.1), (8e-4, 0, 0.1), (2e-3, 0, 1.0), (2e-3, 1, 0.5), (1e-2, 1, 0.5)):
        pose = RigidTransform(POSE.rotation, POSE.translation + shift * np.array([1.0, 0.0, 0.0]))
        found = StillFit(State(model.default, pose), np.eye(len(model.default) + 6), camera, {})
        notices = list(still_notices(found, LandmarksAlone(known, 0.0, 6, click_px), camera))
        assert len(notices) == expected
        if expected:
            # Parallel to the image, a shift is as large for all points at one depth.
            assert notices[0].off_mm == pytest.approx(1e3 * shift, rel=0.1)
            assert notices[0].off_px == pytest.approx(1e3 * shift * 1.5 / 1.25, rel=0.1)


def test_deformed_frames_decide_which_way_a_plane_is_tilted():
    # From afar the landmarks of a flat sheet fit both tilts; its bent states fit one.
    model, camera = bent_sheet_model(43, 31), Camera(640, 480, 15000.0, 15000.0, 320.0, 240.0)
    place = np.array([0.0, 0.0, 12.5])
    tilted, mirrored = (
        RigidTransform(rotation_exp(turn * np.array([0.2, -0.1, 0.0])) @ UPRIGHT, place) for turn in (1.0, -1.0)
    )
    rows, rng = np.arange(0, len(model.nodes), 7), np.random.default_rng(2)

    def seen(parameters):
        pixels = camera.project(tilted.apply(model.positions(parameters)[rows]))
        return pixels + 0.1 * rng.standard_normal(pixels.shape)

    shapes = [State(state(time).parameters, tilted) for time in np.linspace(0.2, 1.0, 5)]
    landmarks = Landmarks(model.nodes[rows[::9]], seen(model.default)[::9])
    known = LandmarkTerm(bind_landmarks(model, landmarks.points), landmarks.pixels, 0.5)
    frames = [Keyframe(seen(shape.parameters), np.ones(len(rows)), shape, 0.3) for shape in shapes]
    for start, other in ((tilted, mirrored), (mirrored, tilted)):
        problem = StillProblem(model, camera, State(model.default, start), seen(model.default), frames, known)
        found = fit_still(problem, [State(model.default, other)])
        assert found.decided
        turned = rotation_log(found.state.camera_from_object.rotation @ tilted.rotation.T)
        assert np.linalg.norm(turned) < np.radians(1.0)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            {"tracker": md.TrackerOptions(pose="still"), "registration": "r.json", "landmarks": None},
            "leave out --still",
        ),
        ({"refine_camera": ("focal",)}, "give --still"),
        ({"tracker": md.TrackerOptions(pose="still"), "reregister_at": ((3, "l.csv"),)}, "not registered anew"),
    ],
)
def test_what_makes_no_sense_is_refused(recording, tmp_path, arguments, message):
    options = {
        "frames": recording / "frames", "model": recording / "sheet.morph", "camera": recording / "camera.yaml",
        "landmarks": recording / "landmarks.csv", "output": tmp_path / "run",
    }  # fmt: skip
    with pytest.raises(md.MorphError, match=message):
        md.track(md.TrackOptions(**options | arguments))


def test_where_an_earlier_pass_found_the_surface_open_is_kept_frame_by_frame(recording):
    files = {"model": "sheet.morph", "camera": "camera.yaml", "landmarks": "landmarks.csv", "frames": "frames"}
    (placed,) = placed_objects(**{what: recording / name for what, name in files.items()})
    small, large = (DisplacementJump(np.array([0.05, 0.02, 0.0]), size, 0.03) for size in (0.002, 0.004))
    known, frames = OpenedSurface(placed, {9: (small,), 12: (large,)}), open_source(recording / "frames")
    assert known.first == 9
    session = Session({"sheet": placed.new_tracker()}, frames, reregistration={"sheet": known})
    found = [[jump.size for jump in tracked.results["sheet"].jumps] for tracked in session]
    assert found == [[]] * 9 + [[small.size]] * 3 + [[large.size]] * 4


def test_an_object_that_is_found_by_its_features_keeps_the_pose():
    """The camera is believed to be 6 % longer than it is, so that a free pose would leave the one that is held."""
    model, camera = bent_sheet_model(43, 31), replace(CAMERA, distortion=())
    film, given = SheetFilm(model, camera), replace(camera, fx=1.06 * camera.fx, fy=1.06 * camera.fy)
    at_rest, bent = State(model.default, POSE), state(0.55)
    greys = [cv2.cvtColor(film.frame(shape), cv2.COLOR_BGR2GRAY) for shape in (at_rest, bent)]
    rest, picture = (Image(grey, normalize_contrast(grey)) for grey in greys)
    estimator, options = Estimator(model, given, EstimationOptions()), md.TrackerOptions(pose="still")
    view = ActiveView.of(ReferenceView(estimator, [PosedImage(rest, at_rest)], options), estimator, options)
    lost = Rejection(RejectionReason.FEW_FEATURES, 0)
    found, why = view.recovery.recover(picture, at_rest, lost, held(at_rest, estimator))
    assert why is None
    pose = found.estimate.state.camera_from_object
    assert np.abs(rotation_log(pose.rotation @ POSE.rotation.T)).max() < 1e-4
    assert np.abs(pose.translation - POSE.translation).max() < 1e-4
    # Its shape is what the longer camera makes of the true one, nearly: in a pose of its own it would be bent less.
    assert found.estimate.state.parameters[0] == pytest.approx(bent.parameters[0], rel=0.1)


@pytest.mark.slow
def test_live_the_pose_is_estimated_anew_from_more_frames(recording, tmp_path):
    summary = md.track(
        md.TrackOptions(
            frames=recording / "frames",
            model=recording / "sheet.morph",
            camera=recording / "camera.yaml",
            landmarks=recording / "landmarks.csv",
            output=tmp_path / "run",
            video=False,
            live=True,
            tracker=md.TrackerOptions(pose="still"),
        )
    )
    assert summary["pose"] == "still"
    run = load_run(tmp_path / "run")
    assert run.tracked.all()
    # What landmarks set to 0.7 pixels leave, or better.
    assert np.linalg.norm(away(run)[3:]) < 10e-3
