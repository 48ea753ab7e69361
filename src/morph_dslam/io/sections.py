"""Sections of files that users write, as pydantic models; what is wrong with a file, in its own words.

A message names a key as it stands in the file, and counts sections and entries of lists from 1.
"""

from __future__ import annotations

import types
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from math import isfinite
from pathlib import Path
from typing import Any, TypeVar, get_args, get_origin

from pydantic import BaseModel, ConfigDict, ValidationError

from morph_dslam.errors import MorphError
from morph_dslam.io.text import read_toml


class Section(BaseModel):
    """A part of a file; unknown keys are mistakes."""

    model_config = ConfigDict(extra="forbid")


AnySection = TypeVar("AnySection", bound=Section)
#: What a value must be, by the types of pydantic's errors.
_EXPECTED = {
    "string_type": "a text in quotes",
    "path_type": "a text in quotes",
    "float_type": "a number",
    "float_parsing": "a number",
    "finite_number": "a finite number",
    "int_type": "a whole number",
    "int_parsing": "a whole number",
    "int_parsing_size": "a whole number",
    "int_from_float": "a whole number",
    "bool_type": "true or false",
    "bool_parsing": "true or false",
    "list_type": "a list",
    "tuple_type": "a list",
    "dict_type": "a table",
    "model_type": "a table",
    "model_attributes_type": "a table",
    "literal_error": "{expected}",
    "greater_than": "greater than {gt:.15g}",
    "greater_than_equal": "at least {ge:.15g}",
    "less_than": "less than {lt:.15g}",
    "less_than_equal": "at most {le:.15g}",
    "none_required": "left out",
}
#: Characters of a value that a message shows.
_SHOWN = 60


def read_sections(path: Path, what: str, kind: type[AnySection], error_class: type[MorphError]) -> AnySection:
    """Read a TOML file whose content is of this kind; other parameters as of `read_text`."""
    content = read_toml(path, what, error_class)
    try:
        return kind.model_validate(content)
    except ValidationError as error:
        raise error_class(f"{path}: {explain(kind, error, content)}") from error


def explain(kind: type[BaseModel], error: ValidationError, content: Mapping[Any, Any]) -> str:
    """All that is wrong with the content of a file of this kind, each thing once."""
    entries: dict[tuple[int | str, ...], list[Any]] = {}
    places: dict[tuple[int | str, ...], _Place] = {}
    for entry in error.errors():
        place = _place(kind, entry["loc"])
        places[place.keys] = place
        entries.setdefault(place.keys, []).append(entry)
    # Of a value that may be one of several things pydantic says for each why it is not that one. The one of which only
    # a part is wrong was meant.
    meant = [keys for keys in entries if not any(keys == other[: len(keys)] != other for other in entries)]
    said = [sentence for keys in meant for sentence in _explain(places[keys], entries[keys], content)]
    return "; ".join(dict.fromkeys(said))


@dataclass(frozen=True)
class _Place:
    """Where a mistake is.

    Attributes
    ----------
    keys : of the file, without pydantic's tags.
    listed : which sections of lists it is in, "support 1: ", or empty.
    key : the rest, "mesh.size, entry 3", or empty.
    section : that of the last key.
    kinds : sections that may stand here, by their tags.
    """

    keys: tuple[int | str, ...]
    listed: str
    key: str
    section: type[BaseModel]
    kinds: Mapping[str, type[BaseModel]]

    @property
    def text(self) -> str:
        """For people."""
        return self.listed + self.key if self.key else self.listed.removesuffix(": ")


def _place(section: type[BaseModel], location: Sequence[int | str]) -> _Place:
    """The place that a pydantic error's location means.

    Pydantic puts a tag in between where a section is one of several kinds, or a value one of several types.
    """
    keys: list[int | str] = []
    listed, words = "", []
    kinds: dict[str, type[BaseModel]] = {}
    in_value = is_name = False
    for part in location:
        if isinstance(part, int):
            keys.append(part)
            if kinds:
                listed += f"{'.'.join(words).removesuffix('s')} {part + 1}: "
                words = []
            else:
                words[-1:] = [f"{''.join(words[-1:])}, entry {part + 1}"]
        elif is_name:
            keys.append(part)
            words.append(part)
            is_name = False
        elif len(kinds) > 1 and part in kinds:
            section, kinds = kinds[part], {}
        elif not in_value:
            keys.append(part)
            words.append(part)
            if part in section.model_fields:
                annotation = section.model_fields[part].annotation
                kinds = sections_of(annotation)
                section = next(iter(kinds.values()), section)
                in_value, is_name = not kinds, get_origin(annotation) is dict
    return _Place(tuple(keys), listed, ".".join(words), section, kinds)


def _explain(place: _Place, entries: list[Any], content: Any) -> list[str]:
    """What is wrong in one place; several of pydantic's errors where a value may be one of several things."""
    value = _value(content, place.keys, entries[0]["input"])
    expected = [entry for entry in entries if entry["type"] in _EXPECTED]
    said = [_must_be(place, value, expected)] if expected else []
    return said + [_other(place, value, entry) for entry in entries if entry["type"] not in _EXPECTED]


def _must_be(place: _Place, value: Any, entries: list[Any]) -> str:
    wanted = " or ".join(dict.fromkeys(_EXPECTED[entry["type"]].format(**entry.get("ctx", {})) for entry in entries))
    if isinstance(value, float) and not isfinite(value):
        wanted = "a finite number"
    if isinstance(value, Mapping):
        advice = f": write [[{place.key}]]" if place.kinds and "a list" in wanted else ""
        return f"{place.text} must be {wanted}, not a table{advice}"
    numbers = {"float_parsing", "int_parsing"}.intersection(entry["type"] for entry in entries)
    advice = ", with a point in place of the comma" if numbers and isinstance(value, str) and "," in value else ""
    return f"{place.text}: {_shown(value)} must be {wanted}{advice}"


def _other(place: _Place, value: Any, entry: Any) -> str:
    match entry["type"]:
        case "extra_forbidden":
            return f"{place.listed}unknown key {place.key}; known here: {', '.join(place.section.model_fields)}"
        case "missing":
            return f"{place.text} is missing"
        case "too_short":
            return f"{place.text} has {len(value)} entries, and must have at least {entry['ctx']['min_length']}"
        case "too_long":
            return f"{place.text} has {len(value)} entries, and must have at most {entry['ctx']['max_length']}"
        case "union_tag_not_found" | "union_tag_invalid":
            return _of_no_kind(place, value)
    message = entry["msg"].removeprefix("Value error, ")
    return f"{place.text}: {message}" if place.text else message


def _of_no_kind(place: _Place, value: Mapping[str, Any]) -> str:
    key = next(name for name in _TAGS if any(name in kind.model_fields for kind in place.kinds.values()))
    known = [tag for tag, kind in place.kinds.items() if key in kind.model_fields]
    if key not in value:
        quoted = [f'"{tag}"' for tag in known]
        return f"{place.text} has no {key}: write {key} = {', '.join(quoted[:-1])} or {quoted[-1]}"
    close = get_close_matches(str(value[key]), known, 1)
    advice = f" (did you mean '{close[0]}'?)" if close else ""
    return f"{place.text}: {_shown(value[key])} is not a known {key}{advice}; known are {', '.join(known)}"


def _value(content: Any, keys: Sequence[int | str], otherwise: Any) -> Any:
    """What the file has under these keys: pydantic has a value in SI where the file has one with its unit."""
    for key in keys:
        try:
            content = content[key]
        except (LookupError, TypeError):
            return otherwise
    return content


def _shown(value: Any) -> str:
    text = str(value).lower() if isinstance(value, bool) else repr(value)
    return text if len(text) <= _SHOWN else text[:_SHOWN] + "..."


#: Keys that say of which kind a section is.
_TAGS = ("kind", "generator")


def sections_of(annotation: Any) -> dict[str, type[BaseModel]]:
    """The sections that an annotation allows, by the tag of their kind."""
    found: dict[str, type[BaseModel]] = {}
    pending = [annotation]
    while pending:
        item = pending.pop(0)
        if isinstance(item, type) and not isinstance(item, types.GenericAlias) and issubclass(item, BaseModel):
            tag = next((item.model_fields[key] for key in _TAGS if key in item.model_fields), None)
            found[get_args(tag.annotation)[0] if tag else "file"] = item
        pending += get_args(item)
    return found
