"""`morph build --compare`: every method that a study can use, on the same solutions, side by side."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from morph_dslam.errors import MorphError
from morph_dslam.evaluation.report import Table
from morph_dslam.model import ReducedModel
from morph_dslam.reduction.method import METHODS
from morph_dslam.studies.sections import ReductionSection
from morph_dslam.studies.study import Study, usable_methods

#: Makes a certified model of the study's solutions with these options.
Reduce = Callable[[ReductionSection], ReducedModel]

_COLUMNS = {
    "method": "method",
    "format": "format",
    "modes": "modes",
    "floats": "floats",
    "compression_percent": "compression %",
    "mean_mm": "mean mm",
    "max_mm": "max mm",
    "relative_l2": "relative",
    "sensitivity": "sensitivities",
    "stress": "stress",
    "seconds": "seconds",
}


def comparison_paths(output: Path) -> tuple[Path, Path]:
    """Where the comparison beside a model file is: figures (JSON) and plot (PNG)."""
    return output.with_suffix(".comparison.json"), output.with_suffix(".comparison.png")


def compare_methods(study: Study, reduce: Reduce) -> tuple[ReducedModel, list[dict[str, Any]]]:
    """The model of the study's own method, and one row of figures for every method.

    Other methods choose format and basis themselves. A method that cannot reduce the solutions has a row with
    the reason under "unusable". Methods that differ only in how they sample are the same here.
    """
    own = study.reduction.method
    others = [name for name in usable_methods(study)[0] if METHODS[name] is not METHODS[own or "pod"]]
    model, seconds = _timed(reduce, study.reduction)
    rows = [_row(own or "pod", model, seconds)]
    done = {METHODS[own or "pod"]}
    for name in others:
        if METHODS[name] in done:
            continue
        done.add(METHODS[name])
        options = study.reduction.model_copy(update={"method": name, "format": None, "basis": None})
        try:
            rows.append(_row(name, *_timed(reduce, options)))
        except MorphError as error:
            rows.append({"method": name, "unusable": str(error)})
    return model, rows


def _timed(reduce: Reduce, options: ReductionSection) -> tuple[ReducedModel, float]:
    start = time.perf_counter()
    model = reduce(options)
    return model, time.perf_counter() - start


def _row(method: str, model: ReducedModel, seconds: float) -> dict[str, Any]:
    certificate = model.certificate
    displacement = certificate["displacement"]
    slopes = [entry["relative_l2"] for entry in certificate.get("sensitivity", {}).values()]
    stresses = [entry["relative_l2"] for name, entry in certificate.items() if name.startswith("stress_")]
    return {
        "method": method,
        "format": certificate["reduction"].get("format", "cp"),
        "modes": model.displacement.n_modes,
        "floats": model.displacement.n_floats,
        "compression_percent": certificate.get("compression_percent"),
        "mean_mm": displacement["mean_mm"],
        "max_mm": displacement["max_mm"],
        "relative_l2": displacement["relative_l2"],
        "sensitivity": max((value for value in slopes if value is not None), default=None),
        "stress": max((value for value in stresses if value is not None), default=None),
        "seconds": seconds,
        "mean_mm_by_modes": displacement["mean_mm_by_modes"],
    }


def write_comparison(output: Path, rows: list[dict[str, Any]]) -> None:
    """Write the figures and the plot beside the model file ``output``."""
    figures, plot = comparison_paths(output)
    figures.write_text(json.dumps(rows, indent=1))
    figure = Figure(figsize=(7.0, 4.2), layout="constrained")
    axes = figure.subplots()
    for row in rows:
        if "unusable" not in row:
            errors = row["mean_mm_by_modes"]
            axes.semilogy(range(1, len(errors) + 1), errors, "o-", markersize=3, label=row["method"])
    axes.set_xlabel("number of modes")
    axes.set_ylabel("mean displacement error at held-out solutions [mm]")
    axes.grid(color="#e4e8ec")
    axes.legend(frameon=False)
    figure.savefig(plot, dpi=144)


def comparison_lines(output: Path) -> list[str]:
    """The comparison beside a model file as lines of text; methods that were of no use come last."""
    rows = json.loads(comparison_paths(output)[0].read_text())
    usable = [row for row in rows if "unusable" not in row]
    table = Table([[_text(row, key) for key in _COLUMNS] for row in usable], tuple(_COLUMNS.values()))
    return table.text() + [f"{row['method']}: {row['unusable']}" for row in rows if "unusable" in row]


def _text(row: Mapping[str, Any], key: str) -> str:
    value = row[key]
    if value is None:
        return "-"
    if key == "compression_percent":
        return f"{value:.2f}"
    return f"{value:.3g}" if isinstance(value, float) else str(value)
