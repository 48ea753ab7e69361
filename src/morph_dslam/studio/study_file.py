"""The study file beside its forms: read, checked, and changed section by section without losing remarks.

These functions run in the worker process.
"""

from __future__ import annotations

import json
import math
import tomllib
import warnings
from collections.abc import Sequence
from functools import cache
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Any

import tomlkit
from tomlkit.exceptions import TOMLKitError
from tomlkit.items import Array, InlineTable, Table

from morph_dslam import make_study
from morph_dslam.errors import MorphError, StudioError
from morph_dslam.extend.mechanics import constant_quantities, laws, material_catalogue
from morph_dslam.extend.studies import SolidStudy, study_warnings
from morph_dslam.io.text import read_text

#: Characters of a study file.
LONGEST_TEXT = 500_000
#: Sections that forms edit: tables by name, lists, or one table.
_NAMED, _LISTED, _SINGLE = ("materials", "parameters"), ("supports", "loads", "couplings", "contacts"), (
    "sampling", "reduction", "solver", "mesh", "name",
)  # fmt: skip
#: Why a form leaves a section alone.
_BY_HAND = "a form cannot change {} as it is written here: change the text"


def check_text(text: str) -> dict[str, Any]:
    """The content of a study's text.

    Raises
    ------
    StudioError
        If it is too long, is not TOML, has a number that is not finite, or names a file outside of the project.
    """
    if len(text) > LONGEST_TEXT:
        raise StudioError(f"the study has {len(text)} characters; {LONGEST_TEXT} are the most")
    try:
        content = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise StudioError(f"the study is not TOML: {error}") from error
    _check_values(content)
    return content


def _check_values(value: Any) -> None:
    """Refuse numbers that are not finite, and texts that name a file outside; values such as "3 N/mm2" name none."""
    if isinstance(value, dict):
        for part in value.values():
            _check_values(part)
    elif isinstance(value, list):
        for part in value:
            _check_values(part)
    elif isinstance(value, float) and not math.isfinite(value):
        raise StudioError(f"{value} is no value that a study can have: give a finite number")
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
    state: dict[str, Any] = {"text": "", "content": None, "problems": [], "warnings": [], "sets": [], "cell_sets": []}
    try:
        if path.is_file():
            # What can be shown of one in another encoding can be mended and saved.
            state["text"] = path.read_bytes().decode(errors="replace")
            state["text"] = read_text(path, "study", StudioError)
        content = check_text(state["text"])
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
    except OSError as error:
        state["problems"] = [f"{path.name} cannot be read ({error.strerror or error})"]
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
        If there is no such section, the text is not TOML, or is written in a way that a form cannot change.
    """
    content = check_text(text)
    document = tomlkit.parse(text)
    kind = dict if section in _NAMED else list if section in _LISTED else object
    if section in content and not isinstance(content[section], kind):
        raise StudioError(_BY_HAND.format(section))
    if section in _NAMED and isinstance(key, str):
        wanted = content | {section: _without_none(content.get(section, {}) | {key: value})}
        change = _change_named
    elif section in _LISTED and isinstance(key, int):
        entries = list(content.get(section, []))
        if not 0 <= key < len(entries) + (value is not None):
            raise StudioError(f"{section} has {len(entries)} entries, so none at {key}")
        entries[key : key + 1] = [] if value is None else [value]
        wanted, change = content | {section: entries}, _change_listed
    elif section in _SINGLE and key is None:
        wanted, change = content | {section: value}, _change_single
    else:
        raise StudioError(f"{section!r:.40} with the key {key!r:.40} is no section of a study that a form changes")
    wanted = {name: part for name, part in wanted.items() if name != section or part}
    try:
        change(document, section, key, value)
        if section in document and not document[section]:
            document.remove(section)
        changed = tomlkit.dumps(document)
        is_right = tomllib.loads(changed) == wanted
    except (TOMLKitError, ValueError, TypeError, LookupError, AttributeError):
        is_right, changed = False, ""
    if not is_right:
        raise StudioError(_BY_HAND.format(section))
    return changed


def _without_none(table: dict[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in table.items() if value is not None}


def _change_named(document: Any, section: str, key: Any, value: Any) -> None:
    if section not in document:
        document[section] = tomlkit.table(is_super_table=True)
    _change(document[section], key, value)


def _change_listed(document: Any, section: str, key: Any, value: Any) -> None:
    if section not in document:
        document[section] = tomlkit.aot()
    entries = document[section]
    if value is None:
        del entries[key]
    elif key < len(entries):
        _fill(entries[key], value)
    else:
        entries.append(_table(value, isinstance(entries, Array)))


def _change_single(document: Any, section: str, key: Any, value: Any) -> None:
    _change(document, section, value)


def _change(table: Any, key: str, value: Any) -> None:
    """Set an entry of a table; tables are filled anew entry by entry, so that remarks in them stay."""
    if value is None:
        table.pop(key, None)
    elif not isinstance(value, dict):
        if key not in table or table[key] != value:
            table[key] = value
    elif isinstance(table.get(key), dict):
        _fill(table[key], value)
    else:
        table[key] = _table(value, isinstance(table, InlineTable))


def _fill(table: Any, value: dict[str, Any]) -> None:
    for key in [key for key in table if key not in value]:
        table.pop(key)
    # Remarks at the end of a table stand before what follows it: new entries come before them.
    body = table.value.body if isinstance(table, Table) else []
    end = len(body)
    while end and body[end - 1][0] is None:
        end -= 1
    last = body[end:]
    del body[end:]
    for key, part in value.items():
        _change(table, key, part)
    body.extend(last)


def _table(value: dict[str, Any], is_inline: bool) -> Any:
    table = tomlkit.inline_table() if is_inline else tomlkit.table()
    _fill(table, value)
    return table


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
