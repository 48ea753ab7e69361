"""The example of a real desk: three landmarks give the cube in half of the maps, and the camera's path is right."""

import re
import subprocess
import sys

import pytest

from tests.support.real_data import ROOT, real_data


@pytest.mark.slow
def test_the_cube_is_found_on_the_desk():
    program = ROOT / "examples" / "desk_scene" / "run.py"
    command = [sys.executable, str(program), "--data", str(real_data("rbt_scene"))]
    last = subprocess.run(command, capture_output=True, text=True, check=True, cwd=ROOT).stdout.splitlines()[-1]
    figures = dict(re.findall(r"(\w+)=([\d.]+)", last))
    assert int(figures["found_hinted"][0]) >= 2
    assert float(figures["place_mm"]) <= 5.0
    assert float(figures["angle_deg"]) <= 3.0
    assert float(figures["path_mm"]) <= 6.5
