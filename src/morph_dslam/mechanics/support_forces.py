"""Force and moment of each support, of the forces on all dofs: what it holds itself, and the pull of its springs.

A support has the forces on the components that it prescribes. Where several prescribe the same component of the same
node, as on an edge of two fixed faces, each has an equal share, so that all supports together balance the loads. A
foundation has the integral of its traction -k u.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from morph_dslam.mechanics.kinematics import Kinematics, Shape
from morph_dslam.mechanics.parameters import ParameterSymbols
from morph_dslam.mechanics.solid_assembly import Assembly, Term
from morph_dslam.mechanics.spaces import DisplacementSpace
from morph_dslam.mechanics.supports import Constraints, ElasticFoundation, PrescribedMotion

Array = NDArray[np.float64]


class SupportForces:
    """What the supports of each set exert, at the parameters' present values.

    Forces and displacements are given by dof, (3, n_scalar); derivatives have a first axis (d,) more.

    Parameters
    ----------
    constraints : of the same supports.
    space : the displacements.
    shape : the undeformed shape.
    supports : all of them.
    symbols : the parameters.
    """

    def __init__(
        self,
        constraints: Constraints,
        space: DisplacementSpace,
        shape: Shape,
        supports: Sequence[PrescribedMotion | ElasticFoundation],
        symbols: ParameterSymbols,
    ) -> None:
        self._constraints, self._space, self._shape, self._symbols = constraints, space, shape, symbols
        self._foundations = [s for s in supports if isinstance(s, ElasticFoundation)]
        self._named = {support.on for support in supports}
        self._shares = constraints.shares()

    def resultant(self, name: str, forces: Array, displacement: Array, about: Array | None) -> tuple[Array, Array]:
        """Force (3,), N, and moment (3,), N m, of the supports of a set.

        Parameters
        ----------
        name : node set or surface; of one that no support names, all that is held of its nodes.
        forces : (3, n_scalar) residual, N.
        displacement : (3, n_scalar), m; the moment is taken at the deformed positions.
        about : point of the moment (3,), m; None for the centroid of the set's undeformed nodes.
        """
        about = self._constraints.centroid(name)[0] if about is None else about
        f = self._share(name) * forces
        if name in self._springs:
            f = f - self._springs[name].residual(displacement.ravel()).reshape(f.shape)
        return f @ self._space.constant, np.cross(self._arms(displacement, about), f.T).sum(axis=0)

    def resultant_slopes(
        self,
        name: str,
        forces: tuple[Array, Array],
        displacements: tuple[Array, Array],
        about: Array,
        by_parameters: bool = True,
    ) -> tuple[Array, Array]:
        """Derivatives (d, 3) of `resultant`'s force, and of its moment about a point that stays.

        Parameters
        ----------
        name : node set or surface.
        forces : (3, n_scalar) residual, N, and its derivatives (d, 3, n_scalar).
        displacements : (3, n_scalar), m, and its derivatives (d, 3, n_scalar).
        about : point of the moment (3,), m.
        by_parameters : whether the derivatives are by the parameters, with which undeformed shape and springs may
            change; otherwise by d other loads.
        """
        share, (u, u_slopes) = self._share(name), displacements
        f, f_slopes = (share * part for part in forces)
        if name in self._springs:
            springs = self._springs[name]
            f = f - springs.residual(u.ravel()).reshape(f.shape)
            changes = np.array([springs.residual(slope.ravel()) for slope in u_slopes])  # linear in the displacement
            if by_parameters:
                changes = changes + springs.residual_slopes(u.ravel())
            f_slopes = f_slopes - changes.reshape(f_slopes.shape)
        arm_slopes = u_slopes.transpose(0, 2, 1)
        if by_parameters:
            arm_slopes = arm_slopes + np.array(self._shape.coordinate_slopes(self._symbols))
        moments = np.cross(arm_slopes, f.T) + np.cross(self._arms(u, about), f_slopes.transpose(0, 2, 1))
        return f_slopes @ self._space.constant, moments.sum(axis=1)

    def _arms(self, displacement: Array, about: Array) -> Array:
        """(n_scalar, 3) coefficients of the deformed position from a point."""
        return self._shape.coordinates(self._symbols) + displacement.T - np.outer(self._space.constant, about)

    def _share(self, name: str) -> Array:
        """(3, n_scalar) part of the held forces that the supports of a set have."""
        if name in self._named:
            return self._shares.get(name, np.zeros((3, self._space.n_scalar)))
        there = np.zeros(self._space.n_scalar, dtype=bool)
        there[self._space.dofs_on(self._space.geometry.mesh.set_nodes(name))] = True
        return np.where(there & self._constraints.held.reshape(3, -1), 1.0, 0.0)

    @cached_property
    def _springs(self) -> dict[str, Assembly]:
        """The foundations of each set; the forces on them are linear in the displacement."""
        kinematics = Kinematics(self._space.vector.TrialFunction(), self._shape)
        terms: dict[str, list[Term]] = {}
        for support in self._foundations:
            term = Term(support.energy(kinematics), self._space.geometry.boundary(support.on))
            terms.setdefault(support.on, []).append(term)
        n = 3 * self._space.n_scalar
        return {name: Assembly(self._space.vector, own, self._symbols, n) for name, own in terms.items()}
