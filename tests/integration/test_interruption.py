"""Builds that are stopped or killed, each a process of its own, then finished: the same file, to the byte."""

from __future__ import annotations

import itertools
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from morph_dslam.cli.app import INTERRUPTED, main
from morph_dslam.studies.build import build
from morph_dslam.studies.executors import SerialExecutor
from morph_dslam.studies.snapshots import PARTIAL
from tests.support.block_study import write_study

N_SAMPLES = 30
KEPT = "the solutions found so far, if any, are kept, and the same command goes on from there"
#: Stopped while workers send results that are long in the pipe.
STOPPED_WHILE_SENDING = """
import time
from concurrent.futures import wait
from morph_dslam.studies.executors import default_executor

if __name__ == "__main__":
    with default_executor(2) as executor:
        wait([executor.submit(bytes, 1) for _ in range(2)])
        sent = [executor.submit(bytes, 100_000_000) for _ in range(20)]
        time.sleep(0.3)
        raise SystemExit(3)
"""


def start(study: Path, output: Path) -> subprocess.Popen:
    """A build on two worker processes, in a process group of its own."""
    command = [sys.executable, "-m", "morph_dslam", "build", str(study), "-o", str(output), "--workers", "2"]
    return subprocess.Popen(
        command,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        # a test run in the background of a shell ignores Ctrl-C, and its children would too
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    )


def solved(output: Path) -> list[Path]:
    return list(output.with_name(output.name + ".snapshots").glob("*.npz"))


def wait_until(ready, seconds: float = 120.0) -> None:
    until = time.monotonic() + seconds
    while not ready():
        assert time.monotonic() < until
        time.sleep(0.01)


def nothing_left(group: int) -> bool:
    """Whether all processes of a group have ended."""
    try:
        os.killpg(group, 0)
    except ProcessLookupError:
        return True
    return False


@pytest.fixture(scope="module")
def alone(tmp_path_factory) -> bytes:
    """The model file of a build that nothing disturbed, in one process."""
    folder = tmp_path_factory.mktemp("alone")
    build(write_study(folder), folder / "block.morph")
    return (folder / "block.morph").read_bytes()


@pytest.mark.usefixtures("interruptible")
def test_a_build_in_one_process_that_is_stopped_goes_on_from_there(alone, tmp_path, monkeypatch, capsys) -> None:
    study, output = write_study(tmp_path), tmp_path / "block.morph"
    submit, numbers = SerialExecutor.submit, itertools.count(1)

    def stopped(self, *task, **options):
        if next(numbers) == 4:
            signal.raise_signal(signal.SIGINT)
        return submit(self, *task, **options)

    monkeypatch.setattr(SerialExecutor, "submit", stopped)
    assert main(["build", str(study), "-o", str(output)]) == INTERRUPTED
    assert capsys.readouterr().err.splitlines()[-1] == f"morph: interrupted; {KEPT}"
    assert 3 <= len(solved(output)) < N_SAMPLES
    assert main(["build", str(study), "-o", str(output)]) == 0
    assert output.read_bytes() == alone


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_stopped_build_keeps_what_it_solved_and_says_so(number, alone: bytes, tmp_path: Path) -> None:
    """Ctrl-C reaches the whole group, SIGTERM of a batch system the main process alone."""
    study, output = write_study(tmp_path), tmp_path / "block.morph"
    process = start(study, output)
    wait_until(lambda: len(solved(output)) >= 3 or process.poll() is not None)
    (os.killpg if number == signal.SIGINT else os.kill)(process.pid, number)
    try:
        message = process.communicate(timeout=60)[1]
    finally:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
    assert process.returncode == INTERRUPTED
    assert "Traceback" not in message
    said = message.splitlines()[-1]
    assert said == f"morph: interrupted; {KEPT}"
    wait_until(lambda: nothing_left(process.pid))
    assert 3 <= len(solved(output)) < N_SAMPLES
    assert main(["build", str(study), "-o", str(output)]) == 0
    assert output.read_bytes() == alone


def test_workers_stopped_while_they_send_results_do_not_hold_up_the_end(tmp_path: Path) -> None:
    """What is half sent is never completed: nobody may wait for the rest."""
    script = tmp_path / "stopped.py"
    script.write_text(STOPPED_WHILE_SENDING)
    process = subprocess.Popen([sys.executable, str(script)], start_new_session=True)
    try:
        assert process.wait(timeout=60) == 3
        wait_until(lambda: nothing_left(process.pid))
    finally:
        if not nothing_left(process.pid):
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()


@pytest.mark.slow
def test_killed_ten_times_at_random_moments(alone: bytes, tmp_path: Path) -> None:
    """SIGKILL of the whole group or of the main process alone, whose workers must then end by themselves."""
    study, output = write_study(tmp_path), tmp_path / "block.morph"
    rng = np.random.default_rng(5)
    for count in np.sort(rng.integers(0, N_SAMPLES + 1, 10)):
        process = start(study, output)
        wait_until(lambda process=process, count=count: len(solved(output)) >= count or process.poll() is not None)
        time.sleep(rng.uniform(0.0, 2.0 if count in (0, N_SAMPLES) else 0.02))
        (os.killpg if rng.random() < 0.5 else os.kill)(process.pid, signal.SIGKILL)
        process.communicate()
        wait_until(lambda process=process: nothing_left(process.pid), 10.0)
    process = start(study, output)
    assert process.communicate()[1].count("damaged") == 0
    assert process.returncode == 0
    assert output.read_bytes() == alone
    assert len(solved(output)) == N_SAMPLES
    assert not list(tmp_path.rglob(f"*{PARTIAL}"))
