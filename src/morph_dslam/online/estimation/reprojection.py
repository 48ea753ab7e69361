"""Reprojection error of surface points and its normal equations: the estimator's inner loop.

The unknowns are stacked as [parameters (d), rotation vector (3), translation (3)]; the pose increment acts on
the left, R <- exp(w) R and t <- t + v. The derivative of a pixel with respect to a parameter is the product
of the camera's, the pose's and the model's derivative (the paper's projected sensitivities).
"""

from __future__ import annotations

import numpy as np
from numba import njit

from morph_dslam.geometry import cross_matrix
from morph_dslam.model.separated import combine_modes

#: Points nearer to the camera plane than this, in metres, or behind it cannot be seen.
MINIMUM_DEPTH = 1e-3
#: Cost of a point that the state places behind the camera; large, so that such a step is refused.
UNSEEN_COST = 1e9


@njit(cache=True, nogil=True)
def _point_jacobian(jacobian, fields, j, rotation, turned, inverse_depth, x, y, intrinsics):
    """Fill the Jacobian (2, d + 6) of point ``j``: x, y are its normalised image coordinates."""
    d = fields.shape[0] - 1
    ax, ay = intrinsics[0] * inverse_depth, intrinsics[1] * inverse_depth
    for k in range(d):
        s0, s1, s2 = fields[k + 1, j, 0], fields[k + 1, j, 1], fields[k + 1, j, 2]
        vx = rotation[0, 0] * s0 + rotation[0, 1] * s1 + rotation[0, 2] * s2
        vy = rotation[1, 0] * s0 + rotation[1, 1] * s1 + rotation[1, 2] * s2
        vz = rotation[2, 0] * s0 + rotation[2, 1] * s1 + rotation[2, 2] * s2
        jacobian[0, k] = ax * (vx - x * vz)
        jacobian[1, k] = ay * (vy - y * vz)
    tx, ty, tz = turned[0], turned[1], turned[2]
    jacobian[0, d], jacobian[1, d] = -ax * x * ty, -ay * (tz + y * ty)
    jacobian[0, d + 1], jacobian[1, d + 1] = ax * (tz + x * tx), ay * y * tx
    jacobian[0, d + 2], jacobian[1, d + 2] = -ax * ty, ay * tx
    jacobian[0, d + 3], jacobian[1, d + 3] = ax, 0.0
    jacobian[0, d + 4], jacobian[1, d + 4] = 0.0, ay
    jacobian[0, d + 5], jacobian[1, d + 5] = -ax * x, -ay * y


@njit(cache=True, nogil=True)
def linearise(functions, rotation, translation, rest, modes, intrinsics, pixels, weights, normals, huber):
    """Huber cost of the reprojection error, its gradient and Gauss-Newton Hessian, compiled.

    Parameters
    ----------
    functions : (1 + d, m) values and derivatives of the parameter functions at the state, `Functions.rows`.
    rotation, translation : (3, 3) and (3,) of camera_from_object, metres.
    rest, modes : (p, 3) undeformed points and (m, p, 3) displacement modes at them, metres.
    intrinsics : (4,) fx, fy, cx, cy in pixels.
    pixels, weights : (p, 2) measurements in pixels and (p,) weights; points of weight 0 do not count.
    normals : (p, 2) unit vectors; a point with one counts only along it (a point of an outline, which may
        slide); (0, 0) for points that count in both directions.
    huber : residual length in pixels beyond which the cost grows linearly.

    Returns
    -------
    cost : sum of weight * rho(|r|), rho Huber's function.
    hessian, gradient : (d + 6, d + 6) and (d + 6,) of the cost, Gauss-Newton with Huber weights.
    residuals : (p, 2) projected minus measured, along the normal where there is one, pixels; NaN behind
        the camera.
    """
    n_points, d = rest.shape[0], functions.shape[0] - 1
    flat_modes = modes.reshape(modes.shape[0], 3 * n_points)
    fields = combine_modes(functions, flat_modes).reshape(1 + d, n_points, 3)
    size = d + 6
    hessian, gradient = np.zeros((size, size)), np.zeros(size)
    residuals, jacobian, turned = np.empty((n_points, 2)), np.zeros((2, size)), np.empty(3)
    cost = 0.0
    for j in range(n_points):
        p0, p1, p2 = rest[j, 0] + fields[0, j, 0], rest[j, 1] + fields[0, j, 1], rest[j, 2] + fields[0, j, 2]
        for c in range(3):
            turned[c] = rotation[c, 0] * p0 + rotation[c, 1] * p1 + rotation[c, 2] * p2
        depth = turned[2] + translation[2]
        if depth < MINIMUM_DEPTH:
            residuals[j] = np.nan
            cost += UNSEEN_COST * weights[j]
            continue
        x, y = (turned[0] + translation[0]) / depth, (turned[1] + translation[1]) / depth
        residuals[j, 0] = intrinsics[0] * x + intrinsics[2] - pixels[j, 0]
        residuals[j, 1] = intrinsics[1] * y + intrinsics[3] - pixels[j, 1]
        n0, n1 = normals[j, 0], normals[j, 1]
        directed = n0 != 0.0 or n1 != 0.0
        if directed:
            along = n0 * residuals[j, 0] + n1 * residuals[j, 1]
            residuals[j, 0], residuals[j, 1] = n0 * along, n1 * along
        if weights[j] == 0.0:
            continue
        length = np.hypot(residuals[j, 0], residuals[j, 1])
        weight = weights[j]
        if length <= huber:
            cost += weight * 0.5 * length * length
        else:
            cost += weight * huber * (length - 0.5 * huber)
            weight *= huber / length
        _point_jacobian(jacobian, fields, j, rotation, turned, 1.0 / depth, x, y, intrinsics)
        if directed:
            for a in range(size):
                slope = n0 * jacobian[0, a] + n1 * jacobian[1, a]
                jacobian[0, a], jacobian[1, a] = n0 * slope, n1 * slope
        for a in range(size):
            gradient[a] += weight * (jacobian[0, a] * residuals[j, 0] + jacobian[1, a] * residuals[j, 1])
            for b in range(a + 1):
                hessian[a, b] += weight * (jacobian[0, a] * jacobian[0, b] + jacobian[1, a] * jacobian[1, b])
    for a in range(size):
        for b in range(a):
            hessian[b, a] = hessian[a, b]
    return cost, hessian, gradient, residuals


@njit(cache=True, nogil=True)
def project_with_jacobian(functions, rotation, translation, rest, modes, intrinsics):
    """Pixels (p, 2) and their Jacobian (p, 2, d + 6), compiled; NaN behind the camera.

    The parameters are those of `linearise`.
    """
    n_points, d = rest.shape[0], functions.shape[0] - 1
    fields = combine_modes(functions, modes.reshape(modes.shape[0], 3 * n_points)).reshape(1 + d, n_points, 3)
    pixels, jacobian = np.full((n_points, 2), np.nan), np.full((n_points, 2, d + 6), np.nan)
    turned = np.empty(3)
    for j in range(n_points):
        for c in range(3):
            turned[c] = 0.0
            for k in range(3):
                turned[c] += rotation[c, k] * (rest[j, k] + fields[0, j, k])
        depth = turned[2] + translation[2]
        if depth < MINIMUM_DEPTH:
            continue
        x, y = (turned[0] + translation[0]) / depth, (turned[1] + translation[1]) / depth
        pixels[j, 0] = intrinsics[0] * x + intrinsics[2]
        pixels[j, 1] = intrinsics[1] * y + intrinsics[3]
        _point_jacobian(jacobian[j], fields, j, rotation, turned, 1.0 / depth, x, y, intrinsics)
    return pixels, jacobian


def project_with_jacobian_numpy(functions, rotation, translation, rest, modes, intrinsics):
    """The plain twin of `project_with_jacobian`."""
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


def linearise_numpy(
    functions, rotation, translation, rest, modes, intrinsics, pixels, weights, normals, huber
):
    """The plain twin of `linearise`."""
    projected, jacobian = project_with_jacobian_numpy(
        functions, rotation, translation, rest, modes, intrinsics
    )
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
    gradient = np.einsum("p,pca,pc->a", w, used, r, optimize=True)
    return cost, hessian, gradient, residuals
