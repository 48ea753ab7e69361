"""The sweep's bookkeeping with a stand-in for the solver: order, failures, later passes, interruption."""

from __future__ import annotations

from concurrent.futures import Executor, Future

import numpy as np
import pytest

from morph_dslam.errors import StudyError
from morph_dslam.offline import sweep
from morph_dslam.offline.problem import Snapshot
from morph_dslam.offline.sample_task import SampleResult
from morph_dslam.offline.snapshots import encode_snapshot
from morph_dslam.offline.studies.sheet_study import SheetStudy

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


class AtOnce(Executor):
    """Runs every task when it is submitted."""

    def submit(self, fn, /, *args, **kwargs):
        future: Future = Future()
        future.set_result(fn(*args, **kwargs))
        return future


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
    result = sweep.run_sweep(STUDY, row([0.02, 0.012, 0.016, 0.008]), tmp_path, AtOnce())
    assert attempts == [(0.008, None), (0.012, 0.008), (0.016, 0.012), (0.02, 0.016)]
    assert len(result.solved) == 4
    assert not result.failed


def test_what_lies_behind_a_failure_is_reached_from_elsewhere(monkeypatch, tmp_path):
    """0.012 cannot be solved; what it would have led to is solved in the next pass from 0.008."""
    attempts = stand_in(monkeypatch, lambda bulge, origin: abs(bulge - 0.012) > 1e-9)
    result = sweep.run_sweep(STUDY, row([0.008, 0.012, 0.016, 0.02]), tmp_path, AtOnce())
    assert sorted(result.solved) == [0, 2, 3]
    assert result.failed == {1: "no equilibrium"}
    assert (0.016, None) in attempts or (0.016, 0.008) in attempts
    assert len(attempts) == len(set(attempts)), "no attempt is repeated"


def test_unreachable_samples_are_named(monkeypatch, tmp_path):
    stand_in(monkeypatch, lambda bulge, origin: bulge < 0.0125)
    result = sweep.run_sweep(STUDY, row([0.006, 0.008, 0.012, 0.016, 0.02]), tmp_path, AtOnce())
    assert sorted(result.solved) == [0, 1, 2]
    assert sorted(result.failed) == [3, 4]


def test_too_few_solved_is_an_error_that_names_the_first_failure(monkeypatch, tmp_path):
    stand_in(monkeypatch, lambda bulge, origin: bulge < 0.007)
    with pytest.raises(StudyError, match=r"only 1 of 4 samples .* no equilibrium\. .* kept in"):
        sweep.run_sweep(STUDY, row([0.006, 0.012, 0.016, 0.02]), tmp_path, AtOnce())
    assert len(list(tmp_path.glob("*.npz"))) == 1


def test_solved_samples_are_not_solved_again(monkeypatch, tmp_path):
    samples = row([0.008, 0.012, 0.016])
    stand_in(monkeypatch, lambda bulge, origin: True)
    sweep.run_sweep(STUDY, samples, tmp_path, AtOnce())
    attempts = stand_in(monkeypatch, lambda bulge, origin: True)
    result = sweep.run_sweep(STUDY, samples, tmp_path, AtOnce())
    assert attempts == []
    assert len(result.solved) == 3
