"""A tiny rubber block from its study file to a tracked video, by the command line."""

from __future__ import annotations

import json
import re
import tomllib
from dataclasses import replace

import h5py
import meshio
import numpy as np
import pytest

from morph_dslam import build, load_study, make_study
from morph_dslam.cli import app as cli
from morph_dslam.evaluation.run_folder import load_run
from morph_dslam.mechanics.solvers.continuation import advance
from morph_dslam.meshing.generators import block
from morph_dslam.model import load_model, save_model
from morph_dslam.studies.snapshots import load_snapshot
from tests.support.block_study import sliding
from tests.support.scenes import write_texture

BLOCK = """
name = "rubber block"
[mesh]
generator = "block"
size = ["40 mm", "40 mm", "80 mm"]
divisions = [3, 3, 6]
cells = "hex8"
[materials.rubber]
law = "neo_hookean"
young = "3 MPa"
poisson = 0.45
[[supports]]
kind = "fixed"
on = "z_min"
[[supports]]
kind = "rotation"
on = "z_max"
axis = [0, 1, 0]
angle = "bend"
translation = ["0 mm", "0 mm", "-1 * squash"]
[parameters.bend]
range = ["-25 deg", "25 deg"]
[parameters.squash]
range = ["0 mm", "8 mm"]
[solver]
threads = 1
[sampling]
training = 24
held_out = 8
refined = 0
[reduction]
max_degree = 5
"""
LOADED = BLOCK + '[unknown_loads]\non = "x_max"\nmodes = 6\n'
SCENE = """
model = "block.morph"
image_format = "png"
frames = 10
camera = { width = 480, height = 360, fx = 430.0, fy = 430.0, cx = 239.5, cy = 179.5 }
[surface]
texture = "print.png"
[[parameters]]
frame = 0
bend = 2.0
[[parameters]]
frame = 9
bend = 18.0
squash = 5.0
[[pose]]
frame = 0
position_mm = [-10, 45, 200]
rotation_deg = [110, 0, 25]
[[pose]]
frame = 9
position_mm = [0, 45, 195]
rotation_deg = [112, 4, 29]
"""


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    folder = tmp_path_factory.mktemp("block")
    (folder / "study.toml").write_text(LOADED)
    assert cli.main(["build", str(folder / "study.toml"), "-o", str(folder / "block.morph")]) == 0
    return folder


def test_held_out_errors_are_small(built):
    certificate = load_model(built / "block.morph").certificate
    samples = certificate["samples"]
    assert samples["training"] <= 24
    assert (samples["held_out"], samples["failed"]) == (8, [])
    assert samples["rounds"][-1]["largest_estimate"] <= 5e-4 / 2
    assert certificate["reduction"]["method"] == "galerkin"
    assert certificate["estimator"]["effectivity_min"] == pytest.approx(1.0, abs=0.02)
    assert certificate["displacement"]["mean_relative_to_largest"] < 1e-3
    assert certificate["sensitivity"]["bend"]["relative_l2"] < 1e-2
    assert certificate["stress_solid"]["relative_l2"] < 1e-2
    assert certificate["stress_solid"]["von_mises"]["relative_l2"] < 1e-2
    assert certificate["strain"]["relative_l2"] < 1e-2
    assert certificate["reaction_moment_z_max"]["relative_l2"] < 1e-2


def test_a_report_stands_beside_the_model(built):
    page = (built / "block.report.html").read_text()
    assert "could not be made" not in page
    assert "<td>moment on z_max</td>" in page
    assert page.count("data:image/") == 4


def test_the_model_moves_its_end_as_a_rigid_body(built):
    """The moved face is prescribed: Rodrigues' formula about its middle, less the squash."""
    model = load_model(built / "block.morph")
    angle, squash = np.radians(17.0), 0.005
    top = np.isclose(model.nodes[:, 2], 0.08)
    arm = model.nodes[top] - [0.02, 0.02, 0.08]
    turn = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    expected = arm @ turn.T + [0.02, 0.02, 0.08 - squash]
    assert model.positions(np.array([angle, squash]))[top] == pytest.approx(expected, abs=1e-5)
    assert model.cells["hex8"].shape == (54, 8)
    corners = model.nodes[model.triangles]
    outward = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert np.all(np.einsum("mx,mx->m", outward, corners.mean(axis=1) - [0.02, 0.02, 0.04]) > 0.0)


def test_reactions_are_kept_with_each_snapshot(built):
    """The block is in equilibrium: what holds its bottom balances what moves its top."""
    for path in sorted((built / "block.morph.snapshots").glob("*.npz"))[:4]:
        outputs = load_snapshot(path).outputs
        size = np.linalg.norm(outputs["force_z_max"])
        assert outputs["force_z_min"] == pytest.approx(-outputs["force_z_max"], abs=1e-6 * size)
        assert outputs["negative_pivots"] == 0


def test_sensitivities_agree_with_differences_of_the_model(built):
    """Snapshots' slopes, by implicit differentiation, against differences of the fitted model."""
    model = load_model(built / "block.morph")
    path = sorted((built / "block.morph.snapshots").glob("*.npz"))[0]
    snapshot = load_snapshot(path)
    mu = snapshot.coordinates
    for name in ("displacement", "stress_solid", "strain"):
        for k, step in enumerate((1e-3, 1e-5)):
            change = step * np.eye(2)[k]
            slope = (model.fields[name].value(mu + change) - model.fields[name].value(mu - change)) / (2 * step)
            missed = np.linalg.norm(slope - snapshot.sensitivities[name][k])
            assert missed < 0.03 * np.linalg.norm(slope)


def test_info_tells_of_a_solid(built, capsys):
    assert cli.main(["info", str(built / "block.morph")]) == 0
    text = capsys.readouterr().out
    assert "hex8 cells         54" in text
    assert "Cauchy stress" in text
    assert "bend    -25 to 25 deg" in text


@pytest.fixture(scope="module")
def filmed(built):
    """The block filmed; the options that `morph track` needs."""
    write_texture(built)
    (built / "scene.toml").write_text(SCENE)
    sequence = built / "seq"
    assert cli.main(["simulate", str(built / "scene.toml"), "-o", str(sequence)]) == 0
    options = [str(sequence / "frames"), "--model", str(built / "block.morph")]
    return [*options, "--camera", str(sequence / "camera.yaml"), "--landmarks", str(sequence / "landmarks.csv")]


@pytest.fixture(scope="module")
def tracked(built, filmed, blank_figures):
    """The run folder of the block, with arrows for forces and moduli known to 5 %."""
    with blank_figures():
        assert cli.main(["track", *filmed, "--forces", "--modulus-std", "5", "-o", str(built / "run")]) == 0
    return built / "run"


def test_forces_of_supports_come_with_every_frame(built, tracked):
    """Against the finite elements at the true parameters; the block is in equilibrium."""
    assert (tracked / "plots" / "reactions.png").stat().st_size > 10_000
    truth = np.load(built / "seq" / "truth.npz")
    problem = load_study(built / "study.toml").problem()
    last = advance(problem, problem.initial_state(), truth["parameters"][-1])[-1]
    force, moment = problem.reactions(last.dofs, last.mu, "z_max", np.zeros(3))
    with h5py.File(tracked / "result.h5") as file:
        top, bottom = (
            {key: item[()] for key, item in file[f"reactions/{name}"].items()} for name in ("z_max", "z_min")
        )
    np.testing.assert_allclose(top["force"], -bottom["force"], atol=1e-3 * np.abs(force).max())
    about_origin = top["moment"] + np.cross(top["point"], top["force"])
    np.testing.assert_allclose(top["force"][-1], force, atol=0.02 * np.linalg.norm(force))
    np.testing.assert_allclose(about_origin[-1], moment, atol=0.02 * np.linalg.norm(moment))
    middle = (
        problem.mesh.nodes[problem.mesh.set_nodes("z_max")]
        + problem.nodal_displacement(last.dofs)[problem.mesh.set_nodes("z_max")]
    )
    np.testing.assert_allclose(top["point"][-1], middle.mean(axis=0), atol=2e-4)
    assert np.all(top["force_std"] >= 0.05 * np.abs(top["force"]) * (1.0 - 1e-9))
    summary = json.loads((tracked / "summary.json").read_text())
    largest = summary["largest_forces"][0]
    assert largest["force_N"] == pytest.approx(np.linalg.norm(top["force"], axis=1).max(), rel=1e-3)
    table = (tracked / "frames.csv").read_text().splitlines()
    column = table[0].split(",").index("force_z_max_z_N")
    assert float(table[-1].split(",")[column]) == pytest.approx(force[2], rel=0.03)


def test_a_solid_is_filmed_and_tracked(built, tracked):
    assert (built / "run" / "augmented.mp4").stat().st_size > 1000
    run = load_run(built / "run")
    assert run.tracked.all()
    points = ["--points", str(built / "seq" / "truth.npz"), "--bind-frame", "0"]
    assert cli.main(["evaluate", str(built / "run"), *points]) == 0
    figures = json.loads((built / "run" / "evaluation.json").read_text())
    assert figures["mean_mm"] < 0.5


@pytest.mark.slow
def test_unknown_loads_that_do_not_act_leave_the_result_as_it_is(built, filmed, tracked):
    """Nothing but the study's own loads acts on the block."""
    run = built / "with_loads"
    assert cli.main(["track", *filmed, "--unknown-loads", "--show", "traction", "-o", str(run)]) == 0
    alone, both = load_run(tracked), load_run(run)
    assert both.tracked.all()
    change = np.abs(both.parameters[:, :2] - alone.parameters).max(axis=0)
    assert (change < [np.radians(0.6), 4e-4]).all()
    with h5py.File(run / "result.h5") as file:
        acting, own = (file[f"reactions/{name}/force"][()] for name in ("unknown loads", "z_max"))
    assert np.linalg.norm(acting, axis=1).max() < 0.1 * np.linalg.norm(own, axis=1).max()
    assert "force_unknown_loads_x_N" in (run / "frames.csv").read_text().splitlines()[0]
    points = ["--points", str(built / "seq" / "truth.npz"), "--bind-frame", "0"]
    assert cli.main(["evaluate", str(run), *points]) == 0
    assert json.loads((run / "evaluation.json").read_text())["mean_mm"] < 0.5


def test_arrows_need_reactions(built, filmed, tmp_path, capsys):
    model = load_model(built / "block.morph")
    save_model(tmp_path / "bare.morph", replace(model, reactions={}))
    options = [str(tmp_path / "bare.morph") if part.endswith("block.morph") else part for part in filmed]
    assert cli.main(["track", *options, "--forces", "-o", str(tmp_path / "run")]) == 2
    assert "leave out --forces" in capsys.readouterr().err


@pytest.mark.slow
def test_the_outline_of_a_closed_surface_counts_beside_its_texture(built, filmed):
    assert cli.main(["track", *filmed, "--outline", "--no-video", "-o", str(built / "outlined")]) == 0
    points = ["--points", str(built / "seq" / "truth.npz"), "--bind-frame", "0"]
    assert cli.main(["evaluate", str(built / "outlined"), *points]) == 0
    # The landmarks are exact and do not say so: what the outline is off by moves the block, by a third of a pixel.
    # The median, as points that are bound beside a rim lie on another face, by whatever little the block has moved.
    assert json.loads((built / "outlined" / "evaluation.json").read_text())["median_mm"] < 0.25


def test_a_solid_is_tracked_by_its_outline_alone_on_request(built, filmed):
    assert cli.main(["track", *filmed, "--no-texture", "--no-video", "-o", str(built / "plain")]) == 0
    summary = json.loads((built / "plain" / "summary.json").read_text())
    assert summary["n_tracked"] == summary["n_frames"]
    assert any("outline alone" in flag for flag in summary["flags"])
    assert (summary["new_reference_views"]["allowed"], summary["new_reference_views"]["made"]) == (False, 0)
    assert set(load_run(built / "plain").status) == {"tracked"}


@pytest.mark.parametrize(("modes", "missed"), [(1, True), (8, False)])
def test_stress_and_forces_that_are_reduced_badly_are_warned_of(modes, missed):
    """A column bent to and fro by half its length is compressed either way: one mode has no such part."""
    study = make_study(
        {
            "name": "column",
            "mesh": {"generator": "block", "size": ["9 mm", "9 mm", "27 mm"], "divisions": [1, 1, 3], "cells": "hex8"},
            "materials": {"rubber": {"law": "neo_hookean", "young": "3 MPa", "poisson": 0.3}},
            "supports": [
                {"kind": "fixed", "on": "z_min"},
                {"kind": "displacement", "on": "z_max", "x": "way", "y": "0 mm", "z": "0 mm"},
            ],
            "parameters": {"way": {"range": ["-15 mm", "15 mm"]}},
            "sampling": {"scheme": "even", "training": 8, "held_out": 4, "refined": 0},
            "reduction": {"max_modes": modes},
            "solver": {"workers": 1},
        }
    )
    certificate = build(study).certificate
    assert (certificate["reaction_force_z_max"]["relative_l2"] > 0.5) is missed
    warnings = [text for text in certificate.get("warnings", []) if "% of von Mises stress and" in text]
    assert len(warnings) == missed


def test_uniaxial_stretch_reaches_the_closed_form_through_the_whole_chain(tmp_path):
    """E = 3 MPa, nu = 0.45, stretch 1.5: lateral stretch 0.830679, nominal stress 1.075843 MPa."""
    text = BLOCK[: BLOCK.index("[[supports]]")] + sliding(("x_min", "x"), ("y_min", "y"), ("z_min", "z"))
    text += '[[supports]]\nkind = "displacement"\non = "z_max"\nz = "80 mm * stretch"\n'
    text += "[parameters.stretch]\nrange = [0.0, 0.6]\n"
    text += '[sampling]\nscheme = "even"\ntraining = 13\nheld_out = 5\nrefined = 0\n'
    text += "[reduction]\nmax_degree = 10\ntolerance = 1e-7\n"
    (tmp_path / "study.toml").write_text(text)
    assert cli.main(["build", str(tmp_path / "study.toml"), "-o", str(tmp_path / "bar.morph")]) == 0
    model = load_model(tmp_path / "bar.morph")
    mu = np.array([0.5])
    corner = np.isclose(model.nodes, [0.04, 0.04, 0.08]).all(axis=1)
    assert model.positions(mu)[corner][0] == pytest.approx([0.04 * 0.830679, 0.04 * 0.830679, 0.12], rel=2e-5)
    cauchy = 1.075843e6 / 0.830679**2
    assert model.von_mises(mu, "solid") == pytest.approx(np.full(len(model.nodes), cauchy), rel=1e-4)
    assert model.strain is not None
    green = [(0.830679**2 - 1) / 2, (0.830679**2 - 1) / 2, (1.5**2 - 1) / 2, 0, 0, 0]
    assert model.strain.value(mu) == pytest.approx(np.tile(green, (len(model.nodes), 1)), abs=1e-4)
    # The nominal stress on 40 x 40 mm; faces that only slide along their neighbours are free of force.
    force = 1.075843e6 * 0.04**2
    assert model.reactions["force_z_max"].value(mu)[0] == pytest.approx([0.0, 0.0, force], abs=1e-4 * force)
    assert set(model.reactions) == {f"{kind}_{end}" for kind in ("force", "moment") for end in ("z_min", "z_max")}
    assert model.certificate["reaction_force_z_max"]["largest_N"] > force
    assert model.certificate["reaction_force_z_max"]["relative_l2"] < 1e-4


MISTAKES = {
    "unknown set": ('on = "z_min"', 'on = "floor"', r"no node set or surface 'floor'; it has: .*z_max"),
    "unit slip": ('["40 mm", "40 mm", "80 mm"]', '["40 m", "40 m", "80 m"]', r"measures 40 x 40 x 80 m"),
    "unknown law": ('"neo_hookean"', '"neo_hooke"', r"not a known material law; known are neo_hookean"),
    "unknown key": ("[solver]", "[solver]\nspeed = 3", r"unknown key solver\.speed; known here: workers, thr"),
    "unknown parameter": ('angle = "bend"', 'angle = "bent"', r"names 'bent', which is no parameter; the par"),
    "falling range": ('["0 mm", "8 mm"]', '["8 mm", "0 mm"]', r"range must rise"),
}


@pytest.mark.parametrize("mistake", sorted(MISTAKES))
def test_a_mistake_in_a_study_is_one_message(tmp_path, refused, mistake):
    before, after, message = MISTAKES[mistake]
    assert before in BLOCK
    (tmp_path / "study.toml").write_text(BLOCK.replace(before, after))
    printed = refused("build", tmp_path / "study.toml", "-o", tmp_path / "x.morph")
    assert re.search(message, printed)


def write_cube(folder, nodes="1, 2, 4, 3, 5, 6, 8, 7", height=10):
    """The study with a mesh file in place of the block: one cell of the nodes given."""
    lines = ["*NODE"] + [
        f"{1 + i + 2 * j + 4 * k}, {10 * i}, {10 * j}, {height * k}" for k in (0, 1) for j in (0, 1) for i in (0, 1)
    ]
    lines += ["*ELEMENT, TYPE=C3D8, ELSET=all_of_it", f"1, {nodes}"]
    lines += ["*NSET, NSET=z_min", "1, 2, 3, 4", "*NSET, NSET=z_max", "5, 6, 7, 8"]
    (folder / "cube.inp").write_text("\n".join(lines) + "\n")
    start, end = BLOCK.index("generator"), BLOCK.index("[materials")
    (folder / "study.toml").write_text(BLOCK[:start] + 'file = "cube.inp"\nunit = "mm"\n' + BLOCK[end:])
    return folder / "study.toml"


def test_a_mesh_file_that_was_written_again_is_read_again(tmp_path):
    """In one process too, in a notebook say."""
    heights = [load_study(write_cube(tmp_path, height=h)).model_mesh().nodes[:, 2].max() for h in (20, 30)]
    np.testing.assert_allclose(heights, [0.02, 0.03])


def test_an_inverted_mesh_is_one_message(tmp_path, refused):
    study = write_cube(tmp_path, "1, 2, 4, 3, 5, 6, 7, 8")  # the top face crosses itself
    assert re.search(r"morph: .*(inverted|folded|inside out)", refused("build", study, "-o", tmp_path / "x.morph"))


@pytest.mark.slow
def test_a_load_past_its_limit_point_names_the_last_value_that_converged(tmp_path, refused):
    """A long tube under inner pressure: with a thin wall p = (wall / radius) mu (1 - stretch^-4) at most."""
    text = BLOCK[: BLOCK.index("generator")] + 'generator = "tube"\ninner_radius = "19 mm"\n'
    text += 'outer_radius = "21 mm"\nlength = "5 mm"\ndivisions = [1, 1, 6]\ncells = "hex20"\n'
    text += 'angles = ["0 deg", "90 deg"]\n' + BLOCK[BLOCK.index("[materials") : BLOCK.index("[[supports]]")]
    text += sliding(("bottom", "z"), ("top", "z"), ("start", "y"), ("end", "x"))
    text += '[[loads]]\nkind = "pressure"\non = "inner"\npressure = "inside"\n'
    text += '[parameters.inside]\nrange = ["0 kPa", "150 kPa"]\n[solver]\nthreads = 1\n'
    text += '[sampling]\nscheme = "even"\ntraining = 16\nheld_out = 4\nrefined = 0\n'
    (tmp_path / "study.toml").write_text(text)
    message = refused("build", tmp_path / "study.toml", "-o", tmp_path / "x.morph")
    found = re.search(r"inside could only be followed from 0 to ([\d.]+) kPa: no equilibrium found beyond", message)
    assert found
    limit = 100.0 * 3e6 / 2.9 * 1e-6
    assert 0.9 * limit < float(found[1]) < 1.05 * limit
    assert list((tmp_path / "x.morph.snapshots").glob("*.npz"))


@pytest.mark.slow
def test_python_states_the_same_study(built):
    """A dictionary in place of the file: the same solutions are found again, none is solved anew."""
    study = make_study(tomllib.loads(LOADED))
    assert study == load_study(built / "study.toml")
    before = sorted((built / "block.morph.snapshots").glob("*.npz"))
    model = build(study, built / "block.morph")
    assert sorted((built / "block.morph.snapshots").glob("*.npz")) == before
    mu = np.array([0.1, 0.002])
    kept = load_model(built / "block.morph").positions(mu)
    assert model.positions(mu) == pytest.approx(kept, abs=1e-8)


LAYERS = """
name = "two layers"
[mesh]
file = "layers.inp"
unit = "mm"
[materials.soft]
law = "linear_elastic"
on = "soft"
young = "60 kPa"
poisson = 0.0
[materials.stiff]
law = "linear_elastic"
on = "stiff"
young = "600 kPa"
poisson = 0.0
[[supports]]
kind = "fixed"
on = "root"
[[supports]]
kind = "displacement"
on = "end"
x = "stretch"
[parameters.stretch]
range = ["0 mm", "4 mm"]
[solver]
threads = 1
workers = 1
[sampling]
scheme = "sobol"
training = 8
held_out = 4
refined = 0
"""


def test_every_element_block_of_a_file_is_in_the_model_with_its_material(tmp_path):
    """Two layers of 40 x 10 x 5 mm, an ELSET each, stretched side by side: stress is modulus times stretch in each."""
    mesh = block((0.04, 0.01, 0.01), (4, 2, 4), "hex8")
    (cells,) = (part.connectivity for part in mesh.blocks)
    height, x = mesh.nodes[cells].mean(axis=1)[:, 2], mesh.nodes[:, 0]
    lines = ["*NODE", *(f"{k}, {a}, {b}, {c}" for k, (a, b, c) in enumerate(1e3 * mesh.nodes, start=1))]
    for name, chosen in (("soft", height < 5e-3), ("stiff", height > 5e-3)):
        lines.append(f"*ELEMENT, TYPE=C3D8, ELSET={name}")
        lines += [", ".join(map(str, [k + 1, *(cells[k] + 1)])) for k in np.flatnonzero(chosen)]
    for name, place in (("root", 0.0), ("end", 0.04)):
        lines += [f"*NSET, NSET={name}", *(f"{k + 1}," for k in np.flatnonzero(np.isclose(x, place)))]
    (tmp_path / "layers.inp").write_text("\n".join(lines))
    (tmp_path / "study.toml").write_text(LAYERS)
    model = build(tmp_path / "study.toml", tmp_path / "layers.morph")
    places = np.array([[0.02, 0.004, 0.001], [0.02, 0.004, 0.009]])
    stress = model.at({"stretch": "4 mm"}).stress(points=model.points(places))
    assert stress[:, 0] == pytest.approx([6e3, 6e4], rel=1e-6)
    out = tmp_path / "out"
    assert cli.main(["export", str(tmp_path / "layers.morph"), "-o", str(out), "--format", "vtu"]) == 0
    written = meshio.read(out / "layers_0000.vtu")
    volumes = np.prod(np.ptp(written.points[written.cells_dict["hexahedron"]], axis=1), axis=1)
    assert volumes.sum() == pytest.approx(4e-6, rel=1e-6)
