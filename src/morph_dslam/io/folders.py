"""Folders that results are written to, made before the long work begins."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from morph_dslam.errors import MorphError, TrackingError

if sys.platform != "win32":
    import fcntl


def check_free(sign: Path, held: str, overwrite: bool, kind: type[MorphError]) -> None:
    """Raise an error of a kind if a folder holds an earlier result that is not to be overwritten.

    Parameters
    ----------
    sign : the file in the folder by which such a result is known.
    held : what it is, "a run" say.
    overwrite : whether the folder may hold it.
    """
    if sign.exists() and not overwrite:
        raise kind(
            f"{sign.parent} holds {held} already: choose another folder, or allow it to be overwritten (`--overwrite`)"
        )


#: What not every run and evaluation writes into its folder, or not under the same names, and reports show.
_OF_ONE_RUN = (
    *("plots/*.png", "augmented.mp4", "latency.csv", "report.html"),
    *("*evaluation.json", "*evaluation.png", "*error_map.png"),
)


def make_run_folder(folder: Path, overwrite: bool, sign: str = "result.h5") -> None:
    """Make a run folder and those above it.

    Parameters
    ----------
    folder : to make.
    overwrite : whether it may hold a run already.
    sign : the file by which a run that is there already is known.

    Raises
    ------
    TrackingError
        If it cannot be made, or holds a run already that is not to be overwritten.
    """
    check_free(folder / sign, "a run", overwrite, TrackingError)
    _make(folder)


def clear_run_folder(folder: Path) -> None:
    """Delete pictures and evaluations of the run that is overwritten: they would stand in the report of the new one."""
    for old in (path for pattern in _OF_ONE_RUN for path in folder.glob(pattern)):
        old.unlink()


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
