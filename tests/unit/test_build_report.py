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
from morph_dslam.evaluation.report import Picture
from morph_dslam.reduction import report as build_report
from morph_dslam.reduction.report import report_path, write_build_report
from morph_dslam.reduction.report_pictures import (
    ReferenceCurve,
    half_way_out,
    plot_convergence,
    read_reference_curve,
    states_to_show,
)
from morph_dslam.render.model_view import draw_shapes
from morph_dslam.render.shading import colour_table
from tests.support.certified_block import certified_block_model
from tests.support.stretched_block import PARAMETERS


@pytest.fixture(scope="module")
def model():
    return certified_block_model()


@pytest.fixture(scope="module")
def page(model, tmp_path_factory):
    path = tmp_path_factory.mktemp("report") / "block.report.html"
    write_build_report(path, model)
    assert list(path.parent.iterdir()) == [path]
    return path.read_text()


@pytest.fixture
def no_plots(monkeypatch):
    """Puts one byte in the place of every picture."""
    for name in ("draw_model_states", "draw_modes", "plot_convergence", "plot_error_maps"):
        monkeypatch.setattr(build_report, name, lambda *_: Picture(b"x", ".png", ""))
    for name in ("plot_errors_by_parameter", "plot_parameter_functions"):
        monkeypatch.setattr(build_report, name, lambda *_: Picture(b"x", ".png", ""))


def pictures(page):
    """Media type and content of every image of a page."""
    sources = re.findall(r'<img src="([^"]*)"', page)
    assert all(source.startswith("data:image/") for source in sources)
    found = [re.fullmatch(r"data:(image/[\w+]+);base64,(.*)", source) for source in sources]
    return [(match[1], base64.b64decode(match[2])) for match in found if match]


def test_a_report_is_one_complete_file(page):
    assert re.findall("<h2>(.*?)</h2>", page) == [
        "In short", "Parameters", "States", "Errors on held-out solves",
        "Errors of the displacement&#x27;s sensitivities", "Error against number of modes",
        "Errors over the parameter box", "Modes in space", "Functions of the parameters", "Stability",
        "Samples that failed", "Fields", "Memory and samples", "Reduction", "Made with", "Study",
    ]  # fmt: skip
    assert "warning" not in page.split("</style>")[1]
    assert not re.search(r"https?://|<script|<link", page.split("</style>")[1])
    for fact in (
        "<td>stretch = 0.1, slide = -4 mm</td><td>no equilibrium &lt;found&gt;</td>",
        "<td>slide</td><td>-10</td><td>10</td><td>0</td><td>mm</td>",
        "<b>0.99 %</b><span>error of sensitivities</span>",
        "<b>0.99 %</b><span>von Mises stress error</span>",
        "All 20 solutions are stable.",
        "<pre>name = &#x27;block&#x27; # &lt;0.45&gt;</pre>",
    ):
        assert fact in page


def test_its_pictures_can_be_read(page):
    found = pictures(page)
    assert [kind for kind, _ in found] == ["image/png", *["image/svg+xml"] * 3, "image/png", "image/svg+xml"]
    for kind, content in found:
        if kind == "image/png":
            image = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_COLOR)
            assert image is not None
            assert image.std() > 10.0, "something is drawn"
        else:
            assert ElementTree.fromstring(content).tag.endswith("svg")


def test_the_same_model_has_the_same_report(tmp_path, model, page):
    write_build_report(tmp_path / "again.html", model)
    assert (tmp_path / "again.html").read_text() == page


def test_a_plot_that_fails_is_replaced_by_why(tmp_path, model, no_plots, monkeypatch):
    def fail(model):
        raise ValueError("no <colours> left")

    monkeypatch.setattr(build_report, "draw_modes", fail)
    write_build_report(tmp_path / "x.html", model)
    page = (tmp_path / "x.html").read_text()
    assert '<p class="warning">This part could not be made: ValueError: no &lt;colours&gt; left</p>' in page
    assert len(pictures(page)) == 5
    assert "<h2>Made with</h2>" in page


def test_a_model_without_certificate_or_stress_still_has_a_page(tmp_path, model):
    bare = replace(model, certificate={}, stresses={}, strain=None, provenance={})
    write_build_report(tmp_path / "x.html", bare)
    page = (tmp_path / "x.html").read_text()
    assert "This part could not be made" in page
    assert len(pictures(page)) == 3, "states, modes, functions"


def test_a_page_that_cannot_be_written_is_one_message(tmp_path, model, no_plots):
    (tmp_path / "x.html").mkdir()
    with pytest.raises(StudyError, match="the model is complete, but its report cannot be written"):
        write_build_report(tmp_path / "x.html", model)


def test_the_report_stands_beside_its_model(tmp_path):
    assert report_path(tmp_path / "seal.morph") == tmp_path / "seal.report.html"
    assert report_path(tmp_path / "seal.v2") == tmp_path / "seal.v2.report.html"


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


def test_states_that_are_shown(model):
    """Half way out are stretch 0.1 and slide 5 mm; a default off the middle points to the other end."""
    assert half_way_out(model) == pytest.approx([0.1, 0.005])
    states, captions = states_to_show(model)
    assert captions == ["default", "stretch = 0.2", "slide = 10 mm"]
    np.testing.assert_allclose(states, [[0.0, 0.0], [0.2, 0.005], [0.1, 0.01]])
    shifted = replace(model, parameters=(replace(PARAMETERS[0], default=0.15), PARAMETERS[1]))
    assert half_way_out(shifted) == pytest.approx([-0.025, 0.005])


def test_a_reference_may_have_any_number_of_modes(model):
    curve = ReferenceCurve("longer", np.arange(1.0, 30.0), np.geomspace(1.0, 0.1, 29))
    assert b"<!-- longer -->" in plot_convergence(model, curve).data


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
