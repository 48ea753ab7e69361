"""Points of a sheet by their place in its rest plane: texture coordinates, regular grids, landmarks."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from morph_dslam.model import ReducedModel, SurfacePoints

Array = NDArray[np.float64]

#: A model whose rest shape is deeper than this fraction of its smaller side is no sheet.
FLATNESS = 0.02


def is_sheet(model: ReducedModel) -> bool:
    """Whether the model at rest is a sheet in the plane z = constant."""
    extent = np.ptp(model.nodes[np.unique(model.triangles)], axis=0)
    return not model.cells and bool(extent[2] <= FLATNESS * extent[:2].min())


def sheet_bounds(model: ReducedModel) -> tuple[Array, Array]:
    """Lower and upper corner (2,) of the sheet's rest plane, metres."""
    plane = model.nodes[np.unique(model.triangles), :2]
    return plane.min(axis=0), plane.max(axis=0)


def texture_coordinates(model: ReducedModel, printed_face: str, width: int, height: int) -> Array:
    """Texture pixel (n, 2) of each node when the texture, edge to edge, fills the sheet's rectangle.

    Seen on the printed face x runs to the right; y runs up on the top face (z towards the viewer) and down
    on the bottom face.
    """
    low, high = sheet_bounds(model)
    fraction = (model.nodes[:, :2] - low) / (high - low)
    if printed_face == "top":
        fraction[:, 1] = 1.0 - fraction[:, 1]
    # Texture pixel 0 covers -0.5 to 0.5.
    return fraction * [width, height] - 0.5


def locate_in_plane(model: ReducedModel, places: Array) -> tuple[SurfacePoints, NDArray[np.bool_]]:
    """Surface points above places (p, 2) of the rest plane, and which places (p,) are on the sheet at all."""
    corners = model.nodes[model.triangles, :2]
    edges = np.stack([corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]], axis=2)
    inverse = np.linalg.inv(edges)
    triangles = np.zeros(len(places), dtype=np.int64)
    weights = np.zeros((len(places), 3))
    inside = np.zeros(len(places), dtype=bool)
    for p, place in enumerate(places):
        local = np.einsum("mij,mj->mi", inverse, place - corners[:, 0])
        barycentric = np.column_stack([1.0 - local.sum(axis=1), local])
        triangles[p] = barycentric.min(axis=1).argmax()
        weights[p] = barycentric[triangles[p]]
        inside[p] = weights[p].min() > -1e-9
    return SurfacePoints(triangles, weights), inside


def regular_points(model: ReducedModel, count: int) -> SurfacePoints:
    """About ``count`` surface points on a regular grid over the sheet, half a spacing off its edges."""
    low, high = sheet_bounds(model)
    size = high - low
    spacing = np.sqrt(size.prod() / count)
    columns, rows = np.maximum(np.rint(size / spacing).astype(int), 1)
    x = low[0] + (np.arange(columns) + 0.5) / columns * size[0]
    y = low[1] + (np.arange(rows) + 0.5) / rows * size[1]
    points, inside = locate_in_plane(model, np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2))
    return points.take(inside)


def landmark_nodes(model: ReducedModel) -> NDArray[np.int64]:
    """Mesh nodes (k,) nearest to the sheet's four corners, edge points and inner points, corners first."""
    low, high = sheet_bounds(model)
    edge = [(0, 0), (1, 0), (1, 1), (0, 1), (0.5, 0), (1, 0.5), (0.5, 1), (0, 0.5)]
    inner = [(0.5, 0.5), (0.25, 0.25), (0.75, 0.25), (0.75, 0.75), (0.25, 0.75)]
    candidates = np.unique(model.triangles)
    nodes = []
    for fraction in edge + inner:
        place = low + np.array(fraction) * (high - low)
        distance = np.linalg.norm(model.nodes[candidates, :2] - place, axis=1)
        nodes.append(candidates[distance.argmin()])
    return np.array(list(dict.fromkeys(nodes)), dtype=np.int64)
