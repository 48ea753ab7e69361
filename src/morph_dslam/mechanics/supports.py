"""Which displacement dofs the supports hold, at which values, and whether they hold the body at all."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from morph_dslam.errors import StudyError
from morph_dslam.mechanics.kinematics import Kinematics, Shape
from morph_dslam.mechanics.materials.base import evaluate
from morph_dslam.mechanics.morphing import surface_normals
from morph_dslam.mechanics.parameters import ParameterSymbols, Scalar
from morph_dslam.mechanics.spaces import DisplacementSpace

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
#: A rigid motion whose held part is below this is free.
FREE_MOTION = 1e-6
#: Prescribed displacements that differ by less than this part of the body's size are the same.
SAME_PLACE = 1e-9


class Constraints:
    """Prescribed motions of a solid in terms of its displacement dofs (3 n_scalar, those of x first).

    Attributes
    ----------
    held : (3 n_scalar,) whether a support holds the dof.
    """

    def __init__(
        self,
        space: DisplacementSpace,
        shape: Shape,
        supports: Sequence[PrescribedMotion | ElasticFoundation],
        symbols: ParameterSymbols,
    ) -> None:
        self._space, self._shape, self._symbols, self._mesh = space, shape, symbols, space.geometry.mesh
        self._mean_of_set: dict[str, Array] = {}  # asked for in each evaluation of the equations
        self._foundations = [s for s in supports if isinstance(s, ElasticFoundation)]
        self._motions: list[PrescribedMotion] = [s for s in supports if not isinstance(s, ElasticFoundation)]
        held = np.zeros((3, space.n_scalar), dtype=bool)
        self._parts: list[tuple[PrescribedMotion, int, Indices]] = []
        self._hidden: list[tuple[PrescribedMotion, int, Indices]] = []
        for motion in self._motions:
            dofs = space.dofs_on(self._mesh.set_nodes(motion.on))
            for component in np.flatnonzero(motion.components):
                new = dofs[~held[component, dofs]]
                held[component, new] = True
                self._parts.append((motion, int(component), new))
                if not len(new):
                    self._hidden.append((motion, int(component), dofs))
        self.held: NDArray[np.bool_] = held.ravel()

    def values(self) -> Array:
        """(3 n_scalar,) prescribed values at the present parameters; 0 where nothing is held."""
        result = np.zeros((3, self._space.n_scalar))
        for motion, component, dofs in self._parts:
            result[component, dofs] = self._prescribed(motion, component, dofs)
        return result.ravel()

    def _prescribed(self, motion: PrescribedMotion, component: int, dofs: Indices) -> Array:
        """(k,) what a support prescribes for a component at k dofs, whichever support decides."""
        affine = motion.motion(self._symbols, *self._centroid(motion))
        rigid = self._shape.coordinates(self._symbols)[dofs] @ affine.matrix[component]
        return np.asarray(rigid + self._space.constant[dofs] * affine.shift[component])

    def without_effect(self) -> tuple[PrescribedMotion, list[int], list[PrescribedMotion]] | None:
        """The first support that moves its set, by the study, where others that come before it have decided all.

        Counted are components that are held at every place of the set already, and elsewhere than the support says.
        A support of which others count may hold some at zero: so does a fixed set one of whose components is moved.

        Returns
        -------
        The support, its components (0, 1, 2) that do nothing, and the supports that decide them; None if there is none.
        """
        present, states = self._symbols.present, self._symbols.telling_states()
        tolerance = SAME_PLACE * float(np.ptp(self._mesh.nodes, axis=0).max())
        found: dict[int, list[tuple[int, Indices]]] = {}
        for motion, component, dofs in self._hidden:
            differs = moves = False
            for mu in states:
                self._symbols.set(mu)
                own = self._prescribed(motion, component, dofs)
                decided = self.values().reshape(3, -1)[component, dofs]
                differs |= bool(np.abs(own - decided).max() > tolerance)
                moves |= bool(np.abs(own).max() > tolerance)
            all_hidden = sum(other is motion for other, _, _ in self._hidden) == sum(motion.components)
            if differs and (moves or all_hidden):
                found.setdefault(self._motions.index(motion), []).append((component, dofs))
        self._symbols.set(present)
        if not found:
            return None
        index = min(found)
        by = [
            motion
            for motion, component, dofs in self._parts
            if any(component == own and np.isin(dofs, hidden).any() for own, hidden in found[index])
        ]
        return self._motions[index], [component for component, _ in found[index]], list(dict.fromkeys(by))

    def values_on_the_way(self, begin: Array, share: float) -> Array:
        """(3 n_scalar,) prescribed values on that share of the way from ``begin`` (3 n_scalar,) to `values`.

        A set that a rotation moves, and that is at rest at the beginning, goes on its arc; all else goes straight.
        """
        way = np.where(self.held, begin + share * (self.values() - begin), 0.0).reshape(3, -1)
        coordinates = self._shape.coordinates(self._symbols)
        for motion, component, dofs in self._resting_rotations(begin):
            affine = motion.part(self._symbols, share).motion(self._symbols, *self._centroid(motion))
            rigid = coordinates[dofs] @ affine.matrix[component]
            way[component, dofs] = rigid + self._space.constant[dofs] * affine.shift[component]
        return way.ravel()

    def _resting_rotations(self, x: Array) -> list[tuple[RigidRotation, int, Indices]]:
        """The parts of rotations whose sets are at rest in ``x`` (3 n_scalar,)."""
        by_component = x.reshape(3, -1)
        moved = {id(motion) for motion, component, dofs in self._parts if by_component[component, dofs].any()}
        parts = [part for part in self._parts if id(part[0]) not in moved]
        return [(motion, component, dofs) for motion, component, dofs in parts if isinstance(motion, RigidRotation)]

    def rotations(self) -> Array:
        """(k, 3) rotation vectors of the sets that rotations move at the present parameters, rad."""
        turning = [motion for motion in self._motions if isinstance(motion, RigidRotation)]
        return np.array([motion.vector(self._symbols) for motion in turning]).reshape(-1, 3)

    def resting_rotations(self, x: Array) -> Array:
        """Those (k, 3) of `rotations` whose sets are at rest in ``x`` (3 n_scalar,)."""
        turning = {id(motion): motion for motion, _, _ in self._resting_rotations(x)}
        return np.array([motion.vector(self._symbols) for motion in turning.values()]).reshape(-1, 3)

    def slopes(self) -> Array:
        """(d, 3 n_scalar) derivatives of `values` by the parameters."""
        result = np.zeros((len(self._symbols), 3, self._space.n_scalar))
        coordinates = self._shape.coordinates(self._symbols)
        coordinate_slopes = self._shape.coordinate_slopes(self._symbols)
        for motion, component, dofs in self._parts:
            affine = motion.motion(self._symbols, *self._centroid(motion))
            result[:, component, dofs] = (
                affine.matrix_slopes[:, component] @ coordinates[dofs].T
                + coordinate_slopes[:, dofs] @ affine.matrix[component]
                + affine.shift_slopes[:, component, None] * self._space.constant[dofs]
            )
        return result.reshape(len(self._symbols), 3 * self._space.n_scalar)

    def _centroid(self, motion: PrescribedMotion) -> tuple[Array, Array]:
        """Mean (3,) of the nodes of the set that a motion is centred on, and its derivatives (d, 3)."""
        if motion.centred_on is None:
            return np.zeros(3), np.zeros((len(self._symbols), 3))
        return self.centroid(motion.centred_on)

    def centroid(self, name: str) -> tuple[Array, Array]:
        """Mean (3,) of the undeformed nodes of a set, m, and its derivatives (d, 3)."""
        weights = self._mean_of_set.get(name)
        if weights is None:
            rows = self._space.node_values[self._mesh.set_nodes(name)]
            weights = self._mean_of_set[name] = np.asarray(rows.mean(axis=0)).ravel()
        slopes = self._shape.coordinate_slopes(self._symbols)
        return weights @ self._shape.coordinates(self._symbols), np.einsum("n,dnc->dc", weights, slopes)

    def shares(self) -> dict[str, Array]:
        """(3, n_scalar) by set: the part of each held dof that its supports hold, together 1 wherever a dof is held."""
        counts: dict[str, Array] = {}
        for motion in self._motions:
            own = counts.setdefault(motion.on, np.zeros((3, self._space.n_scalar)))
            dofs = self._space.dofs_on(self._mesh.set_nodes(motion.on))
            own[np.ix_(np.flatnonzero(motion.components), dofs)] += 1.0
        total = np.maximum(sum(counts.values()), 1.0)
        return {name: own / total for name, own in counts.items()}

    def check_rigid_motions(self, others: Array, hanging: bool = False) -> None:
        """Refuse supports that leave the body free to move as a whole (StudyError).

        Parameters
        ----------
        others : (k, 6) what else is held, by the share of each of `rigid_modes` in it.
        hanging : whether its weight may hold a body that can turn: only translations are looked at.
        """
        modes = self.rigid_modes()
        rows = [modes[self.held.reshape(3, -1)], others]
        # Where springs vanish they hold nothing; the first solution is that of the parameters' defaults.
        springs = [foundation for foundation in self._foundations if evaluate(foundation.stiffness) > 0.0]
        for foundation in springs:
            nodes = self._mesh.surface_nodes(foundation.on)
            at_nodes = np.stack([self._space.node_values[nodes] @ mode for mode in modes], axis=1)
            if foundation.normal_only:
                normals = surface_normals(self._mesh, foundation.on)[nodes]
                rows.append(np.einsum("kc,kcm->km", normals, at_nodes))
            else:
                rows.append(at_nodes.reshape(-1, 6))
        held = np.concatenate(rows)
        looked_at = 3 if hanging else 6
        _, sizes, vectors = np.linalg.svd(held[:, :looked_at].T @ held[:, :looked_at])
        free = np.pad(vectors[sizes < FREE_MOTION**2 * max(len(held), 1)], ((0, 0), (0, 6 - looked_at)))
        if len(free):
            vanishing = (
                "" if springs == self._foundations else " whose stiffness is positive at the parameters' defaults"
            )
            raise StudyError(
                f"the supports leave the body free to {_describe(free)}: fix a set, or give it a foundation{vanishing}"
            )

    def rigid_modes(self) -> Array:
        """(3, n_scalar, 6) coefficients of unit translations and of rotations scaled to unit size."""
        centred = self._space.coordinates - np.outer(self._space.constant, self._mesh.nodes.mean(axis=0))
        centred /= np.abs(centred).max()
        modes = np.zeros((3, self._space.n_scalar, 6))
        for axis in range(3):
            modes[axis, :, axis] = self._space.constant
            i, j = (axis + 1) % 3, (axis + 2) % 3
            modes[j, :, 3 + axis] = centred[:, i]
            modes[i, :, 3 + axis] = -centred[:, j]
        return modes


def _describe(free: Array) -> str:
    """Words for rigid motions (k, 6)."""
    share = np.linalg.norm(free, axis=0)
    moves = [axis for axis, part in zip("xyz", share[:3], strict=True) if part > 0.3]
    turns = [axis for axis, part in zip("xyz", share[3:], strict=True) if part > 0.3]
    words = [f"{verb} {', '.join(axes)}" for verb, axes in (("move along", moves), ("turn about", turns)) if axes]
    return " and to ".join(words)


@dataclass(frozen=True)
class AffineMotion:
    """u(X) = matrix X + shift of the held points: second-order elements, which are isoparametric, take it exactly.

    Attributes
    ----------
    matrix : (3, 3).
    shift : (3,), m.
    matrix_slopes : (d, 3, 3) derivatives of the matrix by the parameters.
    shift_slopes : (d, 3) derivatives of the shift.
    """

    matrix: Array
    shift: Array
    matrix_slopes: Array
    shift_slopes: Array


class PrescribedMotion(Protocol):
    """A support that prescribes displacements of the set ``on``."""

    @property
    def on(self) -> str: ...
    @property
    def components(self) -> tuple[bool, bool, bool]:
        """Which of x, y and z are held."""
        ...

    @property
    def centred_on(self) -> str | None:
        """The set whose centroid the motion depends on, if any."""
        ...

    def motion(self, symbols: ParameterSymbols, centroid: Array, centroid_slopes: Array) -> AffineMotion:
        """The motion at the present parameters, given that centroid (3,) and its derivatives (d, 3)."""
        ...


@dataclass(frozen=True, eq=False)
class PrescribedDisplacement:
    """Holds the given components of the displacement of a set; a component that is None stays free.

    A symmetry plane or a roller holds the component normal to it at zero. Raises StudyError if all are free.

    Attributes
    ----------
    on : node set or surface.
    x : displacement, m: a number or an expression of parameters.
    y : displacement likewise.
    z : displacement likewise.
    """

    on: str
    x: Scalar | None = None
    y: Scalar | None = None
    z: Scalar | None = None
    centred_on = None

    def __post_init__(self) -> None:
        if not any(self.components):
            raise StudyError(f"the displacement of '{self.on}' holds nothing: give at least one of x, y and z")

    @property
    def components(self) -> tuple[bool, bool, bool]:
        return self.x is not None, self.y is not None, self.z is not None

    def motion(self, symbols: ParameterSymbols, centroid: Array, centroid_slopes: Array) -> AffineMotion:
        values = [0.0 if value is None else value for value in (self.x, self.y, self.z)]
        d = len(symbols)
        return AffineMotion(
            matrix=np.zeros((3, 3)),
            shift=symbols.values(values),
            matrix_slopes=np.zeros((d, 3, 3)),
            shift_slopes=symbols.vector_slopes(values),
        )


def fixed(on: str) -> PrescribedDisplacement:
    """Holds all components of a set at zero."""
    return PrescribedDisplacement(on, 0.0, 0.0, 0.0)


def held_still(support: PrescribedMotion | ElasticFoundation) -> PrescribedMotion | ElasticFoundation:
    """The support without its motion."""
    if isinstance(support, PrescribedDisplacement):
        return PrescribedDisplacement(support.on, *(0.0 if held else None for held in support.components))
    if isinstance(support, RigidRotation):
        return replace(support, angle=0.0, translation=(0.0, 0.0, 0.0))
    return support  # a foundation or a plane of symmetry stays where it is


def largest_turn(vectors: Array) -> float:
    """Largest angle, rad, by which rotation vectors (k, 3) turn one set against another, or one against space."""
    every = np.concatenate([vectors, np.zeros((1, 3))])
    return float(np.linalg.norm(every[:, None] - every, axis=-1).max())


def cross_matrix(x: float, y: float, z: float) -> Array:
    """(3, 3) with which the cross product of a vector from the left is taken."""
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


@dataclass(frozen=True, eq=False)
class RigidRotation:
    """Moves a set as a rigid body: a finite rotation about an axis through a centre, then a translation.

    R = 1 + sin(angle) K + (1 - cos(angle)) K^2 with K the cross product with the unit axis (Rodrigues).

    Attributes
    ----------
    on : node set or surface.
    axis : (3,) direction of the axis, right-handed; its length does not matter.
    angle : rad: a number or an expression of parameters.
    centre : point (3,) on the axis, m, or the name of the set whose centroid (mean of its nodes) it is; None
        for the set's own.
    translation : m, numbers or expressions.
    """

    on: str
    axis: tuple[float, float, float]
    angle: Scalar
    centre: tuple[Scalar, Scalar, Scalar] | str | None = None
    translation: tuple[Scalar, Scalar, Scalar] = (0.0, 0.0, 0.0)
    components = (True, True, True)

    def __post_init__(self) -> None:
        if not np.linalg.norm(self.axis) > 0.0:
            raise StudyError(f"the axis of the rotation of '{self.on}' has no direction: {self.axis}")

    @property
    def centred_on(self) -> str | None:
        if self.centre is None:
            return self.on
        return self.centre if isinstance(self.centre, str) else None

    def vector(self, symbols: ParameterSymbols) -> Array:
        """Rotation vector (3,), rad, at the present parameters: its length is the angle, over whole turns too."""
        return symbols.value(self.angle) * np.array(self.axis, dtype=float) / np.linalg.norm(self.axis)

    def part(self, symbols: ParameterSymbols, share: float) -> RigidRotation:
        """The motion by that share of the angle and of the translation at the present parameters."""
        translation = share * symbols.values(self.translation)
        return replace(self, angle=share * symbols.value(self.angle), translation=tuple(translation.tolist()))

    def motion(self, symbols: ParameterSymbols, centroid: Array, centroid_slopes: Array) -> AffineMotion:
        x, y, z = np.array(self.axis, dtype=float) / np.linalg.norm(self.axis)
        cross = cross_matrix(x, y, z)
        angle = symbols.value(self.angle)
        matrix = np.sin(angle) * cross + (1.0 - np.cos(angle)) * cross @ cross
        per_angle = np.cos(angle) * cross + np.sin(angle) * cross @ cross
        matrix_slopes = symbols.slopes(self.angle)[:, None, None] * per_angle
        if isinstance(self.centre, tuple):
            centroid, centroid_slopes = symbols.values(self.centre), symbols.vector_slopes(self.centre)
        translation, translation_slopes = symbols.values(self.translation), symbols.vector_slopes(self.translation)
        return AffineMotion(
            matrix=matrix,
            shift=translation - matrix @ centroid,
            matrix_slopes=matrix_slopes,
            shift_slopes=translation_slopes - matrix_slopes @ centroid - centroid_slopes @ matrix.T,
        )


@dataclass(frozen=True, eq=False)
class ElasticFoundation:
    """Springs spread over a surface that resist its displacement (Winkler): energy k/2 |u|^2 per area.

    Attributes
    ----------
    on : surface.
    stiffness : k, Pa/m, on the undeformed area, not negative: a number or an expression of parameters.
    normal_only : resist the displacement along the undeformed normal alone.
    """

    on: str
    stiffness: Scalar
    normal_only: bool = False

    def __post_init__(self) -> None:
        # Springs that push away from where they are at rest would make every state unstable.
        if not (value := evaluate(self.stiffness)) >= 0.0:
            raise StudyError(f"stiffness = {1e-9 * value:.4g} MPa/mm must not be negative")

    def energy(self, kinematics: Kinematics) -> Any:
        """Energy per area of NGSolve's mesh."""
        u = kinematics.displacement
        u = u * kinematics.unit_normal if self.normal_only else u
        return 0.5 * self.stiffness * (u * u) * kinematics.area_ratio
