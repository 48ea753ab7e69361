"""Folders that results are written to, made before the long work begins."""

from __future__ import annotations

from pathlib import Path

from morph_dslam.errors import TrackingError


def make_run_folder(folder: Path, overwrite: bool, sign: str = "result.h5") -> None:
    """Make a run folder and those above it; evaluations of a run that is to be overwritten are deleted.

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
    if (folder / sign).exists() and not overwrite:
        raise TrackingError(
            f"{folder} holds a run already: choose another folder, or allow it to be overwritten (`--overwrite`)"
        )
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise TrackingError(f"cannot write the run to {folder}: {error.strerror}") from error
    # They would stand in the report of the new run.
    for old in folder.glob("*evaluation.json"):
        old.unlink()
