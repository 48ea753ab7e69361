"""The lines of an Abaqus or CalculiX input file as cards: a keyword, its parameters and its data lines.

Syntax after the Abaqus Keywords Reference Guide, "Input syntax rules": `**` begins a comment, `*` a keyword;
a keyword line that ends in a comma goes on in the next; the case of names and keywords does not matter.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from morph_dslam.errors import StudyError


@dataclass(frozen=True)
class Line:
    """One data line: its comma-separated fields, without spaces around them, and where it was read."""

    fields: tuple[str, ...]
    path: Path
    number: int

    def error(self, message: str) -> StudyError:
        """A StudyError that begins with the file and the line."""
        return StudyError(f"{self.path}, line {self.number}: {message}")

    def text(self, position: int) -> str:
        """The field at a position; StudyError if the line ends before it."""
        if position >= len(self.fields):
            raise self.error(f"value {position + 1} is missing")
        return self.fields[position]

    def integer(self, position: int) -> int:
        """The field at a position as a whole number; StudyError if it is not one."""
        return int(self._parsed(position, int, "a whole number"))

    def real(self, position: int) -> float:
        """The field at a position as a finite number (an empty one is 0); StudyError if it is not one."""
        if not self.text(position):
            return 0.0
        # Abaqus takes Fortran's exponent letter too.
        value = float(self._parsed(position, lambda text: float(text.upper().replace("D", "E")), "a number"))
        if not abs(value) < float("inf"):
            raise self.error(f"'{self.fields[position]}' is not a finite number")
        return value

    def _parsed(self, position: int, kind, what: str):
        try:
            return kind(self.text(position))
        except ValueError:
            raise self.error(f"'{self.fields[position]}' is not {what}") from None


@dataclass(frozen=True)
class Card:
    """A keyword such as "SOLID SECTION", its parameters by name in capitals, and the data lines below it."""

    keyword: str
    parameters: dict[str, str]
    line: Line
    data: list[Line] = field(default_factory=list)

    def required(self, name: str) -> str:
        """The value of a parameter; StudyError if the card lacks it."""
        value = self.parameters.get(name, "")
        if not value:
            raise self.line.error(f"*{self.keyword} lacks its parameter {name}=")
        return value


def _split(text: str) -> tuple[str, ...]:
    return tuple(part.strip().strip('"') for part in text.split(","))


def _lines(path: Path, including: tuple[Path, ...] = ()) -> Iterator[tuple[Path, int, str]]:
    """Lines that are no comments, those of included files in place."""
    try:
        text = path.read_text(encoding="utf-8", errors="replace")
    except OSError as error:
        raise StudyError(f"cannot read the mesh {path}: {error.strerror}") from error
    if "\0" in text:
        raise StudyError(f"{path} is not a text file, so no Abaqus or CalculiX input file")
    numbered = iter(enumerate(text.splitlines(), start=1))
    for number, raw in numbered:
        line = raw.strip()
        if not line or line.startswith("**"):
            continue
        first = number
        while line.startswith("*") and line.endswith(","):
            number, following = next(numbered, (number, ""))
            line += following.strip() or " "
        if line.upper().startswith("*INCLUDE"):
            yield from _included(path, first, line, including)
        else:
            yield path, first, line


def _included(
    path: Path, number: int, line: str, including: tuple[Path, ...]
) -> Iterator[tuple[Path, int, str]]:
    card = _card(path, number, line)
    target = path.parent / card.required("INPUT")
    if target.resolve() in (*including, path.resolve()):
        raise card.line.error(f"{target} includes itself")
    if not target.is_file():
        raise card.line.error(f"the included file {target} is not there")
    yield from _lines(target, (*including, path.resolve()))


def _card(path: Path, number: int, text: str) -> Card:
    keyword, *rest = _split(text[1:])
    parameters = {}
    for part in filter(None, rest):
        name, _, value = part.partition("=")
        parameters[" ".join(name.upper().split())] = value.strip().strip('"')
    return Card(" ".join(keyword.upper().split()), parameters, Line((), path, number))


def read_cards(path: Path) -> list[Card]:
    """The cards of an input file and of those that it includes, in order.

    Raises
    ------
    StudyError
        If a file cannot be read, is not text, includes itself, or begins with data.
    """
    cards: list[Card] = []
    for source, number, text in _lines(Path(path)):
        if text.startswith("*"):
            cards.append(_card(source, number, text))
            continue
        fields = _split(text)
        # A comma at the end says that more may follow, not that an empty field does.
        line = Line(fields[:-1] if len(fields) > 1 and not fields[-1] else fields, source, number)
        if not cards:
            raise line.error("the file begins with data; an input file begins with a keyword such as *NODE")
        cards[-1].data.append(line)
    return cards
