"""Reading study files: which kind of study a file describes, and what is wrong with it.

A file with a [sheet] is a sheet in two grips, one with [external] names solutions of another program, and
every other one is a solid.
"""

from __future__ import annotations

import types
from collections.abc import Mapping
from pathlib import Path
from typing import Any, get_args

from pydantic import BaseModel, ValidationError

from morph_dslam.errors import StudyError
from morph_dslam.io.toml_file import read_toml
from morph_dslam.offline.external import ExternalStudy
from morph_dslam.offline.sheet_study import SheetStudy
from morph_dslam.offline.solid_study import SolidStudy

Study = SheetStudy | SolidStudy | ExternalStudy


def load_study(path: Path) -> Study:
    """Read a study file; paths in it are relative to it.

    Raises
    ------
    StudyError
        If it is missing, is not TOML, has an unknown or missing key, or a value that cannot be.
    """
    return make_study(read_toml(path, "study file", StudyError), path.parent, str(path))


def make_study(content: Mapping[str, Any], folder: Path = Path(), where: str = "the study") -> Study:
    """A study from the content of a study file.

    Parameters
    ----------
    content : sections and keys as in a study file. folder : what paths in it are relative to.
    where : what messages call it.

    Raises
    ------
    StudyError
        As `load_study`.
    """
    kind = _kind(content)
    try:
        return kind.model_validate(dict(content), context={"folder": folder})
    except ValidationError as error:
        explained = dict.fromkeys(_explain(kind, entry) for entry in error.errors())
        raise StudyError(f"{where}: " + "; ".join(explained)) from error


def _kind(content: Mapping[str, Any]) -> type[Study]:
    if "external" in content:
        return ExternalStudy
    return SheetStudy if "sheet" in content else SolidStudy


def _explain(kind: type[BaseModel], entry: Any) -> str:
    where = ".".join(str(part) for part in entry["loc"]) or "study"
    if entry["type"] == "extra_forbidden":
        return f"unknown key {where}; known here: {', '.join(_section_at(kind, entry['loc']).model_fields)}"
    if entry["type"] == "missing":
        return f"{where} is missing"
    return f"{where}: {entry['msg'].removeprefix('Value error, ')}"


def _section_at(section: type[BaseModel], location: tuple[int | str, ...]) -> type[BaseModel]:
    """The section in which the last key of a pydantic error ``location`` was written."""
    for part in location[:-1]:
        if isinstance(part, str) and part in section.model_fields:
            pending = [section.model_fields[part].annotation]
            while pending:
                annotation = pending.pop()
                if isinstance(annotation, type) and not isinstance(annotation, types.GenericAlias):
                    section = annotation if issubclass(annotation, BaseModel) else section
                pending.extend(get_args(annotation))
    return section
