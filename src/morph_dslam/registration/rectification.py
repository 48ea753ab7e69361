"""Images of a rolling shutter, as a global one would have taken them at the instant of the middle row.

Between its first row and its last one, a moving camera stretches and shears what it sees: by up to two per cent at ten
pixels a frame, which a fit of edges or texture takes for another distance. Where each pixel goes depends on its depth,
which is that of the map points, or of the depth samples, around it.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from morph_dslam.camera import Camera
from morph_dslam.slam.rolling_shutter import after, row_times

Array = NDArray[np.float64]
#: The motion is found at every so many pixels, with the median inverse depth of so many points around.
CELL, NEIGHBOURS = 8, 5


def inverse_depths_at(pixels: Array, known_pixels: Array, known_depths: Array) -> Array:
    """Inverse depths (n,) at pixels (n, 2): the median of the nearest of some (k, 2) and (k,); 0, far away, of none."""
    ahead = known_depths > 0.0
    if not ahead.any():
        return np.zeros(len(pixels))
    nearest = KDTree(known_pixels[ahead]).query(pixels, k=min(NEIGHBOURS, int(ahead.sum())))[1]
    return np.median(1.0 / known_depths[ahead][np.asarray(nearest).reshape(len(pixels), -1)], axis=1)


def rectified_image(
    image: NDArray[np.uint8], camera: Camera, twist: Array, known_pixels: Array, known_depths: Array
) -> NDArray[np.uint8]:
    """An undistorted image (h, w) as of the middle row's instant.

    Parameters
    ----------
    image : as recorded row by row.
    camera : with its readout time.
    twist : (6,) the camera's velocity, as of `rolling_shutter.velocities`.
    known_pixels, known_depths : (k, 2), (k,) of points whose depth is known.
    """
    height, width = image.shape[:2]
    columns, rows = (CELL * np.arange(-(-side // CELL)) + 0.5 * (CELL - 1) for side in (width, height))
    centres = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)
    rays, inverse_depths = camera.rays(centres), inverse_depths_at(centres, known_pixels, known_depths)
    # A point is seen as if it were at depth 1 and the camera's shift divided by its depth.
    twists = np.column_stack([np.broadcast_to(twist[:3], rays.shape), inverse_depths[:, None] * twist[3:]])
    seen = centres
    for _ in range(2):  # The row that shows a point is not the one where it would be.
        seconds = camera.readout_s * row_times(camera.distort_pixels(seen)[:, 1], camera)
        seen = camera.project(after(rays, twists, seconds))
    coarse = (seen - centres).reshape(len(rows), len(columns), 2).astype(np.float32)
    fine = cv2.resize(coarse, (CELL * len(columns), CELL * len(rows)), interpolation=cv2.INTER_LINEAR)
    u, v = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    x, y = u + fine[:height, :width, 0], v + fine[:height, :width, 1]
    return np.asarray(cv2.remap(image, x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE), dtype=np.uint8)
