"""The paper's cantilever with a moving load, run as a user runs it."""

import json
import re
import subprocess
import sys

import cv2
import numpy as np
import pytest

from tests.support.real_data import ROOT

EXAMPLE = ROOT / "examples" / "cantilever_pgd"


@pytest.mark.slow
def test_pgd_of_the_cantilever_is_as_good_as_the_best_separation():
    done = subprocess.run([sys.executable, str(EXAMPLE / "run.py")], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-2000:]
    found = re.fullmatch(r"with_stiffness_modes=40 relative_error=([\d.e-]+)", done.stdout.splitlines()[-1])
    assert found
    assert float(found[1]) <= 1e-3
    results = json.loads((EXAMPLE / "output" / "results.json").read_text())
    assert results["modes"] == [1, 3, 5, 10, 20]
    np.testing.assert_allclose(results["energy"], results["best_energy"], rtol=0.02)
    np.testing.assert_allclose(results["l2"], results["best_l2"], rtol=0.02)
    np.testing.assert_allclose(results["dual"], results["energy"], rtol=0.01)
    for name in ("modes.png", "errors.png"):
        picture = cv2.imread(str(EXAMPLE / "output" / name))
        assert picture is not None
        assert picture.std() > 10.0  # something is drawn
