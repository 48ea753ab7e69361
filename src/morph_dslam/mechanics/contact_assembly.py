"""Contact of a solid's surfaces by a penalty: its forces, tangent and derivatives by the parameters.

The gap g of a deformed point is its distance from what it may touch, negative where it has entered. This costs

    int eps / 2 min(g, 0)^2 dA

on the undeformed surface, whose derivative is the pressure eps |g| along the normal (Wriggers, Computational Contact
Mechanics, 2006, section 6.3). The stiffness eps is `STIFFNESS` times Young's modulus over the width of an element's
face, so that a surface gives way by a small part of that width. Where obstacles confine a solid, this would be most of
what gives way; `contact_stiffness` says how much stiffer contact is made then.

Of the tangent, the part due to the turning of normals is in proportion to the pressure, and negative. An iteration that
starts deep in an obstacle has pressures far beyond any that can be carried, with which that part would make the tangent
indefinite. So far from equilibrium it counts with a pressure of at most `LARGEST_PRESSURE` times Young's modulus, and
steps may be larger than elements.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from morph_dslam.errors import StudyError
from morph_dslam.mechanics.contact import Contact, RigidObstacle, RigidPlane, SurfaceContact
from morph_dslam.mechanics.contact_passage import Placed, core_inside, passes_through, travel_in_depths
from morph_dslam.mechanics.contact_search import Crossings, find_crossings, local_geometry
from morph_dslam.mechanics.contact_surface import ContactSurface
from morph_dslam.mechanics.kinematics import Shape
from morph_dslam.mechanics.parameters import ParameterSymbols
from morph_dslam.mechanics.spaces import DisplacementSpace

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
#: Stiffness of contact over that of a layer of the material as thick as a face of an element is wide.
STIFFNESS = 100.0
#: Pressure, over Young's modulus, up to which a limited tangent is complete.
LARGEST_PRESSURE = 0.1
#: Surfaces that overlap by less than such a part of a face's width touch.
TOUCHING = 1e-4
#: Cosine between a surface's normal and the direction to an obstacle that it may come to lie on.
FACING = 0.7
#: Contact is made at most as stiff as a layer that cannot bulge. Where that is less than so many times as stiff as one
#: that can, nothing confines a solid much, and nothing is asked.
WORTH_ASKING = 3.0


@dataclass(frozen=True)
class _Spring:
    """What k points of a surface resist penetration with.

    Attributes
    ----------
    weights : (k,) area, m2.
    stiffness : (k,) eps, Pa/m.
    young : (k,) modulus of the material, Pa.
    """

    weights: Array
    stiffness: Array
    young: Array


@dataclass(frozen=True)
class _Side:
    """A surface in contact.

    Attributes
    ----------
    stiffness : in place of `STIFFNESS`.
    young, confined : (f,) moduli of the material behind each face, Pa: Young's, and that of what cannot bulge.
    """

    surface: ContactSurface
    stiffness: float
    young: Array
    confined: Array

    def spring(self, points: Indices, stiffening: float = 1.0) -> _Spring:
        """Of some of its points (k,), stiffer by a factor where the material is that stiff if confined."""
        faces = self.surface.face[points]
        young = self.young[faces]
        modulus = np.clip(stiffening * young, young, np.maximum(young, self.confined[faces]))
        return _Spring(self.surface.weights[points], self.stiffness * modulus / self.surface.widths[faces], young)


@dataclass(frozen=True)
class _Entered:
    """Points of a surface that have entered something, k of them.

    Attributes
    ----------
    spring : what they resist with.
    gap : (k,) m, negative.
    normal : (k, 3) of what they have entered.
    place : (k, 3) where they are, m.
    forms : sparse (r k, 3 n): changes that the gap depends on, r for each point; the first three are those of its place
        in relation to what it has entered.
    curvature : (k, r, r) second derivatives of the gap by these.
    slopes : (d, k) derivatives of the gap by the parameters at fixed dofs and undeformed shape.
    normal_slopes : (d, k, 3) of the normal.
    """

    spring: _Spring
    gap: Array
    normal: Array
    place: Array
    forms: sp.csr_matrix
    curvature: Array
    slopes: Array
    normal_slopes: Array

    @property
    def _size(self) -> tuple[int, int]:
        rows, columns = self.forms.shape  # type: ignore[misc]
        return rows, columns

    def assembled(self, traction: Array) -> Array:
        """(..., 3 n) forces of tractions (..., k, 3), Pa, on the points' places."""
        several = traction.shape[:-2]
        forces = np.zeros((*traction.shape[:-1], self.curvature.shape[1]))
        forces[..., :3] = self.spring.weights[:, None] * traction
        flat = forces.reshape(int(np.prod(several)), self._size[0])
        return (self.forms.T @ flat.T).T.reshape(*several, self._size[1])

    @property
    def residual(self) -> Array:
        """(3 n,) derivative of the energy."""
        return self.assembled((self.spring.stiffness * self.gap)[:, None] * self.normal)

    def tangent(self, limited: bool) -> sp.csr_matrix:
        """(3 n, 3 n) derivative of the residual; ``limited`` to `LARGEST_PRESSURE`."""
        pressure = -self.spring.stiffness * self.gap
        if limited:
            pressure = np.minimum(pressure, LARGEST_PRESSURE * self.spring.young)
        blocks = -pressure[:, None, None] * self.curvature
        blocks[:, :3, :3] += self.spring.stiffness[:, None, None] * self.normal[:, :, None] * self.normal[:, None, :]
        blocks *= self.spring.weights[:, None, None]
        number = np.arange(len(blocks))
        middle = sp.bsr_matrix((blocks, number, np.arange(len(blocks) + 1)), shape=(self._size[0],) * 2)
        return sp.csr_matrix(self.forms.T @ (middle @ self.forms))

    def approach(self, changes: Array) -> Array:
        """(c, k) by how much changes (c, 3 n) of the dofs open the gaps, m, with what is touched held."""
        places = (self.forms @ changes.T).T.reshape(len(changes), -1, self.curvature.shape[1])
        return np.einsum("ckx,kx->ck", places[:, :, :3], self.normal)

    def residual_slopes(self) -> Array:
        """(d, 3 n) derivatives of the residual by the parameters at fixed dofs and undeformed shape."""
        change = self.slopes[:, :, None] * self.normal + self.gap[:, None] * self.normal_slopes
        return self.assembled(self.spring.stiffness[:, None] * change)


class ContactAssembly:
    """All contacts of a solid.

    Raises StudyError if an obstacle that no parameter or amplitude moves overlaps the undeformed solid, or the core of
    another lies inside of it at the parameters' defaults.

    Parameters
    ----------
    space : displacements.
    shape : how the undeformed shape depends on parameters.
    contacts : see `contact`.
    bulk, shear : (n_cells,) moduli of each cell's material, Pa. Three times the shear modulus is Young's modulus, if
        incompressible.
    symbols : parameters.
    stiffening : how much stiffer contact has to be, if the solid is confined; asked when first needed.
    factor : of the penalty's stiffness besides.
    """

    def __init__(
        self,
        space: DisplacementSpace,
        shape: Shape,
        contacts: Sequence[Contact],
        bulk: Array,
        shear: Array,
        symbols: ParameterSymbols,
        stiffening: Callable[[], float],
        factor: float = 1.0,
    ) -> None:
        self._shape, self._symbols, self._contacts, self._n = shape, symbols, contacts, space.n_scalar
        self._mesh, self._space, self._bulk, self._shear = space.geometry.mesh, space, bulk, shear
        self._ask_stiffening, self._factor = stiffening, factor
        self._sides: dict[str, _Side] = {}
        for contact in contacts:
            self._side(contact.on)
            if isinstance(contact, SurfaceContact):
                self._side(contact.against)
        self._latest: tuple[Array, Array, list[list[_Entered]]] | None = None
        self._check_apart()

    def _side(self, name: str) -> _Side:
        if name not in self._sides:
            faces = self._mesh.surface(name)
            bulk, shear = self._bulk[faces[:, 0]], self._shear[faces[:, 0]]
            surface, stiffness = ContactSurface.of(self._space, faces), STIFFNESS * self._factor
            self._sides[name] = _Side(surface, stiffness, 3.0 * shear, bulk + 4.0 / 3.0 * shear)
        return self._sides[name]

    @cached_property
    def stiffening(self) -> float:
        """How much stiffer the penalty of all contacts is than in a solid that nothing confines."""
        most = max(float(np.max(side.confined / side.young)) for side in self._sides.values())
        return max(1.0, self._ask_stiffening()) if most > WORTH_ASKING else 1.0

    def closed(self) -> list[_Entered]:
        """The points of the undeformed surfaces that face an obstacle, for each, as if they had just touched it."""
        undeformed, parts = self._shape.coordinates(self._symbols), []
        for contact in self._contacts:
            if isinstance(contact, SurfaceContact):
                continue
            surface = self._side(contact.on).surface
            places, step = surface.positions(undeformed), 1e-3 * np.eye(3) * surface.widths.min()
            # By differences, for obstacles need have no derivatives where nothing has entered them.
            sides = [[contact.touch(self._symbols, places + sign * s).gap for s in step] for sign in (1.0, -1.0)]
            normals = (np.array(sides[0]) - np.array(sides[1])).T / (2.0 * step[0, 0])
            outward = surface.normals_at(undeformed, surface.face, surface.place)
            facing = np.flatnonzero(np.einsum("qx,qx->q", normals, outward) < -FACING)
            parts.append(self._touched(contact, facing, places[facing], np.zeros(len(facing)), normals[facing]))
        return parts

    def _check_apart(self) -> None:
        self._check_outside()
        for contact, parts in zip(self._contacts, self._found(np.zeros(3 * self._n), 1.0), strict=True):
            rigid = not isinstance(contact, SurfaceContact)
            if rigid and self._moves(contact):
                continue
            allowed = TOUCHING * self._side(contact.on).surface.widths.mean() + (contact.tolerance if rigid else 0.0)
            entered = min(parts, key=lambda part: part.gap.min(initial=0.0))
            depth = -entered.gap.min(initial=0.0)
            if depth > allowed:
                where = ", ".join(f"{1e3 * x:.4g}" for x in entered.place[int(np.argmin(entered.gap))])
                raise StudyError(
                    f"the {contact.name} reaches {1e3 * depth:.3g} mm into the undeformed surface '{contact.on}', "
                    f"deepest at ({where}) mm: {self._advice(contact)}"
                )

    def _moves(self, contact: RigidObstacle) -> bool:
        """Whether an obstacle is elsewhere at other parameters; an amplitude alone, too, may move it."""
        if any(slopes.any() for slopes in contact.slopes(self._symbols)):
            return True
        places, present = self._mesh.nodes[self._mesh.set_nodes(contact.on)], self._symbols.present
        gaps = []
        for mu in (present, *self._symbols.telling_states()):
            self._symbols.set(mu)
            gaps.append(contact.touch(self._symbols, places).gap)
        self._symbols.set(present)
        return any((gap != gaps[0]).any() for gap in gaps[1:])

    def _check_outside(self) -> None:
        """Refuse obstacles that no contact could push out of the undeformed solid."""
        nodes = self._space.node_values @ self._shape.coordinates(self._symbols)
        for contact in self._contacts:
            if isinstance(contact, SurfaceContact):
                continue
            inside = core_inside(contact, self._symbols, nodes, self._mesh.surface_triangles())
            if len(inside):
                where = ", ".join(f"{1e3 * x:.4g}" for x in inside[len(inside) // 2])
                state = f" where {self._symbols.text(self._symbols.default)}" if len(self._symbols) else ""
                raise StudyError(
                    f"the {contact.name} of the contact on '{contact.on}' lies inside the undeformed solid, its middle "
                    f"at ({where}) mm{state}: have it outside there, and let a parameter push it in"
                )

    def strides(self, begin: Array, end: Array) -> int:
        """Parts of a path of parameters, (d,) to (d,), in each of which no obstacle moves by more than its radius."""
        rigid = [contact for contact in self._contacts if not isinstance(contact, SurfaceContact)]
        return max([1, *(int(np.ceil(travel_in_depths(body, self._symbols, begin, end))) for body in rigid)])

    def passage(self, before: tuple[Array, Array], after: tuple[Array, Array]) -> str | None:
        """What an obstacle has done between two solutions that it cannot do: go through a surface; None if nothing.

        Solutions are displacements (3 n,) and parameters (d,); those of ``after`` are the present ones then.
        """
        states = []
        for x, mu in (before, after):
            self._symbols.set(mu)
            states.append(Placed(mu, self._shape.coordinates(self._symbols) + x.reshape(3, -1).T))
        for contact in self._contacts:
            if isinstance(contact, SurfaceContact):
                continue
            if passes_through(contact, self._symbols, self._side(contact.on).surface, states[0], states[1]):
                return f"the {contact.name} passes through the surface '{contact.on}'"
        return None

    def _advice(self, contact: Contact) -> str:
        """What to do about an obstacle that overlaps the undeformed solid."""
        if isinstance(contact, RigidPlane) and (contact.touch(self._symbols, self._mesh.nodes).gap < 0.0).all():
            return "all of the solid lies behind it, so turn its normal round, towards the solid"
        return "move it away, or let a parameter push it in"

    def _entered(self, x: Array) -> list[list[_Entered]]:
        """For each contact, the points that have entered something at ``x`` (3 n,) and the present parameters."""
        mu = self._symbols.present
        known = self._latest
        if known is None or not (np.array_equal(known[0], x) and np.array_equal(known[1], mu)):
            known = self._latest = x.copy(), mu, self._found(x, self.stiffening)
        return known[2]

    def _found(self, x: Array, stiffening: float) -> list[list[_Entered]]:
        """`_entered`, with a penalty that is stiffer by a factor."""
        undeformed = self._shape.coordinates(self._symbols)
        deformed, found = undeformed + x.reshape(3, -1).T, []
        for contact in self._contacts:
            if isinstance(contact, SurfaceContact):
                pairs = sorted({(contact.on, contact.against), (contact.against, contact.on)})
                found.append([self._entered_surface(pair, undeformed, deformed, stiffening) for pair in pairs])
            else:
                found.append([self._entered_rigid(contact, deformed, stiffening)])
        return found

    def _entered_rigid(self, contact: RigidObstacle, deformed: Array, stiffening: float) -> _Entered:
        side = self._side(contact.on)
        places = side.surface.positions(deformed)
        touch = contact.touch(self._symbols, places)
        inside = np.flatnonzero(touch.gap < 0.0)
        parts = touch.gap[inside], touch.normal[inside], touch.curvature[inside]
        return self._touched(contact, inside, places[inside], *parts, stiffening)

    def _touched(
        self,
        contact: RigidObstacle,
        points: Indices,
        places: Array,
        gap: Array,
        normal: Array,
        curvature: Array | None = None,
        stiffening: float = 1.0,
    ) -> _Entered:
        """Points (k,) of a contact's surface that have entered its obstacle; of no ``curvature`` if None."""
        side = self._side(contact.on)
        moved, offset = contact.slopes(self._symbols)
        curvature = np.zeros((len(points), 3, 3)) if curvature is None else curvature
        return _Entered(
            side.spring(points, stiffening),
            gap,
            normal,
            places,
            place_forms(side.surface.dofs[side.surface.face[points]], side.surface.functions[points], self._n),
            curvature,
            offset[:, None] - moved @ normal.T,
            -np.einsum("kxy,dy->dkx", curvature, moved),
        )

    def _entered_surface(
        self, pair: tuple[str, str], undeformed: Array, deformed: Array, stiffening: float
    ) -> _Entered:
        side, other = self._side(pair[0]), self._side(pair[1]).surface
        found = find_crossings(side.surface, other, (undeformed, undeformed), (deformed, deformed))
        places = side.surface.positions(deformed)[found.points]
        own, faces = side.surface.face[found.points], found.face
        dofs = np.hstack([side.surface.dofs[own], other.dofs[faces]])
        there = other.functions_at(faces, found.place)
        relative = place_forms(dofs, np.hstack([side.surface.functions[found.points], -there]), self._n)
        turning, curvature = _turning(other, deformed, found, places, self._n)
        none = np.zeros((len(self._symbols), len(found.gap)))
        return _Entered(
            side.spring(found.points, stiffening),
            found.gap,
            found.normal,
            places,
            _interleaved(relative, turning),
            curvature,
            none,
            np.zeros((*none.shape, 3)),
        )

    def residual(self, x: Array) -> Array:
        """(3 n,) at displacements ``x`` (3 n,) and the present parameters."""
        return np.sum([part.residual for part in self._parts(x)], axis=0)

    def _parts(self, x: Array) -> list[_Entered]:
        return [part for parts in self._entered(x) for part in parts]

    def forces(self, x: Array, number: int) -> Array:
        """(3 n,) forces that one contact exerts on the solid, N."""
        return -np.sum([part.residual for part in self._entered(x)[number]], axis=0)

    def tangent(self, x: Array, limited: bool) -> sp.csr_matrix:
        """(3 n, 3 n) derivative of the residual; see the module for what is ``limited``."""
        return sp.csr_matrix(sum(part.tangent(limited) for part in self._parts(x)))

    def residual_slopes(self, x: Array) -> Array:
        """(d, 3 n) derivatives of the residual by the parameters at fixed ``x``."""
        slopes = np.sum([part.residual_slopes() for part in self._parts(x)], axis=0)
        if self._shape.functions:
            moved = self._shape.coordinate_slopes(self._symbols).swapaxes(1, 2).reshape(len(slopes), -1)
            slopes = slopes + (self.tangent(x, limited=False) @ moved.T).T
        return slopes


def _turning(
    other: ContactSurface, deformed: Array, found: Crossings, points: Array, n: int
) -> tuple[sp.csr_matrix, Array]:
    """What turns the normals of faces, and second derivatives of the gap.

    Let v be the change of a point's place in relation to its projection, t_a tangents with the metric A, k_ab their
    derivatives and D_a their changes along the normal. The projection moves by y = (A - g k)^-1 (t . v + g D) on its
    face, and the gap has the second derivative g (D + k y) A^-1 (D + k y) - 2 D y - y k y (Wriggers, section 9.1).

    Returns
    -------
    Sparse (2 k, 3 n) forms D, and (k, 5, 5) derivatives by v and D.
    """
    dofs, gap, normal = other.dofs[found.face], found.gap, found.normal
    _, first, second, metric, bends = local_geometry(other, deformed, points, found.face, found.place)
    slopes = np.stack([other.functions_at(found.face, found.place, d) for d in ((1, 0), (0, 1))], axis=1)
    values = (slopes[:, :, None, :] * normal[:, None, :, None]).reshape(-1)
    k, b = dofs.shape
    columns = np.repeat((dofs[:, None, :] + n * np.arange(3)[:, None])[:, None], 2, axis=1).reshape(-1)
    forms = sp.csr_matrix((values, columns, np.arange(0, 6 * k * b + 1, 3 * b)), shape=(2 * k, 3 * n))
    bend = np.einsum("kabx,kx->kab", bends, normal)
    turned = np.zeros((k, 2, 5))
    turned[:, :, 3:] = np.eye(2)
    along = gap[:, None, None] * turned
    along[:, :, :3] += np.stack([first, second], axis=1)
    slid = np.linalg.solve(metric - gap[:, None, None] * bend, along)
    tilted = turned + bend @ slid
    crossed = turned.swapaxes(1, 2) @ slid
    curvature = gap[:, None, None] * (tilted.swapaxes(1, 2) @ np.linalg.solve(metric, tilted))
    curvature -= crossed + crossed.swapaxes(1, 2) + slid.swapaxes(1, 2) @ bend @ slid
    return forms, curvature


def _interleaved(relative: sp.csr_matrix, turning: sp.csr_matrix) -> sp.csr_matrix:
    """Rows of forms (3 k, n) and (2 k, n) point by point (5 k, n)."""
    k = relative.indptr.size // 3
    order = np.hstack([np.arange(3 * k).reshape(-1, 3), 3 * k + np.arange(2 * k).reshape(-1, 2)]).ravel()
    return sp.csr_matrix(sp.vstack([relative, turning]))[order]


def place_forms(dofs: Indices, functions: Array, n: int) -> sp.csr_matrix:
    """Sparse (3 k, 3 n): the x, y and z of k points, given functions (k, b) of scalar dofs (k, b)."""
    k, b = dofs.shape
    columns = (dofs[:, None, :] + n * np.arange(3)[:, None]).reshape(-1)
    values = np.repeat(functions[:, None, :], 3, axis=1).reshape(-1)
    return sp.csr_matrix((values, columns, np.arange(0, 3 * k * b + 1, b)), shape=(3 * k, 3 * n))


def added(matrix: sp.csr_matrix, other: sp.csr_matrix, triangular: bool) -> sp.csr_matrix:
    """``matrix`` plus the symmetric ``other``, of smaller size, in the pattern of the first if that holds the second.

    ``triangular`` says that only one triangle of ``matrix`` is stored.
    """
    entries, n = other.tocoo(), len(matrix.indptr) - 1
    i, j, values = entries.row.astype(np.int64), entries.col.astype(np.int64), entries.data
    rows = np.repeat(np.arange(n, dtype=np.int64), np.diff(matrix.indptr))
    if triangular:
        kept = i >= j if np.any(rows > matrix.indices) else i <= j
        i, j, values = i[kept], j[kept], values[kept]
    keys, wanted = rows * n + matrix.indices, i * n + j
    places = np.minimum(np.searchsorted(keys, wanted), len(keys) - 1)
    if np.array_equal(keys[places], wanted):
        data = matrix.data.copy()
        np.add.at(data, places, values)
        return sp.csr_matrix((data, matrix.indices, matrix.indptr), shape=(n, n))
    # Through lists of entries: scipy's sum of two matrices would drop entries that happen to be zero.
    both = np.concatenate([rows, i]), np.concatenate([matrix.indices, j])
    return sp.csr_matrix(sp.coo_matrix((np.concatenate([matrix.data, values]), both), shape=(n, n)))
