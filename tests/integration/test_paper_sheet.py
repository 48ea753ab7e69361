"""The example of the paper's sheet on a coarse mesh, run as a user runs it."""

from __future__ import annotations

import importlib
import re
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from morph_dslam import MorphError, load_model
from morph_dslam.evaluation.evaluate import evaluate
from morph_dslam.evaluation.run_folder import load_run
from morph_dslam.mechanics.shell import OrthotropicSheet
from morph_dslam.model import save_model
from morph_dslam.studies.problem import Snapshot
from morph_dslam.studies.snapshots import load_snapshot
from tests.support.real_data import ROOT
from tests.support.scenes import film_and_track, write_texture

RESULT = r"positions=(\d+) largest_mm=([\d.]+) pcr_path_N=([\d.]+) pcr_eigen_N=([\d.]+) seconds=(\d+)"


@pytest.mark.slow
def test_the_papers_sheet_is_followed_to_its_full_height_and_not_solved_twice(tmp_path) -> None:
    program = ROOT / "examples" / "paper_sheet" / "run.py"
    options = ["--cells", "12", "6", "--positions", "81", "--output", str(tmp_path)]
    done = [subprocess.run([sys.executable, str(program), *options], capture_output=True, text=True) for _ in "12"]
    assert done[0].returncode == 0, done[0].stderr[-2000:]
    first, second = (re.search(rf"^{RESULT}$", run.stdout, re.MULTILINE) for run in done)
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
    reduced = dict(re.findall(r"(\w+)=(\S+)", done[0].stdout.splitlines()[-1]))
    for form in ("normalised_error", "separated_error"):
        assert float(reduced[form]) <= 1e-3
    for form in ("von_mises_error", "separated_von_mises_error"):
        assert float(reduced[form]) <= 0.02
    for name in ("path.png", "southwell.png", "shapes.png", "reduction.png", "paper_sheet.morph"):
        assert (tmp_path / name).is_file()


def example_module(name: str, monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """The example's module of this name."""
    monkeypatch.syspath_prepend(str(ROOT / "examples" / "paper_sheet"))
    monkeypatch.delitem(sys.modules, name, raising=False)
    return importlib.import_module(name)


@pytest.fixture
def positions(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    return example_module("positions", monkeypatch)


@pytest.fixture
def reduction(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    return example_module("reduction", monkeypatch)


@pytest.fixture
def sides(reduction: ModuleType, monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    return example_module("sides", monkeypatch)


#: E = 5 GPa, nu = 0.
COLUMN = OrthotropicSheet(young_fibre=5e9, young_cross=5e9, poisson=0.0, shear=2.5e9, thickness=1e-4)
#: Euler's load of a column of 297 x 210 x 0.1 mm that is clamped at both ends, N.
EULER = 4.0 * np.pi**2 * 5e9 * 0.210 * 1e-12 / 12.0 / 0.297**2


def test_a_clamped_strip_buckles_at_eulers_load_into_eulers_mode(positions: ModuleType) -> None:
    sheet = positions.BuckledSheet(0.297, 0.210, COLUMN, (10, 2), 3)
    force, mode = sheet.first_buckling()
    assert force == pytest.approx(EULER, rel=1e-3)
    x = np.linspace(-0.14, 0.14, 15)
    height, _ = sheet.shell.sample(mode, np.column_stack([x, np.zeros_like(x)]))
    np.testing.assert_allclose(height[:, 2], np.cos(np.pi * x / 0.297) ** 2, atol=2e-3)


@pytest.mark.slow
def test_an_imperfect_strip_deflects_as_columns_do_and_goes_on_where_it_was(
    positions: ModuleType, tmp_path: Path
) -> None:
    """w = w0 / (1 - P / P_cr) for an imperfection in the shape of the mode; Southwell's load is Euler's."""
    sheet = positions.BuckledSheet(0.297, 0.210, COLUMN, (10, 2), 3, 2e-6)
    folder = positions.BucklingFolder.of(tmp_path, sheet, 2e-3, count=4)
    path = list(positions.follow_path(sheet, folder, 2e-3))
    heights, forces = (np.array([getattr(r, name) for r in path]) for name in ("height", "end_force"))
    early = (heights > 1.5 * sheet.imperfection) & (heights < 5e-5)
    expected = sheet.imperfection / (1.0 - forces[early] / EULER)
    np.testing.assert_allclose(heights[early], expected, rtol=0.03)
    assert positions.southwell_load(heights, forces, sheet.imperfection, 5e-5) == pytest.approx(EULER, rel=2e-3)
    assert heights[-1] == pytest.approx(2e-3, rel=1e-6)

    folder.path_file(len(path) - 1).unlink()
    again = list(positions.follow_path(sheet, folder, 2e-3))
    assert len(again) == len(path)
    assert again[-1].end_force == pytest.approx(path[-1].end_force, rel=1e-6)

    points = [record.point for record in path]
    for number, lengths in positions.positions_by_point(points, folder.count):
        positions.solve_positions(sheet, folder, number, lengths, points[-1].length)
    last = load_snapshot(folder.position_file(3))
    assert last.coordinates == pytest.approx([1.0])
    assert last.outputs["height"] == pytest.approx(2e-3, rel=1e-6)
    # Bending energy of the mode at height w: E I w^2 pi^4 / L^3.
    energy = 5e9 * 0.210 * 1e-12 / 12.0 * np.pi**4 * 4e-6 / 0.297**3
    assert last.outputs["bending_energy"] == pytest.approx(energy, rel=5e-3)
    # Stress on the upper face at the crest: E t / 2 times the curvature 2 pi^2 w / L^2.
    crest = np.argmax(last.fields["displacement"][:, 2])
    stress = 5e9 * 5e-5 * 2.0 * np.pi**2 * 2e-3 / 0.297**2
    assert last.fields["stress_top"][crest, 0] == pytest.approx(stress, rel=0.02)


@pytest.mark.slow
def test_a_sheet_that_cannot_arch_so_high_says_how_high_it_can(positions: ModuleType, tmp_path: Path) -> None:
    """The elastica of length L arches to 0.40315 L at most."""
    sheet = positions.BuckledSheet(0.297, 0.02, COLUMN, (10, 1), 3, 1e-5)
    folder = positions.BucklingFolder.of(tmp_path, sheet, 0.15, count=4)
    with pytest.raises(MorphError, match=r"rises to 119\.[5-9]\d mm and falls again"):
        list(positions.follow_path(sheet, folder, 0.15))


LENGTH, WIDTH, CELLS = 0.4, 0.2, (10, 4)
YOUNG, THICKNESS = 5e9, 1e-4


def rolled(path: float) -> Snapshot:
    """A sheet rolled to a cylinder of curvature 4 path / m: x = sin(k X) / k, z = (1 - cos(k X)) / k."""
    x, y = np.meshgrid(*(np.linspace(-a / 2, a / 2, n + 1) for a, n in zip((LENGTH, WIDTH), CELLS, strict=True)))
    curvature = max(4.0 * path, 1e-6)
    moved = np.stack([np.sin(curvature * x) / curvature - x, 0.0 * y, (1 - np.cos(curvature * x)) / curvature])
    along = YOUNG * THICKNESS / 2.0 * curvature * np.stack([1.0 + 0.0 * x, 0.3 * np.cos(10.0 * y), 0.0 * x])
    stress = along.reshape(3, -1).T
    fields = {"displacement": moved.reshape(3, -1).T, "stress_top": -stress, "stress_bottom": stress}
    return Snapshot(np.array([path]), fields)


def test_a_rolled_sheet_is_given_by_few_modes_and_by_products_of_x_y_and_the_path(
    reduction: ModuleType, tmp_path: Path
) -> None:
    snapshots = [rolled(path) for path in np.linspace(0.0, 1.0, 41)]
    grid = reduction.Grid((LENGTH, WIDTH), CELLS)
    line = reduction.write_reduction(snapshots, grid, tmp_path)
    model = load_model(tmp_path / "paper_sheet.morph")
    figures = {key: float(value) for key, value in re.findall(r"(\w+)=(\S+)", line)}
    unseen = rolled(0.3377)
    truth = unseen.fields["displacement"]
    scale = np.linalg.norm(truth)
    assert np.linalg.norm(model.displacement.value(np.array([0.3377])) - truth) <= 2e-4 * scale
    form = reduction.separate_space(snapshots[::2], "displacement", grid)
    assert np.linalg.norm(reduction.evaluate_separated(form, grid, 0.3377) - truth) <= 2e-4 * scale
    along, across = 4.0 * 0.3377 * YOUNG * THICKNESS / 2.0, 0.3 * np.cos(10.0 * WIDTH / 2.0)
    at_side = along * np.sqrt(1.0 - across + across**2)
    assert model.von_mises(np.array([0.3377]), "top").max() == pytest.approx(at_side, rel=1e-3)
    # The largest triangle (x fastest) has no side longer than a cell's diagonal.
    corners = model.nodes[model.triangles]
    sides = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2)
    assert sides.max() == pytest.approx(np.hypot(0.04, 0.05))
    numbers = model.displacement.modes.size + model.displacement.functions.n_floats
    assert figures["compression_percent"] == pytest.approx(100.0 * (1.0 - numbers / (41 * 55 * 3)), abs=0.01)
    assert max(figures["normalised_error"], figures["separated_error"]) <= 2e-4
    assert max(figures["von_mises_error"], figures["separated_von_mises_error"]) <= 1e-3
    assert (tmp_path / "reduction.png").is_file()


def test_a_sheet_below_its_plane_is_the_one_above_it_in_a_mirror(reduction: ModuleType, sides: ModuleType) -> None:
    """Against the closed form with a negative curvature, which no snapshot has."""
    model = sides.tracked_model(
        [rolled(path) for path in np.linspace(0.0, 1.0, 81)], reduction.Grid((LENGTH, WIDTH), CELLS)
    )
    x, curvature = model.nodes[:, 0], -4.0 * 0.3377
    rolled_down = np.stack([np.sin(curvature * x), 0.0 * x, 1.0 - np.cos(curvature * x)], axis=1) / curvature
    rolled_down[:, 1] = model.nodes[:, 1]
    assert np.abs(model.positions(np.array([-0.3377])) - rolled_down).max() <= 1e-5
    # Bent down, what was stretched is pressed: the upper face has the stress that the lower one had.
    upper = model.stresses["top"].value(np.array([-0.3377]))[:, 0]
    along = YOUNG * THICKNESS / 2.0 * 4.0 * 0.3377
    np.testing.assert_allclose(upper, along, rtol=1e-3)
    # The flat sheet lies inside of the range, and its height changes in proportion to the path there.
    assert model.parameters[0].lower == -1.0
    slope = (model.positions(np.array([1e-3])) - model.positions(np.array([-1e-3])))[:, 2] / 2e-3
    np.testing.assert_allclose(slope, 2.0 * x**2, atol=1e-5)


SCENE = """
model = "sheet.morph"
frames = 19
seed = 1
supersampling = 1
image_format = "png"
camera = { width = 480, height = 360, fx = 450.0, fy = 450.0, cx = 239.5, cy = 179.5 }
[surface]
texture = "print.png"
[sensor]
noise = 1.0
[[pose]]
frame = 0
position_mm = [0, 0, 560]
rotation_deg = [195, 20, 0]
[[pose]]
frame = 18
position_mm = [10, -5, 560]
rotation_deg = [185, -15, 4]
[[parameters]]
frame = 0
path = 0.0
[[parameters]]
frame = 5
path = 0.6
[[parameters]]
frame = 10
path = 0.0
[[parameters]]
frame = 15
path = -0.6
[[parameters]]
frame = 18
path = -0.2
"""


def test_a_flat_sheet_is_followed_to_whichever_side_it_bends(
    reduction: ModuleType, sides: ModuleType, tmp_path: Path
) -> None:
    snapshots = [rolled(path) for path in np.linspace(0.0, 1.0, 81)]
    save_model(tmp_path / "sheet.morph", sides.tracked_model(snapshots, reduction.Grid((LENGTH, WIDTH), CELLS)))
    write_texture(tmp_path, (40, 60), (900, 600))
    (tmp_path / "scene.toml").write_text(SCENE)
    _, sequence, run = film_and_track(tmp_path / "scene.toml", tmp_path / "sheet.morph")
    figures = evaluate(run, sequence / "truth.npz", 0)
    assert figures["n_frames_tracked"] == 19
    assert figures["mean_mm"] <= 0.5
    found, truth = load_run(run).parameters[:, 0], np.load(sequence / "truth.npz")["parameters"][:, 0]
    bent = np.abs(truth) > 0.02
    assert (truth > 0.02).any()
    assert (truth < -0.02).any()
    np.testing.assert_array_equal(np.sign(found[bent]), np.sign(truth[bent]))
    np.testing.assert_allclose(found, truth, atol=0.01)
