"""The sweep's tree, and its bookkeeping with a stand-in for the solver: order, failures, later passes, interruption."""

from __future__ import annotations

from concurrent.futures import Executor, Future, wait

import numpy as np
import pytest
from scipy.sparse.csgraph import minimum_spanning_tree
from scipy.spatial.distance import cdist

from morph_dslam.errors import StudyError
from morph_dslam.studies import sweep
from morph_dslam.studies.executors import SerialExecutor
from morph_dslam.studies.problem import Snapshot
from morph_dslam.studies.sample_task import SampleResult
from morph_dslam.studies.sheet_study import SheetStudy
from morph_dslam.studies.snapshots import encode_snapshot
from morph_dslam.studies.sweep import neighbour_tree

STUDY = SheetStudy.model_validate(
    {
        "name": "stand-in",
        "sheet": {"length": "200 mm", "width": "100 mm", "thickness": "0.2 mm"},
        "material": {"young_fibre": "3 GPa", "young_cross": "2 GPa", "poisson": 0.2, "shear": "1 GPa"},
        "grips": {"depth": "10 mm", "height": "50 mm"},
        "parameters": {
            "bulge": ["-20 mm", "20 mm"],
            "bend": [0.5, 1.5],
            "skew": ["-5 deg", "5 deg"],
            "slant": [-0.1, 0.1],
        },
    }
)


def row(bulges) -> np.ndarray:
    """Samples along the bulge only."""
    return np.column_stack([bulges, np.ones(len(bulges)), np.zeros((len(bulges), 2))])


def stand_in(monkeypatch, solvable):
    """Replace the solver by ``solvable(coordinates, start coordinates or None)``; records every attempt."""
    attempts: list[tuple[float, float | None]] = []

    def solve(study, fingerprint, coordinates, start):
        origin = None if start is None else float(start["bulge"])
        attempts.append((round(float(coordinates[0]), 6), origin))
        if not solvable(coordinates[0], origin):
            return SampleResult(None, "no equilibrium")
        return SampleResult(encode_snapshot(Snapshot(coordinates, {}), {"bulge": coordinates[0]}))

    monkeypatch.setattr(sweep, "solve_sample", solve)
    return attempts


def test_each_sample_starts_from_its_solved_neighbour(monkeypatch, tmp_path):
    attempts = stand_in(monkeypatch, lambda bulge, origin: True)
    result = sweep.run_sweep(STUDY, row([0.02, 0.012, 0.016, 0.008]), tmp_path, SerialExecutor())
    assert attempts == [(0.008, None), (0.012, 0.008), (0.016, 0.012), (0.02, 0.016)]
    assert len(result.solved) == 4
    assert not result.failed


def test_what_lies_behind_a_failure_is_reached_from_elsewhere(monkeypatch, tmp_path):
    """0.012 cannot be solved; what it would have led to is solved in the next pass from 0.008."""
    attempts = stand_in(monkeypatch, lambda bulge, origin: abs(bulge - 0.012) > 1e-9)
    result = sweep.run_sweep(STUDY, row([0.008, 0.012, 0.016, 0.02]), tmp_path, SerialExecutor())
    assert sorted(result.solved) == [0, 2, 3]
    assert result.failed == {1: "no equilibrium"}
    assert (0.016, None) in attempts or (0.016, 0.008) in attempts
    assert len(attempts) == len(set(attempts)), "no attempt is repeated"


def test_unreachable_samples_are_named(monkeypatch, tmp_path):
    stand_in(monkeypatch, lambda bulge, origin: bulge < 0.0125)
    result = sweep.run_sweep(STUDY, row([0.006, 0.008, 0.012, 0.016, 0.02]), tmp_path, SerialExecutor())
    assert sorted(result.solved) == [0, 1, 2]
    assert sorted(result.failed) == [3, 4]


def test_too_few_solved_is_an_error_that_names_the_first_failure(monkeypatch, tmp_path):
    stand_in(monkeypatch, lambda bulge, origin: bulge < 0.007)
    with pytest.raises(StudyError, match=r"only 1 of 4 samples .* no equilibrium\. .* kept in"):
        sweep.run_sweep(STUDY, row([0.006, 0.012, 0.016, 0.02]), tmp_path, SerialExecutor())
    assert len(list(tmp_path.glob("*.npz"))) == 1


def test_the_first_failure_is_said_before_anything_else_is_tried(monkeypatch, tmp_path, capsys):
    said: list[str] = []

    def solvable(bulge, origin):
        said.append(capsys.readouterr().err)
        return bulge < 0.007

    stand_in(monkeypatch, solvable)
    with pytest.raises(StudyError, match="only 1 of 4"):
        sweep.run_sweep(STUDY, row([0.006, 0.012, 0.016, 0.02]), tmp_path, SerialExecutor())
    said.append(capsys.readouterr().err)
    telling = [
        number for number, text in enumerate(said) if "not solved at the first attempt: no equilibrium. " in text
    ]
    assert telling == [2], "the second of all attempts fails, and no later failure is told"
    assert STUDY.advice in said[2]


def test_solved_samples_are_not_solved_again(monkeypatch, tmp_path):
    samples = row([0.008, 0.012, 0.016])
    stand_in(monkeypatch, lambda bulge, origin: True)
    sweep.run_sweep(STUDY, samples, tmp_path, SerialExecutor())
    attempts = stand_in(monkeypatch, lambda bulge, origin: True)
    result = sweep.run_sweep(STUDY, samples, tmp_path, SerialExecutor())
    assert attempts == []
    assert len(result.solved) == 3


def test_damaged_files_are_named_and_solved_again(monkeypatch, tmp_path, capsys):
    samples = row([0.008, 0.012, 0.016])
    stand_in(monkeypatch, lambda bulge, origin: True)
    first = sweep.run_sweep(STUDY, samples, tmp_path, SerialExecutor())
    contents = [first.solved[sample].read_bytes() for sample in range(3)]
    first.solved[1].write_bytes(contents[1][:-20])
    attempts = stand_in(monkeypatch, lambda bulge, origin: True)
    capsys.readouterr()
    again = sweep.run_sweep(STUDY, samples, tmp_path, SerialExecutor())
    assert f"{first.solved[1]} is damaged (" in capsys.readouterr().err
    assert attempts == [(0.012, 0.008)]
    assert [again.solved[sample].read_bytes() for sample in range(3)] == contents


def test_failed_attempts_are_not_repeated_by_the_next_build(monkeypatch, tmp_path):
    samples = row([0.008, 0.012, 0.016, 0.02])
    stand_in(monkeypatch, lambda bulge, origin: abs(bulge - 0.012) > 1e-9)
    first = sweep.run_sweep(STUDY, samples, tmp_path, SerialExecutor())
    attempts = stand_in(monkeypatch, lambda bulge, origin: True)
    again = sweep.run_sweep(STUDY, samples, tmp_path, SerialExecutor())
    assert attempts == []
    assert again == first
    assert again.failed == {1: "no equilibrium"}


def test_more_samples_keep_those_solved_and_fill_in_between(monkeypatch, tmp_path):
    """A caller adds samples: only they are solved, each from its nearest neighbour, old or new."""
    stand_in(monkeypatch, lambda bulge, origin: True)
    sweep.run_sweep(STUDY, row([0.008, 0.016]), tmp_path, SerialExecutor())
    attempts = stand_in(monkeypatch, lambda bulge, origin: True)
    result = sweep.run_sweep(STUDY, row([0.008, 0.016, 0.013, 0.014]), tmp_path, SerialExecutor())
    assert attempts == [(0.013, 0.008), (0.014, 0.013)] or attempts == [(0.014, 0.016), (0.013, 0.014)]
    assert sorted(result.solved) == [0, 1, 2, 3]


def test_an_interruption_keeps_what_has_come_back(monkeypatch, tmp_path):
    """Ctrl-C while three samples are on their way, one of which has just been solved."""
    stand_in(monkeypatch, lambda bulge, origin: True)

    def wait_forever(*args, **kwargs):
        raise KeyboardInterrupt

    class Waiting(Executor):
        slots = 3

        def __init__(self):
            self.pending = []

        def submit(self, fn, /, *args, **kwargs):
            future: Future = Future()
            if not self.pending:
                future.set_result(fn(*args, **kwargs))
            self.pending.append(future)
            return future

    monkeypatch.setattr(sweep, "wait", wait_forever)
    with pytest.raises(KeyboardInterrupt):
        sweep.run_sweep(STUDY, row([0.004, 0.0061, 0.0062]), tmp_path, Waiting())
    assert len(list(tmp_path.glob("*.npz"))) == 1


def test_two_builds_in_one_folder_are_refused(monkeypatch, tmp_path):
    samples = row([0.008, 0.012])
    inner: list[str] = []

    def solve_meanwhile(bulge, origin):
        with pytest.raises(StudyError, match=r"another build is solving in") as caught:
            sweep.run_sweep(STUDY, samples, tmp_path, SerialExecutor())
        inner.append(str(caught.value))
        return True

    stand_in(monkeypatch, solve_meanwhile)
    assert len(sweep.run_sweep(STUDY, samples, tmp_path, SerialExecutor()).solved) == 2
    assert len(inner) == 2


def test_no_more_is_on_its_way_than_the_executor_takes(monkeypatch, tmp_path):
    """Starts are held in memory only for samples that are submitted."""
    stand_in(monkeypatch, lambda bulge, origin: True)

    class Counting(Executor):
        slots, running, most = 4, 0, 0

        def submit(self, fn, /, *args, **kwargs):
            self.running += 1
            self.most = max(self.most, self.running)
            future: Future = Future()
            future.set_result(fn(*args, **kwargs))
            return future

    executor = Counting()

    def wait_for_all(running, return_when):
        executor.running -= len(running)
        return wait(running)

    monkeypatch.setattr(sweep, "wait", wait_for_all)
    star = STUDY.root() + np.outer(np.linspace(1.0, 1.01, 40), [0.0, 0.0, 1e-2, 0.0])
    star[1::2, 2] *= -1.0
    star[2::4, 3] = 1e-3
    result = sweep.run_sweep(STUDY, star, tmp_path, executor)
    assert len(result.solved) == 40
    assert 1 <= executor.most <= 4


def test_progress_counts_what_is_solved_now_for_the_time_left(monkeypatch, tmp_path, capsys):
    """Samples found on disk are there from the start and say nothing of the rate."""
    samples = row(np.linspace(0.006, 0.02, 12))
    stand_in(monkeypatch, lambda bulge, origin: True)
    sweep.run_sweep(STUDY, samples[:8], tmp_path, SerialExecutor())
    seen: list[tuple[int, int]] = []
    make = sweep.tqdm

    def recorded(*args, **kwargs):
        seen.append((kwargs["initial"], kwargs["total"]))
        return make(*args, **kwargs)

    monkeypatch.setattr(sweep, "tqdm", recorded)
    sweep.run_sweep(STUDY, samples, tmp_path, SerialExecutor())
    assert seen == [(8, 12)]
    assert "12/12" in capsys.readouterr().err


def grid(*axes: np.ndarray) -> np.ndarray:
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(axes))


def path_to_root(sample: int, parent: list[int]) -> list[int]:
    path = [sample]
    while parent[path[-1]] >= 0:
        path.append(parent[path[-1]])
    return path


@pytest.mark.parametrize(
    ("axes", "root"),
    [
        ((np.linspace(0.0, 6e5, 7), np.linspace(2e6, 4e6, 7)), (0.0, 3e6)),
        ((np.linspace(-0.3, 0.3, 7), np.linspace(0.1, 0.7, 7)), (0.0, 0.4)),
        ((np.linspace(-1.0, 1.0, 5),) * 3, (0.0, 0.5, -1.0)),
        ((np.linspace(0.0, 1.0, 9), np.linspace(0.0, 1.0, 3), np.linspace(-2.0, 2.0, 5)), (0.0, 0.5, 0.0)),
    ],
)
def test_paths_on_a_grid_lead_outwards(axes, root) -> None:
    """Along every path, no parameter ever comes nearer to its default again, and one changes at a time."""
    samples, scale = grid(*axes), np.array([np.ptp(axis) for axis in axes])
    order, parent = neighbour_tree(samples, scale, np.array(root))
    assert sorted(order) == list(range(len(samples)))
    away = np.abs(samples - root) / scale
    for sample in order:
        if parent[sample] >= 0:
            change = away[sample] - away[parent[sample]]
            assert np.count_nonzero(np.abs(change) > 1e-9) == 1
            assert change.min() > -1e-9
            steps = path_to_root(sample, parent)
            assert len(steps) == len(set(steps))


def test_scattered_samples_are_joined_by_a_shortest_tree() -> None:
    """Its length equals that of scipy's minimum spanning tree; all parents come before their children."""
    samples = np.random.default_rng(2).uniform(size=(150, 4)) * [1.0, 2.0, 3.0, 1e-3]
    scale, root = np.array([1.0, 2.0, 3.0, 1e-3]), np.zeros(4)
    order, parent = neighbour_tree(samples, scale, root)
    points = np.vstack([samples, root]) / scale
    length = sum(np.linalg.norm(points[s] - points[parent[s]]) for s in order)
    assert length == pytest.approx(minimum_spanning_tree(cdist(points, points)).sum(), rel=1e-12)
    rank = {sample: number for number, sample in enumerate(order)} | {-1: -1}
    assert all(rank[parent[sample]] < rank[sample] for sample in order)


def test_nothing_starts_from_failed_samples_and_solved_ones_are_not_ordered() -> None:
    samples = np.arange(1.0, 7.0)[:, None]
    order, parent = neighbour_tree(samples, np.ones(1), np.zeros(1), solved=[0, 1], failed=[2])
    assert order == [2, 3, 4, 5]
    assert [parent[s] for s in order] == [1, 1, 3, 4]
