"""Where a study is solved: samples of the parameter box, every scheme of them deterministic.

Scrambled Sobol samples are nested: the first of a longer sequence are the shorter one, so a study that asks
for more samples keeps those it has (Sobol 1967; scrambling after Owen 1998). So are the held-out samples,
which are drawn independently.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import qmc
from tqdm import tqdm

from morph_dslam.errors import SolverError, StudyError
from morph_dslam.reduction.galerkin import FullSolutions, ReducedSolver, solid_equations
from morph_dslam.reduction.galerkin_method import worst_candidates
from morph_dslam.studies.problem import ParametricStudy, SweepProblem, bounds
from morph_dslam.studies.sweep import SweepResult

Array = NDArray[np.float64]

#: How far training samples are moved from uniform to the Chebyshev density (`sample_box`).
TRAINING_TOWARDS_EDGES = 0.5

#: More points than these on a full grid are taken for a mistake: other schemes need far fewer.
MOST_GRID_POINTS = 100_000


def training_samples(study: ParametricStudy) -> Array:
    """The samples (n, d) that the model is made from; with "adaptive", those that are solved first.

    Raises
    ------
    StudyError
        If the scheme does not suit the number of parameters.
    """
    sampling = study.sampling
    if sampling.scheme == "even":
        return study.admissible(_even(study, sampling.training))
    if sampling.scheme == "grid":
        return study.admissible(_grid(study))
    count = sampling.first if sampling.scheme == "adaptive" else sampling.training
    return sample_box(study, count, sampling.seed, TRAINING_TOWARDS_EDGES)


def candidate_samples(study: ParametricStudy, count: int) -> Array:
    """Samples (count, d) among which adaptive sampling chooses: those that follow the training samples.

    A longer list begins with the shorter one, and no candidate is a training or a held-out sample.
    """
    sampling = study.sampling
    following = sample_box(study, sampling.first + count, sampling.seed, TRAINING_TOWARDS_EDGES)
    return following[sampling.first :]


def held_out_samples(study: ParametricStudy) -> Array:
    """The samples (n, d) that only measure the error: independent and uniform, as its statement assumes."""
    box, sampling = bounds(study), study.sampling
    unit = np.random.default_rng(sampling.seed + 1).random((sampling.held_out, len(box)))
    return study.admissible(box[:, 0] + unit * np.diff(box, axis=1).ravel())


def sample_box(study: ParametricStudy, count: int, seed: int, towards_edges: float) -> Array:
    """Scrambled Sobol samples (count, d) of the box; of two counts, the smaller gives the first samples.

    ``towards_edges`` in [0, 1] moves them from uniform to the Chebyshev density, at which polynomial
    regression is best conditioned.
    """
    box = bounds(study)
    sobol = qmc.Sobol(len(box), rng=seed)
    unit = 2.0 * sobol.random_base2(int(np.ceil(np.log2(count))))[:count] - 1.0
    xi = (1.0 - towards_edges) * unit + towards_edges * np.sin(np.pi / 2.0 * unit)
    return study.admissible(box.mean(axis=1) + xi * np.diff(box, axis=1).ravel() / 2.0)


def _even(study: ParametricStudy, count: int) -> Array:
    """Evenly spaced samples (count, 1), both ends included."""
    box = bounds(study)
    if len(box) != 1:
        raise StudyError(
            f'sampling.scheme = "even" is for one parameter, and this study has {len(box)}: use "grid" or "sobol"'
        )
    return np.linspace(box[0, 0], box[0, 1], count)[:, None]


def _grid(study: ParametricStudy) -> Array:
    """The full grid (n, d), evenly spaced along each parameter, the last parameter running fastest."""
    axes = grid_axes(study)
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(axes))


def grid_axes(study: ParametricStudy) -> list[Array]:
    """Values of each parameter on the full grid, both ends included.

    Raises
    ------
    StudyError
        If ``sampling.points`` does not suit the number of parameters, or makes too many points.
    """
    box, points = bounds(study), study.sampling.points
    counts = (points,) * len(box) if isinstance(points, int) else tuple(points or ())
    if len(counts) != len(box):
        names = ", ".join(parameter.name for parameter in study.model_parameters())
        raise StudyError(
            f"sampling.points has {len(counts)} numbers, and this study has {len(box)} parameters "
            f"({names}): give one number of points for each, in this order"
        )
    total = int(np.prod([float(count) for count in counts]))
    if total > MOST_GRID_POINTS:
        raise StudyError(
            f"the full grid of sampling.points has {total} points, more than {MOST_GRID_POINTS}: "
            'take fewer, or scheme = "sobol"'
        )
    return [np.linspace(low, high, count) for (low, high), count in zip(box, counts, strict=True)]


# Adaptive sampling: full solves where a Galerkin model of those so far is estimated to err most.
# The estimate is the full Newton correction at the reduced solution, one factorisation for each candidate
# that could be among the worst. Method "galerkin" adds several samples in a round, which are solved side by
# side; "reduced_basis" adds one, as the weak greedy algorithm has it: fewer solves, one after the other.
# Candidates come from the same Sobol sequence as the first samples, so that the choice depends on the study
# alone: a build that was stopped makes it again and finds on disk what it had solved.


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
        count = min(_samples_of_a_round(study, len(samples)), max(room, 1))
        worst, estimates = _worst(solver, candidates, estimates, count)
        largest = float(estimates[worst[0]])
        rounds.append({"solves": len(samples), "largest_estimate": largest})
        if largest <= SHARE * study.reduction.tolerance or room <= 0:
            return samples, rounds
        estimates[worst] = -np.inf
        estimates = np.append(estimates, np.full(len(worst), np.inf))
        samples = np.vstack([samples, candidates[worst]])


def _samples_of_a_round(study: ParametricStudy, known: int) -> int:
    return 1 if study.reduction.method == "reduced_basis" else max(LEAST, int(GROWTH * known))


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
