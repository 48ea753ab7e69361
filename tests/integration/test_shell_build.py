"""From a shell's study to a model file, its summary, and the tracking of a simulated film."""

import shutil

import h5py
import numpy as np
import pytest

from morph_dslam.cli import app as cli
from morph_dslam.mechanics.solvers.continuation import loaded_state
from morph_dslam.model import load_model
from morph_dslam.studies.build import build
from morph_dslam.studies.study import load_study
from tests.support.scenes import film_and_track, write_scene

STUDY = """
name = "arch"
shell = { thickness = "1 mm" }
material = { young_fibre = "2 GPa", young_cross = "1 GPa", poisson = 0.3, shear = "0.5 GPa", fibre = [0, 0, 1] }
supports = [{ kind = "clamped", on = "start" }, { kind = "rotation", on = "end", axis = [0, 0, 1], angle = "turn" }]
loads = [{ kind = "pressure", pressure = "0.2 kPa" }]
sampling = { scheme = "even", training = 8, held_out = 4, refined = 0 }

[mesh]
generator = "cylinder"
radius = "60 mm"
length = "30 mm"
angles = ["40 deg", "140 deg"]
divisions = [1, 4]

[parameters.turn]
range = ["-5 deg", "5 deg"]
"""


FILM = """
[[parameters]]
frame = 0
turn = -4.0
[[parameters]]
frame = 4
turn = 4.0

[[pose]]
frame = 0
position_mm = [0, 0, 130]
rotation_deg = [-90, 0, 0]
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("arch")
    (path / "study.toml").write_text(STUDY)
    build(path / "study.toml", path / "arch.morph", workers=1)
    return path


def test_the_model_is_the_shell(folder):
    model, study = load_model(folder / "arch.morph"), load_study(folder / "study.toml")
    problem, state, mu = study.problem(), model.at([np.radians(2.0)]), np.array([np.radians(2.0)])
    solved = loaded_state(problem, mu)
    exact = problem.sample(solved.dofs, mu)
    force, _ = problem.reactions(solved.dofs, mu, "start", np.zeros(3))
    found = {
        "displacement": state.displacement(),
        "stress_top": state.stress("top"),
        "stress_bottom": state.stress("bottom"),
    }
    for name, values in found.items():
        np.testing.assert_allclose(values, exact[name], atol=1e-2 * np.abs(exact[name]).max())
    np.testing.assert_allclose(state.reactions()["force_start"], force, atol=1e-2 * np.abs(force).max())
    # Upwards as seen from outside, where the normals of the cells point.
    a, b, c = np.moveaxis(model.nodes[model.triangles], 1, 0)
    assert (np.einsum("ti,ti->t", np.cross(b - a, c - a), a * [1.0, 1.0, 0.0]) > 0.0).all()


def test_the_model_is_summed_up(folder, capsys):
    assert cli.main(["info", str(folder / "arch.morph")]) == 0
    assert "stress, top face" in capsys.readouterr().out


def test_the_shell_is_filmed_and_tracked(folder, tmp_path):
    """Its outer side has the print; the parameter comes back from the film."""
    shutil.copy(folder / "arch.morph", tmp_path / "sheet.morph")
    scene = write_scene(tmp_path, tail=FILM)
    summary, _, run = film_and_track(scene, tmp_path / "sheet.morph")
    assert summary["n_tracked"] == 5
    with h5py.File(run / "result.h5") as file:
        found = np.degrees(file["parameters"][:, 0])
    np.testing.assert_allclose(found[[0, -1]], [-4.0, 4.0], atol=0.1)
