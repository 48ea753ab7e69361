"""The study file beside its forms: read, checked, and changed section by section without losing remarks.

These functions run in the worker process.
"""

from __future__ import annotations

import json
import tomllib
import warnings
from collections.abc import Sequence
from functools import cache
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Any

import tomlkit

from morph_dslam import make_study
from morph_dslam.errors import MorphError, StudioError
from morph_dslam.extend.mechanics import constant_quantities, laws, material_catalogue
from morph_dslam.extend.studies import SolidStudy, study_warnings

#: Characters of a study file.
LONGEST_TEXT = 500_000
#: Sections that forms edit: tables by name, lists, or one table.
_NAMED, _LISTED, _SINGLE = ("materials", "parameters"), ("supports", "loads", "couplings", "contacts"), (
    "sampling", "reduction", "solver", "mesh", "name",
)  # fmt: skip


def check_text(text: str) -> dict[str, Any]:
    """The content of a study's text.

    Raises
    ------
    StudioError
        If it is too long, is not TOML, or names a file outside of the project.
    """
    if len(text) > LONGEST_TEXT:
        raise StudioError(f"the study has {len(text)} characters; {LONGEST_TEXT} are the most")
    try:
        content = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise StudioError(f"the study is not TOML: {error}") from error
    _check_inside(content)
    return content


def _check_inside(value: Any) -> None:
    """Refuse texts that name a file outside of the study's folder; values such as "3 N/mm2" name none."""
    if isinstance(value, dict):
        for part in value.values():
            _check_inside(part)
    elif isinstance(value, list):
        for part in value:
            _check_inside(part)
    elif isinstance(value, str):
        posix, windows = PurePosixPath(value), PureWindowsPath(value)
        if posix.is_absolute() or windows.is_absolute() or ".." in {*posix.parts, *windows.parts} or "~" in value[:1]:
            raise StudioError(f"{value!r:.80} leads out of the project folder: copy the file into it and name it alone")


def study_state(path: Path) -> dict[str, Any]:
    """What the page shows of a study file.

    Returns
    -------
    ``text``; ``content``, or None where it is not TOML; ``problems``, why `morph build` would refuse it; ``warnings``,
    what loading it says; ``sets`` of its mesh.
    """
    text = path.read_text(encoding="utf-8") if path.is_file() else ""
    state: dict[str, Any] = {"text": text, "content": None, "problems": [], "warnings": [], "sets": [], "cell_sets": []}
    try:
        content = check_text(text)
        state["content"] = json.loads(json.dumps(content, default=str))
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            study = make_study(content, path.parent)
            if isinstance(study, SolidStudy):
                mesh = study.solid_mesh()
                state["sets"] = sorted({*mesh.surfaces, *mesh.node_sets})
                state["cell_sets"] = sorted(mesh.cell_sets)
                state["problems"] = _unused(study)
            state["warnings"] = [*study_warnings(study), *(str(warning.message) for warning in caught)]
    except MorphError as error:
        state["problems"] = [str(error).removeprefix("the study: ")]
    return state


def _unused(study: SolidStudy) -> list[str]:
    """What loading accepts, and building or tracking cannot mean."""
    return [] if study.supports or study.couplings else ["nothing holds the object: add a support"]


def changed_text(text: str, section: str, key: str | int | None, value: Any) -> str:
    """A study's text with one entry of a section replaced, added or, by None, taken out.

    Parameters
    ----------
    text : of the study; remarks and the order of everything else stay.
    section : "materials", "parameters", "supports", "loads" ...
    key : the entry's name, its position in a list (the next one adds), or None where the section is one value.
    value : the entry, a table or a plain value.

    Raises
    ------
    StudioError
        If there is no such section, or the text is not TOML.
    """
    check_text(text)
    document = tomlkit.parse(text)
    if section in _NAMED and isinstance(key, str):
        table = document.setdefault(section, tomlkit.table(is_super_table=True))
        _replace(table, key, value)
    elif section in _LISTED and isinstance(key, int):
        _replace_listed(document, section, key, value)
    elif section in _SINGLE and key is None:
        _replace(document, section, value)
    else:
        raise StudioError(f"{section!r:.40} with the key {key!r:.40} is no section of a study that a form changes")
    if section in document and not document[section]:
        document.remove(section)
    return tomlkit.dumps(document)


def _replace(table: Any, key: str, value: Any) -> None:
    if value is None:
        table.pop(key, None)
    else:
        table[key] = tomlkit.item(value)


def _replace_listed(document: Any, section: str, position: int, value: Any) -> None:
    entries = list(document.get(section, []))
    if not 0 <= position <= len(entries):
        raise StudioError(f"{section} has {len(entries)} entries, so none at {position}")
    new = [] if value is None else [tomlkit.item(value)]
    array = tomlkit.aot()
    for entry in [*entries[:position], *new, *entries[position + 1 :]]:
        array.append(entry)
    document.pop(section, None)
    if len(array):
        document[section] = array


@cache
def forms() -> dict[str, Any]:
    """What forms ask for: the kinds of supports, loads and contacts, the laws, and the materials with sources."""
    definitions = SolidStudy.model_json_schema()["$defs"]
    groups = {"supports": "Support", "loads": "Load", "contacts": "Contact"}
    kinds: dict[str, dict[str, Any]] = {group: {} for group in groups}
    for name, schema in definitions.items():
        properties = schema.get("properties", {})
        kind = properties.get("kind", {}).get("const")
        group = next((g for g, ending in groups.items() if ending in name), None)
        if kind and group:
            required = schema.get("required", ())
            kinds[group][kind] = {
                "help": schema.get("description", "").split("\n")[0],
                "fields": [_field(key, part, key in required) for key, part in properties.items() if key != "kind"],
            }
    constants = {
        name: [[key, quantity] for key, quantity in constant_quantities(name).items()]
        for name in laws()
        if name != "user_material"
    }
    return {"kinds": kinds, "laws": constants, "materials": [entry.content() for entry in material_catalogue()]}


def _field(key: str, schema: dict[str, Any], required: bool) -> dict[str, Any]:
    """A field of a form: what kind of input, how many, whether it must be there."""
    options: Sequence[dict[str, Any]] = schema.get("anyOf", [schema])
    array = next((option for option in options if option.get("type") == "array"), None)
    plain = {option.get("type") for option in options}
    if key in ("on", "against"):
        kind = "set"
    elif "boolean" in plain:
        kind = "flag"
    elif array is not None:
        items = array.get("prefixItems", [])
        kind = "numbers" if items and all(item.get("type") == "number" for item in items) else "values"
    else:
        kind = "value"
    return {"key": key, "kind": kind, "required": required, "default": schema.get("default")}
