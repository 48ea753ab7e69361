"""What an identification found: figures for programs, lines for people, a picture."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from morph_dslam.errors import IdentificationError
from morph_dslam.evaluation.force import reaction_remark
from morph_dslam.identification.identify import FACTOR, Estimate, Identification, Misfit
from morph_dslam.identification.measurements import MeasuredForces, MeasuredPoints
from morph_dslam.io.writing import writing
from morph_dslam.model import Parameter

DPI = 110


def summarise(found: Identification) -> dict[str, Any]:
    """The content of ``identification.json``, parameters in their own units, plain JSON."""
    names = [each.parameter.name for each in found.estimates]
    rows = [dict(zip(names, row, strict=True)) for row in found.correlation.tolist()]
    return {
        "parameters": [_figures(each) for each in found.estimates],
        "correlation": dict(zip(names, rows, strict=True)),
        "measurements": [_misfit_figures(misfit, names) for misfit in found.misfits],
        "groups": found.groups,
    }


def _figures(each: Estimate) -> dict[str, Any]:
    parameter = each.parameter
    return {
        "name": parameter.name,
        "unit": parameter.unit,
        "value": parameter.display(each.value),
        "standard_deviation": parameter.display(each.std),
        "interval_95": [parameter.display(end) for end in each.interval],
        "at_bound": each.at_bound,
        "identified": each.identified,
    }


def _misfit_figures(misfit: Misfit, identified: Sequence[str]) -> dict[str, Any]:
    measurement = misfit.measurement
    known, model = {*measurement.given, *identified}, measurement.model
    discretisation = model.certificate.get("discretisation", {}).get("errors", {}).get(measurement.field)
    figures = {
        "name": measurement.name,
        "unit": measurement.unit,
        "values": len(measurement.values),
        "groups": len(np.unique(measurement.groups)),
        "rms": measurement.scale * misfit.rms,
        "largest": measurement.scale * float(np.abs(misfit.predicted - measurement.values).max()),
        "at_default": [
            {"name": p.name, "unit": p.unit, "value": p.display(p.default)}
            for p in model.study_parameters
            if p.name not in known
        ],
        "discretisation_error": None if discretisation is None else discretisation["relative_l2"],
    }
    if isinstance(measurement, MeasuredForces):
        units = {p.name: p for p in measurement.model.parameters}
        rates = [(n, rate) for n, rate in measurement.loading_rates.items() if n not in identified]
        figures |= {"support": measurement.compared.support, "direction": measurement.compared.direction}
        figures |= {"left_out": measurement.left_out}
        figures |= {"why": f"they are {measurement.why_left_out}"} if measurement.left_out else {}
        figures["loading_rate_per_frame"] = {f"{n}_{units[n].unit}": units[n].display(rate) for n, rate in rates}
    return figures | ({"offset": measurement.scale * misfit.offset} if measurement.has_offset else {})


#: Estimates that are more correlated than this, either way, are named.
CORRELATED = 0.95


def identification_lines(figures: Mapping[str, Any]) -> list[str]:
    """What was identified, and what a reader must know of it."""
    said = []
    for each in figures["parameters"]:
        low, high = each["interval_95"]
        unit = "" if each["unit"] == "1" else f" {each['unit']}"
        said.append(f"{each['name']} = {each['value']:.4g}{unit}, 95 % interval {low:.4g} to {high:.4g}{unit}")
        if each["at_bound"]:
            said.append(f"note: {each['name']} is at the end of its range: the model may need a wider one")
        elif not each["identified"]:
            said.append(f"note: {each['name']} could not be identified: its interval is as wide as its range")
    names = list(figures["correlation"])
    for i, a in enumerate(names):
        for b in names[i + 1 :]:
            if abs(figures["correlation"][a][b]) > CORRELATED:
                said.append(
                    f"note: {a} and {b} are correlated by {figures['correlation'][a][b]:.3f}: what was measured tells "
                    "little more than a combination of them"
                )
    if figures["groups"] < 3 * len(names):
        said.append(
            f"note: only {figures['groups']} groups of measurements whose errors are independent of each other: "
            "intervals are rough"
        )
    said += [*_not_in_intervals(figures["measurements"]), *_at_default(figures["measurements"], FACTOR in names)]
    for each in figures["measurements"]:
        offset = f", offset {each['offset']:.3g} {each['unit']}" if "offset" in each else ""
        said.append(f"{each['name']}: {each['values']} values missed by {each['rms']:.3g} {each['unit']} rms{offset}")
        if "support" in each:
            said.append(f"note: {each['name']} is compared with {reaction_remark(each)}")
        if each.get("left_out"):
            of = each["left_out"] + each["values"]
            said.append(f"note: {each['left_out']} of {of} forces of {each['name']} are left out: {each['why']}")
        rates = each.get("loading_rate_per_frame")
        if rates is not None:
            rate = ", ".join(f"{name} {rate:.3g} a frame" for name, rate in rates.items())
            said.append(
                f"loading rate: {rate or 'not known, forces are not given by frame'}; moduli may differ at others"
            )
    return said


def _not_in_intervals(measurements: Sequence[Mapping[str, Any]]) -> list[str]:
    """By how much the model errs in each measurement because its elements are no finer, if its file says so."""
    parts = [
        f"{100.0 * each['discretisation_error']:.2g} % of the "
        + (f"force on '{each['support']}'" if "support" in each else "displacement")
        for each in measurements
        if each["discretisation_error"] is not None
    ]
    return [f"note: intervals do not contain the model's discretisation error: {', '.join(parts)}"] if parts else []


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


def write_identification(folder: Path, found: Identification) -> dict[str, Any]:
    """Write ``identification.json`` and ``identification.png``; returns the figures."""
    figures = summarise(found)
    with writing(IdentificationError, folder):
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "identification.json").write_text(json.dumps(figures, indent=2) + "\n")
        plot(folder / "identification.png", found.misfits)
    return figures


def plot(path: Path, misfits: Sequence[Misfit]) -> None:
    """What the model predicts beside measured forces, and what it misses measured points by."""
    figure = Figure(figsize=(5.2 * max(len(misfits), 1), 4.4), layout="constrained")
    for axes, misfit in zip(np.atleast_1d(figure.subplots(1, max(len(misfits), 1))), misfits, strict=False):
        if isinstance(misfit.measurement, MeasuredForces):
            _plot_forces(axes, misfit, misfit.measurement)
        elif isinstance(misfit.measurement, MeasuredPoints):
            _plot_points(axes, misfit, misfit.measurement)
        axes.grid(alpha=0.3)
    figure.savefig(path, dpi=DPI)


def _plot_forces(axes: Axes, misfit: Misfit, forces: MeasuredForces) -> None:
    parameter = next((p for p in forces.model.parameters if p.name == forces.curve.against), None)
    order = np.argsort(forces.places)
    places = forces.places[order] * (1.0 if parameter is None else parameter.display(1.0))
    axes.plot(places, forces.values[order], "k.", markersize=4, label="measured")
    axes.plot(places, misfit.predicted[order], color="#1f4e79", label="model and offset")
    axes.set_xlabel("frame" if parameter is None else _label(parameter))
    axes.set_ylabel(f"{forces.name} [N]")
    axes.legend(fontsize=8)


def _plot_points(axes: Axes, misfit: Misfit, points: MeasuredPoints) -> None:
    """What each coordinate is missed by, state by state."""
    missed = np.full(points.measured.shape, np.nan)
    missed[np.isfinite(points.measured)] = points.scale * (misfit.predicted - points.values)
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
