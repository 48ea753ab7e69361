"""Reprojection error of surface points and its normal equations: the estimator's inner loop.

The unknowns are stacked as [parameters (d), rotation vector (3), translation (3)]; the pose increment acts on
the left, R <- exp(w) R and t <- t + v. The derivative of a pixel with respect to a parameter is the product
of the camera's, the pose's and the model's derivative (the paper's projected sensitivities).
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from morph_dslam.model.separated import combine_modes
from morph_dslam.row_products import FAST, row_products

#: Points nearer to the camera plane than this, in metres, or behind it cannot be seen.
MINIMUM_DEPTH = 1e-3
#: Cost of a point that the state places behind the camera; large, so that such a step is refused.
UNSEEN_COST = 1e9


def huber_weights(lengths: NDArray[np.float64], huber_px: float) -> NDArray[np.float64]:
    """Weights of residuals of these lengths by Huber's cost, which is linear from ``huber_px`` on."""
    return np.minimum(1.0, huber_px / np.maximum(lengths, 1e-12))


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
    residuals, turned, slopes = np.empty((n_points, 2)), np.empty((3, n_points)), np.zeros((2, 3, n_points))
    # By rows: the derivatives by each unknown and the residuals, all times the root of the weight; of all points one
    # coordinate after the other. Long rows are what the compiler vectorizes.
    rows, cost = np.zeros((size + 1, 2 * n_points)), 0.0
    for j in range(n_points):
        p0, p1, p2 = rest[j, 0] + fields[0, j, 0], rest[j, 1] + fields[0, j, 1], rest[j, 2] + fields[0, j, 2]
        for c in range(3):
            turned[c, j] = rotation[c, 0] * p0 + rotation[c, 1] * p1 + rotation[c, 2] * p2
        depth = turned[2, j] + translation[2]
        if depth < MINIMUM_DEPTH:
            residuals[j, 0] = residuals[j, 1] = np.nan
            cost += UNSEEN_COST * weights[j]
            continue
        x, y = (turned[0, j] + translation[0]) / depth, (turned[1, j] + translation[1]) / depth
        residuals[j, 0] = intrinsics[0] * x + intrinsics[2] - pixels[j, 0]
        residuals[j, 1] = intrinsics[1] * y + intrinsics[3] - pixels[j, 1]
        n0, n1 = normals[j, 0], normals[j, 1]
        directed = n0 != 0.0 or n1 != 0.0
        along = n0 * residuals[j, 0] + n1 * residuals[j, 1]
        if directed:
            residuals[j, 0], residuals[j, 1] = n0 * along, n1 * along
        if weights[j] == 0.0:
            continue
        length = np.sqrt(residuals[j, 0] ** 2 + residuals[j, 1] ** 2)
        weight = weights[j]
        if length <= huber:
            cost += weight * 0.5 * length * length
        else:
            cost += weight * huber * (length - 0.5 * huber)
            weight *= huber / length
        root = np.sqrt(weight)
        ax, ay = root * intrinsics[0] / depth, root * intrinsics[1] / depth
        if directed:
            slopes[0, 0, j], slopes[0, 1, j], slopes[0, 2, j] = n0 * ax, n1 * ay, -n0 * ax * x - n1 * ay * y
            rows[size, j] = root * along
        else:
            slopes[0, 0, j], slopes[0, 2, j] = ax, -ax * x
            slopes[1, 1, j], slopes[1, 2, j] = ay, -ay * y
            rows[size, j], rows[size, n_points + j] = root * residuals[j, 0], root * residuals[j, 1]
    _fill_derivatives(rows, fields, slopes, turned, rotation)
    products = products_of_rows(rows)
    hessian, gradient = np.empty((size, size)), np.empty(size)
    for a in range(size):
        gradient[a] = products[a, size]
        for b in range(size):
            hessian[a, b] = products[a, b]
    return cost, hessian, gradient, residuals


@njit(cache=True, nogil=True, fastmath=FAST)
def products_of_rows(rows):
    """``rows`` (n, m) times their transpose, (n, n), with the products added up in any order.

    Three rows times two at a pass.
    """
    n = len(rows)
    result = np.empty((n, n))
    for a in range(0, n, 3):
        # Rows that are not there are taken to be the last one, whose products are then written again.
        a1, a2 = min(a + 1, n - 1), min(a + 2, n - 1)
        for b in range(0, a2 + 1, 2):
            b1 = min(b + 1, n - 1)
            (result[a, b], result[a, b1], result[a1, b], result[a1, b1], result[a2, b], result[a2, b1]) = row_products(
                rows[a], rows[a1], rows[a2], rows[b], rows[b1]
            )
    for a in range(n):
        for b in range(a):
            result[b, a] = result[a, b]
    return result


@njit(cache=True, nogil=True, fastmath=FAST)
def _fill_derivatives(rows, fields, slopes, turned, rotation):
    """Fill the rows (d + 6, 2 p) of `linearise`.

    Parameters
    ----------
    fields : (1 + d, p, 3) displacements and their derivatives by the parameters.
    slopes : (2, 3, p) of what counts of each pixel by the point's place in the camera frame.
    turned : (3, p) points in the camera's axes about the object's origin.
    rotation : (3, 3) of camera_from_object.
    """
    d, n_points = fields.shape[0] - 1, turned.shape[1]
    own = np.empty((3, n_points))
    for which in range(2):
        begin, end = which * n_points, (which + 1) * n_points
        u, v, w = slopes[which, 0], slopes[which, 1], slopes[which, 2]
        for c in range(3):  # by the displacement in the object's axes
            for j in range(n_points):
                own[c, j] = rotation[0, c] * u[j] + rotation[1, c] * v[j] + rotation[2, c] * w[j]
        for k in range(d):
            line, field = rows[k, begin:end], fields[k + 1]
            for j in range(n_points):
                line[j] = own[0, j] * field[j, 0] + own[1, j] * field[j, 1] + own[2, j] * field[j, 2]
        tx, ty, tz = turned[0], turned[1], turned[2]
        about_x, about_y, about_z = rows[d, begin:end], rows[d + 1, begin:end], rows[d + 2, begin:end]
        right, down, ahead = rows[d + 3, begin:end], rows[d + 4, begin:end], rows[d + 5, begin:end]
        for j in range(n_points):
            about_x[j] = w[j] * ty[j] - v[j] * tz[j]
            about_y[j] = u[j] * tz[j] - w[j] * tx[j]
            about_z[j] = v[j] * tx[j] - u[j] * ty[j]
            right[j], down[j], ahead[j] = u[j], v[j], w[j]


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


@njit(cache=True, nogil=True)
def weighted_derivatives(functions, rotation, translation, rest, modes, intrinsics, residuals, weights, normals, huber):
    """Jacobian (p, 2, d + 6) by which an error of a pixel enters the gradient, and the Hessian (d + 6, d + 6).

    The first is Huber's factor times the root of the weight times the pixel's Jacobian, along its normal where it has
    one; zero where a point does not count. With them comes how errors (3, d + 6) enter the gradient that all points
    with normals have in common, of one pixel each: one outwards, and two along the axes of the image.

    Parameters
    ----------
    functions, rotation, translation, rest, modes, intrinsics, weights, normals, huber : as of `linearise`.
    residuals : (p, 2) of the estimate, pixels.
    """
    _, jacobian = project_with_jacobian(functions, rotation, translation, rest, modes, intrinsics)
    n_points, size = len(rest), jacobian.shape[2]
    rows, in_common = np.zeros((size, 2 * n_points)), np.zeros((3, size))
    for j in range(n_points):
        across, down = jacobian[j, 0], jacobian[j, 1]
        length = np.sqrt(residuals[j, 0] ** 2 + residuals[j, 1] ** 2)
        if not (weights[j] > 0.0 and np.isfinite(length)):
            for a in range(size):
                across[a] = down[a] = 0.0
            continue
        n0, n1 = normals[j, 0], normals[j, 1]
        factor = min(1.0, huber / max(length, 1e-300))
        if n0 != 0.0 or n1 != 0.0:
            for a in range(size):
                slope = n0 * across[a] + n1 * down[a]
                across[a], down[a] = n0 * slope, n1 * slope
                push = factor * weights[j] * slope
                in_common[0, a] += push
                in_common[1, a] += n0 * push
                in_common[2, a] += n1 * push
        root, scale = np.sqrt(factor * weights[j]), factor * np.sqrt(weights[j])
        for a in range(size):
            rows[a, j], rows[a, n_points + j] = root * across[a], root * down[a]
            across[a], down[a] = scale * across[a], scale * down[a]
    hessian = products_of_rows(rows)
    return jacobian, hessian, in_common
