"""The benchmark of long recordings, on short ones."""

import importlib.util
import re
import sys

import pytest

from tests.support.real_data import ROOT
from tests.support.rendered_room import CAMERA

BENCHMARK = ROOT / "benchmarks" / "slam_long.py"


@pytest.fixture(scope="module")
def benchmark():
    spec = importlib.util.spec_from_file_location("slam_long", BENCHMARK)
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    yield module
    del sys.modules[spec.name]


def test_noise_is_waited_out_with_a_reason(benchmark):
    assert benchmark.noise(60).startswith("noise_frames=60 noise_status=waiting:60 noise_mb=")


def test_a_video_seen_forth_and_back_is_tracked_throughout(benchmark, room_film):
    line = benchmark.video(room_film[0], CAMERA, 0.1)
    figures = dict(part.split("=") for part in line.split())
    start = int(figures["start"])
    assert start <= 30
    assert figures["tracked"] == f"{180 - start}/{180 - start}"
    # 80 frames of 640x480.
    assert float(figures["peak_mb"]) > float(figures["film_mb"]) == 25
    assert re.fullmatch(r"\d+\.\d/\d+\.\d", figures["localising_cpu_ms"])
