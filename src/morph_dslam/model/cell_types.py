"""Cell types: node order, faces, shape functions and quadrature of each, from one table of reference cells.

Node order is VTK's (VTK User's Guide, "Cell types"), which is Abaqus's as well, save that of linear prisms: the base
triangle of a prism turns anticlockwise as seen from its top, that of VTK's linear prism the other way round. Faces are
numbered as Abaqus numbers them (S1 is 0) and their nodes turn anticlockwise as seen from outside. Reference cells fill
the unit cube, the unit simplex or, for prisms, the unit triangle times [0, 1].
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from itertools import product

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
_CORNERS: dict[str, tuple[tuple[int, ...], ...]] = {
    "tri": ((0, 0), (1, 0), (0, 1)),
    "quad": ((0, 0), (1, 0), (1, 1), (0, 1)),
    "tet": ((0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)),
    "prism": ((0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 0, 1), (0, 1, 1)),
    "hex": (
        (0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0),
        (0, 0, 1), (1, 0, 1), (1, 1, 1), (0, 1, 1),
    ),
}  # fmt: skip
_EDGES: dict[str, tuple[tuple[int, int], ...]] = {
    "tri": ((0, 1), (1, 2), (2, 0)),
    "quad": ((0, 1), (1, 2), (2, 3), (3, 0)),
    "tet": ((0, 1), (1, 2), (2, 0), (0, 3), (1, 3), (2, 3)),
    "prism": ((0, 1), (1, 2), (2, 0), (3, 4), (4, 5), (5, 3), (0, 3), (1, 4), (2, 5)),
    "hex": ((0, 1), (1, 2), (2, 3), (3, 0), (4, 5), (5, 6), (6, 7), (7, 4), (0, 4), (1, 5), (2, 6), (3, 7)),
}
_CORNER_FACES: dict[str, tuple[tuple[int, ...], ...]] = {
    "tri": ((0, 1, 2),),
    "quad": ((0, 1, 2, 3),),
    "tet": ((0, 2, 1), (0, 1, 3), (1, 2, 3), (2, 0, 3)),
    "prism": ((0, 2, 1), (3, 4, 5), (0, 1, 4, 3), (1, 2, 5, 4), (2, 0, 3, 5)),
    "hex": ((0, 3, 2, 1), (4, 5, 6, 7), (0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6), (3, 0, 4, 7)),
}
#: Corners around the nodes in the middle of faces, and of the cell, in the order in which VTK numbers them.
_FACE_CENTRES: dict[str, tuple[tuple[int, ...], ...]] = {
    "quad9": ((0, 1, 2, 3),),
    "prism18": ((0, 1, 4, 3), (1, 2, 5, 4), (2, 0, 3, 5)),
    "hex27": (
        (0, 4, 7, 3), (1, 2, 6, 5), (0, 1, 5, 4), (3, 7, 6, 2), (0, 3, 2, 1), (4, 5, 6, 7),
        (0, 1, 2, 3, 4, 5, 6, 7),
    ),
}  # fmt: skip
_SHAPES = {
    "tri3": "tri", "tri6": "tri", "quad4": "quad", "quad8": "quad", "quad9": "quad", "tet4": "tet", "tet10": "tet",
    "prism6": "prism", "prism15": "prism", "prism18": "prism", "hex8": "hex", "hex20": "hex", "hex27": "hex",
}  # fmt: skip
#: Types with nodes beyond their corners.
SECOND_ORDER = ("tri6", "quad8", "quad9", "tet10", "prism15", "prism18", "hex20", "hex27")


def _monomials(name: str) -> list[tuple[int, ...]]:
    """Exponents of the polynomials that a cell type's shape functions span."""
    linear, quadratic = range(2), range(3)
    if name in ("tri3", "tet4"):
        return [e for e in product(linear, repeat=len(_CORNERS[_SHAPES[name]][0])) if sum(e) <= 1]
    if name in ("quad4", "hex8"):
        return list(product(linear, repeat=len(_CORNERS[_SHAPES[name]][0])))
    if name in ("tri6", "tet10"):
        return [e for e in product(quadratic, repeat=len(_CORNERS[_SHAPES[name]][0])) if sum(e) <= 2]
    if name in ("quad8", "quad9"):  # quad8 is serendipity, as hex20
        return [e for e in product(quadratic, repeat=2) if name == "quad9" or e.count(2) <= 1]
    if name == "hex20":  # serendipity: at most one of the coordinates squared
        return [e for e in product(quadratic, repeat=3) if e.count(2) <= 1]
    if name == "hex27":
        return list(product(quadratic, repeat=3))
    triangle = [e for e in product(quadratic, repeat=3) if e[0] + e[1] <= 2]
    if name == "prism18":
        return triangle
    if name == "prism15":  # serendipity: the square along the axis times linear functions of the triangle
        return [e for e in triangle if e[2] < 2 or e[0] + e[1] <= 1]
    return [e for e in triangle if e[2] < 2 and e[0] + e[1] <= 1]  # prism6


@dataclass(frozen=True)
class CellType:
    """One type of cell.

    Attributes
    ----------
    name : "hex8" and so on.
    shape : "tri", "quad", "tet", "prism" or "hex".
    corners : number of corner nodes, which come first.
    parents : for each node beyond the corners, the corners that it lies midway between.
    nodes : (k, dim) coordinates of the nodes in the reference cell.
    faces : for each face its nodes: corners turning anticlockwise as seen from outside, then the nodes
        midway along the edges in that order, then the node at its centre. A sheet's cell is its own face.
    """

    name: str
    shape: str
    corners: int
    parents: tuple[tuple[int, ...], ...]
    nodes: Array
    faces: tuple[tuple[int, ...], ...]

    @property
    def dimension(self) -> int:
        return self.nodes.shape[1]

    @property
    def order(self) -> int:
        return 2 if self.parents else 1

    def _exponents(self) -> NDArray[np.int64]:
        return np.array(_monomials(self.name))

    def _coefficients(self) -> Array:
        """Column k holds the monomial coefficients of the shape function of node k."""
        exponents = self._exponents()
        return np.linalg.inv(np.prod(self.nodes[:, None, :] ** exponents, axis=2))

    def shape_functions(self, points: Array) -> Array:
        """Values (p, k) of the k shape functions at reference points (p, dim)."""
        return np.prod(points[:, None, :] ** self._exponents(), axis=2) @ self._coefficients()

    def shape_gradients(self, points: Array) -> Array:
        """Derivatives (p, k, dim) of the shape functions by the reference coordinates."""
        exponents, coefficients = self._exponents(), self._coefficients()
        gradients = np.empty((len(points), len(self.nodes), self.dimension))
        for axis in range(self.dimension):
            lowered = exponents.copy()
            lowered[:, axis] = np.maximum(exponents[:, axis] - 1, 0)
            monomials = np.prod(points[:, None, :] ** lowered, axis=2) * exponents[:, axis]
            gradients[:, :, axis] = monomials @ coefficients
        return gradients

    def quadrature(self) -> tuple[Array, Array]:
        """Points (p, dim) and weights (p,) that integrate the cell's volume exactly where it is affine.

        Two Gauss points in each direction for cells of first order and three for second; on triangles and
        tetrahedra the rule is the collapsed square's or cube's (Stroud's conical product), one point more in
        each collapsed direction.
        """
        gauss, gauss_weights = np.polynomial.legendre.leggauss(self.order + 1 + (self.shape not in ("quad", "hex")))
        points = np.array(list(product((gauss + 1.0) / 2.0, repeat=self.dimension)))
        weights = np.prod(list(product(gauss_weights / 2.0, repeat=self.dimension)), axis=1)
        u, v = points[:, 0].copy(), points[:, 1].copy()
        if self.shape in ("tri", "prism"):
            points[:, 0], weights = u * (1.0 - v), weights * (1.0 - v)
        elif self.shape == "tet":
            w = points[:, 2]
            points[:, 0], points[:, 1] = u * (1.0 - v) * (1.0 - w), v * (1.0 - w)
            weights = weights * (1.0 - v) * (1.0 - w) ** 2
        return points, weights


def _with_middle_nodes(face: tuple[int, ...], node_between: dict[frozenset[int], int]) -> tuple[int, ...]:
    rim = [frozenset((a, b)) for a, b in zip(face, face[1:] + face[:1], strict=True)]
    middle = [node_between[key] for key in (*rim, frozenset(face)) if key in node_between]
    return face + tuple(middle)


@cache
def cell_type(name: str) -> CellType:
    """The cell type of a name; KeyError if there is none."""
    shape = _SHAPES[name]
    corners = np.array(_CORNERS[shape], dtype=float)
    parents: tuple[tuple[int, ...], ...] = ()
    if name in SECOND_ORDER:
        parents = _EDGES[shape] + _FACE_CENTRES.get(name, ())
    middle = [corners[list(parent)].mean(axis=0) for parent in parents]
    node_between = {frozenset(parent): len(corners) + i for i, parent in enumerate(parents)}
    return CellType(
        name=name,
        shape=shape,
        corners=len(corners),
        parents=parents,
        nodes=np.vstack([corners, *middle]),
        faces=tuple(_with_middle_nodes(face, node_between) for face in _CORNER_FACES[shape]),
    )
