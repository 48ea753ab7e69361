"""One view's texture carried by the mesh into another view, and how far patches of it are displaced there.

Pixels that the first view does not show, behind a fold of the object or beyond its rim, take no part. So a
patch at a fold or at the rim is measured by what both views show of it, whatever is in front or behind.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]

#: A pixel is hidden in the first view if it lies behind what is seen there by this part of its depth.
HIDDEN_BY = 0.01
#: Iterations of an alignment, the step at which it ends, and the farthest that a patch may go, pixels.
ITERATIONS, LAST_STEP, FARTHEST = 25, 2e-3, 8.0
#: At least this part of a patch must be seen in both views, and the gradients must be so different (the
#: determinant of their squares over the trace's square).
LEAST_SHARE, LEAST_STRUCTURE = 0.4, 1e-3


@njit(cache=True, nogil=True)
def _cubic(t, weights):
    """Catmull-Rom weights (4,) of the pixels around a place that is ``t`` beyond the second one."""
    weights[0] = t * (-0.5 + t * (1.0 - 0.5 * t))
    weights[1] = 1.0 + t * t * (1.5 * t - 2.5)
    weights[2] = t * (0.5 + t * (2.0 - 1.5 * t))
    weights[3] = t * t * (0.5 * t - 0.5)


@njit(cache=True, nogil=True)
def _sample(image, x, y, across, along):
    """Grey level at a place at least one pixel inside; ``across``, ``along`` (4,) are scratch."""
    x0, y0 = int(x), int(y)
    _cubic(x - x0, across)
    _cubic(y - y0, along)
    value = 0.0
    for j in range(4):
        line = 0.0
        for i in range(4):
            line += across[i] * image[y0 - 1 + j, x0 - 1 + i]
        value += along[j] * line
    return value


def _sample_numpy(image, x, y):
    """The plain twin of `_sample`, for places (p,)."""
    x0, y0 = x.astype(int), y.astype(int)
    across, along = np.empty((4, len(x))), np.empty((4, len(x)))
    _cubic.py_func(x - x0, across)
    _cubic.py_func(y - y0, along)
    grey = image.astype(float)
    around = [[grey[y0 + j - 1, x0 + i - 1] for i in range(4)] for j in range(4)]
    return np.einsum("jp,ip,jip->p", along, across, np.array(around))


@njit(cache=True, nogil=True)
def carry(triangle_ids, weights, triangles, coordinates, depths, depth, image, carried, shown):
    """Fill ``carried`` (h, w), and ``shown`` where the second view's pixels are seen in the first.

    Parameters
    ----------
    triangle_ids, weights : (h, w), (h, w, 3) of the second view's buffers. triangles : (m, 3).
    coordinates, depths : (n, 2), (n,) the nodes in the first view. depth, image : (h, w) of the first view.
    carried : (h, w) float32. shown : (h, w) bool.
    """
    height, width = triangle_ids.shape
    across, along = np.empty(4), np.empty(4)
    for row in range(height):
        for column in range(width):
            shown[row, column] = False
            t = triangle_ids[row, column]
            if t < 0:
                continue
            x, y, z = 0.0, 0.0, 0.0
            for corner in range(3):
                node, weight = triangles[t, corner], weights[row, column, corner]
                x += weight * coordinates[node, 0]
                y += weight * coordinates[node, 1]
                z += weight * depths[node]
            x0, y0 = int(np.floor(x)), int(np.floor(y))
            if x0 < 1 or y0 < 1 or x0 + 2 >= width or y0 + 2 >= height:
                continue
            around = depth[y0 : y0 + 2, x0 : x0 + 2]
            if z > around.min() * (1.0 + HIDDEN_BY) or z < around.max() * (1.0 - HIDDEN_BY):
                continue
            carried[row, column] = _sample(image, x, y, across, along)
            shown[row, column] = True


def carry_numpy(triangle_ids, weights, triangles, coordinates, depths, depth, image, carried, shown):
    """The plain twin of `carry`."""
    from scipy.ndimage import maximum_filter, minimum_filter

    rows, columns = np.nonzero(triangle_ids >= 0)
    corners, shares = triangles[triangle_ids[rows, columns]], weights[rows, columns]
    x, y = np.einsum("pc,pci->ip", shares, coordinates[corners])
    z = np.einsum("pc,pc->p", shares, depths[corners])
    x0, y0 = np.floor(x).astype(int), np.floor(y).astype(int)
    kept = (x0 >= 1) & (y0 >= 1) & (x0 + 2 < image.shape[1]) & (y0 + 2 < image.shape[0])
    rows, columns, x, y, z, x0, y0 = (part[kept] for part in (rows, columns, x, y, z, x0, y0))
    nearest = minimum_filter(depth, size=2, origin=-1)[y0, x0] * (1.0 + HIDDEN_BY)
    farthest = maximum_filter(depth, size=2, origin=-1)[y0, x0] * (1.0 - HIDDEN_BY)
    seen = (z <= nearest) & (z >= farthest)
    shown[:] = False
    shown[rows[seen], columns[seen]] = True
    carried[rows[seen], columns[seen]] = _sample_numpy(image, x[seen], y[seen])


@njit(cache=True, nogil=True)
def _patch(carried, shown, column, row, half, xs, ys, values, slopes):
    """Pixels of a patch that are shown with their neighbours, their values and gradients; how many."""
    height, width = carried.shape
    count = 0
    for y in range(max(row - half, 1), min(row + half + 1, height - 1)):
        for x in range(max(column - half, 1), min(column + half + 1, width - 1)):
            inner = shown[y, x] and shown[y, x - 1] and shown[y, x + 1] and shown[y - 1, x]
            if not (inner and shown[y + 1, x]):
                continue
            xs[count], ys[count], values[count] = x, y, carried[y, x]
            slopes[count, 0] = 0.5 * (carried[y, x + 1] - carried[y, x - 1])
            slopes[count, 1] = 0.5 * (carried[y + 1, x] - carried[y - 1, x])
            count += 1
    return count


@njit(cache=True, nogil=True)
def _sample_patch(image, xs, ys, x, y, count, seen):
    """Grey levels of a displaced patch into ``seen``; whether all of it is inside the image."""
    height, width = image.shape
    across, along = np.empty(4), np.empty(4)
    for i in range(count):
        u, v = xs[i] + x, ys[i] + y
        if u < 1.0 or v < 1.0 or u >= width - 2 or v >= height - 2:
            return False
        seen[i] = _sample(image, u, v, across, along)
    return True


@njit(cache=True, nogil=True)
def _align(image, xs, ys, values, slopes, count, seen):
    """Displacement and correlation of one patch, whose values and slopes have no mean."""
    a = b = c = power = 0.0
    for i in range(count):
        a += slopes[i, 0] * slopes[i, 0]
        b += slopes[i, 0] * slopes[i, 1]
        c += slopes[i, 1] * slopes[i, 1]
        power += values[i] * values[i]
    determinant = a * c - b * b
    if determinant <= LEAST_STRUCTURE * (a + c) ** 2 or power == 0.0:
        return 0.0, 0.0, -1.0
    x = y = 0.0
    for _ in range(ITERATIONS):
        if not _sample_patch(image, xs, ys, x, y, count, seen):
            break
        mean = seen[:count].mean()
        both = own = 0.0
        for i in range(count):
            both += values[i] * (seen[i] - mean)
            own += (seen[i] - mean) ** 2
        if both <= 0.0 or own == 0.0:
            break
        e = f = 0.0
        for i in range(count):
            left = values[i] - power / both * (seen[i] - mean)
            e += slopes[i, 0] * left
            f += slopes[i, 1] * left
        step_x, step_y = (c * e - b * f) / determinant, (a * f - b * e) / determinant
        x, y = x + step_x, y + step_y
        if max(abs(x), abs(y)) > FARTHEST:
            break
        if max(abs(step_x), abs(step_y)) < LAST_STEP:
            return x, y, both / np.sqrt(power * own)
    return x, y, -1.0


@njit(cache=True, nogil=True)
def align_patches(carried, shown, image, centres, half):
    """Displacements of patches from a carried image to the second view's own one, compiled.

    Gauss-Newton on the grey levels, whose mean and contrast are free (Evangelidis and Psarakis, Parametric
    image alignment using enhanced correlation coefficient maximization, 2008), over the shown pixels.

    Parameters
    ----------
    carried, shown : (h, w) of `carry`. image : (h, w) the second view. centres : (p, 2) pixels.
    half : patches are 2 half + 1 pixels wide.

    Returns
    -------
    (p, 2) displacements, and (p,) the correlations there; -1 where nothing could be measured.
    """
    side = (2 * half + 1) ** 2
    moves, alike = np.zeros((len(centres), 2)), np.full(len(centres), -1.0)
    xs, ys, values = np.empty(side), np.empty(side), np.empty(side)
    slopes, seen = np.empty((side, 2)), np.empty(side)
    for p in range(len(centres)):
        column, row = int(np.rint(centres[p, 0])), int(np.rint(centres[p, 1]))
        count = _patch(carried, shown, column, row, half, xs, ys, values, slopes)
        if count < LEAST_SHARE * side:
            continue
        values[:count] -= values[:count].mean()
        slopes[:count, 0] -= slopes[:count, 0].mean()
        slopes[:count, 1] -= slopes[:count, 1].mean()
        moves[p, 0], moves[p, 1], alike[p] = _align(image, xs, ys, values, slopes, count, seen)
    return moves, alike


def align_patches_numpy(carried, shown, image, centres, half):
    """The plain twin of `align_patches`."""
    from scipy.ndimage import binary_erosion, generate_binary_structure

    inner = binary_erosion(shown, generate_binary_structure(2, 1))
    down, right = np.gradient(carried.astype(float))
    moves, alike = np.zeros((len(centres), 2)), np.full(len(centres), -1.0)
    for p, centre in enumerate(np.rint(centres).astype(int)):
        rows, columns = np.mgrid[-half : half + 1, -half : half + 1].reshape(2, -1) + centre[::-1, None]
        inside = (rows >= 0) & (columns >= 0) & (rows < image.shape[0]) & (columns < image.shape[1])
        rows, columns = rows[inside], columns[inside]
        rows, columns = rows[inner[rows, columns]], columns[inner[rows, columns]]
        if len(rows) < LEAST_SHARE * (2 * half + 1) ** 2:
            continue
        values = carried[rows, columns] - carried[rows, columns].mean()
        slopes = np.column_stack([right[rows, columns], down[rows, columns]])
        slopes = slopes - slopes.mean(axis=0)
        for _ in range(ITERATIONS):
            seen = _sample_numpy(image, columns + moves[p, 0], rows + moves[p, 1])
            seen = seen - seen.mean()
            left = values - values @ values / (values @ seen) * seen
            step = np.linalg.solve(slopes.T @ slopes, slopes.T @ left)
            moves[p] += step
            if np.abs(step).max() < LAST_STEP:
                alike[p] = values @ seen / np.sqrt((values @ values) * (seen @ seen))
                break
    return moves, alike
