"""Folders that results are written to, made before the long work begins."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Literal

from morph_dslam.errors import MorphError, TrackingError

if sys.platform != "win32":
    import fcntl


def check_free(folder: Path, names: Sequence[str], held: str, overwrite: bool, kind: type[MorphError]) -> None:
    """Raise an error of a kind if a folder holds files that are not to be overwritten.

    Parameters
    ----------
    folder : that is written to; it may be missing.
    names : of the files that are written. By the first one an earlier result is known.
    held : what that is, "a run" say.
    overwrite : whether the folder may hold them.
    """
    found = [] if overwrite else [name for name in names if (folder / name).exists()]
    if found:
        what = held if found[0] == names[0] else found[0]
        raise kind(
            f"{folder} holds {what} already: choose another folder, or allow it to be overwritten (`--overwrite`)"
        )


Command = Literal["track", "slam"]
#: What each run writes, by the command; the first one is the file by which such a run is known.
_WRITTEN: dict[Command, tuple[str, ...]] = {
    "track": (
        *("result.h5", "frames.csv", "trajectory.txt", "camera.yaml", "model.morph", "summary.json"),
        *("plots/residual.png", "plots/timings.png"),
    ),
    "slam": (
        *("map.h5", "frames.csv", "trajectory.txt", "map.ply", "summary.json", "colmap"),
        *("plots/trajectory.png", "plots/frames.png"),
    ),
}
#: What not every run and evaluation writes into its folder, or not under the same names, and reports show.
_OF_ONE_RUN: dict[Command, tuple[str, ...]] = {
    "track": (
        *("plots/*.png", "augmented.mp4", "latency.csv", "report.html"),
        *("*evaluation.json", "*evaluation.png", "*error_map.png"),
    ),
    "slam": ("plots/*.png", "report.html", "*evaluation.json", "*evaluation.png"),
}


def holds_run(folder: Path, command: Command) -> bool:
    """Whether a folder has a run of a command."""
    return (folder / _WRITTEN[command][0]).exists()


def make_run_folder(folder: Path, overwrite: bool, command: Command = "track", more: Sequence[str] = ()) -> None:
    """Make a run folder and those above it.

    Parameters
    ----------
    folder : to make.
    overwrite : whether it may hold a run already, and files called as those of a run.
    command : that writes the run.
    more : names of files that this run writes and not every one does, as its video.

    Raises
    ------
    TrackingError
        If it cannot be made, or holds a run of the other command, or one that is not to be overwritten.
    """
    for other in _WRITTEN:
        if other != command and holds_run(folder, other):
            raise TrackingError(
                f"{folder} holds a run of `morph {other}`, whose files would be gone: choose another one"
            )
    check_free(folder, (*_WRITTEN[command], *more), "a run", overwrite, TrackingError)
    _make(folder)


def clear_run_folder(folder: Path, command: Command = "track", more: Sequence[Path] = ()) -> None:
    """Delete pictures and evaluations of the run that is overwritten: they would stand in the report of the new one.

    Where no run is they are somebody's own. What cannot be deleted stays: it may not cost the new results.

    Parameters
    ----------
    folder : of the run.
    command : that writes the new one.
    more : files of the earlier run beside these.
    """
    if holds_run(folder, command):
        for path in (*_of_one_run(folder, command), *more):
            with suppress(OSError):
                path.unlink()


def replaced_files(folder: Path, command: Command = "track") -> list[Path]:
    """What a run writes into a folder, and what it deletes there."""
    return [*(folder / name for name in _WRITTEN[command]), *_of_one_run(folder, command)]


def _of_one_run(folder: Path, command: Command) -> list[Path]:
    return [path for pattern in _OF_ONE_RUN[command] for path in folder.glob(pattern)]


@contextmanager
def only_writer(folder: Path) -> Iterator[None]:
    """Keep other runs out of a run folder, which is made if it is not there, while the context lasts.

    The folder itself is locked, so that no file is left behind and the lock of a process that dies goes with it. On
    Windows, and on drives that know no locks, other runs are not kept out.

    Parameters
    ----------
    folder : of the run.

    Raises
    ------
    TrackingError
        If it cannot be made, or another run is writing to it.
    """
    _make(folder)
    if sys.platform == "win32":
        yield
        return
    opened = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(opened, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(opened)
        raise TrackingError(
            f"another run is writing to {folder}: wait until it ends, or choose another folder"
        ) from None
    except OSError:  # no locks on this drive
        pass
    try:
        yield
    finally:
        with suppress(OSError):
            fcntl.flock(opened, fcntl.LOCK_UN)  # processes forked meanwhile hold the folder open too
        os.close(opened)


def _make(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise TrackingError(f"cannot write the run to {folder}: {error.strerror}") from error
