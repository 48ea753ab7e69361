"""The linear bar as a sum of matrices and a sum of loads, as other libraries take it (reduction_peers.py)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from morph_dslam.extend.models import chebyshev_basis
from morph_dslam.mechanics.solid import SolidProblem
from morph_dslam.mechanics.solvers.linear_solver import LinearSolver

Array = NDArray[np.float64]
#: Chebyshev polynomials that the load is expanded in along its path, and what its few vectors leave out of it.
LOAD_FUNCTIONS, LEFT_OUT = 257, 1e-11


@dataclass(frozen=True)
class AffineBar:
    """K_ff(mu) u_f = f_f(mu) with K_ff affine in two Young's moduli and f_f of few vectors along the path.

    The parameters are the place of the load and the two moduli; no displacement is prescribed but zero.

    Attributes
    ----------
    problem : whose dofs these are.
    free : (n_free,) indices of the dofs that are solved for.
    matrices : data (3, nnz) of the constant part and of one Pa of each modulus, in the pattern of ``indices``
        and ``indptr`` (CSR, symmetric).
    loads : (n_free, J).
    series : (LOAD_FUNCTIONS, J) of the loads' functions of the place.
    """

    problem: SolidProblem
    free: NDArray[np.int64]
    matrices: Array
    indices: NDArray[np.int32]
    indptr: NDArray[np.int32]
    loads: Array
    series: Array

    @classmethod
    def of(cls, problem: SolidProblem) -> AffineBar:
        """Take it from the finite elements."""
        free = np.flatnonzero(problem.free & problem.assembly.coupled)
        place, middle, tip = problem.symbols.parameters
        softest = np.array([place.default, middle.lower, tip.lower])
        spreads = np.diag([0.0, middle.upper - middle.lower, tip.upper - tip.lower])
        blocks = [_free_block(problem, mu, free) for mu in (softest, softest + spreads[1], softest + spreads[2])]
        slopes = [(blocks[k].data - blocks[0].data) / spreads[k, k] for k in (1, 2)]
        constant = blocks[0].data - softest[1] * slopes[0] - softest[2] * slopes[1]

        basis = chebyshev_basis(place.lower, place.upper, LOAD_FUNCTIONS - 1)
        cosines = np.cos(np.pi * np.arange(LOAD_FUNCTIONS) / (LOAD_FUNCTIONS - 1))
        places = (place.lower + place.upper) / 2.0 + (place.upper - place.lower) / 2.0 * cosines
        rest = np.zeros(problem.n_dofs)
        along = [-problem.residual(rest, np.array([x, *softest[1:]]))[free] for x in places]
        left, sizes, right = np.linalg.svd(basis.interpolate(places, np.array(along)), full_matrices=False)
        count = int(np.sum(sizes > LEFT_OUT * sizes[0]))
        loads, series = right[:count].T * sizes[:count], left[:, :count]
        return cls(problem, free, np.array([constant, *slopes]), blocks[0].indices, blocks[0].indptr, loads, series)

    @property
    def box(self) -> Array:
        """Ends (3, 2) of the parameters."""
        return np.array([[p.lower, p.upper] for p in self.problem.symbols.parameters])

    def weights(self, samples: Array) -> Array:
        """Of the matrices (n, 3) at ``samples`` (n, 3)."""
        return np.column_stack([np.ones(len(samples)), samples[:, 1:]])

    def load_weights(self, samples: Array) -> Array:
        """Of the loads (n, J) at ``samples`` (n, 3)."""
        return chebyshev_basis(*self.box[0], LOAD_FUNCTIONS - 1).evaluate(samples[:, 0]) @ self.series

    def stiffness(self, mu: Array) -> Array:
        """Data of K_ff at ``mu`` (3,)."""
        return self.weights(mu[None])[0] @ self.matrices

    def solve(self, samples: Array) -> Array:
        """Solutions (n, n_nodes, 3) at ``samples`` (n, 3), directly."""
        solver = LinearSolver(np.ones(len(self.free), dtype=bool), symmetric=True, threads=1)
        found = [
            solver.factorise(self.stiffness(mu), self.indices, self.indptr).solve(self.loads @ weights)
            for mu, weights in zip(samples, self.load_weights(samples), strict=True)
        ]
        return self.nodal_displacements(np.array(found))

    def nodal_displacements(self, found: Array) -> Array:
        """(n, n_nodes, 3) of solutions (n, n_free)."""
        dofs = np.zeros((len(found), self.problem.n_dofs))
        dofs[:, self.free] = found
        return np.array([self.problem.nodal_displacement(x) for x in dofs])


def _free_block(problem: SolidProblem, mu: Array, free: NDArray[np.int64]) -> sp.csr_array:
    """K_ff at ``mu``; its pattern is the same for all parameters."""
    problem.symbols.set(mu)
    return problem.assembly.tangent(np.zeros(problem.n_dofs))[free][:, free].sorted_indices()
