"""The benchmarks of reduction on small problems, run as a user runs them."""

from __future__ import annotations

import importlib
import re
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import cv2
import numpy as np
import pytest

from tests.support.real_data import ROOT

BENCHMARKS = ROOT / "benchmarks"


def figures(name: str, *options: str) -> dict[str, float]:
    """The figures in the last line that a benchmark prints."""
    command = [sys.executable, str(BENCHMARKS / f"{name}.py"), *options]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-2000:]
    return {key: float(value) for key, value in re.findall(r"(\w+)=(\S+)", done.stdout.splitlines()[-1])}


@pytest.mark.slow
def test_a_coarse_boot_seal_is_as_near_with_twelve_modes_as_is_asked_of_the_fine_one(tmp_path: Path) -> None:
    found = figures(
        "reduction_boot_seal", "--divisions", "20", "1", "10", "--positions", "40", "--output", str(tmp_path)
    )
    assert found["positions"] == 40
    assert found["held_out"] == 20
    assert found["modes"] <= 12
    assert found["mean_mm"] <= 0.02
    assert found["von_mises_error"] <= 0.02
    nodes = 21 * 2 * 10
    numbers = found["modes"] * 3 * nodes  # of the modes; the functions have no more than 25 numbers each
    for positions, name in ((40, "compression_percent"), (397, "compression_of_397_percent")):
        most = 100.0 * (1.0 - numbers / (positions * 3 * nodes))
        assert most - 100.0 * 25.0 * found["modes"] / (positions * 3 * nodes) <= found[name] + 0.005
        assert found[name] <= most + 0.005
    picture = cv2.imread(str(tmp_path / "error_by_modes.png"))
    assert picture is not None
    assert picture.std() > 10.0  # something is drawn


@pytest.mark.slow
def test_one_parameter_of_the_bar_needs_eight_solves(tmp_path: Path) -> None:
    found = figures(
        "reduction_growth",
        *("--parameters", "1", "--training", "8", "--held-out", "4", "--methods", "pod"),
        *("--workers", "1", "--output", str(tmp_path)),
    )
    assert list(found) == ["pod_1"]
    assert 1e-8 < found["pod_1"] <= 1e-3


@pytest.fixture
def growth(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """The benchmark as a module."""
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    return importlib.import_module("reduction_growth")


def test_parameters_that_are_not_freed_stand_at_their_defaults(growth: ModuleType) -> None:
    two, six = growth.study_of(2, 24, 59), growth.study_of(6, 300, 59)
    assert [p.name for p in two.model_parameters()] == ["line", "place"]
    assert [p.name for p in six.model_parameters()] == [
        *("line", "place", "tip_young", "across", "middle_young", "pull")
    ]
    residuals = []
    for study in (two, six):
        problem = study.problem()
        assert problem.n_dofs == 3435
        default = np.array([p.default for p in study.model_parameters()])
        residuals.append(problem.residual(np.linspace(0.0, 1e-3, 3435), default))
    np.testing.assert_allclose(residuals[0], residuals[1], rtol=1e-12)


@pytest.mark.slow
def test_a_small_strip_creeps_as_its_solutions_do(tmp_path: Path) -> None:
    found = figures(
        "reduction_creep",
        *("--points", "16", "5", "--held-out", "8", "--divisions", "1", "1", "3"),
        *("--workers", "1", "--output", str(tmp_path)),
    )
    assert found["relative_error"] <= 0.01
    assert found["von_mises_error"] <= 0.02
    assert cv2.imread(str(tmp_path / "creep.png")) is not None
