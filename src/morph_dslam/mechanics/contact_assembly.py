"""Contact of a solid's surfaces by a penalty: its forces, tangent and derivatives by the parameters.

The gap g of a deformed point is its distance from what it may touch, negative where it has entered. This costs

    int eps / 2 min(g, 0)^2 dA

on the undeformed surface, whose derivative is the pressure eps |g| along the normal (Wriggers, Computational Contact
Mechanics, 2006, section 6.3). The stiffness eps is `STIFFNESS` times Young's modulus over the width of an element's
face, so that a surface gives way by a small part of that width.

Of the tangent, the part due to the turning of normals is in proportion to the pressure, and negative. An iteration that
starts deep in an obstacle has pressures far beyond any that can be carried, with which that part would make the tangent
indefinite. So far from equilibrium it counts with a pressure of at most `LARGEST_PRESSURE` times Young's modulus, and
steps may be larger than elements.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from morph_dslam.errors import StudyError
from morph_dslam.mechanics.contact import RigidObstacle
from morph_dslam.mechanics.contact_surface import ContactSurface
from morph_dslam.mechanics.kinematics import Shape
from morph_dslam.mechanics.parameters import ParameterSymbols
from morph_dslam.mechanics.spaces import DisplacementSpace

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
#: Stiffness of contact over that of a layer of the material as thick as a face of an element is wide.
STIFFNESS = 30.0
#: Pressure, over Young's modulus, up to which a limited tangent is complete.
LARGEST_PRESSURE = 1.0
#: Surfaces that overlap by less than such a part of a face's width touch.
TOUCHING = 1e-4


@dataclass(frozen=True)
class _Entered:
    """Points of a surface that have entered something, k of them.

    Attributes
    ----------
    gap : (k,) m, negative.
    weights : (k,) area, m2.
    stiffness : (k,) eps, Pa/m.
    young : (k,) modulus of the material, Pa.
    normal : (k, 3).
    forms : sparse (r k, 3 n): changes that the gap depends on, r for each point; the first three are those of its place
        in relation to what it has entered.
    curvature : (k, r, r) second derivatives of the gap by these.
    slopes : (d, k) derivatives of the gap by the parameters at fixed dofs and undeformed shape.
    normal_slopes : (d, k, 3) of the normal.
    """

    gap: Array
    weights: Array
    stiffness: Array
    young: Array
    normal: Array
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
        forces[..., :3] = self.weights[:, None] * traction
        flat = forces.reshape(int(np.prod(several)), self._size[0])
        return (self.forms.T @ flat.T).T.reshape(*several, self._size[1])

    @property
    def residual(self) -> Array:
        """(3 n,) derivative of the energy."""
        return self.assembled((self.stiffness * self.gap)[:, None] * self.normal)

    def tangent(self, limited: bool) -> sp.csr_matrix:
        """(3 n, 3 n) derivative of the residual; ``limited`` to `LARGEST_PRESSURE`."""
        pressure = -self.stiffness * self.gap
        if limited:
            pressure = np.minimum(pressure, LARGEST_PRESSURE * self.young)
        blocks = -pressure[:, None, None] * self.curvature
        blocks[:, :3, :3] += self.stiffness[:, None, None] * self.normal[:, :, None] * self.normal[:, None, :]
        blocks *= self.weights[:, None, None]
        number = np.arange(len(blocks))
        middle = sp.bsr_matrix((blocks, number, np.arange(len(blocks) + 1)), shape=(self._size[0],) * 2)
        return sp.csr_matrix(self.forms.T @ (middle @ self.forms))

    def residual_slopes(self) -> Array:
        """(d, 3 n) derivatives of the residual by the parameters at fixed dofs and undeformed shape."""
        change = self.slopes[:, :, None] * self.normal + self.gap[:, None] * self.normal_slopes
        return self.assembled(self.stiffness[:, None] * change)


class ContactAssembly:
    """All contacts of a solid. Raises StudyError if an obstacle that no parameter moves overlaps the undeformed solid.

    Parameters
    ----------
    space : displacements.
    shape : how the undeformed shape depends on parameters.
    contacts : see `contact`.
    shear : (n_cells,) shear modulus of each cell's material, Pa: a third of Young's modulus, if incompressible.
    symbols : parameters.
    """

    def __init__(
        self,
        space: DisplacementSpace,
        shape: Shape,
        contacts: Sequence[RigidObstacle],
        shear: Array,
        symbols: ParameterSymbols,
    ) -> None:
        self._shape, self._symbols, self._contacts, self._n = shape, symbols, contacts, space.n_scalar
        self._surfaces, self._young = [], []
        for contact in contacts:
            faces = space.geometry.mesh.surface(contact.on)
            self._surfaces.append(ContactSurface.of(space, faces))
            self._young.append(3.0 * shear[faces[:, 0]])
        self._latest: tuple[Array, Array, list[_Entered]] | None = None
        self._check_apart()

    def _check_apart(self) -> None:
        for contact, surface, entered in zip(
            self._contacts, self._surfaces, self._entered(np.zeros(3 * self._n)), strict=True
        ):
            moved = any(slopes.any() for slopes in contact.slopes(self._symbols))
            if moved or not (entered.gap < -TOUCHING * surface.widths.mean()).any():
                continue
            deepest = int(np.argmin(entered.gap))
            place = entered.forms[3 * deepest : 3 * deepest + 3] @ self._shape.coordinates(self._symbols).T.ravel()
            where = ", ".join(f"{1e3 * x:.4g}" for x in place)
            raise StudyError(
                f"the {contact.name} reaches {-1e3 * entered.gap[deepest]:.3g} mm into the undeformed surface "
                f"'{contact.on}', deepest at ({where}) mm: move it away, or let a parameter push it in"
            )

    def _entered(self, x: Array) -> list[_Entered]:
        """The points that have entered something at ``x`` (3 n,) and the present parameters, of each contact."""
        mu = np.array([self._symbols.value(self._symbols[p.name]) for p in self._symbols.parameters])
        known = self._latest
        if known is None or not (np.array_equal(known[0], x) and np.array_equal(known[1], mu)):
            coordinates = self._shape.coordinates(self._symbols) + x.reshape(3, -1).T
            found = [self._entered_rigid(number, coordinates) for number in range(len(self._contacts))]
            known = self._latest = x.copy(), mu, found
        return known[2]

    def _entered_rigid(self, number: int, coordinates: Array) -> _Entered:
        contact, surface = self._contacts[number], self._surfaces[number]
        touch = contact.touch(self._symbols, surface.positions(coordinates))
        inside = np.flatnonzero(touch.gap < 0.0)
        moved, offset = contact.slopes(self._symbols)
        normal, curvature = touch.normal[inside], touch.curvature[inside]
        faces = surface.face[inside]
        young = self._young[number][faces]
        return _Entered(
            touch.gap[inside],
            surface.weights[inside],
            STIFFNESS * young / surface.widths[faces],
            young,
            normal,
            place_forms(surface.dofs[faces], surface.functions[inside], self._n),
            curvature,
            offset[:, None] - moved @ normal.T,
            -np.einsum("kxy,dy->dkx", curvature, moved),
        )

    def residual(self, x: Array) -> Array:
        """(3 n,) at displacements ``x`` (3 n,) and the present parameters."""
        return np.sum([entered.residual for entered in self._entered(x)], axis=0)

    def forces(self, x: Array, number: int) -> Array:
        """(3 n,) forces that one contact exerts on the solid, N."""
        return -self._entered(x)[number].residual

    def tangent(self, x: Array, limited: bool) -> sp.csr_matrix:
        """(3 n, 3 n) derivative of the residual; see the module for what is ``limited``."""
        return sp.csr_matrix(sum(entered.tangent(limited) for entered in self._entered(x)))

    def residual_slopes(self, x: Array) -> Array:
        """(d, 3 n) derivatives of the residual by the parameters at fixed ``x``."""
        slopes = np.sum([entered.residual_slopes() for entered in self._entered(x)], axis=0)
        if self._shape.functions:
            moved = self._shape.coordinate_slopes(self._symbols).swapaxes(1, 2).reshape(len(slopes), -1)
            slopes = slopes + (self.tangent(x, limited=False) @ moved.T).T
        return slopes


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
