"""Picking: which material point of a mesh a pixel sees, exactly.

A ray d meets the plane of the triangle A, B, C where w_A A + w_B B + w_C C is parallel to d. Cramer's rule
gives w_A : w_B : w_C = d·(B×C) : d·(C×A) : d·(A×B), and these, scaled to sum to one, are the barycentric
weights on the triangle in space: no image-plane weights and no pixel grid are involved.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from morph_dslam.model import SurfacePoints

Array = NDArray[np.float64]

#: Barycentric slack, so that a ray through a shared edge meets at least one of its triangles.
EDGE_TOLERANCE = 1e-9
#: Rays times triangles examined at once; bounds the memory to about 100 MB.
CHUNK = 2_000_000


def pick_surface(camera_points: Array, triangles: NDArray[np.int64], rays: Array) -> SurfacePoints:
    """The nearest surface point on each ray from the camera centre.

    Parameters
    ----------
    camera_points : (n, 3) mesh nodes in the camera frame, metres.
    triangles : (m, 3) node indices; both faces count, triangles that reach behind the camera do not.
    rays : (p, 3) directions in the camera frame.

    Returns
    -------
    SurfacePoints of length p; where a ray meets nothing, ``triangles`` is -1 and ``weights`` NaN.
    """
    found = np.full(len(rays), -1, dtype=np.int64)
    weights = np.full((len(rays), 3), np.nan)
    in_front = np.flatnonzero((camera_points[triangles, 2] > 0.0).all(axis=1))
    if not in_front.size:
        return SurfacePoints(found, weights)
    a, b, c = camera_points[triangles[in_front]].transpose(1, 0, 2)
    volume = np.einsum("mx,mx->m", a, np.cross(b, c))
    volume[volume == 0.0] = np.nan  # seen edge-on: NaN weights, which no comparison accepts
    dual = np.stack([np.cross(b, c), np.cross(c, a), np.cross(a, b)]) / volume[:, None]
    step = max(1, CHUNK // len(in_front))
    for start in range(0, len(rays), step):
        chosen = slice(start, start + step)
        found[chosen], weights[chosen] = _nearest(rays[chosen], dual, in_front)
    return SurfacePoints(found, weights)


def _nearest(rays: Array, dual: Array, triangle_ids: NDArray[np.int64]) -> tuple[NDArray[np.int64], Array]:
    scaled = np.einsum("px,cmx->cpm", rays, dual)
    inverse_range = scaled.sum(axis=0)  # 1 / (the multiple of the ray at which it meets the plane)
    hit = (scaled >= -EDGE_TOLERANCE * np.abs(inverse_range)).all(axis=0) & (inverse_range > 0.0)
    nearest = np.where(hit, inverse_range, -np.inf).argmax(axis=1)
    rows = np.arange(len(rays))
    met = hit[rows, nearest]
    found, weights = np.where(met, triangle_ids[nearest], -1), np.full((len(rays), 3), np.nan)
    inside = np.clip(scaled[:, rows[met], nearest[met]].T, 0.0, None)
    weights[met] = inside / inside.sum(axis=1, keepdims=True)
    return found, weights


def nearest_on_outline(
    camera_points: Array, node_pixels: Array, triangles: NDArray[np.int64], pixels: Array
) -> tuple[SurfacePoints, Array]:
    """The surface points whose image is nearest to pixels that the surface does not cover.

    The nearest point of the covered region lies on the image of an edge, so only edges are searched.

    Parameters
    ----------
    camera_points : (n, 3) mesh nodes in the camera frame. node_pixels : (n, 2) their pixels.
    triangles : (m, 3) node indices. pixels : (p, 2).

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
