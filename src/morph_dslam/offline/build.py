"""`morph build`: study -> sweep -> reduction -> certified model file."""

from __future__ import annotations

import hashlib
import logging
from concurrent.futures import Executor
from importlib.metadata import version
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from morph_dslam.errors import StudyError
from morph_dslam.model import ReducedModel, SeparatedField, save_model
from morph_dslam.offline.certificate import certify, compression_percent
from morph_dslam.offline.pod import Pod, compute_pod
from morph_dslam.offline.regression import fit_functions
from morph_dslam.offline.snapshots import FACES, Snapshot, load_snapshot, output_points
from morph_dslam.offline.study import Study, load_study
from morph_dslam.offline.sweep import SweepResult, canonical, default_executor, run_sweep, sample_box

Array = NDArray[np.float64]
log = logging.getLogger(__name__)


def build(
    study_path: Path, output: Path, workers: int | None = None, executor: Executor | None = None
) -> ReducedModel:
    """Solve a study and write its model file.

    Snapshots are kept beside the output in ``<output>.snapshots``: an interrupted build goes on from them.

    Raises
    ------
    StudyError
        If the study is wrong or too few samples converge.
    """
    study = load_study(study_path)
    if not output.parent.is_dir():
        raise StudyError(f"the folder {output.parent} for the model file does not exist: make it first")
    training = sample_box(study, study.sampling.training, study.sampling.seed, towards_edges=0.5)
    held_out = sample_box(study, study.sampling.held_out, study.sampling.seed + 1, towards_edges=0.0)
    samples = np.vstack([training, held_out])
    folder = output.with_name(output.name + ".snapshots")
    if executor is None:
        with default_executor(workers) as processes:
            result = run_sweep(study, canonical(study, samples), folder, processes)
    else:
        result = run_sweep(study, canonical(study, samples), folder, executor)

    seen = _gather(study, samples, result, range(len(training)))
    unseen = _gather(study, samples, result, range(len(training), len(samples)))
    if len(unseen) < 4:
        raise StudyError(f"only {len(unseen)} held-out samples converged: too few to certify the model")
    model = reduce(study, seen)
    certificate = certify(model, [snapshots[0] for snapshots in unseen])
    certificate["compression_percent"] = compression_percent(model, len(samples))
    certificate["samples"] = {
        "training": len(seen),
        "held_out": len(unseen),
        "failed": [
            {"coordinates": samples[index].tolist(), "reason": reason}
            for index, reason in sorted(result.failed.items())
        ],
    }
    model.certificate.update(certificate)
    model.provenance.update(_provenance(study_path, model))
    save_model(output, model)
    return model


def _gather(study: Study, samples: Array, result: SweepResult, which: range) -> list[list[Snapshot]]:
    """For each solved sample its snapshot, followed by those mirror images that lie in the box too."""
    lower, upper = study.parameters.bounds.T
    tolerance = 1e-9 * (upper - lower)
    groups = []
    for index in which:
        if index in result.solved:
            images = load_snapshot(result.solved[index]).images(study)
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


def reduce(study: Study, groups: list[list[Snapshot]]) -> ReducedModel:
    """POD in space and polynomial functions of the parameters, for displacement and both faces' stress.

    Parameters
    ----------
    groups : snapshots; those of one group (mirror images) are left out together in cross-validation.
    """
    snapshots = [snapshot for group in groups for snapshot in group]
    fold = np.concatenate([np.full(len(group), index) for index, group in enumerate(groups)])
    coordinates = np.array([snapshot.coordinates for snapshot in snapshots])
    displacement, summary = _reduce_field(
        study,
        coordinates,
        np.array([snapshot.displacement for snapshot in snapshots]),
        np.array([snapshot.displacement_sensitivity for snapshot in snapshots]),
        fold,
    )
    stresses = {}
    for face in FACES:
        stresses[face], _ = _reduce_field(
            study,
            coordinates,
            np.array([snapshot.stress[face] for snapshot in snapshots]),
            np.array([snapshot.stress_sensitivity[face] for snapshot in snapshots]),
            fold,
        )
    points = output_points(study)
    return ReducedModel(
        name=study.name,
        nodes=np.column_stack([points, np.zeros(len(points))]),
        triangles=_grid_triangles(*study.reduction.grid),
        parameters=study.model_parameters(),
        displacement=displacement,
        stresses=stresses,
        certificate={"reduction": summary},
    )


def _reduce_field(
    study: Study, coordinates: Array, values: Array, slopes: Array, fold: NDArray[np.int64]
) -> tuple[SeparatedField, dict]:
    """One separated field from snapshots (s, n, c) and their derivatives (s, d, n, c)."""
    n_snapshots, n_points, n_components = values.shape
    weights = np.repeat(_node_weights(study), n_components)
    pod = compute_pod(
        values.reshape(n_snapshots, -1), weights, study.reduction.tolerance, study.reduction.max_modes
    )
    bounds = study.parameters.bounds
    functions, errors = fit_functions(
        coordinates,
        pod.project(values.reshape(n_snapshots, -1)),
        pod.project(slopes.reshape(n_snapshots, slopes.shape[1], -1)),
        bounds[:, 0],
        bounds[:, 1],
        study.reduction.max_degree,
        fold,
    )
    modes = pod.modes.reshape(-1, n_points, n_components)
    return SeparatedField(modes, functions), _summarise(pod, functions.multi_indices, errors)


def _summarise(pod: Pod, indices: NDArray[np.int64], errors: dict[int, float]) -> dict:
    return {
        "modes": len(pod.modes),
        "singular_values": pod.singular_values[:60].tolist(),
        "degree": int(indices.sum(axis=1).max()),
        "terms": len(indices),
        "cross_validation": {str(degree): error for degree, error in errors.items()},
    }


def _node_weights(study: Study) -> Array:
    """Trapezoidal weights of the output grid, normalised to sum 1."""
    nx, ny = study.reduction.grid
    x, y = np.ones(nx + 1), np.ones(ny + 1)
    x[[0, -1]] = y[[0, -1]] = 0.5
    return np.outer(y, x).ravel() / (nx * ny)


def _grid_triangles(nx: int, ny: int) -> NDArray[np.int64]:
    """Two triangles (2 nx ny, 3) for each grid cell, counter-clockwise seen from +z."""
    corner = (np.arange(ny)[:, None] * (nx + 1) + np.arange(nx)).ravel()
    right, above = corner + 1, corner + nx + 1
    lower = np.column_stack([corner, right, above + 1])
    upper = np.column_stack([corner, above + 1, above])
    return np.stack([lower, upper], axis=1).reshape(-1, 3)


def _provenance(study_path: Path, model: ReducedModel) -> dict:
    mesh = hashlib.sha256(model.nodes.tobytes() + model.triangles.tobytes()).hexdigest()
    packages = ("morph-dslam", "ngsolve", "numpy", "scipy")
    return {
        "study": study_path.read_text(),
        "mesh_sha256": mesh,
        "versions": {package: version(package) for package in packages},
    }
