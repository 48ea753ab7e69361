"""Picking: which material point of a mesh a pixel sees, exactly.

A ray d meets the plane of the triangle A, B, C where w_A A + w_B B + w_C C is parallel to d. Cramer's rule
gives w_A : w_B : w_C = d·(B×C) : d·(C×A) : d·(A×B), and these, scaled to sum to one, are the barycentric
weights on the triangle in space: no image-plane weights and no pixel grid are involved.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from morph_dslam.model import SurfacePoints

Array = NDArray[np.float64]
#: Barycentric slack, so that a ray through a shared edge meets at least one of its triangles.
EDGE_TOLERANCE = 1e-9


def pick_surface(camera_points: Array, triangles: NDArray[np.int64], rays: Array) -> SurfacePoints:
    """The nearest surface point on each ray from the camera centre.

    Each triangle is tried with the rays about it only, by where they meet the plane one unit before the camera.

    Parameters
    ----------
    camera_points : (n, 3) mesh nodes in the camera frame, metres.
    triangles : (m, 3) node indices; both faces count, triangles that reach behind the camera do not.
    rays : (p, 3) directions in the camera frame.

    Returns
    -------
    SurfacePoints of length p; where a ray meets nothing, ``triangles`` is -1 and ``weights`` NaN.
    """
    found, weights = np.full(len(rays), -1, dtype=np.int64), np.full((len(rays), 3), np.nan)
    corners = camera_points[triangles]
    a, b, c = corners.transpose(1, 0, 2)
    volumes = _dot(a, np.cross(b, c))
    # Rays ahead meet triangles ahead only; one whose volume is nought is seen edge-on.
    usable = np.flatnonzero((corners[:, :, 2] > 0.0).all(axis=1) & (volumes != 0.0))
    ahead = np.flatnonzero(np.isfinite(rays).all(axis=1) & (rays[:, 2] > 0.0))
    if not ahead.size or not usable.size:
        return SurfacePoints(found, weights)
    ray, triangle = _candidates(rays[ahead], corners[usable])
    ray, triangle = ahead[ray], usable[triangle]
    normals = (np.cross(b, c), np.cross(c, a), np.cross(a, b))
    scaled = np.column_stack([_dot(rays[ray], normal[triangle]) for normal in normals]) / volumes[triangle, None]
    # 1 / (the multiple of the ray at which it meets the plane)
    inverse_range = scaled.sum(axis=1)
    hits = np.flatnonzero((inverse_range > 0.0) & (scaled.min(axis=1) >= -EDGE_TOLERANCE * inverse_range))
    # The nearest triangle of each ray, and of equally near ones the first, is set last.
    hits = hits[np.lexsort([-triangle[hits], inverse_range[hits]])]
    found[ray[hits]] = triangle[hits]
    inside = np.maximum(scaled[hits], 0.0)
    weights[ray[hits]] = inside / inside.sum(axis=1, keepdims=True)
    return SurfacePoints(found, weights)


def _dot(a: Array, b: Array) -> Array:
    return a[:, 0] * b[:, 0] + a[:, 1] * b[:, 1] + a[:, 2] * b[:, 2]


def _candidates(rays: Array, corners: Array) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Pairs of a ray (p, 3) and a triangle (m, 3, 3) within whose circle it lies, both before the camera."""
    places, seen = rays[:, :2] / rays[:, 2:], corners[:, :, :2] / corners[:, :, 2:]
    centres = seen.mean(axis=1)
    radii = np.linalg.norm(seen - centres[:, None], axis=2).max(axis=1)
    about = KDTree(places).query_ball_point(centres, (1.0 + 1e-6) * radii + 1e-9)
    triangle = np.repeat(np.arange(len(corners)), [len(rows) for rows in about])
    return np.concatenate(about).astype(np.int64), triangle


def nearest_on_outline(
    camera_points: Array, node_pixels: Array, triangles: NDArray[np.int64], pixels: Array
) -> tuple[SurfacePoints, Array]:
    """The surface points whose image is nearest to pixels that the surface does not cover.

    The nearest point of the covered region lies on the image of an edge, so only edges are searched.

    Parameters
    ----------
    camera_points : (n, 3) mesh nodes in the camera frame.
    node_pixels : (n, 2) their pixels.
    triangles : (m, 3) node indices.
    pixels : (p, 2).

    Returns
    -------
    (points, distance): SurfacePoints of length p, and how far (p,) their images lie from ``pixels``, px.
    """
    starts = triangles.ravel()  # edge k of triangle t runs from corner k to corner k + 1
    ends = np.roll(triangles, -1, axis=1).ravel()
    along = node_pixels[ends] - node_pixels[starts]
    squared = np.maximum(np.einsum("ex,ex->e", along, along), 1e-300)
    edge, fraction, distance = (np.zeros(len(pixels), dtype=t) for t in (np.int64, float, float))
    for row, pixel in enumerate(pixels):
        offset = pixel - node_pixels[starts]
        t = np.clip(np.einsum("ex,ex->e", offset, along) / squared, 0.0, 1.0)
        gap = np.linalg.norm(offset - t[:, None] * along, axis=1)
        best = int(np.nanargmin(gap))
        edge[row], fraction[row], distance[row] = best, t[best], gap[best]
    near, far = camera_points[starts[edge], 2], camera_points[ends[edge], 2]
    # Inverse depth is linear in the image, so a fraction of the edge's image is another of the edge itself.
    fraction = fraction * near / ((1.0 - fraction) * far + fraction * near)
    weights = np.zeros((len(pixels), 3))
    rows, corner = np.arange(len(pixels)), edge % 3
    weights[rows, corner] = 1.0 - fraction
    weights[rows, (corner + 1) % 3] += fraction
    return SurfacePoints(edge // 3, weights), distance
