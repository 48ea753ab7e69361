"""Truth points against their own pixels: units, axes and pictures other than the camera's are named, right ones not."""

from dataclasses import replace

import numpy as np
import pytest

import morph_dslam as md
from morph_dslam.errors import EvaluationError
from morph_dslam.evaluation.points import PointTruth
from morph_dslam.evaluation.run_folder import load_run
from tests.support.run_folders import exact_truth, write_run

#: OpenGL's camera looks against its z axis, with y up.
OPENGL = np.array([1.0, -1.0, -1.0])


@pytest.fixture(scope="module")
def run_and_truth(tmp_path_factory):
    folder = tmp_path_factory.mktemp("run")
    arrays = exact_truth(write_run(folder))
    points = 1e-3 * arrays["points_mm"]
    hidden = np.zeros(points.shape[:2], dtype=bool)
    return load_run(folder), PointTruth(arrays["frame"], points, arrays["pixels"], hidden)


def turned(points, degrees):
    """Points (..., 3) of a sensor that is turned about the camera's y axis."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return points @ np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]]).T


@pytest.mark.parametrize(
    ("points", "pixels", "said"),
    [
        (lambda x: x / 10.0, None, r"points_mm in mm \(times 10\)"),
        (lambda x: x / 25.4, None, r"points_mm in mm \(times 25\.4\)"),
        (lambda x: x / 1000.0, None, r"points_mm in mm \(times 1000\)"),
        (lambda x: x * 10.0, None, r"points_mm in mm \(times 0\.1\)"),
        (
            lambda x: x * OPENGL,
            None,
            r"60 of 60 .* not in front of the camera .* fit them if y, z of points_mm are neg",
        ),
        (lambda x: x * OPENGL / 1000.0, None, "y, z of points_mm are negated"),
        (lambda x: x * [1.0, -1.0, 1.0], None, "y of points_mm is negated or if the pixels have v counted from below"),
        (lambda x: x * [-1.0, 1.0, 1.0], None, "x of points_mm is negated"),
        (lambda x: x - np.median(x, axis=(0, 1)), None, "points and pixels do not belong together"),
        (None, lambda p: p[..., ::-1], "the pixels have u and v exchanged"),
        (None, lambda p: (p - 0.5) / 2.0, "the pixels are those of a picture of half the size"),
        (None, lambda p: 2.0 * p, "the pixels are those of a picture of double the size"),
        (lambda x: turned(x, 60.0), None, "points and pixels do not belong together"),
    ],
)
def test_truth_that_cannot_be_right_is_refused_with_what_it_is(run_and_truth, points, pixels, said):
    run, truth = run_and_truth
    if points is not None:
        truth = replace(truth, points=points(truth.points))
    if pixels is not None:
        truth = replace(truth, pixels=pixels(truth.pixels))
    with pytest.raises(EvaluationError, match=said):
        md.evaluate(run, truth)


def test_a_right_truth_passes_without_a_note(run_and_truth):
    """Pixels 3 px off, a tenth of them anywhere, points 10 mm off along the sight line, hidden and missing ones."""
    run, truth = run_and_truth
    rng = np.random.default_rng(3)
    pixels = truth.pixels + rng.normal(scale=3.0, size=truth.pixels.shape)
    pixels[0, :6] = rng.uniform(0.0, 400.0, size=(6, 2))
    points, hidden = truth.points.copy(), truth.hidden.copy()
    points *= 1.0 + 0.010 / 0.62
    points[0, 6:9], hidden[0, 9:12] = np.nan, True
    figures = md.evaluate(run, PointTruth(truth.frames, points, pixels, hidden))
    assert figures["notes"] == []
    assert figures["mean_along_sight_mm"] == pytest.approx(10.0, abs=2.0)


def test_a_lens_and_an_error_of_the_run_are_no_error_of_the_truth(run_and_truth):
    """The pixels follow Brown's formula; the run is 100 mm too near, which only its error may show."""
    run, truth = run_and_truth
    camera = md.Camera(640, 480, 528.0, 528.0, 320.0, 240.0, distortion=(-0.2, 0.0, 0.0, 0.0))
    x, y = np.moveaxis(truth.points[..., :2] / truth.points[..., 2:], -1, 0)
    radial = 1.0 - 0.2 * (x**2 + y**2)
    poses = run.camera_from_object.copy()
    poses[:, 2, 3] -= 0.1
    pixels = np.stack([320.0 + 528.0 * x * radial, 240.0 + 528.0 * y * radial], axis=-1)
    near = replace(run, camera=camera, camera_from_object=poses)
    figures = md.evaluate(near, replace(truth, pixels=pixels))
    assert figures["notes"] == []
    assert figures["mean_along_sight_mm"] > 50.0


def test_a_sensor_that_is_not_aligned_is_compared_with_a_note(run_and_truth):
    """Turned by 3 degrees, 528 px tan(3 degrees) = 27.7 px in the middle; a few points name no axes either."""
    run, truth = run_and_truth
    off = replace(truth, points=turned(truth.points, 3.0))
    (note,) = md.evaluate(run, off)["notes"]
    said = float(note.split(" px (median)")[0].split()[-1])
    assert said == pytest.approx(528.0 * np.tan(np.radians(3.0)), rel=0.15)
    assert "not aligned" in note
    few = PointTruth(off.frames, off.points[:, :3], off.pixels[:, :3], off.hidden[:, :3])
    assert len(md.evaluate(run, few)["notes"]) == 1


def test_a_refusal_ends_with_status_2_and_one_line(tmp_path, refused):
    truth = exact_truth(write_run(tmp_path / "run"))
    np.savez(tmp_path / "truth.npz", **truth | {"points_mm": truth["points_mm"] * OPENGL})
    said = refused("evaluate", tmp_path / "run", "--points", tmp_path / "truth.npz")
    assert "y, z of points_mm are negated" in said
