"""Names of a model file's fields in words."""

from __future__ import annotations

_TITLES = {
    "displacement": "displacement",
    "stress_top": "stress, top face",
    "stress_bottom": "stress, bottom face",
    "stress_solid": "Cauchy stress",
    "strain": "strain",
}
_REACTIONS = {"reaction_force_": "force on ", "reaction_moment_": "moment on "}


def field_title(name: str) -> str:
    """The field's name for a table, "force on top" for "reaction_force_top"."""
    for start, words in _REACTIONS.items():
        if name.startswith(start):
            return words + name.removeprefix(start)
    return _TITLES.get(name, name)
