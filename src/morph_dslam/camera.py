"""The camera: projection, its derivative, and the way between recorded and undistorted images.

Pixel (0, 0) is the centre of the first pixel. The camera looks along +z, x to the right, y down.
The online part works on undistorted images, whatever the lens, so `project` is the ideal pinhole's and
`undistortion_maps` prepares the images; `project_recorded` says where a point is in the image as recorded.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from morph_dslam.errors import CameraError
from morph_dslam.lens import Lens, LensModel, make_lens

Array = NDArray[np.float64]


@dataclass(frozen=True)
class PinholeCamera:
    """The intrinsics of a camera, in pixels, and its lens.

    Attributes
    ----------
    distortion : k1, k2, p1, p2[, k3[, k4, k5, k6]] of a radial-tangential lens, empty for none; k1, k2, k3,
        k4 of a fisheye (`morph_dslam.lens`).
    lens_model : "radial-tangential", or "fisheye" for the equidistant model.

    Raises
    ------
    CameraError
        If the lens model is unknown or takes another number of coefficients.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, ...] = ()
    lens_model: LensModel = "radial-tangential"

    def __post_init__(self) -> None:
        make_lens(self.lens_model, self.distortion)

    @cached_property
    def lens(self) -> Lens | None:
        """The lens, None where recorded images are the ideal pinhole's."""
        return make_lens(self.lens_model, self.distortion)

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

    def project_recorded(self, points: Array) -> Array:
        """Pixels (n, 2), in the image as recorded, of points (n, 3) in the camera frame; NaN where unseen."""
        if self.lens is None:
            return self.project(points)
        return self._pixels(self.lens.image(points))

    def recorded_jacobian(self, points: Array) -> Array:
        """Derivative (n, 2, 3) of `project_recorded` with respect to the points, pixels per metre."""
        if self.lens is None:
            return self.projection_jacobian(points)
        return self.lens.image_jacobian(points) * np.array([[self.fx], [self.fy]])

    def distort_pixels(self, pixels: Array) -> Array:
        """Pixels (n, 2), in the image as recorded, of the same points in the undistorted image."""
        return self.project_recorded(self.rays(np.asarray(pixels, dtype=float)))

    def undistort_pixels(self, pixels: Array) -> Array:
        """Pixels (n, 2), in the undistorted image, of the same points in the image as recorded.

        NaN where the lens images nothing that a pinhole could see.
        """
        pixels = np.asarray(pixels, dtype=float)
        if self.lens is None:
            return pixels
        return self._pixels(self.lens.ideal(self.rays(pixels)[:, :2]))

    def _pixels(self, image_points: Array) -> Array:
        """Pixels (n, 2) of image points (n, 2) at unit focal length."""
        return image_points * np.array([self.fx, self.fy]) + np.array([self.cx, self.cy])

    def undistortion_maps(self) -> tuple[NDArray, NDArray] | None:
        """Maps for `cv2.remap` that undistort an image, or None when there is nothing to undistort.

        The undistorted image has the size and the intrinsics of the recorded one.
        """
        if self.lens is None:
            return None
        rows, columns = np.mgrid[: self.height, : self.width]
        pixels = self.distort_pixels(np.column_stack([columns.ravel(), rows.ravel()]))
        maps = pixels.astype(np.float32).reshape(self.height, self.width, 2)
        return cv2.convertMaps(maps, None, cv2.CV_16SC2)  # type: ignore[call-overload]

    def check_image(self, image: NDArray, where: str) -> None:
        """Raise CameraError unless ``image`` (height, width, ...) has the calibrated size."""
        height, width = image.shape[:2]
        if (width, height) != (self.width, self.height):
            raise CameraError(
                f"{where} is {width}x{height} pixels but the camera file is for {self.width}x{self.height}: "
                "use the calibration of this camera at this size, or resize the images"
            )
