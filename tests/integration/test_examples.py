"""The examples, run as a user runs them."""

import re
import subprocess
import sys

import pytest

from tests.support.real_data import ROOT, real_data

RESULT = r"mean_mm=([\d.]+) median_mm=[\d.]+ p95_mm=[\d.]+ tracked=(\d+)/(\d+) .* rigid_mm=[\d.]+"


def run_example(name, *options, program="run.py"):
    program = ROOT / "examples" / name / program
    return subprocess.run([sys.executable, str(program), *options], capture_output=True, text=True)


def result_of(done):
    """Mean error (mm), frames tracked, frames, from the last line."""
    assert done.returncode == 0, done.stderr[-2000:]
    found = re.fullmatch(RESULT, done.stdout.splitlines()[-1])
    assert found
    return float(found[1]), int(found[2]), int(found[3])


@pytest.mark.slow
def test_the_demo_follows_its_truth_within_a_millimetre():
    mean, tracked, frames = result_of(run_example("demo"))
    assert tracked == frames == 150
    assert mean <= 1.0
    assert (ROOT / "demo" / "run" / "augmented.mp4").is_file()
    assert (ROOT / "demo" / "run" / "report.html").is_file()


@pytest.mark.slow
def test_the_real_sheet_is_followed_within_four_millimetres():
    mean, tracked, frames = result_of(run_example("kinect_paper", "--data", str(real_data("kinect_paper"))))
    assert tracked == frames == 92
    assert mean <= 4.0


def test_a_recording_that_is_not_there_is_one_message_before_the_model_is_built(tmp_path):
    done = run_example("kinect_paper", "--data", str(tmp_path / "absent"))
    assert done.returncode == 2
    assert re.fullmatch(r"morph: .*absent/rgb.*\n", done.stderr)
    assert done.stdout == ""


@pytest.mark.slow
def test_the_hanging_silicone_bar_is_where_its_depth_image_shows_it():
    done = run_example("diffcal_silicone", "--data", str(real_data("diffcal_silicone")))
    assert done.returncode == 0, done.stderr[-2000:]
    found = dict(re.findall(r"(\w+)=(-?[\d.]+)", done.stdout.splitlines()[-1]))
    assert float(found["published_mean_mm"]) <= 3.0
    assert float(found["fitted_mean_mm"]) <= 2.5


@pytest.mark.slow
def test_a_beam_fitted_to_its_own_weight_sinks_under_loads_as_measured():
    done = run_example("silicone_beam", "--data", str(real_data("silicone_beam")))
    assert done.returncode == 0, done.stderr[-2000:]
    found = dict(re.findall(r"(\w+)=(-?[\d.]+)", done.stdout.splitlines()[-1]))
    assert float(found["modulus_kPa"]) == pytest.approx(263.8, rel=0.15)  # published fit, of the motion
    assert abs(float(found["load52_percent"])) <= 10.0
    assert abs(float(found["load101_percent"])) <= 10.0


@pytest.mark.slow
def test_the_stiffness_that_pictures_tell_is_the_published_one_with_the_published_elements():
    data = str(real_data("diffcal_silicone"))
    done = run_example("diffcal_silicone", "--data", data, program="estimate.py")
    assert done.returncode == 0, done.stderr[-2000:]
    found = dict(re.findall(r"(\w+)=([\d.-]+)", done.stdout.splitlines()[-1]))
    low, high = (float(value) for value in found["interval_kPa"].split("-"))
    assert low < 50.1 < high
    assert float(found["shear_kPa"]) == pytest.approx(50.1, rel=0.25)
    assert float(found["converged_kPa"]) > 1.5 * float(found["shear_kPa"])
    assert float(found["surface_mean_mm"]) <= 2.5
