"""The page that sets the paper's errors on its boot seal beside those of this example."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from morph_dslam.extend.reports import KeyFigures, Link, Picture, Section, Table, Text, write_report

Array = NDArray[np.float64]

#: The paper's errors on its recording: distances of a depth camera's points to the surface, mm.
PAPER_MEAN, PAPER_MEDIAN = 1.49, 1.33
NOTE = (
    "The paper filmed a real seal and measured it with a depth camera; this recording is rendered, with "
    "noise, blur and a simulated depth sensor, so that its truth is exact. It lacks the errors of material "
    "and supports of a real seal. Before the seal is deformed, the sensor's noise and the registration are "
    "nearly all that its points are off by."
)


def _draw(path: Path, frames: Array, nodes: Array, lever: Array, side: Array, depth: dict[str, Any]) -> None:
    """Errors over the frames: of the solid, of the sensor's points, and of the two angles."""
    figure = Figure(figsize=(9.0, 6.4), layout="constrained")
    axes, below = figure.subplots(2, 1, sharex=True, height_ratios=(1.6, 1.0))
    axes.plot(frames, nodes, color="#1b1f24", label="all nodes of the solid against the exact truth")
    measured = [depth["per_frame"][str(frame)]["mean_mm"] for frame in depth["frames_compared"]]
    axes.plot(depth["frames_compared"], measured, color="#8fb3d9", label="depth sensor's points to the surface")
    base = depth["base"]["mean_mm"]
    axes.axhline(base, color="#8fb3d9", linestyle=":", label=f"the same, seal undeformed: {base:.2f} mm")
    axes.axhline(PAPER_MEAN, color="#b4530a", label=f"the paper, its own recording: mean {PAPER_MEAN} mm")
    axes.set(ylabel="mean error in the frame / mm", ylim=(0.0, 1.3 * PAPER_MEAN))
    axes.legend(frameon=False, fontsize=8)
    below.plot(frames, lever, color="#2f6690", label="lever")
    below.plot(frames, side, color="#7a9e3f", label="side")
    below.axhline(0.0, color="#57606a", linewidth=0.6)
    # While the lever has hardly turned, the images do not tell to which side it did.
    reach = 1.2 * max(np.abs(lever).max(), np.percentile(np.abs(side), 90))
    below.set(xlabel="frame", ylabel="error / deg", ylim=(-reach, reach))
    below.legend(frameon=False, fontsize=8)
    figure.savefig(path, dpi=110)


def write_comparison(run: Path, frames: Array, nodes: Array, lever: Array, side: Array, depth: dict[str, Any]) -> Path:
    """Write ``comparison.html`` into a run folder.

    Parameters
    ----------
    frames : (f,) in which the seal is deformed.
    nodes : (f, n) errors of the solid's nodes, mm.
    lever, side : (f,) errors of the angles, degrees.
    depth : content of ``depth_evaluation.json``.

    Returns
    -------
    The page.
    """
    _draw(run / "comparison.png", frames, nodes.mean(axis=1), lever, side, depth)
    table = [
        ("mean error, all nodes of the solid", "", f"{nodes.mean():.2f} mm"),
        ("median", "", f"{np.median(nodes):.2f} mm"),
        ("mean distance of depth points", f"{PAPER_MEAN} mm", f"{depth['mean_mm']:.2f} mm"),
        ("median", f"{PAPER_MEDIAN} mm", f"{depth['median_mm']:.2f} mm"),
        ("the same in a frame before the seal is deformed: mean", "", f"{depth['base']['mean_mm']:.2f} mm"),
        ("lever, mean error", "", f"{np.abs(lever).mean():.3f} deg"),
    ]
    figures = {
        "mean distance of depth points, paper": f"{PAPER_MEAN} mm",
        "mean distance of depth points, here": f"{depth['mean_mm']:.2f} mm",
        "mean error of the whole solid, here": f"{nodes.mean():.2f} mm",
    }
    blocks = [
        KeyFigures(figures),
        Table(table, ("", "paper", "here")),
        Text(NOTE),
        Picture.read(run / "comparison.png", "Errors in each frame while the lever is turned."),
        Link("augmented.mp4", "The augmented video"),
        Link("depth_evaluation.png", "Distances of the depth sensor's points"),
    ]
    page = run / "comparison.html"
    write_report(page, "The paper's boot seal, tracked", [Section("Beside the paper", blocks)])
    return page
