"""Sets that move as rigid bodies under a remote force and moment.

The set of a coupling follows a reference point P with six unknown motions: the translation u of the point, and the
rotation vector t about it, whose length is the angle. A point X of the set goes to P + u + R(t) (X - P), with

    R = 1 + a K + b K^2,   a = sin|t| / |t|,   b = (1 - cos|t|) / |t|^2,   K the cross product with t

(Rodrigues). Its derivatives by t are singular at a full turn only. The remote moment keeps its direction in space. Its
virtual work is m . w for a spin w; w_i = axial(dR/dt_i R') belongs to a change of t_i (Simo and Vu-Quoc, Computer
Methods in Applied Mechanics and Engineering 58, 1986). Such a moment has no energy.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import factorial
from typing import Literal, get_args

import numpy as np
from numpy.polynomial import Polynomial
from numpy.typing import NDArray

from morph_dslam.errors import StudyError
from morph_dslam.mechanics.kinematics import Shape
from morph_dslam.mechanics.loads import Vector
from morph_dslam.mechanics.parameters import ParameterSymbols
from morph_dslam.mechanics.spaces import DisplacementSpace
from morph_dslam.mechanics.supports import Constraints

Array = NDArray[np.float64]
Motion = Literal["x", "y", "z", "rx", "ry", "rz"]
#: Motions of a coupling.
MOTIONS = 6
_NAMES: tuple[Motion, ...] = get_args(Motion)
#: Matrices (3, 3, 3) of the cross product with each unit vector from the left.
_CROSS: Array = np.cross(np.eye(3)[:, None], np.eye(3)).transpose(0, 2, 1)
#: a and b as power series in |t|^2, which so many terms give exactly where it is below `SMALL`.
_A, _B = (Polynomial([(-1.0) ** k / factorial(2 * k + first) for k in range(12)]) for first in (1, 2))
#: Square of an angle up to which the series are summed: digits of the closed forms cancel there.
SMALL = 1.0
#: Components of a rotation vector, rad, beyond which an iteration has wound up, and no turn is meant.
MOST_TURNED = 100.0
#: A set whose extent across its longest direction is a smaller part of that lies on a line.
LINE = 1e-6


@dataclass(frozen=True, eq=False)
class Coupling:
    """A set that moves as a rigid body, with a force and a moment on it.

    Attributes
    ----------
    on : node set or surface.
    force : N, keeps its direction, at the reference point.
    moment : N m, keeps its direction in space.
    point : reference point, m; None for the mean of the set's nodes. It moves with the set.
    held : motions that are zero: of the point along x, y, z, and components rx, ry, rz of the rotation vector. A hinge
        about z holds all but rz.
    """

    on: str
    force: Vector = (0.0, 0.0, 0.0)
    moment: Vector = (0.0, 0.0, 0.0)
    point: Vector | None = None
    held: tuple[Motion, ...] = ()

    def unloaded(self) -> Coupling:
        """The same without force and moment."""
        return Coupling(self.on, point=self.point, held=self.held)


def _factors(square: float) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
    """The factors a and b of a rotation with that square of its angle, each with its two derivatives by the square."""
    if square < SMALL:
        a, b = ((f(square), f.deriv(1)(square), f.deriv(2)(square)) for f in (_A, _B))
        return a, b
    angle = np.sqrt(square)
    cosine, a = np.cos(angle), np.sin(angle) / angle
    b = (1.0 - cosine) / square
    a_slope, b_slope = (cosine - a) / (2.0 * square), (0.5 * a - b) / square
    a_bend, b_bend = -(0.5 * a + 3.0 * a_slope) / (2.0 * square), (0.5 * a_slope - 2.0 * b_slope) / square
    return (a, a_slope, a_bend), (b, b_slope, b_bend)


@dataclass(frozen=True)
class Rotation:
    """A rotation matrix and its derivatives by the rotation vector.

    Attributes
    ----------
    matrix : (3, 3).
    slopes : (3, 3, 3), the first index is that of the vector's component.
    curvatures : (3, 3, 3, 3) second derivatives.
    """

    matrix: Array
    slopes: Array
    curvatures: Array

    @staticmethod
    def of(vector: Array) -> Rotation:
        """Of a rotation vector (3,), rad; not a number where an iteration has turned it by more than `MOST_TURNED`."""
        if not np.abs(vector).max() < MOST_TURNED:
            vector = np.full(3, np.nan)
        square = float(vector @ vector)
        K = np.einsum("i,ijk->jk", vector, _CROSS)
        K_slopes, K_curvatures = _CROSS, np.zeros((3, 3, 3, 3))
        products = _CROSS[:, None] @ _CROSS
        squares = K @ K, _CROSS @ K + K @ _CROSS, products + products.swapaxes(0, 1)
        matrix, slopes, curvatures = np.eye(3), np.zeros((3, 3, 3)), np.zeros((3, 3, 3, 3))
        factors = _factors(square)
        for (value, first, second), (M, dM, ddM) in zip(factors, ((K, K_slopes, K_curvatures), squares), strict=True):
            d, dd = 2.0 * first * vector, 4.0 * second * np.outer(vector, vector) + 2.0 * first * np.eye(3)
            cross = np.multiply.outer(d, dM)
            matrix = matrix + value * M
            slopes = slopes + np.multiply.outer(d, M) + value * dM
            curvatures = curvatures + np.multiply.outer(dd, M) + cross + cross.swapaxes(0, 1) + value * ddM
        return Rotation(matrix, slopes, curvatures)

    @property
    def spins(self) -> Array:
        """(3, 3): the spin of a unit change of each component of the vector."""
        return 0.5 * np.einsum("ckl,ikm,lm->ic", _CROSS, self.slopes, self.matrix)

    @property
    def spin_slopes(self) -> Array:
        """(3, 3, 3) derivatives of `spins` [i] by component [j] of the vector."""
        first = np.einsum("ckl,ijkm,lm->ijc", _CROSS, self.curvatures, self.matrix)
        return 0.5 * (first + np.einsum("ckl,ikm,jlm->ijc", _CROSS, self.slopes, self.slopes))


class CoupledSet:
    """One coupling in terms of displacement dofs; everything is that of the present parameters.

    Raises StudyError if the set is unknown, holds no three corners of cells off one line, or is held by a support.

    Attributes
    ----------
    dofs : (n,) scalar dofs that follow it.
    held : (6,) whether each motion is.
    """

    def __init__(
        self,
        coupling: Coupling,
        space: DisplacementSpace,
        shape: Shape,
        constraints: Constraints,
        symbols: ParameterSymbols,
    ) -> None:
        self.coupling, self._shape, self._constraints, self._symbols = coupling, shape, constraints, symbols
        mesh = space.geometry.mesh
        nodes = mesh.set_nodes(coupling.on)
        if not len(nodes):
            raise StudyError(f"the set '{coupling.on}' of a coupling is empty; name a set that holds nodes")
        self.dofs = space.dofs_on(nodes)
        self.held = np.array([name in coupling.held for name in _NAMES])
        if constraints.held.reshape(3, -1)[:, self.dofs].any():
            raise StudyError(
                f"the set '{coupling.on}' of a coupling has nodes that a support holds; "
                "a node follows the one or the other: leave them out of one of the sets"
            )
        self._constant = np.asarray(space.coefficients @ np.ones(mesh.n_nodes))[self.dofs]
        self._check_extent(space.coordinates[self.dofs][self._constant > 0.5])

    def _check_extent(self, corners: Array) -> None:
        sizes = np.linalg.svd(corners - corners.mean(axis=0), compute_uv=False) if len(corners) > 2 else [0.0, 0.0]
        if not sizes[1] > LINE * sizes[0]:
            raise StudyError(
                f"the set '{self.coupling.on}' of a coupling has {len(corners)} corners of cells on one line; "
                "a rigid body needs three that are not"
            )

    def _arms(self) -> Array:
        """Coefficients (n, 3) of X - P, undeformed."""
        return self._shape.coordinates(self._symbols)[self.dofs] - np.outer(self._constant, self.point())

    def _arm_slopes(self) -> Array:
        """(d, n, 3) derivatives of the arms by the parameters."""
        moved = self._constant[:, None] * self.point_slopes()[:, None]
        return self._shape.coordinate_slopes(self._symbols)[:, self.dofs] - moved

    def displacement(self, motion: Array) -> Array:
        """(3 n,) of a motion (6,), component by component."""
        turn = Rotation.of(motion[3:]).matrix - np.eye(3)
        return (turn @ self._arms().T + np.outer(motion[:3], self._constant)).ravel()

    def displacement_slopes(self, motion: Array) -> Array:
        """(d, 3 n) derivatives of `displacement` by the parameters at a fixed motion."""
        turn = Rotation.of(motion[3:]).matrix - np.eye(3)
        moved = (self._arm_slopes() @ turn.T).swapaxes(1, 2)
        return moved.reshape(len(moved), -1)

    def columns(self, motion: Array) -> Array:
        """G' (6, 3 n): derivatives of `displacement` by the motion."""
        moved = np.multiply.outer(np.eye(3), self._constant)
        turned = Rotation.of(motion[3:]).slopes @ self._arms().T
        return np.concatenate([moved, turned]).reshape(MOTIONS, -1)

    def remote(self, motion: Array) -> Array:
        """(6,) work of the remote load per motion."""
        force, moment = self._symbols.values(self.coupling.force), self._symbols.values(self.coupling.moment)
        return np.concatenate([force, Rotation.of(motion[3:]).spins @ moment])

    def unbalanced_slopes(self, motion: Array, forces: Array) -> Array:
        """(d, 6) derivatives of G' f - remote load by the parameters at fixed motion and ``forces`` f (3 n,)."""
        rotation, by_component = Rotation.of(motion[3:]), forces.reshape(3, -1)
        force, moment = (
            self._symbols.vector_slopes(self.coupling.force),
            self._symbols.vector_slopes(self.coupling.moment),
        )
        turned = np.einsum("ick,dnk,cn->di", rotation.slopes, self._arm_slopes(), by_component)
        return np.concatenate([-force, turned - moment @ rotation.spins.T], axis=1)

    def stiffness(self, motion: Array, forces: Array) -> Array:
        """(6, 6) derivatives of G' f - remote load, row by row, by the motion at fixed ``forces`` f (3 n,)."""
        rotation, moment = Rotation.of(motion[3:]), self._symbols.values(self.coupling.moment)
        result = np.zeros((MOTIONS, MOTIONS))
        result[3:, 3:] = np.einsum("ijck,ck->ij", rotation.curvatures, forces.reshape(3, -1) @ self._arms())
        result[3:, 3:] -= rotation.spin_slopes @ moment
        return result

    @property
    def has_energy(self) -> bool:
        """Whether the remote load has one: a moment has none, save about a hinge."""
        return int(np.count_nonzero(~self.held[3:])) < 2 or not self._symbols.values(self.coupling.moment).any()

    def held_modes(self, modes: Array) -> Array:
        """What is held (k, 6) of rigid ``modes`` (3, n_scalar, 6) of the body."""
        columns = self.columns(np.zeros(MOTIONS)).T
        motions = np.linalg.lstsq(columns, modes[:, self.dofs].reshape(-1, MOTIONS), rcond=None)[0].astype(np.float64)
        motions[3:] *= np.abs(self._arms()).max()
        return motions[self.held]

    def point(self) -> Array:
        """Reference point (3,)."""
        point = self.coupling.point
        return self._constraints.centroid(self.coupling.on)[0] if point is None else self._symbols.values(point)

    def point_slopes(self) -> Array:
        """(d, 3) derivatives of the reference point by the parameters."""
        point = self.coupling.point
        return self._constraints.centroid(self.coupling.on)[1] if point is None else self._symbols.vector_slopes(point)

    def reaction(self, motion: Array, work: Array) -> tuple[Array, Array]:
        """Force (3,), and moment (3,) about the point, whose ``work`` (6,) per motion is given."""
        moment = np.linalg.solve(Rotation.of(motion[3:]).spins, work[3:])
        return work[:3], moment.astype(np.float64)

    def reaction_slopes(
        self, motion: Array, work: Array, motion_slopes: Array, work_slopes: Array
    ) -> tuple[Array, Array]:
        """Derivatives (d, 3) of `reaction`, from those (d, 6) of motion and work."""
        rotation, moment = Rotation.of(motion[3:]), self.reaction(motion, work)[1]
        turned = np.einsum("ijc,dj,c->di", rotation.spin_slopes, motion_slopes[:, 3:], moment)
        moment_slopes = np.linalg.solve(rotation.spins, (work_slopes[:, 3:] - turned).T).T
        return work_slopes[:, :3], moment_slopes.astype(np.float64)
