"""The pinhole camera: projection, its derivative, and lens distortion.

Pixel (0, 0) is the centre of the first pixel. The camera looks along +z, x to the right, y down.
The online part works on undistorted images, so projection here is the ideal pinhole's;
`PinholeCamera.undistortion_maps` prepares the images.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from morph_dslam.errors import CameraError

Array = NDArray[np.float64]


@dataclass(frozen=True)
class PinholeCamera:
    """Intrinsics in pixels; ``distortion`` in OpenCV's order k1, k2, p1, p2[, k3], empty for none."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, ...] = ()

    @property
    def matrix(self) -> Array:
        """The intrinsic matrix (3, 3)."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    @property
    def intrinsics(self) -> Array:
        """fx, fy, cx, cy as an array (4,), the form that compiled loops take."""
        return np.array([self.fx, self.fy, self.cx, self.cy])

    def project(self, points: Array) -> Array:
        """Pixels (n, 2) of points (n, 3) in the camera frame, metres; NaN for points not in front."""
        depth = np.where(points[:, 2] > 0.0, points[:, 2], np.nan)
        return np.column_stack(
            [self.fx * points[:, 0] / depth + self.cx, self.fy * points[:, 1] / depth + self.cy]
        )

    def projection_jacobian(self, points: Array) -> Array:
        """Derivative (n, 2, 3) of `project` with respect to the points, pixels per metre."""
        x, y, z = points.T
        jacobian = np.zeros((len(points), 2, 3))
        jacobian[:, 0, 0] = self.fx / z
        jacobian[:, 0, 2] = -self.fx * x / z**2
        jacobian[:, 1, 1] = self.fy / z
        jacobian[:, 1, 2] = -self.fy * y / z**2
        return jacobian

    def rays(self, pixels: Array) -> Array:
        """Directions (n, 3) with z = 1 of undistorted pixels (n, 2)."""
        x = (pixels[:, 0] - self.cx) / self.fx
        y = (pixels[:, 1] - self.cy) / self.fy
        return np.column_stack([x, y, np.ones(len(pixels))])

    def undistort_pixels(self, pixels: Array) -> Array:
        """Pixels (n, 2) of the same points in the undistorted image."""
        if not self.distortion:
            return np.asarray(pixels, dtype=float)
        source = np.ascontiguousarray(pixels, dtype=np.float64).reshape(-1, 1, 2)
        coefficients = np.array(self.distortion)
        undistorted = cv2.undistortPoints(source, self.matrix, coefficients, P=self.matrix)
        return np.asarray(undistorted, dtype=np.float64).reshape(-1, 2)

    def undistortion_maps(self) -> tuple[NDArray, NDArray] | None:
        """Maps for `cv2.remap` that undistort an image, or None when there is nothing to undistort."""
        if not self.distortion:
            return None
        size = (self.width, self.height)
        coefficients = np.array(self.distortion)
        return cv2.initUndistortRectifyMap(
            self.matrix, coefficients, np.eye(3), self.matrix, size, cv2.CV_16SC2
        )

    def check_image(self, image: NDArray, where: str) -> None:
        """Raise CameraError unless ``image`` (height, width, ...) has the calibrated size."""
        height, width = image.shape[:2]
        if (width, height) != (self.width, self.height):
            raise CameraError(
                f"{where} is {width}x{height} pixels but the camera file is for {self.width}x{self.height}: "
                "use the calibration of this camera at this size, or resize the images"
            )
