"""The report of a run: figures, plots, a few augmented frames, and the model it used."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from morph_dslam.errors import EvaluationError
from morph_dslam.evaluation.model_summary import flatten, summarise_model
from morph_dslam.evaluation.report import Link, Picture, Section, Table, Text, write_report
from morph_dslam.evaluation.run_folder import Run
from morph_dslam.evaluation.statements import remarks
from morph_dslam.sources.capture import open_capture

VIDEO = "augmented.mp4"
N_FRAMES_SHOWN = 4

#: Keys of ``summary.json`` that the figures of the evaluation repeat.
_SHOWN_ABOVE = ("model", "n_frames", "n_tracked", "median_ms", "p95_ms")

_CAPTIONS = {
    "evaluation.png": "Material error over the points of each frame with truth.",
    "error_map.png": "Mean material error where each point lies on the undeformed object.",
}


def sample_video(path: Path, count: int) -> list[tuple[int, bytes]]:
    """Up to ``count`` frames spread over a video, as (0-based position, JPEG); none if it cannot be read."""
    capture = open_capture(str(path))
    total = int(capture.get(cv2.CAP_PROP_FRAME_COUNT))
    wanted = (
        set(np.linspace(0, total - 1, count + 2).round().astype(int)[1:-1].tolist()) if total > 0 else set()
    )
    pictures = []
    # Seeking is not exact in every container; reading on is.
    for position in range(max(wanted, default=-1) + 1):
        read, image = capture.read()
        if not read:
            break
        if position in wanted:
            pictures.append(
                (position, cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 88])[1].tobytes())
            )
    capture.release()
    return pictures


def _error_section(run: Run, figures: Mapping[str, Any]) -> Section:
    rows = {
        "mean": f"{figures['mean_mm']:.3f} mm",
        "median": f"{figures['median_mm']:.3f} mm",
        "95th percentile": f"{figures['p95_mm']:.3f} mm",
        "largest": f"{figures['max_mm']:.3f} mm",
        "mean along the sight line": f"{figures['mean_along_sight_mm']:.3f} mm",
        "mean across the sight line": f"{figures['mean_across_sight_mm']:.3f} mm",
        "mean after one rigid motion of the truth": f"{figures['after_one_rigid_motion']['mean_mm']:.3f} mm",
        "mean after one in each frame": f"{figures['after_one_in_each_frame']['mean_mm']:.3f} mm",
        "points compared": f"{figures['n_points_bound']} of {figures['n_points']}",
        "frames compared": f"{len(figures['frames_compared'])}, bound in frame {figures['bind_frame']}",
        "frames tracked": f"{figures['n_frames_tracked']} of {figures['n_frames']}",
        "time a frame": f"median {figures['median_ms']:.2f} ms, 95th percentile {figures['p95_ms']:.2f} ms",
    }
    notes = [Text(remark, warning=True) for remark in remarks(figures)]
    plots = [Picture.read(run.folder / name, caption) for name, caption in _CAPTIONS.items()]
    return Section("Material error, without alignment", [Table.of(rows), *notes, *plots])


def _video_section(run: Run) -> Section:
    if not (run.folder / VIDEO).is_file():
        return Section("Augmented video", [])
    frames = [
        Picture(data, ".jpg", f"Frame {run.frames[min(position, len(run.frames) - 1)]}")
        for position, data in sample_video(run.folder / VIDEO, N_FRAMES_SHOWN)
    ]
    return Section("Augmented video", [Link(VIDEO, f"The whole video ({VIDEO})"), *frames])


def _lost_section(run: Run) -> Section:
    lost = np.flatnonzero(~run.tracked)
    rows = [(str(run.frames[row]), run.status[row], run.reasons[row]) for row in lost]
    return Section(
        "Frames that were not tracked", [Table(rows, ("frame", "status", "reason"))] if rows else []
    )


def _summary(path: Path) -> dict[str, Any]:
    """The content of a run's summary, none where there is no file; raises EvaluationError if damaged."""
    if not path.is_file():
        return {}
    try:
        content = json.loads(path.read_text())
    except ValueError as error:
        raise EvaluationError(f"{path} is damaged ({error}): restore it, or track again") from error
    if not isinstance(content, dict):
        raise EvaluationError(f"{path} is not the summary of a run: restore it, or track again")
    return content


def _tracking_sections(run: Run) -> list[Section]:
    summary = _summary(run.folder / "summary.json")
    flags = [Text(str(flag), warning=True) for flag in summary.pop("flags", [])]
    background = {key: summary.pop(key) for key in ("inputs", "settings", "versions") if key in summary}
    facts = flatten({key: value for key, value in summary.items() if key not in _SHOWN_ABOVE})
    plots = [Picture.read(plot, plot.stem) for plot in sorted((run.folder / "plots").glob("*.png"))]
    return [
        Section("Tracking", [*flags, *([Table.of(facts)] if facts else []), *plots]),
        Section("Settings and versions", [Table.of(flatten(background))] if background else []),
    ]


def write_run_report(run: Run, figures: Mapping[str, Any]) -> Path:
    """Write ``report.html`` into a run folder; ``figures`` are those of ``evaluation.json``.

    Raises
    ------
    EvaluationError
        If the run's summary is damaged.
    """
    tracking, settings = _tracking_sections(run)
    sections = [
        _error_section(run, figures),
        _video_section(run),
        _lost_section(run),
        tracking,
        *(Section(f"Model: {name}", [table]) for name, table in summarise_model(run.model).items()),
        settings,
    ]
    path = run.folder / "report.html"
    write_report(path, f"{run.model.name}: tracked in {len(run.frames)} frames", sections)
    return path
