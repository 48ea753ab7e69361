"""`morph build`: study -> samples -> solutions -> reduction -> certificate -> model file."""

from __future__ import annotations

import time
from collections.abc import Mapping
from concurrent.futures import Executor
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from morph_dslam.errors import SolverError, StudyError
from morph_dslam.evaluation.model_summary import describe_point
from morph_dslam.geometry import fit_similarity
from morph_dslam.io.writing import check_no_input, writing
from morph_dslam.mechanics.spaces import default_order
from morph_dslam.meshing.mesh_notes import many_cells_note
from morph_dslam.meshing.mesh_summary import described_mesh, faces_figures
from morph_dslam.model import ReducedModel, save_model
from morph_dslam.model.stated_errors import doubtful_errors, doubtful_mesh_errors, errors_in_words
from morph_dslam.reduction.adaptive_sampling import estimator_check
from morph_dslam.reduction.bisection import COARSER
from morph_dslam.reduction.certificate import certify, compression_percent, stability_warnings, typical_sizes
from morph_dslam.reduction.galerkin import UNMOVED_BODY
from morph_dslam.reduction.registry import ReductionMethod, reduction_method
from morph_dslam.reduction.self_penetration import obstacle_report, penetration_report
from morph_dslam.reduction.task import ReductionTask
from morph_dslam.studies.defaults import resolve_defaults
from morph_dslam.studies.discretisation import discretisation_errors
from morph_dslam.studies.external import ExternalStudy
from morph_dslam.studies.load_sizes import shell_load_doubt
from morph_dslam.studies.problem import announce
from morph_dslam.studies.provenance import provenance, study_warnings
from morph_dslam.studies.sections import ReductionSection
from morph_dslam.studies.shell_study import ShellStudy
from morph_dslam.studies.solid_sections import make_mesh
from morph_dslam.studies.solid_study import SolidStudy
from morph_dslam.studies.solutions import Snapshots, take_snapshots
from morph_dslam.studies.study import Study, input_files, load_study, study_file, study_mesh_deviation, study_mesh_notes
from morph_dslam.studies.time_sampling import time_instants
from morph_dslam.studies.unknown_loads import reduce_unknown_loads
from morph_dslam.studies.weights import announced_mass
from morph_dslam.threads import one_openblas_thread

#: Fewer held-out solutions than these say nothing of the error.
FEWEST_HELD_OUT = 4
#: Responses to unknown loads that are off by more than this share are not to be trusted.
LARGEST_RESPONSE_ERROR = 0.1
#: A displacement that is a smaller share of the body's size is none: of a body that only moves, and of any.
UNSTRAINED, UNMOVED = 1e-7, 1e-14
MISSED = {
    "training": (
        "sampling ended at sampling.training = {count} solutions with {error} {where}, where the tolerance is "
        "{tolerance}: allow more, or narrow {ranges}"
    ),
    "failed": (
        "the model has {error} {where}, where the tolerance is {tolerance} and a solution in between was not found: "
        "narrow {ranges}"
    ),
    "steady": (
        "the model has {error} {where}, where the tolerance is {tolerance} and the error does not fall with more "
        "solutions, as where they change abruptly: narrow {ranges}"
    ),
}
UNSURE_LOADS = (
    "responses to unknown loads are off by {:.0f} % between the states where they are known: narrow the ranges of the "
    "parameters"
)
#: The method that needs no solutions of reduced equations.
FALLBACK = "pod"
UNSOLVED_REDUCTION = (
    'method "{}" failed: {}. Use reduction.method = "pod", take more samples (sampling.first, sampling.training), or '
    "narrow the ranges of the parameters"
)
DOUBTFUL = (
    "the model misses {} at held-out solutions: do not rely on what it says of these; take more samples, or narrow the "
    "ranges of the parameters"
)
COARSE = (
    "the mesh ({}) is too coarse: with finer elements on its cells the solutions differ by {} (relative L2), and loads "
    "and moduli found in images are off likewise. Take {}"
)


def build(
    study: str | Path | Study,
    output: str | Path | None = None,
    workers: int | None = None,
    executor: Executor | None = None,
) -> ReducedModel:
    """Solve a study and write its model file.

    Solutions are kept beside the output in ``<output>.snapshots``: an interrupted build goes on from them.

    Parameters
    ----------
    study : a study, its file, or the folder of a file study.toml.
    output : the model file to write; None to keep neither it nor the solutions.
    workers : processes to solve in, from 1 on; the study's own number if absent. A script that itself defines a law,
        or another part of the study, builds with several under ``if __name__ == "__main__":``.
    executor : what to solve on in their place: any that runs tasks in processes, a Dask client's say.

    Raises
    ------
    StudyError
        If the study is wrong, too few samples converge, or a file cannot be written.
    WorkerError
        If worker processes cannot start, or one dies.
    ArgumentError
        If ``workers`` is no whole number from 1 on.
    """
    if output is None:
        with TemporaryDirectory() as folder:
            return build(study, Path(folder) / "model.morph", workers, executor)
    output = Path(output)
    if not output.parent.is_dir():
        raise StudyError(f"the folder {output.parent} for the model file does not exist: make it first")
    described, text = _read(study)
    check_no_input([output], [study_file(study) if isinstance(study, str | Path) else None], StudyError)
    try:
        check_no_input([output], input_files(described), StudyError)
        with one_openblas_thread():
            return _built(described, text, output, workers, executor)
    except StudyError as error:
        if isinstance(study, str | Path):
            raise StudyError(f"{study_file(study)}: {error}") from error
        raise


def _built(study: Study, text: str, output: Path, workers: int | None, executor: Executor | None) -> ReducedModel:
    begin = time.thread_time()
    chosen, mesh_notes = resolve_defaults(study), []
    if isinstance(chosen, SolidStudy | ShellStudy):
        chosen.check_parameters_used()
        mesh_notes = _announce_mesh(chosen)
    _announce_doubts(chosen)
    if not isinstance(chosen, ExternalStudy) and chosen.sampling.scheme == "adaptive":
        first = chosen.sampling.first
        if isinstance(chosen, SolidStudy) and chosen.time is not None:
            first = len(time_instants(chosen))
        most = f"sampling: at most {chosen.sampling.training} solves, {first} of them first and more "
        announce(f"{most}where the error is large; then {chosen.sampling.held_out} held-out ones")
    snapshots, model = _solved(chosen, output, workers, executor, _may_fall_back(study.reduction))
    if isinstance(chosen, SolidStudy) and any(section.kind != "surface" for section in chosen.contacts):
        solutions = [*(group[0] for group in snapshots.training), *snapshots.held_out]
        model.certificate["obstacle_penetration"] = obstacle_report(
            snapshots.mesh, solutions, *chosen.obstacles(), chosen.held_components()
        )
    if isinstance(chosen, SolidStudy | ShellStudy) and chosen.unknown_loads is not None:
        announce("reducing the responses to unknown loads")
        loads, model.certificate["unknown_loads"] = reduce_unknown_loads(chosen, chosen.unknown_loads, snapshots)
        model = replace(model, unknown_loads=loads)
    # Before the discretisation, whose errors depend on which parameter is the time.
    model.provenance.update(provenance(text, chosen, model))
    model.certificate["discretisation"] = discretisation_errors(chosen, snapshots, model, time.thread_time() - begin)
    if isinstance(chosen, SolidStudy) and (deviation := study_mesh_deviation(chosen, chosen.solid_mesh())):
        model.certificate["mesh_deviation"] = deviation
    doubts = _unstrained(snapshots) or [*_too_coarse(chosen, model), *_doubtful(model)]
    if isinstance(chosen, ExternalStudy):
        doubts += chosen.doubts([*(group[0] for group in snapshots.training), *snapshots.held_out])
    if found := [*mesh_notes, *_unresolved(chosen, snapshots), *study_warnings(chosen), *doubts]:
        model.certificate["warnings"] = found
    with writing(StudyError, output):
        save_model(output, model)
    return model


def _solved(
    study: Study, output: Path, workers: int | None, executor: Executor | None, may_fall_back: bool
) -> tuple[Snapshots, ReducedModel]:
    """The solutions of a study and their certified model, by another method if its own fails and it may."""
    snapshots = take_snapshots(study, _kept_in(output), workers, executor)
    _check_held_out(study, snapshots, output)
    try:
        return snapshots, certified_model(snapshots, study.reduction, study.name)
    except _UnsolvedReduction as error:
        if not may_fall_back:
            raise
        reason = error.replaced
    announce(reason)
    snapshots, model = _solved(_with_fallback(study), output, workers, executor, may_fall_back=False)
    summary = model.certificate["reduction"]
    summary["warnings"] = [*summary.get("warnings", []), reason]
    return snapshots, model


def _kept_in(output: Path) -> Path:
    """Folder of the solutions of a model file."""
    return output.with_name(output.name + ".snapshots")


def _announce_mesh(study: SolidStudy | ShellStudy) -> list[str]:
    """Print how large the mesh is, for a wrong unit shows there before anything is solved, and which faces were chosen.

    Chosen are those of the study's own sets, and of node sets, or of several sets, that it names as one surface.
    Returned are sentences, printed too, on how the mesh differs from its file.
    """
    mesh = study.solid_mesh() if isinstance(study, SolidStudy) else study.shell_mesh()
    mass = announced_mass(study, mesh)
    announce(f"mesh: {described_mesh(mesh)}" + (f", {mass}" if mass else ""))
    if isinstance(study, SolidStudy):
        for name in mesh.surfaces.keys() - make_mesh(study.mesh).surfaces.keys():
            area, _, _ = faces_figures(mesh, mesh.surfaces[name])
            announce(f"mesh: the surface {name} is {len(mesh.surfaces[name])} faces, {1e6 * area:.4g} mm2")
    notes = study_mesh_notes(study, mesh)
    for note in (*notes, *many_cells_note(mesh)):
        announce(f"note: {note}")
    return notes


def _announce_doubts(study: Study) -> None:
    """Print what is probably not meant in a study, before it is solved for long."""
    sized = shell_load_doubt(study.problem()) if isinstance(study, ShellStudy) else ""
    sized = study.load_doubt() if isinstance(study, SolidStudy) else sized
    for sentence in filter(None, (*study_warnings(study), sized.strip())):
        announce(f"note: {sentence[0].lower()}{sentence[1:]}")


def _unstrained(snapshots: Snapshots) -> list[str]:
    """A sentence if no solution moves the body, or every one only moves it without deforming it."""
    nodes, moves = snapshots.mesh.nodes, [group[0].fields["displacement"] for group in snapshots.training]
    size, largest = float(np.linalg.norm(np.ptp(nodes, axis=0))), max(float(np.abs(move).max()) for move in moves)
    if not largest > UNMOVED * size:
        return [UNMOVED_BODY]
    if not largest > UNSTRAINED * size:
        return []
    for move in moves:
        fit = fit_similarity(nodes, nodes + move, with_scale=False)
        if np.abs(fit.apply(nodes) - nodes - move).max() > UNSTRAINED * max(size, largest):
            return []
    return ["no solution strains the body, all move it as if it were rigid: is a support missing?"]


def _unresolved(study: Study, snapshots: Snapshots) -> list[str]:
    """Sentences on where adaptive sampling has missed its tolerance: all jumps, and the worst of the rest."""
    if isinstance(study, ExternalStudy) or not snapshots.rounds:
        return []
    places = sorted(snapshots.rounds[-1].get("unresolved", []), key=lambda place: -place["estimate"])
    sentences = [_jump(snapshots, place) for place in places if place["why"] == "jump"]
    parameters = snapshots.parameters
    ranges = f"the range of {parameters[0].name}" if len(parameters) == 1 else "the ranges of the parameters"
    for why, sentence in MISSED.items():
        worst = next((place for place in places if place["why"] == why), None)
        if worst is not None:
            where = _between(snapshots, worst["between"]) if "between" in worst else _at(snapshots, worst["at"])
            of = worst.get("of", "displacement")
            error = f"an estimated error of the {of} of up to {100.0 * worst['estimate']:.2g} %"
            error = error if np.isfinite(worst["estimate"]) else "no solution of the reduced equations"
            tolerance = f"{100.0 * study.reduction.tolerance * (COARSER if of != 'displacement' else 1.0):.2g} %"
            count = study.sampling.training
            sentences.append(sentence.format(count=count, error=error, where=where, tolerance=tolerance, ranges=ranges))
    return sentences


def _at(snapshots: Snapshots, place: list[float]) -> str:
    return f"at {describe_point(snapshots.parameters, place)}"


def _between(snapshots: Snapshots, ends: list[float]) -> str:
    """An interval of the only parameter, in words."""
    (parameter,) = snapshots.parameters
    low, high = (f"{parameter.display(end):.6g}" for end in ends)
    return f"between {parameter.name} = {low} and {high} {parameter.unit}".removesuffix(" 1")


def _jump(snapshots: Snapshots, place: dict[str, Any]) -> str:
    """A sentence on an interval in which solutions jump."""
    low, high = place["between"]
    within = sum(low < snapshot.coordinates[0] < high for snapshot in snapshots.held_out)
    counted = f"of the {len(snapshots.held_out)} held-out solutions that measure the errors, {within or 'none'} "
    return (
        f"solutions jump {_between(snapshots, [low, high])}: there the model is off by up to "
        f"{100.0 * place['estimate']:.2g} % of the largest {place['of']}, and {counted}"
        f"{'lie' if within > 1 else 'lies'} there; build each side by itself"
    )


def _doubtful(model: ReducedModel) -> list[str]:
    """A sentence if stress or forces are reduced too badly for use."""
    errors = doubtful_errors(model)
    return [DOUBTFUL.format(errors_in_words(errors))] if errors else []


def _too_coarse(study: Study, model: ReducedModel) -> list[str]:
    """A sentence if finer elements would move the body, or hold it, otherwise by far, and what to do about it."""
    errors = doubtful_mesh_errors(model)
    if not errors or not isinstance(study, SolidStudy | ShellStudy):
        return []
    if isinstance(study, ShellStudy):
        mesh, advice = study.shell_mesh(), ["more cells, or solver.order = 3"]
    else:
        mesh = study.solid_mesh()
        order = study.solver.order or default_order(mesh)
        advice = ["elements of second order (solver.order = 2, or cells hex20)"] if order == 1 else []
        advice += [
            "more cells, over the thickness of walls and along them",
            "a study of a shell for a body that is thin",
        ]
        advice += ["shorter increments of time"] if study.time else []
    return [COARSE.format(described_mesh(mesh), errors_in_words(errors), "; or ".join(advice))]


def _read(study: str | Path | Study) -> tuple[Study, str]:
    """A study and the text that says what it is."""
    if isinstance(study, Mapping):
        raise StudyError(
            "build takes a study or its file, and this is a dictionary: make it a study with md.make_study"
        )
    if not isinstance(study, str | Path):
        return study, study.model_dump_json()
    path = study_file(study)
    return load_study(path), path.read_text(encoding="utf-8")


def _check_held_out(study: Study, snapshots: Snapshots, output: Path) -> None:
    """Raise StudyError, with what to do, if too few held-out samples converged to measure the error of a model."""
    count = len(snapshots.held_out)
    if isinstance(study, ExternalStudy) or count >= FEWEST_HELD_OUT:
        return
    # Held-out samples are the last.
    failed = snapshots.failed[-(study.sampling.held_out - count)]
    raise StudyError(
        f"only {count} of {study.sampling.held_out} held-out samples could be solved, too few to certify the model; "
        f"the first failure: {_at(snapshots, failed['coordinates'])}, {failed['reason']}. The solved ones are kept in "
        f"{_kept_in(output)}. {study.advice}, or take more with sampling.held_out"
    )


class _UnsolvedReduction(StudyError):
    """A method whose reduced equations cannot be solved.

    Attributes
    ----------
    replaced : the warning where another method takes its place.
    """

    def __init__(self, method: str, reason: SolverError) -> None:
        super().__init__(UNSOLVED_REDUCTION.format(method, reason))
        self.replaced = f'method "{method}" failed, "{FALLBACK}" took its place: {reason}'


def certified_model(snapshots: Snapshots, options: ReductionSection, name: str) -> ReducedModel:
    """The reduced model of the training solutions, with its errors at the held-out ones.

    Parameters
    ----------
    snapshots : training and held-out solutions.
    options : how to reduce them.
    name : of the model.

    Raises
    ------
    StudyError
        If the method does not suit the solutions, its reduced equations cannot be solved, or what it returns is not
        their model.
    """
    training, held_out = snapshots.training, snapshots.held_out
    method = reduction_method(options.method or "pod")
    task = ReductionTask(
        snapshots.mesh, snapshots.parameters, training, options, name, snapshots.problem, snapshots.training_files
    )
    model = _reduced(task, method)
    announce(f"measuring errors at {len(held_out)} held-out solutions")
    # Nobody knows how another program's states lie in the box.
    sizes = typical_sizes(model, snapshots.coordinates)
    model.certificate.update(certify(model, held_out, snapshots.problem is not None, sizes))
    model.certificate["compression_percent"] = compression_percent(model, len(training) + len(held_out))
    model.certificate["samples"] = _samples(snapshots)
    if method.adaptive:
        model.certificate["estimator"] = estimator_check(task, snapshots.held_out_files)
    if snapshots.stability is not None:
        model.certificate["stability"] = snapshots.stability
    penetration = penetration_report(
        snapshots.mesh, snapshots.parameters, [*(group[0] for group in training), *held_out]
    )
    if penetration is not None:
        model.certificate["self_penetration"] = penetration
    return model


def _may_fall_back(asked: ReductionSection) -> bool:
    """Whether another method may stand in for the default one: the study asks for none, nor for functions."""
    return asked.method is asked.format is asked.basis is None


def _with_fallback(study: Study) -> Study:
    """The same study with the method that needs no reduced equations, and as many solutions as may be.

    Those of adaptive sampling are as few as the projected equations need; what fits functions to them needs more.
    """
    changes: dict[str, Any] = {"reduction": study.reduction.model_copy(update={"method": FALLBACK})}
    if not isinstance(study, ExternalStudy) and study.sampling.scheme == "adaptive":
        changes["sampling"] = study.sampling.model_copy(update={"scheme": "sobol"})
    return study.model_copy(update=changes)


def _reduced(task: ReductionTask, method: ReductionMethod) -> ReducedModel:
    """The model of a task (`certified_model`)."""
    announce(f"reducing {len(task.groups)} solutions by method {method.name}")
    try:
        return _checked(method.reduce(task), task, method.name)
    except SolverError as error:
        raise _UnsolvedReduction(method.name, error) from error


def _checked(model: object, task: ReductionTask, method: str) -> ReducedModel:
    """What a method of reduction returned; StudyError unless it is a model with fields like those of the solutions."""
    said = f"the method of reduction '{method}' returned"
    if not isinstance(model, ReducedModel):
        raise StudyError(f"{said} an object of type {type(model).__name__}: return task.model(fields, summary)")
    solution = task.snapshots[0]
    for name, field in model.fields.items():
        values, solved = field.value(solution.coordinates), solution.fields.get(name)
        if solved is not None and values.shape != solved.shape:
            sizes = ", ".join(map(str, solved.shape))
            raise StudyError(
                f"{said} the field '{name}' of shape {values.shape}, and that of a solution is ({sizes}): give modes "
                f"of shape (n_modes, {sizes})"
            )
        if not (np.isfinite(values).all() and np.isfinite(field.modes).all()):
            raise StudyError(f"{said} the field '{name}' with values that are not finite: check modes and functions")
    return model


def _samples(snapshots: Snapshots) -> dict[str, Any]:
    """Numbers of samples, as the certificate has them."""
    counts = {"training": len(snapshots.training), "held_out": len(snapshots.held_out), "failed": snapshots.failed}
    return counts | ({"rounds": snapshots.rounds} if snapshots.rounds else {})


def build_warnings(certificate: dict[str, Any]) -> list[str]:
    """Sentences on the study's elements, what its solutions pass through, their stability, the method of reduction."""
    of_the_method = certificate.get("reduction", {}).get("warnings", [])
    error = certificate.get("unknown_loads", {}).get("response_error", 0.0)
    loads = [UNSURE_LOADS.format(100.0 * error)] if error > LARGEST_RESPONSE_ERROR else []
    reports = (certificate.get(name) for name in ("self_penetration", "obstacle_penetration"))
    passing = [report["statement"] for report in reports if report and report["states"]]
    return [*certificate.get("warnings", []), *passing, *stability_warnings(certificate), *loads, *of_the_method]
