"""The compiled functions of `morph_dslam.tracking`, by numpy and scipy."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import map_coordinates

from morph_dslam.geometry import cross_matrix
from morph_dslam.render.rasteriser import rasterise
from morph_dslam.render.texture import render_textured
from morph_dslam.tracking.covariance import EIGENVALUE_FLOOR
from morph_dslam.tracking.estimator import MINIMUM_DEPTH, UNSEEN_COST
from morph_dslam.tracking.patches import LONGEST_STEP


def project_with_jacobian(functions, rotation, translation, rest, modes, intrinsics):
    fields = np.tensordot(functions, modes, axes=1)
    turned = (rest + fields[0]) @ rotation.T
    x, y, z = (turned + translation).T
    z = np.where(z < MINIMUM_DEPTH, np.nan, z)
    fx, fy, cx, cy = intrinsics
    pixels = np.column_stack([fx * x / z + cx, fy * y / z + cy])
    d = len(functions) - 1
    of_position = np.zeros((len(rest), 2, 3))
    of_position[:, 0, 0], of_position[:, 0, 2] = fx / z, -fx * x / z**2
    of_position[:, 1, 1], of_position[:, 1, 2] = fy / z, -fy * y / z**2
    of_unknowns = np.zeros((len(rest), 3, d + 6))
    of_unknowns[:, :, :d] = np.moveaxis(fields[1:] @ rotation.T, 0, 2)
    of_unknowns[:, :, d : d + 3] = -cross_matrix(turned)
    of_unknowns[:, :, d + 3 :] = np.eye(3)
    return pixels, of_position @ of_unknowns


def linearise(functions, rotation, translation, rest, modes, intrinsics, pixels, weights, normals, huber):
    projected, jacobian = project_with_jacobian(functions, rotation, translation, rest, modes, intrinsics)
    residuals = projected - pixels
    directed = (normals != 0.0).any(axis=1)
    onto = np.where(directed[:, None, None], normals[:, :, None] * normals[:, None, :], np.eye(2))
    residuals, jacobian = np.einsum("pab,pb->pa", onto, residuals), onto @ jacobian
    length = np.linalg.norm(residuals, axis=1)
    seen = np.isfinite(length)
    with np.errstate(divide="ignore", invalid="ignore"):
        outside = length > huber
        rho = np.where(outside, huber * (length - 0.5 * huber), 0.5 * length**2)
        factor = np.where(outside, weights * huber / length, weights)
    cost = np.sum(weights[seen] * rho[seen]) + UNSEEN_COST * weights[~seen].sum()
    used, r, w = jacobian[seen], residuals[seen], factor[seen]
    hessian = np.einsum("p,pca,pcb->ab", w, used, used, optimize=True)
    return cost, hessian, np.einsum("p,pca,pc->a", w, used, r, optimize=True), residuals


def linearise_depths(functions, rotation, translation, rest, modes, depths, weights, huber):
    fields = np.tensordot(functions, modes, axes=1)
    turned = (rest + fields[0]) @ rotation.T
    residuals = np.where(weights > 0.0, weights * (turned[:, 2] + translation[2] - depths), 0.0)
    zero = np.zeros(len(rest))
    slopes = weights[:, None] * np.column_stack(
        [(fields[1:] @ rotation[2]).T, turned[:, 1], -turned[:, 0], zero, zero, zero, zero + 1.0]
    )
    length = np.abs(residuals)
    outside = length > huber
    cost = np.sum(np.where(outside, huber * (length - 0.5 * huber), 0.5 * length**2))
    factor = np.where(outside, huber / np.maximum(length, 1e-300), 1.0)
    return cost, (slopes.T * factor) @ slopes, slopes.T @ (factor * residuals), residuals


def huber_covariance(hessian, residuals, weights, numbers, huber_px, scale):
    size, count = len(hessian), int(numbers.sum())
    freedom = count - size
    if freedom <= 0:
        return float("inf"), np.full((size, size), np.inf)
    length = np.linalg.norm(residuals, axis=1)
    pairs = (np.sqrt(weights) * length)[numbers == 2]
    sigma = float(np.median(pairs) / 1.1774 * np.sqrt(count / freedom)) if len(pairs) else float("inf")
    factor = np.minimum(1.0, huber_px / np.maximum(length, 1e-300))
    psi_squared = float(np.sum(weights * (factor * length) ** 2)) / freedom
    mean_slope = max(float(np.mean(0.5 * (factor + (length <= huber_px)))), 1e-3)
    eigenvalues, vectors = np.linalg.eigh(hessian * np.outer(scale, scale))
    floored = np.maximum(eigenvalues, max(eigenvalues[-1], 1e-30) * EIGENVALUE_FLOOR)
    variance = psi_squared * float(factor.mean()) / mean_slope**2
    return sigma, variance * ((vectors / floored) @ vectors.T) * np.outer(scale, scale)


def window_correlation(pixels, window):
    overlap = np.ones((len(pixels), len(pixels)))
    for column in pixels.T:
        overlap *= np.fmax(0.0, 1.0 - np.abs(column[:, None] - column[None]) / window)
    np.fill_diagonal(overlap, 1.0)
    return overlap


def _sampled(image, centre, half):
    """The patch (n, n) of an image about a point, bilinearly; None where it leaves the image."""
    limit = np.array(image.shape[::-1]) - 1
    if (centre - half < 0).any() or (centre + half >= limit).any():
        return None
    offsets = np.mgrid[-half : half + 1, -half : half + 1].astype(float)
    return map_coordinates(image.astype(float), centre[::-1, None, None] + offsets, order=1)


def _correlated(a, b):
    a, b = a - a.mean(), b - b.mean()
    squares = float((a * a).sum() * (b * b).sum())
    return float((a * b).sum()) / np.sqrt(squares) if squares > 1e-6 else 0.0


def patch_correlation(first, second, first_points, second_points, half):
    found = np.full(len(first_points), -1.0)
    for j, (p, q) in enumerate(zip(first_points, second_points, strict=True)):
        a, b = _sampled(first, p, half), _sampled(second, q, half)
        if a is not None and b is not None:
            found[j] = _correlated(a, b)
    return found


def compare_patches(first, second, first_points, second_points, half):
    """By least squares of all six unknowns at once."""
    count, n, inner = len(first_points), 2 * half + 1, slice(1, -1)
    places, correlation, spread = second_points.astype(float), np.full(count, -1.0), np.full(count, np.inf)
    y, x = np.mgrid[-half : half + 1, -half : half + 1].astype(float)
    for j, (p, q) in enumerate(zip(first_points, second_points, strict=True)):
        a, b = _sampled(first, p, half + 1), _sampled(second, q, half + 1)
        if a is None or b is None:
            continue
        down, right = (np.asarray(np.gradient(0.5 * (a + b), axis=k))[inner, inner] for k in (0, 1))
        a, b = a[inner, inner], b[inner, inner]
        correlation[j] = _correlated(a, b)
        rows = np.stack([-right, -down, np.ones_like(x), x, y, a - 128.0], axis=-1).reshape(-1, 6)
        solution, _, rank, _ = np.linalg.lstsq(rows, (b - a).ravel(), rcond=1e-10)
        if rank == 6 and np.linalg.norm(solution[:2]) < LONGEST_STEP:
            places[j] += solution[:2]
            ends = [slice(0, half), slice(n - half, n)]
            worst = max(np.var((b - a)[part, side]) for part in ends for side in ends)
            spread[j] = np.sqrt(0.5 * worst * np.trace(np.linalg.inv(rows.T @ rows)[:2, :2]))
    return places, correlation, spread


def search_outline(grey, pixels, normals, brightness, reach, side, least_contrast, tolerance):
    height, width = grey.shape
    steps = np.arange(-reach - side, reach + side + 1)
    result = np.full(len(pixels), np.nan)
    for j in np.flatnonzero(np.isfinite(pixels[:, 0]) & np.isfinite(brightness)):
        x, y = (pixels[j] + steps[:, None] * normals[j]).T
        if min(x.min(), y.min()) < 0.0 or x.max() >= width - 1 or y.max() >= height - 1:
            continue
        profile = map_coordinates(grey.astype(float), [y, x], order=1)
        windows = np.lib.stride_tricks.sliding_window_view(profile, 2 * side + 1)
        inner, outer = windows[:, :side].mean(axis=1), windows[:, side + 1 :].mean(axis=1)
        alike = np.abs(inner - brightness[j]) <= tolerance * brightness[j]
        scores = np.where(alike, np.abs(inner - outer), 0.0)
        best = int(np.argmax(scores))
        if scores[best] <= least_contrast or best in (0, 2 * reach):
            continue
        before, at, after = scores[best - 1 : best + 2]
        bend = before - 2.0 * at + after
        shift = 0.5 * (before - after) / bend if bend < 0.0 else 0.0
        result[j] = best - reach + np.clip(shift, -0.5, 0.5)
    return result


def draw_textured(pixels, depths, triangles, coordinates, texture, closed, image, depth):
    """In two passes."""
    buffers = rasterise(pixels, depths, triangles, *depth.shape, closed=closed)
    nearest = buffers.depth < depth
    corners = np.arange(3 * len(triangles)).reshape(-1, 3)
    image[nearest] = render_textured(buffers, corners, coordinates.reshape(-1, 2), texture)[nearest]
    depth[nearest] = buffers.depth[nearest]
