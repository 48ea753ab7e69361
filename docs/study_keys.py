"""All keys of study files as Markdown, from the models that read them."""

from __future__ import annotations

import inspect
import re
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


def study_reference() -> str:
    """A Markdown page: for each kind of study its sections, what they mean, and a table of their keys."""
    lines: list[str] = []
    for title, study in _STUDIES.items():
        top = {name: field for name, field in study.model_fields.items() if not sections_of(field.annotation)}
        lines += [f"## {title}", "", _text(study), "", *_table(top), ""]
        for name, field in study.model_fields.items():
            for tag, section in sections_of(field.annotation).items():
                lines += [*_section(name, field, section, tag), ""]
    return "\n".join(lines).rstrip() + "\n"


def _section(name: str, field: FieldInfo, section: type[BaseModel], tag: str) -> list[str]:
    """Heading, text and table of one section; nested sections follow it."""
    origin = get_origin(field.annotation)
    heading = f"[[{name}]]" if origin is tuple else f"[{name}.NAME]" if origin is dict else f"[{name}]"
    kind = next((key for key in ("kind", "generator") if key in section.model_fields), None)
    heading += f" {kind} = {tag}" if kind else ""
    return [f"### `{heading}`", "", _text(section), "", *_table(section.model_fields)]


def _text(section: type[BaseModel]) -> str:
    return re.sub(r"``(.*?)``", r"`\1`", inspect.cleandoc(section.__doc__ or ""))


def _table(fields: dict[str, FieldInfo]) -> list[str]:
    rows = [
        f"| `{name}` | {_type(field)} | {_default(field)} |"
        for name, field in fields.items()
        if name not in ("kind", "generator")
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
    if origin is Union or type(annotation).__name__ == "UnionType":
        return " or ".join(dict.fromkeys(_name(argument) for argument in arguments if argument is not NoneType))
    words = {str: "text", float: "number", int: "whole number", bool: "true or false", Path: "file"}
    return words.get(annotation, getattr(annotation, "__name__", str(annotation)))


def _default(field: FieldInfo) -> str:
    if field.is_required():
        return "required"
    default = field.get_default(call_default_factory=True)
    return "none" if default is None else f"`{default}`"
