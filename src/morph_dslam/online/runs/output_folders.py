"""The folders that runs and registrations are written to, made before the long work begins."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

from morph_dslam.errors import MorphError, RegistrationError, TrackingError


def make_folder(folder: Path, what: str, error_class: type[MorphError]) -> None:
    """Make a folder and those above it, unless it is there.

    Parameters
    ----------
    what : is to be written there, for the message: "the registration" say.

    Raises
    ------
    error_class
        If it cannot be made.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise error_class(f"cannot write {what} to {folder}: {error.strerror}") from error


def check_run_folder(folder: Path, overwrite: bool, sign: str = "result.h5") -> None:
    """Make the run folder.

    Parameters
    ----------
    sign : the file by which a run that is there already is known.

    Raises
    ------
    TrackingError
        If it cannot be made, or holds a run already that is not to be overwritten.
    """
    if (folder / sign).exists() and not overwrite:
        raise TrackingError(
            f"{folder} holds a run already: choose another folder, or allow it to be overwritten "
            "(`--overwrite`)"
        )
    make_folder(folder, "the run", TrackingError)


def write_registration(
    folder: Path, content: dict[str, Any], map_path: Path, model_path: Path
) -> dict[str, Any]:
    """Write ``registration.json``, which names map and model relative to it, into a folder that is there.

    Returns
    -------
    What was written: ``content``, and the names.

    Raises
    ------
    RegistrationError
        If it cannot be written.
    """
    content = content | {
        "map": os.path.relpath(map_path, folder),
        "model": os.path.relpath(model_path, folder),
    }
    try:
        (folder / "registration.json").write_text(json.dumps(content, indent=2) + "\n")
    except OSError as error:
        raise RegistrationError(f"cannot write the registration to {folder}: {error.strerror}") from error
    return content
