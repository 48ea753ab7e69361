"""Depth residuals: how far surface points are from what a depth camera measured, and their normal equations.

The residual of a point is its depth along the optical axis minus the depth measured where it was seen, in
pixels by a weight (pixels per metre) that makes both kinds of measurement comparable: the standard deviation
of an image coordinate over that of the depth, which grows with the square of the distance (Khoshelham and
Elberink, Sensors 2012). Huber's cost is that of single numbers, so that a wrong depth spares the pixel.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from morph_dslam.camera import Camera
from morph_dslam.model.separated import combine_modes
from morph_dslam.tracking.reprojection import huber_weights
from morph_dslam.tracking.state import BoundPoints, State

Array = NDArray[np.float64]
#: Standard deviation of one pixel's depth at 1 m, metres; it grows with the distance squared.
SIGMA_AT_1M = 2.0e-3
#: Standard deviation of what all depths are off by together, a share: no residual shows it. Data sheets of depth
#: cameras allow twice as much (Intel RealSense D400: 2 % of the distance).
SCALE_STD = 0.01
#: Neighbours nearer than this, pixels, have the same error, as those of structured light have.
ALIKE_PX = 3
#: Side of the square of pixels through which a plane is laid.
DEPTH_WINDOW = 5
#: Depths in the square that differ by more than this share of the depth are of two surfaces.
LARGEST_STEP = 0.03
#: Residual in standard deviations where Huber's cost turns linear.
HUBER_SIGMAS = 2.0


@dataclass(frozen=True)
class PointDepths:
    """Depths measured where points were seen.

    Attributes
    ----------
    depths : (p,) along the optical axis, metres; of any value where the weight is 0.
    weights : (p,) pixels per metre, 0 where there is none.
    squared_px : variance of a residual in pixels
    huber_px : residual where the cost turns linear.
    """

    depths: Array
    weights: Array
    squared_px: float
    huber_px: float

    @classmethod
    def sampled(
        cls,
        image: NDArray[np.float32],
        pixels: Array,
        used: NDArray[np.bool_],
        camera: Camera,
        squared_px: float,
        sigma_at_1m: float = SIGMA_AT_1M,
    ) -> PointDepths:
        """From a depth image.

        Parameters
        ----------
        image : (h, w) as recorded, metres, NaN where unknown
        pixels : (p, 2) of the points in the undistorted image
        used : (p,) which of them count.
        squared_px : variance of an image coordinate in the estimator's cost, against which depth is weighed.
        """
        depths = np.full(len(pixels), np.nan)
        rows = np.flatnonzero(used & np.isfinite(pixels).all(axis=1))
        depths[rows] = _plane_depth(image, camera.distort_pixels(pixels[rows]))
        known = np.isfinite(depths)
        depths = np.where(known, depths, 1.0)
        sigma_px = float(np.sqrt(squared_px))
        weights = np.where(known, sigma_px / (sigma_at_1m * depths**2 * min(ALIKE_PX / DEPTH_WINDOW, 1.0)), 0.0)
        return cls(depths, weights, squared_px, HUBER_SIGMAS * sigma_px)

    @property
    def count(self) -> int:
        """How many points have depth."""
        return int((self.weights > 0.0).sum())

    def ratio_to(self, expected: Array) -> float | None:
        """Median of the measured depths as shares of others (p,), metres; None where none was measured."""
        rows = self.weights > 0.0
        return float(np.median(self.depths[rows] / expected[rows])) if rows.any() else None

    def variance_px(self, residuals: Array) -> float:
        """Variance of the residuals (p,): as taken for granted, or what they show if that is more."""
        bounded = np.clip(residuals, -self.huber_px, self.huber_px)
        return max(self.squared_px, float(np.sum(bounded**2)) / max(self.count, 1))

    def bounded(self, residuals: Array) -> Array:
        """Residuals (p,) whose squares are twice Huber's cost's weighted squares: large ones by their root."""
        return residuals * np.sqrt(huber_weights(np.abs(residuals), self.huber_px))

    def take(self, rows: NDArray[Any]) -> PointDepths:
        """Those of some points."""
        return PointDepths(self.depths[rows], self.weights[rows], self.squared_px, self.huber_px)

    def only(self, kept: NDArray[np.bool_]) -> PointDepths:
        """These, without what is not ``kept`` (p,)."""
        return PointDepths(self.depths, np.where(kept, self.weights, 0.0), self.squared_px, self.huber_px)

    def scaled(self, factor: float) -> PointDepths:
        """These, all of them so many times as far away, as a depth camera whose scale is off has them."""
        return PointDepths(self.depths * factor, self.weights, self.squared_px, self.huber_px)

    def off_by(self, further: Array) -> PointDepths:
        """These, each off by ``further`` (p,), a standard deviation in metres, beside its noise."""
        weights = self.weights / np.sqrt(1.0 + (self.weights * further) ** 2 / self.squared_px)
        return PointDepths(self.depths, weights, self.squared_px, self.huber_px)

    def padded(self, count: int) -> PointDepths:
        """These, followed by points without depth, ``count`` in all."""
        missing = np.zeros(count - len(self.depths))
        depths, weights = (np.concatenate([a, missing]) for a in (self.depths, self.weights))
        return PointDepths(depths, weights, self.squared_px, self.huber_px)

    def terms(self, points: BoundPoints, state: State) -> tuple[float, Array, Array, Array]:
        """Cost, Hessian (d + 6, d + 6), gradient and residuals (p,) in pixels at a state."""
        residuals, slopes = self.linearised(points, state)
        away, huber = np.abs(residuals), self.huber_px
        weighted = huber_weights(away, huber)[:, None] * slopes
        cost = float(np.sum(np.where(away > huber, huber * (away - 0.5 * huber), 0.5 * away**2)))
        return cost, weighted.T @ slopes, weighted.T @ residuals, residuals

    def linearised(self, points: BoundPoints, state: State) -> tuple[Array, Array]:
        """Residuals (p,) in pixels at a state, and their derivatives (p, d + 6); zero of points without depth."""
        return weighted_depths(*points.in_state(state), np.ascontiguousarray(self.depths), self.weights)


def _plane_depth(image: NDArray[np.float32], pixels: Array) -> Array:
    """Depths (p,) at pixels (p, 2): of the plane through the square about each that fits best.

    NaN at jumps, and where half of the square or more is unknown. A mean would be of another place where what
    is unknown lies to one side.
    """
    half, (height, width) = DEPTH_WINDOW // 2, image.shape
    places = np.nan_to_num(pixels, nan=-1.0)
    columns, rows = np.rint(places).astype(int).T
    inside = (columns >= half) & (rows >= half) & (columns < width - half) & (rows < height - half)
    columns, rows, places = columns[inside], rows[inside], places[inside]
    down, right = (grid.ravel() for grid in np.mgrid[-half : half + 1, -half : half + 1])
    values = image[rows[:, None] + down, columns[:, None] + right].astype(float)
    known = np.isfinite(values)
    values = np.where(known, values, 0.0)
    count = known.sum(axis=1)
    step = np.max(values, axis=1) - np.min(np.where(known, values, np.inf), axis=1)
    mean = values.sum(axis=1) / np.maximum(count, 1)
    whole = (2 * count > len(down)) & (step < LARGEST_STEP * mean)
    offsets = np.stack([columns[:, None] + right, rows[:, None] + down], axis=2) - places[:, None]
    design = known[:, :, None] * np.concatenate([np.ones_like(offsets[:, :, :1]), offsets], axis=2)
    normal = np.einsum("pwa,pwb->pab", design, design)
    normal[~whole] = np.eye(3)
    plane = np.linalg.solve(normal, np.einsum("pwa,pw->pa", design, values)[:, :, None])[:, 0, 0]
    result = np.full(len(pixels), np.nan)
    result[inside] = np.where(whole, plane, np.nan)
    return result


@njit(cache=True, nogil=True)
def weighted_depths(functions, rotation, translation, rest, modes, depths, weights):
    """Residuals of depths and their derivatives, compiled.

    Parameters
    ----------
    functions, rotation, translation, rest, modes : as in `reprojection.linearise`.
    depths, weights : (p,) measured, metres, and pixels per metre; points of weight 0 do not count.

    Returns
    -------
    residuals : (p,) weight * (depth of the point - measured depth), pixels, 0 without weight.
    slopes : (p, d + 6) of these.
    """
    n_points, d = rest.shape[0], functions.shape[0] - 1
    fields = combine_modes(functions, modes.reshape(modes.shape[0], 3 * n_points)).reshape(1 + d, n_points, 3)
    axis = rotation[2]
    residuals, slopes = np.zeros(n_points), np.zeros((n_points, d + 6))
    for j in range(n_points):
        if weights[j] == 0.0:
            continue
        p0, p1, p2 = rest[j, 0] + fields[0, j, 0], rest[j, 1] + fields[0, j, 1], rest[j, 2] + fields[0, j, 2]
        weight = weights[j]
        residuals[j] = weight * (axis[0] * p0 + axis[1] * p1 + axis[2] * p2 + translation[2] - depths[j])
        for k in range(d):
            s0, s1, s2 = fields[k + 1, j, 0], fields[k + 1, j, 1], fields[k + 1, j, 2]
            slopes[j, k] = weight * (axis[0] * s0 + axis[1] * s1 + axis[2] * s2)
        slopes[j, d] = weight * (rotation[1, 0] * p0 + rotation[1, 1] * p1 + rotation[1, 2] * p2)
        slopes[j, d + 1] = -weight * (rotation[0, 0] * p0 + rotation[0, 1] * p1 + rotation[0, 2] * p2)
        slopes[j, d + 5] = weight
    return residuals, slopes
