"""`morph build --compare` on a small block of three parameters, and methods that a study cannot use."""

from __future__ import annotations

import json
import tomllib

import matplotlib.image
import numpy as np
import pytest

from morph_dslam.cli import app as cli
from morph_dslam.errors import SolverError, StudyError
from morph_dslam.model import load_model
from morph_dslam.reduction.comparison import compare_methods, comparison_lines
from morph_dslam.studies.study import make_study, resolve_defaults
from tests.support.small_models import block_model

STUDY = """
name = "pushed block"
[mesh]
generator = "block"
size = ["20 mm", "20 mm", "40 mm"]
divisions = [2, 2, 4]
cells = "hex8"
[materials.rubber]
law = "neo_hookean"
young = "young"
poisson = 0.45
[[supports]]
kind = "fixed"
on = "z_min"
[[supports]]
kind = "rotation"
on = "z_max"
axis = [0, 1, 0]
angle = "bend"
[[loads]]
kind = "traction"
on = "x_min"
traction = ["push", "0 Pa", "0 Pa"]
[parameters.bend]
range = ["-25 deg", "25 deg"]
[parameters.push]
range = ["0 MPa", "0.2 MPa"]
[parameters.young]
range = ["2 MPa", "4 MPa"]
default = "3 MPa"
[solver]
threads = 1
[sampling]
first = 20
training = 32
held_out = 8
[reduction]
max_modes = 8
max_degree = 4
"""


@pytest.fixture(scope="module")
def compared(tmp_path_factory):
    folder = tmp_path_factory.mktemp("compared")
    (folder / "study.toml").write_text(STUDY)
    assert cli.main(["build", str(folder), "-o", str(folder / "block.morph"), "--compare"]) == 0
    return folder


def test_every_usable_method_has_its_figures(compared):
    rows = {row["method"]: row for row in json.loads((compared / "block.comparison.json").read_text())}
    assert set(rows) == {"galerkin", "pod", "sparse_pgd", "pgd"}
    assert "linear" in rows["pgd"]["unusable"]
    galerkin, pod = rows["galerkin"], rows["pod"]
    assert galerkin["format"] == "tucker"
    assert galerkin["relative_l2"] < 1e-3
    assert galerkin["stress"] < 1e-2
    assert galerkin["relative_l2"] < pod["relative_l2"] < 0.1
    for row in (galerkin, pod, rows["sparse_pgd"]):
        assert len(row["mean_mm_by_modes"]) == row["modes"]
        assert row["mean_mm_by_modes"][-1] == pytest.approx(row["mean_mm"], rel=1e-6)
    assert np.ptp(matplotlib.image.imread(compared / "block.comparison.png")[..., :3]) > 0.5


def test_the_model_kept_is_that_of_the_studys_own_method(compared):
    model = load_model(compared / "block.morph")
    assert model.certificate["reduction"]["method"] == "galerkin"
    assert model.certificate["samples"]["training"] <= 32
    assert model.certificate["estimator"]["effectivity_median"] == pytest.approx(1.0, abs=0.02)


def test_the_table_has_a_line_for_each_method(compared):
    lines = comparison_lines(compared / "block.morph")
    assert lines[0].split()[:4] == ["method", "format", "modes", "floats"]
    assert lines[1].startswith("galerkin    tucker")
    assert lines[-1].startswith("pgd: ")


def test_reactions_of_the_model_balance(compared):
    """What holds the bottom and what turns the top carry the traction on the side between them."""
    model = load_model(compared / "block.morph")
    bend, push, young = 0.2, 0.15e6, 2.7e6
    mu = np.array([bend, push, young])
    forces = sum(model.reactions[f"force_{name}"].value(mu)[0] for name in ("z_min", "z_max"))
    area = 0.02 * 0.04
    assert forces == pytest.approx([-push * area, 0.0, 0.0], abs=2e-3 * push * area)


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ('[reduction]\nmethod = "krylov"', "reduction.method"),
        ('[reduction]\nbasis = "kriging"', 'leave it out, or use one of "chebyshev", "cubic_spline"'),
        ('[reduction]\nmethod = "sparse_pgd"\nformat = "tucker"', 'use one of "cp"'),
        ('[reduction]\nmethod = "sparse_pgd"\ncomponents = "separate"', 'use method "galerkin" or "pod"'),
        ('[reduction]\nformat = "polynomial"\nbasis = "hat"', "leave out reduction.basis"),
        ('scheme = "adaptive"\n[reduction]\nmethod = "pod"', "needs an estimate of the error"),
    ],
)
def test_a_wrong_choice_is_one_message(tmp_path, capsys, line, message):
    (tmp_path / "study.toml").write_text(STUDY.replace("[reduction]", line))
    assert cli.main(["build", str(tmp_path), "-o", str(tmp_path / "x.morph")]) == 2
    printed = capsys.readouterr().err.splitlines()
    assert len(printed) == 1
    assert message in printed[0]


def test_methods_that_do_not_suit_a_study_are_refused_with_those_that_do():
    external = {
        "name": "runs",
        "external": {"table": "t.csv", "length_unit": "mm"},
        "reduction": {"method": "galerkin"},
    }
    with pytest.raises(StudyError, match=r'"galerkin" does not suit this study: .*Use "pod" or "sparse_pgd"'):
        resolve_defaults(make_study(external))


def test_defaults_follow_the_study():
    content = tomllib.loads(STUDY)
    assert resolve_defaults(make_study(content)).reduction.method == "galerkin"
    assert resolve_defaults(make_study(content)).sampling.scheme == "adaptive"
    one = content | {
        "parameters": {"bend": content["parameters"]["bend"]},
        "loads": [],
        "materials": {"rubber": {"law": "neo_hookean", "young": "3 MPa", "poisson": 0.45}},
    }
    assert resolve_defaults(make_study(one)).reduction.method == "pod"
    assert resolve_defaults(make_study(one)).sampling.scheme == "sobol"


def test_a_method_that_fails_in_any_known_way_costs_no_model():
    """Solves that do not converge too: the row says why, and the study's own model is there."""
    study = resolve_defaults(make_study(tomllib.loads(STUDY)))
    model = block_model("tucker")
    figures = {"mean_mm": 0.1, "max_mm": 0.2, "relative_l2": 0.01, "mean_mm_by_modes": [0.1]}
    model.certificate.update({"displacement": figures, "reduction": {"format": "tucker"}})

    def reduce(options):
        if options.method != study.reduction.method:
            raise SolverError("no equilibrium found")
        return model

    kept, rows = compare_methods(study, reduce)
    assert kept is model
    assert [row.get("unusable") for row in rows[1:]] == ["no equilibrium found"] * 3
