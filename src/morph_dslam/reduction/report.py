"""`NAME.report.html`: everything a build says of its model, on one page without any other file."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from tqdm import tqdm

from morph_dslam.errors import StudyError
from morph_dslam.evaluation.model_summary import describe_point, error_facts, summarise_model
from morph_dslam.evaluation.report import Block, KeyFigures, Listing, Section, Table, Text, write_report
from morph_dslam.model import ReducedModel
from morph_dslam.reduction.report_pictures import (
    ReferenceCurve,
    draw_modes,
    plot_convergence,
    plot_errors_by_parameter,
    plot_parameter_functions,
)
from morph_dslam.studies.build import build_warnings

_Part = tuple[str, list[Callable[[], Block]]]


def report_path(model_file: str | Path) -> Path:
    """Where the report of a model file is: "seal.report.html" beside "seal.morph"."""
    model_file = Path(model_file)
    return model_file.with_name(f"{model_file.name.removesuffix('.morph')}.report.html")


def write_build_report(path: str | Path, model: ReducedModel, reference: ReferenceCurve | None = None) -> None:
    """Write the report of a certified model.

    It is made from the model alone, so it can be written again at any time. A plot that cannot be drawn is
    replaced by a sentence that says why.

    Parameters
    ----------
    path : the page to write.
    model : with the certificate of its build.
    reference : a published curve, drawn beside the error against the number of modes.

    Raises
    ------
    StudyError
        If the page cannot be written.
    """
    parts = _parts(model, reference)
    sections = []
    with tqdm(total=sum(len(blocks) for _, blocks in parts), desc="report", unit="part") as progress:
        for heading, makers in parts:
            blocks = []
            for make in makers:
                blocks.append(_made(make))
                progress.update()
            sections.append(Section(heading, blocks))
    try:
        write_report(Path(path), f"{model.name}: report of the reduced model", sections)
    except OSError as error:
        raise StudyError(f"the model is complete, but its report cannot be written: {error}") from error


def _made(make: Callable[[], Block]) -> Block:
    try:
        return make()
    except Exception as error:
        # Whatever goes wrong in a picture, hours of solves and the rest of the page must not be lost for it.
        return Text(f"This part could not be made: {type(error).__name__}: {error}", warning=True)


def _parts(model: ReducedModel, reference: ReferenceCurve | None) -> list[_Part]:
    """Headings and what makes the blocks under each."""
    certificate = model.certificate
    warnings = [lambda line=line: Text(line, warning=True) for line in build_warnings(certificate)]
    tables: list[_Part] = [
        (heading.capitalize(), [lambda table=table: table])
        for heading, table in summarise_model(model).items()
        if heading != "warnings"
    ]
    failed = [
        [describe_point(model.parameters, entry["coordinates"]), entry["reason"]]
        for entry in certificate.get("samples", {}).get("failed", [])
    ]
    study = model.provenance.get("study")
    return [
        ("In short", [lambda: _key_figures(model), *warnings]),
        ("Error against number of modes", [lambda: plot_convergence(model, reference)]),
        ("Errors over the parameter box", [lambda: plot_errors_by_parameter(model)]),
        ("Modes in space", [lambda: draw_modes(model)]),
        ("Functions of the parameters", [lambda: plot_parameter_functions(model)]),
        *tables,
        ("Samples that failed", [lambda: Table(failed, ("sample", "why"))] if failed else []),
        ("Study", [lambda: Listing("The study as it was built", study)] if study else []),
    ]


def _key_figures(model: ReducedModel) -> KeyFigures:
    """The figures that are looked for first."""
    certificate = model.certificate
    errors = certificate["displacement"]
    facts = error_facts(model)
    figures = {
        "total error": facts["total error"],
        "discretisation error": facts["discretisation error"],
        "mean reduction error": f"{errors['mean_mm']:.2g} mm",
        "largest reduction error of any node": f"{errors['max_mm']:.2g} mm",
        "largest displacement": f"{errors['largest_mm']:.3g} mm",
    }
    stresses = [entry["von_mises"] for name, entry in certificate.items() if name.startswith("stress_")]
    figures |= _largest_relative("reduction error of von Mises stress", stresses)
    figures |= _largest_relative("reduction error of sensitivities", certificate.get("sensitivity", {}).values())
    figures["displacement modes"] = str(model.displacement.n_modes)
    if "compression_percent" in certificate:
        figures["compression"] = f"{certificate['compression_percent']:.2f} %"
    return KeyFigures(figures | {"held-out solves": str(errors["n_held_out"])})


def _largest_relative(name: str, entries: Iterable[dict[str, Any]]) -> dict[str, str]:
    """The largest relative L2 error, if there is any, under its name."""
    errors = [entry["relative_l2"] for entry in entries if entry["relative_l2"] is not None]
    return {name: f"{100.0 * max(errors):.2g} %"} if errors else {}
