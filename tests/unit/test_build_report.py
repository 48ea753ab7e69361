"""The report of a build: complete, self-contained, the same every time, and robust against its own plots."""

from __future__ import annotations

import base64
import re
from dataclasses import replace
from xml.etree import ElementTree

import cv2
import numpy as np
import pytest

from morph_dslam.errors import StudyError
from morph_dslam.reduction import report as build_report
from morph_dslam.reduction.report import report_path, write_build_report
from morph_dslam.reduction.report_pictures import half_way_out, plot_convergence, read_reference_curve
from morph_dslam.render.model_view import draw_shapes
from morph_dslam.render.shading import colour_table
from tests.support.certified_block import certified_block_model
from tests.support.stretched_block import PARAMETERS

pytestmark = pytest.mark.usefixtures("drawn_figures")


@pytest.fixture(scope="module")
def model():
    return certified_block_model()


@pytest.fixture(scope="module")
def page(model, tmp_path_factory, blank_figures):
    path = tmp_path_factory.mktemp("report") / "block.report.html"
    with blank_figures():
        write_build_report(path, model)
    assert list(path.parent.iterdir()) == [path]
    return path.read_text()


def pictures(page):
    """Media type and content of every image of a page."""
    sources = re.findall(r'<img src="([^"]*)"', page)
    assert all(source.startswith("data:image/") for source in sources)
    found = [re.fullmatch(r"data:(image/[\w+]+);base64,(.*)", source) for source in sources]
    return [(match[1], base64.b64decode(match[2])) for match in found if match]


def test_a_report_is_one_complete_file(page, model, tmp_path):
    headings = re.findall("<h2>(.*?)</h2>", page)
    assert headings[:5] == [
        "In short",
        "Error against number of modes",
        "Errors over the parameter box",
        "Modes in space",
        "Functions of the parameters",
    ]
    assert headings[-2:] == ["Samples that failed", "Study"]
    assert {"Parameters", "Fields", "Stability", "Made with"} < set(headings)
    assert not re.search(r"https?://|<script|<link|warning", page.split("</style>")[1])
    assert "no equilibrium &lt;found&gt;" in page
    assert "<b>0.99 %</b><span>reduction error of von Mises stress</span>" in page
    write_build_report(tmp_path / "again.html", model)
    assert (tmp_path / "again.html").read_text() == page


def test_its_pictures_can_be_read(page):
    found = pictures(page)
    assert sorted(kind for kind, _ in found) == ["image/png", *["image/svg+xml"] * 3]
    for kind, content in found:
        if kind == "image/png":
            image = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_COLOR)
            assert image is not None
            assert image.std() > 10.0, "something is drawn"
        else:
            assert ElementTree.fromstring(content).tag.endswith("svg")


def test_plots_that_fail_are_replaced_by_why(tmp_path, model, monkeypatch):
    """Without a certificate there are no errors to plot; modes and functions stay."""

    def fail(model):
        raise ValueError("no <colours> left")

    monkeypatch.setattr(build_report, "draw_modes", fail)
    write_build_report(tmp_path / "x.html", replace(model, certificate={}, stresses={}, strain=None, provenance={}))
    page = (tmp_path / "x.html").read_text()
    assert "ValueError: no &lt;colours&gt; left" in page
    assert len(pictures(page)) == 1


def test_where_a_report_stands(tmp_path, model):
    assert report_path(tmp_path / "seal.morph") == tmp_path / "seal.report.html"
    assert report_path(tmp_path / "seal.v2") == tmp_path / "seal.v2.report.html"
    (tmp_path / "x.html").mkdir()
    with pytest.raises(StudyError, match="report"):
        write_build_report(tmp_path / "x.html", replace(model, certificate={}))


def test_a_reference_curve_is_drawn_with_its_name(tmp_path, model):
    (tmp_path / "paper.csv").write_text("modes,the paper\n1,9.884\n2,3.1217\n\n")
    curve = read_reference_curve(tmp_path / "paper.csv")
    assert curve.label == "the paper"
    assert curve.modes.tolist() == [1.0, 2.0]
    assert curve.mean_mm.tolist() == [9.884, 3.1217]
    assert b"<!-- the paper -->" in plot_convergence(model, curve).data
    assert b"<!-- the paper -->" not in plot_convergence(model, None).data


@pytest.mark.parametrize(
    "text", ["", "modes,a\n", "modes,a\n1,x\n", "modes,a\n1\n", "modes,a\n1,-2\n", "modes\n1,2\n", "modes,a\n1,nan\n"]
)
def test_what_is_no_reference_curve_is_refused(tmp_path, text):
    (tmp_path / "curve.csv").write_text(text)
    with pytest.raises(StudyError, match=r"curve\.csv"):
        read_reference_curve(tmp_path / "curve.csv")
    with pytest.raises(StudyError, match="there is no reference curve"):
        read_reference_curve(tmp_path / "other.csv")


def test_other_parameters_are_half_way_out(model):
    """A default off the middle points to the other end."""
    assert half_way_out(model) == pytest.approx([0.1, 0.005])
    shifted = replace(model, parameters=(replace(PARAMETERS[0], default=0.15), PARAMETERS[1]))
    assert half_way_out(shifted) == pytest.approx([-0.025, 0.005])


def test_shapes_fill_their_pictures_in_the_colours_of_their_values():
    """A square of 1 m seen along y takes 92 % of the picture's height, in the middle."""
    square = np.array([[0, 0, 0], [1, 0, 0], [1, 0, 1], [0, 0, 1]], dtype=float)
    triangles = np.array([[0, 1, 2], [0, 2, 3]])
    low, high = draw_shapes(
        triangles, [square, square], [np.zeros(4), np.ones(4)], (0.0, 1.0), np.array([0.0, 1.0, 0.0]), (200, 100)
    )
    for image, colour in ((low, colour_table("turbo")[0]), (high, colour_table("turbo")[255])):
        assert image.shape == (100, 200, 3)
        drawn = np.argwhere(image.min(axis=2) < 250)
        assert np.ptp(drawn, axis=0) + 1 == pytest.approx([92, 92], abs=1.5)
        assert drawn.mean(axis=0) == pytest.approx([49.5, 99.5], abs=0.6)
        # The light comes from (-0.4, -0.6, -1) in the camera's frame, the surface faces (0, 0, -1).
        brightness = 0.4 + 0.6 / np.sqrt(1.52)
        assert image[50, 100] == pytest.approx(brightness * colour, abs=1.0)
