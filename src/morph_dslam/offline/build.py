"""`morph build`: study -> sweep -> reduction -> certified model file."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable
from concurrent.futures import Executor
from importlib.metadata import version
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from morph_dslam.errors import StudyError
from morph_dslam.model import ReducedModel, save_model
from morph_dslam.offline.certificate import certify, compression_percent
from morph_dslam.offline.problem import ParametricStudy, Snapshot, bounds
from morph_dslam.offline.reduction import reduce
from morph_dslam.offline.snapshots import load_snapshot
from morph_dslam.offline.study import Study, load_study
from morph_dslam.offline.sweep import (
    SweepResult,
    default_executor,
    held_out_samples,
    run_sweep,
    training_samples,
)

Array = NDArray[np.float64]


def build(
    study: Path | Study, output: Path, workers: int | None = None, executor: Executor | None = None
) -> ReducedModel:
    """Solve a study and write its model file.

    Snapshots are kept beside the output in ``<output>.snapshots``: an interrupted build goes on from them.

    Parameters
    ----------
    study : a study, or the file of one. output : the model file. workers : processes, the study's own
        number if absent. executor : what to solve on in their place, a Dask cluster's say.

    Raises
    ------
    StudyError
        If the study is wrong or too few samples converge.
    """
    text = study.read_text() if isinstance(study, Path) and study.is_file() else None
    if isinstance(study, Path):
        study = load_study(study)
    if not output.parent.is_dir():
        raise StudyError(f"the folder {output.parent} for the model file does not exist: make it first")
    training, held_out = training_samples(study), held_out_samples(study)
    samples = np.vstack([training, held_out])
    folder = output.with_name(output.name + ".snapshots")
    if executor is None:
        with default_executor(workers or study.work.workers) as processes:
            result = run_sweep(study, study.canonical(samples), folder, processes)
    else:
        result = run_sweep(study, study.canonical(samples), folder, executor)
    seen = _gather(study, samples, result, range(len(training)))
    unseen = _gather(study, samples, result, range(len(training), len(samples)))
    model = _certified(study, seen, [images[0] for images in unseen])
    model.certificate["samples"]["failed"] = [
        {"coordinates": samples[index].tolist(), "reason": reason}
        for index, reason in sorted(result.failed.items())
    ]
    model.provenance.update(_provenance(text or json.dumps(study.model_dump(mode="json")), model))
    save_model(output, model)
    return model


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


def _certified(study: ParametricStudy, seen: list[list[Snapshot]], unseen: list[Snapshot]) -> ReducedModel:
    """The reduced model of the snapshots ``seen``, with its errors at those ``unseen``."""
    if len(unseen) < 4:
        raise StudyError(f"only {len(unseen)} held-out samples converged: too few to certify the model")
    model = reduce(study, study.model_mesh(), seen)
    certificate = certify(model, unseen)
    certificate["compression_percent"] = compression_percent(model, len(seen) + len(unseen))
    certificate["samples"] = {"training": len(seen), "held_out": len(unseen), "failed": []}
    model.certificate.update(certificate)
    return model


def _provenance(study_text: str, model: ReducedModel) -> dict:
    mesh = hashlib.sha256(model.nodes.tobytes() + model.triangles.tobytes()).hexdigest()
    packages = ("morph-dslam", "ngsolve", "numpy", "scipy")
    return {
        "study": study_text,
        "mesh_sha256": mesh,
        "versions": {package: version(package) for package in packages},
    }
