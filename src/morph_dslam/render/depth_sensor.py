"""A simulated depth camera: exact depth made noisy, coarse and incomplete, as structured light gives it."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from morph_dslam.render.scene_file import DepthSensor

#: 16-bit depth images hold this many values a metre, as those of the TUM RGB-D benchmark do.
VALUES_PER_METRE = 5000.0


def sensor_depth(
    depth: NDArray[np.float32], sensor: DepthSensor, seed: tuple[int, int]
) -> NDArray[np.uint16]:
    """The 16-bit image (h, w) that the sensor gives of exact depth (h, w) in metres; 0 is unknown.

    The standard deviation grows with the square of the distance, as that of triangulation does (Khoshelham
    and Elberink, Sensors 2012). Pixels at the rim of a surface have no depth. The same ``seed`` (scene,
    frame) gives the same noise.
    """
    known = np.isfinite(depth) & (depth <= sensor.range_mm * 1e-3) & ~_rim(depth, sensor)
    exact = np.where(known, depth, 0.0).astype(np.float64)
    noise = np.random.default_rng((*seed, 1)).standard_normal(depth.shape)
    measured = exact + noise * sensor.noise_mm_at_1m * 1e-3 * exact**2
    stored = np.rint(measured * VALUES_PER_METRE)
    return np.where(known & (stored > 0) & (stored < 65535), stored, 0).astype(np.uint16)


def _rim(depth: NDArray[np.float32], sensor: DepthSensor) -> NDArray[np.bool_]:
    """Pixels within ``rim_px`` of a jump in depth."""
    if sensor.rim_px == 0:
        return np.zeros(depth.shape, dtype=bool)
    filled = np.where(np.isfinite(depth), depth, np.float32(1e3))
    square = np.ones((3, 3), np.uint8)
    jump = cv2.dilate(filled, square) - cv2.erode(filled, square) > 0.03 * filled
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * sensor.rim_px + 1,) * 2)
    return cv2.dilate(jump.astype(np.uint8), disc).astype(bool)
