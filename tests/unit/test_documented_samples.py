"""Sample files and programs in the documentation are what the program accepts."""

import tomllib
from pathlib import Path

import cv2
import meshio
import netgen.occ as occ
import ngsolve as ngs
import numpy as np
import pytest

from morph_dslam import load_run, make_study
from morph_dslam.errors import StudyError
from morph_dslam.extend.reports import load_tracks
from morph_dslam.io.camera_files import load_camera
from morph_dslam.io.landmarks import load_landmarks
from morph_dslam.io.state_choice import StateChoice
from morph_dslam.mechanics.materials.user import UserMaterial
from morph_dslam.mechanics.solvers.continuation import advance, loaded_state
from morph_dslam.model import Parameter, save_model
from morph_dslam.reduction.report_pictures import read_reference_curve
from morph_dslam.registration.board import load_board
from morph_dslam.registration.guess import load_guess
from morph_dslam.registration.picture import load_picture
from morph_dslam.render.scene_file import load_scene_file
from morph_dslam.studies.affine import read_affine
from morph_dslam.studies.defaults import resolve_defaults
from morph_dslam.studies.external import ExternalStudy
from morph_dslam.studies.external_table import SolutionTable
from morph_dslam.studies.sections import UnknownLoadsSection
from morph_dslam.studies.sheet_study import SheetStudy
from morph_dslam.studies.shell_study import ShellStudy
from morph_dslam.studies.solid_study import SolidStudy
from tests.support.bent_sheet import bent_sheet_model
from tests.support.documents import PAGES, samples
from tests.support.meshes import surface_area
from tests.support.run_folders import exact_truth, write_run
from tests.support.scenes import MOTION, write_scene


def test_every_sample_file_is_read_by_a_test_here():
    """A new sample needs a line here, and a test."""
    pages = [page for page in PAGES if "tutorials" not in page]
    counts = {(page, kind): len(samples(page, kind)) for page in pages for kind in ("toml", "yaml", "csv")}
    assert {key: count for key, count in counts.items() if count} == {
        ("cameras", "yaml"): 1,
        ("certificate", "csv"): 1,
        ("export", "csv"): 1,
        ("external-solutions", "csv"): 1,
        ("external-solutions", "toml"): 2,
        ("record-your-own", "toml"): 2,
        ("record-your-own", "csv"): 1,
        ("registration-aids", "toml"): 3,
        ("scene-file", "toml"): 2,
        ("registration", "csv"): 1,
        ("registration-aids", "csv"): 1,
        ("shell-study", "toml"): 2,
        ("solid-study", "toml"): 10,
        ("study-file", "toml"): 1,
    }


def test_camera_file(tmp_path):
    (tmp_path / "camera.yaml").write_text(samples("cameras", "yaml")[0])
    camera = load_camera(tmp_path / "camera.yaml")
    assert (camera.width, camera.fx, len(camera.distortion)) == (640, 528.0, 4)


def test_scene_files(tmp_path):
    still, moving = samples("scene-file", "toml")
    (tmp_path / "scene.toml").write_text(still)
    assert load_scene_file(tmp_path / "scene.toml").occluder is not None
    # the second sample's camera goes round what the first one shows
    (tmp_path / "scene.toml").write_text(still + moving)
    scene = load_scene_file(tmp_path / "scene.toml")
    assert scene.environment is not None
    assert (len(scene.camera_path), scene.environment.boxes[0].turn_deg) == (2, 30)


def test_boards_pictures_and_guesses(tmp_path):
    for name, text in zip(("board", "picture", "guess"), samples("registration-aids", "toml"), strict=True):
        (tmp_path / f"{name}.toml").write_text(text)
    board = load_board(tmp_path / "board.toml")
    np.testing.assert_allclose(board.size, [4 * 0.030 + 3 * 0.009, 3 * 0.030 + 2 * 0.009])
    cv2.imwrite(str(tmp_path / "print.png"), np.zeros((30, 42, 3), np.uint8))
    rectangle = load_picture(tmp_path / "picture.toml").rectangle
    assert rectangle is not None
    np.testing.assert_allclose(rectangle[1], [0.420, 0.0, 0.0])
    state = load_guess(tmp_path / "guess.toml").state(bent_sheet_model(9, 7))
    np.testing.assert_allclose(state.parameters, [0.020, 0.0, 0.0])


def test_landmarks_and_curves(tmp_path):
    (tmp_path / "landmarks.csv").write_text(samples("registration-aids", "csv")[0])
    landmarks = load_landmarks(tmp_path / "landmarks.csv")
    np.testing.assert_allclose(landmarks.points[0], [-0.210, 0.1485, 0.0])
    (tmp_path / "clicks.csv").write_text(samples("registration", "csv")[0])
    assert load_landmarks(tmp_path / "clicks.csv").frames.tolist() == [12, 12, 12]
    (tmp_path / "curve.csv").write_text(samples("certificate", "csv")[0])
    assert read_reference_curve(tmp_path / "curve.csv").label == "the paper"


def test_paths_of_an_export(tmp_path):
    (tmp_path / "path.csv").write_text(samples("export", "csv")[0])
    states = StateChoice(path=tmp_path / "path.csv").states(bent_sheet_model(9, 7))
    np.testing.assert_allclose(states[-1], [0.040, 0.0, np.radians(10.0)])


def test_study_of_a_sheet():
    study = make_study(tomllib.loads(samples("study-file", "toml")[0]))
    assert isinstance(study, SheetStudy)
    assert study.sheet.length == pytest.approx(0.420)


def test_study_of_a_shell():
    study = make_study(tomllib.loads(samples("shell-study", "toml")[0]))
    assert isinstance(study, ShellStudy)
    problem, mu = study.problem(), np.array([20.0, 0.2])
    start = loaded_state(problem, study.root())
    assert problem.nodal_displacement(advance(problem, start, mu)[-1].dofs)[:, 1].max() > 3e-4


def test_hands_that_bend_a_sheet_come_together_as_an_arc_does():
    plate = 'name = "sheet"\nmesh = { generator = "plate", size = ["400 mm", "150 mm"], divisions = [10, 4] }\n'
    made = 'shell = { thickness = "1 mm" }\nmaterial = { young = "4 GPa", poisson = 0.3 }\n'
    study = make_study(tomllib.loads(plate + made + samples("shell-study", "toml")[1]))
    assert isinstance(study, ShellStudy)
    way = read_affine(study.supports[1].translation[0], "length", study.model_parameters())
    for degrees in (20.0, 35.0):
        turn = np.radians(degrees)
        assert way(np.array([turn, 0.0])) == pytest.approx(-0.4 * (1.0 - np.sin(turn) / turn), abs=7e-4)


def test_a_recording_of_your_own(tmp_path, monkeypatch):
    """Study and landmarks are read; the program follows dots in a video to a tenth of a pixel."""
    whole, notched = map(tomllib.loads, samples("record-your-own", "toml"))
    study = make_study(whole)
    assert isinstance(study, SolidStudy)
    assert [parameter.name for parameter in study.model_parameters()] == ["stroke"]
    other = make_study(whole | notched)
    assert isinstance(other, SolidStudy)
    mesh = other.solid_mesh()
    assert {"x_min", "x_max", "hole_1", "side_2"} <= set(mesh.surfaces)
    assert np.ptp(mesh.nodes, axis=0) == pytest.approx([0.08, 0.02, 0.002])
    (tmp_path / "landmarks.csv").write_text(samples("record-your-own", "csv")[0])
    landmarks = load_landmarks(tmp_path / "landmarks.csv")
    scale = np.linalg.norm(np.diff(landmarks.pixels[:2], axis=0)) / np.linalg.norm(
        np.diff(landmarks.points[:2], axis=0)
    )
    assert scale == pytest.approx(13_670.0, rel=1e-3)  # pixels a metre
    monkeypatch.chdir(tmp_path)
    centres = np.array([[40.3, 50.6], [100.8, 52.1], [70.4, 110.9]])
    rows, columns = np.mgrid[:160, :240]
    video = cv2.VideoWriter("pull.mp4", cv2.VideoWriter.fourcc(*"mp4v"), 30.0, (240, 160))
    for frame in range(5):
        moved = centres + np.array([3.37 * frame, 0.0])
        distance = np.min([np.hypot(columns - u, rows - v) for u, v in moved], axis=0)
        image = (30 + 190 * np.clip(distance - 7.0 + 0.5, 0.0, 1.0)).astype(np.uint8)  # radius 7 px
        video.write(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR))
    video.release()
    exec(compile(samples("record-your-own", "python")[0], "record-your-own", "exec"), {})
    tracks = load_tracks("tracks.csv")
    assert tracks.pixels.shape == (5, 3, 2)
    order = np.linalg.norm(tracks.pixels[0][:, None] - centres, axis=2).argmin(axis=1)
    expected = centres[order] + np.arange(5)[:, None, None] * [3.37, 0.0]
    assert np.abs(tracks.pixels - expected).max() < 0.1


def test_an_exported_run_in_the_coordinates_of_the_world(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    save_model(Path("sheet.morph"), write_run(Path("run")))
    exec(compile(samples("export", "python")[0], "export", "exec"), {})
    found, run = meshio.read("in_world_0000.vtu"), load_run("run")
    np.testing.assert_allclose(found.points, run.camera_points(0), atol=1e-7)


def test_study_of_a_solid():
    """Its block is 60 mm high, and pulled by 20 mm."""
    study = make_study(tomllib.loads(samples("solid-study", "toml")[0]))
    assert isinstance(study, SolidStudy)
    problem = study.problem()
    mu = np.array([parameter.upper for parameter in study.model_parameters()])
    moved = problem.nodal_displacement(advance(problem, problem.initial_state(), mu)[-1].dofs)
    top = problem.mesh.nodes[:, 2] > 0.0599
    np.testing.assert_allclose((problem.mesh.nodes + moved)[top, 2], 0.080, atol=1e-9)


def test_values_of_a_solids_study():
    """Each line of the sample is read as what its key measures, with parameters of the kinds it tells."""
    parameters = tuple(
        Parameter(name, quantity, unit, 0.0, 1.0, 0.0)
        for name, quantity, unit in (
            ("lever", "angle", "deg"),
            ("inflation", "pressure", "kPa"),
            ("share", "ratio", "1"),
            ("held", "time", "s"),
        )
    )
    measured = {"young": "stress", "angle": "angle", "pressure": "pressure", "force": "force", "x": "length"}
    values = tomllib.loads(samples("solid-study", "toml")[1])
    assert set(values) == set(measured)
    found = {
        key: [read_affine(text, measured[key], parameters) for text in np.atleast_1d(value).tolist()]
        for key, value in values.items()
    }
    assert found["young"][0].constant == 3e6
    assert (found["pressure"][0].constant, found["pressure"][0].slopes) == (2e3, (0.0, 0.5, 0.0, 0.0))
    assert found["force"][2].slopes == (0.0, 0.0, -20.0, 0.0)
    assert found["x"][0].slopes == pytest.approx((0.0, 0.0, 0.0, 0.0015))


def test_sets_by_their_place():
    """Of a block from the origin: the lowest row of cells, and a spot of its top."""
    sizes = {"size": ["60 mm", "40 mm", "31 mm"], "divisions": [30, 20, 6]}
    study = {
        "name": "block",
        "mesh": {"generator": "block", "cells": "hex8", **sizes},
        "materials": {"silicone": {"law": "neo_hookean", "young": "0.1 MPa", "poisson": 0.45}},
        "supports": [{"kind": "fixed", "on": "base"}],
        "loads": [{"kind": "pressure", "on": "pressed", "pressure": "p"}],
        "parameters": {"p": {"range": ["0 kPa", "1 kPa"]}},
    }
    mesh = make_study(study | tomllib.loads(samples("solid-study", "toml")[2])).solid_mesh()
    assert mesh.nodes[mesh.set_nodes("base"), 2].max() == pytest.approx(0.031 / 6)
    spot = mesh.nodes[mesh.surface_nodes("pressed")]
    np.testing.assert_allclose(spot[:, 2], 0.031)
    assert np.linalg.norm(spot - [0.012, 0.004, 0.031], axis=1).max() <= 0.009


def test_the_wall_of_a_chamber_with_an_inlet(tmp_path):
    """A chamber of 12 x 9 x 11.5 mm with an inlet of 1 mm diameter, 6 mm long."""
    air = occ.Box((6, 2.5, 2.5), (18, 11.5, 14)) + occ.Cylinder((0, 7, 8), occ.X, r=0.5, h=7)
    (occ.Box((0, 0, 0), (24, 14, 16)) - air).WriteStep(str(tmp_path / "part.step"))
    study = {
        "name": "actuator",
        "mesh": {"file": str(tmp_path / "part.step"), "unit": "mm", "size": "4 mm"},
        "materials": {"silicone": {"law": "neo_hookean", "young": "0.1 MPa", "poisson": 0.45}},
        "supports": [{"kind": "fixed", "on": "x_max"}],
        "parameters": {"inflate": {"range": ["0 kPa", "10 kPa"]}},
    }
    made = make_study(study | tomllib.loads(samples("solid-study", "toml")[3]))
    assert isinstance(made, SolidStudy)
    area = 1e6 * surface_area(made.solid_mesh(), "chamber")
    wall = 2 * (12 * 9 + 12 * 11.5 + 9 * 11.5) - np.pi * 0.25
    assert wall * 0.9995 < area < (wall + np.pi * 6) * 1.0005


def test_a_strip_that_buckles_upwards_first():
    study = {
        "name": "strip",
        "mesh": {"generator": "block", "size": ["100 mm", "10 mm", "2 mm"], "divisions": [10, 1, 1], "cells": "hex8"},
        "materials": {"rubber": {"law": "neo_hookean", "young": "3 MPa", "poisson": 0.3}},
        "parameters": {"weight": {"range": ["0 Pa", "30 Pa"], "default": "20 Pa"}},
    }
    sample = tomllib.loads(samples("solid-study", "toml")[4])
    weight = {"kind": "traction", "on": "z_max", "traction": ["0 Pa", "0 Pa", "-1 * weight"]}
    supports, loads = [{"kind": "fixed", "on": "x_min"}, *sample["supports"]], [*sample["loads"], weight]
    sweep = make_study(study | {"supports": supports, "loads": loads}).sweep_problem()
    assert sweep.take_snapshot(sweep.first_state()).fields["displacement"][:, 2].max() > 5e-3


def test_a_bar_with_a_fitting_at_its_end():
    """The support holds what the fitting transmits: the force, and its moment about the deformed place."""
    study = {
        "name": "bar",
        "mesh": {"generator": "block", "size": ["100 mm", "10 mm", "10 mm"], "divisions": [6, 1, 1], "cells": "hex8"},
        "materials": {"rubber": {"law": "neo_hookean", "young": "3 MPa", "poisson": 0.4}},
        "supports": [{"kind": "fixed", "on": "x_min"}],
        "parameters": {"pull": {"range": ["0 N", "0.1 N"]}, "bend": {"range": ["-5 N.mm", "5 N.mm"]}},
    }
    study |= tomllib.loads(samples("solid-study", "toml")[5])
    sweep = make_study(study).sweep_problem()
    outputs = sweep.take_snapshot(sweep.advance(sweep.first_state(), np.array([0.05, 2e-3]))).outputs
    place = np.array([0.12, 0.0, 0.025]) + outputs["translation_x_max"]
    np.testing.assert_allclose(outputs["force_x_min"], [0.0, 0.0, 0.05], atol=1e-7)
    expected = [0.05 * place[1], -0.05 * place[0] - 2e-3, 0.0]
    np.testing.assert_allclose(outputs["moment_x_min"], expected, atol=1e-8)


def test_a_ball_that_presses_on_a_block():
    places = {name: {"range": ["20 mm", "80 mm"], "default": "40 mm"} for name in ("place_x", "place_y")}
    study = {
        "name": "block",
        "mesh": {"generator": "block", "size": ["100 mm", "100 mm", "30 mm"], "divisions": [5, 5, 2], "cells": "hex8"},
        "materials": {"silicone": {"law": "neo_hookean", "young": "0.1 MPa", "poisson": 0.45}},
        "supports": [{"kind": "fixed", "on": "z_min"}],
        "parameters": {"depth": {"range": ["0 mm", "8 mm"]}} | places,
    }
    study |= tomllib.loads(samples("solid-study", "toml")[6])
    made = make_study(study)
    assert isinstance(made, SolidStudy)
    assert resolve_defaults(made).reduction.method == "pod"
    with pytest.raises(StudyError, match="begin to touch"):
        resolve_defaults(make_study(study | {"reduction": {"method": "galerkin"}}))
    problem = made.problem()
    state = advance(problem, problem.initial_state(), np.array([0.004, 0.04, 0.06]))[-1]
    below = problem.mesh.nodes + problem.nodal_displacement(state.dofs)
    # The ball's lowest point was 4 mm below the top, where the node under it has gone.
    assert np.linalg.norm(below - [0.04, 0.06, 0.041], axis=1).min() == pytest.approx(0.015, abs=5e-4)


def test_a_stroke_that_grows_stays_and_goes_back():
    section = tomllib.loads(samples("solid-study", "toml")[9])
    gel = {"law": "neo_hookean", "young": "1 MPa", "poisson": 0.3}
    parameters = {"time": {"range": ["0 s", "20 s"]}, "stroke": {"range": ["0 mm", "8 mm"]}}
    study = {
        "name": "bar",
        "mesh": {"generator": "block", "size": ["10 mm", "10 mm", "20 mm"], "divisions": [1, 1, 1], "cells": "hex8"},
        "materials": {"gel": gel | {"prony": {"relative_moduli": [0.6], "times": ["2 s"]}}},
        "parameters": parameters,
    }
    held = [{"kind": "fixed", "on": "z_min"}, *section.pop("supports")]
    made = make_study(study | section | {"supports": held})
    assert isinstance(made, SolidStudy)
    symbols = made.problem().symbols
    for time, share in ((1.0, 0.5), (5.0, 1.0), (12.5, 0.75), (20.0, 0.5)):
        symbols.set(np.array([time, 8e-3]))
        assert symbols.value(symbols["stroke"] * symbols["ramp"]) == pytest.approx(share * 8e-3)


def test_shape_of_a_solid():
    study = {
        "name": "tube",
        "mesh": {
            "generator": "tube",
            "inner_radius": "10 mm",
            "outer_radius": "14 mm",
            "length": "30 mm",
            "divisions": [1, 1, 6],
        },
        "materials": {"rubber": {"law": "neo_hookean", "young": "3 MPa", "poisson": 0.4}},
        "supports": [{"kind": "fixed", "on": "bottom"}],
        "parameters": {"growth": {"range": ["-0.5 mm", "1 mm"]}},
    }
    study |= tomllib.loads(samples("solid-study", "toml")[7])
    made = make_study(study)
    assert isinstance(made, SolidStudy)
    assert [shape.kind for shape in made.shape] == ["thickness"]
    with pytest.raises(StudyError, match="amplitude"):
        make_study(study | {"shape": [{"kind": "thickness", "on": "outer", "kept": "inner"}]})


def test_solutions_of_another_program(tmp_path):
    section, reactions = samples("external-solutions", "toml")
    study = make_study(tomllib.loads(section), tmp_path)
    assert isinstance(study, ExternalStudy)
    (tmp_path / "parameters.csv").write_text(samples("external-solutions", "csv")[0])
    table = SolutionTable(study.external.table)
    parameters, values = table.parameters()
    assert [parameter.name for parameter in parameters] == ["force", "tilt"]
    np.testing.assert_allclose(values[0], [0.5, np.radians(-3.0)])
    assert table.rows[0]["file"] == "run0.vtu"
    named = make_study(tomllib.loads(f'{section}force_unit = "N"\n{reactions}'), tmp_path)
    assert isinstance(named, ExternalStudy)
    assert list(named.external.reactions) == ["base", "punch"]


def run_sample(page: str, number: int = 0) -> dict:
    names: dict = {}
    exec(samples(page, "python")[number], names)
    return names


def test_a_simulated_sequence_is_tracked_in_memory(tmp_path, monkeypatch):
    write_scene(tmp_path, tail=MOTION)
    monkeypatch.chdir(tmp_path)
    names = run_sample("scene-file")
    assert names["frame"].index == 4
    assert abs(names["result"].estimate.state.parameters[0] - names["true"][0]) < 0.5e-3


def test_every_program_is_run_by_a_test():
    """In `test_docs` (model-file, solid-study), `test_slam`, `test_own_program`, `test_studio`, and others."""
    run_elsewhere = {"README", "quick-start", "extending"}
    pages = [page for page in PAGES if "tutorials" not in page and page not in run_elsewhere]
    counts = {page: len(samples(page, "python")) for page in pages}
    assert {page: count for page, count in counts.items() if count} == {
        "certificate": 1,
        "evaluation": 1,
        "export": 2,
        "material-tests": 1,
        "materials": 1,
        "meshes": 1,
        "model-file": 2,
        "own-program": 12,
        "record-your-own": 1,
        "scene-file": 1,
        "slam": 2,
        "solid-study": 3,
        "sources": 1,
        "streams": 1,
        "studio": 1,
    }


INP = """*NODE
1, 0, 0, 0
2, 10, 0, 0
3, 0, 10, 0
4, 0, 0, 10
*ELEMENT, TYPE=C3D4, ELSET=rubber
1, 1, 2, 3, 4
*NSET, NSET=grip
1, 2, 3
"""


def test_meshes(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("mount.inp").write_text(INP)
    mesh = run_sample("meshes")["mesh"]
    np.testing.assert_allclose(np.ptp(mesh.nodes, axis=0), [0.010, 0.010, 0.010])


def test_law_of_ones_own():
    """The sample with its bulk modulus is neo-Hookean: its shear modulus at small strain is mu."""
    law = UserMaterial(function=run_sample("materials")["energy"], values={"mu": 2.5e5}, bulk=5e6)
    law.check()
    stiffness = law.small_strain_stiffness()
    np.testing.assert_allclose(stiffness[3, 3], 2.5e5, rtol=1e-10)
    np.testing.assert_allclose(stiffness[0, 0], 5e6 + 4.0 / 3.0 * 2.5e5, rtol=1e-10)
    assert law.function(ngs.Id(3), 2.0).dim == 1


def test_a_law_of_ones_own_is_fitted(capsys):
    names = run_sample("material-tests")
    # The sample's stress is neo-Hookean, which Gent's law is if its chains are endless.
    assert names["fit"].constants["shear"] == pytest.approx(0.4e6, rel=2e-3)
    assert "shear" in capsys.readouterr().out


def test_report_from_the_model_alone(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    save_model(Path("seal.morph"), bent_sheet_model(9, 7))
    run_sample("certificate")
    assert "<html" in Path("seal.report.html").read_text()


def test_evaluation_in_memory(tmp_path, monkeypatch):
    """Truth that follows the run exactly has no error in any frame but the binding one."""
    monkeypatch.chdir(tmp_path)
    np.savez("truth.npz", **exact_truth(write_run(Path("run"))))
    before = sorted(tmp_path.rglob("*"))
    in_frame = run_sample("evaluation")["in_frame"]
    assert in_frame == pytest.approx(dict.fromkeys(("11", "12", "13", "14", "15"), 0.0), abs=1e-4)
    assert sorted(tmp_path.rglob("*")) == before


def test_unknown_loads():
    section = UnknownLoadsSection(**tomllib.loads(samples("solid-study", "toml")[8])["unknown_loads"])
    assert (section.on, section.direction, section.modes) == ("top", "inward", 60)


def clamped_arch(young: float, thickness: float, radius: float, angle: float) -> np.ndarray:
    """Sinks of the middle, m, and loads, Pa, (2, n) of a shallow clamped arch of unit width that stays symmetric.

    With the thrust N and the half span a, E I w'''' + N w'' = q - N / R gives w' = B (x - a sin(kx) / sin(ka)), where
    k^2 = N / (E I) and B = (q - N / R) / N; the arch shortens by N a / (E A) = -int x w' / R + w'^2 / 2 dx.
    """
    a, stiffness = radius * np.sin(angle), young * thickness**3 / 12.0
    x, curve = np.linspace(0.0, a, 2001), []
    for share in np.linspace(0.0031, 2.5531, 1276):  # N over Euler's load of the span, at 1 of which sin(ka) = 0
        thrust = share * stiffness * (np.pi / a) ** 2
        k = np.sqrt(thrust / stiffness)
        slope = x - a * np.sin(k * x) / np.sin(k * a)
        square, along, sink = (np.trapezoid(part, x) for part in (slope**2, x * slope, slope))
        both = np.roots([square / 2.0, along / radius, thrust * a / (young * thickness)])
        curve += [(-b * sink, thrust * (b + 1.0 / radius)) for b in both if np.isreal(b)]
    return np.array(sorted(curve)).real.T


def test_an_arch_that_snaps_through() -> None:
    """Against the closed form, whose load has a maximum of 35.8 Pa and a minimum of 13.2 Pa."""
    names = run_sample("solid-study", 2)
    loads, sinks, stable = (np.array(names[name]) for name in ("loads", "sinks", "stable"))
    assert (loads[0], loads[-1]) == (0.0, pytest.approx(40.0))
    assert (np.diff(sinks) > 0.0).all()
    expected = np.interp(sinks, *clamped_arch(1e8, 0.5e-3, 0.40025, np.radians(5.0)))
    np.testing.assert_allclose(loads[1:], expected[1:], atol=0.5)
    falls = np.array([point.rate < 0.0 for point in names["points"]])
    assert falls.sum() >= 3
    assert not stable[falls].any()
    assert stable[[0, -1]].all()
