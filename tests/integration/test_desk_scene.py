"""The example of a real desk: by measured depth the cube is found in all maps, and the camera's path is right."""

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
    for kind in ("plain", "hinted"):
        assert figures[f"measured_found_{kind}"] == "4"
    assert figures["measured_wrong"] == "0"
    assert float(figures["measured_place_mm"]) <= 4.0
    assert float(figures["angle_deg"]) <= 3.0
    assert float(figures["path_mm"]) <= 6.5
