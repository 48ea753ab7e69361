"""Lens distortion: where a lens images a direction, and the direction that it images at a point.

Both models map points of the camera frame to the image plane at unit focal length; intrinsics then give
pixels. Coefficients and their order are OpenCV's.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar, Literal, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from morph_dslam.errors import CameraError
from morph_dslam.geometry import RigidTransform

Array = NDArray[np.float64]

LensModel = Literal["radial-tangential", "fisheye"]

#: Newton stops when the image point is met to this distance at unit focal length, 1e-7 px at 1000 px.
TOLERANCE = 1e-10

MOST_ITERATIONS = 50


class Lens(Protocol):
    """What every lens model offers."""

    def image(self, points: Array) -> Array:
        """Image points (n, 2) at unit focal length of points (n, 3) in the camera frame; NaN where unseen."""
        ...

    def image_jacobian(self, points: Array) -> Array:
        """Derivative (n, 2, 3) of `image` with respect to the points, per metre."""
        ...

    def ideal(self, image_points: Array) -> Array:
        """Pinhole image points (n, 2) at unit focal length of the recorded ones (n, 2).

        NaN where no direction within a right angle of the axis is imaged, or only one beyond the angle at
        which the distortion folds the image over, where coefficients mean nothing.
        """
        ...


@dataclass(frozen=True)
class RadialTangential:
    """Brown's radial and tangential distortion (Brown 1966) with OpenCV's rational extension.

    Attributes
    ----------
    coefficients : k1, k2, p1, p2[, k3[, k4, k5, k6]].
    """

    coefficients: tuple[float, ...]
    counts: ClassVar[tuple[int, ...]] = (4, 5, 8)

    def _padded(self) -> tuple[float, ...]:
        return (*self.coefficients, *([0.0] * (8 - len(self.coefficients))))

    def image(self, points: Array) -> Array:
        """See `Lens`; points that are not in front have no image."""
        k1, k2, p1, p2, k3, k4, k5, k6 = self._padded()
        depth = np.where(points[:, 2] > 0.0, points[:, 2], np.nan)
        x, y = points[:, 0] / depth, points[:, 1] / depth
        s = x * x + y * y
        radial = (1.0 + s * (k1 + s * (k2 + s * k3))) / (1.0 + s * (k4 + s * (k5 + s * k6)))
        return np.column_stack(
            [
                x * radial + 2.0 * p1 * x * y + p2 * (s + 2.0 * x * x),
                y * radial + p1 * (s + 2.0 * y * y) + 2.0 * p2 * x * y,
            ]
        )

    def image_jacobian(self, points: Array) -> Array:
        """See `Lens`."""
        k1, k2, p1, p2, k3, k4, k5, k6 = self._padded()
        z = points[:, 2]
        x, y = points[:, 0] / z, points[:, 1] / z
        s = x * x + y * y
        above, below = 1.0 + s * (k1 + s * (k2 + s * k3)), 1.0 + s * (k4 + s * (k5 + s * k6))
        radial = above / below
        slope = (k1 + s * (2.0 * k2 + 3.0 * s * k3) - radial * (k4 + s * (2.0 * k5 + 3.0 * s * k6))) / below
        plane = np.empty((len(points), 2, 2))
        plane[:, 0, 0] = radial + 2.0 * x * x * slope + 2.0 * p1 * y + 6.0 * p2 * x
        plane[:, 0, 1] = 2.0 * x * y * slope + 2.0 * p1 * x + 2.0 * p2 * y
        plane[:, 1, 0] = plane[:, 0, 1]
        plane[:, 1, 1] = radial + 2.0 * y * y * slope + 6.0 * p1 * y + 2.0 * p2 * x
        result = np.empty((len(points), 2, 3))
        result[:, :, :2] = plane / z[:, None, None]
        result[:, :, 2] = -np.einsum("nij,nj->ni", plane, np.column_stack([x, y])) / z[:, None]
        return result

    def ideal(self, image_points: Array) -> Array:
        """See `Lens`; by Newton's method from the recorded points."""
        points = np.column_stack([image_points, np.ones(len(image_points))]).astype(float)
        with np.errstate(all="ignore"):
            for _ in range(MOST_ITERATIONS):
                residual = self.image(points) - image_points
                if not (np.abs(residual) > TOLERANCE).any():
                    break
                points[:, :2] -= _solve(self.image_jacobian(points)[:, :, :2], residual)
            missed = np.abs(self.image(points) - image_points).max(axis=1)
            plane = self.image_jacobian(points)[:, :, :2]
            determinant, trace = np.linalg.det(plane), np.trace(plane, axis1=1, axis2=2)
            # A negative determinant or trace: a solution on the far side of the fold.
            good = (missed <= 1e3 * TOLERANCE) & (determinant > 0.0) & (trace > 0.0)
        return np.where(good[:, None], points[:, :2], np.nan)


@dataclass(frozen=True)
class Equidistant:
    """The fisheye of Kannala and Brandt (2006): the angle from the axis, corrected, is the image radius.

    It images directions of more than a right angle from the axis as well.

    Attributes
    ----------
    coefficients : k1, k2, k3, k4 of angle * (1 + k1 angle^2 + k2 angle^4 + k3 angle^6 + k4 angle^8).
    """

    coefficients: tuple[float, ...]
    counts: ClassVar[tuple[int, ...]] = (4,)

    def _radius(self, angle: Array) -> tuple[Array, Array]:
        """Image radius (n,) and its derivative by the angle (n,)."""
        k1, k2, k3, k4 = self.coefficients
        s = angle * angle
        radius = angle * (1.0 + s * (k1 + s * (k2 + s * (k3 + s * k4))))
        return radius, 1.0 + s * (3.0 * k1 + s * (5.0 * k2 + s * (7.0 * k3 + s * 9.0 * k4)))

    def image(self, points: Array) -> Array:
        """See `Lens`."""
        x, y, z = points.T
        distance = np.hypot(x, y)
        radius, _ = self._radius(np.arctan2(distance, z))
        with np.errstate(divide="ignore", invalid="ignore"):
            # On the axis the image is the pinhole's; behind the camera on the axis there is none.
            scale = np.where(distance > 0.0, radius / distance, np.where(z > 0.0, 1.0 / z, np.nan))
        return np.column_stack([scale * x, scale * y])

    def image_jacobian(self, points: Array) -> Array:
        """See `Lens`."""
        x, y, z = points.T
        # The limit on the axis is smooth; this distance is far below what float64 resolves of the result.
        distance = np.maximum(np.hypot(x, y), 1e-9 * np.abs(z))
        squared = distance**2 + z**2
        radius, slope = self._radius(np.arctan2(distance, z))
        along, across = slope * z / squared, radius / distance
        cosine, sine = x / distance, y / distance
        result = np.empty((len(points), 2, 3))
        result[:, 0, 0] = along * cosine**2 + across * sine**2
        result[:, 0, 1] = result[:, 1, 0] = (along - across) * cosine * sine
        result[:, 1, 1] = along * sine**2 + across * cosine**2
        result[:, 0, 2] = -slope * distance / squared * cosine
        result[:, 1, 2] = -slope * distance / squared * sine
        on_axis = (x == 0.0) & (y == 0.0)
        result[on_axis, 0, 0] = result[on_axis, 1, 1] = 1.0 / z[on_axis]
        return result

    def ideal(self, image_points: Array) -> Array:
        """See `Lens`; by Newton's method for the angle, as OpenCV does."""
        distance = np.linalg.norm(image_points, axis=1)
        angle = np.minimum(distance, 0.5 * np.pi)
        with np.errstate(all="ignore"):
            for _ in range(MOST_ITERATIONS):
                radius, slope = self._radius(angle)
                if not (np.abs(radius - distance) > TOLERANCE).any():
                    break
                angle = angle - (radius - distance) / slope
            radius, slope = self._radius(angle)
            good = (np.abs(radius - distance) <= 1e3 * TOLERANCE) & (slope > 0.0)
            good &= (angle >= 0.0) & (angle < 0.5 * np.pi)
            scale = np.where(distance > 0.0, np.tan(angle) / distance, 1.0)
        return np.where(good[:, None], scale[:, None] * image_points, np.nan)


LENSES: dict[LensModel, type[RadialTangential] | type[Equidistant]] = {
    "radial-tangential": RadialTangential,
    "fisheye": Equidistant,
}


def make_lens(model: LensModel, coefficients: tuple[float, ...]) -> Lens | None:
    """The lens with these coefficients, None for the ideal pinhole.

    Raises
    ------
    CameraError
        If the model is unknown or takes another number of coefficients.
    """
    if model not in LENSES:
        raise CameraError(f"unknown lens model '{model}'; use one of {', '.join(LENSES)}")
    kind = LENSES[model]
    if model == "radial-tangential" and not coefficients:
        return None
    if len(coefficients) not in kind.counts:
        counts = " or ".join(str(count) for count in kind.counts)
        none = ", or none" if model == "radial-tangential" else ""
        raise CameraError(f"{model} distortion has {len(coefficients)} values; give {counts}{none}")
    return kind(coefficients)


def _solve(jacobian: Array, residual: Array) -> Array:
    """Solutions (n, 2) of 2x2 systems."""
    a, b, c, d = jacobian[:, 0, 0], jacobian[:, 0, 1], jacobian[:, 1, 0], jacobian[:, 1, 1]
    determinant = a * d - b * c
    return np.column_stack(
        [
            (d * residual[:, 0] - b * residual[:, 1]) / determinant,
            (a * residual[:, 1] - c * residual[:, 0]) / determinant,
        ]
    )


# The camera: projection, its derivative, and the way between recorded and undistorted images.
# Pixel (0, 0) is the centre of the first pixel. The camera looks along +z, x to the right, y down.
# The online part works on undistorted images, whatever the lens, so `project` is the ideal pinhole's and
# `undistortion_maps` prepares the images; `project_recorded` says where a point is in the image as recorded.


@dataclass(frozen=True)
class Camera:
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
        return np.column_stack([self.fx * points[:, 0] / depth + self.cx, self.fy * points[:, 1] / depth + self.cy])

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


# Stereo pairs: two cameras that are fixed to each other, and the images that share their rows.


@dataclass(frozen=True)
class RectifiedPair:
    """Images in which a point has the same row, and disparity tells its depth.

    Attributes
    ----------
    camera : the ideal pinhole of both images. baseline : distance of the cameras, metres.
    rectified_from_left : rotation (3, 3) from the left camera's frame to the rectified one.
    left_maps, right_maps : for `cv2.remap`, from recorded images to rectified ones.
    """

    camera: Camera
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

    left: Camera
    right: Camera
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
        camera = Camera(left.width, left.height, focal, focal, float(centre[0]), float(centre[1]))
        rays = camera.rays(_pixel_grid(camera))
        left_rays = rays @ rotation
        right_rays = left_rays @ self.right_from_left.rotation.T
        return RectifiedPair(camera, self.baseline, rotation, _maps(left, left_rays), _maps(right, right_rays))

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


def _pixel_grid(camera: Camera) -> Array:
    rows, columns = np.mgrid[: camera.height, : camera.width]
    return np.column_stack([columns.ravel(), rows.ravel()]).astype(float)


def _maps(camera: Camera, rays: Array) -> tuple[NDArray, NDArray]:
    """Maps for `cv2.remap` that take each pixel from where the camera recorded its ray."""
    pixels = camera.project_recorded(rays).astype(np.float32).reshape(camera.height, camera.width, 2)
    return cv2.convertMaps(pixels, None, cv2.CV_16SC2)  # type: ignore[call-overload]
