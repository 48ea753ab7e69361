"""What rendering and evaluation compute in compiled loops, once more in NumPy."""

from __future__ import annotations

import numpy as np

from morph_dslam.model import SurfacePoints
from morph_dslam.render.picking import EDGE_TOLERANCE
from morph_dslam.render.rasteriser import LEAST_AREA, Buffers
from morph_dslam.render.texture import interpolate


def rasterise(pixels, depths, triangles, height, width, closed=False):
    buffers = Buffers(
        np.full((height, width), -1, dtype=np.int32),
        np.zeros((height, width, 3), dtype=np.float32),
        np.full((height, width), np.inf, dtype=np.float32),
    )
    for t, nodes in enumerate(triangles):
        corners, z = pixels[nodes], depths[nodes]
        if not (np.isfinite(corners).all() and (z > 0.0).all()):
            continue
        system = np.vstack([corners.T, np.ones(3)])
        area = np.linalg.det(system)
        if not abs(area) > LEAST_AREA or (closed and area >= 0.0):
            continue
        low = np.ceil(np.maximum(corners.min(axis=0), 0)).astype(int)
        high = np.floor(np.minimum(corners.max(axis=0), [width - 1, height - 1])).astype(int)
        rows, columns = np.mgrid[low[1] : high[1] + 1, low[0] : high[0] + 1]
        if rows.size == 0:
            continue
        window = (slice(low[1], high[1] + 1), slice(low[0], high[0] + 1))
        image_weights = np.tensordot(
            np.linalg.inv(system), np.stack([columns, rows, np.ones_like(rows)]).astype(float), axes=1
        )
        scaled = image_weights / z[:, None, None]
        with np.errstate(divide="ignore"):
            depth = 1.0 / scaled.sum(axis=0)
        seen = (image_weights >= -EDGE_TOLERANCE).all(axis=0) & (depth < buffers.depth[window])
        buffers.depth[window][seen] = depth[seen]
        buffers.triangle_ids[window][seen] = t
        buffers.weights[window][seen] = (scaled * depth).transpose(1, 2, 0)[seen]
    return buffers


def pick_surface(camera_points, triangles, rays):
    ahead = np.flatnonzero((camera_points[triangles, 2] > 0.0).all(axis=1))
    a, b, c = camera_points[triangles[ahead]].transpose(1, 0, 2)
    volume = np.einsum("mx,mx->m", a, np.cross(b, c))
    volume[volume == 0.0] = np.nan  # seen edge-on: NaN weights, which no comparison accepts
    dual = np.stack([np.cross(b, c), np.cross(c, a), np.cross(a, b)]) / volume[:, None]
    scaled = np.einsum("px,cmx->cpm", rays, dual)
    inverse_range = scaled.sum(axis=0)
    hit = (scaled >= -EDGE_TOLERANCE * np.abs(inverse_range)).all(axis=0) & (inverse_range > 0.0)
    nearest = np.where(hit, inverse_range, -np.inf).argmax(axis=1)
    rows = np.arange(len(rays))
    met = hit[rows, nearest]
    inside = np.clip(scaled[:, rows[met], nearest[met]].T, 0.0, None)
    weights = np.full((len(rays), 3), np.nan)
    weights[met] = inside / inside.sum(axis=1, keepdims=True)
    return SurfacePoints(np.where(met, ahead[nearest], -1), weights)


def render_textured(buffers, triangles, texture_coordinates, texture):
    last = np.array([texture.shape[1] - 1, texture.shape[0] - 1])
    place = np.clip(interpolate(buffers, triangles, texture_coordinates), 0, last)
    x0, y0 = place.astype(int).T
    x1, y1 = np.minimum(x0 + 1, last[0]), np.minimum(y0 + 1, last[1])
    shape = (-1,) + (1,) * (texture.ndim - 2)
    right, down = (place[:, 0] - x0).reshape(shape), (place[:, 1] - y0).reshape(shape)
    above = (1.0 - right) * texture[y0, x0] + right * texture[y0, x1]
    below = (1.0 - right) * texture[y1, x0] + right * texture[y1, x1]
    image = np.zeros(buffers.triangle_ids.shape + texture.shape[2:], dtype=np.uint8)
    image[buffers.covered] = ((1.0 - down) * above + down * below + 0.5).astype(np.uint8)
    return image


def blend_surface(image, triangle_ids, weights, triangles, levels, brightness, table, alpha):
    covered = triangle_ids >= 0
    corners = triangles[triangle_ids[covered]]
    level, light = (np.einsum("kc,kc->k", weights[covered], field[corners])[:, None] for field in (levels, brightness))
    entry = (np.clip(level[:, 0], 0.0, 255.0) + 0.5).astype(int)
    colour = np.minimum(light * table[entry], 255.0)
    image[covered] = ((1.0 - alpha) * image[covered] + alpha * colour + 0.5).astype(np.uint8)
