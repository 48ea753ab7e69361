"""A sheet that skews and twists, tracked with a model that can only arch: what it has beyond the model."""

import json

import cv2
import numpy as np
import pytest

from morph_dslam.cli.app import main
from morph_dslam.evaluation.run_folder import load_run
from morph_dslam.io.camera_files import save_camera
from morph_dslam.io.landmarks import Landmarks, save_landmarks
from morph_dslam.model import save_model
from tests.support.bent_sheet import bent_sheet_model
from tests.support.rendered_sequence import CAMERA, SheetFilm, sheet_state

TIMES = np.linspace(0.0, 0.9, 28)


@pytest.fixture(scope="module")
def inputs(tmp_path_factory):
    """Frames, a model without skew and twist, camera and landmarks of the first frame."""
    folder = tmp_path_factory.mktemp("sequence")
    model = bent_sheet_model()
    film = SheetFilm(model)
    (folder / "frames").mkdir()
    for number, time in enumerate(TIMES):
        cv2.imwrite(str(folder / "frames" / f"{number:06d}.png"), film.frame(sheet_state(time)))
    save_model(folder / "sheet.morph", bent_sheet_model(known=1))
    save_camera(folder / "camera.yaml", CAMERA)
    nodes = np.random.default_rng(0).choice(len(model.nodes), 16, replace=False)
    state = sheet_state(TIMES[0])
    seen = CAMERA.project(state.camera_from_object.apply(model.positions(state.parameters)))[nodes]
    save_landmarks(folder / "landmarks.csv", Landmarks(model.nodes[nodes], seen))
    return folder


def tracked(inputs, name, *options):
    folder = inputs / name
    files = ["--model", inputs / "sheet.morph", "--camera", inputs / "camera.yaml"]
    start = ["--landmarks", inputs / "landmarks.csv", "--no-video", "--one-view", "-o", folder]
    command = ["track", inputs / "frames", *files, *start, *options]
    assert main([str(word) for word in command]) == 0
    return folder, load_run(folder)


def errors(run):
    """Mean distance (f,) of all nodes from the truth in the camera frame, metres."""
    truth, found = bent_sheet_model(), []
    for row, time in enumerate(TIMES):
        state = sheet_state(time)
        nodes = state.camera_from_object.apply(truth.positions(state.parameters))
        found.append(np.linalg.norm(run.camera_points(row) - nodes, axis=1).mean())
    return np.array(found)


def test_the_shape_beyond_the_model_is_found_over_the_sequence(inputs):
    _, plain = tracked(inputs, "plain", "--refine")
    folder, found = tracked(inputs, "found", "--refine", "--discrepancy")
    assert plain.tracked.all()
    assert found.tracked.all()
    assert errors(plain).mean() > 3e-3
    assert errors(found).mean() < 0.5 * errors(plain).mean()
    summary = json.loads((folder / "summary.json").read_text())
    assert summary["discrepancy_used"] is True
    # Skew and twist move a corner by up to 12 and 30 mm beyond the arch.
    assert 5.0 < summary["beyond_model_mm"]["largest"] < 45.0
