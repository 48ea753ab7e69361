"""A rigid box without parameters, rendered in motion and tracked against its true poses."""

import json

import numpy as np
import pytest

from morph_dslam import SimulatedSequence, Tracker, TrackerOptions, register_landmarks
from morph_dslam.cli import main

BOX = """
v 0 0 0\nv 80 0 0\nv 0 60 0\nv 80 60 0\nv 0 0 50\nv 80 0 50\nv 0 60 50\nv 80 60 50
f 1 3 4 2\nf 5 6 8 7\nf 1 2 6 5\nf 3 7 8 4\nf 1 5 7 3\nf 2 4 8 6
"""
SCENE = """
model = "box.morph"
frames = 12
camera = { width = 480, height = 360, fx = 420.0, fy = 420.0, cx = 239.5, cy = 179.5 }
[surface]
texture = "coffee"
[background]
colour = [120, 124, 128]
[sensor]
blur_px = 0.6
noise = 2.0
[[pose]]
frame = 0
position_mm = [-40, -20, 330]
rotation_deg = [215, 30, 10]
[[pose]]
frame = 11
position_mm = [-30, -25, 300]
rotation_deg = [230, 50, 18]
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("rigid")
    (folder / "box.obj").write_text(BOX)
    (folder / "scene.toml").write_text(SCENE)
    built = main(["build", "--rigid", str(folder / "box.obj"), "--unit", "mm", "-o", str(folder / "box.morph")])
    assert built == 0
    return folder


@pytest.mark.parametrize("use_outline", [False, True], ids=["texture", "outline too"])
def test_the_pose_alone_is_tracked(folder, use_outline):
    sequence = SimulatedSequence(folder / "scene.toml")
    start = register_landmarks(sequence.model, sequence.camera, sequence.landmarks)
    tracker = Tracker(sequence.model, sequence.camera, start, TrackerOptions(use_outline=use_outline))
    nodes, errors = sequence.model.nodes, []
    for frame, true in zip(sequence, sequence.camera_from_object, strict=True):
        result = tracker.track(frame)
        assert result.tracked
        assert result.parameters == {}
        assert not result.displacement().any()
        assert result.pose is not None
        errors.append(np.linalg.norm(result.pose.apply(nodes) - true.apply(nodes), axis=1).max())
    # A third of a pixel is 0.25 mm at 300 mm.
    assert max(errors) < 0.25e-3


def test_command_line_tracks_draws_and_writes_what_a_rigid_object_has(folder, capsys):
    sequence, run = folder / "seq", folder / "run"
    assert main(["simulate", str(folder / "scene.toml"), "-o", str(sequence)]) == 0
    files = ["--camera", str(sequence / "camera.yaml"), "--landmarks", str(sequence / "landmarks.csv")]
    command = ["track", str(sequence / "frames"), "--model", str(folder / "box.morph"), *files]
    assert main([*command, "-o", str(run)]) == 0
    summary = json.loads((run / "summary.json").read_text())
    # Twelve frames do not show the camera, which is said; they do not accuse the right one.
    assert (summary["n_tracked"], [notice["kind"] for notice in summary["notices"]]) == (12, ["remark"])
    assert not any(term["is_wrong"] for term in summary["camera"].values())
    assert not summary["camera"]["focal"]["is_observable"]
    assert {path.name for path in (run / "plots").iterdir()} == {"residual.png", "timings.png"}
    assert (run / "augmented.mp4").stat().st_size > 1000
    capsys.readouterr()
    for option, message in (
        (["--show", "stress"], "holds no stress to show"),
        (["--per-sequence", "lever"], "'lever' cannot be one over the sequence: the model's parameters are none"),
        (["--section", "x=20"], "it has no inside to show in a section"),
    ):
        assert main([*command, *option, "-o", str(folder / "other")]) == 2
        assert message in capsys.readouterr().err
