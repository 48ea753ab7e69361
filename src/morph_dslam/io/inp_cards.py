"""The lines of an Abaqus or CalculiX input file as cards: a keyword, its parameters and its data lines.

Syntax after the Abaqus Keywords Reference Guide, "Input syntax rules": `**` begins a comment, `*` a keyword;
a keyword line that ends in a comma goes on in the next; the case of names and keywords does not matter.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

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


def _included(path: Path, number: int, line: str, including: tuple[Path, ...]) -> Iterator[tuple[Path, int, str]]:
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

    Raises StudyError if a file cannot be read, is not text, includes itself, or begins with data.
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


Labels = NDArray[np.int64]


@dataclass
class _Set:
    name: str
    labels: list[int] = field(default_factory=list)
    ranges: list[range] = field(default_factory=list)
    #: Entries that were written in set lines: where, and the label or the name of another set.
    entries: list[tuple[Line, int | str]] = field(default_factory=list)


def _is_label(text: str) -> bool:
    return text.lstrip("+-").isdigit()


class LabelSets:
    """The node sets, or the element sets, of one file; ``what`` is "node" or "element"."""

    def __init__(self, what: str):
        self._what = what
        self._sets: dict[str, _Set] = {}

    def _set(self, name: str) -> _Set:
        return self._sets.setdefault(name.upper(), _Set(name))

    def add(self, name: str | None, labels: Iterable[int]) -> None:
        """Add labels that the file defines to a set; none where the name is missing."""
        if name:
            self._set(name).labels.extend(labels)

    def add_card(self, card: Card, parameter: str) -> None:
        """Add the data lines of a *NSET or *ELSET card to the set that ``parameter`` names."""
        name = card.required(parameter)
        self._set(name)
        for line in card.data:
            if "GENERATE" in card.parameters:
                self.add_range(name, line)
            else:
                self.add_line(name, line)

    def add_line(self, name: str, line: Line) -> None:
        """Add every label and every name of a set on a line."""
        entries = self._set(name).entries
        for position, text in enumerate(line.fields):
            if text:
                entries.append((line, line.integer(position) if _is_label(text) else text))

    def add_range(self, name: str, line: Line) -> None:
        """Add first, last and step of a GENERATE line."""
        if not 2 <= len([text for text in line.fields if text]) <= 3:
            raise line.error("a GENERATE line needs a first label, a last one and, if not 1, a step")
        first, last = line.integer(0), line.integer(1)
        step = line.integer(2) if len(line.fields) > 2 and line.fields[2] else 1
        if step <= 0 or last < first:
            raise line.error(f"{first}, {last}, {step} is no range; give first <= last and a positive step")
        self._set(name).ranges.append(range(first, last + 1, step))

    def entry(self, line: Line, position: int, defined: Labels) -> Labels:
        """Labels that a field stands for: itself, or a set's."""
        text = line.text(position)
        single = _Set(text, entries=[(line, line.integer(position) if _is_label(text) else text)])
        return self._expand(single, defined, ())

    def named(self, name: str, line: Line, defined: Labels) -> Labels:
        """Sorted labels of a set; StudyError naming the line that refers to it if there is no such set."""
        return self._expand(_Set(name, entries=[(line, name)]), defined, ())

    def resolved(self, defined: Labels) -> dict[str, Labels]:
        """Sorted labels of each set by name.

        Raises StudyError if a line names a label that is not defined, a set that is not there, or one that holds
        itself.

        Parameters
        ----------
        defined : the labels that the file defines; a range keeps those of its labels that are among them.
        """
        return {entry.name: self._expand(entry, defined, ()) for entry in self._sets.values()}

    def _expand(self, one: _Set, defined: Labels, within: tuple[str, ...]) -> Labels:
        listed = [(line, entry) for line, entry in one.entries if isinstance(entry, int)]
        labels = np.array([entry for _, entry in listed], dtype=np.int64)
        for i in np.flatnonzero(~np.isin(labels, defined))[:1]:
            line, label = listed[i]
            raise line.error(f"{self._what} {label} in '{one.name}' is not defined in the file")
        parts = [labels, np.array(one.labels, dtype=np.int64)]
        parts += [np.intersect1d(np.arange(r.start, r.stop, r.step), defined) for r in one.ranges]
        for line, entry in one.entries:
            if isinstance(entry, str):
                key = entry.upper()
                if key not in self._sets:
                    raise line.error(f"there is no {self._what} set '{entry}'")
                if key in within:
                    raise line.error(f"the {self._what} set '{entry}' holds itself")
                parts.append(self._expand(self._sets[key], defined, (*within, key)))
        return np.unique(np.concatenate(parts))
