"""The commands in a row on a rendered sequence with known truth."""

import json
import re

import cv2
import h5py
import numpy as np
import pytest

from morph_dslam import load_model
from morph_dslam.cli import app as cli
from tests.support.block_study import STUDY
from tests.support.scenes import write_scene

CAMERA = "camera = { width = 480, height = 360, fx = 430.0, fy = 430.0, cx = 239.5, cy = 179.5 }\n"
MOTION = """
[sensor]
blur_px = 0.5
noise = 1.5

[occluder]
radius_px = 24.0
path = [{ frame = 4, centre_px = [-40.0, 180.0] }, { frame = 15, centre_px = [300.0, 180.0] }]

[[parameters]]
frame = 0
arch = 8.0
[[parameters]]
frame = 8
arch = 40.0
twist = 8.0
[[parameters]]
frame = 15
arch = -15.0
skew = 0.2

[[pose]]
frame = 0
position_mm = [0, 0, 520]
[[pose]]
frame = 15
position_mm = [15, -10, 560]
rotation_deg = [190, -10, 4]
"""


@pytest.fixture(scope="module")
def sequence(tmp_path_factory):
    """A folder with `sheet.morph`, `seq/` and `run/`, all made by the command line."""
    folder = tmp_path_factory.mktemp("chain")
    scene = write_scene(folder, "frames = 16\n", MOTION, CAMERA)
    assert cli.main(["simulate", str(scene), "-o", str(folder / "seq")]) == 0
    assert cli.main(track_command(folder, "--frame-log", str(folder / "frames.jsonl"))) == 0
    return folder


def track_command(folder, *options, **changed):
    """The arguments of `morph track` for the sequence, with inputs or options changed by name."""
    inputs = {
        "frames": folder / "seq" / "frames",
        "model": folder / "sheet.morph",
        "camera": folder / "seq" / "camera.yaml",
        "landmarks": folder / "seq" / "landmarks.csv",
        "output": folder / "run",
    } | changed
    frames = inputs.pop("frames")
    return ["track", str(frames), *(f"--{name}={value}" for name, value in inputs.items()), *options]


def test_the_commands_in_a_row_find_the_truth(sequence, capsys):
    command = ["evaluate", sequence / "run", "--points", sequence / "seq" / "truth.npz", "--bind-frame", "0"]
    assert cli.main([str(word) for word in command]) == 0
    last = capsys.readouterr().out.splitlines()[-1]
    assert re.fullmatch(
        r"mean_mm=[\d.]+ median_mm=[\d.]+ p95_mm=[\d.]+ tracked=16/16 median_ms=[\d.]+ p95_ms=[\d.]+ rigid_mm=[\d.]+",
        last,
    )
    figures = json.loads((sequence / "run" / "evaluation.json").read_text())
    assert figures["mean_mm"] < 1.0
    assert figures["n_points_bound"] == figures["n_points"]
    with h5py.File(sequence / "run" / "result.h5") as file:
        parameters, poses = file["parameters"][()], file["camera_from_object"][()]
    truth = np.load(sequence / "seq" / "truth.npz")
    assert np.abs(parameters[:, 0] - truth["parameters"][:, 0]).max() < 2e-3  # arch, m
    assert np.abs(poses[:, :3, 3] - truth["camera_from_object"][:, :3, 3]).max() < 3e-3  # m


def test_the_frame_log_has_a_line_for_each_frame(sequence):
    rows = [json.loads(line) for line in (sequence / "frames.jsonl").read_text().splitlines()]
    with h5py.File(sequence / "run" / "result.h5") as file:
        assert [row["frame"] for row in rows] == file["frame"][()].tolist()
        assert [row["status"] for row in rows] == file["status"].asstr()[()].tolist()
        for key, name in (("camera_from_object", "camera_from_object"), ("largest_von_mises", "largest_von_mises")):
            np.testing.assert_array_equal([row[key] for row in rows], file[name][()])
        np.testing.assert_array_equal([list(row["parameters"].values()) for row in rows], file["parameters"][()])


def test_a_recording_that_never_shows_the_object_ends_as_an_error_and_keeps_its_run(sequence, tmp_path, refused):
    (tmp_path / "grey").mkdir()
    for frame in range(3):
        cv2.imwrite(str(tmp_path / "grey" / f"{frame}.png"), np.full((360, 480, 3), 120, np.uint8))
    options = {"frames": tmp_path / "grey", "output": tmp_path / "run"}
    message = refused(*track_command(sequence, "--outline", "--no-video", **options))
    assert f"was lost in every frame, for the reasons in {tmp_path}/run/frames.csv" in message
    with h5py.File(tmp_path / "run" / "result.h5") as file:
        assert file["status"].asstr()[()].tolist() == ["lost"] * 3


@pytest.fixture
def project(sequence, tmp_path):
    """A folder with what is needed to track, by names of its own."""
    for name, source in (
        ("rubber.morph", "sheet.morph"),
        ("phone.yaml", "seq/camera.yaml"),
        ("clicked.csv", "seq/landmarks.csv"),
        ("pictures", "seq/frames"),
    ):
        (tmp_path / name).symlink_to(sequence / source)
    (tmp_path / "notes.txt").write_text("filmed on Tuesday\n")
    (tmp_path / "forces.csv").write_text("frame,force_N\n0,0.0\n")
    return tmp_path


def test_what_is_not_named_is_found_in_the_folder(sequence, project, capsys):
    assert cli.main(["track", str(project), "--no-video", "--range", "0-"]) == 0
    command = capsys.readouterr().out.splitlines()[0].split()
    inputs = [f"{project}/{name}" for name in ("pictures", "rubber.morph", "phone.yaml", "clicked.csv", "run")]
    assert [word for word in command if str(project) in word] == inputs
    assert command[3:6] == ["--no-video", "--range", "0-"]
    with h5py.File(sequence / "run" / "result.h5") as named, h5py.File(project / "run" / "result.h5") as found:
        np.testing.assert_array_equal(found["parameters"][()], named["parameters"][()])


def test_what_a_folder_lacks_or_has_twice_is_named(project, refused):
    assert "name --camera, --output, --landmarks or another start too" in refused(
        "track", project / "pictures" / "000000.png", "--model", project / "rubber.morph"
    )
    (project / "webcam.yml").write_text((project / "phone.yaml").read_text())
    assert re.search(r"holds several: .*phone\.yaml, .*webcam\.yml; name one with --camera", refused("track", project))
    (project / "webcam.yml").unlink()
    (project / "more").symlink_to(project / "pictures")
    assert re.search(r"several recordings: .*more, .*pictures", refused("track", project))
    (project / "clicked.csv").unlink()
    assert "does not say where the object is" in refused("track", project)


@pytest.mark.slow
def test_a_model_is_built_from_the_study_in_the_folder(project, refused):
    """A block, whose landmarks are those of something else: the model is there, and the landmarks are refused."""
    (project / "rubber.morph").unlink()
    (project / "cube.toml").write_text(STUDY)
    assert "landmark" in refused("track", project)
    assert load_model(project / "cube.morph").name == "block"


def test_bad_input_is_one_message(sequence, tmp_path, refused):
    whole = (sequence / "sheet.morph").read_bytes()
    (tmp_path / "half.morph").write_bytes(whole[: len(whole) // 2])
    for changed, expected in (
        ({"frames": tmp_path / "absent.mp4"}, "absent.mp4"),
        ({"model": tmp_path / "half.morph"}, "is damaged or cut short"),
    ):
        assert expected in refused(*track_command(sequence, **changed, output=tmp_path / "run"))
        assert not (tmp_path / "run" / "result.h5").exists()
