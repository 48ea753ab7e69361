"""Stresses of a solved shell at its nodes, and their derivatives by the parameters.

The second Piola-Kirchhoff stress S of a face is N/t -+ 6 m/t^2, in the material's frame; N and m are polynomials in
each cell, evaluated at its nodes and averaged, unweighted, over the cells around each.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import ngsolve as ngs
import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from morph_dslam.mechanics.ngsolve_mesh import reference_points
from morph_dslam.mechanics.shell_energy import ShellKinematics
from morph_dslam.mechanics.shell_material import components

if TYPE_CHECKING:
    from morph_dslam.mechanics.shell_problem import ShellProblem

Array = NDArray[np.float64]
#: Sign of the moments' part in the stress of each face: the top is on the side of the normal.
FACES = {"stress_top": -1.0, "stress_bottom": 1.0}


class ShellRecovery:
    """Evaluates the fields of one problem; its expressions are made once."""

    def __init__(self, problem: ShellProblem) -> None:
        self._problem, normal = problem, ShellKinematics.reference_normal
        self._state = ngs.GridFunction(problem.space)
        parts, t = problem.unknowns(self._state.components), problem.thickness
        frame = problem.material.frame(normal)
        self._stresses = {
            name: ngs.CF(components(parts.force / t + sign * 6.0 / t**2 * parts.moment, *frame))
            for name, sign in FACES.items()
        }
        self._points, self._average = self._node_rule()

    def _node_rule(self) -> tuple[NDArray, sp.csr_matrix]:
        """The nodes of every cell as NGSolve's points (p,), and the averages (n_nodes, p) over them."""
        geometry, mesh, points, nodes = self._problem.geometry, self._problem.mesh, [], []
        for block, start in zip(mesh.blocks, mesh.block_starts()[:-1], strict=True):
            reference = reference_points(block.type.shape, block.type.nodes)
            elements = geometry.element_of_cell[start : start + len(block.connectivity)]
            repeated = np.tile(reference, (len(elements), 1))
            points.append(geometry.mesh_points(np.repeat(elements, len(reference)), repeated))
            nodes.append(block.connectivity.ravel())
        rows = np.concatenate(nodes)
        share = 1.0 / np.bincount(rows, minlength=mesh.n_nodes)[rows]
        average = sp.csr_matrix((share, (rows, np.arange(len(rows)))), shape=(mesh.n_nodes, len(rows)))
        return np.concatenate(points), average

    def _set(self, dofs: Array, mu: Array) -> None:
        self._problem.symbols.set(mu)
        self._state.vec.FV().NumPy()[:] = dofs

    def at_nodes(self, dofs: Array, mu: Array) -> dict[str, Array]:
        """Displacement (n, 3) m, and stress_top and stress_bottom (n, 3) Pa as S11, S22, S12, at the nodes."""
        self._set(dofs, mu)
        result = {"displacement": self._problem.nodal_displacement(dofs)}
        return result | {name: self._average @ stress(self._points) for name, stress in self._stresses.items()}

    def slopes_at_nodes(self, dofs: Array, mu: Array, dof_slopes: Array) -> dict[str, Array]:
        """Total derivatives (d, n, 3) of the same by the parameters; ``dof_slopes`` (d, n) are the solution's."""
        by_direction = [self.at_nodes(slope, mu) for slope in dof_slopes]
        result = {name: np.array([fields[name] for fields in by_direction]) for name in by_direction[0]}
        self._set(dofs, mu)
        for name, stress in self._stresses.items():
            for index, slope in self._problem.symbols.derivatives(stress).items():
                result[name][index] += self._average @ slope(self._points)
        return result
