"""What a reader of a result must know: a typed value for programs, a text for people."""

from __future__ import annotations

import re
from dataclasses import asdict, dataclass
from typing import Any


@dataclass(frozen=True)
class Notice:
    """A warning about a result, with the numbers that it rests on as fields.

    Each kind of warning is a small frozen dataclass. Programs test the class, or its `kind`, and read the
    fields; the text is only shown. One module of each part of the program writes all texts of that part.
    """

    @property
    def kind(self) -> str:
        """The class's name in snake case, ``"at_bound"`` for ``AtBound``."""
        return re.sub(r"(?<!^)(?=[A-Z])", "_", type(self).__name__).lower()

    @property
    def text(self) -> str:
        """The warning in words."""
        raise NotImplementedError

    def content(self) -> dict[str, Any]:
        """The kind, the fields and the text, for a JSON file."""
        return {"kind": self.kind, **asdict(self), "text": self.text}

    def __str__(self) -> str:
        return self.text
