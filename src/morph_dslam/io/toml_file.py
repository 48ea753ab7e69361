"""TOML files that users write, with the errors that reading one can meet."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

from morph_dslam.errors import MorphError


def read_toml(path: Path, what: str, error_class: type[MorphError]) -> dict[str, Any]:
    """The content of a TOML file.

    Parameters
    ----------
    what : what the file is, for the message: "study file" say.

    Raises
    ------
    error_class
        If the file cannot be read or is not TOML.
    """
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise error_class(f"cannot read the {what} {path}: {error.strerror}") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise error_class(f"{path} is not a TOML file: {error}") from error
