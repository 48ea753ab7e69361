"""Small linear algebra in compiled loops: symmetric positive definite systems, and steps of a pose.

numba's `np.linalg` takes many seconds to compile; these few lines take one, and for the sizes of a local
bundle adjustment (some dozens of unknowns) run as fast.
"""

from __future__ import annotations

import numpy as np
from numba import njit

#: Pivots are kept above this part of their diagonal entry, so that a singular system still gives a step.
LEAST_PIVOT = 1e-14


@njit(cache=True, nogil=True)
def cholesky_solve(matrix, right):
    """The solution (n,) of a symmetric positive definite system; reads the lower half of ``matrix``."""
    n = len(right)
    factor, solution = np.zeros((n, n)), np.empty(n)
    for i in range(n):
        for j in range(i + 1):
            value = matrix[i, j]
            for k in range(j):
                value -= factor[i, k] * factor[j, k]
            if i == j:
                factor[i, i] = np.sqrt(max(value, LEAST_PIVOT * abs(matrix[i, i]) + 1e-300))
            else:
                factor[i, j] = value / factor[j, j]
    for i in range(n):
        value = right[i]
        for k in range(i):
            value -= factor[i, k] * solution[k]
        solution[i] = value / factor[i, i]
    for i in range(n - 1, -1, -1):
        value = solution[i]
        for k in range(i + 1, n):
            value -= factor[k, i] * solution[k]
        solution[i] = value / factor[i, i]
    return solution


@njit(cache=True, nogil=True)
def inverse_3x3(matrix, out):
    """The inverse of a symmetric (3, 3) matrix into ``out``, by cofactors."""
    a, b, c = matrix[0, 0], matrix[0, 1], matrix[0, 2]
    d, e, f = matrix[1, 1], matrix[1, 2], matrix[2, 2]
    out[0, 0], out[0, 1], out[0, 2] = d * f - e * e, c * e - b * f, b * e - c * d
    out[1, 1], out[1, 2], out[2, 2] = a * f - c * c, b * c - a * e, a * d - b * b
    determinant = a * out[0, 0] + b * out[0, 1] + c * out[0, 2]
    for i in range(3):
        for j in range(i, 3):
            out[i, j] /= determinant
            out[j, i] = out[i, j]


@njit(cache=True, nogil=True)
def turned_and_shifted(pose, rotation, shift, out):
    """``rotation`` (3, 3) times the rows of ``pose`` (4, 4), plus ``shift`` (3,), into ``out`` (4, 4)."""
    for i in range(3):
        for j in range(4):
            value = 0.0
            for k in range(3):
                value += rotation[i, k] * pose[k, j]
            out[i, j] = value
        out[i, 3] += shift[i]


def orthonormal(poses):
    """Rigid transforms (..., 4, 4) with the rotation nearest to what rounding has made of it.

    A prediction that multiplies poses by transposed ones would double what is off in every frame.
    """
    u, _, vt = np.linalg.svd(poses[..., :3, :3])
    result = poses.copy()
    result[..., :3, :3] = u @ vt
    return result
