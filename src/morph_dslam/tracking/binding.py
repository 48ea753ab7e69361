"""Binding: which material points of the mesh belong to given positions or pixels, and which can be seen."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from morph_dslam.camera import Camera
from morph_dslam.model import ReducedModel, SurfacePoints
from morph_dslam.model.discrepancy import Discrepancy
from morph_dslam.render.picking import pick_surface
from morph_dslam.render.rasteriser import Buffers, rasterise
from morph_dslam.tracking.estimator import State

Array = NDArray[np.float64]


@dataclass(frozen=True)
class View:
    """The mesh as the camera sees it in one state.

    Attributes
    ----------
    nodes : (n, 3) in the camera frame, metres
    pixels : (n, 2), NaN behind the camera.
    """

    nodes: Array
    pixels: Array


@dataclass(frozen=True)
class Drawing:
    """The drawn surface in one state, as each pixel sees it.

    Attributes
    ----------
    state : of the object.
    view : of its drawn surface.
    triangle_ids : (h, w) int32, the nearest triangle, -1 where there is none.
    depth : (h, w) metres, infinite where the object is not.
    """

    state: State
    view: View
    triangle_ids: NDArray[np.int32]
    depth: NDArray[np.float32]


@dataclass(frozen=True)
class DrawnSurface:
    """What of a model is drawn.

    Attributes
    ----------
    model : with the nodes of the surface alone and the displacement there in single precision, which is as
        exact as the model file. Triangles keep their order.
    closed : whether the surface closes a volume, with its triangles anticlockwise seen from outside.
    """

    model: ReducedModel
    closed: bool

    @classmethod
    def of(cls, model: ReducedModel) -> DrawnSurface:
        """Leave out the nodes inside a solid; they are most of its nodes."""
        used, triangles = np.unique(model.triangles, return_inverse=True)
        triangles = triangles.reshape(model.triangles.shape)
        nodes = model.nodes[used]
        modes = model.displacement.modes[:, used].astype(np.float32, copy=False)
        drawn = replace(
            model,
            nodes=nodes,
            triangles=triangles,
            displacement=model.displacement.with_modes(modes),
            stresses={},
            cells={},
            strain=None,
            supports={},
            reactions={},
        )
        return cls(drawn, _closes_a_volume(nodes, triangles))


def _closes_a_volume(nodes: Array, triangles: NDArray[np.int64]) -> bool:
    """Whether every edge is run through once in each direction, and the volume inside is positive."""
    edges = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    there = np.sort(edges[:, 0] * len(nodes) + edges[:, 1])
    back = np.sort(edges[:, 1] * len(nodes) + edges[:, 0])
    if (there[1:] == there[:-1]).any() or not np.array_equal(there, back):
        return False
    a, b, c = (nodes[triangles[:, corner]] for corner in range(3))
    return float(np.einsum("mx,mx->", a, np.cross(b, c))) > 0.0


def view_of(model: ReducedModel, camera: Camera, state: State, discrepancy: Discrepancy | None = None) -> View:
    """Deform, place and project the mesh; with what its shape has beyond the model's, if that is known."""
    pose = state.camera_from_object
    nodes = model.displacement.placed(model.nodes, model.vector(state.parameters), pose.rotation, pose.translation)
    if discrepancy is not None:
        nodes = nodes + discrepancy.displacement(model.nodes) @ pose.rotation.T
    return View(nodes, camera.project(nodes))


def draw_view(view: View, triangles: NDArray[np.int64], camera: Camera) -> Buffers:
    """The z-buffer of the whole image, depths in metres; triangles (m, 3)."""
    return rasterise(view.pixels, view.nodes[:, 2], triangles, camera.height, camera.width)


def bind_pixels(
    model: ReducedModel, camera: Camera, view: View, pixels: Array
) -> tuple[SurfacePoints, NDArray[np.bool_]]:
    """Material points that pixels (p, 2) of the undistorted image see, and which pixels see any.

    Returns
    -------
    points : the material points of the pixels that meet the surface, in their order.
    met : (p,) bool.
    """
    points = pick_surface(view.nodes, model.triangles, camera.rays(pixels))
    met = points.triangles >= 0
    return points.take(met), met


def signed_areas(pixels: Array) -> Array:
    """Areas (m,) of triangles with corners ``pixels`` (m, 3, 2), positive where these run clockwise."""
    a, b, c = pixels[:, 0], pixels[:, 1], pixels[:, 2]
    with np.errstate(invalid="ignore"):
        return 0.5 * ((b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (c[:, 0] - a[:, 0]) * (b[:, 1] - a[:, 1]))


def facing(view: View, triangles: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Which triangles (m,) show the side on which their corners run clockwise in the image."""
    return signed_areas(view.pixels[triangles]) > 0.0


def foreshortening(view: View, triangles: NDArray[np.int64]) -> Array:
    """Area (m,) of triangles as seen, at one distance for all: least where the sight line runs along them."""
    return np.abs(signed_areas(view.pixels[triangles])) * view.nodes[triangles, 2].mean(axis=1) ** 2


def nearest_surface_points(nodes: Array, triangles: NDArray[np.int64], positions: Array) -> tuple[SurfacePoints, Array]:
    """The points of a triangle mesh nearest to positions.

    Parameters
    ----------
    nodes : (n, 3)
    triangles : (m, 3) node indices
    positions : (k, 3), same unit.

    Returns
    -------
    points : SurfacePoints of length k.
    distances : (k,) from the positions, same unit.
    """
    chosen, weights = np.zeros(len(positions), dtype=np.int64), np.zeros((len(positions), 3))
    distances = np.zeros(len(positions))
    corners = nodes[triangles]
    for row, position in enumerate(positions):
        candidates = nearest_in_triangles(corners, position)
        gaps = np.linalg.norm(np.einsum("mc,mcx->mx", candidates, corners) - position, axis=1)
        best = int(gaps.argmin())
        chosen[row], weights[row], distances[row] = best, candidates[best], gaps[best]
    return SurfacePoints(chosen, weights), distances


def nearest_in_triangles(corners: Array, position: Array) -> Array:
    """Barycentric weights (m, 3) of the point of every triangle (m, 3, 3) nearest to a position (3,), or to (m, 3)."""
    origin, u, v = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    offset = position - origin
    uu, uv, vv = (np.einsum("mx,mx->m", p, q) for p, q in ((u, u), (u, v), (v, v)))
    ou, ov = np.einsum("mx,mx->m", offset, u), np.einsum("mx,mx->m", offset, v)
    determinant = np.maximum(uu * vv - uv**2, 1e-300)
    b, c = (vv * ou - uv * ov) / determinant, (uu * ov - uv * ou) / determinant
    best = np.column_stack([1.0 - b - c, b, c])
    outside = (best < 0.0).any(axis=1)
    gap = np.where(outside, np.inf, 0.0)
    # Outside the triangle the nearest point lies on one of the three edges.
    for start, end in ((0, 1), (1, 2), (2, 0)):
        along = corners[:, end] - corners[:, start]
        from_start = position - corners[:, start]
        length = np.maximum(np.einsum("mx,mx->m", along, along), 1e-300)
        t = np.clip(np.einsum("mx,mx->m", from_start, along) / length, 0.0, 1.0)
        distance = np.linalg.norm(from_start - t[:, None] * along, axis=1)
        better = outside & (distance < gap)
        gap[better] = distance[better]
        best[better] = 0.0
        best[better, start], best[better, end] = 1.0 - t[better], t[better]
    return best
