"""What a model file holds, in tables: `morph info` prints them and the reports show them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from morph_dslam.evaluation.report import Table
from morph_dslam.model import Parameter, ReducedModel
from morph_dslam.model.functions import ParameterFunctions
from morph_dslam.model.parameter_errors import ENTRY, ERRORS, PRODUCTS, errors_alone
from morph_dslam.model.stated_errors import NOT_ESTIMATED
from morph_dslam.model.tensor_functions import CPFunctions, ProductFunctions, TensorTrainFunctions, TuckerFunctions

#: Endings of certificate keys and the unit they stand for.
_UNITS = {"_mm": "mm", "_percent": "%", "_MPa": "MPa", "_seconds": "s", "_ms": "ms", "_deg": "°"}
#: Texts longer than this (a study's) are for programs, not for a summary.
_LONGEST_TEXT = 120
_FORMATS = {
    ParameterFunctions: "polynomials",
    CPFunctions: "CP",
    TuckerFunctions: "Tucker",
    TensorTrainFunctions: "tensor train",
    ProductFunctions: "products",
}
#: Long lists of the reduction, which the build's report draws.
_DRAWN = ("singular_values", "cross_validation")
Facts = dict[str, str]


def describe_point(parameters: Sequence[Parameter], coordinates: ArrayLike) -> str:
    """Coordinates (d,), SI, as "lever = 12 deg, load = 3 N"."""
    return ", ".join(
        f"{parameter.name} = {parameter.display(float(value)):.4g} {parameter.unit}".removesuffix(" 1")
        for parameter, value in zip(parameters, np.asarray(coordinates), strict=True)
    )


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


def summarise_model(model: ReducedModel) -> dict[str, Table]:
    """Tables of a model by heading, in the order in which they are read; empty ones are left out.

    A model made without `morph build` has an empty certificate.
    """
    certificate = model.certificate
    summary = {
        "errors": Table.of(error_facts(model)),
        "mesh": Table.of(_mesh(model)),
        "parameters": Table.of({parameter.name: _range(parameter) for parameter in model.parameters}),
        "fields": _fields(model),
        "errors on held-out solves": error_table(certificate),
        "errors of the displacement's sensitivities": sensitivity_table(certificate),
        "confidence": Table.of(held_out_facts(model)),
        "memory and samples": Table.of(_memory(certificate)),
        "error estimator": Table.of(flatten(certificate.get("estimator", {}))),
        "reduction": Table.of(_reduction(certificate)),
        "stability": Table.of(_stability(certificate)),
        "contact": Table.of(_penetration(model)),
        "unknown loads": Table.of(_unknown_loads(certificate)),
        "warnings": Table.of({f"{n}": line for n, line in enumerate(certificate.get("warnings", []), start=1)}),
        "made with": Table.of(flatten(_versions_last(model.provenance))),
    }
    return {heading: table for heading, table in summary.items() if table.rows}


#: What a certificate of an earlier version says of the discretisation.
_UNKNOWN_DISCRETISATION = {NOT_ESTIMATED: "the model file is of an earlier version"}


def error_facts(model: ReducedModel) -> Facts:
    """The total error of a model and its two parts, discretisation and reduction; empty without a certificate."""
    certificate = model.certificate
    if "displacement" not in certificate:
        return {}
    reduction = main_errors(certificate)
    facts = {"reduction error": _in_words(reduction)}
    if "n_held_out" in certificate["displacement"]:
        facts["reduction error"] += f", at {_held_out(certificate['displacement']['n_held_out'], 'solve')}"
    discretisation = certificate.get("discretisation", _UNKNOWN_DISCRETISATION)
    if NOT_ESTIMATED in discretisation:
        unknown = f"not estimated: {discretisation[NOT_ESTIMATED]}"
        return {"total error": "not estimated", "discretisation error": unknown} | facts
    errors, states = main_errors(discretisation["errors"]), discretisation["coordinates"]
    coarse, finer = discretisation["unknowns"]
    facts = {
        "total error": _in_words({name: errors[name] + reduction.get(name, 0.0) for name in errors}),
        "discretisation error": f"{_in_words(errors)}, at {_held_out(len(states), 'state')} solved again",
        **facts,
        "finer elements": f"{discretisation['method']}; {finer} unknowns in place of {coarse}",
    }
    if ENTRY in discretisation:
        facts["as errors of the parameters"] = _as_parameters(model, discretisation[ENTRY][ERRORS])
        if PRODUCTS in discretisation[ENTRY] and len(model.study_parameters) > 1:
            alone = errors_alone(discretisation[ENTRY])
            facts["of each where the others are known"] = _as_parameters(model, alone)
    if discretisation.get("singular_nodes"):
        facts["nodes left out"] = (
            f"strain and stress at up to {discretisation['singular_nodes']} nodes, where cells of the finer solution "
            "are turned inside out, as at a sharp rim of a support or load: there no mesh tells them"
        )
    if "left_out" in discretisation:
        facts["states left out"] = discretisation["left_out"]
    described = [describe_point(model.parameters, state) for state in states]
    return facts | {f"state solved again {n}": text for n, text in enumerate(described, start=1)}


def _held_out(count: int, what: str) -> str:
    return f"{count} held-out {what}{'' if count == 1 else 's'}"


def _as_parameters(model: ReducedModel, errors: Mapping[str, Any]) -> str:
    """What the discretisation error amounts to in each parameter, root mean square over the states."""
    values = [float(np.sqrt(np.mean(np.square(errors[p.name])))) for p in model.study_parameters]
    return describe_point(model.study_parameters, values) + " (root mean square)"


def main_errors(errors: Mapping[str, Any]) -> dict[str, float]:
    """The figures that say most: mean and largest displacement error (mm), relative L2 errors of the rest (%).

    Of the von Mises stresses of several faces, and of all reactions, it is the largest.
    """
    figures = {"mean": errors["displacement"]["mean_mm"], "largest": errors["displacement"]["max_mm"]}
    stresses = [entry["von_mises"] for name, entry in errors.items() if name.startswith("stress_")]
    reactions = [entry for name, entry in errors.items() if name.startswith("reaction_")]
    for title, entries in (("von Mises stress", stresses), ("reactions", reactions)):
        relative = [entry["relative_l2"] for entry in entries if _is_known(entry.get("relative_l2"))]
        figures |= {title: 100.0 * max(relative)} if relative else {}
    return figures


def _is_known(value: float | None) -> bool:
    """Whether an error is stated; certificates of earlier versions hold NaN where a finer solution has no stress."""
    return value is not None and bool(np.isfinite(value))


def _in_words(figures: Mapping[str, float]) -> str:
    displacement = f"displacement {figures['mean']:.2g} mm mean, {figures['largest']:.2g} mm at most"
    relative = [
        f"{name} {float(f'{value:.2g}'):g} %" for name, value in figures.items() if name not in ("mean", "largest")
    ]
    return ", ".join([displacement, *relative]) + (" (relative L2)" if relative else "")


def held_out_facts(model: ReducedModel) -> Facts:
    """How far the errors can be relied upon, and where the worst of them is."""
    errors = model.certificate.get("displacement", {})
    facts = {}
    if "n_held_out" in errors:
        facts["held-out solves"] = str(errors["n_held_out"])
    if "confidence" in errors:
        facts["confidence"] = errors["confidence"]
    if "worst_sample" in errors:
        worst = f"mean error {_value(errors['worst_sample_mean_mm'])} mm"
        facts["worst solve"] = f"{describe_point(model.parameters, errors['worst_sample'])}: {worst}"
    return facts


def _unit(parameter: Parameter) -> str:
    return "" if parameter.unit == "1" else parameter.unit


def _range(parameter: Parameter) -> str:
    lower, upper, default = (
        f"{parameter.display(value):.4g}" for value in (parameter.lower, parameter.upper, parameter.default)
    )
    note = f"; {parameter.description}" if parameter.description else ""
    return f"{lower} to {upper} {_unit(parameter)}".rstrip() + f", default {default}{note}"


def _value(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, list):
        if any(isinstance(item, Mapping) for item in value):
            return f"{len(value)} entries" if len(value) > 1 else "1 entry"
        return ", ".join(_value(item) for item in value) or "none"
    return str(value)


def _mesh(model: ReducedModel) -> Facts:
    extent = 1e3 * np.ptp(model.nodes, axis=0)
    return {
        "nodes": str(len(model.nodes)),
        "triangles": str(len(model.triangles)),
        **{f"{name} cells": str(len(cells)) for name, cells in model.cells.items()},
        "extent": " x ".join(f"{length:.4g}" for length in extent) + " mm",
        "units in the file": "metres, pascals, radians",
    }


def _fields(model: ReducedModel) -> Table:
    rows = [
        [field_title(name), str(field.n_modes), _FORMATS[type(field.functions)], str(field.n_floats)]
        for name, field in model.fields.items()
    ]
    return Table(rows, ("field", "modes", "format", "numbers stored"))


def _memory(certificate: Mapping[str, Any]) -> Facts:
    facts = {}
    if "compression_percent" in certificate:
        facts["compression of the displacement"] = f"{certificate['compression_percent']:.2f} %"
    samples = dict(certificate.get("samples", {}))
    rounds = samples.pop("rounds", [])
    facts |= {f"{name.replace('_', '-')} samples": _value(value) for name, value in samples.items()}
    return facts | {
        f"adaptive round {number}": f"{content['solves']} solves, "
        f"largest estimated error {_value(content['largest_estimate'])}"
        for number, content in enumerate(rounds, start=1)
    }


def _reduction(certificate: Mapping[str, Any]) -> Facts:
    content = certificate.get("reduction", {})
    return flatten({key: value for key, value in content.items() if key not in _DRAWN})


def _penetration(model: ReducedModel) -> Facts:
    facts: Facts = {}
    for what in ("self", "obstacle"):
        report = model.certificate.get(f"{what}_penetration")
        if report is None:
            continue
        facts[f"{what} penetration"] = report["statement"]
        facts |= {
            f"{what} penetration {n}": f"{state['depth_mm']:.2g} mm, {state['nodes']} nodes, at "
            + describe_point(model.parameters, state["coordinates"])
            for n, state in enumerate(report["states"][:3], start=1)
        }
    return facts


def _unknown_loads(certificate: Mapping[str, Any]) -> Facts:
    facts = dict(certificate.get("unknown_loads", {}))
    if facts:
        facts["response_error"] = f"{100.0 * facts['response_error']:.2g} % where states are left out"
    return flatten({key.replace("_", " "): value for key, value in facts.items()})


def _stability(certificate: Mapping[str, Any]) -> Facts:
    report = certificate.get("stability", {})
    facts = flatten({key: report[key] for key in ("statement", "stable", "unstable", "unknown") if key in report})
    places = [" and ".join(place["between"]) for place in report.get("passed", [])]
    return facts | {f"change of stability {n}": f"between {place}" for n, place in enumerate(places, start=1)}


def _versions_last(provenance: Mapping[str, Any]) -> dict[str, Any]:
    """The provenance without nesting, versions by their packages' names."""
    facts = {key: value for key, value in provenance.items() if key != "versions"}
    if facts.get("linear_solver", "") is None:
        facts["linear_solver"] = "that of another program"
    return facts | dict(provenance.get("versions", {}))


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


#: Endings of a certificate's keys and the unit in which their values are.
_ERROR_UNITS = {"_mm": "mm", "_MPa": "MPa", "_Nmm": "N mm", "_N": "N"}
_ABSOLUTE = ("mean", "max", "worst_sample_mean", "largest")
_HEADER = ("field", "mean", "largest", "worst mean", "largest value", "unit", "mean / largest", "relative L2")
_SENSITIVITY_HEADER = ("parameter", "mean / largest", "relative L2")
_UNKNOWN = "–"


def error_table(certificate: Mapping[str, Any]) -> Table:
    """One row for each field with its errors, and one for the von Mises stress of each stress."""
    rows = []
    for name, entry in certificate.items():
        if name not in ("displacement", "strain") and not name.startswith(("stress_", "reaction_")):
            continue
        rows.append(_row(field_title(name), entry))
        if "von_mises" in entry:
            place = field_title(name).partition(", ")[2]
            rows.append(_row(f"von Mises stress, {place}".removesuffix(", "), entry["von_mises"]))
    return Table(rows, _HEADER)


def sensitivity_table(certificate: Mapping[str, Any]) -> Table:
    """One row for each parameter with both measures of its sensitivity's error."""
    entries = certificate.get("sensitivity", {})
    return Table([[name, *_relative(errors)] for name, errors in entries.items()], _SENSITIVITY_HEADER)


def _row(title: str, errors: Mapping[str, Any]) -> list[str]:
    ending = next((ending for ending in _ERROR_UNITS if f"mean{ending}" in errors), "")
    absolute = [_number(errors.get(name + ending), "#.3g") for name in _ABSOLUTE]
    return [title, *absolute, _ERROR_UNITS.get(ending, _UNKNOWN), *_relative(errors)]


def _relative(errors: Mapping[str, Any]) -> list[str]:
    return [_number(errors.get(name), ".2e") for name in ("mean_relative_to_largest", "relative_l2")]


def _number(value: float | None, form: str) -> str:
    if value is None or not _is_known(value):
        return _UNKNOWN
    # Thousands in full, not as a power of ten.
    return f"{value:.0f}" if abs(value) >= 1e3 else f"{value:{form}}".removesuffix(".")
