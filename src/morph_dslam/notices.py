"""What a reader of a result must know: a typed value for programs, a text for people."""

from __future__ import annotations

import re
from dataclasses import asdict, dataclass
from typing import Any, ClassVar


@dataclass(frozen=True)
class Notice:
    """A warning about a result, with the numbers that it rests on as fields.

    Each kind of warning is a small frozen dataclass. Programs test the class, or its `kind`, and read the
    fields; the text is only shown.

    Attributes
    ----------
    template : the text, with the fields' names in braces.
    """

    template: ClassVar[str] = ""

    @property
    def kind(self) -> str:
        """The class's name in snake case, ``"at_bound"`` for ``AtBound``."""
        return re.sub(r"(?<!^)(?=[A-Z])", "_", type(self).__name__).lower()

    @property
    def text(self) -> str:
        """For people."""
        return self.template.format(**vars(self))

    def __str__(self) -> str:
        return self.text

    def content(self) -> dict[str, Any]:
        """The kind, the fields and the text, for a JSON file."""
        return {"kind": self.kind, **asdict(self), "text": self.text}


@dataclass(frozen=True)
class Remark(Notice):
    """A warning of which programs need no more than the text.

    Attributes
    ----------
    message : the text.
    """

    template: ClassVar[str] = "{message}"
    message: str
