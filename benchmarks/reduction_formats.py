"""Formats of a three-parameter field compared: error on held-out samples, numbers stored, time to evaluate.

The field is the displacement of a geometrically exact cantilever of unit length (the elastica) in 305 points,
under a dead load P in [0, 8] at s in [0.4, 1], its outer half kappa in [0.3, 3] times as stiff as the inner.
The grid formats see 25 x 21 x 17 solves, sparse PGD 500 scattered ones; errors are relative, in L2, over 300
samples of the inner 95 % of the box, for the field and for its three sensitivities by the scaled parameters.
The last column is the time of the value and all sensitivities at 500 points with three components, on one
thread; the last line gives it for 30 modes in each format. Run: python benchmarks/reduction_formats.py
"""

from __future__ import annotations

import time

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.stats import qmc

from morph_dslam.extend.models import Basis, CPFunctions, SeparatedField, chebyshev_basis, cubic_spline_basis, hat_basis
from morph_dslam.extend.reduction import cp, cp_functions
from morph_dslam.model.basis_functions import kriging_basis, p_spline_basis
from morph_dslam.model.tensor_functions import TensorFunctions, TensorTrainFunctions, TuckerFunctions
from morph_dslam.reduction.pod import Pod, compute_pod
from morph_dslam.reduction.sparse_pgd import fit_sparse_pgd
from morph_dslam.reduction.tensor_formats import tensor_train, tensor_train_functions, tucker, tucker_functions

Array = NDArray[np.float64]

CELLS, DEPTH = 120, 0.12
GRID = (25, 21, 17)
N_MODES, N_SAMPLES, N_HELD_OUT = 29, 500, 300


@njit(cache=True)
def elastica(load, position, ratio):
    """Rotations (CELLS,) of the cells: (EI theta')' + P [x < s] cos theta = 0, theta(0) = theta'(1) = 0."""
    h = 1.0 / CELLS
    theta = np.zeros(CELLS)
    stiffness = np.zeros(CELLS + 1)  # EI / h at the faces: clamp (half a cell away), inner faces, free end
    stiffness[0] = 2.0 / h
    for i in range(1, CELLS):
        stiffness[i] = (1.0 + (ratio - 1.0) / (1.0 + np.exp(-(i * h - 0.5) / 0.05))) / h
    upper, right = np.empty(CELLS), np.empty(CELLS)
    for step in range(1, 5):
        for _ in range(30):
            largest = 0.0
            for i in range(CELLS):  # Newton's step by the Thomas algorithm
                share = h * load * step / 4.0 * min(max((position - i * h) / h, 0.0), 1.0)
                before = theta[i - 1] if i > 0 else 0.0
                after = theta[i + 1] if i < CELLS - 1 else theta[i]
                residual = stiffness[i + 1] * (after - theta[i]) - stiffness[i] * (theta[i] - before)
                residual += share * np.cos(theta[i])
                diagonal = -stiffness[i] - stiffness[i + 1] - share * np.sin(theta[i])
                if i > 0:
                    diagonal -= stiffness[i] * upper[i - 1]
                    residual += stiffness[i] * right[i - 1]
                upper[i] = stiffness[i + 1] / diagonal
                right[i] = -residual / diagonal
            for i in range(CELLS - 2, -1, -1):
                right[i] -= upper[i] * right[i + 1]
            for i in range(CELLS):
                theta[i] += right[i]
                largest = max(largest, abs(right[i]))
            if largest < 1e-12:
                break
    return theta


def fields(mu: Array) -> Array:
    """Displacements (N, 610) at 61 stations times 5 heights for scaled parameters ``mu`` (N, 3)."""
    ratio = np.exp(np.log(0.3) + (mu[:, 2] + 1.0) / 2.0 * np.log(10.0))
    theta = np.stack([elastica(4.0 * (m[0] + 1.0), 0.7 + 0.3 * m[1], k) for m, k in zip(mu, ratio, strict=True)])
    zero = np.zeros((len(mu), 1))
    x = np.hstack([zero, np.cumsum(np.cos(theta), axis=1)]) / CELLS
    y = np.hstack([zero, np.cumsum(np.sin(theta), axis=1)]) / CELLS
    at_faces = np.hstack([zero, (theta[:, 1:] + theta[:, :-1]) / 2.0, theta[:, -1:]])
    stations = slice(None, None, 2)
    height = np.linspace(-DEPTH / 2.0, DEPTH / 2.0, 5)
    along = (x - np.arange(CELLS + 1) / CELLS)[:, stations, None] - np.sin(at_faces)[:, stations, None] * height
    across = y[:, stations, None] + (np.cos(at_faces)[:, stations, None] - 1.0) * height
    return np.stack([along, across], axis=3).reshape(len(mu), -1)


def slopes(mu: Array, step: float = 1e-4) -> Array:
    """Sensitivities (3, N, 610) by central differences of the solver."""
    return np.stack([(fields(mu + step * unit) - fields(mu - step * unit)) / (2.0 * step) for unit in np.eye(3)])


def microseconds(functions: TensorFunctions) -> float:
    """Median time of value and all sensitivities at 500 points with three components."""
    rng = np.random.default_rng(0)
    field = SeparatedField(rng.normal(size=(functions.n_functions, 500, 3)), functions)
    mu, times = np.array([0.1, 0.2, 0.3]), []
    for _ in range(2000):
        start = time.perf_counter()
        field.value_and_sensitivities(mu)
        times.append(time.perf_counter() - start)
    return 1e6 * float(np.median(times))


class Report:
    """Held-out samples, and one printed line for each format."""

    def __init__(self) -> None:
        self.mu = np.random.default_rng(1).uniform(-0.95, 0.95, (N_HELD_OUT, 3))
        self.values, self.slopes = fields(self.mu), slopes(self.mu)
        print(f"{'format':34s} {'solves':>6s} {'floats':>8s} {'value':>8s} {'sensit.':>8s} {'us':>5s}")

    def line(self, name: str, pod: Pod, functions: TensorFunctions, n_solves: int) -> None:
        found = [functions.evaluate(m) for m in self.mu]
        values = np.stack([f[0] for f in found]) @ pod.modes
        gradients = np.stack([f[1] for f in found], axis=1) @ pod.modes
        value = np.linalg.norm(values - self.values) / np.linalg.norm(self.values)
        slope = np.linalg.norm(gradients - self.slopes) / np.linalg.norm(self.slopes)
        floats = functions.n_floats + pod.modes.size
        print(
            f"{name:34s} {n_solves:6d} {floats:8d} {value:8.1e} {slope:8.1e} {microseconds(functions):5.0f}", flush=True
        )


def grid_formats(report: Report) -> None:
    """All formats that need every point of a grid."""
    grids = tuple(np.linspace(-1.0, 1.0, n) for n in GRID)
    mu = np.stack(np.meshgrid(*grids, indexing="ij"), axis=-1).reshape(-1, 3)
    snapshots = fields(mu)
    pod = compute_pod(snapshots, np.ones(snapshots.shape[1]), 0.0, N_MODES)
    tensor = np.ascontiguousarray(pod.project(snapshots).T).reshape(-1, *GRID)
    cubic = tuple(cubic_spline_basis(g) for g in grids)
    hats = tuple(hat_basis(g) for g in grids)
    units = tuple(np.eye(n) for n in GRID)
    n = len(mu)
    report.line("POD 29 + full grid, hats", pod, TuckerFunctions(hats, units, tensor), n)
    interpolated = tuple(b.interpolate(g, np.eye(len(g))) for b, g in zip(cubic, grids, strict=True))
    report.line("POD 29 + full grid, cubic splines", pod, TuckerFunctions(cubic, interpolated, tensor), n)
    report.line("CP, 29 terms", pod, cp_functions(cp(tensor, 1e-6, 29), grids, cubic), n)
    for tolerance in (1e-3, 1e-4):
        found = tucker(tensor, tolerance)
        name = f"Tucker {found.core.shape[0]} x {found.core.shape[1:]}"
        report.line(name, pod, tucker_functions(found, grids, cubic), n)
        train = tensor_train(tensor, tolerance)
        name = f"tensor train {tuple(c.shape[0] for c in train.cores[1:])}"
        report.line(name, pod, tensor_train_functions(train, grids, cubic), n)


def scattered_formats(report: Report) -> None:
    """Sparse PGD in each basis."""
    mu = -np.cos(np.pi * qmc.Sobol(3, rng=0).random_base2(9)[:N_SAMPLES])
    snapshots = fields(mu)
    bases: dict[str, Basis] = {
        "hats": hat_basis(np.linspace(-1.0, 1.0, 13)),
        "Kriging": kriging_basis(-1.0, 1.0, np.linspace(-1.0, 1.0, 10), 1.0),
        "P-splines": p_spline_basis(-1.0, 1.0, 12),
        "Chebyshev": chebyshev_basis(-1.0, 1.0, 8),
    }
    for name, basis in bases.items():
        fit = fit_sparse_pgd(mu, snapshots, (basis,) * 3, N_MODES, pod_tolerance=1e-5)
        report.line(f"sparse PGD {len(fit.functions.mixing)}, {name}", fit.pod, fit.functions, len(mu))


def time_thirty_modes() -> str:
    """One line: times of 30 modes in each format, of sizes that errors of about 1e-4 ask for."""
    rng = np.random.default_rng(0)
    bases = tuple(cubic_spline_basis(np.linspace(-1.0, 1.0, n)) for n in GRID)
    factors = {rank: tuple(rng.normal(size=(n, rank)) for n in GRID) for rank in (8, 30)}
    ranks = (30, 16, 8, 1)
    cores = tuple(rng.normal(size=(a, n, b)) for a, n, b in zip(ranks, GRID, ranks[1:], strict=False))
    functions: dict[str, TensorFunctions] = {
        "cp": CPFunctions(bases, factors[30], np.eye(30)),
        "tucker": TuckerFunctions(bases, factors[8], rng.normal(size=(30, 8, 8, 8))),
        "tensor_train": TensorTrainFunctions(bases, cores),
    }
    return "modes=30 " + " ".join(f"{name}_us={microseconds(f):.0f}" for name, f in functions.items())


def main() -> None:
    report = Report()
    grid_formats(report)
    scattered_formats(report)
    print(time_thirty_modes())


if __name__ == "__main__":
    main()
