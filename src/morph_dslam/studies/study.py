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
from morph_dslam.io.text import read_toml
from morph_dslam.studies.external import ExternalStudy
from morph_dslam.studies.sheet_study import SheetStudy
from morph_dslam.studies.solid_study import SolidStudy

Study = SheetStudy | SolidStudy | ExternalStudy


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
        explained = dict.fromkeys(_explain(kind, entry) for entry in error.errors())
        raise StudyError(f"{where}: " + "; ".join(explained)) from error


def _kind(content: Mapping[str, Any]) -> type[Study]:
    if "external" in content:
        return ExternalStudy
    return SheetStudy if "sheet" in content else SolidStudy


def _explain(kind: type[BaseModel], entry: Any) -> str:
    location, section = _without_tags(kind, entry["loc"])
    where = ".".join(str(part) for part in location) or "study"
    if entry["type"] == "extra_forbidden":
        return f"unknown key {where}; known here: {', '.join(section.model_fields)}"
    if entry["type"] == "missing":
        return f"{where} is missing"
    return f"{where}: {entry['msg'].removeprefix('Value error, ')}"


def _without_tags(section: type[BaseModel], location: tuple[int | str, ...]) -> tuple[list[int | str], type[BaseModel]]:
    """The keys of a pydantic error's location as they stand in the file, and the section of the last one.

    Where a section is one of several kinds, pydantic puts the tag of its kind in between.
    """
    keys: list[int | str] = []
    kinds: dict[str, type[BaseModel]] = {}
    for position, part in enumerate(location):
        if part in kinds:
            section, kinds = kinds[str(part)], {}
            continue
        keys.append(part)
        if isinstance(part, str) and part in section.model_fields and position < len(location) - 1:
            kinds = sections_of(section.model_fields[part].annotation)
            section = next(iter(kinds.values()), section)
    return keys, section


def sections_of(annotation: Any) -> dict[str, type[BaseModel]]:
    """The sections that an annotation allows, by the tag of their kind."""
    found: dict[str, type[BaseModel]] = {}
    pending = [annotation]
    while pending:
        item = pending.pop(0)
        if isinstance(item, type) and not isinstance(item, types.GenericAlias) and issubclass(item, BaseModel):
            tag = item.model_fields.get("kind") or item.model_fields.get("generator")
            found[get_args(tag.annotation)[0] if tag else "file"] = item
        pending += get_args(item)
    return found
