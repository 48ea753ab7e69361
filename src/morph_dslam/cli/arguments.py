"""Kinds of values that several commands take."""

from __future__ import annotations

import argparse
import os
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

#: Units that coordinates of a file may be in.
LENGTH_UNITS = ("m", "cm", "mm", "um")
#: No value in whatever unit is meant by what is larger: its square could overflow.
LARGEST = 1e30


def with_signed_sections(arguments: Sequence[str]) -> list[str]:
    """The arguments with "--section -x=12" as one, because argparse takes "-x=12" alone for an option."""
    joined: list[str] = []
    for text in arguments:
        if joined and joined[-1] == "--section" and text[:2] in ("-x", "-y", "-z"):
            joined[-1] += f"={text}"
        else:
            joined.append(text)
    return joined


def frame_range(text: str) -> tuple[int | None, int | None]:
    """Frame numbers "first-last", both included; "9-", "-100" and "9" are ranges too."""
    first, dash, last = text.partition("-")
    try:
        numbers = (int(first) if first else None, int(last) if last else None)
    except ValueError:
        raise argparse.ArgumentTypeError(f"'{text}' is not a range of frames such as 9-100") from None
    if not dash:
        numbers = (numbers[0], numbers[0])
    if text in ("", "-") or (None not in numbers and numbers[0] > numbers[1]):  # type: ignore[operator]
        raise argparse.ArgumentTypeError(f"'{text}' is not a range of frames such as 9-100")
    return numbers


def add_file(
    command: argparse._ActionsContainer, name: str, text: str, metavar: str | None = None, required: bool = False
) -> None:
    """Add a path, called as its name in the help where there is no ``metavar``."""
    more: dict[str, Any] = {"required": True} if required else {}
    command.add_argument(name, type=Path, metavar=metavar or name.strip("-").upper(), help=text, **more)


def add_output(command: argparse._ActionsContainer, metavar: str, text: str, required: bool = True) -> None:
    """Add ``-o``, the path to write to."""
    command.add_argument("-o", "--output", type=Path, required=required, metavar=metavar, help=text)


def add_flag(command: argparse._ActionsContainer, name: str, text: str) -> None:
    """Add an option without a value."""
    command.add_argument(name, action="store_true", help=text)


def add_repeated(
    command: argparse._ActionsContainer, name: str, text: str, metavar: str, kind: Callable[[str], Any] = str
) -> None:
    """Add an option that may be given several times, whose values make a list."""
    command.add_argument(name, action="append", default=[], type=kind, metavar=metavar, help=f"{text}; may be repeated")


def add_range(command: argparse._ActionsContainer, text: str) -> None:
    """Add ``--range FIRST-LAST``, a `frame_range`."""
    command.add_argument("--range", type=frame_range, default=(None, None), metavar="FIRST-LAST", help=text)


def add_rate(command: argparse._ActionsContainer) -> None:
    """Add ``--fps N``."""
    command.add_argument(
        "--fps", type=positive_number, metavar="N", help="frames a second of numbered images (default: 30)"
    )


def add_depth_per_metre(command: argparse._ActionsContainer) -> None:
    """Add ``--depth-per-metre V``."""
    command.add_argument(
        "--depth-per-metre",
        type=positive_number,
        metavar="V",
        help="values a metre of the recording's depth images, 1000 for millimetres; 5000 by default",
    )


def positive_number(text: str) -> float:
    """A number above zero, not infinite."""
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 0.0 < value < float("inf"):
        raise argparse.ArgumentTypeError(f"'{text}' is not a number above zero")
    return value


def percentage(text: str) -> float:
    """A number of percent above zero, up to 100."""
    value = positive_number(text)
    if value > 100.0:
        raise argparse.ArgumentTypeError(f"'{text}' is not a number of percent up to 100")
    return value


def positive_integer(text: str) -> int:
    """A whole number above zero."""
    if not text.isdecimal() or int(text) == 0:
        raise argparse.ArgumentTypeError(f"'{text}' is not a whole number above zero")
    return int(text)


def frame_number(text: str) -> int:
    """A frame number, from zero on."""
    if not text.isdecimal():
        raise argparse.ArgumentTypeError(f"'{text}' is not a frame number")
    return int(text)


def named_value(text: str) -> tuple[str, float]:
    """A name and a positive number, "NAME=VALUE"."""
    name, _, number = text.partition("=")
    try:
        value = float(number)
    except ValueError:
        value = 0.0
    if not name or not 0.0 < value < LARGEST:
        raise argparse.ArgumentTypeError(f"'{text}' is not a name and a positive number such as load=0.5")
    return name, value


def named_place(text: str) -> tuple[str, tuple[float, float, float]]:
    """A name and coordinates in millimetres, "NAME=X,Y,Z", in metres."""
    name, _, place = text.partition("=")
    try:
        x, y, z = (1e-3 * float(value) for value in place.split(","))
    except ValueError:
        x = y = z = float("nan")
    if not name.strip() or not max(abs(x), abs(y), abs(z)) < LARGEST:
        raise argparse.ArgumentTypeError(
            f"'{text}' is not a name and three coordinates in millimetres such as tip=98,10,8"
        )
    return name.strip(), (x, y, z)


def file_and_column(text: str) -> tuple[Path, str | None]:
    """A path, and the column after a colon: "curve.csv", "curve.csv:force_N"; "C:\\curve.csv" is a path."""
    if os.path.exists(text):  # as `Path.exists`, but of a name that is longer than one may be too
        return Path(text), None
    for colon in re.finditer(":", text):  # names of files and of columns may have some of their own
        name, column = text[: colon.start()], text[colon.end() :]
        if os.path.isfile(name):
            return Path(name), column
    name, colon, column = text.rpartition(":")
    if colon and not set(column) & set("/\\"):
        return Path(name), column
    return Path(text), None


def frame_and_file(text: str) -> tuple[str, int, Path | None]:
    """An object's name, a frame number, and a file that belongs to it: "120", "120=landmarks.csv", "lid:120"."""
    before, equals, name = text.partition("=")
    of, _, number = before.rpartition(":")
    if not number.isdecimal() or (equals and not name):
        raise argparse.ArgumentTypeError(f"'{text}' is not a frame, or a frame and a file, such as 120=new.csv")
    return of, int(number), Path(name) if name else None


def region(text: str) -> tuple[int, tuple[float, float, float, float]]:
    """A box in a frame, "N:LEFT,TOP,RIGHT,BOTTOM"."""
    number, _, box = text.partition(":")
    try:
        left, top, right, bottom = (float(value) for value in box.split(","))
        frame = int(number)
    except ValueError:
        left = right = top = bottom = 0.0
        frame = -1
    if frame < 0 or not (left < right and top < bottom):
        raise argparse.ArgumentTypeError(f"'{text}' is not N:LEFT,TOP,RIGHT,BOTTOM, a frame and a box of pixels in it")
    return frame, (left, top, right, bottom)
