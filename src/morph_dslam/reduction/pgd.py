"""A-priori proper generalized decomposition (PGD) of linear problems with separated parameters.

U(X, mu) = sum_i F_i(X) prod_k G_i^k(mu_k) is found without any snapshot: each enrichment alternates between
space and the parameters until the new product settles (Cueto, Gonzalez and Alfaro, "Proper Generalized
Decompositions", 2016); then the functions of each parameter are refitted for all modes at once. The iteration
stops on the dual norm of the residual, which is the energy error where the operator does not depend on the
parameters; the ratio of the last mode to the first is no measure of the error.

The operator must be symmetric and positive definite: alternating directions minimise nothing otherwise.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.sparse.linalg import splu
from tqdm import tqdm

from morph_dslam.model.tensor_functions import CPFunctions
from morph_dslam.reduction.separable_problem import DualResidual, SeparableProblem, SeparatedSystem

Array = NDArray[np.float64]
#: All modes and all their functions are refitted after so many enrichments, and at the end.
REFIT_EVERY = 5


@dataclass(frozen=True)
class PgdSolution:
    """The separated solution.

    Attributes
    ----------
    modes : (n_modes, n), the functions F_i on the free degrees of freedom, amplitude included.
    functions : the products of the G_i^k, one for each mode, of unit norm over the parameters.
    residuals : (n_modes,), relative dual norm of the residual after each enrichment.
    iterations : (n_modes,), alternating directions spent on each.
    converged : whether the tolerance was met.
    """

    modes: Array
    functions: CPFunctions
    residuals: Array
    iterations: NDArray[np.int64]
    converged: bool


class _AlternatingDirections:
    """The state of the sum: modes (n, m), coefficients [(n_free, m)], and L_t F_i as images (terms, n, m)."""

    def __init__(self, system: SeparatedSystem) -> None:
        self.system = system
        n = len(system.loads)
        self.modes = np.zeros((n, 0))
        self.images = np.zeros((system.operators.n_terms, n, 0))
        self.coefficients = [np.zeros((len(mass), 0)) for mass in system.masses]
        self._random = np.random.default_rng(0)

    def _normalise(self, k: int, coefficients: Array) -> tuple[Array, Array]:
        """Functions (n_free, m) of axis k scaled to unit norm, and the norms taken out (m,)."""
        norms = np.sqrt(np.einsum("am,ab,bm->m", coefficients, self.system.masses[k], coefficients))
        norms = np.maximum(norms, np.finfo(float).tiny)
        return coefficients / norms, norms

    def _images(self, mode: Array) -> Array:
        """L_t F (terms, n) for one mode (n,)."""
        operators = self.system.operators
        return np.stack([operators.apply(t, mode) for t in range(operators.n_terms)])

    def _products(self, k: int, new: Array) -> tuple[Array, Array, Array]:
        """Of a new function (n_free,) of axis k: with itself (terms,), the old (terms, m), the loads (J,)."""
        images = new @ self.system.grams[k]
        return images @ new, images @ self.coefficients[k], self.system.load_vectors[k] @ new

    def enrich(self, tolerance: float, max_iterations: int) -> int:
        """Add the product that the alternating directions settle on; returns the iterations spent."""
        axes = range(len(self.coefficients))
        new = [
            self._normalise(k, 1.0 + self._random.standard_normal((len(self.coefficients[k]), 1)))[0][:, 0]
            for k in axes
        ]
        products = [self._products(k, new[k]) for k in axes]
        iterations, change, amplitude, mode = 0, np.inf, 1.0, np.zeros(len(self.modes))
        while change > tolerance and iterations < max_iterations:
            iterations, change = iterations + 1, 0.0
            mode = self._space_step(products)
            images = self._images(mode)
            for k in axes:
                found, norm = self._normalise(k, self._parameter_step(k, products, mode, images)[:, None])
                difference = found[:, 0] - new[k]
                change = max(change, float(np.sqrt(difference @ self.system.masses[k] @ difference)))
                new[k], amplitude = found[:, 0], float(norm[0])
                products[k] = self._products(k, new[k])
        mode = mode * amplitude
        self.modes = np.column_stack([self.modes, mode])
        self.images = np.concatenate([self.images, self._images(mode)[:, :, None]], axis=2)
        self.coefficients = [np.column_stack([c, v]) for c, v in zip(self.coefficients, new, strict=True)]
        return iterations

    def _space_step(self, products: list[tuple[Array, Array, Array]]) -> Array:
        """R: [sum_t c_t L_t] R = sum_j h_j (...) - sum_t,i L_t F_i (...)."""
        weights, cross, load = (np.prod([p[i] for p in products], axis=0) for i in range(3))
        right = self.system.loads @ load - np.einsum("tni,ti->n", self.images, cross, optimize=True)
        return self.system.operators.solve(weights, right)

    def _parameter_step(self, k: int, products: list[tuple[Array, Array, Array]], mode: Array, images: Array) -> Array:
        """The new function of axis k, coefficients (n_free,), for a given mode and other functions."""
        grams = self.system.grams[k]
        energy = images @ mode
        cross = np.einsum("n,tni->ti", mode, self.images, optimize=True)
        load = mode @ self.system.loads
        for other, (weights_, cross_, load_) in enumerate(products):
            if other != k:
                energy, cross, load = energy * weights_, cross * cross_, load * load_
        right = load @ self.system.load_vectors[k]
        right = right - np.einsum("tab,bi,ti->a", grams, self.coefficients[k], cross, optimize=True)
        return np.linalg.solve(np.tensordot(energy, grams, axes=1), right)

    def refit(self) -> None:
        """All functions of one parameter after the other, then the modes one by one."""
        for k in range(len(self.coefficients)):
            self._refit_axis(k)
        self._refit_modes()

    def _overlaps(self, skip: int | None = None) -> tuple[Array, Array]:
        """Products over all axes but ``skip``: of the functions (terms, m, m), with the loads (J, m)."""
        m = self.modes.shape[1]
        energy = np.ones((self.system.operators.n_terms, m, m))
        load = np.ones((self.system.loads.shape[1], m))
        for k, c in enumerate(self.coefficients):
            if k != skip:
                energy = energy * (c.T @ self.system.grams[k] @ c)
                load = load * (self.system.load_vectors[k] @ c)
        return energy, load

    def _refit_axis(self, k: int) -> None:
        """The functions of axis k of all modes at once, for fixed modes and other functions."""
        energy, load = self._overlaps(skip=k)
        energy = energy * np.einsum("nj,tni->tji", self.modes, self.images, optimize=True)
        load = load * (self.system.loads.T @ self.modes)
        # unit energy of every mode, so that modes of very different size stay well conditioned
        scale = 1.0 / np.sqrt(np.maximum(np.abs(np.einsum("tii->i", energy)), np.finfo(float).tiny))
        energy = energy * scale[:, None] * scale
        right = self.system.load_vectors[k].T @ (load * scale)
        grams = [sp.csr_array(g) for g in self.system.grams[k]]
        matrix = sum(sp.kron(g, sp.csr_array(e)) for g, e in zip(grams, energy, strict=True))
        found = splu(sp.csc_array(matrix)).solve(right.ravel()).reshape(right.shape) * scale
        self.coefficients[k], norms = self._normalise(k, found)
        self.modes = self.modes * norms
        self.images = self.images * norms

    def _refit_modes(self) -> None:
        """One Gauss-Seidel sweep over the modes, each for the residual that the others leave."""
        energy, load = self._overlaps()
        for i in range(self.modes.shape[1]):
            others = energy[:, i, :].copy()
            others[:, i] = 0.0
            right = self.system.loads @ load[:, i]
            right = right - np.einsum("tnj,tj->n", self.images, others, optimize=True)
            self.modes[:, i] = self.system.operators.solve(energy[:, i, i], right)
            self.images[:, :, i] = self._images(self.modes[:, i])


def solve_pgd(
    problem: SeparableProblem,
    max_modes: int = 40,
    tolerance: float = 1e-4,
    *,
    inner_tolerance: float = 1e-3,
    inner_iterations: int = 25,
) -> PgdSolution:
    """Enrich until the dual residual meets the tolerance or the modes run out.

    Parameters
    ----------
    problem : what to solve.
    max_modes : at most this many products.
    tolerance : stop when the relative dual norm of the residual falls below.
    inner_tolerance : change of the functions at which the alternating directions of one enrichment stop; the
        refits make up for what they leave.
    inner_iterations : at most so many of them.
    """
    state = _AlternatingDirections(SeparatedSystem.of(problem))
    dual = DualResidual(problem)
    residuals: list[float] = []
    iterations: list[int] = []
    bar = tqdm(total=max_modes, desc="PGD", unit="mode")
    while len(residuals) < max_modes:
        iterations.append(state.enrich(inner_tolerance, inner_iterations))
        if len(iterations) == max_modes or len(iterations) % REFIT_EVERY == 0:
            state.refit()
        residuals.append(dual.relative(state.modes, state.coefficients))
        bar.update()
        bar.set_postfix_str(f"residual {residuals[-1]:.1e}")
        if residuals[-1] <= tolerance:
            break
    bar.close()
    functions = CPFunctions(tuple(a.basis for a in problem.axes), tuple(state.coefficients), np.eye(len(residuals)))
    converged = residuals[-1] <= tolerance
    return PgdSolution(state.modes.T, functions, np.array(residuals), np.array(iterations), converged)
