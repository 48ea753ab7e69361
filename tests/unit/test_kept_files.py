"""What somebody has in a folder is still there after a command that writes to it, unless it was to be overwritten."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import meshio
import numpy as np
import pytest

from morph_dslam.errors import ExportError, MapError, RegistrationError, SceneError, SourceError, TrackingError
from morph_dslam.io.camera_files import save_camera
from morph_dslam.io.export import export
from morph_dslam.io.folders import clear_run_folder, make_run_folder
from morph_dslam.io.state_choice import StateChoice
from morph_dslam.model import save_model
from morph_dslam.model.inner_structure import save_inner_structure
from morph_dslam.registration.register import run_registration
from morph_dslam.render.simulation import simulate
from morph_dslam.slam.run import run_slam
from morph_dslam.sources import Frame
from morph_dslam.studies.inner_structures import read_inner_structure
from morph_dslam.tracking.run_folder import RunFolder
from morph_dslam.tracking.run_options import ObjectOptions, TrackOptions
from morph_dslam.tracking.run_results import RunResults
from morph_dslam.tracking.sinks import TrackedFrame
from tests.support.bent_sheet import bent_sheet_model
from tests.support.block_study import write_study
from tests.support.run_folders import CAMERA, write_run
from tests.support.scenes import write_scene
from tests.support.stretched_block import SIZE, stretched_block_model
from tests.unit.test_results import frame_result

OWN = ("plots/own.png", "report.html", "latency.csv", "depth_evaluation.json", "own_error_map.png")


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def with_own_files(folder: Path) -> dict[str, bytes]:
    (folder / "plots").mkdir(parents=True, exist_ok=True)
    for name in OWN:
        (folder / name).write_text("mine")
    return contents(folder)


def run_in(folder: Path, overwrite: bool) -> RunFolder:
    results = RunResults(bent_sheet_model(22, 16), reference_frame=0)
    return RunFolder(folder, "sheet", results, CAMERA, overwrite=overwrite)


def tracked() -> TrackedFrame:
    result = frame_result([0.01, 0.1, 0.0], [1e-3, 0.05, 0.01], [False, False, False])
    return TrackedFrame((Frame(0, 0.0, np.zeros((2, 2, 3), dtype=np.uint8)),), {"sheet": result})


@pytest.mark.parametrize("overwrite", [False, True])
def test_a_folder_without_a_run_keeps_what_is_in_it(overwrite: bool, tmp_path: Path) -> None:
    own = with_own_files(tmp_path)
    run_in(tmp_path, overwrite)(tracked())
    assert contents(tmp_path) == own


def test_a_run_is_cleared_away_when_the_next_one_has_a_frame(tmp_path: Path) -> None:
    """Until then the next one may be refused, by a port that is taken say, or get no frame."""
    write_run(tmp_path)
    before = with_own_files(tmp_path)
    (tmp_path / "plots" / "folder.png").mkdir()  # it cannot be deleted as a file is
    run = run_in(tmp_path, overwrite=True)
    assert contents(tmp_path) == before
    run(tracked())
    assert contents(tmp_path).keys() == before.keys() - set(OWN)


@pytest.mark.parametrize(("sign", "command"), [("map.h5", "track"), ("result.h5", "slam")])
def test_a_run_of_the_other_command_is_not_replaced(sign: str, command, tmp_path: Path) -> None:
    (tmp_path / sign).write_text("")
    for overwrite in (False, True):
        with pytest.raises(TrackingError, match="holds a run of `morph"):
            make_run_folder(tmp_path, overwrite, command)


def test_files_with_the_names_of_a_run_are_not_replaced(tmp_path: Path) -> None:
    (tmp_path / "camera.yaml").write_text("")
    with pytest.raises(TrackingError, match=r"holds camera\.yaml already"):
        make_run_folder(tmp_path, False)
    make_run_folder(tmp_path, True)
    make_run_folder(tmp_path, False, "slam")  # which writes none


@pytest.fixture
def a_film(tmp_path: Path) -> Path:
    """A folder with a camera file and a recording of one image, in which nothing is seen."""
    (tmp_path / "frames").mkdir()
    cv2.imwrite(str(tmp_path / "frames" / "000000.png"), np.zeros((CAMERA.height, CAMERA.width, 3), np.uint8))
    save_camera(tmp_path / "lens.yaml", CAMERA)
    return tmp_path


@pytest.mark.parametrize(("name", "refine"), [("tracked.mp4", ()), ("camera.yaml", ("focal",))])
def test_mapping_replaces_no_files_of_others(name: str, refine, a_film: Path) -> None:
    out = a_film / "out"
    (out / "plots").mkdir(parents=True)
    (out / name).write_text("mine")
    with pytest.raises(TrackingError):
        run_slam(a_film / "frames", a_film / "lens.yaml", out, refine=refine, progress=False)
    (out / name).rename(out / "plots" / "frames.png")
    with pytest.raises(TrackingError):
        run_slam(a_film / "frames", a_film / "lens.yaml", out, progress=False)
    assert contents(out) == {"plots/frames.png": b"mine"}


@pytest.mark.parametrize("live", [False, True])
def test_tracking_replaces_no_video_of_others(live: bool, tmp_path: Path) -> None:
    options = TrackOptions(
        frames=tmp_path / "film.mp4", model=tmp_path / "m", camera=tmp_path / "c", output=tmp_path, live=live,
        others=(("knob", ObjectOptions(model=tmp_path / "k")),),
    )  # fmt: skip
    (tmp_path / "augmented.mp4").write_text("mine")
    refused = []
    for more in (*options.shown_in_folders, *replace(options, video=False).shown_in_folders):
        try:
            make_run_folder(tmp_path, False, more=more)
        except TrackingError:
            refused.append(True)
        else:
            refused.append(False)
    # The object itself, the one beside it, and both without a video: a live run has one video of all.
    assert refused == [True, not live, False, False]


def test_mapping_does_not_replace_its_source_or_its_camera(a_film: Path) -> None:
    """Each is refused only if it would be gone: a camera file beside a run that made none stays."""
    run = a_film / "run"
    (run / "colmap").mkdir(parents=True)
    for name in ("camera.yaml", "colmap/cameras.yaml"):
        shutil.copy(a_film / "lens.yaml", run / name)
    for name in ("tracked.mp4", "map.h5"):
        (run / name).write_text("")
    before = contents(a_film)

    def raised(source: str, camera: str, **choices) -> type[Exception]:
        with pytest.raises((MapError, SourceError)) as error:
            run_slam(a_film / source, a_film / camera, run, progress=False, **choices)
        return error.type

    assert raised("run/tracked.mp4", "lens.yaml") is MapError
    assert raised("run/tracked.mp4", "lens.yaml", overwrite=True, video=False) is MapError
    assert raised("gone.mp4", "run/colmap/cameras.yaml", overwrite=True) is MapError
    for facts, expected in (({}, SourceError), ({"refined_camera": {}}, MapError)):
        (run / "summary.json").write_text(json.dumps(facts))
        assert raised("gone.mp4", "run/camera.yaml", overwrite=True) is expected
    (run / "summary.json").unlink()
    assert contents(a_film) == before


def test_a_registration_does_not_replace_the_one_beside_it(tmp_path: Path) -> None:
    beside = tmp_path / "registration.json"
    beside.write_text("mine")
    with pytest.raises(RegistrationError, match="is an input of this command"):
        run_registration("map.h5", "block.morph", "camera.yaml", tmp_path, beside=[beside], overwrite=True)
    assert contents(tmp_path) == {"registration.json": b"mine"}


def test_the_video_of_an_earlier_map_goes_with_it(tmp_path: Path) -> None:
    for name in ("tracked.mp4", "map.h5"):
        (tmp_path / name).write_text("")
    clear_run_folder(tmp_path, "slam", [tmp_path / "tracked.mp4"])
    assert contents(tmp_path).keys() == {"map.h5"}


@pytest.mark.parametrize("given", ["camera.yaml", "trajectory.txt", "frames.csv"])
def test_inputs_of_a_run_are_not_its_outputs(given: str, tmp_path: Path, refused) -> None:
    """Under another name too."""
    (tmp_path / "run").mkdir()
    for name in ("camera.yaml", "trajectory.txt", "frames.csv", "film.mp4", "sheet.morph", "landmarks.csv"):
        (tmp_path / "run" / name).write_text(name)
    names = {"--camera": "camera.yaml", "--known": "frames.csv", "--landmarks": "trajectory.txt"}
    option = next(option for option, name in names.items() if name == given)
    (tmp_path / "link").symlink_to(tmp_path / "run" / given)
    words = {"--model": "m", "--camera": "c", "--landmarks": "l", option: tmp_path / "link"}
    before = contents(tmp_path)
    flat = [word for pair in words.items() for word in pair]
    for command in ("track", "slam"):
        if command == "slam" and option != "--camera":
            continue
        end = flat if command == "track" else [option, tmp_path / "link", "--refine-camera"]
        message = refused(command, tmp_path / "film.mp4", *end, "-o", tmp_path / "run", "--overwrite")
        assert f"{given} is an input of this command" in message
    assert contents(tmp_path) == before


@pytest.fixture
def with_inputs(tmp_path: Path) -> Path:
    """A study, the model of a block, and a surface inside of it."""
    write_study(tmp_path)
    save_model(tmp_path / "block.morph", stretched_block_model())
    low, high = 0.3 * np.array(SIZE), 0.5 * np.array(SIZE)
    corners = np.array([low, [high[0], *low[1:]], [low[0], high[1], low[2]], [*low[:2], high[2]]])
    faces = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
    meshio.Mesh(corners, [("triangle", faces)]).write(tmp_path / "ball.stl")
    return tmp_path


@pytest.mark.parametrize(
    "words",
    [
        ("build", "study.toml", "-o", "study.toml"),
        ("build", "study.toml", "--reference-curve", "curve.csv", "-o", "curve.csv"),
        ("build", "--rigid", "ball.stl", "--unit", "m", "-o", "ball.stl"),
        ("inner", "ball.stl", "--model", "block.morph", "--unit", "m", "-o", "block.morph"),
        ("inner", "ball.stl", "--model", "block.morph", "--unit", "m", "-o", "link"),
    ],
)
def test_what_is_built_is_not_what_it_is_built_from(words, with_inputs: Path, monkeypatch, refused) -> None:
    monkeypatch.chdir(with_inputs)
    Path("link").symlink_to("ball.stl")
    Path("curve.csv").write_text("modes,error\n1,0.1\n")
    before = contents(with_inputs)
    assert f"{words[-1]} is an input of this command" in refused(*words)
    assert contents(with_inputs) == before


LAW = """
from ngsolve import Det, InnerProduct, log
def rubber(F, mu):
    return mu * (InnerProduct(F, F) - 2.0 * log(Det(F)))
"""
#: By kind of study, text that names files of its own.
NAMING = {
    "solid": """name = "block"
shape = [{ kind = "field", file = "growth.vtu", unit = "mm", amplitude = "growth" }]
supports = [{ kind = "fixed", on = "z_min" }]
contacts = [{ kind = "mesh", on = "z_max", file = "ball.stl", unit = "m" }]
mesh = { file = "block.inp", unit = "mm" }
materials.rubber = { law = "user_material", function = "law.py:rubber", mu = 1.0 }
parameters.growth = { range = [0.0, 0.1] }
""",
    "external": 'name = "block"\nexternal = { table = "table.csv", length_unit = "mm" }\n',
}


@pytest.mark.parametrize(
    ("kind", "name"),
    [
        *(("solid", name) for name in ("growth.vtu", "ball.stl", "block.inp", "law.py")),
        *(("external", name) for name in ("table.csv", "solutions/1.vtu", "solutions/2.h5")),
    ],
)
def test_a_build_replaces_no_file_that_its_study_names(kind, name, with_inputs: Path, monkeypatch, refused) -> None:
    monkeypatch.chdir(with_inputs)
    Path("study.toml").write_text(NAMING[kind])
    Path("law.py").write_text(LAW)
    Path("solutions").mkdir()
    for own in ("growth.vtu", "block.inp", "solutions/1.vtu", "solutions/2.h5"):
        Path(own).write_text("mine")
    Path("table.csv").write_text("file,step,force [N]\nsolutions/1.vtu,,1\nsolutions/2.xdmf,0,2\n")
    before = contents(with_inputs)
    assert f"{name} is an input of this command" in refused("build", "study.toml", "-o", name)
    assert contents(with_inputs) == before


def test_a_build_names_the_row_of_a_table_that_has_no_file(with_inputs: Path, monkeypatch, refused) -> None:
    monkeypatch.chdir(with_inputs)
    Path("study.toml").write_text(NAMING["external"])
    Path("table.csv").write_text("file,force [N]\nsolutions/1.vtu,1\n,2\n")
    assert "table.csv, line 3: the cell of 'file' is empty" in refused("build", "study.toml", "-o", "model.morph")


def test_a_file_beside_a_solution_that_keeps_nothing_there_is_no_input(with_inputs: Path, monkeypatch, refused) -> None:
    """XDMF files keep their numbers in a file .h5 beside them, others do not: the build goes on to the solutions."""
    monkeypatch.chdir(with_inputs)
    Path("study.toml").write_text(NAMING["external"])
    Path("solutions").mkdir()
    for own in ("solutions/1.vtu", "solutions/1.h5"):
        Path(own).write_text("mine")
    Path("table.csv").write_text("file,force [N]\n" + "".join(f"solutions/{k}.vtu,{k}\n" for k in (1, 2, 3, 4, 5, 6)))
    assert "solutions/1.vtu is damaged" in refused("build", "study.toml", "-o", "solutions/1.h5")


POSE = "[[pose]]\nframe = 0\nposition_mm = [0, 0, 620]\n"


@pytest.mark.parametrize("name", ["frames/000050.png", "frames/000051.jpg", "depth/000000.png", "depth.h5", "rgb.txt"])
def test_a_simulation_deletes_no_pictures_of_others(name: str, tmp_path: Path) -> None:
    scene, own = write_scene(tmp_path, "frames = 1\n", POSE), tmp_path / "film" / name
    own.parent.mkdir(parents=True)
    own.write_text("mine")
    with pytest.raises(SceneError, match="is there and would be gone"):
        simulate(scene, tmp_path / "film", progress=False)
    assert contents(tmp_path / "film") == {name: b"mine"}


def test_a_simulation_does_not_replace_its_own_camera_file(tmp_path: Path) -> None:
    lens = '{"width": 320, "height": 240, "fx": 260.0, "fy": 262.0, "cx": 158.0, "cy": 121.0}'
    (tmp_path / "camera.yaml").write_text(lens)
    scene = write_scene(tmp_path, "frames = 1\n", POSE, camera='camera = "camera.yaml"\n')
    with pytest.raises(SceneError, match=r"camera\.yaml is an input of this command"):
        simulate(scene, tmp_path, progress=False)
    assert (tmp_path / "camera.yaml").read_text() == lens


def test_a_simulation_replaces_one_that_was_not_finished(tmp_path: Path, monkeypatch) -> None:
    scene, film = write_scene(tmp_path, "frames = 2\n", POSE), tmp_path / "film"
    written = cv2.imwrite

    def interrupted(path: str, *arguments) -> bool:
        if path.endswith("000001.png"):
            raise KeyboardInterrupt
        return written(path, *arguments)

    monkeypatch.setattr(cv2, "imwrite", interrupted)
    with pytest.raises(KeyboardInterrupt):
        simulate(scene, film, progress=False)
    assert not (film / "truth.npz").exists()
    monkeypatch.undo()
    simulate(write_scene(tmp_path, "frames = 1\n", POSE), film, progress=False)
    assert np.load(film / "truth.npz")["frame"].tolist() == [0]
    assert contents(film / "frames").keys() == {"000000.png"}
    assert not list(film.glob("*.partial"))


@pytest.mark.parametrize(
    ("file_format", "name"),
    [
        *(("xdmf", "block.h5"), ("xdmf", "states.csv"), ("vtu", "states.csv"), ("gltf", "block.glb")),
        *(("vtu", "block_0001.vtu"), ("vtu", "block_inner_left-lobe_0001.vtu")),
    ],
)
def test_an_export_replaces_no_files_of_others(file_format, name: str, with_inputs: Path) -> None:
    folder = with_inputs / "out"
    folder.mkdir()
    (folder / name).write_text("mine")
    structure = read_inner_structure(stretched_block_model(), "left-lobe", with_inputs / "ball.stl", "m")
    save_inner_structure(with_inputs / "inner.h5", structure)
    inner = [with_inputs / "inner.h5"] if file_format == "vtu" else []
    for _ in range(2):
        with pytest.raises(ExportError, match="no earlier export has written it"):
            export(with_inputs / "block.morph", folder, file_format, np.zeros((2, 2)), inner=inner)
    assert contents(folder) == {name: b"mine"}
    (folder / name).unlink()
    for _ in range(2):
        export(with_inputs / "block.morph", folder, file_format, np.zeros((2, 2)), inner=inner)


@pytest.mark.parametrize(("file_format", "last"), [("vtu", "block_0002.vtu"), ("xdmf", "block.h5")])
def test_an_export_that_was_killed_is_known_as_one(file_format, last: str, with_inputs: Path, monkeypatch) -> None:
    folder = with_inputs / "out"

    def killed(*_) -> None:
        raise SystemExit

    with monkeypatch.context() as patch:
        if file_format == "vtu":
            whole = meshio.Mesh.write
            patch.setattr(meshio.Mesh, "write", lambda mesh, p: killed() if p.name == last else whole(mesh, p))
        else:
            patch.setattr(meshio.xdmf.time_series, "write_xml", killed)
        with pytest.raises(SystemExit):
            export(with_inputs / "block.morph", folder, file_format, np.zeros((4, 2)))
    assert (last in contents(folder)) == (file_format == "xdmf")
    export(with_inputs / "block.morph", folder, "vtu", np.zeros((1, 2)))
    assert contents(folder).keys() == {"block_0000.vtu", "block.pvd", "states.csv"}


def test_an_export_does_not_replace_the_table_of_its_states(with_inputs: Path) -> None:
    """Columns of the reader's own would be gone; nor one that an export has written."""
    folder = with_inputs / "out"
    export(with_inputs / "block.morph", folder, "vtu", np.zeros((2, 2)))
    before = contents(folder)
    with pytest.raises(ExportError, match=r"states\.csv is an input of this command"):
        export(with_inputs / "block.morph", folder, "vtu", StateChoice(path=folder / "states.csv"))
    assert contents(folder) == before


@pytest.mark.parametrize("name", ["R&D", "RD"])
def test_an_xdmf_series_is_known_by_its_name(name: str, with_inputs: Path) -> None:
    model = with_inputs / f"{name}.morph"
    shutil.copy(with_inputs / "block.morph", model)
    export(model, with_inputs / "out", "xdmf", np.zeros((3, 2)))
    export(model, with_inputs / "out", "vtu", np.zeros((1, 2)))
    assert contents(with_inputs / "out").keys() == {f"{name}_0000.vtu", f"{name}.pvd", "states.csv"}


def test_files_of_structures_inside_go_with_their_export(with_inputs: Path) -> None:
    model = with_inputs / "block.morph"
    structure = read_inner_structure(stretched_block_model(), "left-lobe", with_inputs / "ball.stl", "m")
    save_inner_structure(with_inputs / "inner.h5", structure)
    export(model, with_inputs / "out", "vtu", np.zeros((3, 2)), inner=[with_inputs / "inner.h5"])
    assert "block_inner_left-lobe_0002.vtu" in contents(with_inputs / "out")
    export(model, with_inputs / "out", "vtu", np.zeros((1, 2)))
    assert contents(with_inputs / "out").keys() == {"block_0000.vtu", "block.pvd", "states.csv"}
