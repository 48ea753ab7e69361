"""What a model file holds, in words: `morph info` prints it and the reports show it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from morph_dslam.model import Parameter, ReducedModel

#: Endings of certificate keys and the unit they stand for.
_UNITS = {"_mm": "mm", "_percent": "%", "_MPa": "MPa", "_seconds": "s", "_ms": "ms", "_deg": "°"}
#: Provenance longer than this (a study's text) is for programs, not for a summary.
_LONGEST_TEXT = 120

#: Fields of the model file in words.
_FIELDS = {
    "stress_top": "stress, top face",
    "stress_bottom": "stress, bottom face",
    "stress_solid": "Cauchy stress",
}

Facts = dict[str, str]


def _range(parameter: Parameter) -> str:
    lower, upper, default = (
        f"{parameter.display(value):.4g}" for value in (parameter.lower, parameter.upper, parameter.default)
    )
    unit = "" if parameter.unit == "1" else f" {parameter.unit}"
    note = f"; {parameter.description}" if parameter.description else ""
    return f"{lower} to {upper}{unit}, default {default}{note}"


def _value(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, list):
        if any(isinstance(item, Mapping) for item in value):
            return f"{len(value)} entries"
        return ", ".join(_value(item) for item in value) or "none"
    return str(value)


def flatten(content: Mapping[str, Any], prefix: str = "") -> Facts:
    """Nested JSON as one line a value, ``{"a": {"b_mm": 1.5}}`` -> ``{"a: b": "1.5 mm"}``.

    Long texts are left out.
    """
    facts: Facts = {}
    for key, value in content.items():
        if isinstance(value, Mapping):
            facts |= flatten(value, f"{prefix}{key.replace('_', ' ')}: ")
            continue
        ending = next((ending for ending in _UNITS if key.endswith(ending)), "")
        unit = f" {_UNITS[ending]}" if ending else ""
        text = _value(value)
        if len(text) <= _LONGEST_TEXT and "\n" not in text:
            facts[prefix + key.removesuffix(ending).replace("_", " ")] = text + unit
    return facts


def summarise_model(model: ReducedModel) -> dict[str, Facts]:
    """Facts of a model by heading, in the order in which they are read; empty headings are left out."""
    extent = 1e3 * np.ptp(model.nodes, axis=0)
    summary = {
        "mesh": {
            "nodes": str(len(model.nodes)),
            "triangles": str(len(model.triangles)),
            **{f"{name} cells": str(len(cells)) for name, cells in model.cells.items()},
            "extent": " x ".join(f"{length:.4g}" for length in extent) + " mm",
            "units in the file": "metres, pascals, radians",
        },
        "parameters": {parameter.name: _range(parameter) for parameter in model.parameters},
        "modes": {_FIELDS.get(name, name): str(field.n_modes) for name, field in model.fields.items()},
        "certificate": flatten(model.certificate),
        "provenance": flatten(model.provenance),
    }
    return {heading: facts for heading, facts in summary.items() if facts}
