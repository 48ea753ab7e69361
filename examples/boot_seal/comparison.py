"""The page that sets the paper's errors on its boot seal beside those of this example."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from morph_dslam.evaluation.report import KeyFigures, Link, Picture, Section, Table, Text, write_report

Array = NDArray[np.float64]

#: The paper's errors on its recording: distances of a depth camera's points to the surface, mm.
PAPER_MEAN, PAPER_MEDIAN = 1.49, 1.33
NOTE = (
    "The paper filmed a real seal and measured distances of a depth camera's points to its surface; this "
    "recording is rendered, with noise and blur, and compared with its exact truth, inside too. It lacks the "
    "errors of material and supports of a real seal. `morph evaluate run --depth recording` measures as the "
    "paper does, with the recording's simulated depth sensor."
)


def _draw(path: Path, frames: Array, nodes: Array, lever: Array, side: Array) -> None:
    """Errors over the frames: of the solid and of the two angles."""
    figure = Figure(figsize=(9.0, 6.4), layout="constrained")
    axes, below = figure.subplots(2, 1, sharex=True, height_ratios=(1.6, 1.0))
    axes.plot(frames, nodes, color="#1b1f24", label="all nodes of the solid against the exact truth")
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


def write_comparison(run: Path, frames: Array, nodes: Array, lever: Array, side: Array) -> Path:
    """Write ``comparison.html`` into a run folder.

    Parameters
    ----------
    frames : (f,) in which the seal is deformed. nodes : (f, n) errors of the solid's nodes, mm.
    lever, side : (f,) errors of the angles, degrees.

    Returns
    -------
    The page.
    """
    _draw(run / "comparison.png", frames, nodes.mean(axis=1), lever, side)
    table = [
        ("mean error", f"{PAPER_MEAN} mm, points of the surface", f"{nodes.mean():.2f} mm, all nodes"),
        ("median", f"{PAPER_MEDIAN} mm", f"{np.median(nodes):.2f} mm"),
        ("lever, mean error", "", f"{np.abs(lever).mean():.3f} deg"),
    ]
    ours = f"{nodes.mean():.2f} mm"
    blocks = [
        KeyFigures({"mean error, paper": f"{PAPER_MEAN} mm", "mean error, here": ours}),
        Table(table, ("", "paper", "here")),
        Text(NOTE),
        Picture.read(run / "comparison.png", "Errors in each frame while the lever is turned."),
        Link("augmented.mp4", "The augmented video"),
    ]
    page = run / "comparison.html"
    write_report(page, "The paper's boot seal, tracked", [Section("Beside the paper", blocks)])
    return page
