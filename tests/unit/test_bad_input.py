"""What a user gets wrong at the command line: one message that says what to mend, and status 2."""

import multiprocessing
import re
import subprocess
import sys
import time

import cv2
import meshio
import numpy as np
import pytest

from morph_dslam.cli import app as cli
from morph_dslam.errors import (
    EvaluationError,
    ExportError,
    IdentificationError,
    ModelFileError,
    MorphError,
    RegistrationError,
    StudyError,
    TrackingError,
)
from morph_dslam.evaluation.pixels import load_tracks
from morph_dslam.evaluation.run_folder import load_run
from morph_dslam.evaluation.run_report import write_run_report
from morph_dslam.io.camera_files import load_camera
from morph_dslam.io.folders import clear_run_folder, make_run_folder, only_writer
from morph_dslam.io.landmarks import load_landmarks
from morph_dslam.io.state_choice import read_path
from morph_dslam.io.trajectory import load_trajectory
from morph_dslam.io.video import VideoWriter
from morph_dslam.material_tests.tables import load_test
from morph_dslam.meshing.generators import block
from morph_dslam.meshing.inp_writing import save_mesh
from morph_dslam.model import load_model, save_model
from morph_dslam.reduction.report_pictures import read_reference_curve
from morph_dslam.registration.board import load_board
from morph_dslam.registration.messages import WrongUnit
from morph_dslam.studies.external_table import SolutionTable
from morph_dslam.studies.study import load_study
from tests.support.bent_sheet import bent_sheet_model
from tests.support.block_study import STUDY, write_study
from tests.support.documents import PROJECT
from tests.support.run_folders import write_run
from tests.support.small_models import block_model
from tests.support.stretched_block import stretched_block_model

BOARD = """
kind = "grid"
dictionary = "apriltag_36h11"
columns = 4
rows = 3
marker_mm = 30
gap_mm = 9
"""
IDLE = '[[supports]]\nkind = "displacement"\non = "z_max"\n'
RUBBER = 'law = "neo_hookean"\nyoung = "young"\npoisson = 0.3'
FIBRES = """law = "transversely_isotropic"
young_fibre = "young"
young_cross = "1 MPa"
poisson_fibre = 0.3
poisson_cross = 0.3
shear_fibre = "1 MPa"
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


@pytest.mark.slow
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
    for command, sign in (("track", "result.h5"), ("slam", "map.h5")):
        (tmp_path / command).mkdir()
        (tmp_path / command / sign).write_text("")
        with pytest.raises(TrackingError, match="holds a run already"):
            make_run_folder(tmp_path / command, False, command)
        make_run_folder(tmp_path / command, True, command)
    for name in ("file", "file/run"):
        with pytest.raises(TrackingError, match="cannot write the run to"):
            make_run_folder(tmp_path / name, overwrite=True)


def test_decimals_with_commas_are_not_taken_for_other_numbers(tmp_path):
    table = tmp_path / "table.csv"
    for text, read, error in (
        ("stretch,stress_MPa\n1,00,0,00\n1,05,0,06\n", load_test, IdentificationError),
        ("frame,id,u,v\n0,a,512,31,204,77\n", load_tracks, EvaluationError),
        ("slide [mm]\n1,5\n", lambda path: read_path(stretched_block_model(), path, np.zeros(2)), ExportError),
    ):
        table.write_text(text)
        with pytest.raises(error, match=r"line 2.*decimals with points"):
            read(table)


def test_nothing_of_a_run_that_is_overwritten_stands_in_the_report_of_the_next(tmp_path):
    write_run(tmp_path)
    run = load_run(tmp_path)
    (tmp_path / "plots").mkdir(exist_ok=True)
    picture = cv2.imencode(".png", np.zeros((2, 2, 3), dtype=np.uint8))[1].tobytes()
    of_the_run = ("plots/jumps.png", "plots/points.png", "evaluation.png", "error_map.png", "pixel_error_map.png")
    for name in (*of_the_run, "own.png"):
        (tmp_path / name).write_bytes(picture)
    for name in ("latency.csv", "augmented.mp4", "report.html", "notes.txt", "plots/own.txt"):
        (tmp_path / name).write_text("")
    clear_run_folder(tmp_path)
    assert "<img" not in write_run_report(tmp_path, run).read_text()
    left = {str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*") if path.is_file()}
    assert not left & {*of_the_run, "latency.csv", "augmented.mp4"}
    assert left >= {"own.png", "notes.txt", "plots/own.txt", "result.h5", "model.morph"}  # the reader's own, the run


def test_pictures_of_a_video_have_their_time_and_no_numbers_of_frames(tmp_path):
    """A live run's video stands still where frames were dropped, and a rig's lacks what the first camera lacks.

    The picture at one place was called as the frame at another.
    """
    write_run(tmp_path)
    with VideoWriter(tmp_path / "augmented.mp4", 20.0, (64, 48)) as video:
        for level in range(41):
            video.write(np.full((48, 64, 3), 5 * level, dtype=np.uint8))
    page = write_run_report(tmp_path, load_run(tmp_path)).read_text()
    captions = re.findall(r"<figcaption>(At [^<]*|Frame [^<]*)</figcaption>", page)
    n = len(captions)
    assert n > 1
    # Spread evenly over two seconds.
    assert captions == [f"At {2.0 * (k + 1) / (n + 1):.1f} s" for k in range(n)]


def test_a_run_folder_has_one_writer(tmp_path):
    run = tmp_path / "a" / "run"
    with only_writer(run):
        with pytest.raises(TrackingError, match="another run is writing"), only_writer(run):
            pass
        with only_writer(tmp_path / "b"):
            pass
    assert list(run.iterdir()) == []
    # A process that is killed leaves no lock behind.
    program = (
        "import time; from pathlib import Path; from morph_dslam.io.folders import only_writer\n"
        f"with only_writer(Path({str(run)!r})): print('holds it', flush=True); time.sleep(60)"
    )
    with subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, text=True) as other:
        assert other.stdout.readline() == "holds it\n"
        with pytest.raises(TrackingError, match="another run is writing"), only_writer(run):
            pass
        other.kill()
    with only_writer(run):
        pass
    # A process that was forked meanwhile, and still runs, holds none.
    forked = multiprocessing.get_context("fork").Process(target=time.sleep, args=(60,))
    with only_writer(run):
        forked.start()
    try:
        with only_writer(run):
            pass
    finally:
        forked.kill()
        forked.join()


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


def message_of_study(folder, *changes):
    """What is said of a study with changes, without the file's name, which must come first."""
    path = write_study(folder, *changes)
    with pytest.raises(StudyError) as caught:
        load_study(path)
    assert str(caught.value).startswith(f"{path}: ")
    return str(caught.value).removeprefix(f"{path}: ")


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (
            ('kind = "fixed"\n', ""),
            'support 1 has no kind: write kind = "fixed", "displacement", "rotation" or "foundation"',
        ),
        (
            ('"fixed"', '"fixd"'),
            "support 1: 'fixd' is not a known kind (did you mean 'fixed'?); known are fixed, displacement, rotation, "
            "foundation",
        ),
        (
            ('generator = "block"', 'generator = "blok"'),
            "mesh: 'blok' is not a known generator (did you mean 'block'?); known are block, tube, revolution",
        ),
        (('name = "block"', "name = 5"), "name: 5 must be a text in quotes"),
        (('on = "z_min"', "on = [3]"), "support 1: on: [3] must be a text in quotes"),
        (('on = "z_min"', 'on = "z_min"\nonn = 3'), "support 1: unknown key onn; known here: kind, on"),
        (('on = "z_min"\n', ""), "support 1: on is missing"),
        (
            ("[[loads]]", IDLE + "[[loads]]"),
            "support 2: the displacement of 'z_max' holds nothing: give at least one of",
        ),
        (("[[supports]]", "[supports]"), "supports must be a list, not a table: write [[supports]]"),
        (("divisions = [1, 1, 3]", "divisions = [1, 1]"), "mesh.divisions, entry 3 is missing"),
        (("[1, 1, 3]", "[1, 1, 3, 5]"), "mesh.divisions has 4 entries, and must have at most 3"),
        (("[1, 1, 3]", "[1, 1.5, 3]"), "mesh.divisions, entry 2: 1.5 must be a whole number"),
        (
            ('"20 mm", "20 mm", "60 mm"', '"20 mm", "-20 mm", "60 mm"'),
            "mesh.size, entry 2: '-20 mm' must be greater th",
        ),
        (('"60 mm"', '"6O mm"'), "mesh.size, entry 3: '6O mm' is not a number and a unit, as \"20.5 mm\" is"),
        (('"60 mm"', "[6]"), 'mesh.size, entry 3: write a number with its unit in quotes, "20 mm" for example'),
        (
            ("training = 24", 'training = "2,4"'),
            "sampling.training: '2,4' must be a whole number, with a point in place",
        ),
        (
            ("training = 24", 'scheme = "grids"'),
            "sampling.scheme: 'grids' must be 'sobol', 'even', 'grid', 'adaptive' or 'paths'",
        ),
        (("training = 24", 'points = "x"'), "sampling.points: 'x' must be a whole number or a list"),
        (("training = 24", "points = [2, 1.5]"), "sampling.points, entry 2: 1.5 must be a whole number"),
        (('law = "neo_hookean"', "law = 3"), "materials.rubber.law: 3 must be a text in quotes"),
        (
            ('range = ["2 MPa", "4 MPa"]', 'range = [["2 MPa"], 4]'),
            "parameters.young.range, entry 1: ['2 MPa'] must be",
        ),
        (('["push", "0 Pa", "pull"]', '["push", "0 Pa", "-1 * pul"]'), "load 1: '-1 * pul' names 'pul', which is no"),
        (("poisson = 0.3", "poisson = 0.5"), "materials.rubber: neo_hookean: "),
        (("poisson = 0.3", "poisson = [0.3]"), "materials.rubber: neo_hookean: poisson = [0.3] is not a number"),
        (
            ("poisson = 0.3", 'poisson = 0.3\ndensity = ["1 g/cm3"]'),
            "materials.rubber: neo_hookean: density = [1000.0] is not a number",
        ),
        ((RUBBER, FIBRES + 'fibre = ["a", 0, 0]'), "materials.rubber: the direction ['a', 0, 0] must be three numbers"),
        (
            (RUBBER, FIBRES + 'fibre = { angle = "9 deg", from = [1, {}, 0], towards = [0, 1, 0] }'),
            "materials.rubber: the direction [1, {}, 0] must be three numbers",
        ),
    ],
)
def test_what_is_wrong_with_a_study_is_said_in_its_own_words(tmp_path, change, expected):
    said = message_of_study(tmp_path, change)
    assert said.startswith(expected)
    assert "Input" not in said


def test_the_first_of_several_sections_is_number_one(tmp_path):
    second = '[[supports]]\nkind = "displacement"\non = "z_max"\nx = {}\n[[loads]]'
    assert message_of_study(tmp_path, ("[[loads]]", second.format('"-1 * pul"'))).startswith("support 2: '-1 * pul'")
    said = message_of_study(tmp_path, ("[[loads]]", second.format("[1]")))
    assert said == "support 2: x: [1] must be a text in quotes or a number"


def test_a_material_that_is_unstable_is_named_as_in_the_study(tmp_path):
    law = 'law = "mooney_rivlin"\nc10 = "young"\nc01 = "0.1 MPa"\nbulk = "0 MPa"\n'
    said = message_of_study(tmp_path, ('law = "neo_hookean"\nyoung = "young"\npoisson = 0.3\n', law))
    assert said == "materials.rubber: mooney_rivlin: bulk = 0 must be positive"


@pytest.mark.parametrize(
    ("unit", "drawn", "change", "expected"),
    [
        ("inch", "mm", None, "mesh.unit: 'inch' is not a unit of length; use one of m, cm, mm, um"),
        (
            "um",
            "mm",
            None,
            'mesh.unit: in "um" the mesh measures 2e-05 x 2e-05 x 6e-05 m, which is hardly meant; if it',
        ),
        ("um", "mm", None, 'if it was drawn in mm, write "mm"'),
        ("m", "mm", None, 'if it was drawn in mm, write "mm"'),
        ("um", "m", None, 'if it was drawn in m, write "m"'),
        (
            "mm",
            "mm",
            ('on = "z_min"', 'on = "lefft"'),
            "support 1: on: the mesh has no node set or surface 'lefft'; it has:",
        ),
        ("mm", "mm", ('on = "z_max"', 'on = "rigth"'), "load 1: on: the mesh has no surface 'rigth'; it has: "),
        ("mm", "mm", ('law = "neo', 'on = "core"\nlaw = "neo'), "materials.rubber.on: the mesh has no cell set 'core'"),
    ],
)
def test_a_mesh_file_that_does_not_fit_the_study(tmp_path, refused, unit, drawn, change, expected):
    save_mesh(tmp_path / "part.inp", block((0.02, 0.02, 0.06), (1, 1, 3), "hex8"), drawn)
    generated = STUDY[STUDY.index("generator") : STUDY.index("[materials")]
    study = write_study(tmp_path, (generated, f'file = "part.inp"\nunit = "{unit}"\n'), *([change] if change else []))
    said = refused("build", study, "-o", tmp_path / "block.morph")
    assert said.startswith(f"morph: {study}: ")
    assert expected in said


def test_what_a_model_is_made_from_is_no_model(folder):
    study = write_study(folder)
    with pytest.raises(ModelFileError, match=r"study\.toml is a study, not a model: build it first with `morph build "):
        load_model(study)
    for name in ("tumour.ply", "part.inp"):
        save_mesh(folder / "part.inp", block((0.02, 0.02, 0.06), (1, 1, 3), "hex8"), "mm")
        with pytest.raises(ModelFileError, match=f"{name} is a mesh, not a model: name it in the "):
            load_model(folder / name)
    whole = (folder / "block.morph").read_bytes()
    (folder / "block.morph").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(ModelFileError, match=r"damaged or cut short .*does not match its checksum"):
        load_model(folder / "block.morph")


@pytest.mark.parametrize(
    ("read", "text"),
    [
        (load_landmarks, "x_mm;y_mm;z_mm;u_px;v_px\n1,5;2;3;4;5\n"),
        (load_tracks, "frame;id;u;v\n1;a;2,5;3\n"),
        (SolutionTable, "file;force [N]\nrun0.vtu;0,5\n"),
        (read_reference_curve, "modes;the paper\n1;0,9\n"),
        (lambda path: read_path(bent_sheet_model(3, 3), path, np.zeros(3)), "arch_mm;time\n0,5;1\n"),
    ],
)
def test_tables_separated_by_semicolons(tmp_path, read, text):
    (tmp_path / "table.csv").write_text(text)
    with pytest.raises(MorphError, match=r"table\.csv is separated by semicolons: .* commas .* points"):
        read(tmp_path / "table.csv")


@pytest.mark.parametrize(("factor", "unit"), [(1e-3, "metres"), (1 / 25.4, "inches"), (0.1, "centimetres")])
def test_landmarks_in_a_wrong_unit_may_be_their_own_fault(factor, unit):
    said = WrongUnit(0.3e-3, 0.3, factor, "millimetres", "metres").hint
    assert f"multiplied by {factor:.4g}: either the landmark file is in {unit}, where its columns x_mm" in said
    assert said.endswith("a mesh in millimetres was taken for one in metres: correct its unit in the study")


def test_landmarks_in_no_wrong_unit_leave_the_mesh():
    said = WrongUnit(0.2, 0.5, 1 / 2.54, "centimetres", "inches").hint
    assert "landmark file" not in said
    assert said.endswith("perhaps a mesh in centimetres was taken for one in inches: correct its unit in the study")


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (
            CAMERA.replace("fx: 528", "fx: 30800,0"),
            "fx: '30800,0' must be a number, with a point in place of the comma",
        ),
        (CAMERA.replace("width: 640", "width: 640.5"), "width: 640.5 must be a whole number"),
        (CAMERA + "distortion: 0.1\n", "distortion: 0.1 must be a list"),
        (CAMERA + "distortion: [0.1, x]\n", "distortion, entry 2: 'x' must be a number"),
    ],
)
def test_numbers_of_a_camera_that_are_none(tmp_path, text, expected):
    (tmp_path / "camera.yaml").write_text(text)
    with pytest.raises(MorphError) as caught:
        load_camera(tmp_path / "camera.yaml")
    assert str(caught.value).startswith(f"{tmp_path / 'camera.yaml'}: {expected}")
