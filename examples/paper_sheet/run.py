"""The paper's sheet of paper: its post-buckling path at 801 positions, by arc length from a buckling mode.

An A3 sheet (31 x 43 nodes are 10 mm apart), fibres along it, clamped at its short ends, which are brought
together until its middle stands 169 mm above the plane: just short of as high as a sheet of this length can
arch. The positions are kept in the output folder; a run that was stopped goes on where it was. They are then
reduced to a model file and to the paper's form u(X, Y, path). Pictures are drawn beside them.
"""

from __future__ import annotations

import argparse
import sys
import time
from concurrent.futures import as_completed
from pathlib import Path

import numpy as np
from matplotlib import colormaps
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from positions import (
    BuckledSheet,
    BucklingFolder,
    PathRecord,
    follow_path,
    positions_by_point,
    solve_positions,
    southwell_load,
)
from reduction import Grid, write_reduction
from tqdm import tqdm

import morph_dslam as md
from morph_dslam.extend import run_and_report_errors
from morph_dslam.extend.sheets import OrthotropicSheet, PathPoint, missed_bifurcations
from morph_dslam.extend.studies import default_executor, load_snapshot

HERE = Path(__file__).resolve().parent
OUTPUT = HERE / "output"

POSITIONS = 801
HEIGHT = 0.169
#: Along x, the fibres, and y, m.
SIZE = (0.420, 0.297)
#: Office paper with its machine direction along the sheet, as in examples/kinect_paper.
PAPER = OrthotropicSheet(young_fibre=5e9, young_cross=2.5e9, poisson=0.3, shear=1.4e9, thickness=1e-4)
#: The outputs of a position, in the order in which they are tabulated.
OUTPUTS = ("approach", "height", "bending_energy", "end_force")

#: Neighbouring positions may differ by this part of the largest value, as many times as they are far apart.
LARGEST_JUMP = 8.0
#: The work of the end force must equal the bending energy so well (stretching takes almost none).
WORK_TOLERANCE = 5e-3
BUCKLING_TOLERANCE = 5e-3
DPI = 110


def run(arguments: argparse.Namespace) -> None:
    began = time.perf_counter()
    sheet = BuckledSheet(*SIZE, PAPER, cells=tuple(arguments.cells))
    folder = BucklingFolder.of(arguments.output, sheet, HEIGHT, arguments.positions)
    eigenvalue, _ = folder.buckling(sheet)
    path = trace(sheet, folder)
    solve_all(sheet, folder, [record.point for record in path], arguments.positions, arguments.workers)
    table = np.array([outputs(folder, number) for number in range(arguments.positions)])
    from_path = southwell_load(
        np.array([record.height for record in path]),
        np.array([record.end_force for record in path]),
        sheet.imperfection,
        largest=0.5 * sheet.material.thickness,
    )
    draw_path(arguments.output / "path.png", table, eigenvalue)
    draw_southwell(arguments.output / "southwell.png", path, sheet, eigenvalue)
    draw_shapes(arguments.output / "shapes.png", sheet, folder, arguments.positions)
    check(table, eigenvalue, from_path, [record.point for record in path])
    print(
        f"positions={len(table)} largest_mm={1e3 * table[:, 1].max():.2f} pcr_path_N={from_path:.5f} "
        f"pcr_eigen_N={eigenvalue:.5f} seconds={time.perf_counter() - began:.0f}"
    )
    snapshots = [load_snapshot(folder.position_file(number)) for number in range(arguments.positions)]
    print(write_reduction(snapshots, Grid((sheet.length, sheet.width), sheet.cells), arguments.output))


def trace(sheet: BuckledSheet, folder: BucklingFolder) -> list[PathRecord]:
    """Follow the path with a progress bar in mm of height."""
    path = []
    with tqdm(total=round(1e3 * HEIGHT), desc="following the path", unit="mm", bar_format=BAR) as progress:
        for record in follow_path(sheet, folder, HEIGHT):
            path.append(record)
            progress.update(round(1e3 * record.height) - progress.n)
    return path


BAR = "{desc}: {n}/{total} {unit} [{elapsed}]"


def solve_all(
    sheet: BuckledSheet, folder: BucklingFolder, points: list[PathPoint], count: int, workers: int | None
) -> None:
    """Solve the positions that are not kept yet, the path's intervals in parallel."""
    tasks = positions_by_point(points, count)
    with (
        default_executor(workers) as executor,
        tqdm(total=count, desc="solving positions", unit="position") as progress,
    ):
        running = {
            executor.submit(solve_positions, sheet, folder, number, positions, points[-1].length): positions
            for number, positions in tasks
        }
        for done in as_completed(running):
            done.result()
            progress.update(len(running[done]))


def outputs(folder: BucklingFolder, number: int) -> list[float]:
    kept = load_snapshot(folder.position_file(number)).outputs
    return [float(kept[name]) for name in OUTPUTS]


def check(table: np.ndarray, eigenvalue: float, from_path: float, points: list[PathPoint]) -> None:
    """Refuse a path that jumps, that loses energy, or that begins at another load than the eigenvalue.

    Raises
    ------
    MorphError
        Saying what is wrong.
    """
    if missed := missed_bifurcations(points):
        raise md.MorphError(f"the path has passed a bifurcation: {missed[0]}")
    approach, _, energy, force = table.T
    buckled = slice(1, None)  # the first position is the unloaded sheet
    for name, values in (("bending energy", energy[buckled]), ("end force", force[buckled])):
        jump = np.abs(np.diff(values)).max() / values.max()
        if jump > LARGEST_JUMP / len(table):
            raise md.MorphError(f"the {name} jumps by {100.0 * jump:.1f} % between neighbouring positions")
    work = np.sum(np.diff(approach[buckled]) * (force[1:-1] + force[2:]) / 2.0)
    gained = energy[-1] - energy[1]
    if abs(work / gained - 1.0) > WORK_TOLERANCE:
        raise md.MorphError(f"the end force works {1e3 * work:.4f} mJ but bending takes {1e3 * gained:.4f} mJ")
    if abs(from_path / eigenvalue - 1.0) > BUCKLING_TOLERANCE:
        raise md.MorphError(f"the path buckles at {from_path:.5f} N, the eigenvalue is {eigenvalue:.5f} N")


def draw_path(file: Path, table: np.ndarray, eigenvalue: float) -> None:
    """End force, height and bending energy against the approach of the ends."""
    approach, height, energy, force = table.T
    figure = Figure(figsize=(7.0, 8.0), layout="constrained")
    force_axes, height_axes, energy_axes = figure.subplots(3, 1, sharex=True)
    force_axes.plot(1e3 * approach, 1e3 * force, ".-", markersize=3)
    force_axes.axhline(1e3 * eigenvalue, color="#b4530a", linewidth=1, label="first eigenvalue")
    force_axes.legend(frameon=False)
    force_axes.set_ylabel("end force / mN")
    height_axes.plot(1e3 * approach, 1e3 * height, ".-", markersize=3)
    height_axes.set_ylabel("height of the middle / mm")
    energy_axes.plot(1e3 * approach, 1e3 * energy, ".-", markersize=3)
    energy_axes.set_ylabel("bending energy / mJ")
    energy_axes.set_xlabel("approach of the ends / mm")
    figure.savefig(file, dpi=DPI)


def draw_southwell(file: Path, path: list[PathRecord], sheet: BuckledSheet, eigenvalue: float) -> None:
    """The beginning of the path, where the imperfect sheet nears the eigenvalue."""
    deflection = np.array([record.height for record in path]) - sheet.imperfection
    force = np.array([record.end_force for record in path])
    small = deflection < 5.0 * sheet.material.thickness
    figure = Figure(figsize=(7.0, 4.0), layout="constrained")
    axes = figure.subplots()
    axes.plot(1e3 * deflection[small], 1e3 * force[small], "o-", markersize=4, label="path")
    axes.axhline(1e3 * eigenvalue, color="#b4530a", linewidth=1, label="first eigenvalue")
    axes.set(xlabel="deflection of the middle / mm", ylabel="end force / mN", ylim=(0.0, None))
    axes.legend(frameon=False, loc="lower right")
    figure.savefig(file, dpi=DPI)


def draw_shapes(file: Path, sheet: BuckledSheet, folder: BucklingFolder, count: int) -> None:
    """Some positions from the side, and the last one in space with the stress along it on its upper face."""
    figure = Figure(figsize=(12.0, 4.6), layout="constrained")
    side = figure.add_subplot(1, 2, 1)
    nx, ny = sheet.cells
    points = np.column_stack([sheet.points, np.zeros(len(sheet.points))])
    for number in np.linspace(0, count - 1, 9).astype(int):
        snapshot = load_snapshot(folder.position_file(int(number)))
        placed = (points + snapshot.fields["displacement"]).reshape(ny + 1, nx + 1, 3)
        middle = 1e3 * placed[ny // 2]
        side.plot(middle[:, 0], middle[:, 2], color="#2f6690", linewidth=1)
    side.set(xlabel="x / mm", ylabel="height / mm", aspect="equal", title="the middle line")
    space = figure.add_subplot(1, 2, 2, projection="3d")
    stress = snapshot.fields["stress_top"][:, 0].reshape(ny + 1, nx + 1) / 1e6
    limit = np.abs(stress).max()
    colours = colormaps["coolwarm"]((stress + limit) / (2.0 * limit))
    x, y, z = (1e3 * placed[..., axis] for axis in range(3))
    space.plot_surface(x, y, z, facecolors=colours, rstride=1, cstride=1, shade=False)  # type: ignore[attr-defined]
    space.set(xlabel="x / mm", ylabel="y / mm", zlabel="height / mm")
    space.set_box_aspect([np.ptp(placed[..., axis]) for axis in range(3)], zoom=0.85)  # type: ignore[attr-defined]
    for axis in (space.xaxis, space.yaxis, space.zaxis):  # type: ignore[attr-defined]
        axis.set_major_locator(MaxNLocator(4))
    space.zaxis.labelpad = 8  # type: ignore[attr-defined]
    bar = figure.colorbar(ScalarMappable(Normalize(-limit, limit), "coolwarm"), ax=space, shrink=0.7)
    bar.set_label("stress along the sheet, upper face / MPa")
    figure.savefig(file, dpi=DPI)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--positions", type=int, default=POSITIONS, help="along the path (default %(default)s)")
    parser.add_argument("--cells", type=int, nargs=2, default=(42, 30), metavar=("NX", "NY"))
    parser.add_argument("--output", type=Path, default=OUTPUT, help="folder of results (default %(default)s)")
    parser.add_argument("--workers", type=int, help="processes; one a core unless said otherwise")
    return run_and_report_errors(run, parser.parse_args(), "what was solved so far is kept")


if __name__ == "__main__":
    sys.exit(main())
