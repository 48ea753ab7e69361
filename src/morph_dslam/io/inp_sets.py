"""Named sets of labels in an input file: lists, GENERATE ranges, and sets within sets."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from morph_dslam.io.inp_cards import Card, Line

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

        Parameters
        ----------
        defined : the labels that the file defines; a range keeps those of its labels that are among them.

        Raises
        ------
        StudyError
            If a line names a label that is not defined, a set that is not there, or one that holds itself.
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
