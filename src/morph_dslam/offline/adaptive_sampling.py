"""Adaptive sampling: full solves where a Galerkin model of those so far is estimated to err most.

The estimate is the full Newton correction at the reduced solution, one factorisation for each candidate.
Candidates come from the same Sobol sequence as the first samples, so that the choice depends on the study
alone: a build that was stopped makes it again and finds on disk what it had solved.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from morph_dslam.errors import SolverError
from morph_dslam.offline.problem import ParametricStudy, SweepProblem, bounds
from morph_dslam.offline.reduction.reduced_solver import FullSolutions, ReducedSolver, solid_equations
from morph_dslam.offline.sampling import candidate_samples, training_samples
from morph_dslam.offline.sweep import SweepResult

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
    ``sampling.training`` samples.

    Raises
    ------
    StudyError
        If the study has no Galerkin model, or too few samples converge.
    """
    equations = solid_equations(problem)
    samples, chosen = training_samples(study), np.zeros(0, dtype=np.int64)
    pool = min(CANDIDATES * len(bounds(study)), MOST_CANDIDATES)
    rounds: list[dict[str, Any]] = []
    while True:
        result = sweep(samples)
        solutions = FullSolutions.read([path for _, path in sorted(result.solved.items())])
        solver = ReducedSolver(equations, solutions, bounds(study), study.reduction.tolerance)
        candidates = candidate_samples(study, pool + len(chosen))
        free = np.setdiff1d(np.arange(len(candidates)), chosen)
        estimates = _estimates(solver, candidates[free])
        rounds.append({"solves": len(samples), "largest_estimate": float(estimates.max())})
        room = study.sampling.training - len(samples)
        if estimates.max() <= SHARE * study.reduction.tolerance or room <= 0:
            return samples, rounds
        count = min(max(LEAST, int(GROWTH * len(samples))), room)
        worst = free[np.argsort(-estimates, kind="stable")[:count]]
        chosen = np.concatenate([chosen, worst])
        samples = np.vstack([samples, candidates[worst]])


def _estimates(solver: ReducedSolver, candidates: Array) -> Array:
    """Estimated errors (n,) at candidates (n, d); infinite where there is no reduced solution."""
    found = np.full(len(candidates), np.inf)
    for number, mu in enumerate(tqdm(candidates, desc="estimating errors", unit="sample", leave=False)):
        try:
            found[number] = solver.estimate(solver.solve(mu), mu)
        except SolverError:
            continue
    return found


def estimator_check(solver: ReducedSolver, files: Sequence[Path]) -> dict[str, Any]:
    """The estimate over the true error of the Galerkin solution (effectivity) at held-out solutions.

    Parameters
    ----------
    files : of the held-out solutions, which the solver's modes do not know.
    """
    held_out = FullSolutions.read(files)
    ratios, errors = [], []
    for mu, truth in zip(held_out.samples, held_out.states, strict=True):
        try:
            reduced = solver.solve(mu)
        except SolverError:
            continue
        missed = (solver.lift(reduced, mu) - truth)[solver.measured]
        errors.append(float(np.linalg.norm(missed)) / solver.largest)
        ratios.append(solver.estimate(reduced, mu) / errors[-1])
    return {
        "effectivity_min": min(ratios),
        "effectivity_median": float(np.median(ratios)),
        "effectivity_max": max(ratios),
        "galerkin_error_mean": float(np.mean(errors)),
        "galerkin_error_max": max(errors),
        "n_held_out": len(ratios),
    }
