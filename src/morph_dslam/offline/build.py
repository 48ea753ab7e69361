"""`morph build`: study -> sweep -> reduction -> certified model file."""

from __future__ import annotations

from collections.abc import Iterable
from concurrent.futures import Executor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from morph_dslam.errors import StudyError
from morph_dslam.model import Parameter, ReducedModel, save_model
from morph_dslam.offline.certificate import certify, compression_percent
from morph_dslam.offline.executors import default_executor
from morph_dslam.offline.external import ExternalStudy
from morph_dslam.offline.neighbour_tree import neighbour_tree
from morph_dslam.offline.problem import ModelMesh, ParametricStudy, Snapshot, bounds
from morph_dslam.offline.provenance import provenance
from morph_dslam.offline.reduction.method import METHODS, ReductionTask
from morph_dslam.offline.sampling import held_out_samples, training_samples
from morph_dslam.offline.snapshots import load_outputs, load_snapshot
from morph_dslam.offline.stability import stability_report
from morph_dslam.offline.studies.study import Study, load_study
from morph_dslam.offline.studies.study_sections import ReductionSection
from morph_dslam.offline.sweep import SweepResult, run_sweep

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Solutions:
    """Snapshots of a study, solved or read.

    Attributes
    ----------
    seen : to make the model from; mirror images of one solution form a group. unseen : to measure its error.
    failed : coordinates and reason of each sample that could not be solved.
    stability : see `stability_report`; None for solutions of another program.
    """

    mesh: ModelMesh
    parameters: tuple[Parameter, ...]
    seen: list[list[Snapshot]]
    unseen: list[Snapshot]
    failed: list[dict[str, Any]] = field(default_factory=list)
    stability: dict[str, Any] | None = None


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
    text = None
    if isinstance(study, Path):
        path = study / "study.toml" if study.is_dir() else study
        study = load_study(path)
        text = path.read_text()
    if not output.parent.is_dir():
        raise StudyError(f"the folder {output.parent} for the model file does not exist: make it first")
    if isinstance(study, ExternalStudy):
        solutions = _read(study)
    else:
        solutions = _solve(study, output.with_name(output.name + ".snapshots"), workers, executor)
    model = _certified(solutions, study.reduction, study.name)
    model.provenance.update(provenance(text or study.model_dump_json(), study, model))
    save_model(output, model)
    return model


def _solve(study: ParametricStudy, folder: Path, workers: int | None, executor: Executor | None) -> Solutions:
    """Solve all samples of a study, or find them in ``folder``."""
    training, held_out = training_samples(study), held_out_samples(study)
    samples = np.vstack([training, held_out])
    if executor is None:
        with default_executor(workers or study.work.workers) as processes:
            result = run_sweep(study, study.canonical(samples), folder, processes)
    else:
        result = run_sweep(study, study.canonical(samples), folder, executor)
    unseen = _gather(study, samples, result, range(len(training), len(samples)))
    return Solutions(
        study.model_mesh(),
        study.model_parameters(),
        _gather(study, samples, result, range(len(training))),
        [images[0] for images in unseen],
        [
            {"coordinates": samples[index].tolist(), "reason": reason}
            for index, reason in sorted(result.failed.items())
        ],
        _stability(study, study.canonical(samples), result),
    )


def _stability(study: ParametricStudy, samples: Array, result: SweepResult) -> dict[str, Any]:
    """Stability of the solutions at ``samples`` (n, d), canonical, along the tree that joins them."""
    outputs = {index: load_outputs(path) for index, path in result.solved.items()}
    pivots = {
        index: int(values["negative_pivots"]) if "negative_pivots" in values else None
        for index, values in outputs.items()
    }
    _, parents = neighbour_tree(samples, study.scale(), study.root(), failed=result.failed)
    return stability_report(study.model_parameters(), samples, pivots, parents)


def _read(study: ExternalStudy) -> Solutions:
    """The solutions of another program, those that measure the error drawn by chance."""
    mesh, parameters, snapshots = study.solutions()
    training, held_out = study.split(len(snapshots))
    return Solutions(
        mesh, parameters, [[snapshots[index]] for index in training], [snapshots[index] for index in held_out]
    )


def _gather(
    study: ParametricStudy, samples: Array, result: SweepResult, which: Iterable[int]
) -> list[list[Snapshot]]:
    """For each solved sample its snapshot, followed by those mirror images that lie in the box too."""
    lower, upper = bounds(study).T
    tolerance = 1e-9 * (upper - lower)
    groups = []
    for index in which:
        if index in result.solved:
            images = study.images(load_snapshot(result.solved[index]))
            images.sort(key=lambda image: float(np.abs(image.coordinates - samples[index]).max()))
            groups.append(
                [
                    image
                    for image in images
                    if np.all(image.coordinates >= lower - tolerance)
                    and np.all(image.coordinates <= upper + tolerance)
                ]
            )
    return groups


def _certified(solutions: Solutions, options: ReductionSection, name: str) -> ReducedModel:
    """The reduced model of the solutions seen, with its errors at those unseen."""
    seen, unseen = solutions.seen, solutions.unseen
    if len(unseen) < 4:
        raise StudyError(f"only {len(unseen)} held-out samples converged: too few to certify the model")
    model = METHODS["pod"](ReductionTask(solutions.mesh, solutions.parameters, seen, options, name))
    certificate = certify(model, unseen)
    certificate["compression_percent"] = compression_percent(model, len(seen) + len(unseen))
    certificate["samples"] = {"training": len(seen), "held_out": len(unseen), "failed": solutions.failed}
    if solutions.stability is not None:
        certificate["stability"] = solutions.stability
    model.certificate.update(certificate)
    return model
