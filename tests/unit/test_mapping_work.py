"""The mapper's work, step by step in the frames' thread or beside it."""

import os
import sys
import threading

import pytest

from morph_dslam.slam.mapping import MappingWork


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


def test_errors_in_the_thread_are_raised_and_dropped_work_is_not_taken_over():
    def fails():
        raise ValueError("a step that fails")

    work = MappingWork(threaded=True)
    work.begin(steps([], fails))
    with pytest.raises(ValueError, match="a step that fails"):
        work.finish()
    log, may_end = [], threading.Event()
    work = MappingWork(True, after=lambda: log.append("after"))
    work.begin(steps(log, lambda: may_end.wait(timeout=30.0)))
    work.drop()
    assert work.is_idle
    may_end.set()
    work.wait()
    work.finish()
    assert "after" not in log
    assert "ended" not in log
