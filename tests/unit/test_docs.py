"""The programs in the documentation do what it says."""

import re
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest

from morph_dslam.model import SeparatedField, load_model, save_model
from morph_dslam.model.basis_functions import chebyshev_basis
from morph_dslam.model.tensor_functions import TuckerFunctions
from tests.support.bent_sheet import bent_sheet_model
from tests.support.function_formats import FORMATS
from tests.support.small_models import block_model

DOCS = Path(__file__).parents[2] / "docs"


def documented_readers():
    """The programs that read model files without the library: the short one, and the one for all formats."""
    programs = re.findall(r"```python\n(.*?)```", (DOCS / "model-file.md").read_text(), flags=re.DOTALL)
    readers = []
    for program in programs:
        assert "morph_dslam" not in program
        names = {}
        exec(program, names)
        readers.append(names)
    return readers


@pytest.fixture(scope="module")
def reader():
    """The documented program for all formats."""
    return documented_readers()[1]


def test_the_short_reader_reads_what_studies_make(tmp_path):
    short, sheet = documented_readers()[0]["field"], bent_sheet_model(9, 7)
    bases = tuple(chebyshev_basis(p.lower, p.upper, 2) for p in sheet.parameters)
    random = np.random.default_rng(0)
    factors = tuple(random.standard_normal((3, rank)) for rank in (2, 3, 1))
    core = random.standard_normal((sheet.displacement.n_modes, 2, 3, 1))
    tucker = SeparatedField(sheet.displacement.modes, TuckerFunctions(bases, factors, core))
    mu = np.array([0.025, -0.3, 0.2])
    for model in (sheet, replace(sheet, displacement=tucker)):
        save_model(tmp_path / "sheet.morph", model)
        with h5py.File(tmp_path / "sheet.morph") as file:
            found = short(file, "displacement", mu)
        # modes are kept in single precision
        scale = (
            np.abs(model.displacement.modes).max() * np.abs(model.displacement.functions.rows(mu)[0]).sum()
        )
        np.testing.assert_allclose(found, model.displacement.value(mu), rtol=0.0, atol=1e-7 * scale)


def test_the_model_file_can_be_read_with_the_documented_program(tmp_path, reader):
    path, mu = tmp_path / "sheet.morph", np.array([0.025, -0.3, 0.2])
    model = bent_sheet_model(9, 7)
    save_model(path, model)
    positions = reader["deformed_positions"](path, mu)
    np.testing.assert_allclose(positions, model.positions(mu), atol=1e-8)
    np.testing.assert_allclose(positions, load_model(path).positions(mu), atol=1e-12)


@pytest.mark.parametrize("form", FORMATS)
@pytest.mark.parametrize("mu", [[-1.0, 0.0, 0.0], [0.3, 0.7, 1.9], [1.0, 1.0, 2.0]])
def test_every_format_can_be_read_with_the_documented_program(tmp_path, reader, form, mu):
    save_model(tmp_path / "block.morph", block_model(form))
    model = load_model(tmp_path / "block.morph")
    with h5py.File(tmp_path / "block.morph") as file:
        for name in ("displacement", "stress_solid", "strain"):
            value = model.fields[name].value(mu)
            found = reader["field"](file, name, mu)
            np.testing.assert_allclose(found, value, atol=1e-9 * np.abs(value).max())


def test_the_programs_for_solids_pull_a_block_as_far_as_its_law_says(tmp_path, monkeypatch):
    """E = 3 MPa, nu = 0, nominal stress 0.3 MPa = mu (s - 1/s): the stretch s is 1.104988."""
    monkeypatch.chdir(tmp_path)
    text = (DOCS / "solid-study.md").read_text()
    study, problem = re.findall(r"```python\n(.*?)```", text, flags=re.DOTALL)
    names = {}
    exec(study, names)
    top = names["model"].nodes[:, 2] > 0.0599
    np.testing.assert_allclose(names["positions"][top, 2], 0.06 * 1.104988, rtol=1e-5)
    assert names["model"].certificate["stability"]["statement"] == "all 13 solutions are stable"
    exec(problem, names)
    np.testing.assert_allclose(names["fields"]["displacement"][top, 2], 0.06 * 0.104988, rtol=1e-5)
    np.testing.assert_allclose(names["force"], [0.0, 0.0, -0.3e6 * 0.02**2], atol=1e-6)


def test_links_between_documents_lead_somewhere():
    for page in [*DOCS.glob("*.md"), DOCS.parent / "README.md", DOCS.parent / "CONTRIBUTING.md"]:
        for target in re.findall(r"\]\(([\w./-]+\.\w+)\)", page.read_text()):
            assert (page.parent / target).exists(), f"{page.name}: {target}"
