"""The run that the project holds: its frames, what it is of, and the frame log that a run appends to.

A failed or stopped command may leave a frame log that is not of the run in the folder, so results are read from the
folder. These functions run in the worker process, `FrameLog` and `run_of` beside the server.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import h5py
import numpy as np
from numpy.typing import NDArray

from morph_dslam import ReducedModel, load_model
from morph_dslam.errors import StudioError
from morph_dslam.studio.clicks import opened_model, overlay
from morph_dslam.studio.project import read_once, stamp

#: What `morph live` calls the frames that the studio hands to it.
_LIVE_SOCKET = "camera.sock"
#: Largest difference of two models that are the same, a share of the object's size: a build adds up in any order.
_SAME = 1e-5
#: Frames that are sent to pages at once.
_MOST_FRAMES = 1000
_RESULT, _MODEL, _CAMERA = "result.h5", "model.morph", "camera.yaml"


class FrameLog:
    """Lines of a frame log as they come.

    Parameters
    ----------
    path : of the file, which may not be there yet.
    """

    def __init__(self, path: Path) -> None:
        self._path, self._stamp = path, (0, 0)
        self._offset, self._last = 0, b""

    def new(self) -> list[dict[str, Any]]:
        """Whole lines that came since the last call, in parts: ``frames``, and whether the file begins ``anew``."""
        now = stamp(self._path)
        if now == self._stamp:
            return []
        self._stamp = now
        was_read = self._offset > 0
        try:
            text = self._path.read_bytes() if self._is_another() else self._rest()
        except OSError:
            text, self._offset = b"", 0
        text = text[: text.rfind(b"\n") + 1]
        anew = self._offset == 0 and (was_read or bool(text))
        if not text and not anew:
            return []
        lines = text.splitlines(keepends=True)
        self._offset, self._last = self._offset + len(text), lines[-1] if lines else b""
        frames = _rows(lines)
        parts = [frames[k : k + _MOST_FRAMES] for k in range(0, len(frames), _MOST_FRAMES)] or [[]]
        return [{"anew": anew and k == 0, "frames": part} for k, part in enumerate(parts)]

    def _is_another(self) -> bool:
        """Whether the file no longer holds what was read of it last; it is then read from its beginning."""
        with self._path.open("rb") as file:
            file.seek(self._offset - len(self._last))
            is_another = file.read(len(self._last)) != self._last
        if is_another:
            self._offset, self._last = 0, b""
        return is_another

    def _rest(self) -> bytes:
        with self._path.open("rb") as file:
            file.seek(self._offset)
            return file.read()


def _rows(lines: Iterable[bytes]) -> list[dict[str, Any]]:
    """The frames of lines of a frame log; lines that are damaged have none."""
    rows = []
    for line in lines:
        with suppress(ValueError, RecursionError):
            row = json.loads(line)
            if isinstance(row, dict) and "frame" in row:
                rows.append(row)
    return rows


def logged_frames(log: Path) -> list[dict[str, Any]]:
    """The frames of a frame log, none where there is no log."""
    return _rows(log.read_bytes().splitlines()) if log.is_file() else []


def log_overlay(log: Path, model: Path, camera: Path, frame: int) -> bytes:
    """The model over a frame of a frame log; see `overlay`.

    Raises
    ------
    StudioError
        If the object was not tracked in the frame.
    """
    # The others of a long log would take seconds to be read.
    named = re.compile(rb'"frame": *%d\b' % frame)
    lines = log.read_bytes().splitlines() if log.is_file() else []
    rows = _rows(line for line in lines if named.search(line))
    return _row_overlay(model, camera, next((row for row in rows if row["frame"] == frame), None), frame)


def clear_broken_log(path: Path) -> None:
    """Take away a frame log whose first line is cut short: commands write over nothing that is not a log for sure."""
    try:
        with path.open("rb") as file:
            first = file.readline()
        json.loads(first)
    except OSError:
        return
    except ValueError:
        path.unlink(missing_ok=True)


def run_of(run: Path, live: str) -> str | None:
    """Name of the recording that a run folder is of, by its summary; None if there is no run, or it does not say.

    Parameters
    ----------
    run : folder.
    live : name of the folder of live frames.
    """
    try:
        frames = json.loads((run / "summary.json").read_text(encoding="utf-8"))["inputs"]["frames"]
        name = Path(frames).name
    except (OSError, ValueError, TypeError, LookupError, RecursionError):
        return None
    return live if name == _LIVE_SOCKET else name


def run_summary(run: Path) -> dict[str, Any] | None:
    """The summary of a run; None if there is no run."""
    path = run / "summary.json"
    if not path.is_file():
        return None
    content = json.loads(path.read_text(encoding="utf-8"))
    if not isinstance(content, dict):
        raise StudioError("run/summary.json holds no summary: track again")
    return content


def run_frames(run: Path) -> list[dict[str, Any]] | None:
    """The frames of a run as its frame log has them; None if the folder holds no results.

    Raises
    ------
    StudioError
        If the results cannot be read.
    """
    return list(_frames_of(run).values()) if (run / _RESULT).is_file() else None


def _frames_of(run: Path) -> dict[int, dict[str, Any]]:
    return _frames(run / _RESULT, run / "summary.json")


@read_once(1)
def _frames(result: Path, summary: Path) -> dict[int, dict[str, Any]]:
    """Frames by number, of the results that were written with a summary."""
    run = result.parent
    try:
        names = [parameter.name for parameter in opened_model(run / _MODEL).study_parameters]
        with h5py.File(result) as file:
            columns = _columns(file, names)
    except (OSError, KeyError, ValueError, RuntimeError) as error:
        raise StudioError(f"the results in {run.name} are damaged or cut short: track again") from error
    rows = (dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True))
    return {row["frame"]: row for row in rows}


def _columns(file: h5py.File, names: list[str]) -> dict[str, list[Any]]:
    """What a frame log has of each frame, by its key there."""

    def array(name: str) -> NDArray:
        return np.asarray(file[name])

    def texts(name: str) -> list[str]:
        return [value.decode(errors="replace") for value in array(name)]

    numbers = array("frame").tolist()
    unknown = [None] * len(numbers)
    columns = {"frame": numbers, "timestamp": array("timestamp").tolist()}
    columns |= {"status": texts("status"), "reason": texts("reason")}
    for name in ("parameters", "parameter_std"):
        columns[name] = [dict(zip(names, map(_number, row), strict=False)) for row in array(name)]
    columns["camera_from_object"] = [
        one.tolist() if np.isfinite(one).all() else None for one in array("camera_from_object")
    ]
    for name in ("largest_displacement", "largest_von_mises", "residual_rms_px"):
        columns[name] = [_number(value) for value in array(name)] if name in file else unknown
    supports = list(file["reactions"]) if "reactions" in file else []  # type: ignore[arg-type]
    forces = {unquote(name): array(f"reactions/{name}/force") for name in supports}
    columns["forces"] = [
        {name: force[k].tolist() if np.isfinite(force[k]).all() else None for name, force in forces.items()}
        for k in range(len(numbers))
    ]
    return columns


def _number(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def run_overlay(run: Path, model: Path, camera: Path, frame: int) -> bytes:
    """The model over a frame of a run, by the camera that the run knew; see `overlay`.

    Raises
    ------
    StudioError
        If the object was not tracked in the frame.
    """
    own = run / _CAMERA
    return _row_overlay(model, own if own.is_file() else camera, _frames_of(run).get(frame), frame)


def _row_overlay(model: Path, camera: Path, row: dict[str, Any] | None, frame: int) -> bytes:
    """The model over a frame, by its row of a frame log."""
    if row is None or row["camera_from_object"] is None or None in row["parameters"].values():
        raise StudioError(f"the object was not tracked in frame {frame}")
    return overlay(model, camera, list(row["parameters"].values()), row["camera_from_object"])


def is_of_model(run: Path, model: Path) -> bool:
    """Whether a run is of a model: the shape, the parameters and what they do are those of the run's own copy."""
    own = run / _MODEL
    if not own.is_file() or not model.is_file():
        return True
    return _are_same(own, model)


@read_once(4)
def _are_same(first: Path, second: Path) -> bool:
    one, other = load_model(first), opened_model(second)
    if one.nodes.shape != other.nodes.shape or not np.array_equal(one.triangles, other.triangles):
        return False
    ranges = [[(p.name, p.unit, p.lower, p.upper) for p in model.study_parameters] for model in (one, other)]
    if ranges[0] != ranges[1] or not _are_near(one.nodes, other.nodes, one):
        return False
    lower, upper = np.array([p.lower for p in one.study_parameters]), np.array([p.upper for p in one.study_parameters])
    states = (lower + share * (upper - lower) for share in (0.0, 0.3, 1.0))
    return all(_are_near(one.displacement.value(mu), other.displacement.value(mu), one) for mu in states)


def _are_near(one: NDArray, other: NDArray, model: ReducedModel) -> bool:
    return bool(np.abs(one - other).max(initial=0.0) <= _SAME * np.ptp(model.nodes, axis=0).max())
