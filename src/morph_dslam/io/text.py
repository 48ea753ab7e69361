"""Text files that users write, with the errors that reading one can meet."""

from __future__ import annotations

import csv
import re
import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from morph_dslam.errors import MorphError

_BRACKETED = re.compile(r"(.*\S)\s*(?:\[(.+)\]|\((.+)\))")
#: A name that becomes a part of columns, and a group in a file.
PLAIN_NAME = re.compile(r"\w[\w -]*")
PLAIN_NAME_RULE = "give one of letters, digits, spaces, - and _"
_SEPARATORS = {";": "semicolons", "\t": "tabs"}


def read_text(path: Path, what: str, error_class: type[MorphError]) -> str:
    """The text of a file in UTF-8, with or without a byte order mark.

    Parameters
    ----------
    path : the file
    what : what the file is, for the message: "study file" say
    error_class : what is raised if it cannot be read or is no text
    """
    try:
        return path.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise error_class(f"cannot read the {what} {path}: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise error_class(f"{path} is not a text file, so no {what}: {error}") from error


def read_csv(path: Path, what: str, error_class: type[MorphError]) -> list[tuple[int, list[str]]]:
    """Number and cells, without spaces around them, of each line of a CSV file that holds any.

    Parameters as of `read_text`.

    Raises
    ------
    error_class
        If the file cannot be read, or something else than commas separates its cells.
    """
    reader = csv.reader(read_text(path, what, error_class).splitlines())
    try:
        rows = [(reader.line_num, [cell.strip() for cell in row]) for row in reader]
    except csv.Error as error:
        raise error_class(f"{path}, line {reader.line_num} is no line of a CSV file: {error}") from error
    rows = [(line, cells) for line, cells in rows if any(cells)]
    for separator, name in _SEPARATORS.items():
        if rows and separator in rows[0][1][0]:
            raise error_class(f"{path} is separated by {name}: write commas between cells, and decimals with points")
    return rows


def has_a_cell_for_each(titles: Sequence[str], cells: Sequence[str]) -> bool:
    """Whether a line of a table has a cell, perhaps an empty one, for each title, and none beside them.

    Decimals with commas make more.
    """
    return len(cells) >= len(titles) and not any(cells[len(titles) :])


def name_and_unit(header: str) -> tuple[str, str]:
    """Both parts of a column's header, "stroke_mm", "stroke [mm]" or "stroke (mm)"."""
    if bracketed := _BRACKETED.fullmatch(header):
        return bracketed[1], bracketed[2] or bracketed[3]
    name, _, unit = header.rpartition("_")
    return name, unit


def read_toml(path: Path, what: str, error_class: type[MorphError]) -> dict[str, Any]:
    """The content of a TOML file; parameters as of `read_text`."""
    try:
        return tomllib.loads(read_text(path, what, error_class))
    except tomllib.TOMLDecodeError as error:
        raise error_class(f"{path} is not a TOML file: {error}") from error
