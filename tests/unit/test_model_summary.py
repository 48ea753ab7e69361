"""What is said of a model file: every figure with its unit, old files as far as they go; reports as pages."""

import base64
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest

from morph_dslam.cli import app as cli
from morph_dslam.evaluation.model_summary import (
    describe_point,
    error_table,
    field_title,
    flatten,
    sensitivity_table,
    summarise_model,
)
from morph_dslam.evaluation.report import Link, Picture, Section, Table, Text, write_report
from morph_dslam.model import Parameter, save_model
from morph_dslam.model.basis_functions import chebyshev_basis
from morph_dslam.model.tensor_functions import CPFunctions
from tests.support.bent_sheet import bent_sheet_model
from tests.support.stretched_block import stretched_block_model

ABSOLUTE = {"mean": 1.0, "max": 4.0, "worst_sample_mean": 2.0, "largest": 50.0}
RELATIVE = {"relative_l2": 0.0123, "mean_relative_to_largest": 0.02}


def errors(ending):
    return {name + ending: value for name, value in ABSOLUTE.items()} | RELATIVE


CERTIFICATE = {
    "reduction": {"modes": 9, "singular_values": [3.0, 2.0], "cross_validation": {"2": 0.1}},
    "displacement": errors("_mm") | {"worst_sample": [0.2, -0.01], "n_held_out": 59, "confidence": "surely"},
    "held_out": {"coordinates": [[0.2, -0.01]], "mean_mm": [2.0], "max_mm": [4.0]},
    "stress_solid": errors("_MPa") | {"von_mises": errors("_MPa") | {"relative_l2": None}},
    "strain": errors(""),
    "reaction_force_top": errors("_N"),
    "reaction_moment_top": errors("_Nmm"),
    "sensitivity": {"stretch": RELATIVE, "slide": {"relative_l2": 0.5, "mean_relative_to_largest": None}},
    "estimator": {"mean_effectivity": 1.02, "min_effectivity": 0.97, "max_effectivity": 1.31},
    "compression_percent": 97.123,
    "samples": {
        "rounds": [{"solves": 32, "largest_estimate": 0.02}, {"solves": 64, "largest_estimate": 4e-4}],
        "training": 64,
        "held_out": 59,
        "failed": [{"coordinates": [0.0, 0.0], "reason": "no"}],
    },
    "stability": {
        "statement": "1 of 4 solutions are unstable",
        "stable": 3,
        "unstable": 1,
        "unknown": 0,
        "unstable_samples": [],
        "passed": [{"between": ["slide = 1 mm", "slide = 2 mm"], "negative_pivots": [0, 1]}],
    },
}
PROVENANCE = {"study": "name = 'x'\n" * 40, "mesh_sha256": "ab12", "versions": {"numpy": "2.4.6"}}


def test_every_field_has_a_row_in_its_unit():
    rows = {row[0]: row[1:] for row in error_table(CERTIFICATE).rows}
    relative = ["2.00e-02", "1.23e-02"]
    assert rows["displacement"] == ["1.00", "4.00", "2.00", "50.0", "mm", *relative]
    assert rows["Cauchy stress"] == ["1.00", "4.00", "2.00", "50.0", "MPa", *relative]
    assert rows["von Mises stress"][-2:] == ["2.00e-02", "–"]
    assert rows["strain"][:5] == ["1.00", "4.00", "2.00", "50.0", "–"]
    assert rows["force on top"][4] == "N"
    assert rows["moment on top"][4] == "N mm"
    assert len(rows) == 6


@pytest.mark.parametrize(
    ("value", "text"), [(1287.4, "1287"), (999.4, "999"), (0.00499703, "0.00500"), (1.4657e-05, "1.47e-05")]
)
def test_errors_have_three_digits(value, text):
    assert error_table({"reaction_moment_top": {"mean_Nmm": value}}).rows[0][1] == text


def test_sensitivities_have_both_measures():
    assert sensitivity_table(CERTIFICATE).rows == [["stretch", "2.00e-02", "1.23e-02"], ["slide", "–", "5.00e-01"]]


def test_the_faces_of_a_sheet_have_a_von_mises_stress_each():
    certificate = {f"stress_{face}": errors("_MPa") | {"von_mises": errors("_MPa")} for face in ("top", "bottom")}
    assert [row[0] for row in error_table(certificate).rows] == [
        "stress, top face",
        "von Mises stress, top face",
        "stress, bottom face",
        "von Mises stress, bottom face",
    ]


def test_info_prints_the_whole_certificate(tmp_path, capsys):
    model = replace(stretched_block_model(), certificate=CERTIFICATE, provenance=PROVENANCE)
    save_model(tmp_path / "block.morph", model)
    assert cli.main(["info", str(tmp_path / "block.morph")]) == 0
    printed = capsys.readouterr().out
    words = " ".join(printed.split())
    for fact in (
        "nodes 12",
        "triangles 20",
        "hex8 cells 2",
        "extent 80 x 40 x 40 mm",
        "stretch -0.2 to 0.2, default 0; strain along x",
        "slide -10 to 10 mm, default 0; motion of the top along x",
        "Cauchy stress 2 polynomials",
        "confidence surely",
        "worst solve stretch = 0.2, slide = -10 mm: mean error 2 mm",
        "compression of the displacement 97.12 %",
        "training samples 64",
        "failed samples 1 entry",
        "adaptive round 2 64 solves, largest estimated error 0.0004",
        "mean effectivity 1.02",
        "statement 1 of 4 solutions are unstable",
        "change of stability 1 between slide = 1 mm and slide = 2 mm",
        "mesh sha256 ab12",
        "numpy 2.4.6",
    ):
        assert fact in words
    assert "singular" not in printed
    assert "name = 'x'" not in printed
    assert max(len(line) for line in printed.splitlines()) < 140


def test_fields_state_their_format_and_numbers_stored():
    """CP of 2 modes at 12 nodes: 72 numbers in space, 3 + 3 coefficients for 2 terms each, none to mix."""
    model = stretched_block_model()
    bases = tuple(chebyshev_basis(p.lower, p.upper, 2) for p in model.parameters)
    functions = CPFunctions(bases, (np.ones((3, 2)), np.ones((3, 2))), np.eye(2))
    displacement = replace(model.displacement, functions=functions)
    table = summarise_model(replace(model, displacement=displacement))["fields"]
    assert table.rows[0] == ["displacement", "2", "CP", str(12 * 3 * 2 + 12)]


def test_a_model_without_certificate_has_no_empty_headings():
    headings = set(summarise_model(bent_sheet_model(3, 3)))
    assert headings == {"mesh", "parameters", "fields"}


def test_points_are_described_in_the_units_of_reports():
    lever = Parameter("lever", "angle", "deg", 0.0, 1.0, 0.0)
    share = Parameter("share", "ratio", "1", 0.0, 1.0, 0.0)
    assert describe_point([lever, share], [np.pi / 6, 0.25]) == "lever = 30 deg, share = 0.25"


@pytest.mark.parametrize(
    ("name", "title"), [("reaction_moment_rim_top", "moment on rim_top"), ("stress_bottom", "stress, bottom face")]
)
def test_field_names_in_words(name, title):
    assert field_title(name) == title


def test_tables_are_aligned_as_text():
    table = Table([["a", "bcd"], ["efg", ""]], ("h", "i"))
    assert table.text() == ["h    i", "a    bcd", "efg"]


def test_linear_solver_of_external_solutions_is_said_not_to_be_ours(tmp_path):
    model = replace(stretched_block_model(), provenance={"linear_solver": None, "versions": {}})
    assert ("linear solver", "that of another program") in summarise_model(model)["made with"].rows


class Reader(HTMLParser):
    """Collects cells, headings and picture sources, and checks that tags are closed in order."""

    def __init__(self):
        super().__init__()
        self.open, self.texts, self.sources = [], {}, []

    def handle_starttag(self, tag, attributes):
        if tag == "img":
            self.sources.append(dict(attributes)["src"])
        elif tag != "meta":
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open and data.strip():
            self.texts.setdefault(self.open[-1], []).append(data)


def test_a_report_holds_its_sections_and_pictures(tmp_path):
    picture = b"\x89PNG not really"
    (tmp_path / "plot.png").write_bytes(picture)
    sections = [
        Section("Figures & <facts>", [Table.of({"a < b": "1.0 mm"}), Text("Careful!", warning=True)]),
        Section("Pictures", [Picture.read(tmp_path / "plot.png", "A plot"), Link("video.mp4", "The video")]),
        Section("Nothing here", []),
        Section("Wide", [Table([["1", "2", "3"]], ("x", "y", "z"))]),
    ]
    write_report(tmp_path / "report.html", "A $5 title", sections)
    reader = Reader()
    reader.feed((tmp_path / "report.html").read_text())
    assert reader.open == []
    assert reader.texts["h1"] == ["A $5 title"]
    assert reader.texts["h2"] == ["Figures & <facts>", "Pictures", "Wide"]
    assert reader.texts["td"] == ["a < b", "1.0 mm", "1", "2", "3"]
    assert reader.texts["th"] == ["x", "y", "z"]
    assert [base64.b64decode(source.split(",")[1]) for source in reader.sources] == [picture]


def test_certificates_are_flattened_with_their_units():
    facts = flatten(
        {
            "displacement": {"mean_mm": 0.0123456, "n_held_out": 40},
            "compression_percent": 99.5,
            "orders": [1.5, 2],
            "failed": [],
            "notes": [{"a": 1}, {"a": 2}],
            "study": "line one\nline two",
        }
    )
    assert facts == {
        "displacement: mean": "0.01235 mm",
        "displacement: n held out": "40",
        "compression": "99.5 %",
        "orders": "1.5, 2",
        "failed": "none",
        "notes": "2 entries",
    }
