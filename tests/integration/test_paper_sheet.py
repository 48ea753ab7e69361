"""The example of the paper's sheet on a coarse mesh, run as a user runs it."""

from __future__ import annotations

import re
import subprocess
import sys

import pytest

from tests.support.real_data import ROOT

RESULT = r"positions=(\d+) largest_mm=([\d.]+) pcr_path_N=([\d.]+) pcr_eigen_N=([\d.]+) seconds=(\d+)"


@pytest.mark.slow
def test_the_papers_sheet_is_followed_to_its_full_height_and_not_solved_twice(tmp_path) -> None:
    program = ROOT / "examples" / "paper_sheet" / "run.py"
    options = ["--cells", "12", "6", "--positions", "81", "--output", str(tmp_path)]
    done = [
        subprocess.run([sys.executable, str(program), *options], capture_output=True, text=True) for _ in "12"
    ]
    assert done[0].returncode == 0, done[0].stderr[-2000:]
    first, second = (re.fullmatch(RESULT, run.stdout.splitlines()[-1]) for run in done)
    assert first
    assert second
    positions, largest, on_path, eigenvalue = (float(value) for value in first.groups()[:4])
    assert positions == 81
    assert largest == pytest.approx(169.0, abs=0.05)
    assert on_path == pytest.approx(eigenvalue, rel=5e-3)
    # Between the loads of a narrow strip and of a wide plate, 4 pi^2 E I / L^2 and that over 1 - nu12 nu21.
    strip = 4.0 * 3.141593**2 * 5e9 * 0.297 * 1e-12 / 12.0 / 0.42**2
    assert strip < eigenvalue < strip / (1.0 - 0.3**2 / 2.0)
    assert second.groups()[:4] == first.groups()[:4]
    assert int(second[5]) < int(first[5])
    for name in ("path.png", "southwell.png", "shapes.png"):
        assert (tmp_path / name).is_file()
