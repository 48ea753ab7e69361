"""Sections: what a plane through an undeformed solid cuts open, to be carried along as the solid deforms."""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from morph_dslam.errors import TrackingError
from morph_dslam.model import ReducedModel
from morph_dslam.model.reduced_model import MaterialPoints

Array = NDArray[np.float64]

#: A hexahedron as six tetrahedra around its diagonal 0-6, corners in VTK's order.
_HEX = np.array([[0, 1, 2, 6], [0, 2, 3, 6], [0, 3, 7, 6], [0, 7, 4, 6], [0, 4, 5, 6], [0, 5, 1, 6]])
#: A prism as three tetrahedra.
_PRISM = np.array([[0, 1, 2, 5], [0, 1, 5, 4], [0, 4, 5, 3]])
_FORM = re.compile(r"([+-]?)([xyz])=(-?[0-9]*\.?[0-9]+)")


@dataclass(frozen=True)
class SectionPlane:
    """The points x of the undeformed object with normal @ x = offset; what lies beyond is taken away.

    Attributes
    ----------
    normal : (3,) unit vector, object frame. offset : metres.
    """

    normal: Array
    offset: float

    @classmethod
    def parse(cls, text: str) -> SectionPlane:
        """From "x=12" or "-x=12", millimetres: x > 12 mm, or x < 12 mm, is taken away.

        Raises
        ------
        TrackingError
            If the text is none of these.
        """
        found = _FORM.fullmatch(text.replace(" ", ""))
        if found is None:
            raise TrackingError(
                f"'{text}' is no section: write x=12 to take away all beyond x = 12 mm, -x=12 for all before "
                "it; y and z likewise, in the object's frame"
            )
        sign = -1.0 if found[1] == "-" else 1.0
        normal = sign * np.eye(3)["xyz".index(found[2])]
        return cls(normal, sign * 1e-3 * float(found[3]))

    def beyond(self, points: Array) -> Array:
        """How far (n,) points (n, 3) lie beyond the plane, metres."""
        return points @ self.normal - self.offset


def cut(model: ReducedModel, plane: SectionPlane) -> tuple[MaterialPoints, NDArray[np.int64]]:
    """The section's nodes, as material points between two mesh nodes each, and its triangles (m, 3).

    Each cell is cut as tetrahedra with straight edges.

    Raises
    ------
    TrackingError
        If the model is a sheet's, or the plane misses the object.
    """
    if not model.cells:
        raise TrackingError(f"'{model.name}' is a sheet: it has no inside to show in a section")
    tetrahedra, depth = _tetrahedra(model), _depth(model, plane)
    below = depth[tetrahedra] < 0.0
    count = below.sum(axis=1)
    # Corners below the plane first.
    ordered = np.take_along_axis(tetrahedra, np.argsort(~below, axis=1, kind="stable"), axis=1)
    edges = [
        _edges(ordered[count == 1], [(0, 1), (0, 2), (0, 3)]),
        _edges(ordered[count == 3], [(0, 3), (1, 3), (2, 3)]),
        _edges(ordered[count == 2], [(0, 2), (0, 3), (1, 3)]),
        _edges(ordered[count == 2], [(0, 2), (1, 3), (1, 2)]),
    ]
    triangles = np.concatenate(edges)
    if not len(triangles):
        low, high = 1e3 * depth.min() + 1e3 * plane.offset, 1e3 * depth.max() + 1e3 * plane.offset
        raise TrackingError(
            f"the section misses the object: along its normal '{model.name}' reaches from {low:.1f} to "
            f"{high:.1f} mm"
        )
    return _on_edges(triangles, depth)


def surface_before(model: ReducedModel, plane: SectionPlane) -> tuple[MaterialPoints, NDArray[np.int64]]:
    """What the plane leaves of the surface: its nodes, between two mesh nodes each, and its triangles (m, 3).

    Triangles that the plane crosses are cut along it, and keep the direction in which they run.
    """
    depth = _depth(model, plane)
    below = depth[model.triangles] < 0.0
    count = below.sum(axis=1)
    # First the one corner that is on its side of the plane alone.
    alone = np.where(count == 1, below.argmax(axis=1), (~below).argmax(axis=1))
    turned = np.take_along_axis(model.triangles, (alone[:, None] + np.arange(3)) % 3, axis=1)
    one, two = turned[count == 1], turned[count == 2]
    parts = [
        _edges(model.triangles[count == 3], [(0, 0), (1, 1), (2, 2)]),
        _edges(one, [(0, 0), (0, 1), (0, 2)]),
        _edges(two, [(1, 0), (1, 1), (2, 2)]),
        _edges(two, [(1, 0), (2, 2), (2, 0)]),
    ]
    return _on_edges(np.concatenate(parts), depth)


def _depth(model: ReducedModel, plane: SectionPlane) -> Array:
    """How far the nodes (n,) lie beyond the plane; one that lies in it belongs to one side, by a hair."""
    depth = plane.beyond(model.nodes)
    return np.where(np.abs(depth) < 1e-12, 1e-12, depth)


def _on_edges(triangles: NDArray[np.int64], depth: Array) -> tuple[MaterialPoints, NDArray[np.int64]]:
    """Triangles (t, 3, 2), each corner where the plane cuts the edge between two nodes, or a node itself."""
    unique, corners = np.unique(triangles.reshape(-1, 2), axis=0, return_inverse=True)
    here, there = depth[unique[:, 0]], depth[unique[:, 1]]
    is_node = unique[:, 0] == unique[:, 1]
    share = np.where(is_node, 0.0, here / np.where(is_node, 1.0, here - there))
    return MaterialPoints(unique, np.column_stack([1.0 - share, share])), corners.reshape(-1, 3)


def _tetrahedra(model: ReducedModel) -> NDArray[np.int64]:
    """All cells by their corners as tetrahedra (k, 4)."""
    parts = []
    for cell_type, cells in model.cells.items():
        if cell_type.startswith("hex"):
            parts.append(cells[:, _HEX].reshape(-1, 4))
        elif cell_type.startswith("prism"):
            parts.append(cells[:, _PRISM].reshape(-1, 4))
        else:
            parts.append(cells[:, :4])
    return np.concatenate(parts)


def _edges(cells: NDArray[np.int64], pairs: list[tuple[int, int]]) -> NDArray[np.int64]:
    """Three edges (t, 3, 2) of each tetrahedron or triangle, by its corners; they make a triangle."""
    return np.stack([cells[:, list(pair)] for pair in pairs], axis=1)
