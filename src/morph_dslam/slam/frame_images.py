"""From a frame as recorded to what tracking and mapping work on, and the description of its points.

ORB descriptors are turned upright by each patch's intensity centroid (Rublee et al. 2011) and computed at several
scales, since the points did not come from ORB's detector, in the grey image: contrast normalization, by a window of
fixed size, makes the same surface look different from nearer or farther.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import cv2
import numpy as np
from numba import njit, types
from numba.extending import intrinsic
from numpy.typing import NDArray

from morph_dslam.camera import Camera, Rectification, StereoCamera
from morph_dslam.errors import CameraError
from morph_dslam.slam.options import LEAST_CORRELATION, PATCH_HALF
from morph_dslam.slam.pose import inside
from morph_dslam.slam.templates import Pyramid, image_pyramid
from morph_dslam.tracking.patches import follow, normalize_contrast, patch_correlation

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
Image = NDArray[np.uint8]
Descriptors = NDArray[np.uint8]
#: ORB's patch radius in pixels, and what it needs around a keypoint at the first scale.
PATCH_RADIUS, BORDER = 15, 32
SCALE_STEP = 1.2
#: Octaves that points are described at, for changes of scale between 0.6 and 1.6.
OCTAVES = (0, 2, 4)
#: Bits in a descriptor.
N_BITS = 256


@njit(cache=True, nogil=True)
def orientations(image, points):
    """Direction (n,), degrees, from each point (n, 2) to the centroid of grey of the disc around it."""
    result = np.empty(len(points))
    for j in range(len(points)):
        column, row = round(points[j, 0]), round(points[j, 1])
        along_x = along_y = 0
        for dy in range(-PATCH_RADIUS, PATCH_RADIUS + 1):
            half = int(np.sqrt(PATCH_RADIUS**2 - dy**2))
            for dx in range(-half, half + 1):
                grey = np.int64(image[row + dy, column + dx])
                along_x += dx * grey
                along_y += dy * grey
        result[j] = np.degrees(np.arctan2(float(along_y), float(along_x))) % 360.0
    return result


def describe(grey: Image, points: Array, octaves: tuple[int, ...]) -> tuple[Indices, Descriptors]:
    """ORB descriptors (k, 32) of points (n, 2), at several scales, and the row (k,) of each one's point."""
    whole = np.flatnonzero(inside(points, grey.shape, BORDER))
    if not len(whole):
        return np.empty(0, dtype=np.int64), np.empty((0, 32), dtype=np.uint8)
    angles = orientations(grey, points[whole])
    orb = cv2.ORB_create(nlevels=max(octaves) + 1, scaleFactor=SCALE_STEP)  # type: ignore[attr-defined]
    # OpenCV reorders keypoints and drops those too near the border at their scale: class_id says which stay.
    keypoints = [
        cv2.KeyPoint(x, y, 31.0 * SCALE_STEP**octave, angle, 1.0, octave, row)
        for octave in octaves
        for row, (x, y), angle in zip(whole.tolist(), points[whole].tolist(), angles.tolist(), strict=True)
    ]
    kept, described = orb.compute(grey, keypoints)
    if described is None:
        return np.empty(0, dtype=np.int64), np.empty((0, 32), dtype=np.uint8)
    return np.array([k.class_id for k in kept], dtype=np.int64), described


@intrinsic
def _ones(_context, word):
    """Bits that are set in a 64-bit word."""

    def generate(_context, builder, _signature, arguments):
        return builder.ctpop(arguments[0])

    return types.uint64(word), generate


@njit(cache=True, nogil=True)
def _least_distances(first, first_points, second, second_points, out):
    for i in range(len(first)):
        a, b, c, d = first[i, 0], first[i, 1], first[i, 2], first[i, 3]
        row = out[first_points[i]]
        for j in range(len(second)):
            distance = (
                _ones(a ^ second[j, 0])  # type: ignore[call-arg]
                + _ones(b ^ second[j, 1])  # type: ignore[call-arg]
                + _ones(c ^ second[j, 2])  # type: ignore[call-arg]
                + _ones(d ^ second[j, 3])  # type: ignore[call-arg]
            )
            point = second_points[j]
            row[point] = min(row[point], distance)


def least_distances(
    first: Descriptors, first_points: Indices, second: Descriptors, second_points: Indices
) -> NDArray[np.uint16]:
    """Least Hamming distance (a, b) between any descriptors of points 0..a-1 and of points 0..b-1.

    Parameters
    ----------
    first, second : (i, 32), (j, 32).
    first_points, second_points : (i,), (j,) whose each one is.
    """
    shape = (int(first_points.max(initial=-1)) + 1, int(second_points.max(initial=-1)) + 1)
    result = np.full(shape, N_BITS, dtype=np.uint16)
    words = [np.ascontiguousarray(d).view(np.uint64) for d in (first, second)]
    _least_distances(words[0], first_points, words[1], second_points, result)
    return result


def match_points(distances: NDArray[np.uint16], ratio: float, most: int) -> tuple[Indices, Indices]:
    """Rows and columns (k,) of distances (n, m) that are nearest to each other, nearer than ``most`` bits.

    Either's second best has to be further away by 1 / ``ratio``.
    """
    if min(distances.shape) < 2:
        return np.empty(0, dtype=np.int64), np.empty(0, dtype=np.int64)
    rows = np.arange(len(distances))
    columns = distances.argmin(axis=1)
    best = distances[rows, columns]
    clear = (best < most) & (distances[:, columns].argmin(axis=0) == rows)
    clear &= best < ratio * np.partition(distances, 1, axis=1)[:, 1]
    rows, columns, best = rows[clear], columns[clear], best[clear]
    kept = best < ratio * np.partition(distances[:, columns], 1, axis=0)[1]
    return rows[kept], columns[kept]


#: Largest disparity of stereo pairs, pixels; nearer points have no depth from one frame.
MOST_DISPARITY_PX = 128
#: Disparities of neighbouring pixels of a depth image that differ by more are an edge, pixels.
MOST_STEP = 1.5
#: How far a measured column may be from the expected one, pixels.
SEARCH_PX = 6
#: Half width of the patches compared along a row, and how much worse the second best place has to be.
ROW_HALF, ROW_CLEARNESS = 5, 1.25
#: A point's rows in both rectified images differ by less than this, pixels.
MOST_ROW_ERROR = 0.75
#: Every so many pixels in both directions a depth image is sampled for a keyframe.
SAMPLED = 8
#: Baseline, metres, that depth images are taken to have: structured light's noise is then half a pixel.
VIRTUAL_BASELINE = 0.08


class FrameDepth(Protocol):
    """What a frame knows of depth."""

    def right_columns(self, pixels: Array, expected: Array | None = None) -> Array:
        """Columns (n,) of pixels (n, 2) in the right image, NaN if not measured or not near ``expected``."""
        ...

    def at(self, pixels: Array) -> Array:
        """Depths (n,) of pixels (n, 2), metres, NaN where not measured, whatever the map expects."""
        ...

    def samples(self) -> NDArray[np.float32]:
        """Column, row and depth (m, 3), metres, of pixels spread over the image, where they are measured anyway."""
        ...


def depth_of(pixels: Array, right: Array, baseline_px: float) -> Array:
    """Depths (n,), metres, of pixels (n, 2) and their columns in the right image; NaN where not measured."""
    disparity = pixels[:, 0] - right
    return baseline_px / np.where(disparity > 0.0, disparity, np.nan)


@dataclass(frozen=True)
class DepthImage:
    """Depth (h, w), metres, of every pixel of the undistorted image; NaN where not measured."""

    depth: NDArray[np.float32]
    baseline_px: float

    def right_columns(self, pixels: Array, expected: Array | None = None) -> Array:
        """As `FrameDepth` says; between pixels the disparity is linear, as on a plane."""
        result = np.full(len(pixels), np.nan)
        height, width = self.depth.shape
        x, y = np.floor(pixels).astype(int).T
        rows = np.flatnonzero((x >= 0) & (y >= 0) & (x < width - 1) & (y < height - 1))
        x, y = x[rows], y[rows]
        around = np.stack([self.depth[y + j, x + i] for j in (0, 1) for i in (0, 1)]).astype(float)
        disparity = self.baseline_px / np.where(around > 0.0, around, np.nan)
        right, down = (pixels[rows] - np.column_stack([x, y])).T
        weights = np.stack([(1 - right) * (1 - down), right * (1 - down), (1 - right) * down, right * down])
        # At an edge, or next to a hole (NaN), the corner may belong to either side.
        smooth = disparity.max(axis=0) - disparity.min(axis=0) < MOST_STEP
        result[rows[smooth]] = (pixels[rows, 0] - (weights * disparity).sum(axis=0))[smooth]
        return _near(result, expected)

    def at(self, pixels: Array) -> Array:
        """As `FrameDepth` says, of the nearest pixel."""
        height, width = self.depth.shape
        columns, rows = np.rint(pixels).astype(int).T
        seen = (columns >= 0) & (rows >= 0) & (columns < width) & (rows < height)
        result = np.full(len(pixels), np.nan)
        result[seen] = self.depth[rows[seen], columns[seen]]
        return result

    def samples(self) -> NDArray[np.float32]:
        """As `FrameDepth` says; none next to edges and holes."""
        height, width = self.depth.shape
        row, column = np.mgrid[SAMPLED // 2 : height : SAMPLED, SAMPLED // 2 : width : SAMPLED]
        pixels = np.column_stack([column.ravel(), row.ravel()]).astype(float)
        depths = depth_of(pixels, self.right_columns(pixels), self.baseline_px)
        return np.column_stack([pixels, depths])[np.isfinite(depths)].astype(np.float32)


@dataclass(frozen=True)
class StereoImages:
    """Both contrast-normalized images (h, w) of a rectified pair."""

    left: Image
    right: Image
    baseline_px: float

    def right_columns(self, pixels: Array, expected: Array | None = None) -> Array:
        """As `FrameDepth` says: the place in the row that looks most alike, refined by Lucas-Kanade."""
        low, high = np.zeros(len(pixels)), np.full(len(pixels), float(MOST_DISPARITY_PX))
        if expected is not None:
            disparity = np.nan_to_num(pixels[:, 0] - expected)
            low, high = np.maximum(disparity - SEARCH_PX, 0.0), disparity + SEARCH_PX
        clearness = ROW_CLEARNESS if expected is None else 1.0
        rough = _row_disparities(self.left, self.right, pixels, low, high, ROW_HALF, clearness)
        result, rows = np.full(len(pixels), np.nan), np.flatnonzero(np.isfinite(rough))
        seen, guesses = pixels[rows], pixels[rows] - np.column_stack([rough[rows], np.zeros(len(rows))])
        found, good = follow(self.left, self.right, seen, guesses, 0)
        likeness = patch_correlation(self.left, self.right, seen, found, PATCH_HALF)
        good &= (likeness > LEAST_CORRELATION) & (np.abs(found[:, 1] - seen[:, 1]) < MOST_ROW_ERROR)
        result[rows[good]] = found[good, 0]
        return _near(result, expected)

    def at(self, pixels: Array) -> Array:
        """As `FrameDepth` says."""
        return depth_of(pixels, self.right_columns(pixels), self.baseline_px)

    def samples(self) -> NDArray[np.float32]:
        """None: each pixel would have to be searched."""
        return np.empty((0, 3), dtype=np.float32)


@dataclass(frozen=True)
class StereoDepth:
    """Depth at pixels of the undistorted left image, by both rectified images of a stereo pair.

    Right columns are those of a camera that stands beside the left one as the right one does, with its axes and its
    lens: map and poses are then of the left camera as users know it, and the rectified one stays in here.

    Attributes
    ----------
    left : the left camera
    rectification : of the pair
    images : both images, rectified
    baseline_px : focal length of the left camera times the baseline, px m
    """

    left: Camera
    rectification: Rectification
    images: StereoImages
    baseline_px: float

    def right_columns(self, pixels: Array, expected: Array | None = None) -> Array:
        """As `FrameDepth` says."""
        turned, per_disparity = self._rectified(pixels)
        if expected is not None:
            expected = turned[:, 0] - (pixels[:, 0] - expected) / per_disparity
        return pixels[:, 0] - per_disparity * (turned[:, 0] - self.images.right_columns(turned, expected))

    def at(self, pixels: Array) -> Array:
        """As `FrameDepth` says."""
        return depth_of(pixels, self.right_columns(pixels), self.baseline_px)

    def samples(self) -> NDArray[np.float32]:
        """As `FrameDepth` says: those of the rectified images."""
        return self.images.samples()

    def _rectified(self, pixels: Array) -> tuple[Array, Array]:
        """Rectified pixels (n, 2), and disparities (n,) of the left camera for one pixel of theirs.

        A depth is that of the rectified camera times the ray's depth in the left one, and goes by one over disparity.
        """
        rays = self.left.rays(pixels) @ self.rectification.rectified_from_left.T
        # Rays behind the rectified camera have no pixel there: any outside of the image gives no depth.
        turned = np.nan_to_num(self.rectification.camera.project(rays), nan=-1.0)
        return turned, self.baseline_px / self.images.baseline_px * rays[:, 2]


def _near(columns: Array, expected: Array | None) -> Array:
    if expected is None:
        return columns
    with np.errstate(invalid="ignore"):
        return np.where(np.abs(columns - expected) < SEARCH_PX, columns, np.nan)


@njit(cache=True, nogil=True)
def _row_disparities(left, right, pixels, low, high, half, clearness):
    """Whole disparities (n,) in [low, high] of the least sum of absolute differences; NaN if not clear."""
    height, width = left.shape
    result = np.full(len(pixels), np.nan)
    for n in range(len(pixels)):
        x, y = int(pixels[n, 0] + 0.5), int(pixels[n, 1] + 0.5)
        if x < half or y < half or x >= width - half or y >= height - half:
            continue
        first, last = int(low[n]), min(int(high[n]) + 1, x - half)
        costs = np.empty(max(last - first + 1, 0))
        best = -1
        for k in range(len(costs)):
            cost, shifted = 0, x - first - k
            for j in range(-half, half + 1):
                for i in range(-half, half + 1):
                    cost += abs(np.int64(left[y + j, x + i]) - np.int64(right[y + j, shifted + i]))
            costs[k] = cost
            if best < 0 or cost < costs[best]:
                best = k
        if best < 0:
            continue
        clear = True
        for k in range(len(costs)):
            if abs(k - best) > 2 and costs[k] <= clearness * costs[best]:
                clear = False
        if clear:
            result[n] = first + best
    return result


@dataclass(frozen=True)
class FrameView:
    """A frame.

    Attributes
    ----------
    grey : (h, w) undistorted.
    normalized : (h, w) the same contrast-normalized.
    depth : None where nothing measured it.
    """

    index: int
    timestamp: float
    grey: Image
    normalized: Image
    depth: FrameDepth | None = None

    @cached_property
    def pyramid(self) -> Pyramid:
        """The normalized image at several sizes."""
        return image_pyramid(self.normalized)


class FrameImages:
    """Prepares the frames of one camera, alone, with depth images, or in a stereo pair.

    Attributes
    ----------
    camera : of the undistorted images, the left ones of a stereo pair.
    baseline_px : of the depth (`RigidMap`), 0 without depth.

    Raises CameraError if a stereo pair is to have depth images too, or cannot be rectified.
    """

    def __init__(self, camera: Camera | StereoCamera, with_depth: bool = False) -> None:
        if isinstance(camera, StereoCamera):
            if with_depth:
                raise CameraError("a stereo pair measures depth itself: give one camera for depth images")
            self.camera, self._rectification, baseline = camera.left, camera.rectify(), camera.baseline
        else:
            self.camera, self._rectification = camera, None
            baseline = VIRTUAL_BASELINE if with_depth else 0.0
        self._maps = self.camera.undistortion_maps()
        self.baseline_px = self.camera.fx * baseline

    @property
    def is_stereo(self) -> bool:
        """Whether frames come in pairs."""
        return self._rectification is not None

    def undistort(self, image: Image) -> Image:
        """The image (h, w[, 3]) as ``camera`` would have seen it."""
        return self._remapped(image, self._maps)

    def prepare(
        self,
        image: Image,
        index: int,
        timestamp: float,
        depth: NDArray[np.float32] | None = None,
        right: Image | None = None,
    ) -> FrameView:
        """The view of a frame; depth or right images that the camera does not use are left aside.

        Raises CameraError if an image has not the camera's size.
        """
        grey = self._grey(image, f"frame {index}", self._maps)
        normalized = normalize_contrast(grey)
        return FrameView(index, timestamp, grey, normalized, self._depth(index, image, depth, right))

    def _depth(
        self, index: int, image: Image, depth: NDArray[np.float32] | None, right: Image | None
    ) -> FrameDepth | None:
        if not self.baseline_px:
            return None
        if self._rectification is not None:
            if right is None:
                return None
            found = self._rectification
            left = normalize_contrast(self._grey(image, f"frame {index}", found.left_maps))
            right = normalize_contrast(self._grey(right, f"the right image of frame {index}", found.right_maps))
            baseline_px = self.baseline_px * found.camera.fx / self.camera.fx
            return StereoDepth(self.camera, found, StereoImages(left, right, baseline_px), self.baseline_px)
        if depth is None:
            return None
        self.camera.check_image(depth, f"the depth image of frame {index}")
        # Depths on both sides of an edge must not be blended.
        depth = self.camera.undistort_unblended(depth, np.nan)
        return DepthImage(np.asarray(depth, dtype=np.float32), self.baseline_px)

    def _grey(self, image: Image, where: str, maps: tuple[NDArray, NDArray] | None) -> Image:
        self.camera.check_image(image, where)
        grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
        return self._remapped(np.asarray(grey, dtype=np.uint8), maps)

    @staticmethod
    def _remapped(image: Image, maps: tuple[NDArray, NDArray] | None) -> Image:
        if maps is None:
            return image
        return np.asarray(cv2.remap(image, *maps, cv2.INTER_LINEAR), dtype=np.uint8)
