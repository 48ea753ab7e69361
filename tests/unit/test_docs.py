"""The programs in the documentation do what it says."""

import re
from dataclasses import replace

import h5py
import numpy as np
import pytest

from morph_dslam.model import SeparatedField, load_model, save_model
from morph_dslam.model.basis_functions import chebyshev_basis
from morph_dslam.model.tensor_functions import TuckerFunctions
from morph_dslam.studies.rigid import build_rigid
from tests.support.bent_sheet import bent_sheet_model
from tests.support.documents import PROJECT, code_words, commands, options, samples
from tests.support.function_formats import FORMATS, OTHERS, SMOOTH
from tests.support.small_models import block_model

PAGES = [
    *(PROJECT / "docs").rglob("*.md"),
    *(PROJECT / f"{name}.md" for name in ("README", "CONTRIBUTING", "CHANGELOG")),
]


def documented_readers():
    """The programs that read model files without the library: the short one, and the one for all formats."""
    readers = []
    for program in samples("model-file", "python"):
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
        scale = np.abs(model.displacement.modes).max() * np.abs(model.displacement.functions.rows(mu)[0]).sum()
        np.testing.assert_allclose(found, model.displacement.value(mu), rtol=0.0, atol=1e-7 * scale)


def test_the_model_file_can_be_read_with_the_documented_program(tmp_path, reader):
    path, mu = tmp_path / "sheet.morph", np.array([0.025, -0.3, 0.2])
    model = bent_sheet_model(9, 7)
    save_model(path, model)
    positions = reader["deformed_positions"](path, mu)
    np.testing.assert_allclose(positions, model.positions(mu), atol=1e-8)
    np.testing.assert_allclose(positions, load_model(path).positions(mu), atol=1e-12)


def test_the_programs_read_a_rigid_object(tmp_path):
    """It has no parameters, and is where it was."""
    corners, faces = ("0 0 0", "20 0 0", "0 20 0", "0 0 20"), ("1 3 2", "1 2 4", "1 4 3", "2 3 4")
    lines = [*(f"v {corner}" for corner in corners), *(f"f {face}" for face in faces)]
    (tmp_path / "block.obj").write_text("\n".join(lines) + "\n")
    model = build_rigid(tmp_path / "block.obj", "mm", tmp_path / "block.morph")
    for program in documented_readers():
        with h5py.File(tmp_path / "block.morph") as file:
            np.testing.assert_array_equal(program["field"](file, "displacement", []), np.zeros((len(model.nodes), 3)))


@pytest.mark.parametrize(("number", "bases"), [(0, SMOOTH), (1, OTHERS)])
def test_the_programs_refuse_functions_that_they_do_not_know(tmp_path, number, bases):
    """They would take them for others, and be millimetres off without a word."""
    save_model(tmp_path / "block.morph", block_model("tucker", bases))
    with h5py.File(tmp_path / "block.morph") as file, pytest.raises(AssertionError):
        documented_readers()[number]["field"](file, "displacement", [0.3, 0.7, 1.9])


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
    study, problem, _ = samples("solid-study", "python")
    names = {}
    exec(study, names)
    top = names["model"].nodes[:, 2] > 0.0599
    np.testing.assert_allclose(names["positions"][top, 2], 0.06 * 1.104988, rtol=1e-5)
    assert names["model"].certificate["stability"]["statement"] == "all 13 solutions are stable"
    exec(problem, names)
    np.testing.assert_allclose(names["fields"]["displacement"][top, 2], 0.06 * 0.104988, rtol=1e-5)
    np.testing.assert_allclose(names["force"], [0.0, 0.0, -0.3e6 * 0.02**2], atol=1e-6)
    check_that_the_certificate_is_documented(names["model"])


def check_that_the_certificate_is_documented(model):
    """Its keys, and those of its entries; endings with units are `_*` in the page."""
    entries = model.certificate.values()
    keys = {*model.certificate, *(key for entry in entries if isinstance(entry, dict) for key in entry)}
    keys -= {*model.fields, *(parameter.name for parameter in model.parameters)}
    named = code_words("certificate")
    assert len(keys) > 30
    assert {key for key in keys if not {key, re.sub(r"(_N|_Nmm|_mm|_MPa)?$", "_", key, count=1)} & named} == set()


def anchor(heading: str) -> str:
    """The name under which a page's heading is linked to."""
    return re.sub(r"[^\w\- ]", "", heading.strip().lower()).replace(" ", "-")


def test_links_of_pages_outside_the_site_lead_somewhere():
    """Those within the site are checked by `make docs`."""
    for page in PAGES[-3:]:
        for name, fragment in re.findall(r"\]\(([\w./-]*)(?:#([\w-]+))?\)", page.read_text()):
            target = page.parent / name if name else page
            assert target.exists(), f"{page.name}: {name}"
            if fragment:
                headings = re.findall(r"^#+ (.*)$", target.read_text(), flags=re.MULTILINE)
                assert fragment in map(anchor, headings), f"{page.name}: {name}#{fragment}"


def test_links_of_pages_lead_to_files_of_the_project():
    """They are read beside the source too; the reference, and copies of pages outside, are made with the site alone."""
    n_links = 0
    for page in (PROJECT / "docs").rglob("*.md"):
        for name in re.findall(r"\]\(([\w./-]+\.\w+)(?:#[\w-]+)?\)", page.read_text()):
            if not re.match(r"(\.\./)*(reference/|changelog|contributing)", name):
                assert (page.parent / name).exists(), f"{page.name}: {name}"
                n_links += 1
    assert n_links > 300


def test_commands_in_documents_have_these_options():
    """What the pages tell to type after `morph` is known to the command line; a # begins a remark."""
    known, n_options = {name: options(parser) for name, parser in commands().items()}, 0
    for page in PAGES:
        text = re.sub(r"\\\n\s*", " ", page.read_text())
        for name, rest in re.findall(r"(?:^|`)morph ([a-z]+)\b([^`\n#]*)", text, flags=re.MULTILINE):
            used = set(re.findall(r"(?<![\w-])--[a-z][\w-]*", rest))
            assert used <= known[name], f"{page.name}: morph {name} {used - known[name]}"
            n_options += len(used)
    assert n_options > 30


def test_programs_and_files_in_documents_exist():
    n_files = 0
    for page in PAGES:
        for name in re.findall(r"(?<![\w/.])(?:examples|benchmarks|tests|docs)/[\w/-]+\.\w+", page.read_text()):
            if "output/" not in name and "/NAME/" not in name:
                assert (PROJECT / name).exists(), f"{page.name}: {name}"
                n_files += 1
    assert n_files > 50


def test_pages_that_messages_and_programs_name_exist():
    named = set()
    for folder in ("src", "examples", "benchmarks"):
        for path in (PROJECT / folder).rglob("*.py"):
            named |= set(re.findall(r"\bdocs/[\w-]+\.md", path.read_text()))
    assert len(named) > 5
    assert {name for name in named if not (PROJECT / name).exists()} == set()


def test_targets_of_make_exist():
    targets = set(re.findall(r"^([a-z-]+):", (PROJECT / "Makefile").read_text(), flags=re.MULTILINE))
    named = {t for page in PAGES for t in re.findall(r"(?:^|`)make ([a-z-]+)", page.read_text(), re.MULTILINE)}
    assert {"demo", "test", "test-all"} <= named
    assert named <= targets
