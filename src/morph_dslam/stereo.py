"""Stereo pairs: two cameras that are fixed to each other, and the images that share their rows."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from morph_dslam.camera import PinholeCamera
from morph_dslam.errors import CameraError
from morph_dslam.geometry import RigidTransform

Array = NDArray[np.float64]


@dataclass(frozen=True)
class RectifiedPair:
    """Images in which a point has the same row, and disparity tells its depth.

    Attributes
    ----------
    camera : the ideal pinhole of both images. baseline : distance of the cameras, metres.
    rectified_from_left : rotation (3, 3) from the left camera's frame to the rectified one.
    left_maps, right_maps : for `cv2.remap`, from recorded images to rectified ones.
    """

    camera: PinholeCamera
    baseline: float
    rectified_from_left: Array
    left_maps: tuple[NDArray, NDArray]
    right_maps: tuple[NDArray, NDArray]

    def depth(self, disparity: Array) -> Array:
        """Depth, metres, of disparities, left minus right column, pixels; infinite where not positive."""
        positive = np.where(disparity > 0.0, disparity, np.nan)
        return np.where(disparity > 0.0, self.camera.fx * self.baseline / positive, np.inf)


@dataclass(frozen=True)
class StereoCamera:
    """Two cameras and the pose of the left one in the right one's frame, metres."""

    left: PinholeCamera
    right: PinholeCamera
    right_from_left: RigidTransform

    @property
    def baseline(self) -> float:
        """Distance between the centres of the cameras, metres."""
        return float(np.linalg.norm(self.right_from_left.translation))

    def rectify(self) -> RectifiedPair:
        """Turn both cameras until their rows coincide, by the smallest turns (Fusiello et al. 2000).

        Raises
        ------
        CameraError
            If the cameras differ in image size, stand in one place, or the right one is not to the right.
        """
        left, right = self.left, self.right
        if (left.width, left.height) != (right.width, right.height):
            raise CameraError(
                f"the left camera has {left.width}x{left.height} pixels, "
                f"the right one {right.width}x{right.height}: images of one size are needed"
            )
        rotation = self._rectified_from_left()
        focal = float(np.mean([*left.intrinsics[:2], *right.intrinsics[:2]]))
        centre = 0.5 * (left.intrinsics[2:] + right.intrinsics[2:])
        camera = PinholeCamera(left.width, left.height, focal, focal, float(centre[0]), float(centre[1]))
        rays = camera.rays(_pixel_grid(camera))
        left_rays = rays @ rotation
        right_rays = left_rays @ self.right_from_left.rotation.T
        return RectifiedPair(
            camera, self.baseline, rotation, _maps(left, left_rays), _maps(right, right_rays)
        )

    def _rectified_from_left(self) -> Array:
        """The rotation whose x axis points to the right camera and whose z axis is between both cameras'."""
        right_centre = self.right_from_left.inverse.translation
        if self.baseline < 1e-6:
            raise CameraError("both cameras of the stereo pair are in one place: check their calibration")
        x = right_centre / self.baseline
        if x[0] < 0.5:
            raise CameraError(
                "the second camera of the stereo pair is not to the right of the first: exchange them, or "
                "turn their images upright"
            )
        z = np.array([0.0, 0.0, 1.0]) + self.right_from_left.rotation[2]
        y = np.cross(z, x)
        y /= np.linalg.norm(y)
        return np.stack([x, y, np.cross(x, y)])


def _pixel_grid(camera: PinholeCamera) -> Array:
    rows, columns = np.mgrid[: camera.height, : camera.width]
    return np.column_stack([columns.ravel(), rows.ravel()]).astype(float)


def _maps(camera: PinholeCamera, rays: Array) -> tuple[NDArray, NDArray]:
    """Maps for `cv2.remap` that take each pixel from where the camera recorded its ray."""
    pixels = camera.project_recorded(rays).astype(np.float32).reshape(camera.height, camera.width, 2)
    return cv2.convertMaps(pixels, None, cv2.CV_16SC2)  # type: ignore[call-overload]
