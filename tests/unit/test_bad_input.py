"""What a user gets wrong at the command line: one message that says what to mend, and status 2."""

import subprocess
import sys

import cv2
import meshio
import numpy as np
import pytest

from morph_dslam.cli import app as cli
from morph_dslam.errors import EvaluationError, MorphError, RegistrationError, StudyError, TrackingError
from morph_dslam.evaluation.run_folder import load_run
from morph_dslam.evaluation.run_report import write_run_report
from morph_dslam.io.camera_files import load_camera
from morph_dslam.io.folders import make_run_folder
from morph_dslam.io.landmarks import load_landmarks
from morph_dslam.io.trajectory import load_trajectory
from morph_dslam.model import save_model
from morph_dslam.registration.board import load_board
from morph_dslam.studies.study import load_study
from tests.support.block_study import write_study
from tests.support.documents import PROJECT
from tests.support.run_folders import write_run
from tests.support.small_models import block_model

BOARD = """
kind = "grid"
dictionary = "apriltag_36h11"
columns = 4
rows = 3
marker_mm = 30
gap_mm = 9
"""
CAMERA = "width: 640\nheight: 480\nfx: 528\nfy: 528\ncx: 319.5\ncy: 239.5\n"


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "file").write_text("hello\n")
    (tmp_path / "camera.yaml").write_text(CAMERA)
    (tmp_path / "board.toml").write_text(BOARD)
    tumour = [[40, 40, 40], [50, 60, 40], [60, 40, 40], [50, 50, 60]]
    faces = [[0, 1, 2], [0, 2, 3], [2, 1, 3], [1, 0, 3]]
    meshio.Mesh(np.array(tumour, dtype=float), [("triangle", np.array(faces))]).write(tmp_path / "tumour.ply")
    save_model(tmp_path / "block.morph", block_model("tucker"))
    return tmp_path


@pytest.mark.parametrize("name", ["", "file/t.h5", "absent/t.h5"])
def test_an_inner_structure_that_cannot_be_written(folder, refused, name):
    command = ["inner", folder / "tumour.ply", "--model", folder / "block.morph", "--unit", "mm"]
    assert cli.main([str(argument) for argument in [*command, "-o", folder / "tumour.h5"]]) == 0
    assert "cannot write the inner structure" in refused(*command, "-o", folder / name)


@pytest.mark.parametrize("name", ["board", "board.jpg", "", "absent/board.png", "file/board.pdf"])
def test_a_board_that_cannot_be_written(folder, refused, name):
    before = sorted(folder.parent.iterdir())
    assert "cannot write the board to" in refused("board", folder / "board.toml", "-o", folder / name)
    assert sorted(folder.parent.iterdir()) == before


def test_a_board_in_the_wrong_unit(folder, refused):
    (folder / "board.toml").write_text(BOARD.replace("30", "3e9"))
    assert "sizes are in millimetres" in refused("board", folder / "board.toml", "-o", folder / "board.png")
    (folder / "board.toml").write_text(BOARD + "[object]\nposition_mm = [1e300, 0, 0]\n")
    with pytest.raises(RegistrationError, match="position_mm"):
        load_board(folder / "board.toml")


def test_a_model_file_is_no_folder_and_workers_are_counted(folder, refused):
    study = write_study(folder)
    assert "give the name of the model file" in refused("build", study, "-o", folder)
    for workers in ("0", "-1", "two"):
        said = refused("build", study, "-o", folder / "b.morph", f"--workers={workers}")
        assert "is not a whole number above zero" in said


def test_a_calibration_is_written_where_it_can_be_read(folder, refused):
    command = ["calibrate", folder, "--board", "9x6", "--square", "25 mm", "-o"]
    assert "has the ending .yaml" in refused(*command, folder / "camera.png")


@pytest.mark.parametrize("seconds", ["-1", "0", "nan", "inf", "soon"])
def test_a_length_of_time_is_above_zero(refused, seconds):
    command = ["live", "webcam:0", "--model", "m", "--camera", "c", "--landmarks", "l", "-o", "r"]
    assert "is not a number above zero" in refused(*command, f"--seconds={seconds}")


def test_nothing_but_our_message_is_printed_of_a_damaged_video(folder):
    """OpenCV and FFmpeg write to the process's own stderr, so it takes a process of its own."""
    writer = cv2.VideoWriter(str(folder / "film.mp4"), cv2.VideoWriter.fourcc(*"mp4v"), 30, (64, 48))
    for value in range(20):
        writer.write(np.full((48, 64, 3), 10 * value, np.uint8))
    writer.release()
    whole = (folder / "film.mp4").read_bytes()
    (folder / "film.mp4").write_bytes(whole[: len(whole) // 2])
    arguments = ["calibrate", str(folder / "film.mp4"), "--board", "9x6", "--square", "25 mm", "-o"]
    program = f"from morph_dslam.cli import main; raise SystemExit(main({[*arguments, str(folder / 'c.yaml')]}))"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.returncode == 2
    (line,) = done.stderr.splitlines()
    assert "cannot be opened as a video" in line


def test_options_without_effect_are_refused(folder, refused):
    output = ["-o", folder / "run"]
    slam = ["slam", folder, "--camera", folder / "camera.yaml", *output]
    assert "is not a frame number" in refused(*slam, "--freeze-at=-1")
    assert "go with --depth" in refused("evaluate", folder, "--points", "truth.npz", "--base-frame", 0)
    assert "goes with --points" in refused("evaluate", folder, "--trajectory", "truth.txt", "--bind-frame", 0)
    assert "--points needs --bind-frame N" in refused("evaluate", folder, "--points", "truth.npz")
    assert "there is no trajectory" in refused("evaluate", folder / "absent", "--trajectory", "truth.txt")


@pytest.mark.parametrize(
    ("load", "name", "text"),
    [
        (load_camera, "camera.yaml", CAMERA.replace("fx: 528", "fx: 1e300")),
        (load_camera, "camera.yaml", CAMERA.replace("239.5", "-1e300")),
        (load_landmarks, "landmarks.csv", "x_mm,y_mm,z_mm,u_px,v_px\n1,2,3,4,1e300\n"),
        (load_trajectory, "poses.txt", "0 0 0 1e300 0 0 0 1\n"),
    ],
)
def test_numbers_that_cannot_be_meant(tmp_path, load, name, text):
    (tmp_path / name).write_text(text)
    with pytest.raises(MorphError, match=name):
        load(tmp_path / name)


@pytest.mark.parametrize("name", ["summary.json", "pixel_evaluation.json"])
def test_damaged_figures_are_named(tmp_path, name):
    write_run(tmp_path)
    run = load_run(tmp_path)
    for text in ("", "[]", '{"flags": ['):
        (tmp_path / name).write_text(text)
        with pytest.raises(EvaluationError, match=name):
            write_run_report(tmp_path, run)


def test_a_folder_that_holds_a_run_or_cannot_be_made(tmp_path):
    (tmp_path / "file").write_text("")
    make_run_folder(tmp_path / "a" / "run", overwrite=False)
    assert (tmp_path / "a" / "run").is_dir()
    (tmp_path / "a" / "run" / "pixel_evaluation.json").write_text("{}")
    for sign in ("result.h5", "trajectory.txt"):
        (tmp_path / "a" / "run" / sign).write_text("")
        with pytest.raises(TrackingError, match="holds a run already"):
            make_run_folder(tmp_path / "a" / "run", False, sign)
        make_run_folder(tmp_path / "a" / "run", True, sign)
    assert not (tmp_path / "a" / "run" / "pixel_evaluation.json").exists()  # of the run that was overwritten
    for name in ("file", "file/run"):
        with pytest.raises(TrackingError, match="cannot write the run to"):
            make_run_folder(tmp_path / name, overwrite=True)


def test_a_random_walk_whose_square_overflows(refused):
    arguments = ["track", "film", "--model", "m", "--camera", "c", "--landmarks", "l", "-o", "run"]
    said = refused(*arguments, "--random-walk", "arch=1e300")
    assert "'arch=1e300' is not a name and a positive number" in said


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
def test_mistakes_in_a_study_are_named_with_its_file(tmp_path, change, expected):
    text = (PROJECT / "examples" / "demo" / "study.toml").read_text()
    assert change[0] in text
    (tmp_path / "study.toml").write_text(text.replace(*change))
    with pytest.raises(StudyError) as caught:
        load_study(tmp_path / "study.toml")
    assert expected in str(caught.value)
    assert "study.toml" in str(caught.value)
    with pytest.raises(StudyError, match="cannot read the study file"):
        load_study(tmp_path / "absent.toml")
