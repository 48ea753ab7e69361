"""Parts of study files: a block that is solved in a fraction of a second, one bent at its end, supports."""

from __future__ import annotations

from pathlib import Path
from typing import Any

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
refined = 0
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


def bent_block(size: list[str], divisions: list[int], poisson: float, bend: str, squash: str) -> dict[str, Any]:
    """A study of a block of rubber along z, its end turned about y by up to ``bend`` and pushed in."""
    top = {"kind": "rotation", "on": "z_max", "axis": [0, 1, 0], "angle": "bend"}
    return {
        "name": "rubber block",
        "mesh": {"generator": "block", "size": size, "divisions": divisions, "cells": "hex8"},
        "materials": {"rubber": {"law": "neo_hookean", "young": "3 MPa", "poisson": poisson}},
        "supports": [{"kind": "fixed", "on": "z_min"}, top | {"translation": ["0 mm", "0 mm", "-1 * squash"]}],
        "parameters": {"bend": {"range": [f"-{bend}", bend]}, "squash": {"range": ["0 mm", squash]}},
        "solver": {"threads": 1},
    }


def sliding(*held: tuple[str, str]) -> str:
    """Supports that hold one component of a face each, pairs of a face and the axis."""
    return "".join(f'[[supports]]\nkind = "displacement"\non = "{on}"\n{axis} = "0 mm"\n' for on, axis in held)
