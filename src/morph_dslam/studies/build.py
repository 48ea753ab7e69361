"""What a build says could be wrong with its model."""

from __future__ import annotations

from concurrent.futures import Executor
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from morph_dslam.errors import StudyError
from morph_dslam.mechanics.recovery import material_points
from morph_dslam.meshing.netgen_meshing import read_surface
from morph_dslam.model import ReducedModel, save_model
from morph_dslam.model.inner_structure import InnerStructure
from morph_dslam.reduction.certificate import certify, compression_percent, stability_warnings
from morph_dslam.reduction.galerkin import FullSolutions, ReducedSolver, solid_equations
from morph_dslam.reduction.method import METHODS, ReductionTask
from morph_dslam.studies import external as solutions
from morph_dslam.studies.external import ExternalStudy, Solutions
from morph_dslam.studies.problem import ParametricStudy, announce
from morph_dslam.studies.sampling import estimator_check
from morph_dslam.studies.sections import ReductionSection
from morph_dslam.studies.study import ADAPTIVE, Study, load_study, locking_warnings, provenance, resolve_defaults
from morph_dslam.studies.sweep import SweepResult, default_executor, run_sweep
from morph_dslam.units import to_si


def build_warnings(certificate: dict[str, Any]) -> list[str]:
    """Sentences on the study's elements, the stability of its solutions, and the method of reduction."""
    of_the_method = certificate.get("reduction", {}).get("warnings", [])
    return [*certificate.get("warnings", []), *stability_warnings(certificate), *of_the_method]


# Inner structures placed in a solid: which cell each of their nodes lies in.


Array = NDArray[np.float64]


def place_inner_structure(model: ReducedModel, name: str, nodes: Array, triangles: NDArray[np.int64]) -> InnerStructure:
    """A mesh inside of the undeformed solid as a structure that the model carries.

    Parameters
    ----------
    nodes : (p, 3) in the object frame, metres. triangles : (m, 3) its surface, node indices.

    Raises
    ------
    StudyError
        If the model is that of a sheet, or a node lies outside of the solid.
    """
    if not model.cells:
        raise StudyError(f"'{model.name}' is the model of a sheet: it has no inside for '{name}'")
    try:
        points = material_points(model, nodes)
    except StudyError as error:
        low, high = (
            ", ".join(f"{1e3 * value:.1f}" for value in corner)
            for corner in (model.nodes.min(axis=0), model.nodes.max(axis=0))
        )
        raise StudyError(
            f"the inner structure '{name}' does not fit into '{model.name}': {error}; the solid reaches from "
            f"({low}) to ({high}) mm. Is the unit right, and is it drawn in the object's frame?"
        ) from error
    # Shape functions reproduce the positions to rounding; what is kept is what the model says.
    return InnerStructure(name, model.rest_positions(points), triangles.astype(np.int64), points)


def read_inner_structure(model: ReducedModel, name: str, path: Path, unit: str) -> InnerStructure:
    """The same from a surface file (.stl, .obj, .ply) drawn in ``unit`` in the object frame.

    Raises
    ------
    StudyError
        If the file cannot be read, or as of `place_inner_structure`.
    """
    surface = read_surface(path)
    return place_inner_structure(model, name, to_si(1.0, unit, "length") * surface.points, surface.triangles)


# `morph build`: study -> solutions -> reduction -> certified model file.


def build(
    study: Path | Study, output: Path, workers: int | None = None, executor: Executor | None = None
) -> ReducedModel:
    """Solve a study and write its model file.

    Snapshots are kept beside the output in ``<output>.snapshots``: an interrupted build goes on from them.

    Parameters
    ----------
    study : a study, its file, or the folder of a file study.toml. output : the model file.
    workers : processes, the study's own number if absent.
    executor : what to solve on in their place, a Dask cluster's say.

    Raises
    ------
    StudyError
        If the study is wrong or too few samples converge.
    """
    described, text = _described(study)
    if not output.parent.is_dir():
        raise StudyError(f"the folder {output.parent} for the model file does not exist: make it first")
    chosen = resolve_defaults(described)
    known = solve_or_read(chosen, output.with_name(output.name + ".snapshots"), workers, executor)
    model = certified_model(known, chosen.reduction, chosen.name)
    model.provenance.update(provenance(text, chosen, model))
    if found := locking_warnings(chosen):
        model.certificate["warnings"] = found
    save_model(output, model)
    return model


def _described(study: Path | Study) -> tuple[Study, str]:
    """A study and the text that says what it is."""
    if not isinstance(study, Path):
        return study, study.model_dump_json()
    path = study / "study.toml" if study.is_dir() else study
    return load_study(path), path.read_text()


def solve_or_read(
    study: Study, folder: Path, workers: int | None = None, executor: Executor | None = None
) -> Solutions:
    """The solutions of a study: all its samples solved, or found in ``folder``, or another program's."""
    if isinstance(study, ExternalStudy):
        return solutions.read(study)
    if executor is not None:
        return _solve(study, folder, executor)
    with default_executor(workers or study.work.workers) as processes:
        return _solve(study, folder, processes)


def _solve(study: ParametricStudy, folder: Path, executor: Executor) -> Solutions:
    def sweep(samples: Array) -> SweepResult:
        return run_sweep(study, study.canonical(samples), folder, executor)

    return solutions.solve(study, cache(study.sweep_problem), sweep)


def certified_model(known: Solutions, options: ReductionSection, name: str) -> ReducedModel:
    """The reduced model of the solutions seen, with its errors at those unseen.

    Raises
    ------
    StudyError
        If the method does not suit the solutions, or too few of them are left to measure the error.
    """
    seen, unseen = known.seen, known.unseen
    if len(unseen) < 4:
        raise StudyError(f"only {len(unseen)} held-out samples converged: too few to certify the model")
    task = ReductionTask(known.mesh, known.parameters, seen, options, name, known.problem, known.seen_files)
    method = options.method or "pod"
    announce(f"reducing {len(seen)} solutions by method {method}" if seen else f"method {method}")
    model = METHODS[method](task)
    announce(f"measuring errors at {len(unseen)} held-out solutions")
    certificate = certify(model, unseen)
    if seen:  # a method that needs no solutions compresses none
        certificate["compression_percent"] = compression_percent(model, len(seen) + len(unseen))
    certificate["samples"] = {"training": len(seen), "held_out": len(unseen), "failed": known.failed}
    if known.rounds:
        certificate["samples"]["rounds"] = known.rounds
    if options.method in ADAPTIVE:
        certificate["estimator"] = _estimator(task, known)
    if known.stability is not None:
        certificate["stability"] = known.stability
    model.certificate.update(certificate)
    return model


def _estimator(task: ReductionTask, known: Solutions) -> dict:
    """How well the estimate of adaptive sampling meets the true error at solutions unseen."""
    equations = solid_equations(task.problem() if task.problem else None)
    solver = ReducedSolver(equations, FullSolutions.read(task.files), task.box, task.options.tolerance)
    return estimator_check(solver, known.unseen_files)
