"""The report of a specimen: what was predicted beside what was measured, and how far polynomials get."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from numpy.typing import NDArray

import morph_dslam as md
from morph_dslam.extend.reports import (
    Block,
    KeyFigures,
    Picture,
    PixelError,
    PixelTracks,
    Section,
    Table,
    Text,
    write_report,
)

Array = NDArray[np.float64]


def draw_stress(axes: Axes, run: md.Run, row: int, title: str) -> None:
    """The specimen in the picture's place, coloured by von Mises stress at its surface, MPa."""
    at = run.model.at(run.parameters[row])
    pose = run.camera_from_object[row]
    nodes = at.positions() @ pose[:3, :3].T + pose[:3, 3]
    pixels = run.camera.project_recorded(nodes)
    stress = 1e-6 * at.von_mises()
    corners = pixels[run.model.triangles]
    sides = corners[:, 1:] - corners[:, :1]
    front = run.model.triangles[sides[:, 0, 0] * sides[:, 1, 1] < sides[:, 0, 1] * sides[:, 1, 0]]
    # Stiff discs carry far more than the rubber around them.
    drawn = axes.tripcolor(pixels[:, 0], pixels[:, 1], front, stress, vmax=np.percentile(stress, 90), shading="gouraud")
    plt.colorbar(drawn, ax=axes, label="von Mises stress, MPa", shrink=0.8)
    axes.set(title=title, xlim=(0, run.camera.width), ylim=(run.camera.height, 0), aspect="equal", xticks=[], yticks=[])


@dataclass(frozen=True)
class Compared:
    """A run beside the points that were measured.

    Attributes
    ----------
    title : what the tracker saw.
    run : what it found.
    error : of the points.
    tracks : where they were measured.
    """

    title: str
    run: md.Run
    error: PixelError
    tracks: PixelTracks


def draw_points(path: Path, runs: Sequence[Compared], frame: int | None = None) -> None:
    """Predicted and measured points over the predicted stress, side by side, in the last frame by default."""
    figure, places = plt.subplots(1, len(runs), figsize=(6.5 * len(runs), 3.9), squeeze=False)
    for axes, compared in zip(places[0], runs, strict=True):
        run, error, tracks = compared.run, compared.error, compared.tracks
        shown = int(error.frames[-1]) if frame is None else frame
        row = run.row(shown)
        columns = [tracks.ids.index(name) for name in error.ids]
        measured = tracks.pixels[tracks.frames == shown][0, columns]
        predicted = measured + error.pixels[error.frames == shown][0]
        draw_stress(axes, run, row, f"{compared.title}, stroke {1e3 * run.parameters[row, 0]:.1f} mm")
        axes.scatter(*measured.T, s=60, facecolors="none", edgecolors="white", label="measured")
        axes.scatter(*predicted.T, s=7, color="red", label="predicted")
        axes.legend(loc="lower right", facecolor="0.6", fontsize=8)
    figure.tight_layout()
    figure.savefig(path, dpi=80)
    plt.close(figure)


def draw_errors(path: Path, runs: Sequence[Compared], without: Mapping[str, float]) -> None:
    """Mean distances in each frame, mm, beside those of polynomials in the hidden half."""
    figure, axes = plt.subplots(figsize=(7.0, 4.0))
    for compared in runs:
        across = 1e3 * compared.error.across
        label = f"{compared.title} ({np.nanmean(across):.3f} mm)"
        axes.plot(compared.error.frames, np.nanmean(across, axis=1), label=label)
    for number, (name, value) in enumerate(without.items()):
        axes.axhline(value, color=f"C{number + 4}", linestyle="--", label=f"{name}, hidden half ({value:.2f} mm)")
    axes.set(xlabel="frame", ylabel="mean distance, mm", yscale="log")
    axes.legend()
    figure.tight_layout()
    figure.savefig(path, dpi=110)
    plt.close(figure)


def write_page(
    path: Path, title: str, figures: Mapping[str, float], pictures: Mapping[str, Path], without: Mapping[str, float]
) -> None:
    """One page of a specimen."""
    blocks: list[Block] = [KeyFigures({name: f"{value:.4g}" for name, value in figures.items()})]
    blocks += [Picture.read(picture, caption) for caption, picture in pictures.items()]
    if without:
        header = ["without physics, fitted to the seen half", "hidden half, mm"]
        blocks.append(Table([[name, f"{value:.2f}"] for name, value in without.items()], header))
    blocks.append(Text("Truth: image points found by a program that shares no code with the tracker."))
    write_report(path, title, [Section("Measured and predicted", blocks)])
