"""One object in front of two rendered cameras that are fixed to each other."""

import cv2
import numpy as np
import pytest

from morph_dslam.camera import Camera
from morph_dslam.cli.app import main
from morph_dslam.errors import RegistrationError
from morph_dslam.evaluation.run_folder import load_run
from morph_dslam.geometry import RigidTransform, rotation_exp
from morph_dslam.io.landmarks import Landmarks, save_landmarks
from morph_dslam.model import save_model
from morph_dslam.registration.registration import Registration
from morph_dslam.tracking.multi_camera import RigCamera, RigTracker
from morph_dslam.tracking.tracker import Tracker
from tests.support.bent_sheet import bent_sheet_model
from tests.support.camchain import write_camchain
from tests.support.rendered_sequence import SheetFilm, mean_error, sheet_state

#: Two cameras of wide lenses, so that one by itself tells little along its sight line; 0.4 m apart.
FRONT = RigCamera(Camera(480, 360, 330.0, 330.0, 240.0, 180.0), RigidTransform.identity())
TURN = rotation_exp(np.array([0.0, 0.5, 0.0]))
ASIDE = RigCamera(
    Camera(480, 360, 350.0, 350.0, 235.0, 182.0),
    RigidTransform(TURN, np.array([0.0, 0.0, 0.62]) - TURN @ np.array([0.0, 0.0, 0.62])),
)
RIG = (FRONT, ASIDE)
TIMES = np.linspace(0.0, 0.3, 10)[1:]


@pytest.fixture(scope="module")
def model():
    return bent_sheet_model(43, 31)


@pytest.fixture
def films(model):
    return [SheetFilm(model, part.camera) for part in RIG]


def images(films, time, **changes):
    state = sheet_state(time)
    return [film.frame(part.seen(state), noise=6.0, **changes) for film, part in zip(films, RIG, strict=True)]


def test_two_cameras_are_nearer_to_the_truth_than_one(model, films):
    """Something hides most of the object from the first camera, and some of it from the second."""
    first = images(films, 0.0)
    alone = Tracker(model, FRONT.camera, Registration(model, sheet_state(0.0)), reference=first[0])
    rig = RigTracker(model, RIG, first, sheet_state(0.0))
    errors, deviations = {"alone": [], "rig": []}, {"alone": [], "rig": []}
    for time in TIMES:
        seen = images(films, time)
        seen[0][:, 250:] = 90
        seen[1][:160] = 90
        for name, result in (("alone", alone.track(seen[0])), ("rig", rig.track(seen))):
            assert result.status == "tracked", result.reason
            errors[name].append(mean_error(model, result.estimate.state, sheet_state(time)))
            deviations[name].append(result.estimate.pose_std[5])
    assert np.mean(errors["rig"]) < 0.5 * np.mean(errors["alone"])
    assert np.mean(deviations["rig"]) < 0.5 * np.mean(deviations["alone"])


def test_covered_camera_goes_on_from_the_other(model, films):
    rig = RigTracker(model, RIG, images(films, 0.0), sheet_state(0.0))
    for number, time in enumerate(TIMES):
        seen = images(films, time)
        if 2 <= number <= 6:
            seen[1] = films[1].blank()
        result = rig.track(seen)
        assert result.status == "tracked", result.reason
        assert mean_error(model, result.estimate.state, sheet_state(time)) < 0.6e-3
        assert [w.camera for w in result.warnings] == ([1] if 2 <= number <= 6 else [])
    assert rig.trackers[1].last_measured.weights.sum() > 100


def test_object_that_no_camera_sees_is_lost(model, films):
    rig = RigTracker(model, RIG, images(films, 0.0), sheet_state(0.0))
    result = rig.track([film.blank() for film in films])
    assert result.status == "lost"
    assert [(w.camera, w.status) for w in result.warnings] == [(0, "lost"), (1, "lost")]


def test_reference_frame_without_texture_names_its_camera(model, films):
    first = [images(films, 0.0)[0], np.full((360, 480, 3), 128, np.uint8)]
    with pytest.raises(RegistrationError, match="camera 1: the object shows only"):
        RigTracker(model, RIG, first, sheet_state(0.0))


@pytest.fixture(scope="module")
def recording(model, tmp_path_factory):
    """What both cameras recorded, their camchain, the model, and landmarks in the first camera."""
    folder = tmp_path_factory.mktemp("rig")
    films = [SheetFilm(model, part.camera) for part in RIG]
    for number, time in enumerate([0.0, *TIMES[:4]]):
        for name, image in zip(("front", "aside"), images(films, time), strict=True):
            (folder / name).mkdir(exist_ok=True)
            cv2.imwrite(str(folder / name / f"{number:03d}.png"), image)
    write_camchain(folder / "camchain.yaml", RIG)
    save_model(folder / "sheet.morph", model)
    state, nodes = sheet_state(0.0), np.random.default_rng(0).choice(len(model.nodes), 24, replace=False)
    positions = state.camera_from_object.apply(model.positions(state.parameters))[nodes]
    landmarks = Landmarks(model.nodes[nodes], FRONT.camera.project(positions))
    save_landmarks(folder / "landmarks.csv", landmarks)
    return folder


def command(recording, output, *more, camera="camchain.yaml#cam0"):
    arguments = [str(recording / "front"), "--camera", str(recording / camera)]
    arguments += ["--model", str(recording / "sheet.morph"), "--landmarks", str(recording / "landmarks.csv")]
    return ["track", *arguments, "-o", str(output), *more]


def test_command_tracks_with_both_cameras(model, recording, tmp_path, capsys):
    assert main(command(recording, tmp_path / "run", "--with", str(recording / "aside"))) == 0
    assert "tracked=5/5" in capsys.readouterr().out
    run = load_run(tmp_path / "run")
    for row, time in enumerate([0.0, *TIMES[:4]]):
        state = sheet_state(time)
        exact = state.camera_from_object.apply(model.positions(state.parameters))
        assert np.linalg.norm(run.camera_points(row) - exact, axis=1).mean() < 0.4e-3


@pytest.mark.parametrize(
    ("more", "camera", "message"),
    [
        (["--with", "aside", "--with", "aside"], "camchain.yaml#cam0", "has 2 cameras, but there are 3"),
        (["--with", "aside"], "camchain.yaml#cam1", "give the first camera of a Kalibr camchain"),
        (
            ["--with", "aside", "--depth"],
            "camchain.yaml#cam0",
            "leave out --refine, --reregister-at, --depth and --discrepancy",
        ),
    ],
)
def test_what_does_not_fit_a_rig_is_refused(recording, tmp_path, capsys, more, camera, message):
    more = [str(recording / word) if word == "aside" else word for word in more]
    assert main(command(recording, tmp_path / "run", *more, camera=camera)) == 2
    assert message in capsys.readouterr().err
