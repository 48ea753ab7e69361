"""A Koiter sheet with moved edges and dead loads as `newton.Equations`: for arc length and buckling.

Two parameters: mu[0] scales the motion of the moved edges, mu[1] the shell's dead loads. Displacements are
counted from the plane. An initial imperfection w0 (a stress-free shape) enters exactly, without another form:
strains and curvatures appear in the mixed energy as N:E(u) + m:kappa(u), so that taking E(w0) and kappa(w0)
off them subtracts a constant from the equations of the forces and moments.
"""

from __future__ import annotations

import ngsolve as ngs
import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from morph_dslam.mechanics.shell import KoiterSheet
from morph_dslam.mechanics.solvers.condensation import Condensation, CondensedLinearisation
from morph_dslam.mechanics.solvers.linear_solver import AssembledLinearisation, LinearSolver
from morph_dslam.mechanics.solvers.newton import Linearisation

Array = NDArray[np.float64]


class SheetEquations:
    """Equilibrium of a `KoiterSheet`; forces are in units of its ``energy_scale``.

    Parameters
    ----------
    shell : with the edges that are moved among its ``clamped`` ones.
    motion : boundary name -> displacement (3,) of that edge at mu[0] = 1, m.
    length : of the sheet, m: the unit in which changes of its displacement are measured.
    condensed : eliminate the dofs inside elements before the factorisation: far cheaper, but each
        linearisation is then assembled again if used after another one is made, so not for `buckling_modes`.
    threads : of the linear solver.
    """

    def __init__(
        self,
        shell: KoiterSheet,
        motion: dict[str, Array],
        length: float,
        condensed: bool = True,
        threads: int | None = None,
    ) -> None:
        self.shell, self.condensed, self.n_dofs = shell, condensed, shell.space.ndof
        form = ngs.BilinearForm(shell.space, symmetric=True, condense=condensed, store_inner=condensed)
        for part in shell.form.integrators:
            form += part
        self._condensation = Condensation(form)
        self.free = np.array(shell.space.FreeDofs())
        self.solver = LinearSolver(np.array(shell.space.FreeDofs(condensed)), symmetric=True, threads=threads)
        self.scale = np.full(self.n_dofs, np.inf)
        for component in range(3):
            self.scale[shell.displacement_dofs(component)] = length
        self._motion = self._edge_motion(motion)
        self._initial = np.zeros(self.n_dofs)
        self.unloaded = np.zeros(self.n_dofs)
        still, loaded = np.zeros(self.n_dofs), np.array([0.0, 1.0])
        self._load_slope = self.residual(still, loaded) - self.residual(still, np.zeros(2))

    def _edge_motion(self, motion: dict[str, Array]) -> Array:
        result = np.zeros(self.n_dofs)
        for name, displacement in motion.items():
            for component, value in enumerate(displacement):
                field = ngs.GridFunction(self.shell.scalar_space)
                field.Set(ngs.CF(float(value)), definedon=self.shell.mesh.Boundaries(name))
                result[self.shell.displacement_dofs(component)] += field.vec.FV().NumPy()
        return result

    def set_imperfection(self, dofs: Array) -> None:
        """Make the displacement in ``dofs`` (n,) the stress-free shape; its other entries do not matter.

        It must be level along clamped edges. A solution then starts from `unloaded`.
        """
        shape = np.zeros(self.n_dofs)
        for component in range(3):
            part = self.shell.displacement_dofs(component)
            shape[part] = dofs[part]
        self._initial[:] = 0.0
        self._use(shape, np.zeros(2))
        self.shell.refresh_normals()
        initial = self.residual(shape, np.zeros(2))
        initial[np.isfinite(self.scale)] = 0.0
        # The rotations of edges between elements are unknowns too, but nothing is taken off their equations.
        rotations = self.shell.space.Range(4)
        initial[rotations.start : rotations.stop] = 0.0
        self._initial, self.unloaded = initial, shape

    def prescribed(self, mu: Array) -> Array:
        return mu[0] * self._motion

    def prescribed_slopes(self, mu: Array) -> Array:
        return np.array([self._motion, np.zeros(self.n_dofs)])[: len(mu)]

    def residual(self, x: Array, mu: Array) -> Array:
        self._use(x, mu)
        result = self.shell.state.vec.CreateVector()
        self._condensation.form.Apply(self.shell.state.vec, result)
        return result.FV().NumPy() - self._initial

    def residual_slopes(self, x: Array, mu: Array) -> Array:
        return np.array([np.zeros_like(x), self._load_slope])[: len(mu)]

    def linearise(self, x: Array, mu: Array) -> Linearisation:
        """Tangent at ``x``; the frozen edge normals are averaged there first.

        That renewal shifts the meaning of the edges' rotations, which the next correction makes up for.
        """
        x, mu = x.copy(), mu.copy()
        matrix = self._tangent(x, mu)
        linearisation = AssembledLinearisation(self.residual(x, mu), matrix, self.solver)
        if not self.condensed:
            return linearisation
        return CondensedLinearisation(self._condensation, linearisation, lambda: self._tangent(x, mu))

    def _tangent(self, x: Array, mu: Array) -> sp.csr_matrix:
        self._use(x, mu)
        self.shell.refresh_normals()
        form = self._condensation.form
        form.AssembleLinearization(self.shell.state.vec)
        data, indices, indptr = form.mat.CSR()
        arrays = np.array(data), np.array(indices), np.array(indptr, dtype=np.int64)
        return sp.csr_matrix(arrays, shape=(self.n_dofs, self.n_dofs))

    def _use(self, x: Array, mu: Array) -> None:
        self.shell.state_vector()[:] = x
        self.shell.load_factor.Set(float(mu[1]))

    def end_force(self, x: Array, mu: Array) -> float:
        """Force along the motion of the edges, conjugate to mu[0]: d energy / d mu[0], N."""
        return float(self._motion @ self.residual(x, mu)) * self.shell.energy_scale

    def bending_energy(self, x: Array, mu: Array) -> float:
        """Elastic energy of bending, joule."""
        self._use(x, mu)
        return self.shell.bending_energy()
