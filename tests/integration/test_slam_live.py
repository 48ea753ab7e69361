"""Mapping beside the frames, and live cameras."""

import json
import os
import sys
import threading
import time

import cv2
import numpy as np
import pytest

from morph_dslam.cli.app import main
from morph_dslam.geometry import fit_similarity
from morph_dslam.io.trajectory import load_trajectory
from morph_dslam.slam.mapping import MappingWork, do_all
from morph_dslam.slam.output import trajectory_of
from morph_dslam.slam.slam import Slam
from tests.support.rendered_room import CAMERA

N_FRAMES = 80


def steps(log, job=lambda: "done"):
    log.append("begun")
    log.append(job())
    yield
    log.append("ended")


def test_work_in_step_is_done_one_step_at_a_time():
    work, log = MappingWork(threaded=False), []
    work.begin(steps(log))
    assert log == ["begun", "done"]
    assert not work.is_idle
    work.advance()
    assert log == ["begun", "done", "ended"]
    assert work.is_idle
    do_all(steps(log))
    assert log[3:] == ["begun", "done", "ended"]


def test_nobody_waits_for_a_step_in_the_thread():
    """The step ends only after `advance` has returned: with any waiting this would hang."""
    log, may_end = [], threading.Event()
    work = MappingWork(True, lambda: log.append("before"), lambda: log.append("after"))

    def job():
        assert may_end.wait(timeout=30.0)
        return threading.current_thread().name

    work.begin(steps(log, job))
    for _ in range(3):
        work.advance()
    assert "after" not in log
    assert "ended" not in log
    may_end.set()
    work.finish()
    assert log[:2] == ["before", "begun"]
    assert log[2].startswith("mapper")
    assert log[3:] == ["after", "before", "ended", "after"]
    assert work.is_idle


@pytest.mark.skipif(sys.platform != "linux", reason="threads have priorities of their own on Linux only")
def test_frames_go_before_work_in_the_thread():
    log, own = [], os.getpriority(os.PRIO_PROCESS, 0)
    work = MappingWork(threaded=True)
    work.begin(steps(log, lambda: os.getpriority(os.PRIO_PROCESS, 0)))
    work.finish()
    assert log[1] == min(own + 5, 19)
    assert os.getpriority(os.PRIO_PROCESS, 0) == own


def test_what_goes_wrong_in_the_thread_is_told():
    def fails():
        raise ValueError("a step that fails")

    work = MappingWork(threaded=True)
    work.begin(steps([], fails))
    with pytest.raises(ValueError, match="a step that fails"):
        work.finish()


def test_dropped_work_is_not_taken_over():
    log, may_end = [], threading.Event()
    work = MappingWork(True, after=lambda: log.append("after"))
    work.begin(steps(log, lambda: may_end.wait(timeout=30.0)))
    work.drop()
    assert work.is_idle
    may_end.set()
    work.finish()
    assert "after" not in log
    assert "ended" not in log


def test_a_map_made_beside_the_frames_is_as_good(room_film):
    images, truth = room_film
    slam = Slam(CAMERA, threaded=True)
    frames = []
    for index, image in enumerate(images):
        frames.append(slam.process_frame(image, index, index / 30.0))
        # The pace of a camera: without it the whole film would be over before the mapper had its turn.
        time.sleep(0.01)
    slam.refine_map()
    status = [frame.status for frame in frames]
    start = status.index("tracked")
    assert start <= 30
    assert set(status[start:]) == {"tracked"}
    assert sum(frame.is_keyframe for frame in frames) >= 4
    expected = np.array([truth[f.index][:3, 3] for f in frames if f.pose is not None])
    estimate = trajectory_of(slam, frames).positions
    transform = fit_similarity(estimate, expected)
    errors = np.linalg.norm(transform.apply(estimate) - expected, axis=1)
    length = np.linalg.norm(np.diff(expected, axis=0), axis=1).sum()
    assert np.median(errors) < 0.005 * length
    points = transform.apply(slam.map.positions[slam.map.good])
    assert len(points) > 300
    # The room's walls are at x = -2 and 2, z = 4, the floor at y = 1.3; nothing is behind them.
    outside = np.maximum.reduce([np.abs(points[:, 0]) - 2.0, points[:, 2] - 4.0, points[:, 1] - 1.3])
    assert np.quantile(outside, 0.98) < 0.06


class FilmCapture:
    """What `cv2.VideoCapture` offers, from images; each waits until the frame before was worked on."""

    def __init__(self, images):
        self.images, self.delivered, self.next = images, 0, threading.Semaphore(1)

    def isOpened(self):
        return True

    def read(self):
        if not self.next.acquire(timeout=60.0) or self.delivered == len(self.images):
            return False, None
        self.delivered += 1
        return True, cv2.cvtColor(self.images[self.delivered - 1], cv2.COLOR_GRAY2BGR)

    def get(self, propId):
        return 30.0

    def release(self):
        pass


@pytest.mark.parametrize("ends", ["by itself", "by an interrupt"])
def test_a_webcam_is_tracked_until_it_ends(tmp_path, room_film, monkeypatch, capsys, ends):
    capture, process = FilmCapture(room_film[0][:40]), Slam.process_frame

    def released(slam, image, index, *rest):
        if index == 30 and ends == "by an interrupt":
            raise KeyboardInterrupt
        assert slam._threaded
        result = process(slam, image, index, *rest)
        capture.next.release()
        return result

    monkeypatch.setattr(cv2, "VideoCapture", lambda device: capture)
    monkeypatch.setattr(Slam, "process_frame", released)
    camera = f"width: 640\nheight: 480\nfx: {CAMERA.fx}\nfy: {CAMERA.fy}\ncx: {CAMERA.cx}\ncy: {CAMERA.cy}\n"
    (tmp_path / "camera.yaml").write_text(camera)
    run = tmp_path / "run"
    code = main(["slam", "webcam:0", "--camera", str(tmp_path / "camera.yaml"), "-o", str(run), "--no-video"])
    assert code == (2 if ends == "by itself" else 130)
    assert ("stopped delivering after frame 39" in capsys.readouterr().err) == (ends == "by itself")
    summary = json.loads((run / "summary.json").read_text())
    assert summary["n_frames"] == (40 if ends == "by itself" else 30)
    assert summary["n_dropped"] == 0
    assert summary["longest_wait_for_mapper_ms"] >= summary["p99_wait_for_mapper_ms"] > 0.0
    assert len(load_trajectory(run / "trajectory.txt")) == summary["n_tracked"] > 5
    assert (run / "map.h5").exists()
