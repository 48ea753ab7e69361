"""A block pulled and pushed, small enough to be solved in a fraction of a second, as a study file."""

from __future__ import annotations

from pathlib import Path

STUDY = """
name = "block"
[mesh]
generator = "block"
size = ["20 mm", "20 mm", "60 mm"]
divisions = [1, 1, 3]
[materials.rubber]
law = "neo_hookean"
young = "young"
poisson = 0.3
[[supports]]
kind = "fixed"
on = "z_min"
[[loads]]
kind = "traction"
on = "z_max"
traction = ["push", "0 Pa", "pull"]
[parameters.pull]
range = ["0 kPa", "600 kPa"]
[parameters.push]
range = ["-30 kPa", "30 kPa"]
[parameters.young]
range = ["2 MPa", "4 MPa"]
[solver]
threads = 1
workers = 1
[sampling]
training = 24
held_out = 6
[reduction]
method = "pod"
max_degree = 2
"""


def write_study(folder: Path, *changes: tuple[str, str]) -> Path:
    """The study file in ``folder``, with texts of it replaced."""
    text = STUDY
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    path = folder / "study.toml"
    path.write_text(text)
    return path
