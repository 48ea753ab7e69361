"""Reading study files: which kind of study a file describes, and what is wrong with it.

A file with a [sheet] is a sheet in two grips, one with a [shell] a shell, one with [external] names solutions of
another program, and every other one is a solid.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from morph_dslam.errors import StudyError
from morph_dslam.io.sections import explain
from morph_dslam.io.text import read_toml
from morph_dslam.studies.external import ExternalStudy
from morph_dslam.studies.sheet_study import SheetStudy
from morph_dslam.studies.shell_study import ShellStudy
from morph_dslam.studies.solid_study import SolidStudy

Study = SheetStudy | ShellStudy | SolidStudy | ExternalStudy


def load_study(path: str | Path) -> Study:
    """Read a study file; paths in it are relative to it.

    Raises
    ------
    StudyError
        If it is missing, is not TOML, has an unknown or missing key, or a value that cannot be.
    """
    path = Path(path)
    return make_study(read_toml(path, "study file", StudyError), path.parent, str(path))


def make_study(content: Mapping[str, Any], folder: str | Path = Path(), where: str = "the study") -> Study:
    """A study from the content of a study file.

    Parameters
    ----------
    content : sections and keys as in a study file.
    folder : what paths in it are relative to.
    where : what messages call it.

    Raises
    ------
    StudyError
        As `load_study`.
    """
    kind = _kind(content)
    try:
        return kind.model_validate(dict(content), context={"folder": Path(folder)})
    except ValidationError as error:
        raise StudyError(f"{where}: {explain(kind, error, content)}") from error


def _kind(content: Mapping[str, Any]) -> type[Study]:
    kinds: dict[str, type[Study]] = {"external": ExternalStudy, "sheet": SheetStudy, "shell": ShellStudy}
    return next((kind for section, kind in kinds.items() if section in content), SolidStudy)
