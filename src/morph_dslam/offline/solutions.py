"""The solutions that a model is made from and certified with: solved by a sweep, or read from files."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from morph_dslam.model import Parameter
from morph_dslam.offline.adaptive_sampling import sample_adaptively
from morph_dslam.offline.external import ExternalStudy
from morph_dslam.offline.neighbour_tree import neighbour_tree
from morph_dslam.offline.problem import ModelMesh, ParametricStudy, Snapshot, SweepProblem, bounds
from morph_dslam.offline.reactions import reaction_names, with_reactions
from morph_dslam.offline.sampling import held_out_samples, training_samples
from morph_dslam.offline.snapshots import load_outputs, load_snapshot
from morph_dslam.offline.stability import stability_report
from morph_dslam.offline.sweep import SweepResult

Array = NDArray[np.float64]

#: Methods that make a model from the equations alone: only held-out samples are solved for them.
WITHOUT_SOLUTIONS = ("pgd",)


@dataclass(frozen=True)
class Solutions:
    """Snapshots of a study, solved or read.

    Attributes
    ----------
    seen : to make the model from; mirror images of one solution form a group. unseen : to measure its error.
    seen_files, unseen_files : where they are kept with the solver's states; empty for another program's.
    problem : makes what they were solved with, once; None for another program's.
    failed : coordinates and reason of each sample that could not be solved.
    stability : see `stability_report`; None for solutions of another program.
    rounds : number of solves and largest estimated error of each round of adaptive sampling.
    """

    mesh: ModelMesh
    parameters: tuple[Parameter, ...]
    seen: list[list[Snapshot]]
    unseen: list[Snapshot]
    seen_files: tuple[Path, ...] = ()
    unseen_files: tuple[Path, ...] = ()
    problem: Callable[[], SweepProblem] | None = None
    failed: list[dict[str, Any]] = field(default_factory=list)
    stability: dict[str, Any] | None = None
    rounds: list[dict[str, Any]] = field(default_factory=list)


def solve(
    study: ParametricStudy, problem: Callable[[], SweepProblem], sweep: Callable[[Array], SweepResult]
) -> Solutions:
    """Solve the training and held-out samples of a study.

    Parameters
    ----------
    problem : makes what the study is solved with. sweep : solves samples (n, d), or finds them on disk.
    """
    rounds: list[dict[str, Any]] = []
    if study.reduction.method in WITHOUT_SOLUTIONS:
        training = np.zeros((0, len(study.model_parameters())))
    elif study.sampling.scheme == "adaptive":
        training, rounds = sample_adaptively(study, problem(), sweep)
    else:
        training = training_samples(study)
    samples = np.vstack([training, held_out_samples(study)])
    result = sweep(samples)
    mesh = study.model_mesh()
    seen = _gather(study, samples, result, range(len(training)))
    unseen = _gather(study, samples, result, range(len(training), len(samples)))
    known = [group[0] for group in seen or unseen]
    names = reaction_names(known, float(np.linalg.norm(np.ptp(mesh.nodes, axis=0))))
    return Solutions(
        mesh,
        study.model_parameters(),
        [[with_reactions(image, names) for image in images] for images in seen],
        [with_reactions(images[0], names) for images in unseen],
        tuple(path for index, path in sorted(result.solved.items()) if index < len(training)),
        tuple(path for index, path in sorted(result.solved.items()) if index >= len(training)),
        problem,
        [
            {"coordinates": samples[index].tolist(), "reason": reason}
            for index, reason in sorted(result.failed.items())
        ],
        _stability(study, study.canonical(samples), result),
        rounds,
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


def read(study: ExternalStudy) -> Solutions:
    """The solutions of another program, those that measure the error drawn by chance."""
    mesh, parameters, snapshots = study.solutions()
    training, held_out = study.split(len(snapshots))
    return Solutions(
        mesh, parameters, [[snapshots[index]] for index in training], [snapshots[index] for index in held_out]
    )
