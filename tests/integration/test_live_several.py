"""Several anchored objects in a live stream, against exact truth."""

import json
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from morph_dslam.cli.app import main
from morph_dslam.evaluation.run_folder import load_run
from morph_dslam.geometry import RigidTransform
from morph_dslam.model import load_model
from morph_dslam.render.rasteriser import rasterise
from morph_dslam.sources import Frame
from morph_dslam.tracking.drawing import AugmentedView, DrawOptions
from morph_dslam.tracking.estimator import State
from morph_dslam.tracking.live import LivePicture
from tests.support.rendered_anchored_rig import FRAMES, RIG, SCAN
from tests.support.tracked_rig import column, errors, exact_nodes

CAMERA = RIG[0].camera


def command(folder, output, *more):
    arguments = [folder / "front", "--camera", folder / "camera.yaml", "--range", f"{SCAN - 1}-{FRAMES - 1}"]
    arguments += ["--model", folder / "sheet.morph", "--registration", folder / "sheet" / "adjusted.json"]
    arguments += ["--also", "wedge", folder / "wedge.morph", folder / "wedge" / "adjusted.json", "-o", output]
    return ["live", *map(str, [*arguments, *more])]


def test_two_objects_are_tracked_live_in_one_map(rig_recording, tmp_path, capsys):
    folder, truth = rig_recording
    run = tmp_path / "run"
    assert main(command(folder, run, "--show", "displacement")) == 0
    said = capsys.readouterr().out
    assert f"wrote {run / 'wedge'}" in said
    frames = load_run(run).frames
    assert said.count(f"tracked={len(frames)}/{len(frames)} fps=") == 2
    assert frames[-1] == FRAMES - 1
    for name, output in (("sheet", run), ("wedge", run / "wedge")):
        np.testing.assert_array_equal(load_run(output).frames, frames)
        # The keyframes' poses are 0.28 mm off.
        assert errors(folder, truth, name, output).max() < 0.6e-3
        assert set(column(output, "pose_from")) == {"points and map"}
        summary = json.loads((output / "summary.json").read_text())
        assert summary["live"]["n_dropped"] == FRAMES - SCAN + 1 - len(frames)
    # There is one picture of both.
    capture = cv2.VideoCapture(str(run / "augmented.mp4"))
    assert int(capture.get(cv2.CAP_PROP_FRAME_COUNT)) == frames[-1] - frames[0] + 1
    capture.release()
    assert not (run / "wedge" / "augmented.mp4").exists()


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ([], "the models hold different fields to colour the objects by"),
        (["--show", "displacement", "--pose", "free"], "in the map that they are all"),
        (["--show", "displacement", "--outline"], "in the map that they are all"),
        (["--show", "displacement", "--reregister-at", "40=a.csv"], "leave out --reregister-at"),
    ],
)
def test_what_does_not_fit_several_live_objects_is_refused(rig_recording, tmp_path, capsys, more, message):
    assert main(command(rig_recording[0], tmp_path / "run", *more)) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


def result_of(folder, truth, name, frame):
    of_object = truth[name]
    pose = RigidTransform.from_matrix(of_object["camera_from_object"][frame])
    state = State(of_object["parameters"][frame], pose)
    return SimpleNamespace(estimate=SimpleNamespace(state=state), discrepancy=None, reason="followed")


def covered(folder, truth, name, frame):
    """Where the object is in the picture, without its rim."""
    nodes, triangles = exact_nodes(folder, truth, name, frame), load_model(folder / f"{name}.morph").triangles
    drawn = rasterise(CAMERA.project(nodes), nodes[:, 2], triangles, CAMERA.height, CAMERA.width).covered
    return cv2.erode(drawn.astype(np.uint8), np.ones((7, 7), np.uint8)) > 0


def test_the_nearest_object_is_drawn_over_the_others(rig_recording):
    folder, truth = rig_recording
    views = {
        name: AugmentedView(load_model(folder / f"{name}.morph"), CAMERA, DrawOptions("displacement"))
        for name in ("wedge", "sheet")
    }
    picture, frame = LivePicture(CAMERA, views), Frame(FRAMES - 1, 0.0, np.full((360, 480, 3), 90, np.uint8))
    results = {name: result_of(folder, truth, name, FRAMES - 1) for name in views}
    lost = SimpleNamespace(estimate=None, discrepancy=None, reason="lost: covered")

    def drawn(**changes):
        return picture.draw(frame, results | changes).astype(int)

    together, only_sheet, only_wedge = drawn(), drawn(wedge=lost), drawn(sheet=lost)
    both = np.logical_and(*(covered(folder, truth, name, FRAMES - 1) for name in views))
    assert both.sum() > 1000
    away = [np.abs(together - only)[both].mean() for only in (only_wedge, only_sheet)]
    assert away[0] < 0.6 * away[1]
    beside = covered(folder, truth, "sheet", FRAMES - 1) & ~both
    beside[:, 400:] = False  # the colour bar
    wedge = cv2.dilate((np.abs(only_wedge - 90).sum(axis=2) > 0).astype(np.uint8), np.ones((5, 5))) > 0
    np.testing.assert_array_equal(together[beside & ~wedge], only_sheet[beside & ~wedge])
    # Only where it says so is a picture without any object different.
    neither = drawn(wedge=lost, sheet=lost)
    changed = np.argwhere(np.abs(neither - 90).sum(axis=2) > 0)
    assert len(changed)
    assert changed[:, 0].min() > 330
