"""How well patches of two images agree, and where the second one is when light may have changed.

Lucas and Kanade's least squares take two patches to differ by motion alone. What shades one of them, such as
light on a bent surface, or the background that local contrast was measured against, moves their minimum by a
tenth of a pixel, the same way over wide parts of an object. So their result is corrected by one step with
gain, offset and slope of the brightness free (Jin, Favaro and Soatto, CVPR 2001, with the slopes of both
patches as in Benhimane and Malis, IROS 2004).
"""

from __future__ import annotations

import math

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from morph_dslam.row_products import FAST

Array = NDArray[np.float64]
#: A step longer than this, pixels, is no correction.
LONGEST_STEP = 1.0
#: Grey level of a pixel that equals its neighbourhood's mean.
NEUTRAL = 128

_F32 = np.float32


@njit(cache=True, nogil=True, fastmath=FAST)
def fill_patch(image, x, y, patch):
    """Fill a patch (n, n) with the image about it less `NEUTRAL`, its first pixel at (x, y), bilinearly."""
    size, x0, y0 = len(patch), int(x), int(y)
    right, down = _F32(x - x0), _F32(y - y0)
    left, up = _F32(1.0) - right, _F32(1.0) - down
    for row in range(size):
        # Slices, whose indices begin at zero, are what the compiler vectorizes.
        above, below = image[y0 + row, x0 : x0 + size + 1], image[y0 + row + 1, x0 : x0 + size + 1]
        line = patch[row]
        for column in range(size):
            first = left * _F32(above[column]) + right * _F32(above[column + 1])
            second = left * _F32(below[column]) + right * _F32(below[column + 1])
            line[column] = up * first + down * second - _F32(NEUTRAL)


@njit(cache=True, nogil=True)
def _both_patches(first, second, first_point, second_point, half, a, b):
    """Fill both patches (2 half + 1)² about two points; False where one leaves its image."""
    height, width = first.shape
    x, y = first_point[0] - half, first_point[1] - half
    u, v = second_point[0] - half, second_point[1] - half
    inside = min(x, y, u, v) >= 0.0
    inside &= max(x, u) + 2 * half < width - 1 and max(y, v) + 2 * half < height - 1
    if inside:
        fill_patch(first, x, y, a)
        fill_patch(second, u, v, b)
    return inside


@njit(cache=True, nogil=True, fastmath=FAST)
def _products(a, b, first_row, first_column, size):
    """Of parts (size, size) of two patches: sums of squares about their means, and of products."""
    sum_a = sum_b = aa = bb = ab = _F32(0.0)
    for row in range(first_row, first_row + size):
        ours, theirs = a[row, first_column : first_column + size], b[row, first_column : first_column + size]
        for column in range(size):
            p, q = ours[column], theirs[column]
            sum_a += p
            sum_b += q
            aa += p * p
            bb += q * q
            ab += p * q
    count = _F32(size * size)
    return aa - sum_a * sum_a / count, bb - sum_b * sum_b / count, ab - sum_a * sum_b / count


@njit(cache=True, nogil=True)
def patch_correlation(first, second, first_points, second_points, half):
    """How alike square patches of two images are.

    Parameters
    ----------
    first, second : (h, w) uint8
    first_points, second_points : (p, 2) patch centres in each.
    half : the patches are (2 half + 1) pixels wide.

    Returns
    -------
    (p,) normalised, in [-1, 1]; -1 where a patch leaves its image, 0 where one has no contrast.
    """
    correlation, size = np.full(len(first_points), -1.0), 2 * half + 1
    a, b = np.empty((size, size), _F32), np.empty((size, size), _F32)
    for j in range(len(first_points)):
        if _both_patches(first, second, first_points[j], second_points[j], half, a, b):
            aa, bb, ab = _products(a, b, 0, 0, size)
            correlation[j] = ab / np.sqrt(aa * bb) if aa * bb > 1e-6 else 0.0
    return correlation


@njit(cache=True, nogil=True)
def _worst_quarter(a, b, size):
    """The largest mean square difference of a quarter of two patches (size, size), framed by a pixel."""
    part, worst = size // 2, 0.0
    for corner in range(4):
        row = 1 if corner < 2 else 1 + size - part
        column = 1 if corner % 2 == 0 else 1 + size - part
        aa, bb, ab = _products(a, b, row, column, part)
        worst = max(worst, (aa + bb - 2.0 * ab) / float(part * part))
    return worst


@njit(cache=True, nogil=True, fastmath=FAST)
def _normal_equations(a, b, half, sums, products):
    """Sums over two patches, framed by a pixel, of what is to be fitted.

    Of four signals, the slopes to the right and down, the first patch, and the second less the first:
    ``sums`` (4, 3) of each times 1, x and y, and ``products`` (4, 4), the upper half.
    """
    size, quarter = 2 * half + 1, _F32(0.25)
    sums[:] = 0.0
    products[:] = 0.0
    for row in range(size):
        first, second, left, right = a[row + 1], b[row + 1], a[row + 1, 2:], b[row + 1, 2:]
        above, below, over, under = a[row], a[row + 2], b[row], b[row + 2]
        s0 = s1 = s2 = s3 = x0 = x1 = x2 = x3 = _F32(0.0)
        p00 = p01 = p02 = p03 = p11 = p12 = p13 = p22 = p23 = p33 = _F32(0.0)
        for column in range(size):
            grey = first[column + 1]
            across = quarter * (left[column] - first[column] + right[column] - second[column])
            along = quarter * (below[column + 1] - above[column + 1] + under[column + 1] - over[column + 1])
            change, x = second[column + 1] - grey, _F32(column - half)
            s0 += across
            s1 += along
            s2 += grey
            s3 += change
            x0 += across * x
            x1 += along * x
            x2 += grey * x
            x3 += change * x
            p00 += across * across
            p01 += across * along
            p02 += across * grey
            p03 += across * change
            p11 += along * along
            p12 += along * grey
            p13 += along * change
            p22 += grey * grey
            p23 += grey * change
            p33 += change * change
        y = float(row - half)
        for i, (total, moment) in enumerate(((s0, x0), (s1, x1), (s2, x2), (s3, x3))):
            sums[i, 0] += total
            sums[i, 1] += moment
            sums[i, 2] += total * y
        for j, product in enumerate((p00, p01, p02, p03)):
            products[0, j] += product
        for j, product in enumerate((p11, p12, p13)):
            products[1, j + 1] += product
        products[2, 2] += p22
        products[2, 3] += p23
        products[3, 3] += p33


@njit(cache=True, nogil=True)
def _step(sums, products, half, step):
    """The motion (2,) of the second patch, into ``step``; returns tr(G^-1) / 2, infinite if there is none.

    Offset and slope of the brightness, which are orthogonal over the window, then the gain, are taken out of
    all signals; what is left of the change is motion, with the normal matrix G.
    """
    size = 2 * half + 1
    count, moment = float(size * size), float(size) * half * (half + 1) * size / 3.0
    for i in range(4):
        for j in range(i, 4):
            products[i, j] -= sums[i, 0] * sums[j, 0] / count
            products[i, j] -= (sums[i, 1] * sums[j, 1] + sums[i, 2] * sums[j, 2]) / moment
    gain = products[2, 2]
    if gain > 1e-6:
        for i in range(2):
            for j in (0, 1, 3):
                if j >= i:
                    # The gain's own column is the lower half's: products[2, 3] stands for [3, 2].
                    other = products[2, 3] if j == 3 else products[j, 2]
                    products[i, j] -= products[i, 2] * other / gain
    xx, xy, yy = products[0, 0], products[0, 1], products[1, 1]
    determinant = xx * yy - xy * xy
    if not determinant > 1e-6 * (xx + yy) ** 2 + 1e-6:
        return np.inf
    step[0] = -(yy * products[0, 3] - xy * products[1, 3]) / determinant
    step[1] = -(xx * products[1, 3] - xy * products[0, 3]) / determinant
    if not step[0] ** 2 + step[1] ** 2 < LONGEST_STEP**2:
        return np.inf
    return 0.5 * (xx + yy) / determinant


@njit(cache=True, nogil=True)
def compare_patches(first, second, first_points, second_points, half):
    """Where patches of one image are in another, light apart, and how exactly that is known.

    What is left of the difference of the patches acts on the least squares like noise: with its mean square s
    and the normal matrix G of the motion, the covariance of the place is s G^-1 (Foerstner, Image matching,
    1993). The mean square is that of the quarter that differs most, about its means: what covers a corner of
    a patch, or a corner that looks past the object, then counts in full.

    Parameters
    ----------
    first, second : (h, w) grey levels, uint8 or float32
    first_points : (p, 2) patch centres in the first image.
    second_points : (p, 2) in the second, by motion alone
    half : the patches are (2 half + 1) pixels wide.

    Returns
    -------
    places : (p, 2) in the second image
    correlation : (p,) as of `patch_correlation`.
    spread : (p,) standard deviation of a coordinate, pixels; infinite where it is not determined.
    """
    count, size = len(first_points), 2 * half + 1
    places, correlation, spread = second_points.copy(), np.full(count, -1.0), np.full(count, np.inf)
    a, b = np.empty((size + 2, size + 2), _F32), np.empty((size + 2, size + 2), _F32)
    sums, products, step = np.empty((4, 3)), np.empty((4, 4)), np.empty(2)
    for j in range(count):
        if not _both_patches(first, second, first_points[j], second_points[j], half + 1, a, b):
            continue
        aa, bb, ab = _products(a, b, 1, 1, size)
        correlation[j] = ab / np.sqrt(aa * bb) if aa * bb > 1e-6 else 0.0
        _normal_equations(a, b, half, sums, products)
        inverse = _step(sums, products, half, step)
        if inverse < np.inf:
            places[j, 0], places[j, 1] = places[j, 0] + step[0], places[j, 1] + step[1]
            spread[j] = np.sqrt(_worst_quarter(a, b, size) * inverse)
    return places, correlation, spread


#: What is finer than this, pixels, is smoothed away where texture is distinguished from noise.
TEXTURE_SCALE_PX = 1.5
#: Lucas-Kanade's window, pixels, and pyramid levels above the image itself.
FLOW_WINDOW, LEVELS = 17, 3
#: Side of the square over whose mean contrast is normalized, pixels.
CONTRAST_WINDOW = 31


def normalize_contrast(grey: NDArray[np.uint8], window: int = CONTRAST_WINDOW) -> NDArray[np.uint8]:
    """Grey image (h, w) minus its mean over a square window, plus `NEUTRAL`; clipped to 0..255."""
    mean = cv2.boxFilter(grey, -1, (window, window), borderType=cv2.BORDER_REFLECT)
    return cv2.addWeighted(grey, 1.0, mean, -1.0, NEUTRAL)  # type: ignore[return-value]


def follow(
    source: NDArray[np.uint8], target: NDArray[np.uint8], points: Array, guesses: Array, levels: int = LEVELS
) -> tuple[Array, NDArray[np.bool_]]:
    """Follow points from one contrast-normalized image to another (Bouguet's pyramidal Lucas-Kanade).

    Parameters
    ----------
    points : (p, 2) in the source image, pixels
    guesses : (p, 2) where to start in the target.

    Returns
    -------
    (p, 2) positions in the target and (p,) which of them were found inside the image.
    """
    if not len(points):
        return np.empty((0, 2)), np.empty(0, dtype=bool)
    part = _part_around(np.concatenate([points, guesses]), source.shape, levels)
    corner = np.array([part[1].start, part[0].start], dtype=np.float64)
    found, status, _ = cv2.calcOpticalFlowPyrLK(
        source[part],
        target[part],
        (points - corner).astype(np.float32),
        (guesses - corner).astype(np.float32),
        winSize=(FLOW_WINDOW, FLOW_WINDOW),
        maxLevel=levels,
        criteria=(cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 20, 0.02),
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
    )
    return found.reshape(-1, 2).astype(np.float64) + corner, status.ravel() == 1


def _part_around(points: Array, shape: tuple[int, ...], levels: int) -> tuple[slice, slice]:
    """Rows and columns of an image that points (p, 2) are followed in: the pyramid of the rest is not needed.

    It begins where pixels of the coarsest level do, so that the levels are those of the whole image.
    """
    size, (left, top, right, bottom) = 1 << levels, _extent(points)
    reach = FLOW_WINDOW * size
    left, top = (int(max(least - reach, 0.0)) // size * size for least in (left, top))
    right, bottom = (min(math.ceil(most + reach) + 1, end) for most, end in ((right, shape[1]), (bottom, shape[0])))
    if left >= right or top >= bottom:  # nothing is in sight
        return slice(0, shape[0]), slice(0, shape[1])
    return slice(top, bottom), slice(left, right)


@njit(cache=True, nogil=True)
def _extent(points):
    """Least column and row, then largest, of points (p, 2); NaN counts as 0."""
    least, most = np.full(2, np.inf), np.full(2, -np.inf)
    for j in range(len(points)):
        for k in range(2):
            value = 0.0 if np.isnan(points[j, k]) else points[j, k]
            least[k], most[k] = min(least[k], value), max(most[k], value)
    return least[0], least[1], most[0], most[1]


@njit(cache=True, nogil=True)
def zero_where_unknown(numbers):
    """Numbers (p, k) with zero for NaN; numpy's own takes ten times as long for some hundred."""
    found = numbers.copy()
    for j in range(found.shape[0]):
        for k in range(found.shape[1]):
            if np.isnan(found[j, k]):
                found[j, k] = 0.0
    return found


def interior(covered: NDArray[np.bool_], margin: int) -> NDArray[np.uint8]:
    """Mask (h, w), 255 at pixels that the object covers at least ``margin`` pixels inside its outline."""
    kernel = np.ones((2 * margin + 1, 2 * margin + 1), np.uint8)
    padded = cv2.copyMakeBorder(covered.astype(np.uint8) * 255, 1, 1, 1, 1, cv2.BORDER_CONSTANT, value=0)
    return cv2.erode(padded, kernel)[1:-1, 1:-1]  # type: ignore[return-value]


#: Rows of an image whose corners are measured at once: for many rows, most of the time goes into getting new memory.
BAND = 96


@njit(cache=True, nogil=True)
def _local_maxima(strength, mask, quality):
    """Rows and columns (k, 2) inside the mask where no neighbour is stronger, nor the strongest by 1 / ``quality``."""
    height, width = strength.shape
    strongest = np.float32(0.0)
    for row in range(height):
        for column in range(width):
            if mask[row, column] > 0:
                strongest = max(strongest, strength[row, column])
    least = np.float32(quality) * strongest
    places, count = np.empty((height * width // 4 + 1, 2), np.int32), 0
    for row in range(1, height - 1):
        for column in range(1, width - 1):
            value = strength[row, column]
            if not value > least or mask[row, column] == 0:
                continue
            highest = True
            for i in range(-1, 2):
                for j in range(-1, 2):
                    highest &= strength[row + i, column + j] <= value
            if highest:
                places[count, 0], places[count, 1] = row, column
                count += 1
    return places[:count]


@njit(cache=True, nogil=True)
def _far_apart(places, distance, most, height, width):
    """Numbers of at most ``most`` of the places (k, 2), none nearer than a distance to one before it."""
    size = distance / math.sqrt(2.0)  # of cells that hold one place each
    taken = np.full((int(height / size) + 5, int(width / size) + 5), -1, np.int32)
    kept, count = np.empty(min(most, len(places)), np.int64), 0
    for k in range(len(places)):
        row, column = int(places[k, 0] / size) + 2, int(places[k, 1] / size) + 2
        free = True
        for i in range(row - 2, row + 3):
            for j in range(column - 2, column + 3):
                other = taken[i, j]
                if other >= 0:
                    far = (places[k, 0] - places[other, 0]) ** 2 + (places[k, 1] - places[other, 1]) ** 2
                    free &= far >= distance * distance
        if free:
            taken[row, column] = k
            kept[count] = k
            count += 1
            if count == most:
                break
    return kept[:count]


def strongest_corners(
    image: NDArray[np.uint8], mask: NDArray[np.uint8], most: int, quality: float, distance: float
) -> Array:
    """At most ``most`` corners (p, 2) inside the mask: those of OpenCV's `goodFeaturesToTrack`, in less time.

    Parameters
    ----------
    quality : part of the strongest one's strength that all others have at least.
    distance : between any two, at least one pixel.
    """
    height = len(image)
    strength = np.empty(image.shape, np.float32)
    for top in range(0, height, BAND):
        # Slopes and their mean reach two rows beyond a band.
        first, end = max(top - 2, 0), min(top + BAND, height)
        band = cv2.cornerMinEigenVal(image[first : min(end + 2, height)], 3)
        strength[top:end] = band[top - first : end - first]
    places = _local_maxima(strength, np.ascontiguousarray(mask), quality)[::-1]
    order = np.argsort(-strength[places[:, 0], places[:, 1]], kind="stable")
    places = np.ascontiguousarray(places[order])
    kept = _far_apart(places, float(distance), most, *image.shape)
    return places[kept][:, ::-1].astype(np.float64)


def spread_corners(normalized: NDArray[np.uint8], mask: NDArray[np.uint8], count: int) -> Array:
    """About ``count`` corners (p, 2) inside the mask, spread over it and the strongest of their surroundings.

    Shi and Tomasi's corners are taken in order of strength, at most as many from each cell of a grid as an
    even spread would put there, then the strongest of the rest until there are enough.
    """
    area = int(np.count_nonzero(mask))
    if area == 0:
        return np.empty((0, 2))
    spacing = np.sqrt(area / count)
    corners = strongest_corners(normalized, mask, 8 * count, 0.005, max(3.0, 0.4 * spacing))
    cells = (corners // (3.0 * spacing)).astype(int)
    share, taken = 9, {}
    first, rest = [], []
    for row, cell in enumerate(map(tuple, cells)):
        taken[cell] = taken.get(cell, 0) + 1
        (first if taken[cell] <= share else rest).append(row)
    return corners[(first + rest)[:count]]


def weaker_slope(normalized: NDArray[np.uint8], points: Array, window: int) -> Array:
    """Root mean square slope (p,), grey levels a pixel, of a smoothed image in the direction in which it varies least.

    Large on texture; on noise it is below a tenth of the noise's deviation, and on an edge or a shaded fold small.

    Parameters
    ----------
    points : (p, 2) pixels.
    window : side of the squares about them.
    """
    smooth = cv2.GaussianBlur(normalized.astype(np.float32), (0, 0), TEXTURE_SCALE_PX)
    x, y = (cv2.Sobel(smooth, cv2.CV_32F, *order) / 8.0 for order in ((1, 0), (0, 1)))
    columns, rows = np.rint(points).astype(int).reshape(-1, 2).T
    products = np.stack([x * x, x * y, y * y], axis=2, dtype=np.float32)
    xx, xy, yy = cv2.blur(products, (window, window))[rows, columns].T
    least = 0.5 * (xx + yy) - np.sqrt(0.25 * (xx - yy) ** 2 + xy**2)
    return np.sqrt(np.maximum(least, 0.0)).astype(np.float64)


def detect_orb(
    grey: NDArray[np.uint8], count: int, mask: NDArray[np.uint8] | None = None
) -> tuple[Array, NDArray[np.uint8]]:
    """Positions (k, 2) and descriptors (k, 32) of at most ``count`` ORB features (Rublee et al. 2011)."""
    keypoints, descriptors = cv2.ORB_create(nfeatures=count, fastThreshold=10).detectAndCompute(grey, mask)  # type: ignore[attr-defined]
    if descriptors is None:
        return np.empty((0, 2)), np.empty((0, 32), dtype=np.uint8)
    return np.array([k.pt for k in keypoints]), descriptors


#: Of two that match, the distance is at most this share of that to the next best one.
CLEARLY_NEARER = 0.85


def match_descriptors(
    first: NDArray[np.uint8], second: NDArray[np.uint8]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Rows (k,) of descriptors (n, 32) and (m, 32) that match: nearest both ways, clearly nearer than the second."""
    if len(first) < 2 or len(second) < 2:
        return np.empty(0, dtype=np.int64), np.empty(0, dtype=np.int64)
    matcher = cv2.BFMatcher(cv2.NORM_HAMMING)
    back = np.full(len(second), -1)
    for match in matcher.match(second, first):
        back[match.queryIdx] = match.trainIdx
    pairs = [
        (best.queryIdx, best.trainIdx)
        for best, runner_up in matcher.knnMatch(first, second, k=2)
        if best.distance < CLEARLY_NEARER * runner_up.distance and back[best.trainIdx] == best.queryIdx
    ]
    rows = np.array(pairs, dtype=np.int64).reshape(-1, 2)
    return rows[:, 0], rows[:, 1]
