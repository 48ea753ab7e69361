"""The commands in a row on a rendered sequence with known truth, and every bad input as one message."""

import json
import re
import shutil

import cv2
import h5py
import numpy as np
import pytest
import yaml

from morph_dslam import load_model
from morph_dslam.cli import app as cli
from morph_dslam.io.checksum import write_checksum
from morph_dslam.io.video import VideoWriter
from tests.support.real_data import ROOT
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
    assert cli.main(track_command(folder)) == 0
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


def refused(capsys, command):
    """The one message of a command that must end with status 2 and no traceback."""
    capsys.readouterr()
    assert cli.main([str(word) for word in command]) == 2
    messages = [line for line in capsys.readouterr().err.splitlines() if line.startswith("morph: ")]
    assert len(messages) == 1
    return messages[0]


def test_the_commands_in_a_row_find_the_truth(sequence, capsys):
    command = ["evaluate", sequence / "run", "--points", sequence / "seq" / "truth.npz", "--bind-frame", "0"]
    assert cli.main([str(word) for word in command]) == 0
    last = capsys.readouterr().out.splitlines()[-1]
    assert re.fullmatch(
        r"mean_mm=[\d.]+ median_mm=[\d.]+ p95_mm=[\d.]+ tracked=16/16 median_ms=[\d.]+ p95_ms=[\d.]+", last
    )
    figures = json.loads((sequence / "run" / "evaluation.json").read_text())
    assert figures["mean_mm"] < 1.0
    assert figures["n_points_bound"] == figures["n_points"]
    with h5py.File(sequence / "run" / "result.h5") as file:
        parameters, poses = file["parameters"][()], file["camera_from_object"][()]
    truth = np.load(sequence / "seq" / "truth.npz")
    assert np.abs(parameters[:, 0] - truth["parameters"][:, 0]).max() < 2e-3  # arch, m
    assert np.abs(poses[:, :3, 3] - truth["camera_from_object"][:, :3, 3]).max() < 3e-3  # m


def test_the_run_folder_is_whole(sequence):
    run = sequence / "run"
    capture = cv2.VideoCapture(str(run / "augmented.mp4"))
    assert int(capture.get(cv2.CAP_PROP_FRAME_COUNT)) == 16
    capture.release()
    rows = (run / "frames.csv").read_text().splitlines()
    assert len(rows) == 17
    assert json.loads((run / "summary.json").read_text())["n_tracked"] == 16
    kept, given = load_model(run / "model.morph"), load_model(sequence / "sheet.morph")
    mu = 0.7 * given.upper + 0.3 * given.lower
    np.testing.assert_allclose(kept.positions(mu), given.positions(mu), rtol=0.0, atol=1e-9)


def test_a_run_is_not_overwritten_unasked(sequence, capsys):
    before = (sequence / "run" / "result.h5").read_bytes()
    assert "holds a run already" in refused(capsys, track_command(sequence))
    assert (sequence / "run" / "result.h5").read_bytes() == before


def spoiled_camera(folder, tmp_path):
    camera = yaml.safe_load((folder / "seq" / "camera.yaml").read_text()) | {"width": 640, "height": 480}
    (tmp_path / "camera.yaml").write_text(yaml.safe_dump(camera))
    return {"camera": tmp_path / "camera.yaml"}


def halved_model(folder, tmp_path):
    whole = (folder / "sheet.morph").read_bytes()
    (tmp_path / "half.morph").write_bytes(whole[: len(whole) // 2])
    return {"model": tmp_path / "half.morph"}


def newer_model(folder, tmp_path):
    shutil.copyfile(folder / "sheet.morph", tmp_path / "newer.morph")
    with h5py.File(tmp_path / "newer.morph", "r+") as file:
        file.attrs["version"] = 7
    write_checksum(tmp_path / "newer.morph", "morph-dslam reduced model")
    return {"model": tmp_path / "newer.morph"}


def landmarks_of(folder, tmp_path, change):
    table = np.loadtxt(folder / "seq" / "landmarks.csv", delimiter=",", skiprows=1)
    path = tmp_path / "landmarks.csv"
    np.savetxt(path, change(table), delimiter=",", header="x_mm,y_mm,z_mm,u_px,v_px", comments="")
    return {"landmarks": path}


def off_the_object(folder, tmp_path):
    return landmarks_of(folder, tmp_path, lambda table: table * [1, 1, 1, 1, 1] + [0, 0, 80.0, 0, 0])


def scattered_pixels(folder, tmp_path):
    rng = np.random.default_rng(0)
    return landmarks_of(folder, tmp_path, lambda t: np.column_stack([t[:, :3], rng.uniform(0, 360, (len(t), 2))]))


def too_few_landmarks(folder, tmp_path):
    return landmarks_of(folder, tmp_path, lambda table: table[:3])


def empty_folder(folder, tmp_path):
    (tmp_path / "empty").mkdir()
    return {"frames": tmp_path / "empty"}


def undecodable_video(folder, tmp_path):
    (tmp_path / "video.mp4").write_bytes(b"not a video" * 1000)
    return {"frames": tmp_path / "video.mp4"}


BAD_INPUTS = {
    "frames missing": (lambda f, t: {"frames": t / "absent.mp4"}, r"absent\.mp4"),
    "no images": (empty_folder, "holds no images"),
    "not a video": (undecodable_video, r"video\.mp4"),
    "camera of another size": (spoiled_camera, "480x360 pixels but the camera file is for 640x480"),
    "camera missing": (lambda f, t: {"camera": t / "absent.yaml"}, "cannot read the camera file"),
    "half a model": (halved_model, "is damaged or cut short"),
    "newer model": (newer_model, "version 7, this release reads version 3: update morph-dslam"),
    "landmarks missing": (lambda f, t: {"landmarks": t / "absent.csv"}, "cannot read the landmarks"),
    "landmarks off the object": (off_the_object, "landmark"),
    "landmarks at random pixels": (scattered_pixels, "landmark"),
    "too few landmarks": (too_few_landmarks, "landmark"),
}


@pytest.mark.parametrize("case", BAD_INPUTS)
def test_bad_input_is_one_message(sequence, tmp_path, capsys, case):
    spoil, expected = BAD_INPUTS[case]
    changed = spoil(sequence, tmp_path) | {"output": tmp_path / "run"}
    assert re.search(expected, refused(capsys, track_command(sequence, **changed)))
    assert not (tmp_path / "run" / "result.h5").exists()


def test_frames_outside_the_sequence_are_refused(sequence, tmp_path, capsys):
    command = track_command(sequence, "--range=5-90", output=tmp_path / "run")
    assert "90" in refused(capsys, command)


def test_a_truncated_video_keeps_the_frames_before_the_break(sequence, tmp_path, capsys):
    video = tmp_path / "video.mp4"
    with VideoWriter(video, 30.0, (480, 360)) as writer:
        for path in sorted((sequence / "seq" / "frames").iterdir()):
            writer.write(cv2.imread(str(path)))
    # An mp4 cut in half has lost its index and cannot be opened at all; an image folder that breaks off can.
    video.write_bytes(video.read_bytes()[: video.stat().st_size // 2])
    assert str(video) in refused(capsys, track_command(sequence, frames=video, output=tmp_path / "run"))
    frames = tmp_path / "frames"
    shutil.copytree(sequence / "seq" / "frames", frames)
    broken = frames / "000009.png"
    broken.write_bytes(broken.read_bytes()[:2000])
    message = refused(capsys, track_command(sequence, frames=frames, output=tmp_path / "run"))
    assert "frame 9" in message
    assert "000009.png" in message
    with h5py.File(tmp_path / "run" / "result.h5") as file:
        assert file["frame"][()].tolist() == list(range(9))


def test_an_interrupt_keeps_the_frames_so_far_and_says_so(sequence, tmp_path, capsys, monkeypatch):
    from morph_dslam.tracking.tracker import Tracker

    whole, frames_seen = Tracker.track, []

    def interrupted(tracker, image, *known):
        frames_seen.append(image)
        if len(frames_seen) == 9:  # the first ones warm up
            raise KeyboardInterrupt
        return whole(tracker, image, *known)

    monkeypatch.setattr(Tracker, "track", interrupted)
    assert cli.main(track_command(sequence, output=tmp_path / "run")) == 130
    assert "interrupted; the frames tracked so far are kept" in capsys.readouterr().err
    with h5py.File(tmp_path / "run" / "result.h5") as file:
        kept = file["frame"][()].tolist()
    assert kept == list(range(len(kept)))
    assert len(kept) >= 5
    assert (tmp_path / "run" / "augmented.mp4").is_file()


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (("frames = 16", "frames = 16\nzoom = 2"), "unknown key zoom; known here"),
        (("arch = 8.0", "arch = 900.0"), "arch"),
        (('model = "sheet.morph"', 'model = "absent.morph"'), r"there is no model file .*absent\.morph"),
        (('texture = "print.png"', 'texture = "absent.png"'), r"absent\.png"),
        (("frames = 16", "frames = 16 16"), "not a TOML file"),
    ],
)
def test_bad_scenes_are_one_message(sequence, tmp_path, capsys, change, expected):
    for name in ("sheet.morph", "print.png"):
        shutil.copyfile(sequence / name, tmp_path / name)
    text = (sequence / "scene.toml").read_text()
    assert change[0] in text
    (tmp_path / "scene.toml").write_text(text.replace(*change))
    message = refused(capsys, ["simulate", tmp_path / "scene.toml", "-o", tmp_path / "seq"])
    assert re.search(expected, message)


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (("[grips]", "[grips]\ncolour = 3"), "unknown key grips.colour; known here: depth, height"),
        (('length = "297 mm"', "length = 297"), "sheet.length: write the value with its unit"),
        (('length = "297 mm"', 'length = "297 deg"'), "'deg' is not a unit of length"),
        (('length = "297 mm"\n', ""), "sheet.length is missing"),
        (('bulge = ["-34 mm", "34 mm"]', 'bulge = ["34 mm", "-34 mm"]'), "bulge"),
        (("[sheet]", "[sheet"), "not a TOML file"),
    ],
)
def test_bad_studies_are_one_message(tmp_path, capsys, change, expected):
    text = (ROOT / "examples" / "demo" / "study.toml").read_text()
    assert change[0] in text
    (tmp_path / "study.toml").write_text(text.replace(*change))
    message = refused(capsys, ["build", tmp_path / "study.toml", "-o", tmp_path / "sheet.morph"])
    assert expected in message
    assert "study.toml" in message


def test_a_study_that_is_not_there_is_one_message(tmp_path, capsys):
    message = refused(capsys, ["build", tmp_path / "absent.toml", "-o", tmp_path / "sheet.morph"])
    assert "cannot read the study file" in message
