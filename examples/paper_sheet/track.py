"""Track the paper's sheet beyond buckling, as a free object, and set the errors beside the paper's.

A sheet is bent upwards until its middle is 169 mm high, flattened, bent to its other side and flattened
again, while it is moved and turned before one camera that stands still. Pose and path are estimated together
in every frame; nobody tells to which side the flat sheet will buckle. The recording is rendered through all
801 positions of `run.py`, which must be solved first; the tracker's model is made of 41 of them. Everything
is left in output/.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray
from positions import BuckledSheet, BucklingFolder
from reduction import Grid
from run import HEIGHT, OUTPUT, PAPER, POSITIONS, SIZE
from sides import filmed_model, tracked_model

import morph_dslam as md
from morph_dslam.extend import run_and_report_errors
from morph_dslam.extend.reports import KeyFigures, Link, Picture, Section, Table, Text, depth_line, write_report
from morph_dslam.extend.studies import Snapshot, load_snapshot
from support import Recording, keep, keep_sequence, report, track_and_evaluate

Array = NDArray[np.float64]
HERE = Path(__file__).resolve().parent
MODEL, FILMED = OUTPUT / "tracked.morph", OUTPUT / "filmed.morph"
RECORDING, RUN = OUTPUT / "recording", OUTPUT / "run"
#: The paper's mean error on its recording of such a sheet, its camera's own error, its largest height, mm.
PAPER_MEAN, PAPER_CAMERA, PAPER_HEIGHT = 3.98, 1.2, 169.0
#: The largest displacement is what frames show that have at least this part of the full height.
HIGHEST = 0.95
GRID = Grid(SIZE, (42, 30))


def make_models() -> None:
    """Make the filmed and the tracked model of the positions, unless that was done.

    Raises
    ------
    MorphError
        If the positions are not there.
    """
    sheet = BuckledSheet(*GRID.size, PAPER, cells=GRID.cells)
    folder = BucklingFolder.of(OUTPUT, sheet, HEIGHT, POSITIONS)
    files = [folder.position_file(number) for number in range(POSITIONS)]
    missing = sum(not file.is_file() for file in files)
    if missing:
        raise md.MorphError(
            f"{missing} of the {POSITIONS} positions are not in {folder.root}: solve them with "
            f"`python examples/{HERE.name}/run.py` first"
        )
    ingredients = [HERE / "sides.py", HERE / "reduction.py", *files]
    for model, make in ((MODEL, tracked_model), (FILMED, filmed_model)):
        keep(model, ingredients, lambda model=model, make=make: md.save_model(model, make(read(files), GRID)))


def read(files: list[Path]) -> list[Snapshot]:
    """Positions with their fields in memory, since each is asked for many times."""
    kept = (load_snapshot(file) for file in files)
    return [replace(snapshot, fields=dict(snapshot.fields)) for snapshot in kept]


def heights() -> Array:
    """How high above its plane, or below it, the sheet is in each frame, m."""
    model = md.load_model(FILMED)
    found = []
    for mu in np.load(RECORDING / "truth.npz")["parameters"]:
        z = model.positions(mu)[:, 2]
        found.append(z[np.abs(z).argmax()])
    return np.array(found)


def draw(path: Path, figures: dict[str, Any], surface: dict[str, Any], height: Array) -> None:
    """Both errors over the frames, the paper's mean beside them, and how high the sheet is."""
    figure = Figure(figsize=(9.0, 5.4), layout="constrained")
    axes, below = figure.subplots(2, 1, sharex=True, height_ratios=(2.4, 1.0))
    for content, label, colour in (
        (figures, "this program: material points against the exact truth", "#1b1f24"),
        (surface, "this program: depth sensor's points to the estimated surface", "#8fb3d9"),
    ):
        frames = content["frames_compared"]
        means = [content["per_frame"][str(frame)]["mean_mm"] for frame in frames]
        axes.plot(frames, means, color=colour, linewidth=1.3, label=f"{label}, mean {content['mean_mm']:.2f} mm")
    axes.axhline(PAPER_MEAN, color="#b4530a", label=f"the paper, its own recording: mean {PAPER_MEAN} mm")
    axes.axhline(
        PAPER_CAMERA, color="#b4530a", linestyle=":", label=f"the paper: error of its camera, {PAPER_CAMERA} mm"
    )
    axes.set(ylabel="mean error in the frame / mm", ylim=(0.0, 1.6 * PAPER_MEAN))
    axes.legend(frameon=False, fontsize=8, loc="upper left")
    below.plot(1e3 * height, color="#2f6690")
    below.axhline(0.0, color="#57606a", linewidth=0.6)
    below.set(xlabel="frame", ylabel="height / mm")
    below.margins(x=0.01)
    figure.savefig(path, dpi=110)


def rows(figures: dict[str, Any], surface: dict[str, Any], height: Array) -> list[tuple[str, str, str]]:
    """What, the paper's figure, and this program's."""
    highest = np.flatnonzero(np.abs(height) > HIGHEST * HEIGHT)
    near = [figures["per_frame"].get(str(frame), {}).get("mean_mm", np.nan) for frame in highest]
    base = surface["base"]["mean_mm"]
    model = md.load_model(MODEL).certificate["displacement"]
    return [
        ("largest displacement", f"{PAPER_HEIGHT:.0f} mm", f"{1e3 * np.abs(height).max():.1f} mm"),
        ("mean error, material points", "", f"{figures['mean_mm']:.2f} mm"),
        (f"the same from {1e3 * HIGHEST * HEIGHT:.0f} mm on", "", f"{np.nanmean(near):.2f} mm"),
        ("mean distance of depth points", f"{PAPER_MEAN} mm", f"{surface['mean_mm']:.2f} mm"),
        ("error of the depth camera, sheet flat", f"{PAPER_CAMERA} mm", f"{base:.2f} mm"),
        ("frames tracked", "", f"{figures['n_frames_tracked']} of {figures['n_frames']}"),
        ("model on positions it has not seen", "", f"{model['mean_mm']:.3f} mm"),
    ]


def write_comparison(figures: dict[str, Any], surface: dict[str, Any]) -> list[tuple[str, str, str]]:
    """Write the page that sets the paper's figures beside ours; returns its table."""
    height = heights()
    draw(RUN / "comparison.png", figures, surface, height)
    table = rows(figures, surface, height)
    note = (
        "The paper filmed a real sheet with an RGB-D camera; this recording is rendered, with noise and "
        "blur, so that its truth is exact. It lacks the errors of material and supports of a real sheet."
    )
    blocks = [
        KeyFigures({"mean error, paper": f"{PAPER_MEAN} mm", "mean error, here": f"{figures['mean_mm']:.2f} mm"}),
        Table(table, ("", "paper", "here")),
        Text(note),
        Picture.read(RUN / "comparison.png", "Mean error in each frame, and how high the sheet stands."),
        Link("augmented.mp4", "The augmented video"),
        Link("report.html", "The report of the run"),
    ]
    write_report(RUN / "comparison.html", "The paper's sheet, tracked", [Section("Beside the paper", blocks)])
    return table


def run(_: argparse.Namespace) -> None:
    make_models()
    keep_sequence(HERE / "scene.toml", FILMED, RECORDING)
    recording = Recording(
        RECORDING / "frames", RECORDING / "camera.yaml", RECORDING / "landmarks.csv", RECORDING / "truth.npz"
    )
    figures = track_and_evaluate(recording, MODEL, RUN)
    surface = md.evaluate_depth(RUN, RECORDING, base_frame=0)
    for line in Table(write_comparison(figures, surface), ("", "paper", "here")).text():
        print(line)
    print(depth_line(surface))
    print(f"compare {RUN / 'comparison.html'}")
    report(figures, RUN)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    return run_and_report_errors(run, parser.parse_args(), "what was done so far is kept")


if __name__ == "__main__":
    sys.exit(main())
