"""The benchmark of long recordings, on short ones."""

import importlib.util
import re
import sys
from pathlib import Path

import numpy as np
import pytest

from morph_dslam.slam.slam import Slam
from tests.support.rendered_room import CAMERA

BENCHMARK = Path(__file__).parents[2] / "benchmarks" / "slam_long.py"


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


def test_records_of_frames_are_small_and_say_the_same(room_film):
    slam = Slam(CAMERA)
    frames = [slam.process_frame(image, i, i / 30.0) for i, image in enumerate(room_film[0][:60])]
    records = [frame.record(is_final=False) for frame in frames]
    slam.refine_map()
    for frame, record in zip(frames, records, strict=True):
        before, after = slam.camera_from_world(frame), slam.camera_from_world(record)
        assert (before is None) == (after is None)
        assert before is None or np.array_equal(before, after)
        counts = len(frame.points.ids), len(frame.candidates), len(frame.disagreeing.ids)
        assert (record.n_points, record.n_candidates, record.n_disagreeing) == counts
        assert not len(record.candidates)
    last = frames[-1].record(is_final=True)
    assert not len(last.points.ids)
    assert last.n_points > 100
