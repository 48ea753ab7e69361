"""What an identification found: figures for programs, lines for people, a picture."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from morph_dslam.errors import IdentificationError
from morph_dslam.evaluation.force import SMALL_SHARE, noticed, reaction_remark
from morph_dslam.evaluation.likeness import root_mean_square
from morph_dslam.identification.doubts import notices, size_factor
from morph_dslam.identification.found import Estimate, Identification, Misfit
from morph_dslam.identification.measured_forces import MeasuredForces
from morph_dslam.identification.measured_points import MeasuredPoints
from morph_dslam.identification.missed_states import missed_state_notes, state_figures
from morph_dslam.identification.moved_states import moved_state_notes, moved_states
from morph_dslam.identification.point_doubts import MOST_MISSED, point_doubt_notes, point_doubts
from morph_dslam.identification.values import FACTOR
from morph_dslam.io.folders import check_free
from morph_dslam.io.writing import writing
from morph_dslam.model import Parameter
from morph_dslam.units import FACTORS

if TYPE_CHECKING:
    from morph_dslam.identification.given_loads import GivenLoads

DPI = 110


def summarise(found: Identification) -> dict[str, Any]:
    """The content of ``identification.json``, parameters in their own units, plain JSON."""
    names = [each.parameter.name for each in found.estimates]
    rows = [dict(zip(names, row, strict=True)) for row in found.correlation.tolist()]
    return {
        "parameters": [_figures(each) for each in found.estimates],
        "correlation": dict(zip(names, rows, strict=True)),
        "measurements": [_misfit_figures(misfit, found) for misfit in found.misfits],
        "groups": found.groups,
        "curve_factor_standard_deviation": found.curve_std,
        **({} if found.loads is None else {"loads": _load_figures(found.loads)}),
    }


def _load_figures(loads: GivenLoads) -> dict[str, Any]:
    """Those of given size, beside a factor of all moduli."""
    return {
        "are_known": loads.are_known,
        "divided_by_factor": sorted(loads.scaled),
        "not_scaled": [load.name for load in loads.unscaled],
    }


def _figures(each: Estimate) -> dict[str, Any]:
    parameter = each.parameter
    return {
        "name": parameter.name,
        "unit": parameter.unit,
        "range": [parameter.display(parameter.lower), parameter.display(parameter.upper)],
        "value": parameter.display(each.value),
        "standard_deviation": parameter.display(each.std),
        "standard_deviation_by_model": parameter.display(each.model_std),
        "standard_deviation_by_run": parameter.display(each.run_std),
        "interval_95": [parameter.display(end) for end in each.interval],
        "at_bound": each.at_bound,
        "as_wide_as_range": each.wide,
        "identified": each.identified,
    }


def _misfit_figures(misfit: Misfit, found: Identification) -> dict[str, Any]:
    """Those of one measurement."""
    measurement, identified = misfit.measurement, [each.parameter.name for each in found.estimates]
    known, scale = {*measurement.given, *identified}, measurement.scale
    figures = {
        "name": measurement.name,
        "unit": measurement.unit,
        "values": len(measurement.values),
        "groups": len(np.unique(measurement.groups)),
        "rms": scale * misfit.rms,
        "largest": scale * float(np.abs(misfit.missed).max()),
        "change_rms": scale * root_mean_square(misfit.changes),
        "model_error_rms": scale * misfit.model_rms,
        "run_error_rms": scale * misfit.run_rms,
        "change_over_range_rms": dict(zip(identified, (scale * misfit.by_range).tolist(), strict=True)),
        "mesh_error_stated": measurement.mesh_error_stated,
        "at_default": [
            {"name": p.name, "unit": p.unit, "value": p.display(p.default)}
            for p in measurement.model.study_parameters
            if p.name not in known
        ],
    }
    if isinstance(measurement, MeasuredForces):
        return figures | _force_figures(misfit, measurement, identified, found.size_factor(measurement))
    if isinstance(measurement, MeasuredPoints):
        figures |= {"span_of_object": measurement.span, "states": state_figures(misfit, measurement)}
        figures |= point_doubts(misfit, measurement, found)
        return figures | (_motion_figures(misfit, measurement) if measurement.aligned else {})
    return figures


def _motion_figures(misfit: Misfit, points: MeasuredPoints) -> dict[str, Any]:
    """Those of points that were aligned."""
    moved = np.sqrt(3.0) * points.scale * root_mean_square(misfit.adjustment)
    return {"moved_rms": moved, "states_moved": moved_states(misfit, points)}


def _force_figures(
    misfit: Misfit, forces: MeasuredForces, identified: Sequence[str], moduli: float | None
) -> dict[str, Any]:
    """Those that points do not have."""
    units = {p.name: p for p in forces.model.parameters}
    rates = [(n, rate) for n, rate in forces.loading_rates.items() if n not in identified]
    alike, found = notices(forces, misfit.predicted, misfit.slopes, misfit.own_rms, moduli)
    own = size_factor(forces, misfit.predicted)
    figures = {
        "own_factor": own,
        "support": forces.compared.support,
        "direction": forces.compared.direction,
        "against": forces.curve.against,
        "share_of_range": forces.share_of_range,
        "lines_without_force": forces.curve.empty,
        "left_out": forces.left_out,
        "inside_with_places_times": forces.smaller_unit,
        "loading_rate_per_frame": {f"{n}_{units[n].unit}": units[n].display(rate) for n, rate in rates},
        "neighbours": None if alike is None else asdict(alike),
        "notices": [notice.content() for notice in found],
    }
    figures |= {"why": f"they are {forces.why_left_out}"} if forces.left_out else {}
    return figures | ({"offset": misfit.offset} if forces.free_zero else {})


#: Note points that lie within this part of the object.
LEAST_SPAN = 0.05
#: Estimates that are more correlated than this, either way, are named.
CORRELATED = 0.95
#: Estimates that are less correlated than this hardly depend on each other.
RELATED = 0.1


def identification_lines(figures: Mapping[str, Any]) -> list[str]:
    """What was identified, and what a reader must know of it."""
    measured = figures["measurements"]
    said = [line for each in figures["parameters"] for line in _parameter_lines(each, measured)]
    said += _held_by_ends(figures)
    names = list(figures["correlation"])
    for i, a in enumerate(names):
        for b in names[i + 1 :]:
            if abs(figures["correlation"][a][b]) > CORRELATED:
                said.append(
                    f"note: {a} and {b} are correlated by {figures['correlation'][a][b]:.3f}: what was measured tells "
                    "little more than a combination of them"
                )
    if measured and figures["groups"] < 3 * len(names):
        said.append(
            f"note: few groups of measurements whose errors are independent of each other ({figures['groups']}): "
            "intervals are rough"
        )
    said += _curves_differ(figures)
    said += [*_given_loads(figures.get("loads")), *_model_errors(figures), *_at_default(measured, FACTOR in names)]
    return said + [line for each in measured for line in _measurement_lines(each)]


def _held_by_ends(figures: Mapping[str, Any]) -> list[str]:
    """Which intervals do not hold because another parameter is at the end of its range."""
    said, at_end = [], {each["name"]: each["at_bound"] for each in figures["parameters"]}
    for end in (name for name, is_at_end in at_end.items() if is_at_end):
        row = figures["correlation"][end]
        if moved := [name for name in at_end if not at_end[name] and abs(row[name]) > RELATED]:
            said.append(
                f"note: {' and '.join(moved)} compensated for {end}, which is at the end of its range: "
                f"{'its interval does' if len(moved) == 1 else 'their intervals do'} not hold"
            )
    return said


def _curves_differ(figures: Mapping[str, Any]) -> list[str]:
    """That whole force curves disagree, and what the interval is of then."""
    std = figures["curve_factor_standard_deviation"]
    if not std > 0.0:
        return []
    own = [(m["name"], m["own_factor"]) for m in figures["measurements"] if m.get("own_factor") is not None]
    listed = ", ".join(f"{name} {100.0 * (factor - 1.0):+.2g} %" for name, factor in own)
    return [
        f"note: force curves differ as a whole by {100.0 * std:.2g} % (standard deviation of a factor), more than the "
        f"scatter of each explains; against the model's forces they are {listed}: specimens, their sections, load "
        "cells or the law differ. The interval is that of the mean of all such specimens; more curves would narrow it"
    ]


def _given_loads(loads: Mapping[str, Any] | None) -> list[str]:
    """What a common factor of all moduli supposes of loads that have no moduli."""
    if loads is None:
        return []
    if not loads["are_known"]:
        return [
            f"note: the model does not say which loads act: {FACTOR} is right if supports alone move the object, or "
            "all loads grow as the moduli do"
        ]
    if not loads["not_scaled"]:
        return []
    return [
        f"note: {' and '.join(loads['not_scaled'])} of the study does not grow with the moduli: {FACTOR} is right only "
        "where this changes the shape little; a modulus that is a parameter (--parameter) has no such limit"
    ]


def _parameter_lines(each: Mapping[str, Any], measurements: Sequence[Mapping[str, Any]]) -> list[str]:
    (low, high), (lower, upper) = each["interval_95"], each["range"]
    name, unit = each["name"], "" if each["unit"] == "1" else f" {each['unit']}"
    interval = f"95 % interval {low:.4g} to {high:.4g}{unit}"
    if low <= lower and high >= upper:
        interval = f"95 % interval wider than its range, {lower:.4g} to {upper:.4g}{unit}"
    elif each["at_bound"]:
        interval = "without an interval"
    elif low <= lower or high >= upper:
        interval += ", cut off at the end of its range"
    said, weak = [f"{name} = {each['value']:.4g}{unit}, {interval}"], _weak(each, measurements)
    if each["at_bound"]:
        advice = "" if each["as_wide_as_range"] or weak else ": the model may need a wider one"
        said.append(f"note: {name} is at the end of its range{advice}")
    if each["as_wide_as_range"]:
        said.append(f"note: {name} could not be identified: its interval is as wide as its range")
    return said + weak


def _weak(each: Mapping[str, Any], measurements: Sequence[Mapping[str, Any]]) -> list[str]:
    """Why a parameter was not identified, if over its whole range it changes less than what is missed anyway."""
    name = each["name"]
    changes = [(m, m["change_over_range_rms"][name]) for m in measurements]
    if each["identified"] or not changes or any(change >= m["rms"] for m, change in changes):
        return []
    listed = " and ".join(
        f"{m['name']} by {change:.2g} {m['unit']} rms, less than the {m['rms']:.2g} {m['unit']} that are missed"
        for m, change in changes
    )
    advice = "measure something that depends on it more"
    if each["unit"] in FACTORS["stress"] and not any("support" in m for m in measurements):
        advice = "where supports prescribe displacements, shapes hardly depend on moduli; measure forces (--force)"
    return [f"note: over its whole range {name} changes {listed}: they hardly determine it; {advice}"]


def _model_errors(figures: Mapping[str, Any]) -> list[str]:
    """Which intervals are errors of the model or of a run, and where the model's file does not state all of its."""
    said = []
    if by_model := _mostly_by("model", figures):
        said.append(
            f"note: most of the interval of {', '.join(by_model)} is the model's own error: finer elements, or more "
            "training solutions, would narrow it"
        )
    if by_run := _mostly_by("run", figures):
        said.append(
            f"note: most of the interval of {', '.join(by_run)} is by errors of the run's states, which all its frames "
            "have in common: a better known reference frame (more landmarks, --at-rest) would narrow it"
        )
    if unknown := [each["name"] for each in figures["measurements"] if not each["mesh_error_stated"]]:
        said.append(
            f"note: intervals do not contain the error of the model's mesh for {', '.join(unknown)}: its file does not "
            "state it"
        )
    return said


def _mostly_by(cause: str, figures: Mapping[str, Any]) -> list[str]:
    """The parameters more than half of whose variance has this cause."""
    least = np.sqrt(0.5)
    return [
        each["name"]
        for each in figures["parameters"]
        if each[f"standard_deviation_by_{cause}"] > least * each["standard_deviation"]
    ]


def _measurement_lines(each: Mapping[str, Any]) -> list[str]:
    name, unit = each["name"], each["unit"]
    offset = f", offset {each['offset']:.3g} {unit}" if "offset" in each else ""
    offset += f", moved by {each['moved_rms']:.3g} {unit} rms" if "moved_rms" in each else ""
    said = [f"{name}: {each['values']} values missed by {each['rms']:.3g} {unit} rms{offset}", *_doubts(each)]
    if "support" not in each:
        return said
    said.append(f"note: {name} is compared with {reaction_remark(each)}")
    if each["left_out"]:
        of = each["left_out"] + each["values"]
        scale = each["inside_with_places_times"]
        unit = (
            f"; with {scale:.3g} times its places all would be inside: is the unit in the title right?" if scale else ""
        )
        said.append(f"note: {each['left_out']} of {of} forces of {name} are left out: {each['why']}{unit}")
    if each["lines_without_force"]:
        said.append(f"note: {name} is empty in {each['lines_without_force']} lines of its file")
    rate = ", ".join(f"{name} {rate:.3g} a frame" for name, rate in each["loading_rate_per_frame"].items())
    return [*said, f"loading rate: {rate or 'not known, forces are not given by frame'}; moduli may differ at others"]


def _doubts(each: Mapping[str, Any]) -> list[str]:
    """What speaks against a measurement being what the model describes."""
    said, name, unit = [], each["name"], each["unit"]
    if each["rms"] > MOST_MISSED * each["change_rms"]:
        where = "one frame" if "moved_rms" in each else "the object frame (--align-points)"
        check = "--reaction" if "support" in each else f"that x, y, z are positions in {where}"
        said.append(
            f"note: {name} changed by {each['change_rms']:.3g} {unit} rms, and {each['rms']:.3g} {unit} of it is "
            f"missed: check the units, and {check}"
        )
    said += missed_state_notes(each)
    said += moved_state_notes(each)
    said += point_doubt_notes(each)
    span, share = each.get("span_of_object"), each.get("share_of_range")
    if span is not None and span < LEAST_SPAN:
        said.append(
            f"note: all points lie within {100.0 * span:.2g} % of the object: is the unit of their places right?"
        )
    if share is not None and share < SMALL_SHARE:
        said.append(
            f"note: {name} covers {100.0 * share:.2g} % of the model's range of {each['against']}: is the unit in the "
            "name of its first column right?"
        )
    return said + [f"note: {text}" for text in noticed(each)]


def _at_default(measurements: Sequence[Mapping[str, Any]], scaled: bool) -> list[str]:
    """Which parameters have their defaults because nothing gives them.

    Parameters
    ----------
    measurements : their figures.
    scaled : whether a common factor of all moduli was identified.
    """
    of: dict[str, list[str]] = {}
    for each in measurements:
        values = [f"{p['name']} = {p['value']:.4g} {p['unit']}".removesuffix(" 1") for p in each["at_default"]]
        of.setdefault(", ".join(values), []).append(each["name"])
    end = f"; {FACTOR} multiplies the moduli there" if scaled else ""
    return [
        f"note: parameters that nothing gives have their defaults for {', '.join(names)}: {values}{end}"
        for values, names in of.items()
        if values
    ]


def last_line(figures: Mapping[str, Any]) -> str:
    """All estimates in one line."""
    parts = []
    for each in figures["parameters"]:
        name = each["name"] if each["unit"] == "1" else f"{each['name']}_{each['unit']}"
        parts.append(f"{name}={each['value']:.5g} std={each['standard_deviation']:.2g}")
    return " ".join(parts)


#: The file by which an identification is known.
RESULT = "identification.json"


def check_no_identification(folder: str | Path, overwrite: bool) -> None:
    """Raise IdentificationError if a folder holds an identification that is not to be overwritten."""
    names = (RESULT, "identification.png")
    check_free(Path(folder), names, "an identification", overwrite, IdentificationError)


def write_identification(folder: str | Path, found: Identification) -> dict[str, Any]:
    """Write ``identification.json`` and ``identification.png``; returns the figures."""
    folder = Path(folder)
    figures = summarise(found)
    with writing(IdentificationError, folder):
        folder.mkdir(parents=True, exist_ok=True)
        plot(folder / "identification.png", found.misfits)
        # The last one: by it an identification is known.
        (folder / RESULT).write_text(json.dumps(figures, indent=2) + "\n", encoding="utf-8")
    return figures


def plot(path: Path, misfits: Sequence[Misfit]) -> None:
    """What the model predicts beside measured forces, and what it misses forces and points by."""
    columns = max(len(misfits), 1)
    figure = Figure(figsize=(5.2 * columns, 5.2), layout="constrained")
    grid = figure.add_gridspec(2, columns, height_ratios=(2.0, 1.0))
    for column, misfit in enumerate(misfits):
        if isinstance(misfit.measurement, MeasuredForces):
            above = figure.add_subplot(grid[0, column])
            below = figure.add_subplot(grid[1, column], sharex=above)
            _plot_forces(above, below, misfit, misfit.measurement)
        elif isinstance(misfit.measurement, MeasuredPoints):
            _plot_points(figure.add_subplot(grid[:, column]), misfit, misfit.measurement)
    for axes in figure.axes:
        axes.grid(alpha=0.3)
    figure.savefig(path, dpi=DPI)


def _plot_forces(above: Axes, below: Axes, misfit: Misfit, forces: MeasuredForces) -> None:
    """The forces, and what is missed of them."""
    parameter = next((p for p in forces.model.parameters if p.name == forces.curve.against), None)
    order = np.argsort(forces.places)
    places = forces.places[order] * (1.0 if parameter is None else parameter.display(1.0))
    fitted = "model and offset" if forces.free_zero else "model"
    above.plot(places, forces.values[order], "k.", markersize=4, label="measured")
    above.plot(places, misfit.predicted[order], color="#1f4e79", label=fitted)
    above.set_ylabel(f"{forces.name} [N]")
    above.tick_params(labelbottom=False)
    above.legend(fontsize=8)
    below.plot(places, misfit.missed[order], ".-", color="#1f4e79", markersize=4, linewidth=0.8)
    below.axhline(0.0, color="#888888", linewidth=0.8)
    below.set_xlabel("frame" if parameter is None else _label(parameter))
    below.set_ylabel("predicted - measured [N]", fontsize=8)


def _plot_points(axes: Axes, misfit: Misfit, points: MeasuredPoints) -> None:
    """What each coordinate is missed by, state by state."""
    missed = np.full(points.measured.shape, np.nan)
    missed[np.isfinite(points.measured)] = points.scale * misfit.missed
    states = list(dict.fromkeys(points.states))
    at = np.array([states.index(state) for state in points.states])
    for axis, name in enumerate("xyz"):
        axes.plot(at + 0.12 * (axis - 1), missed[:, axis], "x+1"[axis], markersize=8, label=name)
    axes.axhline(0.0, color="#888888", linewidth=0.8)
    axes.set_xticks(range(len(states)), states, rotation=40, ha="right", fontsize=8)
    axes.set_ylabel("predicted - measured [mm]")
    axes.set_title(f"{points.scale * misfit.rms:.2f} mm rms", fontsize=10)
    axes.legend(fontsize=8)


def _label(parameter: Parameter) -> str:
    return f"{parameter.name} [{parameter.unit}]"
