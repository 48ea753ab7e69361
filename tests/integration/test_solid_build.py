"""A tiny rubber block from its study file to a tracked video, by the command line."""

from __future__ import annotations

import json

import numpy as np
import pytest

from morph_dslam import cli
from morph_dslam.evaluation.run_folder import load_run
from morph_dslam.model import load_model
from morph_dslam.offline.snapshots import load_snapshot
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
[reduction]
max_degree = 5
"""

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
    (folder / "study.toml").write_text(BLOCK)
    assert cli.main(["build", str(folder / "study.toml"), "-o", str(folder / "block.morph")]) == 0
    return folder


def test_held_out_errors_are_small(built):
    certificate = load_model(built / "block.morph").certificate
    assert certificate["samples"] == {"training": 24, "held_out": 8, "failed": []}
    assert certificate["displacement"]["mean_relative_to_largest"] < 1e-3
    assert certificate["sensitivity"]["bend"] < 1e-2
    assert certificate["stress_solid"] < 1e-2
    assert certificate["strain"] < 1e-2


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
            slope = (model.fields[name].value(mu + change) - model.fields[name].value(mu - change)) / (
                2 * step
            )
            missed = np.linalg.norm(slope - snapshot.sensitivities[name][k])
            assert missed < 0.03 * np.linalg.norm(slope)


def test_info_tells_of_a_solid(built, capsys):
    assert cli.main(["info", str(built / "block.morph")]) == 0
    text = capsys.readouterr().out
    assert "hex8 cells         54" in text
    assert "Cauchy stress" in text
    assert "bend    -25 to 25 deg" in text


def test_a_solid_is_filmed_and_tracked(built):
    write_texture(built)
    (built / "scene.toml").write_text(SCENE)
    assert cli.main(["simulate", str(built / "scene.toml"), "-o", str(built / "seq")]) == 0
    sequence = built / "seq"
    command = ["track", str(sequence / "frames"), "--model", str(built / "block.morph")]
    command += ["--camera", str(sequence / "camera.yaml"), "--landmarks", str(sequence / "landmarks.csv")]
    assert cli.main([*command, "-o", str(built / "run")]) == 0
    assert (built / "run" / "augmented.mp4").stat().st_size > 1000
    run = load_run(built / "run")
    assert run.tracked.all()
    points = ["--points", str(sequence / "truth.npz"), "--bind-frame", "0"]
    assert cli.main(["evaluate", str(built / "run"), *points]) == 0
    figures = json.loads((built / "run" / "evaluation.json").read_text())
    assert figures["mean_mm"] < 0.5


def test_uniaxial_stretch_reaches_the_closed_form_through_the_whole_chain(tmp_path):
    """E = 3 MPa, nu = 0.45, stretch 1.5: lateral stretch 0.830679, nominal stress 1.075843 MPa."""
    text = BLOCK[: BLOCK.index("[[supports]]")]
    for face, axis in (("x_min", "x"), ("y_min", "y"), ("z_min", "z")):
        text += f'[[supports]]\nkind = "displacement"\non = "{face}"\n{axis} = "0 mm"\n'
    text += '[[supports]]\nkind = "displacement"\non = "z_max"\nz = "80 mm * stretch"\n'
    text += (
        '[parameters.stretch]\nrange = [0.0, 0.6]\n[sampling]\nscheme = "even"\ntraining = 13\nheld_out = 5\n'
    )
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
