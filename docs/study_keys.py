"""All keys of study files as Markdown, from the models that read them."""

from __future__ import annotations

import inspect
import json
import re
from collections.abc import Collection
from math import pi
from pathlib import Path
from types import NoneType
from typing import Any, Literal, Union, get_args, get_origin

from pydantic import BaseModel
from pydantic.fields import FieldInfo

from morph_dslam.io.sections import sections_of
from morph_dslam.studies.study import ExternalStudy, SheetStudy, ShellStudy, SolidStudy

#: Kinds of studies with their headings.
_STUDIES = {
    "Solid": SolidStudy,
    "Shell": ShellStudy,
    "Sheet in two grips": SheetStudy,
    "Solutions of another program": ExternalStudy,
}
#: Keys of sections that several kinds of studies share, and this one refuses.
_REFUSED = {ShellStudy: {("supports", "first"), ("loads", "first")}}


def study_reference() -> str:
    """A Markdown page: for each kind of study its sections, what they mean, and a table of their keys."""
    lines: list[str] = []
    for title, study in _STUDIES.items():
        top = {name: field for name, field in study.model_fields.items() if not sections_of(field.annotation)}
        lines += [f"## {title}", "", _text(study), "", *_table(top), ""]
        for name, field in study.model_fields.items():
            for tag, section in sections_of(field.annotation).items():
                refused = {key for at, key in _REFUSED.get(study, ()) if at == name}
                lines += _section(name, field, section, tag, refused)
    return "\n".join(lines).rstrip() + "\n"


def _section(
    name: str, field: FieldInfo, section: type[BaseModel], tag: str, refused: Collection[str] = ()
) -> list[str]:
    """Heading, text and table of one section but for keys that are refused; nested sections follow it."""
    origin = get_origin(field.annotation)
    heading = f"[[{name}]]" if origin is tuple else f"[{name}.NAME]" if origin is dict else f"[{name}]"
    kind = next((key for key in ("kind", "generator") if key in section.model_fields), None)
    heading += f" {kind} = {tag}" if kind else ""
    fields = {key: field for key, field in section.model_fields.items() if key not in refused}
    lines = [f"### `{heading}`", "", _text(section), "", *_table(fields), ""]
    for key, nested in fields.items():
        for inner, part in sections_of(nested.annotation).items():
            lines += _section(f"{name}.{key}", nested, part, inner)
    return lines


def _text(section: type[BaseModel]) -> str:
    return re.sub(r"``(.*?)``", r"`\1`", inspect.cleandoc(section.__doc__ or ""))


def _table(fields: dict[str, FieldInfo]) -> list[str]:
    rows = [
        f"| `{name}` | {_type(field)} | {_default(field)} |"
        for name, field in fields.items()
        if name not in ("kind", "generator") and field.annotation is not NoneType
    ]
    return ["| key | value | default |", "|---|---|---|", *rows] if rows else []


def _type(field: FieldInfo) -> str:
    quantities = [q for m in field.metadata if (q := getattr(getattr(m, "func", None), "quantity", None))]
    return quantities[0] if quantities else _name(field.annotation)


def _name(annotation: Any) -> str:
    """A type in words."""
    origin, arguments = get_origin(annotation), get_args(annotation)
    if origin is Literal:
        return " or ".join(f'"{value}"' if isinstance(value, str) else str(value) for value in arguments)
    if hasattr(annotation, "__metadata__"):
        quantities = [getattr(getattr(m, "func", None), "quantity", None) for m in annotation.__metadata__]
        return next((q for q in quantities if q), None) or _name(arguments[0])
    if origin is tuple:
        names = [_name(argument) for argument in arguments if argument is not Ellipsis]
        return f"list of {names[0]}" if Ellipsis in arguments else "[" + ", ".join(names) + "]"
    if origin is dict:
        return f"{_name(arguments[1])}, by name"
    if origin is Union or type(annotation).__name__ == "UnionType":
        return " or ".join(dict.fromkeys(_name(argument) for argument in arguments if argument is not NoneType))
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return "sections"  # in a list: others have headings of their own
    words = {str: "text", float: "number", int: "whole number", bool: "true or false", Path: "file"}
    return words.get(annotation, getattr(annotation, "__name__", str(annotation)))


def _default(field: FieldInfo) -> str:
    if field.is_required():
        return "required"
    default = field.get_default(call_default_factory=True)
    return "none" if default is None or default == {} else f"`{_shown(default)}`"


def _shown(value: Any) -> str:
    """A value as a study file has it, a full turn as 2 pi."""
    if isinstance(value, tuple):
        return f"[{', '.join(_shown(item) for item in value)}]"
    if isinstance(value, bool | str):
        return json.dumps(value)
    return "2 pi" if value == 2.0 * pi else str(value)
