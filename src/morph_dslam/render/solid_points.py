"""Texture and landmarks of a solid's surface: where a sheet has one rest plane, a solid has three.

The print is laid on by box projection: each triangle takes the texture as seen along the axis that its rest
normal is nearest to. Nodes where triangles of different axes meet are used once for each.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from morph_dslam.model import ReducedModel
from morph_dslam.model.surface_sampling import triangle_normals

Array = NDArray[np.float64]

#: Landmarks of a solid, spread over all of its surface: about half of them face the camera.
N_LANDMARKS = 40


@dataclass(frozen=True)
class TexturedSurface:
    """A surface with one texture coordinate for each of its vertices.

    Attributes
    ----------
    nodes : (k,) mesh node of each vertex. triangles : (m, 3) vertices, in the mesh's order of triangles.
    coordinates : (k, 2) column and row in the texture, texture pixels.
    """

    nodes: NDArray[np.int64]
    triangles: NDArray[np.int64]
    coordinates: Array


def surface_size(model: ReducedModel) -> float:
    """The largest extent of the surface at rest, metres: the side of the square print."""
    return float(np.ptp(model.nodes[np.unique(model.triangles)], axis=0).max())


def box_projection(model: ReducedModel, pixels: int) -> TexturedSurface:
    """Lay a square texture of ``pixels`` a side over the surface at rest, x or y to the right and z up."""
    axis = np.abs(triangle_normals(model.nodes, model.triangles)).argmax(axis=1)
    keys = 3 * model.triangles + axis[:, None]
    vertices, inverse = np.unique(keys.ravel(), return_inverse=True)
    nodes, axes = vertices // 3, vertices % 3
    low = model.nodes[np.unique(model.triangles)].min(axis=0)
    fraction = (model.nodes[nodes] - low) / surface_size(model)
    right = np.where(axes == 0, fraction[:, 1], fraction[:, 0])
    up = np.where(axes == 2, fraction[:, 1], fraction[:, 2])
    coordinates = np.column_stack([right, 1.0 - up]) * pixels - 0.5
    return TexturedSurface(nodes, inverse.reshape(-1, 3), coordinates)


def spread_nodes(model: ReducedModel, count: int = N_LANDMARKS) -> NDArray[np.int64]:
    """Surface nodes (k,), each as far as possible from those before it, from the lowest corner on."""
    candidates = np.unique(model.triangles)
    places = model.nodes[candidates]
    chosen = [int(places.sum(axis=1).argmin())]
    distance = np.linalg.norm(places - places[chosen[0]], axis=1)
    while len(chosen) < min(count, len(candidates)):
        chosen.append(int(distance.argmax()))
        distance = np.minimum(distance, np.linalg.norm(places - places[chosen[-1]], axis=1))
    return candidates[chosen]
