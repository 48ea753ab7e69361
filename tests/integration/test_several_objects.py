"""Two rendered sheets in one image, one of which passes in front of the other."""

import cv2
import numpy as np
import pytest

from morph_dslam.cli.app import main
from morph_dslam.evaluation.run_folder import load_run
from morph_dslam.geometry import RigidTransform, rotation_exp
from morph_dslam.io.camera_files import save_camera
from morph_dslam.io.landmarks import Landmarks, save_landmarks
from morph_dslam.model import save_model
from morph_dslam.registration.registration import Registration
from morph_dslam.tracking.estimator import State
from morph_dslam.tracking.multi_object import ObjectTracker
from morph_dslam.tracking.tracker import Tracker
from tests.support.bent_sheet import bent_sheet_model
from tests.support.rendered_sequence import CAMERA, UPRIGHT, SheetFilm, mean_error, sheet_depth

TIMES = np.linspace(0.0, 1.0, 21)


@pytest.fixture(scope="module")
def model():
    return bent_sheet_model(43, 31)


@pytest.fixture(scope="module")
def films(model):
    return {"behind": SheetFilm(model, seed=1), "before": SheetFilm(model, seed=2)}


def states(time):
    """The sheet behind bends; the one before passes it from right to left."""
    bend = np.array([0.03 * np.sin(4.0 * time), 0.2, 0.1])
    behind = RigidTransform(rotation_exp(np.array([0.1, 0.2, 0.1 * time])) @ UPRIGHT, np.array([-0.1, 0.0, 0.9]))
    before = RigidTransform(
        rotation_exp(np.array([0.0, -0.3, 0.0])) @ UPRIGHT, np.array([0.33 - 0.35 * time, 0.12, 0.75])
    )
    return {"behind": State(bend, behind), "before": State(np.array([0.02, 0.0, 0.05]), before)}


def frame(model, films, time):
    """Both sheets, the nearer one before the other."""
    images = {name: film.frame(states(time)[name]) for name, film in films.items()}
    no_noise = np.random.default_rng(0)
    depths = {name: sheet_depth(model, states(time)[name], no_noise, 0.0, 9.0) for name in films}
    nearer = depths["before"] < depths["behind"]
    return np.where(nearer[:, :, None], images["before"], images["behind"])


def new_trackers(model, films):
    first = frame(model, films, 0.0)
    return {name: Tracker(model, CAMERA, Registration(model, states(0.0)[name]), reference=first) for name in films}


def test_object_that_passes_before_another_one_costs_it_no_accuracy(model, films):
    objects = ObjectTracker(new_trackers(model, films))
    errors = {name: [] for name in films}
    visible = []
    for time in TIMES[1:]:
        results = objects.track(frame(model, films, time))
        for name, result in results.items():
            assert result.status == "tracked", (name, time, result.reason)
            errors[name].append(mean_error(model, result.estimate.state, states(time)[name]))
        visible.append(results["behind"].n_points)
    assert max(errors["before"]) < 0.3e-3
    # Two thirds of its points are hidden at last.
    assert min(visible) < 0.4 * visible[0]
    assert np.mean(errors["behind"]) < 0.3e-3
    assert max(errors["behind"]) < 1.0e-3


def test_hidden_points_are_known_to_be_hidden(model, films):
    """By themselves, points behind the other sheet count as visible, and have to be thrown out by looks."""
    aware, unaware = ObjectTracker(new_trackers(model, films)), new_trackers(model, films)["behind"]
    for time in TIMES[1:]:
        image = frame(model, films, time)
        counts = aware.track(image)["behind"].n_points, unaware.track(image).n_points
    tracker = aware.trackers["behind"]
    positions = tracker.reference.points.in_camera(states(1.0)["behind"])
    pixels = np.rint(CAMERA.project(positions)).astype(int)
    depth = sheet_depth(model, states(1.0)["before"], np.random.default_rng(0), 0.0, 9.0)
    hidden = depth[pixels[:, 1], pixels[:, 0]] < positions[:, 2]
    assert hidden.sum() > 60
    assert counts[0] <= counts[1] - hidden.sum()


def test_lost_object_hides_nothing(model, films):
    objects = ObjectTracker(new_trackers(model, films))
    for time in TIMES[1:14]:
        before = objects.track(frame(model, films, time))
    results = objects.track(films["behind"].frame(states(TIMES[14])["behind"]))
    assert results["before"].status == "lost"
    assert results["behind"].n_points > before["behind"].n_points + 80


@pytest.fixture(scope="module")
def recording(model, films, tmp_path_factory):
    """Frames, model, camera, and landmarks of both sheets in the first frame."""
    folder = tmp_path_factory.mktemp("recording")
    (folder / "frames").mkdir()
    for number, time in enumerate(TIMES[:12:2]):
        cv2.imwrite(str(folder / "frames" / f"{number:03d}.png"), frame(model, films, time))
    save_model(folder / "sheet.morph", model)
    save_camera(folder / "camera.yaml", CAMERA)
    nodes = np.random.default_rng(0).choice(len(model.nodes), 24, replace=False)
    for name, state in states(0.0).items():
        positions = state.camera_from_object.apply(model.positions(state.parameters))
        pixels = CAMERA.project(positions)[nodes]
        inside = (pixels > 5.0).all(axis=1) & (pixels < [635.0, 475.0]).all(axis=1)
        landmarks = Landmarks(model.nodes[nodes[inside]], pixels[inside])
        save_landmarks(folder / f"{name}.csv", landmarks)
    return folder


def command(recording, output, *more):
    arguments = [str(recording / "frames"), "--model", str(recording / "sheet.morph"), "--camera"]
    arguments += [str(recording / "camera.yaml"), "--landmarks", str(recording / "behind.csv")]
    return ["track", *arguments, "-o", str(output), "--no-video", *more]


def test_command_writes_a_run_folder_for_each_object(model, recording, tmp_path, capsys):
    also = ["--also", "before", str(recording / "sheet.morph"), str(recording / "before.csv")]
    assert main(command(recording, tmp_path / "run", *also)) == 0
    assert capsys.readouterr().out.count("tracked=6/6") == 2
    for folder, name in ((tmp_path / "run", "behind"), (tmp_path / "run" / "before", "before")):
        run = load_run(folder)
        for row, time in enumerate(TIMES[:12:2]):
            state = states(time)[name]
            exact = state.camera_from_object.apply(model.positions(state.parameters))
            assert np.linalg.norm(run.camera_points(row) - exact, axis=1).mean() < 0.5e-3


@pytest.mark.parametrize("name", ["a/b", "..", "plots"])
def test_names_that_are_no_folders_are_refused(recording, tmp_path, capsys, name):
    also = ["--also", name, str(recording / "sheet.morph"), str(recording / "before.csv")]
    assert main(command(recording, tmp_path / "run", *also)) == 2
    assert "cannot be the name of another object's folder" in capsys.readouterr().err
