"""The example of a viscous elastomer: half of the tension tests predict the other half, and it reports missing ones."""

import re
import subprocess
import sys

import pytest

from tests.support.real_data import ROOT, real_data

EXAMPLE = ROOT / "examples" / "vhb_viscoelastic"


def run_example(data):
    return subprocess.run(
        [sys.executable, str(EXAMPLE / "run.py"), "--data", str(data)], capture_output=True, text=True
    )


@pytest.mark.slow
def test_half_of_the_measurements_predict_the_other_half():
    done = run_example(real_data("fem_reference") / "vhb4910")
    assert done.returncode == 0, done.stderr[-2000:]
    result = r"fit_error_percent=([\d.]+) predicted_error_percent=([\d.]+)"
    found = re.fullmatch(result, done.stdout.splitlines()[-1])
    assert found
    assert float(found[1]) <= 4.0
    assert float(found[2]) <= 5.5


@pytest.mark.slow
def test_measurements_that_are_not_there_are_one_message(tmp_path):
    done = run_example(tmp_path / "absent")
    assert done.returncode == 2
    assert re.fullmatch(r"morph: there are no measurements in .*; --data names .*\n", done.stderr)
    assert done.stdout == ""
