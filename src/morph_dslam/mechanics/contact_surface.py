"""A surface of a solid as contact sees it: points on its faces, and where they are."""

from __future__ import annotations

from itertools import product

import numpy as np
from numpy.typing import NDArray

from morph_dslam.mechanics.spaces import DisplacementSpace

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

    Attributes
    ----------
    face : (q,) face of each quadrature point.
    place : (q, 2) its coordinates there.
    functions : (q, b) the face's functions at it.
    weights : (q,) area that it stands for, m2.
    widths : (f,) square root of each face's area, of triangles' twice the area, m.
    """

    def __init__(self, dofs: Indices, coefficients: Array, corners: Indices, coordinates: Array) -> None:
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
        self.widths: Array = np.sqrt(np.where(corners == 3, 2.0, 1.0) * whole)

    @staticmethod
    def of(space: DisplacementSpace, faces: Indices) -> ContactSurface:
        """The faces (f, 2) of a solid."""
        dofs, coefficients = space.face_functions(faces)
        corners = (space.geometry.mesh.face_nodes(faces, corners_only=True) >= 0).sum(axis=1)
        return ContactSurface(dofs, coefficients, corners, space.coordinates)

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
        first, second = (self.at(coordinates, self.face, self.place, d) for d in ((1, 0), (0, 1)))
        return np.cross(first, second)

    def positions(self, coordinates: Array) -> Array:
        """The quadrature points (q, 3) where the ``coordinates`` (n, 3) have these coefficients."""
        return np.einsum("qb,qbx->qx", self.functions, coordinates[self.dofs[self.face]])

    def at(self, coordinates: Array, face: Indices, place: Array, derivative: tuple[int, int] = (0, 0)) -> Array:
        """Positions (k, 3), or a derivative of them, on faces (k,) at places (k, 2)."""
        return np.einsum("kb,kbx->kx", self.functions_at(face, place, derivative), coordinates[self.dofs[face]])
