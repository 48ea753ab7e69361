"""Solved samples of a study for the benchmarks of reduction: kept ones are read, the others solved first."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from morph_dslam import ReducedModel
from morph_dslam.extend.reduction import ReductionTask, certify, reduction_method
from morph_dslam.extend.studies import (
    Snapshot,
    SolidStudy,
    default_executor,
    held_out_samples,
    load_snapshot,
    run_sweep,
    training_samples,
)


@dataclass(frozen=True)
class SolvedStudy:
    """Solutions of a study, those that models are made from and those that measure their errors.

    Attributes
    ----------
    seconds : that the solves took; close to none where they were kept.
    files : of the training solutions.
    """

    study: SolidStudy
    training: list[Snapshot]
    held_out: list[Snapshot]
    seconds: float
    files: tuple[Path, ...]

    def task(self, **options: object) -> ReductionTask:
        """What a method of reduction is given, with some of the study's [reduction] changed."""
        section = type(self.study.reduction)
        changed = section.model_validate(self.study.reduction.model_dump(exclude_unset=True) | options)
        return ReductionTask(
            self.study.model_mesh(),
            self.study.model_parameters(),
            [[snapshot] for snapshot in self.training],
            changed,
            self.study.name,
            self.study.sweep_problem,
            self.files,
        )

    def reduce(self, method: str, **options: object) -> ReducedModel:
        """A model by one method, certified by the held-out solutions."""
        model = reduction_method(method).reduce(self.task(method=method, **options))
        model.certificate.update(certify(model, self.held_out))
        return model

    def displacements(self) -> SolvedStudy:
        """The same with displacements alone and without derivatives: what the paper's method is given."""
        training, held_out = (
            [Snapshot(s.coordinates, {"displacement": s.fields["displacement"]}) for s in part]
            for part in (self.training, self.held_out)
        )
        return SolvedStudy(self.study, training, held_out, self.seconds, self.files)


def solve_study(study: SolidStudy, folder: Path, workers: int | None = None) -> SolvedStudy:
    """Solve all samples of a study that ``folder`` does not hold yet."""
    training = training_samples(study)
    samples = np.vstack([training, held_out_samples(study)])
    began = time.perf_counter()
    with default_executor(workers or study.work.workers) as executor:
        result = run_sweep(study, study.canonical(samples), folder, executor)
    seconds = time.perf_counter() - began
    solved = sorted(result.solved.items())
    files = tuple(path for index, path in solved if index < len(training))
    snapshots = [load_snapshot(path) for _, path in solved]
    return SolvedStudy(study, snapshots[: len(files)], snapshots[len(files) :], seconds, files)
