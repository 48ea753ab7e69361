"""Loads on a solid or a shell, any of them a function of parameters.

Dead loads have an energy; the follower pressure has none, and makes the tangent unsymmetric unless its surface is
closed or held at its rim. All areas and volumes are those of the undeformed solid, whatever its shape parameters.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import ngsolve as ngs
import numpy as np
from numpy.typing import NDArray

from morph_dslam.errors import StudyError
from morph_dslam.mechanics.kinematics import Kinematics
from morph_dslam.mechanics.parameters import ParameterSymbols, Scalar
from morph_dslam.mechanics.spaces import DisplacementSpace
from morph_dslam.model.reduced_model import FORCE, MOMENT, REACTION
from morph_dslam.studies.problem import Snapshot

Array = NDArray[np.float64]
Vector = tuple[Scalar, Scalar, Scalar]


@dataclass(frozen=True, eq=False)
class DeadTraction:
    """Force per undeformed area that keeps its direction.

    Attributes
    ----------
    on : surface.
    traction : Pa.
    """

    on: str
    traction: Vector
    bonus_order = 0

    def energy(self, kinematics: Kinematics) -> Any:
        """Energy per area of NGSolve's mesh, up to a constant."""
        return -ngs.CF(self.traction) * kinematics.displacement * kinematics.area_ratio


@dataclass(frozen=True, eq=False)
class SurfaceForce:
    """Force spread evenly over a surface of the mesh that keeps its direction.

    Attributes
    ----------
    on : surface.
    force : total, N, whatever the shape parameters.
    """

    on: str
    force: Vector
    bonus_order = 0

    def energy(self, kinematics: Kinematics, area: float) -> Any:
        """Energy per area of NGSolve's mesh, up to a constant; ``area`` is that of the surface there, m2."""
        return -ngs.CF(self.force) * kinematics.displacement / area


@dataclass(frozen=True, eq=False)
class FollowerPressure:
    """Pressure on the deformed surface, against its outward normal: t = -p n.

    Nanson's formula brings it to the undeformed surface: the force on a unit of it is -p cof(F) N.

    Attributes
    ----------
    on : surface.
    pressure : Pa, positive pushes inwards.
    """

    on: str
    pressure: Scalar
    bonus_order = 2

    def virtual_work(self, kinematics: Kinematics, test: Any) -> Any:
        """Its part of the residual, internal minus external work on the test displacement."""
        return self.pressure * kinematics.deformed_area_vector * test


@dataclass(frozen=True, eq=False)
class BodyForce:
    """Force per undeformed volume that keeps its direction.

    Attributes
    ----------
    force : N/m3.
    on : cell set.
    """

    force: Vector
    on: str = "all"


@dataclass(frozen=True, eq=False)
class Gravity:
    """Weight of every cell by its material's density.

    Attributes
    ----------
    acceleration : m/s2.
    """

    acceleration: Vector = (0.0, 0.0, -9.80665)


@dataclass(frozen=True, eq=False)
class PointLoad:
    """Dead force on nodes, shared equally by those of a set.

    Attributes
    ----------
    on : node set or surface.
    force : total, N.
    """

    on: str
    force: Vector


@dataclass(frozen=True, eq=False)
class EdgeLoad:
    """Force per undeformed length along edges of a shell that keeps its direction.

    Attributes
    ----------
    on : node set; an edge is loaded if all of its nodes are in it.
    force : N/m.
    """

    on: str
    force: Vector
    bonus_order = 0

    def energy(self, kinematics: Kinematics) -> Any:
        """Energy per length of NGSolve's mesh, up to a constant."""
        return -ngs.CF(self.force) * kinematics.displacement


@dataclass(frozen=True, eq=False)
class MovingPatch:
    """Dead force spread around a point that moves over a surface, with a Gaussian density.

    t(X) = force exp(-r^2 / 2 w^2) / (2 pi w^2), r the distance of X from the centre: the whole force on a flat surface
    that reaches 4 widths around the centre; nearer to its rim the rest falls beside it. Smooth in the position, so that
    solutions have derivatives by it.

    Attributes
    ----------
    on : surface.
    force : N.
    centre : m, expressions of the parameter that is the position.
    width : w, m; at least half a cell of the surface, or quadrature misses it.
    """

    on: str
    force: Vector
    centre: Vector
    width: float
    bonus_order = 6

    def __post_init__(self) -> None:
        _check_width(self.on, self.width)

    def energy(self, kinematics: Kinematics) -> Any:
        """Energy per area of NGSolve's mesh, up to a constant."""
        offset = kinematics.position - ngs.CF(self.centre)
        density = ngs.exp(-offset * offset / (2.0 * self.width**2)) / (2.0 * np.pi * self.width**2)
        return -density * (ngs.CF(self.force) * kinematics.displacement) * kinematics.area_ratio


@dataclass(frozen=True, eq=False)
class MovingLine:
    """Dead force along a straight line that moves over a surface, with a Gaussian density across it.

    t(X) = force exp(-r^2 / 2 w^2) / (sqrt(2 pi) w), r the distance of X from the line. Where that is nearer than 4
    widths to the surface's rim, a part of the force falls beside it, as of a patch.

    Attributes
    ----------
    on : surface.
    force : per length of the line, N/m.
    centre : a point of the line, m, expressions of the parameter that is the position.
    direction : (3,) of the line; its length does not matter.
    width : w, m; at least half a cell of the surface, or quadrature misses it.
    """

    on: str
    force: Vector
    centre: Vector
    direction: tuple[float, float, float]
    width: float
    bonus_order = 6

    def __post_init__(self) -> None:
        _check_width(self.on, self.width)
        if not np.linalg.norm(self.direction) > 0.0:
            raise StudyError(f"the moving line on '{self.on}' has no direction: {self.direction}")

    def energy(self, kinematics: Kinematics) -> Any:
        """Energy per area of NGSolve's mesh, up to a constant."""
        unit = ngs.CF(tuple(np.array(self.direction, dtype=float) / np.linalg.norm(self.direction)))
        offset = kinematics.position - ngs.CF(self.centre)
        square = offset * offset - (offset * unit) * (offset * unit)
        density = ngs.exp(-square / (2.0 * self.width**2)) / (np.sqrt(2.0 * np.pi) * self.width)
        return -density * (ngs.CF(self.force) * kinematics.displacement) * kinematics.area_ratio


Load = (
    DeadTraction
    | SurfaceForce
    | EdgeLoad
    | MovingPatch
    | MovingLine
    | FollowerPressure
    | BodyForce
    | Gravity
    | PointLoad
)


def _check_width(on: str, width: float) -> None:
    if not width > 0.0:
        raise StudyError(f"the moving load on '{on}' has width {width:g} m; it must be positive")


class NodalForces:
    """The point loads of a solid as forces on the dofs of its displacements; StudyError if one names an unknown set."""

    def __init__(self, space: DisplacementSpace, loads: Sequence[PointLoad], symbols: ParameterSymbols) -> None:
        self._loads, self._symbols, self._n_scalar = loads, symbols, space.n_scalar
        mesh = space.geometry.mesh
        # Work that each load's unit force does on each scalar dof.
        self._shares = [np.asarray(space.node_values[mesh.set_nodes(load.on)].mean(axis=0)).ravel() for load in loads]

    def values(self) -> Array:
        """(3 n_scalar,) forces at the present parameters, N."""
        forces = np.zeros((3, self._n_scalar))
        for load, share in zip(self._loads, self._shares, strict=True):
            forces += np.outer(self._symbols.values(load.force), share)
        return forces.ravel()

    def slopes(self) -> Array:
        """(d, 3 n_scalar) derivatives of `values` by the parameters."""
        slopes = np.zeros((len(self._symbols), 3, self._n_scalar))
        for load, share in zip(self._loads, self._shares, strict=True):
            slopes += self._symbols.vector_slopes(load.force)[:, :, None] * share
        return slopes.reshape(len(self._symbols), 3 * self._n_scalar)


#: A reaction that never exceeds so much of the largest may be what Newton's method leaves in a nearly incompressible
#: body, and has nothing to be reduced; nor has one that never exceeds so much of what the stresses of the body could
#: exert on the square of its size.
NEGLIGIBLE, NEGLIGIBLE_OF_STRESS = 1e-5, 1e-9


def reaction_names(snapshots: Sequence[Snapshot], size: float) -> list[str]:
    """Outputs that are forces and moments on supports and do not vanish in all of the snapshots.

    Loads that balance each other, a pressure inside of a body say, leave no reaction but rounding: so reactions count
    against the stresses too, where snapshots have any.

    Parameters
    ----------
    size : extent of the body, m; moments count against the largest force at that distance, and forces against the
        largest moment so.
    """
    names = [name for name in snapshots[0].outputs if name.startswith((FORCE, MOMENT))]
    largest = {name: max(float(np.linalg.norm(s.outputs[name])) for s in snapshots) for name in names}
    force = max((value if name.startswith(FORCE) else value / size for name, value in largest.items()), default=0.0)
    least = NEGLIGIBLE * force
    if force > 0.0:
        least = max(least, NEGLIGIBLE_OF_STRESS * size**2 * max(_typical_stress(snapshot) for snapshot in snapshots))
    limit = {FORCE: least, MOMENT: least * size}
    return [name for name in names if largest[name] > limit[name[: name.index("_") + 1]]]


def _typical_stress(snapshot: Snapshot) -> float:
    """Root of the mean square over the nodes, Pa, of the face where it is largest; 0 without stresses."""
    stresses = [snapshot.fields[name].astype(np.float64) for name in snapshot.fields if name.startswith("stress_")]
    return max((float(np.sqrt(np.mean(np.sum(stress**2, axis=1)))) for stress in stresses), default=0.0)


def with_reactions(snapshot: Snapshot, names: Sequence[str]) -> Snapshot:
    """The snapshot with these outputs (3,) as fields (1, 3)."""
    fields = {REACTION + name: np.reshape(snapshot.outputs[name], (1, 3)) for name in names}
    return replace(snapshot, fields=snapshot.fields | fields)
