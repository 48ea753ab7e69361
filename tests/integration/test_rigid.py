"""A rigid box without parameters, rendered in motion and tracked against its true poses."""

import json
from dataclasses import replace

import numpy as np
import pytest

from morph_dslam import SimulatedSequence, Tracker, TrackerOptions, load_model, register_landmarks
from morph_dslam.camera import Camera
from morph_dslam.cli import main
from morph_dslam.geometry import RigidTransform, rotation_exp
from morph_dslam.io.landmarks import Landmarks, save_landmarks
from morph_dslam.io.trajectory import Trajectory, save_trajectory
from morph_dslam.model import Parameter, SeparatedField, save_model
from morph_dslam.registration.messages import LandmarksTurnedAway
from morph_dslam.tracking.drawing import AugmentedView
from morph_dslam.tracking.estimator import State
from tests.support.bent_tube import polynomial

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


@pytest.fixture(scope="module")
def command(folder, blank_figures):
    """Tracks the recording; the run is in the folder."""
    sequence = folder / "seq"
    assert main(["simulate", str(folder / "scene.toml"), "-o", str(sequence)]) == 0
    files = ["--camera", str(sequence / "camera.yaml"), "--landmarks", str(sequence / "landmarks.csv")]
    command = ["track", str(sequence / "frames"), "--model", str(folder / "box.morph"), *files]
    with blank_figures():
        assert main([*command, "-o", str(folder / "run")]) == 0
    return command


def test_command_line_tracks_draws_and_writes_what_a_rigid_object_has(folder, command, capsys):
    run = folder / "run"
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
        (["--per-sequence", "lever"], "'lever' cannot be a per-sequence parameter: the model's parameters are none"),
        (["--section", "x=20"], "it has no inside to show in a section"),
    ):
        assert main([*command, *option, "-o", str(folder / "other")]) == 2
        assert message in capsys.readouterr().err


@pytest.mark.usefixtures("command")
def test_the_path_of_the_camera_about_the_object_is_evaluated(folder, tmp_path, capsys):
    sequence = SimulatedSequence(folder / "scene.toml")
    poses = np.array([pose.inverse.matrix for pose in sequence.camera_from_object])
    save_trajectory(tmp_path / "truth.txt", Trajectory(np.arange(12) / 30.0, poses))
    assert main(["evaluate", str(folder / "run"), "--trajectory", str(tmp_path / "truth.txt")]) == 0
    line = capsys.readouterr().out
    figures = dict(word.split("=") for word in line.split() if "=" in word)
    assert figures["pairs"] == "12/12"
    assert float(figures["ate_se3_mm"]) < 1.0
    assert float(figures["scale"]) == pytest.approx(1.0, abs=0.02)


@pytest.mark.parametrize(("mirrored", "expected"), [(False, []), (True, [6])])
def test_landmarks_on_the_back_are_said_to_be(folder, mirrored, expected):
    """All on the upper face, which the camera looks at; y the other way fits as well, with the face turned away."""
    model, camera = load_model(folder / "box.morph"), Camera(480, 360, 3000.0, 3000.0, 239.5, 179.5)
    points = 1e-3 * np.array(
        [[0, 0, 50], [80, 0, 50], [80, 60, 50], [0, 60, 50], [40, 0, 50], [30, 20, 50]], dtype=float
    )
    pose = RigidTransform(rotation_exp(np.array([np.pi + 0.05, 0.0, 0.0])), np.array([-0.04, 0.03, 1.5]))
    pixels = camera.project(pose.apply(points))
    if mirrored:
        points = points * [1.0, -1.0, 1.0] + [0.0, 0.06, 0.0]
    found = register_landmarks(model, camera, Landmarks(points, pixels)).warnings
    assert [warning.turned_away for warning in found if isinstance(warning, LandmarksTurnedAway)] == expected


def test_the_edges_that_are_seen_are_drawn(folder):
    """In pose 0 of the scene, of the corner that is nearest to the camera three edges run through the drawing."""
    sequence = SimulatedSequence(folder / "scene.toml")
    pose, camera = sequence.camera_from_object[0], sequence.camera
    view, black = AugmentedView(sequence.model, camera), np.zeros((360, 480, 3), np.uint8)
    drawn = view.draw(black, State(np.zeros(0), pose), (0.0, 1.0), "")
    corners = 1e-3 * np.array([[x, y, z] for x in (0, 80) for y in (0, 60) for z in (0, 50)], dtype=float)
    nearest = corners[np.linalg.norm(pose.apply(corners), axis=1).argmin()]
    opposite = 1e-3 * np.array([80.0, 60.0, 50.0]) - nearest
    for axis in range(3):
        along = np.where(np.arange(3) == axis, opposite, nearest)
        for share in (0.3, 0.5, 0.7):
            column, row = np.round(camera.project(pose.apply([nearest + share * (along - nearest)])))[0].astype(int)
            assert drawn[row - 1 : row + 2, column - 1 : column + 2].min(axis=2).max() > 200
    # Nor is a face white.
    faces = camera.project(pose.apply([nearest + 0.4 * (opposite - nearest) * [1, 1, 0]]))[0].round().astype(int)
    assert drawn[faces[1], faces[0]].max() < 200


@pytest.fixture(scope="module")
def halves(folder):
    """The arguments of one half of the box, which can shear and holds stress and a force, and of the rigid other."""
    sequence, linear = SimulatedSequence(folder / "scene.toml"), polynomial([[0.05], [0.05]])
    whole, corners, pose = sequence.model, sequence.landmarks.points, sequence.camera_from_object[0]
    for name, begin in (("soft", 0.0), ("hard", 40.0)):
        points = corners * [0.5, 1.0, 1.0] + 1e-3 * np.array([begin, 0.0, 0.0])
        save_landmarks(folder / f"{name}.csv", Landmarks(points, sequence.camera.project(pose.apply(points))))
        half = replace(whole, name=name, nodes=whole.nodes * [0.5, 1.0, 1.0] + 1e-3 * np.array([begin, 0.0, 0.0]))
        if name == "soft":
            zero = np.zeros(len(half.nodes))
            half = replace(
                half,
                parameters=(Parameter("shear", "ratio", "1", 0.0, 2.0, 0.0),),
                displacement=SeparatedField(np.column_stack([half.nodes[:, 2], zero, zero])[None], linear),
                stresses={"solid": SeparatedField(np.full((1, len(zero), 6), 1e5), linear)},
                supports={"bottom": np.flatnonzero(half.nodes[:, 2] < 1e-6)},
                reactions={"force_bottom": SeparatedField(np.full((1, 1, 3), 10.0), linear)},
            )
        save_model(folder / f"{name}.morph", half)
    soft = ["--model", folder / "soft.morph", "--landmarks", folder / "soft.csv"]
    return [*map(str, [*soft, "--also", "hard", folder / "hard.morph", folder / "hard.csv"])]


@pytest.mark.slow
@pytest.mark.parametrize("option", [["--forces"], ["--show", "stress"], []])
@pytest.mark.usefixtures("command")
def test_what_is_drawn_of_a_deformable_object_is_not_asked_of_a_rigid_one(folder, halves, tmp_path, option):
    frames = [str(folder / "seq" / "frames"), "--camera", str(folder / "seq" / "camera.yaml")]
    run = "track" if option else "live"  # which colours all by the same field
    assert main([run, *frames, *halves, *option, "-o", str(tmp_path / "run")]) == 0
