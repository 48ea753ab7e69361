"""A linear solid as a-priori PGD needs it: stiffness, load and prescribed displacements, separated.

A solid's residual r(x, mu) is linear in its displacements, r = K(mu) x - f(mu), where every material is
linear elastic and no load follows the deformation. With x = g(mu) + u, g the prescribed displacements and u
zero at their dofs, equilibrium is K_ff u_f = -r(g(mu), mu)_f. K, the right-hand side and g, functions of the
parameters, are taken from the finite elements as they are, and separated (`separation`).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from morph_dslam.errors import StudyError
from morph_dslam.mechanics.loads import FollowerPressure
from morph_dslam.mechanics.materials.isotropic import LinearElastic
from morph_dslam.mechanics.solid import SolidProblem
from morph_dslam.mechanics.solvers.linear_solver import LinearSolver
from morph_dslam.model import Parameter
from morph_dslam.model.basis_functions import Basis
from morph_dslam.reduction.separable_problem import SeparableProblem, galerkin_axis
from morph_dslam.reduction.separation import SeparatedVector, generic_points, separate
from morph_dslam.studies.problem import SweepProblem
from morph_dslam.studies.solid_sweep import SolidSweep

Array = NDArray[np.float64]
#: Size of the displacements over the body's extent with which linearity is tried, and what may be left over.
PROBE, LINEAR = 1e-2, 1e-9


@dataclass(frozen=True)
class LinearSolid:
    """The separated functions of a linear solid; dofs are those of its `SolidProblem`.

    Attributes
    ----------
    free : (n_free,) indices of the dofs that are solved for.
    stiffness : data of K_ff in the pattern of ``indices`` and ``indptr`` (CSR, symmetric).
    load : right-hand side (n_free,). prescribed : g (n_dofs,).
    """

    problem: SolidProblem
    parameters: tuple[Parameter, ...]
    free: NDArray[np.int64]
    stiffness: SeparatedVector
    indices: NDArray[np.int32]
    indptr: NDArray[np.int32]
    load: SeparatedVector
    prescribed: SeparatedVector

    def matrix(self, data: Array) -> sp.csc_array:
        """The sparse matrix (n_free, n_free) of stiffness ``data``."""
        return sp.csc_array((data, self.indices, self.indptr), shape=(len(self.free),) * 2)

    def solve(self, mu: Array) -> Array:
        """u_f (n_free,) at ``mu`` (d,), directly."""
        data = self.stiffness.value(mu)
        return self._solver.factorise(data, self.indices, self.indptr).solve(self.load.value(mu))

    @cached_property
    def _solver(self) -> LinearSolver:
        return LinearSolver(np.ones(len(self.free), dtype=bool), symmetric=True, threads=self.problem.options.threads)

    def separable(self, bases: tuple[Basis, ...]) -> SeparableProblem:
        """The problem for u_f with functions of the parameters in ``bases``."""
        axes = tuple(galerkin_axis(basis) for basis in bases)
        middle = np.array([(p.lower + p.upper) / 2.0 for p in self.parameters])
        return SeparableProblem(
            axes,
            tuple(self.matrix(data) for data in self.stiffness.vectors.T),
            tuple(a.multiplied_by(self.stiffness.functions(k, a.points)) for k, a in enumerate(axes)),
            self.load.vectors,
            tuple(self.load.functions(k, a.points) for k, a in enumerate(axes)),
            self.matrix(self.stiffness.value(middle)),
        )


def linear_solid(sweep: SweepProblem) -> LinearSolid:
    """Check that a study's problem is linear and separable, and separate it.

    Raises
    ------
    StudyError
        Naming what is not linear, or the parameters that are not separable, and what to use instead.
    """
    problem = _solid_of(sweep)
    parameters = problem.symbols.parameters
    _check_linear(problem)
    free = np.flatnonzero(problem.free & problem.assembly.coupled)
    pattern = _free_block(problem, problem.symbols.default, free)

    def stiffness(mu: Array) -> Array:
        return np.asarray(_free_block(problem, mu, free).data, dtype=np.float64)

    def load(mu: Array) -> Array:
        return -problem.residual(problem.prescribed(mu), mu)[free]

    forces = separate(load, parameters, "the load")
    if not forces.n_terms:
        raise StudyError(
            'reduction.method = "pgd": nothing moves this solid: it needs a load or a prescribed displacement'
            " that is not zero"
        )
    return LinearSolid(
        problem,
        parameters,
        free,
        separate(stiffness, parameters, "the stiffness"),
        pattern.indices,
        pattern.indptr,
        forces,
        separate(problem.prescribed, parameters, "the prescribed displacement"),
    )


def _free_block(problem: SolidProblem, mu: Array, free: NDArray[np.int64]) -> Any:
    """K_ff (CSR) at ``mu``; its pattern is the same for all parameters."""
    problem.symbols.set(mu)
    return problem.assembly.tangent(np.zeros(problem.n_dofs))[free][:, free].sorted_indices()


def _refuse(why: str) -> StudyError:
    return StudyError(
        f'reduction.method = "pgd" is for linear solids, and {why}: use method = "galerkin" for this study'
    )


def _solid_of(sweep: SweepProblem) -> SolidProblem:
    """The solid behind a sweep, if it is of the kind that PGD solves."""
    if not isinstance(sweep, SolidSweep):
        raise _refuse("this study's solutions depend on their past, or are those of a sheet")
    problem = sweep.problem
    if problem.shape.functions:
        raise _refuse("its stiffness is no short sum of products where [[shape]] moves the mesh")
    if problem.options.mixed:
        raise StudyError(
            'reduction.method = "pgd" has no pressures: leave out solver.formulation = "mixed", or use '
            'method = "galerkin"'
        )
    if problem.assembly.condensed:
        raise StudyError('reduction.method = "pgd" takes hex20 or hex8 in place of hex27 cells')
    return problem


def _check_linear(problem: SolidProblem) -> None:
    """Refuse what is not linear, by its name where it has one."""
    for region in problem.regions:
        if not isinstance(region.material, LinearElastic):
            raise _refuse(f"the material '{region.material.name}' is not: linear_elastic is")
    for load in problem.loads:
        if isinstance(load, FollowerPressure):
            raise _refuse(f"the pressure on '{load.on}' follows the deformation: a traction does not")
    rng = np.random.default_rng(0)
    box = np.array([[p.lower, p.upper] for p in problem.symbols.parameters])
    mu = generic_points(box, 1, 0)[0]
    a, b = PROBE * problem.length * rng.standard_normal((2, problem.n_dofs))
    both, first, second, none = (problem.residual(x, mu) for x in (a + b, a, b, np.zeros(len(a))))
    if np.linalg.norm(both - first - second + none) > LINEAR * np.linalg.norm(both):
        raise _refuse("its forces are not proportional to its displacements")
