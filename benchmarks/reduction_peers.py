"""The methods of reduction beside pyMOR's and tensorly's, on one linear problem and the same solutions.

benchmarks/studies/linear_bar.toml is a bar of 3 435 degrees of freedom under a moving line load, with two of
its Young's moduli as further parameters. Each of the project's methods makes a model from its own choice of
solutions. pyMOR gets the separated stiffness and load: POD with Galerkin projection, and its weak greedy
algorithm with residual estimator. tensorly gets the coefficients of all solutions on a grid, as do the
project's own CP and Tucker decompositions. Errors are relative, in L2 over the nodes of the held-out
solutions; CPU seconds on one core count from nothing to the finished model, the solves included; a query is
one displacement field. pyMOR (BSD) is installed in .venv-bench by the first run.
Run: python benchmarks/reduction_peers.py
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

os.environ.update(dict.fromkeys(("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1"))

import numpy as np
import tensorly.decomposition as tensorly
from numpy.typing import NDArray

from affine_bar import AffineBar
from morph_dslam import ReducedModel, load_study
from morph_dslam.extend import run_and_report_errors
from morph_dslam.extend.models import SeparatedField, chebyshev_basis
from morph_dslam.extend.reduction import cp, cp_functions
from morph_dslam.extend.studies import Snapshot, SolidStudy
from morph_dslam.reduction.grid_functions import interpolation_nodes
from morph_dslam.reduction.pod import Pod, compute_pod
from morph_dslam.reduction.tensor_formats import CP, Tucker, tucker, tucker_functions
from morph_dslam.studies.build import certified_model
from morph_dslam.studies.defaults import resolve_defaults
from morph_dslam.studies.executors import default_executor
from morph_dslam.studies.sampling import held_out_samples
from morph_dslam.studies.snapshots import load_snapshot
from morph_dslam.studies.solutions import take_snapshots
from morph_dslam.studies.sweep import run_sweep
from peer_environment import peer_python

Array = NDArray[np.float64]

HERE = Path(__file__).resolve().parent
TOLERANCE = 1e-4
#: What each of the project's methods is asked for.
METHODS: dict[str, dict[str, Any]] = {
    "galerkin": {"max_modes": 60},
    "reduced_basis": {"max_modes": 60},
    "pod": {"max_modes": 60, "max_degree": 12},
    "sparse_pgd": {"max_modes": 40, "max_degree": 14},
}
#: Numbers of modes at which pyMOR's reduced models are compared.
MODES = (10, 20, 30)
GRID = (17, 12, 12)
MOST_TERMS = 40


class Table:
    """Lines as they are found, and the errors for the last one."""

    def __init__(self, held_out: list[Snapshot]) -> None:
        self.samples = np.array([snapshot.coordinates for snapshot in held_out])
        self.truth = np.array([snapshot.fields["displacement"] for snapshot in held_out], dtype=np.float64)
        self.errors: dict[str, float] = {}
        print(f"{'method':22s} {'solves':>6s} {'modes':>5s} {'error':>8s} {'s':>7s} {'query, us':>9s}", flush=True)

    def add(self, name: str, solves: int, modes: int, found: Array, seconds: float, query: float) -> None:
        missed = found.reshape(self.truth.shape) - self.truth
        self.errors[name] = float(np.linalg.norm(missed) / np.linalg.norm(self.truth))
        print(
            f"{name:22s} {solves:6d} {modes:5d} {self.errors[name]:8.1e} {seconds:7.1f} {1e6 * query:9.0f}", flush=True
        )

    def add_field(self, name: str, solves: int, field: SeparatedField, seconds: float) -> None:
        field.value(self.samples[0])  # compiles
        began = time.process_time()
        found = np.array([field.value(mu) for mu in self.samples])
        query = (time.process_time() - began) / len(self.samples)
        self.add(name, solves, field.n_modes, found, seconds, query)


def reduced_by(study: SolidStudy, method: str) -> SolidStudy:
    """The study with a method of reduction."""
    options = type(study.reduction)(method=method, tolerance=TOLERANCE, **METHODS[method])
    return resolve_defaults(study.model_copy(update={"reduction": options}))


def own_model(study: SolidStudy, held_out: Path, folder: Path) -> tuple[ReducedModel, float]:
    """A model made in a folder that has the held-out solutions and no others yet, and its time."""
    shutil.copytree(held_out, folder)
    began = time.process_time()
    model = certified_model(take_snapshots(study, folder, workers=1), study.reduction, study.name)
    return model, time.process_time() - began


def solve_held_out(study: SolidStudy, folder: Path) -> list[Snapshot]:
    """The held-out solutions, left in a folder from which every method takes them."""
    with default_executor(1) as processes:
        solved = run_sweep(study, study.canonical(held_out_samples(study)), folder, processes).solved
    return [load_snapshot(path) for _, path in sorted(solved.items())]


def run_pymor(bar: AffineBar, training: Array, table: Table, folder: Path) -> None:
    """pyMOR's reduced models from the separated problem."""
    python = peer_python("pymor", "pymor>=2025")
    problem, result = folder / "problem.npz", folder / "pymor.npz"
    np.savez(
        problem,
        stiffness=bar.matrices,
        indices=bar.indices,
        indptr=bar.indptr,
        middle=bar.stiffness(bar.box.mean(axis=1)),
        loads=bar.loads,
        training_a=bar.weights(training),
        training_f=bar.load_weights(training),
        unseen_a=bar.weights(table.samples),
        unseen_f=bar.load_weights(table.samples),
        modes=MODES,
    )
    subprocess.run([python, HERE / "peers" / "pymor_reduction.py", problem, result], check=True)
    with np.load(result) as found:
        for name in ("pod", "greedy"):
            for count in MODES:
                nodal = bar.nodal_displacements(found[f"{name}_{count}"])
                times = float(found[f"{name}_seconds"]), float(found[f"{name}_{count}_query"])
                table.add(f"pyMOR {name} {count}", int(found[f"{name}_solves"]), count, nodal, *times)


def run_tensors(bar: AffineBar, table: Table) -> None:
    """CP and Tucker forms of the solutions on a grid, by the project and by tensorly."""
    began = time.process_time()
    bases = tuple(chebyshev_basis(*ends, n - 1) for ends, n in zip(bar.box, GRID, strict=True))
    nodes = tuple(interpolation_nodes(basis) for basis in bases)
    grid = np.stack(np.meshgrid(*nodes, indexing="ij"), axis=-1).reshape(-1, len(bases))
    flat = bar.solve(grid).reshape(len(grid), -1)
    pod = compute_pod(flat, np.ones(flat.shape[1]), 0.1 * TOLERANCE, 100)
    tensor = pod.project(flat).T.reshape(-1, *GRID)
    solving = time.process_time() - began
    own, own_seconds = timed(lambda: tucker(tensor, TOLERANCE))
    other, other_seconds = timed(lambda: tensorly.tucker(tensor, rank=list(own.core.shape), init="svd"))
    for name, form, seconds in (
        ("Tucker", own, own_seconds),
        ("tensorly Tucker", Tucker(np.asarray(other[0]), tuple(other[1])), other_seconds),
    ):
        functions = tucker_functions(form, nodes, bases)
        table.add_field(name, len(grid), field_of(pod, functions), solving + seconds)
    terms, own_seconds = timed(lambda: cp(tensor, TOLERANCE, MOST_TERMS))
    rank = terms.factors[0].shape[1]
    other, other_seconds = timed(lambda: tensorly.parafac(tensor, rank=rank, init="svd", n_iter_max=2000, tol=1e-10))
    scaled = (np.asarray(other[1][0]) * other[0], *(np.asarray(f) for f in other[1][1:]))
    for name, form, seconds in (("CP", terms, own_seconds), ("tensorly CP", CP(scaled), other_seconds)):
        table.add_field(f"{name} {rank}", len(grid), field_of(pod, cp_functions(form, nodes, bases)), solving + seconds)


def timed(make: Callable[[], Any]) -> tuple[Any, float]:
    began = time.process_time()
    return make(), time.process_time() - began


def field_of(pod: Pod, functions: Any) -> SeparatedField:
    """The displacement with a POD's modes."""
    return SeparatedField(pod.modes.reshape(len(pod.modes), -1, 3), functions)


def run(arguments: argparse.Namespace) -> None:
    study = load_study(HERE / "studies" / "linear_bar.toml")
    assert isinstance(study, SolidStudy)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        held_out = folder / "held_out"
        table = Table(solve_held_out(study, held_out))
        for method in arguments.methods:
            model, seconds = own_model(reduced_by(study, method), held_out, folder / method)
            solves = model.certificate["samples"]["training"]
            table.add_field(method, solves, model.displacement, seconds)
        bar = AffineBar.of(study.problem())
        box, rng = bar.box, np.random.default_rng(0)
        training = box[:, 0] + rng.random((study.sampling.training, len(box))) * np.diff(box, axis=1).T
        run_pymor(bar, training, table, folder)
        run_tensors(bar, table)
    print(" ".join(f"{key.replace(' ', '_')}={error:.2e}" for key, error in table.errors.items()))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--methods", nargs="+", choices=METHODS, default=list(METHODS), help="of the project")
    return run_and_report_errors(run, parser.parse_args(), "nothing was kept")


if __name__ == "__main__":
    sys.exit(main())
