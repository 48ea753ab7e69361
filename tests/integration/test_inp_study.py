"""A study of an Abaqus input file."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from morph_dslam import load_study

BAR = """*NODE
{nodes}
*ELEMENT, TYPE=C3D8, ELSET=soft
1, 1, 2, 3, 4, 5, 6, 7, 8
*ELEMENT, TYPE=C3D8, ELSET=stiff
2, 5, 6, 7, 8, 9, 10, 11, 12
*NSET, NSET=floor
1, 2, 3, 4
*NSET, NSET=lid
9, 10, 11, 12
"""
SQUARE = ((0, 0), (10, 0), (10, 10), (0, 10))
NODES = [f"{4 * k + i + 1}, {x}, {y}, {10 * k}" for k in range(3) for i, (x, y) in enumerate(SQUARE)]
BAR = BAR.format(nodes="\n".join(NODES))
STUDY = """
name = "bar"
[mesh]
file = "bar.inp"
unit = "mm"
[materials.gel]
law = "st_venant_kirchhoff"
young = "1 MPa"
poisson = 0.0
on = "soft"
[materials.putty]
law = "st_venant_kirchhoff"
young = "3 MPa"
poisson = 0.0
on = "stiff"
[[supports]]
kind = "fixed"
on = "floor"
[[supports]]
kind = "displacement"
on = "lid"
x = "0 mm"
y = "0 mm"
z = "pull"
[parameters.pull]
range = ["0 mm", "4 mm"]
[solver]
threads = 1
[sampling]
scheme = "even"
training = 8
held_out = 4
[reduction]
max_degree = 6
tolerance = 1e-8
"""


def written(folder: Path, bar: str = BAR) -> Path:
    (folder / "bar.inp").write_text(bar)
    (folder / "study.toml").write_text(STUDY)
    return folder / "study.toml"


def test_a_mesh_file_that_was_written_again_is_read_again(tmp_path: Path) -> None:
    """In one process too, in a notebook say."""
    longer = BAR.replace(", 20\n", ", 30\n")
    heights = [load_study(written(tmp_path, bar)).model_mesh().nodes[:, 2].max() for bar in (BAR, longer)]
    np.testing.assert_allclose(heights, [0.02, 0.03])
