"""The sweep: every sample solved once, each from its nearest solved neighbour, on any Executor."""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Collection, Iterator
from concurrent.futures import FIRST_COMPLETED, Executor, Future, ProcessPoolExecutor, wait
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.stats import qmc
from tqdm import tqdm

from morph_dslam.errors import SolverError, StudyError
from morph_dslam.offline.continuation import advance
from morph_dslam.offline.gripped_sheet import GrippedSheet
from morph_dslam.offline.snapshots import (
    MIRROR_X,
    MIRROR_Z,
    load_state,
    save_snapshot,
    snapshot_key,
    take_snapshot,
)
from morph_dslam.offline.study import Study

Array = NDArray[np.float64]

#: Smallest |bulge| that is solved, over the largest: in the flat state itself the equations are singular.
SMALLEST_BULGE = 0.02
#: A sample is given up after so many attempts from different neighbours.
MOST_ATTEMPTS = 2


@dataclass
class SweepResult:
    """Which samples were solved (paths by sample index) and why others were not."""

    solved: dict[int, Path] = field(default_factory=dict)
    failed: dict[int, str] = field(default_factory=dict)


def sample_box(study: Study, count: int, seed: int, towards_edges: float) -> Array:
    """Scrambled Sobol samples (count, 4) of the box.

    ``towards_edges`` in [0, 1] moves them from uniform to the Chebyshev density, at which polynomial
    regression is best conditioned.
    """
    sobol = qmc.Sobol(4, rng=seed)
    unit = 2.0 * sobol.random_base2(int(np.ceil(np.log2(count))))[:count] - 1.0
    xi = (1.0 - towards_edges) * unit + towards_edges * np.sin(np.pi / 2.0 * unit)
    bounds = study.parameters.bounds
    samples = bounds.mean(axis=1) + xi * np.diff(bounds, axis=1).ravel() / 2.0
    smallest = SMALLEST_BULGE * np.abs(bounds[0]).max()
    bulge = samples[:, 0]
    samples[:, 0] = np.where(np.abs(bulge) < smallest, np.copysign(smallest, bulge), bulge)
    return samples


def canonical(study: Study, samples: Array) -> Array:
    """The mirror image of each sample (n, 4) that is solved in its place.

    The sheet does not know its sides apart, so bulge can be made positive; if its grips are at the same
    height, slant too.
    """
    samples = np.where(samples[:, :1] < 0.0, samples * MIRROR_Z, samples)
    if study.grips.symmetric:
        samples = np.where(samples[:, 3:] < 0.0, samples * MIRROR_X, samples)
    return samples


def neighbour_tree(
    samples: Array, scale: Array, root: Array, solved: Collection[int] = (), failed: Collection[int] = ()
) -> tuple[list[int], list[int]]:
    """Prim's order of the samples that are not solved yet, and the neighbour that each starts from.

    Parameters
    ----------
    solved, failed : samples that may be started from already, and samples that nothing is to start from.

    Returns
    -------
    order : the unsolved samples. parent : for every sample, another one or -1 for the root state.
    """
    points = samples / scale
    distance = np.linalg.norm(points - root / scale, axis=1)
    parent = np.full(len(points), -1)
    waiting = np.ones(len(points), dtype=bool)
    order: list[int] = []
    for step in range(len(points)):
        known = sorted(solved)
        nearest = known[step] if step < len(known) else int(np.argmin(np.where(waiting, distance, np.inf)))
        if step >= len(known):
            order.append(nearest)
        waiting[nearest] = False
        if nearest in failed:
            continue
        to_new = np.linalg.norm(points - points[nearest], axis=1)
        closer = waiting & (to_new < distance)
        distance[closer], parent[closer] = to_new[closer], nearest
    return order, parent.tolist()


def root_coordinates(study: Study) -> Array:
    """The gentle circular arch that every path starts from."""
    bulge = min(0.03 * study.sheet.length, 0.5 * max(abs(b) for b in study.parameters.bulge))
    return np.array([bulge, 1.0, 0.0, 0.0])


@lru_cache(maxsize=1)
def _worker_problem(study: Study) -> GrippedSheet:
    """The problem of a worker process, built once; one thread, since the workers fill the cores."""
    import ngsolve

    ngsolve.SetNumThreads(1)
    return study.problem()


def _solve_sample(study: Study, coordinates: Array, start: Path | None, result: Path) -> str | None:
    """Solve one sample and write its snapshot; returns why it could not be solved, or None."""
    problem = _worker_problem(study)  # type: ignore[arg-type]
    try:
        state = load_state(start) if start else problem.first_state(root_coordinates(study)[0])
        state, _ = advance(problem, state, coordinates)
    except SolverError as error:
        return str(error)
    save_snapshot(result, state, take_snapshot(problem, study, state))
    return None


@contextmanager
def default_executor(workers: int | None) -> Iterator[Executor]:
    """Worker processes, one a core unless ``workers`` says otherwise; cancelled cleanly on interruption."""
    context = multiprocessing.get_context("spawn")
    executor = ProcessPoolExecutor(workers or os.cpu_count(), mp_context=context)
    try:
        yield executor
    except BaseException:
        executor.shutdown(wait=False, cancel_futures=True)
        for process in multiprocessing.active_children():
            process.terminate()
        raise
    executor.shutdown()


def _box_size(study: Study) -> Array:
    bounds = study.parameters.bounds
    size = np.diff(bounds, axis=1).ravel()
    size[0] = np.abs(bounds[0]).max()
    return size


def run_sweep(study: Study, samples: Array, folder: Path, executor: Executor) -> SweepResult:
    """Solve all ``samples`` (n, 4), canonical, keeping each as soon as it is solved.

    Samples found in ``folder`` are not solved again. Each starts from its nearest neighbour in a tree; what
    lies behind a sample that did not converge is tried in the next pass from other neighbours, and so is the
    sample itself, once. Which sample starts from which does not depend on the workers' timing.

    Raises
    ------
    StudyError
        If not even half of the samples converge.
    """
    folder.mkdir(parents=True, exist_ok=True)
    paths = [folder / f"{snapshot_key(study, sample)}.npz" for sample in samples]
    result = SweepResult()
    tried: dict[int, list[int]] = {}
    with tqdm(total=len(samples), desc="solving", unit="sample", smoothing=0.05) as progress:
        while len(result.solved) < len(samples):
            size, root = _box_size(study), root_coordinates(study)
            order, parent = neighbour_tree(samples, size, root, result.solved, result.failed)
            children: dict[int, list[int]] = {}
            for sample in order:
                starts = tried.get(sample, [])
                if parent[sample] not in starts and len(starts) < MOST_ATTEMPTS:
                    children.setdefault(parent[sample], []).append(sample)
            if not children.keys() & {-1, *result.solved}:
                break
            _run_pass(study, samples, paths, children, executor, result, tried, progress)
    for sample in set(range(len(samples))) - set(result.solved) - set(result.failed):
        result.failed[sample] = "not reached: no neighbour of it could be solved"
    if len(result.solved) < 0.5 * len(samples):
        first = next(iter(result.failed.values()))
        raise StudyError(
            f"only {len(result.solved)} of {len(samples)} samples could be solved; the first failure: "
            f"{first}. The solved ones are kept in {folder}. Narrow the ranges of the parameters, refine "
            "solver.divisions, or raise solver.thickness"
        )
    return result


def _run_pass(
    study: Study,
    samples: Array,
    paths: list[Path],
    children: dict[int, list[int]],
    executor: Executor,
    result: SweepResult,
    tried: dict[int, list[int]],
    progress: tqdm,
) -> None:
    """Walk a tree of samples from the solved ones outwards; branches behind a failure are left."""
    running: dict[Future, int] = {}

    def start(parent: int) -> None:
        for sample in children.get(parent, []):
            tried.setdefault(sample, []).append(parent)
            if paths[sample].is_file():
                future: Future = Future()
                future.set_result(None)
            else:
                origin = paths[parent] if parent >= 0 else None
                future = executor.submit(_solve_sample, study, samples[sample], origin, paths[sample])
            running[future] = sample

    for origin in [-1, *sorted(result.solved)]:
        start(origin)
    while running:
        done, _ = wait(running, return_when=FIRST_COMPLETED)
        for future in done:
            sample = running.pop(future)
            reason = future.result()
            if reason is None:
                result.solved[sample] = paths[sample]
                result.failed.pop(sample, None)
                progress.update()
                start(sample)
            else:
                result.failed[sample] = reason
        progress.set_postfix(failed=len(result.failed))
