"""A sink that writes the result of each frame as soon as it is there, for programs that follow a run."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from morph_dslam.errors import TrackingError
from morph_dslam.io.writing import check_no_input, writing
from morph_dslam.tracking.run_folder import RunFolder
from morph_dslam.tracking.run_results import RunResults
from morph_dslam.tracking.sinks import TrackedFrame

#: The first line of a log is read to here at most: of other files it may be the whole file.
_LONGEST_LINE = 1_000_000


def check_frame_log(path: Path, inputs: Sequence[Path]) -> None:
    """Refuse a file that a log would empty though it holds something else.

    Parameters
    ----------
    path : of the log. It may be missing or empty, or hold the log of an earlier run.
    inputs : files that the run reads.

    Raises
    ------
    TrackingError
        If the file is one of the inputs, or holds something else than a log.
    """
    if not path.is_file():  # what is there may be a pipe too
        return
    check_no_input([path], inputs, TrackingError)
    try:
        with path.open("rb") as file:
            first = file.readline(_LONGEST_LINE)
    except OSError as error:
        raise TrackingError(f"cannot write {path}: {error.strerror or error}") from error
    if first and not _is_line_of_log(first):
        raise TrackingError(
            f"the frame log {path} is there and holds something else, which would be gone: name another file, or "
            "delete this one"
        )


def _is_line_of_log(line: bytes) -> bool:
    try:
        content = json.loads(line)
    except ValueError:
        return False
    return isinstance(content, dict) and "frame" in content


class FrameLog:
    """Appends a line of JSON for each frame, and each object, that run folders have taken in (docs/run-folder.md).

    Parameters
    ----------
    path : file to write; what it held is gone with the first frame: `check_frame_log` says whether it may be.
    folders : by the objects' names, whose last frame is written; in a session's sinks they come first. Where they may
        not replace a run, the log of an earlier one is not replaced either: of a run that was killed it may be all that
        is left.

    Raises
    ------
    TrackingError
        If the file cannot be written, or has frames of an earlier run that are not to be replaced.
    """

    def __init__(self, path: Path, folders: Mapping[str, RunFolder]) -> None:
        self._path, self._folders = path, folders
        first = next(iter(folders.values()))
        if not first.overwrite and path.is_file() and path.stat().st_size:
            raise TrackingError(
                f"the frame log {path} holds an earlier run: name another file, move this one, or allow both it and "
                f"{first.path} to be replaced (`--overwrite`)"
            )
        self._is_begun = False
        with writing(TrackingError, path), path.open("a", encoding="utf-8"):  # what is wrong with it is said at once
            pass

    def start_again(self) -> None:
        """Write the frames of another pass in place of those so far."""
        self._is_begun = False

    def __call__(self, tracked: TrackedFrame) -> None:
        """Write the frame that the run folders have just taken in; of several objects each line has the name.

        From the first one on, the file takes the place of that of an earlier run.
        """
        several = len(self._folders) > 1
        lines = [({"object": name} if several else {}) | _line(run.results) for name, run in self._folders.items()]
        mode = "a" if self._is_begun else "w"
        with writing(TrackingError, self._path), self._path.open(mode, encoding="utf-8") as file:
            file.write("".join(json.dumps(line) + "\n" for line in lines))
        self._is_begun = True


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
