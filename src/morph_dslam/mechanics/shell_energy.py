"""Energy of a nonlinear Koiter shell on a surface in space, and the averaged normals on its edges.

The formulation is that of Neunteufel and Schöberl ("The Hellan-Herrmann-Johnson and TDNNS methods for linear and
nonlinear shells", Computers & Structures 305, 2024): bending moments and a rotation on the edges are unknowns beside
the displacement, so that continuous elements suffice. With n and nu the unit normals before and after, F the surface
deformation gradient, P the projection on the surface, E = (F'F - P)/2 interpolated into Regge's space ("Avoiding
membrane locking with Regge interpolation", CMAME 373, 2021), kappa the change of curvature

    kappa = sum_i nu_i grad^2 u_i + (1 - n . nu) grad n,

moments m, membrane forces N (independent unknowns too, as in `shell`) and A half the compliance:

    int  N:E - N:A:N/t  +  m:kappa - 12/t^3 m:A:m   -   sum over elements int over the rim (angle - angle_0 - h) m_nn

The angle is that between the element's normal and the averaged one at the edge; h is the rotation of the averaged one.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import ngsolve as ngs
import numpy as np
from numpy.typing import NDArray

from morph_dslam.mechanics.shell_supports import HoldsDirection

Array = NDArray[np.float64]


def unit(vector: Any) -> Any:
    """A vector over its length."""
    return vector / ngs.Norm(vector)


class ShellKinematics:
    """Coefficient functions on the surface, of a displacement: a trial function or a grid function.

    Attributes
    ----------
    gradient : F (3x3), which takes the undeformed normal to zero.
    strain : Green-Lagrange strain E (3x3) of the surface.
    normal : unit normal of the deformed surface.
    """

    reference_normal = ngs.specialcf.normal(3)

    def __init__(self, displacement: Any) -> None:
        n = self.reference_normal
        projection = ngs.Id(3) - ngs.OuterProduct(n, n)
        gradient = ngs.Grad(displacement)
        # Only trial functions have to be told that they are meant on the surface.
        self._gradient = gradient.Trace() if hasattr(gradient, "Trace") else gradient
        self.gradient = self._gradient + projection
        self.strain = 0.5 * (self.gradient.trans * self.gradient - projection)
        self.normal = unit(ngs.Cof(self.gradient) * n)
        self._displacement = displacement

    @property
    def curvature(self) -> Any:
        """Change of curvature kappa (3x3)."""
        n = self.reference_normal
        second = (self._displacement.Operator("hesseboundary").trans * self.normal).Reshape((3, 3))
        return second + (1.0 - n * self.normal) * ngs.Grad(n)

    @property
    def tangent(self) -> Any:
        """Unit tangent of the deformed edge, on the rim of an element."""
        return unit(self.gradient * ngs.specialcf.tangential(3))


def rim_angle(normal: Any, tangent: Any, averaged: Any) -> Any:
    """Angle on the rim of an element from its unit ``normal`` to the ``averaged`` one, across the unit ``tangent``."""
    across = unit(averaged - (tangent * averaged) * tangent)
    return ngs.asin(ngs.Cross(normal, tangent) * across)


class AveragedNormals:
    """Unit normals on the edges, averaged between the elements around them and then kept fixed.

    The sum of the two angles that an edge sees does not depend on this field, so freezing it is exact; it only keeps
    the arc sine away from its branch. Edges that a support holds have the normal that this gives them.

    Parameters
    ----------
    mesh : of the surface.
    order : polynomial degree of the normals along an edge.
    state : the displacement (grid function) at which they are averaged.
    held : supports with the edges (numbers) that they hold.
    turned : the share of the angle that supports turn by.

    Attributes
    ----------
    indicators : by the set of a support, 1 on the edges that it holds and 0 on others.
    """

    def __init__(
        self,
        mesh: ngs.Mesh,
        order: int,
        state: ngs.GridFunction,
        held: Sequence[tuple[HoldsDirection, list[int]]],
        turned: Any,
    ) -> None:
        self._turned = turned
        self._everywhere = mesh.Boundaries(".*")
        space = ngs.VectorFacetSurface(mesh, order=order)
        self._current, self._reference = ngs.GridFunction(space), ngs.GridFunction(space)
        self._reference.Set(ShellKinematics.reference_normal, dual=True, definedon=self._everywhere)
        self._kinematics = ShellKinematics(state)
        self._held = [(support, _indicator(mesh, edges)) for support, edges in held]
        self.indicators = {support.on: indicator for support, indicator in self._held}
        self.update()

    def update(self) -> None:
        """Average the normals of the current state; due before an edge has turned by 90 degrees."""
        self._current.Set(self._kinematics.normal, dual=True, definedon=self._everywhere)

    @property
    def current(self) -> Any:
        """The averaged normals, or what supports prescribe: an expression of the parameters."""
        return self._with_held(
            unit(self._current), lambda support, n: support.edge_normal(self.reference, n, self._turned)
        )

    @property
    def reference(self) -> Any:
        """Those of the undeformed surface."""
        return self._with_held(unit(self._reference), lambda support, n: support.undeformed_normal(n))

    def _with_held(self, normals: Any, prescribed: Callable[[HoldsDirection, Any], Any]) -> Any:
        result = normals
        for support, indicator in self._held:
            result = result + indicator * (prescribed(support, normals) - normals)
        return result


def _indicator(mesh: ngs.Mesh, edges: list[int]) -> ngs.GridFunction:
    """1 on these edges, 0 on others."""
    space = ngs.FacetSurface(mesh, order=0)
    function, dofs = ngs.GridFunction(space), [d for e in edges for d in space.GetDofNrs(ngs.NodeId(ngs.EDGE, e))]
    function.vec.FV().NumPy()[dofs] = 1.0
    return function


@dataclass(frozen=True)
class ShellUnknowns:
    """Trial functions, or the parts of a state, in SI units.

    Attributes
    ----------
    displacement : u, m.
    force : membrane forces N (3x3), N/m.
    moment : m (3x3), N.
    rotation : h, a vector across the edge, rad.
    """

    displacement: Any
    force: Any
    moment: Any
    rotation: Any
