"""A sink that writes the result of each frame as soon as it is there, for programs that follow a run."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from morph_dslam.errors import TrackingError
from morph_dslam.tracking.run_folder import RunFolder
from morph_dslam.tracking.run_results import RunResults
from morph_dslam.tracking.sinks import TrackedFrame


class FrameLog:
    """Appends a line of JSON for each frame that a run folder has taken in (docs/run-folder.md).

    Parameters
    ----------
    path : file to write; what it held is gone.
    folder : whose last frame is written; in a session's sinks it comes first.

    Raises
    ------
    TrackingError
        If the file cannot be written.
    """

    def __init__(self, path: Path, folder: RunFolder) -> None:
        self._path, self._folder = path, folder
        self.start_again()

    def start_again(self) -> None:
        """Empty the file, for another pass over the frames."""
        try:
            self._path.write_text("")
        except OSError as error:
            raise TrackingError(f"cannot write {self._path}: {error.strerror or error}") from error

    def __call__(self, tracked: TrackedFrame) -> None:
        """Write the frame that the run folder has just taken in."""
        with self._path.open("a") as file:
            file.write(json.dumps(_line(self._folder.results)) + "\n")


def _line(run: RunResults) -> dict[str, Any]:
    """What is known of the last frame, in SI units; None for what is not known."""
    result = run.results[-1]
    displacement, stress = run.last_largest()
    return {
        "frame": run.frames[-1],
        "timestamp": run.timestamps[-1],
        "status": result.status.value,
        "reason": result.reason,
        "parameters": {name: _number(value) for name, value in result.parameters.items()},
        "parameter_std": {name: _number(value) for name, value in result.parameter_std.items()},
        "camera_from_object": None if result.pose is None else result.pose.matrix.tolist(),
        "largest_displacement": _number(displacement),
        "largest_von_mises": _number(stress),
        "residual_rms_px": _number(result.residual_rms_px),
        "forces": {
            name: None if one is None else one.force.value.tolist() for name, one in run.last_reactions().items()
        },
    }


def _number(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
