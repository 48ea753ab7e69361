"""The rubber specimens: their mesh, what finds the truth in the pictures, and the comparison on the real recording."""

import importlib
import re
import sys

import cv2
import numpy as np
import pytest

from morph_dslam.meshing.mesh_files import load_mesh
from tests.integration.test_examples import run_example
from tests.support.real_data import ROOT, real_data

sys.path.insert(0, str(ROOT / "examples" / "rubber_tension"))
baselines, measure, specimen = (importlib.import_module(name) for name in ("baselines", "measure", "specimen"))


def test_the_mesh_has_the_volume_of_the_drawing(tmp_path):
    specimen.write_mesh(tmp_path / "strip.inp", specimen.Shape(6.0))
    mesh = load_mesh(tmp_path / "strip.inp", "mm")
    corners = mesh.nodes[mesh.blocks[0].connectivity[:, :6]]
    sides = corners[:, 1:3, :2] - corners[:, :1, :2]
    area = 0.5 * np.abs(np.linalg.det(sides)).sum()
    # The strip without two slits, each with a triangle as its tip.
    expected = 48.0 * 24.0 - 2.0 * (0.5 * (6.0 - 0.54) + 0.5 * 0.5 * 0.54)
    assert area == pytest.approx(1e-6 * expected, rel=1e-9)
    assert np.ptp(mesh.nodes, axis=0) == pytest.approx([0.048, 0.024, 0.0025], rel=1e-9)
    assert {"left", "right"} <= set(mesh.node_sets)


def film(path, shifts, draw):
    """A video of drawings, shifted from frame to frame."""
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 10.0, (320, 240))
    for shift in shifts:
        writer.write(cv2.cvtColor(draw(shift), cv2.COLOR_GRAY2BGR))
    writer.release()


def test_discs_are_found_to_a_tenth_of_a_pixel(tmp_path):
    centres, shifts = np.array([[90.3, 80.6], [200.8, 150.2]]), [np.array([2.3 * k, -1.1 * k]) for k in range(5)]

    def draw(shift):
        rows, columns = np.mgrid[:240, :320].astype(float)
        image = np.full((240, 320), 70.0)
        for x, y in centres + shift:
            image += 100.0 / (1.0 + np.exp((np.hypot(columns - x, rows - y) - 22.0) / 2.0))
        return image.astype(np.uint8)

    film(tmp_path / "discs.avi", shifts, draw)
    found = measure.disc_tracks(tmp_path / "discs.avi", centres + 3.0, 4).pixels
    expected = centres + np.array(shifts)[:, None]
    assert np.abs(found - expected).max() < 0.1


def test_speckles_are_followed(tmp_path):
    speckle = np.random.default_rng(0).integers(20, 100, (300, 400)).astype(np.float32)
    speckle = cv2.GaussianBlur(speckle, (0, 0), 1.5)

    def draw(shift):
        matrix = np.array([[1.0, 0.0, shift[0] - 30.0], [0.0, 1.0, shift[1] - 30.0]])
        return cv2.warpAffine(speckle, matrix, (320, 240), borderMode=cv2.BORDER_REFLECT).astype(np.uint8)

    shifts = [np.array([1.7 * k, 0.6 * k]) for k in range(6)]
    film(tmp_path / "speckle.avi", shifts, draw)
    found = measure.speckle_tracks(tmp_path / "speckle.avi", 5).pixels
    moved = np.nanmedian(found - found[0], axis=1)
    assert moved == pytest.approx(np.array(shifts), abs=0.15)


def test_an_affine_motion_is_predicted_by_every_polynomial():
    rng = np.random.default_rng(1)
    seen, hidden = rng.random((60, 2)) * [400.0, 500.0], rng.random((9, 2)) * [400.0, 500.0] - [400.0, 0.0]

    def moved(points):
        return np.array([points, points @ [[1.2, 0.02], [-0.03, 0.9]] + [5.0, -2.0]])

    assert max(baselines.polynomial_errors(moved(seen), moved(hidden), 30.0).values()) < 1e-9


@pytest.mark.slow
def test_real_discs_are_predicted_where_they_are_and_where_they_are_hidden():
    done = run_example("rubber_tension", "--data", str(real_data("rubber_tension")))
    assert done.returncode == 0, done.stderr[-2000:]
    found = dict(re.findall(r"(\w+)=(-?[\d.]+)", done.stdout.splitlines()[-1]))
    assert float(found["mean_mm"]) <= 0.06
    assert float(found["hidden_mm"]) <= 0.10
    assert float(found["stroke_mm_per_frame"]) == pytest.approx(0.167, rel=0.015)
    assert float(found["stroke_std_mm"]) <= 0.03


@pytest.mark.slow
def test_a_real_crack_is_named_when_it_grows():
    done = run_example("rubber_tension", "--specimen", "notch_7.2mm", "--data", str(real_data("rubber_tension")))
    assert done.returncode == 0, done.stderr[-2000:]
    found = dict(re.findall(r"(\w+)=(-?[\d.]+)", done.stdout.splitlines()[-1]))
    # Seen by eye in the pictures, and the force falls after the last of these frames.
    assert 82 <= int(found["crack_frame"]) <= 98
    # Up to frame 80, in a pose in which the frames of the crack have no part.
    assert float(found["mean_mm"]) <= 0.032


@pytest.mark.slow
def test_the_law_of_one_specimen_predicts_the_force_of_another_from_its_video():
    done = run_example("rubber_tension", "--data", str(real_data("rubber_tension")), program="identify.py")
    assert done.returncode == 0, done.stderr[-2000:]
    found = dict(re.findall(r"(\w+)=([+-]?[\d.]+)", done.stdout.splitlines()[-1]))
    assert abs(float(found["largest_percent"])) <= 5.0
    assert int(found["frames"]) >= 80
