"""A surface of a solid as contact sees it: points on its faces, and where they are."""

from __future__ import annotations

from itertools import product

import numpy as np
from numpy.typing import NDArray

from morph_dslam.mechanics.spaces import DisplacementSpace
from morph_dslam.meshing.meshes import Mesh

Array = NDArray[np.float64]
Indices = NDArray[np.int64]


_LOBATTO = np.array([0.0, 0.5 - 0.1 * 5.0**0.5, 0.5 + 0.1 * 5.0**0.5, 1.0])
_SHARES = np.array([1.0, 5.0, 5.0, 1.0]) / 12.0
_MIDDLE = [[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [0.5, 0.0], [0.5, 0.5], [0.0, 0.5], [1.0 / 3.0, 1.0 / 3.0]]
#: Points and weights by the number of a face's corners. These are among the points, for corners dip in first.
#: Exact for the third order on triangles, the fifth in each direction on quadrilaterals (Gauss-Lobatto).
RULES: dict[int, tuple[Array, Array]] = {
    3: (np.array(_MIDDLE), np.array([3.0, 3.0, 3.0, 8.0, 8.0, 8.0, 27.0]) / 120.0),
    4: (np.array(list(product(_LOBATTO, repeat=2))), np.outer(_SHARES, _SHARES).ravel()),
}


class ContactSurface:
    """Faces, each with polynomials of two coordinates (see `DisplacementSpace.face_functions`), and quadrature points.

    Parameters
    ----------
    dofs : (f, b) scalar dofs, or vertices, that a face depends on.
    coefficients : (f, b, m) of each one's polynomial.
    corners : (f,) number of each face's corners.
    coordinates : (n, 3) undeformed coefficients of the position, m: they give quadrature its areas.
    heights : (f,) of the cells behind the faces, m; infinite for rigid bodies.

    Attributes
    ----------
    face : (q,) face of each quadrature point.
    place : (q, 2) its coordinates there.
    functions : (q, b) the face's functions at it.
    weights : (q,) area that it stands for, m2.
    widths : (f,) square root of each face's area, of triangles' twice the area, m.
    heights : (f,) as given.
    """

    def __init__(
        self, dofs: Indices, coefficients: Array, corners: Indices, coordinates: Array, heights: Array
    ) -> None:
        self.dofs, self.corners, self._coefficients = dofs, corners, coefficients
        self._exponents = np.array(list(product(range(round(coefficients.shape[2] ** 0.5)), repeat=2)))
        face, place, shares = [], [], []
        for count, (points, weights) in RULES.items():
            faces = np.flatnonzero(corners == count)
            face.append(np.repeat(faces, len(weights)))
            place.append(np.tile(points, (len(faces), 1)))
            shares.append(np.tile(weights, len(faces)))
        self.face, self.place = np.concatenate(face), np.concatenate(place)
        self.functions = self.functions_at(self.face, self.place)
        areas = np.linalg.norm(self.area_vectors(coordinates), axis=1)
        self.weights: Array = areas * np.concatenate(shares)
        whole = np.bincount(self.face, self.weights, minlength=len(dofs))
        self.heights = heights
        self.widths: Array = np.sqrt(np.where(corners == 3, 2.0, 1.0) * whole)

    @staticmethod
    def of(space: DisplacementSpace, faces: Indices) -> ContactSurface:
        """The faces (f, 2) of a solid."""
        dofs, coefficients = space.face_functions(faces)
        corners = (space.geometry.mesh.face_nodes(faces, corners_only=True) >= 0).sum(axis=1)
        return ContactSurface(dofs, coefficients, corners, space.coordinates, _heights(space.geometry.mesh, faces))

    def functions_at(self, face: Indices, place: Array, derivative: tuple[int, int] = (0, 0)) -> Array:
        """Functions (k, b) of faces (k,), or a derivative of them, at places (k, 2)."""
        monomials = np.ones((len(place), len(self._exponents)))
        for axis, times in enumerate(derivative):
            powers = self._exponents[:, axis]
            for lowered in range(times):
                monomials *= np.maximum(powers - lowered, 0)
            monomials *= place[:, axis, None] ** np.maximum(powers - times, 0)
        return np.einsum("kbm,km->kb", self._coefficients[face], monomials)

    def area_vectors(self, coordinates: Array) -> Array:
        """Outward normals (q, 3) at the quadrature points, as long as the area per area of the coordinates."""
        return self._area_vectors_at(coordinates, self.face, self.place)

    def _area_vectors_at(self, coordinates: Array, face: Indices, place: Array) -> Array:
        first, second = (self.at(coordinates, face, place, d) for d in ((1, 0), (0, 1)))
        return np.cross(first, second)

    def normals_at(self, coordinates: Array, face: Indices, place: Array) -> Array:
        """Outward unit normals (k, 3) of faces (k,) at places (k, 2)."""
        return unit(self._area_vectors_at(coordinates, face, place))

    def centres(self, values: Array) -> Array:
        """Means (f, c) over the faces of ``values`` (q, c) at the quadrature points."""
        counts = np.bincount(self.face, minlength=len(self.dofs))
        sums = [np.bincount(self.face, column, minlength=len(self.dofs)) for column in values.T]
        return np.column_stack(sums) / counts[:, None]

    def positions(self, coordinates: Array) -> Array:
        """The quadrature points (q, 3) where the ``coordinates`` (n, 3) have these coefficients."""
        return np.einsum("qb,qbx->qx", self.functions, coordinates[self.dofs[self.face]])

    def at(self, coordinates: Array, face: Indices, place: Array, derivative: tuple[int, int] = (0, 0)) -> Array:
        """Positions (k, 3), or a derivative of them, on faces (k,) at places (k, 2)."""
        return np.einsum("kb,kbx->kx", self.functions_at(face, place, derivative), coordinates[self.dofs[face]])


def unit(vectors: Array) -> Array:
    """Vectors (k, 3) of length 1."""
    return vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), np.finfo(float).tiny)


def _heights(mesh: Mesh, faces: Indices) -> Array:
    """Length (f,) of the shortest way, m, from a corner of each of the ``faces`` (f, 2) to one of its cell's others."""
    heights = np.zeros(len(faces))
    for block, start in zip(mesh.blocks, mesh.block_starts()[:-1], strict=True):
        corners = mesh.nodes[block.connectivity[:, : block.type.corners]]
        for number, local in enumerate(block.type.faces):
            cell = faces[:, 0] - start
            rows = np.flatnonzero((cell >= 0) & (cell < len(corners)) & (faces[:, 1] == number))
            on = [node for node in local if node < block.type.corners]
            off = np.setdiff1d(np.arange(block.type.corners), on)
            ways = corners[cell[rows]][:, on, None] - corners[cell[rows]][:, None, off]
            heights[rows] = np.linalg.norm(ways, axis=3).min(axis=(1, 2))
    return heights
