"""Sections of files that users write, as pydantic models; what is wrong with a file, in its own words."""

from __future__ import annotations

import types
from pathlib import Path
from typing import Any, TypeVar, get_args

from pydantic import BaseModel, ConfigDict, ValidationError

from morph_dslam.errors import MorphError
from morph_dslam.io.text import read_toml


class Section(BaseModel):
    """A part of a file; unknown keys are mistakes."""

    model_config = ConfigDict(extra="forbid")


AnySection = TypeVar("AnySection", bound=Section)


def read_sections(path: Path, what: str, kind: type[AnySection], error_class: type[MorphError]) -> AnySection:
    """Read a TOML file whose content is of this kind; other parameters as of `read_text`."""
    try:
        return kind.model_validate(read_toml(path, what, error_class))
    except ValidationError as error:
        raise error_class(f"{path}: {explain(kind, error)}") from error


def explain(kind: type[BaseModel], error: ValidationError) -> str:
    """All that is wrong with a file of this kind, each thing once."""
    return "; ".join(dict.fromkeys(_explain(kind, entry) for entry in error.errors()))


def _explain(kind: type[BaseModel], entry: Any) -> str:
    location, section = _without_tags(kind, entry["loc"])
    where = ".".join(str(part) for part in location)
    if entry["type"] == "extra_forbidden":
        return f"unknown key {where}; known here: {', '.join(section.model_fields)}"
    if entry["type"] == "missing":
        return f"{where} is missing"
    message = entry["msg"].removeprefix("Value error, ")
    return f"{where}: {message}" if where else message


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
