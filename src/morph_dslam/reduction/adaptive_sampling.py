"""Adaptive sampling: full solves where a Galerkin model of those so far is estimated to err most.

The estimate is the full Newton correction at the reduced solution, one factorisation for each candidate that
could be among the worst. Method "galerkin" adds several samples in a round, which are solved side by side;
"reduced_basis" adds one, as the weak greedy algorithm has it: fewer solves, one after the other. Candidates
come from the same Sobol sequence as the first samples, so that the choice depends on the study alone: a build
that was stopped makes it again and finds on disk what it had solved.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from morph_dslam.errors import SolverError
from morph_dslam.reduction.galerkin import FullSolutions, ReducedSolver, solid_equations
from morph_dslam.reduction.registry import reduction_method
from morph_dslam.reduction.task import ReductionTask
from morph_dslam.studies.problem import ParametricStudy, SweepProblem, bounds
from morph_dslam.studies.sampling import candidate_samples, training_samples
from morph_dslam.studies.sweep import SweepResult

Array = NDArray[np.float64]
#: Candidates looked at in each round, for each parameter, and at most.
CANDIDATES, MOST_CANDIDATES = 16, 64
#: New samples of a round, as a part of those so far, and at least.
GROWTH, LEAST = 0.25, 4
#: Part of the tolerance that the estimate must reach: the rest is left to the functions of the parameters.
SHARE = 0.5


def sample_adaptively(
    study: ParametricStudy, problem: SweepProblem, sweep: Callable[[Array], SweepResult]
) -> tuple[Array, list[dict[str, Any]]]:
    """The training samples (n, d), all of them solved, and what each round found.

    Sampling ends when the largest estimate is below the tolerance of the reduction, or at
    ``sampling.training`` samples. In the second case the last round has as "unresolved" the candidate of the largest
    estimate, if that is above the tolerance: "at" (coordinates, SI), "estimate", and "why", "training".
    """
    equations = solid_equations(problem)
    samples = training_samples(study)
    pool = min(CANDIDATES * len(bounds(study)), MOST_CANDIDATES)
    estimates = np.full(pool, np.inf)
    rounds: list[dict[str, Any]] = []
    while True:
        result = sweep(samples)
        solutions = FullSolutions.read([path for _, path in sorted(result.solved.items())])
        solver = ReducedSolver(equations, solutions, bounds(study), study.reduction.tolerance)
        candidates = candidate_samples(study, len(estimates))
        room = study.sampling.training - len(samples)
        greedy = reduction_method(study.reduction.method or "").greedy
        count = min(1 if greedy else max(LEAST, int(GROWTH * len(samples))), max(room, 1))
        worst, estimates = _worst(solver, candidates, estimates, count)
        largest = float(estimates[worst[0]])
        rounds.append({"solves": len(samples), "largest_estimate": largest})
        if largest > study.reduction.tolerance and room <= 0:
            rounds[-1]["unresolved"] = [{"at": candidates[worst[0]].tolist(), "estimate": largest, "why": "training"}]
        if largest <= SHARE * study.reduction.tolerance or room <= 0:
            return samples, rounds
        estimates[worst] = -np.inf
        estimates = np.append(estimates, np.full(len(worst), np.inf))
        samples = np.vstack([samples, candidates[worst]])


def _worst(solver: ReducedSolver, candidates: Array, earlier: Array, count: int) -> tuple[NDArray[np.int64], Array]:
    """`worst_candidates` among ``candidates`` (n, d); infinite where there is no reduced solution."""

    def estimate(index: int) -> float:
        progress.update()
        try:
            return solver.estimate(solver.solve(candidates[index]), candidates[index])
        except SolverError:
            return np.inf

    with tqdm(desc="estimating errors", unit="sample", leave=False) as progress:
        return worst_candidates(estimate, earlier, count)


def estimator_check(task: ReductionTask, files: Sequence[Path]) -> dict[str, Any]:
    """The estimate over the true error of the Galerkin solution (effectivity) at held-out solutions.

    Parameters
    ----------
    task : with the training solutions, whose modes the equations are projected on.
    files : of the held-out solutions.

    Returns
    -------
    dict
        Without figures where no reduced equations could be solved, or none has an error.
    """
    equations = solid_equations(task.problem() if task.problem else None)
    solver = ReducedSolver(equations, FullSolutions.read(task.files), task.box, task.options.tolerance)
    held_out = FullSolutions.read(files)
    ratios, errors = [], []
    for mu, truth in zip(held_out.samples, held_out.states, strict=True):
        try:
            reduced = solver.solve(mu)
        except SolverError:
            continue
        missed = (solver.lift(reduced, mu) - truth)[solver.measured]
        error = float(np.linalg.norm(missed)) / solver.largest
        if error > 0.0:
            errors.append(error)
            ratios.append(solver.estimate(reduced, mu) / error)
    if not ratios:
        return {"n_held_out": 0}
    return {
        "effectivity_min": min(ratios),
        "effectivity_median": float(np.median(ratios)),
        "effectivity_max": max(ratios),
        "galerkin_error_mean": float(np.mean(errors)),
        "galerkin_error_max": max(errors),
        "n_held_out": len(ratios),
    }


def worst_candidates(estimate: Callable[[int], float], earlier: Array, count: int) -> tuple[NDArray[np.int64], Array]:
    """The candidates with the largest estimated errors.

    Parameters
    ----------
    estimate : present estimate at a candidate, by its index.
    earlier : (n,) last estimate of each; infinite where there is none, minus infinity for candidates that are
        out of the choice.
    count : how many to choose.

    Returns
    -------
    chosen : (count,) indices, the largest estimate first; fewer where no more are in the choice.
    estimates : (n,) with those made anew.
    """
    estimates, current = earlier.copy(), np.isneginf(earlier)
    while True:
        chosen = np.argsort(-estimates, kind="stable")[: min(count, int(np.sum(~np.isneginf(estimates))))]
        stale = chosen[~current[chosen]]
        if not len(stale):
            return chosen, estimates
        estimates[stale[0]] = estimate(int(stale[0]))
        current[stale[0]] = True
