"""The sweep: every sample solved once, each from its nearest solved neighbour, on any Executor."""

from __future__ import annotations

import gc
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
from morph_dslam.offline.problem import ParametricStudy, SweepProblem, bounds
from morph_dslam.offline.snapshots import load_state, save_snapshot, snapshot_key

Array = NDArray[np.float64]

#: A sample is given up after so many attempts from different neighbours.
MOST_ATTEMPTS = 2


@dataclass
class SweepResult:
    """Which samples were solved (paths by sample index) and why others were not."""

    solved: dict[int, Path] = field(default_factory=dict)
    failed: dict[int, str] = field(default_factory=dict)


def training_samples(study: ParametricStudy) -> Array:
    """The samples (n, d) that the model is made from."""
    sampling = study.sampling
    if sampling.scheme == "sobol":
        return sample_box(study, sampling.training, sampling.seed, towards_edges=0.5)
    box = bounds(study)
    if len(box) != 1:
        raise StudyError(
            f'sampling.scheme = "even" is for one parameter, and this study has {len(box)}: use "sobol"'
        )
    return study.admissible(np.linspace(box[0, 0], box[0, 1], sampling.training)[:, None])


def held_out_samples(study: ParametricStudy) -> Array:
    """The samples (n, d) that only measure the error: uniform, as the certificate's statement assumes."""
    return sample_box(study, study.sampling.held_out, study.sampling.seed + 1, towards_edges=0.0)


def sample_box(study: ParametricStudy, count: int, seed: int, towards_edges: float) -> Array:
    """Scrambled Sobol samples (count, d) of the box.

    ``towards_edges`` in [0, 1] moves them from uniform to the Chebyshev density, at which polynomial
    regression is best conditioned.
    """
    box = bounds(study)
    sobol = qmc.Sobol(len(box), rng=seed)
    unit = 2.0 * sobol.random_base2(int(np.ceil(np.log2(count))))[:count] - 1.0
    xi = (1.0 - towards_edges) * unit + towards_edges * np.sin(np.pi / 2.0 * unit)
    return study.admissible(box.mean(axis=1) + xi * np.diff(box, axis=1).ravel() / 2.0)


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


@lru_cache(maxsize=1)
def _worker_problem(study: ParametricStudy) -> SweepProblem:
    """The problem of a worker process, built once."""
    import ngsolve

    ngsolve.SetNumThreads(study.work.threads or os.cpu_count() or 1)
    return study.sweep_problem()


def _solve_sample(study: ParametricStudy, coordinates: Array, start: Path | None, result: Path) -> str | None:
    """Solve one sample and write its snapshot; returns why it could not be solved, or None."""
    problem = _worker_problem(study)
    try:
        state = problem.unpack(load_state(start)) if start else problem.first_state()
        state = problem.advance(state, coordinates)
    except SolverError as error:
        return str(error)
    save_snapshot(result, problem.take_snapshot(state), problem.pack(state))
    return None


class SerialExecutor(Executor):
    """Runs each task here, when it is submitted: no second process, so the least memory."""

    def submit(self, fn, /, *args, **kwargs) -> Future:
        future: Future = Future()
        future.set_result(fn(*args, **kwargs))
        return future

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Give back the memory of the problem."""
        _worker_problem.cache_clear()
        gc.collect()  # a problem and its linear solver refer to each other


@contextmanager
def default_executor(workers: int | None) -> Iterator[Executor]:
    """Worker processes, one a core unless ``workers`` says otherwise; cancelled cleanly on interruption.

    A single worker is this process itself.
    """
    if workers == 1:
        with SerialExecutor() as executor:
            yield executor
        return
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


def run_sweep(study: ParametricStudy, samples: Array, folder: Path, executor: Executor) -> SweepResult:
    """Solve all ``samples`` (n, d), canonical, keeping each as soon as it is solved.

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
            order, parent = neighbour_tree(samples, study.scale(), study.root(), result.solved, result.failed)
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
    _check_reach(study, samples, result, folder)
    return result


def _check_reach(study: ParametricStudy, samples: Array, result: SweepResult, folder: Path) -> None:
    """Refuse a box of which too much could not be solved."""
    if len(result.solved) < 0.5 * len(samples):
        first = next(iter(result.failed.values()))
        raise StudyError(
            f"only {len(result.solved)} of {len(samples)} samples could be solved; the first failure: "
            f"{first}. The solved ones are kept in {folder}. {study.advice}"
        )
    if samples.shape[1] == 1 and result.failed:
        parameter, solved = study.model_parameters()[0], samples[list(result.solved), 0]
        beyond = [i for i in result.failed if not solved.min() < samples[i, 0] < solved.max()]
        if beyond:
            reached = [parameter.display(value) for value in (solved.min(), solved.max())]
            raise StudyError(
                f"{parameter.name} could only be followed from {reached[0]:.4g} to {reached[1]:.4g} "
                f"{parameter.unit}: {result.failed[beyond[0]]}. The solutions up to there are kept in "
                f"{folder}; with that range the same command goes on from them. {study.advice}"
            )


def _run_pass(
    study: ParametricStudy,
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
