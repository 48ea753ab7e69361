"""What compiled loops do with small arrays.

numba has all of it as numpy's functions, but takes up to four seconds to compile one of them: with each come checks
whose messages compiled code puts together. These take a tenth.
"""

from __future__ import annotations

import numpy as np
from numba import njit

#: Pivots are kept above this part of their diagonal entry, so that a singular system still gives a step.
LEAST_PIVOT = 1e-14


@njit(cache=True, nogil=True)
def dot(a, b):
    """Scalar product of two vectors (3,)."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@njit(cache=True, nogil=True)
def cross(a, b):
    """The three numbers of the vector product of two vectors (3,)."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


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
def scaled(matrix, scale):
    """Entries (n, n) times the ``scale`` (n,) of their row and that of their column."""
    n = len(scale)
    result = np.empty((n, n))
    for a in range(n):
        for b in range(n):
            result[a, b] = matrix[a, b] * (scale[a] * scale[b])
    return result


@njit(cache=True, nogil=True)
def median(values):
    """Median of finite numbers (n,), at least one, by Hoare's FIND (Commun. ACM 4, 1961)."""
    left, middle = values.copy(), len(values) // 2
    low, high = 0, len(values) - 1
    while low < high:
        pivot, i, j = left[middle], low, high
        while i <= j:
            while left[i] < pivot:
                i += 1
            while pivot < left[j]:
                j -= 1
            if i <= j:
                left[i], left[j] = left[j], left[i]
                i, j = i + 1, j - 1
        if j < middle:
            low = i
        if middle < i:
            high = j
    if len(values) % 2:
        return left[middle]
    below = left[0]
    for k in range(1, middle):
        below = max(below, left[k])
    return 0.5 * (below + left[middle])
