"""The solutions that a model is made from and certified with: solved by a sweep, or read from files."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from concurrent.futures import Executor
from dataclasses import dataclass, field
from functools import cache
from numbers import Integral
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from morph_dslam.errors import ArgumentError
from morph_dslam.mechanics.loads import reaction_names, with_reactions
from morph_dslam.model import Parameter
from morph_dslam.reduction.adaptive_sampling import sample_adaptively
from morph_dslam.reduction.bisection import sample_by_bisection
from morph_dslam.reduction.certificate import stability_report
from morph_dslam.reduction.registry import reduction_method
from morph_dslam.studies.executors import default_executor, needs_main
from morph_dslam.studies.external import ExternalStudy
from morph_dslam.studies.problem import ModelMesh, ParametricStudy, Snapshot, SweepProblem, bounds
from morph_dslam.studies.sample_task import keep_threads
from morph_dslam.studies.sampling import held_out_samples, training_samples
from morph_dslam.studies.snapshots import load_outputs, load_snapshot
from morph_dslam.studies.study import Study
from morph_dslam.studies.sweep import SweepResult, neighbour_tree, run_sweep

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Snapshots:
    """The solutions of a study, solved or read.

    Attributes
    ----------
    mesh : of the model.
    parameters : with their ranges.
    training : to make the model from; mirror images of one solution form a group.
    held_out : to measure its error.
    training_files : where the training solutions are kept with the solver's states; empty for another program's.
    held_out_files : the same of the held-out ones.
    problem : makes what they were solved with, once; None for another program's.
    failed : coordinates and reason of each sample that could not be solved.
    stability : see `stability_report`; None for another program's.
    rounds : number of solves and largest estimated error of each round of adaptive sampling.
    """

    mesh: ModelMesh
    parameters: tuple[Parameter, ...]
    training: list[list[Snapshot]]
    held_out: list[Snapshot]
    training_files: tuple[Path, ...] = ()
    held_out_files: tuple[Path, ...] = ()
    problem: Callable[[], SweepProblem] | None = None
    failed: list[dict[str, Any]] = field(default_factory=list)
    stability: dict[str, Any] | None = None
    rounds: list[dict[str, Any]] = field(default_factory=list)

    @property
    def coordinates(self) -> list[Array]:
        """Parameters (d,) of all solutions, SI."""
        return [each.coordinates for group in [*self.training, self.held_out] for each in group]


def take_snapshots(
    study: Study, folder: Path, workers: int | None = None, executor: Executor | None = None
) -> Snapshots:
    """The solutions of a study: all its samples solved, or found in ``folder``, or another program's.

    Parameters
    ----------
    study : with its defaults resolved (`resolve_defaults`).
    folder : where solutions are kept.
    workers : processes to solve in, the study's own number if absent.
    executor : what to solve on in their place.

    Raises
    ------
    ArgumentError
        If ``workers`` is no whole number from 1 on.
    """
    if workers is not None and (not isinstance(workers, Integral) or workers < 1):
        raise ArgumentError(f"workers is {workers!r}: give a number of processes from 1 on, or None for the study's")
    if isinstance(study, ExternalStudy):
        mesh, parameters, snapshots = study.solutions()
        training, held_out = study.split(len(snapshots))
        return Snapshots(mesh, parameters, [[snapshots[i]] for i in training], [snapshots[i] for i in held_out])
    if executor is not None:
        return _solve(study, folder, executor)
    with default_executor(workers or study.work.workers, needs_main(study)) as processes:
        return _solve(study, folder, processes)


def _solve(study: ParametricStudy, folder: Path, executor: Executor) -> Snapshots:
    """Choose the samples and solve them."""
    keep_threads(study)  # what is reduced and refined later runs in this process

    def sweep(samples: Array) -> SweepResult:
        return run_sweep(study, study.canonical(samples), folder, executor)

    problem, rounds = cache(study.sweep_problem), []
    if study.sampling.scheme != "adaptive":
        training = training_samples(study)
    elif reduction_method(study.reduction.method or "").bisects:
        training, rounds = sample_by_bisection(study, sweep)
    else:
        training, rounds = sample_adaptively(study, problem(), sweep)
    samples = np.vstack([training, held_out_samples(study)])
    return _gather(study, samples, len(training), sweep(samples), problem, rounds)


def _gather(
    study: ParametricStudy,
    samples: Array,
    n_training: int,
    result: SweepResult,
    problem: Callable[[], SweepProblem],
    rounds: list[dict[str, Any]],
) -> Snapshots:
    """The snapshots of solved ``samples`` (n, d), the first ``n_training`` of them to train on."""
    mesh = study.model_mesh()
    training = _images(study, samples, result, range(n_training))
    held_out = _images(study, samples, result, range(n_training, len(samples)))
    first_of_each = [group[0] for group in training]
    names = reaction_names(first_of_each, float(np.linalg.norm(np.ptp(mesh.nodes, axis=0))))
    files = sorted(result.solved.items())
    return Snapshots(
        mesh,
        study.model_parameters(),
        [[with_reactions(image, names) for image in images] for images in training],
        [with_reactions(images[0], names) for images in held_out],
        tuple(path for index, path in files if index < n_training),
        tuple(path for index, path in files if index >= n_training),
        problem,
        [{"coordinates": samples[index].tolist(), "reason": reason} for index, reason in sorted(result.failed.items())],
        _stability(study, study.canonical(samples), result),
        rounds,
    )


def _images(study: ParametricStudy, samples: Array, result: SweepResult, which: Iterable[int]) -> list[list[Snapshot]]:
    """For each solved sample its snapshot, followed by those mirror images that lie in the box too."""
    lower, upper = bounds(study).T
    tolerance = 1e-9 * (upper - lower)

    def inside(image: Snapshot) -> bool:
        mu = image.coordinates
        return bool(np.all(mu >= lower - tolerance) and np.all(mu <= upper + tolerance))

    groups = []
    for index in which:
        if index in result.solved:
            images = study.images(load_snapshot(result.solved[index]))
            images.sort(key=lambda image: float(np.abs(image.coordinates - samples[index]).max()))
            groups.append([image for image in images if inside(image)])
    return groups


def _stability(study: ParametricStudy, samples: Array, result: SweepResult) -> dict[str, Any]:
    """Stability of the solutions at ``samples`` (n, d), canonical, along the tree that joins them."""
    outputs = {index: load_outputs(path) for index, path in result.solved.items()}
    pivots = {
        index: int(values["negative_pivots"]) if "negative_pivots" in values else None
        for index, values in outputs.items()
    }
    _, parents = neighbour_tree(samples, study.scale(), study.root(), failed=result.failed)
    return stability_report(study.model_parameters(), samples, pivots, parents)
