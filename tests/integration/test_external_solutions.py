"""Solutions of another program: a series of files and a table of parameters become a model."""

from __future__ import annotations

import re

import meshio
import numpy as np
import pytest

from morph_dslam.cli import app as cli
from morph_dslam.meshing.generators import block
from morph_dslam.model import load_model

STUDY = """
name = "cantilever, solved elsewhere"
[external]
table = "runs/table.csv"
length_unit = "mm"
displacement = "U"
stress = "S"
stress_unit = "MPa"
strain = "E"
[reduction]
max_degree = 4
tolerance = 1e-8
"""
#: Stress in VTK's order xx, yy, zz, xy, yz, xz and in this program's xx, yy, zz, yz, xz, xy.
VTK_STRESS = np.array([1.0, 2.0, 3.0, 4.0, 5.0, 6.0])
OUR_STRESS = np.array([1.0, 2.0, 3.0, 5.0, 6.0, 4.0])
MESH = block((0.1, 0.02, 0.02), (5, 1, 1), "hex8")


def displacement(points_mm, force, angle):
    """A made-up solution, mm: quadratic in the force (N), bilinear with the angle (rad)."""
    x = points_mm[:, :1] / 100.0
    return np.hstack([-(force**2) * x**3, force * (1.0 + angle) * x**2, 2.0 * angle * x])


def fields(force, angle):
    points = 1e3 * MESH.nodes
    count = len(points)
    return {
        "U": displacement(points, force, angle),
        "S": force * np.tile(VTK_STRESS, (count, 1)),
        "E": 1e-3 * force * np.tile(np.eye(3).ravel(), (count, 1)),
    }


@pytest.fixture
def folder(tmp_path):
    runs = tmp_path / "runs"
    runs.mkdir()
    rows = ["file, force [N], angle [deg]"]
    rng = np.random.default_rng(0)
    for number, (force, degrees) in enumerate(rng.uniform([0.0, -20.0], [3.0, 20.0], (40, 2))):
        cells = [("hexahedron", MESH.blocks[0].connectivity)]
        content = meshio.Mesh(1e3 * MESH.nodes, cells, point_data=fields(force, np.radians(degrees)))
        content.write(runs / f"run{number}.vtu")
        rows.append(f"run{number}.vtu, {float(force)!r}, {float(degrees)!r}")
    (runs / "table.csv").write_text("\n".join(rows) + "\n")
    (tmp_path / "study.toml").write_text(STUDY)
    return tmp_path


def test_a_folder_of_solutions_becomes_a_model(folder):
    assert cli.main(["build", str(folder), "-o", str(folder / "beam.morph")]) == 0
    model = load_model(folder / "beam.morph")
    assert [(p.name, p.quantity, p.unit) for p in model.parameters] == [
        ("force", "force", "N"),
        ("angle", "angle", "deg"),
    ]
    mu = np.array([1.7, np.radians(9.0)])
    expected = 1e-3 * displacement(1e3 * MESH.nodes, *mu)
    assert model.displacement.value(mu) == pytest.approx(expected, abs=1e-8)
    assert model.stresses["solid"].value(mu) == pytest.approx(1.7e6 * np.tile(OUR_STRESS, (24, 1)), rel=1e-4)
    assert model.strain is not None
    assert model.strain.value(mu)[0] == pytest.approx([1.7e-3] * 3 + [0.0] * 3, abs=1e-8)
    assert model.cells["hex8"].shape == (5, 8)
    assert "sensitivity" not in model.certificate
    assert model.certificate["displacement"]["mean_relative_to_largest"] < 1e-5
    assert model.certificate["samples"]["held_out"] == 8


def test_an_xdmf_series_is_read_step_by_step(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # meshio writes the series' numbers where it runs
    with meshio.xdmf.TimeSeriesWriter(tmp_path / "series.xdmf") as writer:
        writer.write_points_cells(1e3 * MESH.nodes, [("hexahedron", MESH.blocks[0].connectivity)])
        for step, force in enumerate(np.linspace(0.0, 2.0, 15)):
            writer.write_data(step, point_data={"U": displacement(1e3 * MESH.nodes, force, 0.0)})
    rows = [f"series.xdmf, {step}, {force!r}" for step, force in enumerate(np.linspace(0.0, 2.0, 15).tolist())]
    (tmp_path / "table.csv").write_text("\n".join(["file, step, force [N]", *rows]) + "\n")
    text = STUDY.replace("runs/table.csv", "table.csv")
    text = "\n".join(line for line in text.splitlines() if line.split(" ")[0] not in ("stress", "strain"))
    (tmp_path / "study.toml").write_text(text)
    assert cli.main(["build", str(tmp_path / "study.toml"), "-o", str(tmp_path / "x.morph")]) == 0
    model = load_model(tmp_path / "x.morph")
    expected = 1e-3 * displacement(1e3 * MESH.nodes, 1.3, 0.0)
    assert model.displacement.value(np.array([1.3])) == pytest.approx(expected, abs=1e-8)
    assert model.stresses == {}


@pytest.mark.parametrize(
    ("file", "before", "after", "message"),
    [
        ("runs/table.csv", "run7.vtu", "run70.vtu", r"run70\.vtu that the table names does not exist"),
        ("runs/table.csv", "force [N]", "force [lbf]", r"'lbf' is not a known unit"),
        ("runs/table.csv", "file,", "name,", r"needs a column 'file'"),
        ("runs/table.csv", "run7.vtu", "run5.vtu", r"line 9: 'run5\.vtu' is in line 7 already"),
        ("runs/table.csv", "run7.vtu", "table.csv", r"table\.csv is no solution that can be read; use \.vtu"),
        ("study.toml", '"mm"', '"m"', r'external\.length_unit: .* hardly meant; .* write "mm"'),
        ("study.toml", '"U"', '"u"', r"no point data 'u'; it has: U, S, E"),
        ("study.toml", '"runs/table.csv"', '"table.csv"', r"cannot read the table .*No such file"),
        ("study.toml", "max_degree", "degree", r"unknown key reduction\.degree; known here: method, format, basis"),
    ],
)
def test_a_mistake_is_one_message(folder, refused, file, before, after, message):
    path = folder / file
    assert before in path.read_text()
    path.write_text(path.read_text().replace(before, after, 1))
    assert re.search(message, refused("build", folder / "study.toml", "-o", folder / "x.morph"))


def test_a_solution_on_another_mesh_is_refused(folder, refused):
    content = meshio.read(folder / "runs" / "run3.vtu")
    content.points = np.asarray(content.points) * 1.01
    content.write(folder / "runs" / "run3.vtu")
    assert re.search(
        r"run3\.vtu has another mesh than the first", refused("build", folder / "study.toml", "-o", folder / "x.morph")
    )


def test_a_damaged_solution_is_one_message(folder, refused):
    path = folder / "runs" / "run3.vtu"
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    assert re.search(
        r"^morph: \S*study.toml: .*run3\.vtu is damaged, cut short, or no \.vtu file",
        refused("build", folder / "study.toml", "-o", folder / "x.morph"),
    )
