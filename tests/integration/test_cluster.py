"""A sweep on a Dask scheduler and its workers, on loopback: the same numbers, even if a worker is lost."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import nullcontext
from pathlib import Path

import pytest

from morph_dslam.cli.app import main
from morph_dslam.errors import WorkerError
from morph_dslam.studies import executors as cluster
from morph_dslam.studies.executors import default_executor
from morph_dslam.studies.sampling import training_samples
from morph_dslam.studies.snapshots import damage
from morph_dslam.studies.solid_study import SolidStudy
from morph_dslam.studies.study import load_study
from morph_dslam.studies.sweep import run_sweep
from tests.support.block_study import write_study

pytest.importorskip("distributed", reason="needs the extra 'dask'")


class Cluster:
    """A scheduler and two workers, each a process of its own, without anything that starts them again."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        scheduler = folder / "scheduler.json"
        self.processes = [
            self._start("dask_scheduler", "--host", "127.0.0.1", "--port", "0", "--scheduler-file", scheduler)
        ]
        self._wait(lambda: scheduler.is_file() and scheduler.read_text().endswith("}"))
        self.address = json.loads(scheduler.read_text())["address"]

    def add_workers(self) -> None:
        if len(self.processes) > 1:
            return
        for name in ("one", "two"):
            self.processes.append(
                self._start("dask_worker", self.address, "--name", name, "--nthreads", "1", "--no-nanny")
            )
        log = self.folder / "dask_scheduler.log"
        self._wait(lambda: log.read_text().count("Starting worker compute stream") == 2)

    def _start(self, program: str, *arguments: str | Path) -> subprocess.Popen:
        log = (self.folder / f"{program}.log").open("a")
        command = [sys.executable, "-m", f"distributed.cli.{program}", "--no-dashboard", *map(str, arguments)]
        with log:
            return subprocess.Popen(command, stdout=log, stderr=log, cwd=self.folder)

    def _wait(self, ready) -> None:
        until = time.monotonic() + 60.0
        while not ready():
            assert time.monotonic() < until, (self.folder / "dask_scheduler.log").read_text()
            time.sleep(0.1)

    def stop(self) -> None:
        for process in self.processes:
            process.kill()
            process.wait()


@pytest.fixture(scope="module")
def loopback(tmp_path_factory) -> Iterator[Cluster]:
    running = Cluster(tmp_path_factory.mktemp("cluster"))
    try:
        yield running
    finally:
        running.stop()


def kill_after(count: int, victim: subprocess.Popen, executor: cluster.ClusterExecutor, monkeypatch) -> list:
    """Kill a process when so many samples have been submitted; the list of all that were."""
    submitted: list = []
    submit = executor.submit

    def submit_and_kill(fn, /, *args, **kwargs):
        submitted.append(args)
        if len(submitted) == count:
            victim.kill()
            victim.wait()
        return submit(fn, *args, **kwargs)

    monkeypatch.setattr(executor, "submit", submit_and_kill)
    return submitted


def contents(result) -> list[bytes]:
    return [result.solved[sample].read_bytes() for sample in sorted(result.solved)]


def test_a_scheduler_without_workers_is_refused(loopback: Cluster) -> None:
    with (
        pytest.raises(WorkerError, match=r"has no workers: start some with `dask worker tcp://127"),
        cluster.cluster_executor(loopback.address),
    ):
        pass


def test_a_lost_worker_changes_nothing(loopback: Cluster, tmp_path: Path, monkeypatch) -> None:
    """One of two workers is killed after a few solutions; the files are those of one process, to the byte."""
    study = load_study(write_study(tmp_path))
    assert isinstance(study, SolidStudy)
    samples = training_samples(study)
    with default_executor(1) as executor:
        alone = run_sweep(study, samples, tmp_path / "alone", executor)
    loopback.add_workers()
    with cluster.cluster_executor(loopback.address) as executor:
        submitted = kill_after(6, loopback.processes[1], executor, monkeypatch)
        spread = run_sweep(study, samples, tmp_path / "spread", executor)
    assert len(submitted) == len(samples) == len(spread.solved)
    assert contents(spread) == contents(alone)


def test_a_lost_scheduler_is_one_message_and_what_was_solved_stays(
    loopback: Cluster, tmp_path: Path, monkeypatch
) -> None:
    study = load_study(write_study(tmp_path))
    assert isinstance(study, SolidStudy)
    loopback.add_workers()
    monkeypatch.setattr(cluster, "PATIENCE", 3.0)
    lost = pytest.raises(WorkerError, match=r"the connection to the scheduler at tcp://\S+ was lost\. What was")
    with lost, cluster.cluster_executor(loopback.address) as executor:
        kill_after(8, loopback.processes[0], executor, monkeypatch)
        run_sweep(study, training_samples(study), tmp_path / "spread", executor)
    kept = list((tmp_path / "spread").glob("*.npz"))
    assert 0 < len(kept) < 24
    assert not any(damage(path) for path in kept)


def test_workers_of_another_version_are_refused(monkeypatch) -> None:
    """What distributed reports of a worker whose numpy differs and that has no morph-dslam."""

    class Client:
        def nthreads(self):
            return {"tcp://127.0.0.1:9": 1}

        def get_versions(self, packages):
            here = dict.fromkeys(packages, "2.0")
            there = here | {"numpy": "1.26", "morph_dslam": None}
            host = {"python": "3.11.7.final.0"}
            return {
                "client": {"host": host, "packages": here},
                "workers": {"tcp://127.0.0.1:9": {"host": host, "packages": there}},
            }

    monkeypatch.setattr(cluster, "_connected", lambda kind, address: nullcontext(Client()))
    wrong = r"tcp://127.0.0.1:9 does not fit .*: morph_dslam missing \(here 2.0\), numpy 1.26 \(here 2.0\)"
    with pytest.raises(WorkerError, match=wrong), cluster.cluster_executor("tcp://127.0.0.1:8786"):
        pass


def test_no_scheduler_is_one_message(tmp_path: Path, monkeypatch, capsys) -> None:
    monkeypatch.setattr(cluster, "PATIENCE", 0.5)
    arguments = ["build", str(write_study(tmp_path)), "-o", str(tmp_path / "block.morph"), "--scheduler"]
    for address in ("tcp://127.0.0.1:1", "nonsense", "foo://127.0.0.1:1"):
        assert main([*arguments, address]) == 2
        message = capsys.readouterr().err
        assert message.startswith(f"morph: no Dask scheduler answers at {address} (")
        assert message.count("\n") == 1
