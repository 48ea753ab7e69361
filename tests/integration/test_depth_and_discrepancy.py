"""`morph track` with depth, and of a sheet that skews and twists with a model that can only arch."""

import json
import re
import shutil

import cv2
import numpy as np
import pytest

from morph_dslam import open_live, open_source
from morph_dslam.cli.app import main
from morph_dslam.errors import SourceError
from morph_dslam.evaluation.run_folder import load_run
from morph_dslam.io.camera_files import save_camera
from morph_dslam.io.landmarks import Landmarks, save_landmarks
from morph_dslam.model import save_model
from tests.support.bent_sheet import bent_sheet_model
from tests.support.rendered_sequence import (
    CAMERA,
    SheetFilm,
    sheet_depth,
    sheet_state,
    write_landmarks,
    write_recording,
)

TIMES = np.linspace(0.0, 0.9, 28)


@pytest.fixture(scope="module")
def inputs(tmp_path_factory):
    """Frames, a model without skew and twist, camera and landmarks of the first frame."""
    folder = tmp_path_factory.mktemp("sequence")
    model = bent_sheet_model()
    film = SheetFilm(model)
    images = {number: film.frame(sheet_state(time)) for number, time in enumerate(TIMES)}
    write_recording(folder, images, bent_sheet_model(known=1))
    write_landmarks(folder / "landmarks.csv", model, sheet_state(TIMES[0]))
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


@pytest.mark.slow
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


DEPTH_TIMES = np.linspace(0.0, 0.24, 7)


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    """Frames with depth, model, camera, and landmarks of the first frame as a hand sets them."""
    folder = tmp_path_factory.mktemp("recording")
    model, rng = bent_sheet_model(43, 31), np.random.default_rng(3)
    film, lists = SheetFilm(model), {"rgb": [], "depth": []}
    for kind in lists:
        (folder / kind).mkdir()
    for number, time in enumerate(DEPTH_TIMES):
        state = sheet_state(time)
        images = {"rgb": film.frame(state), "depth": (5000.0 * sheet_depth(model, state, rng))}
        images["depth"] = np.rint(images["depth"]).astype(np.uint16)
        for kind, image in images.items():
            cv2.imwrite(str(folder / kind / f"{number}.png"), image)
            lists[kind].append(f"{0.1 * number:.6f} {kind}/{number}.png")
    for kind, lines in lists.items():
        (folder / f"{kind}.txt").write_text("\n".join(lines) + "\n")
    save_model(folder / "sheet.morph", model)
    save_camera(folder / "camera.yaml", CAMERA)
    state, nodes = sheet_state(0.0), rng.choice(len(model.nodes), 14, replace=False)
    seen = CAMERA.project(state.camera_from_object.apply(model.positions(state.parameters)))[nodes]
    landmarks = Landmarks(model.nodes[nodes], seen + 1.0 * rng.standard_normal((14, 2)))
    save_landmarks(folder / "landmarks.csv", landmarks)
    return folder


def tracked_from(recording, output, *more):
    arguments = [str(recording), "--model", str(recording / "sheet.morph"), "--camera"]
    arguments += [str(recording / "camera.yaml"), "--landmarks", str(recording / "landmarks.csv")]
    assert main(["track", *arguments, "-o", str(output), "--no-video", *more]) == 0
    return load_run(output)


def along_the_sight_line(run):
    """Mean error of all nodes in all frames along the optical axis, metres."""
    model, errors = bent_sheet_model(43, 31), []
    for row, time in enumerate(DEPTH_TIMES):
        truth = sheet_state(time)
        exact = truth.camera_from_object.apply(model.positions(truth.parameters))
        errors.append(np.abs(run.camera_points(row) - exact)[:, 2].mean())
    return np.mean(errors)


@pytest.fixture(scope="module")
def with_depth(recording, tmp_path_factory):
    """The folder and the run that the depth images count in."""
    folder = tmp_path_factory.mktemp("with_depth") / "run"
    return folder, tracked_from(recording, folder, "--depth")


def test_depth_puts_the_object_right_along_the_sight_line(recording, with_depth, tmp_path):
    without = along_the_sight_line(tracked_from(recording, tmp_path / "without"))
    folder, run = with_depth
    assert without > 1.0e-3
    assert along_the_sight_line(run) < 0.5 * without
    summary = json.loads((folder / "summary.json").read_text())
    assert summary["depth_used"] is True
    assert summary["registration"]["depth_scale"]["std"] < 0.01


def test_depths_that_are_all_too_large_do_not_move_the_object_by_as_much(recording, with_depth, tmp_path):
    """By twice their deviation, 11 mm there: what landmarks find of it counts in all frames."""
    shutil.copytree(recording, tmp_path / "larger")
    for path in (tmp_path / "larger" / "depth").iterdir():
        depth = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        cv2.imwrite(str(path), np.rint(1.02 * depth.astype(float)).astype(np.uint16))
    found = tracked_from(tmp_path / "larger", tmp_path / "run", "--depth")
    assert along_the_sight_line(found) < along_the_sight_line(with_depth[1]) + 1e-3


@pytest.mark.slow
def test_depth_images_in_millimetres(recording, with_depth, tmp_path, refused):
    """As RealSense and Kinect cameras write them; read as 5000 values a metre they are a fifth of the distances."""
    shutil.copytree(recording, tmp_path / "mm")
    for path in (tmp_path / "mm" / "depth").iterdir():
        depth = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        cv2.imwrite(str(path), np.rint(depth / 5.0).astype(np.uint16))
    found = tracked_from(tmp_path / "mm", tmp_path / "run", "--depth", "--depth-per-metre", "1000")
    assert along_the_sight_line(found) == pytest.approx(along_the_sight_line(with_depth[1]), abs=2e-4)
    files = ["--model", recording / "sheet.morph", "--camera", recording / "camera.yaml"]
    start = ["--landmarks", recording / "landmarks.csv", "-o", tmp_path / "none"]
    said = refused("track", tmp_path / "mm", *files, *start, "--depth")
    ratio = re.search(r"the measured ones are (\S+) times those", said)
    assert float(ratio[1]) == pytest.approx(0.2, rel=0.05)
    assert "correct --depth-per-metre, the scale of the depth images (5000 values a metre" in said
    # Live and before it is tracked, it is read the same way.
    with open_live(tmp_path / "mm", depth_per_metre=1000) as live:
        depth = next(iter(live)).depth
    np.testing.assert_allclose(depth, next(iter(open_source(recording))).depth, atol=6e-4)
    assert "leave --depth-per-metre out" in refused(
        "track", recording / "rgb", *files, *start, "--depth", "--depth-per-metre", 1000
    )
    with pytest.raises(SourceError, match="cannot have 0 values a metre"):
        open_source(recording, depth_per_metre=0.0)


def test_recording_without_depth_is_refused(recording, tmp_path, refused):
    arguments = ["--model", str(recording / "sheet.morph"), "--camera", str(recording / "camera.yaml")]
    arguments += ["--landmarks", str(recording / "landmarks.csv"), "-o", str(tmp_path / "run")]
    assert "has no depth images that belong to its pixels" in refused("track", recording / "rgb", *arguments, "--depth")
