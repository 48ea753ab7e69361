"""What is said of a mesh whose flat cells stand for the round sides of a STEP solid."""

import re
from math import pi

import netgen.occ as occ
import pytest

from morph_dslam.cli import app as cli
from morph_dslam.meshing.mesh_files import load_mesh
from tests.support.meshes import cell_volumes


def notes_of(path, capsys, size):
    assert cli.main(["info", str(path), "--size", str(size)]) == 0
    return [line for line in capsys.readouterr().out.splitlines() if line.startswith("note: ")]


@pytest.mark.slow
def test_a_round_step_solid_is_said_to_lose_volume_and_stiffness(tmp_path, capsys):
    path = tmp_path / "rod.step"
    occ.Cylinder((0, 0, 0), occ.X, r=6, h=80).WriteStep(str(path))
    (note,) = notes_of(path, capsys, 5)
    missing, softer = re.search(r"is (\S+) % smaller .*bends (\S+) % too easily.*: take a smaller size", note).groups()
    part = cell_volumes(load_mesh(path, "mm", 0.005)).sum() / (pi * 0.006**2 * 0.08)
    assert float(missing) == pytest.approx(100.0 * (1.0 - part), abs=0.05)
    # Of a round section, I = A^2 / (4 pi).
    assert float(softer) == pytest.approx(100.0 * (1.0 - part**2), abs=0.05)


def test_a_round_hole_is_said_to_be_filled_in_part(tmp_path, capsys):
    path = tmp_path / "pipe.step"
    (occ.Box((0, 0, 0), (20, 20, 20)) - occ.Cylinder((10, 10, 0), occ.Z, r=9, h=20)).WriteStep(str(path))
    (note,) = notes_of(path, capsys, 8)
    added = float(re.search(r"is (\S+) % larger .*too little", note).group(1))
    part = cell_volumes(load_mesh(path, "mm", 0.008)).sum() / (20e-9 * (400.0 - pi * 81.0))
    assert added == pytest.approx(100.0 * (part - 1.0), rel=0.05)


@pytest.mark.slow
def test_flat_sides_and_small_holes_are_not_spoken_of(tmp_path, capsys):
    box = occ.Box((0, 0, 0), (40, 20, 10))
    for name, solid in (("box", box), ("drilled", box - occ.Cylinder((20, 10, 0), occ.Z, r=0.7, h=10))):
        solid.WriteStep(str(tmp_path / f"{name}.step"))
        assert notes_of(tmp_path / f"{name}.step", capsys, 8) == []
