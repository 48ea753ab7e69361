"""The camera: projection, its derivative, and the way between recorded and undistorted images.

Pixel (0, 0) is the centre of the first pixel. The camera looks along +z, x to the right, y down. Tracking works on
undistorted images, whatever the lens, so `Camera.project` is the ideal pinhole's; `project_recorded` says where a
point is in the image as recorded. Lens coefficients and their order are OpenCV's.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from math import isfinite
from typing import Literal

import cv2
import numpy as np
from numba import njit
from numpy.polynomial import Polynomial
from numpy.typing import NDArray

from morph_dslam.errors import CameraError
from morph_dslam.geometry import RigidTransform

Array = NDArray[np.float64]
LensModel = Literal["radial-tangential", "fisheye"]
#: For `cv2.remap`: where each pixel of an image comes from.
Maps = tuple[NDArray, NDArray]
#: Newton stops when the image point is met to this distance at unit focal length, 1e-7 px at 1000 px.
TOLERANCE = 1e-10
MOST_ITERATIONS = 50
#: A longer readout time is a mistake of units, seconds.
LONGEST_READOUT_S = 0.5
#: The least focal length of a lens that is no fisheye, as a share of the image's side: a view of 136 degrees.
LEAST_FOCAL_SHARE = 0.2
#: Sides of images of two sizes have the same ratio up to this part.
SAME_RATIO = 0.01
#: Numbers of coefficients of each lens model.
COUNTS: dict[str, tuple[int, ...]] = {"radial-tangential": (4, 5, 8), "fisheye": (4,)}


#: A pixel outside of any image.
NOWHERE_PX = -1e4
#: Newton's starts are read from a table of so many angles from the axis, up to this one: close enough for it never to
#: leave the way up to the fold.
N_STARTS, WIDEST = 2048, np.radians(89.4)


def _first_positive_root(*polynomials: Polynomial) -> float:
    """The smallest positive real root of any of the polynomials; infinite if there is none."""
    roots = np.concatenate([polynomial.trim().roots() for polynomial in polynomials])
    return float(min(roots.real[(roots.imag == 0.0) & (roots.real > 0.0)], default=np.inf))


class _RadialTangential:
    """Brown's radial and tangential distortion (1966) with OpenCV's rational extension, at unit focal length."""

    def __init__(self, coefficients: tuple[float, ...]) -> None:
        self._coefficients = (*coefficients, *([0.0] * (8 - len(coefficients))))

    @cached_property
    def fold(self) -> float:
        """Ideal radius at which the radial part of the distortion stops growing, or has a pole; infinite for none."""
        k1, k2, _, _, k3, k4, k5, k6 = self._coefficients
        s, above, below = Polynomial([0.0, 1.0]), Polynomial([1.0, k1, k2, k3]), Polynomial([1.0, k4, k5, k6])
        growth = (above + 2.0 * s * above.deriv()) * below - 2.0 * s * above * below.deriv()
        return float(np.sqrt(_first_positive_root(growth, below)))

    @cached_property
    def _starts(self) -> tuple[Array, Array]:
        """Recorded radii (n,), and ideal ones (n,) that have them by the radial part, from the axis to the fold."""
        # At the fold there is no slope to start with.
        ideal = np.tan(np.linspace(0.0, min(np.arctan(self.fold), WIDEST), N_STARTS + 1))[:-1]
        along = np.column_stack([ideal, np.zeros(N_STARTS), np.ones(N_STARTS)])
        k1, k2, _, _, k3, k4, k5, k6 = self._coefficients
        return _RadialTangential((k1, k2, 0.0, 0.0, k3, k4, k5, k6)).image(along)[:, 0], ideal

    def image(self, points: Array) -> Array:
        """Image points (n, 2) of points (n, 3) in the camera frame; NaN for those not in front."""
        k1, k2, p1, p2, k3, k4, k5, k6 = self._coefficients
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

    def ideal(self, image_points: Array) -> Array:
        """Pinhole image points (n, 2) of recorded ones (n, 2), by Newton's method from the radial part's inverse.

        NaN beyond the radius at which the distortion folds the image over, where coefficients mean nothing.
        """
        distance = np.linalg.norm(image_points, axis=1)
        scale = np.interp(distance, *self._starts) / np.where(distance > 0.0, distance, 1.0)
        points = np.column_stack([scale[:, None] * image_points, np.ones(len(image_points))])
        with np.errstate(all="ignore"):
            for _ in range(MOST_ITERATIONS):
                residual = self.image(points) - image_points
                if not (np.abs(residual) > TOLERANCE).any():
                    break
                (a, b), (c, d) = self._slopes(points)
                determinant, (u, v) = a * d - b * c, residual.T
                points[:, :2] -= np.column_stack([d * u - b * v, a * v - c * u]) / determinant[:, None]
            missed = np.abs(self.image(points) - image_points).max(axis=1)
            (a, b), (c, d) = self._slopes(points)
            # Behind the fold the image may grow again. A negative determinant or trace: the tangential part has
            # brought the fold nearer.
            good = (missed <= 1e3 * TOLERANCE) & (np.linalg.norm(points[:, :2], axis=1) < self.fold)
            good &= (a * d - b * c > 0.0) & (a + d > 0.0)
        return np.where(good[:, None], points[:, :2], np.nan)

    def _slopes(self, points: Array) -> Array:
        """Derivatives (2, 2, n) of image points by ideal ones."""
        k1, k2, p1, p2, k3, k4, k5, k6 = self._coefficients
        x, y, _ = points.T
        s = x * x + y * y
        above, below = 1.0 + s * (k1 + s * (k2 + s * k3)), 1.0 + s * (k4 + s * (k5 + s * k6))
        by_s = (k1 + s * (2.0 * k2 + 3.0 * s * k3) - (k4 + s * (2.0 * k5 + 3.0 * s * k6)) * above / below) / below
        radial, across = above / below, 2.0 * (x * y * by_s + p1 * x + p2 * y)
        along_x = radial + 2.0 * x * x * by_s + 2.0 * p1 * y + 6.0 * p2 * x
        along_y = radial + 2.0 * y * y * by_s + 6.0 * p1 * y + 2.0 * p2 * x
        return np.array([[along_x, across], [across, along_y]])


class _Fisheye:
    """The fisheye of Kannala and Brandt (2006) at unit focal length: the corrected angle is the image radius.

    The radius is angle (1 + k1 angle^2 + k2 angle^4 + k3 angle^6 + k4 angle^8). It images directions of more than a
    right angle from the axis as well.
    """

    def __init__(self, coefficients: tuple[float, ...]) -> None:
        self._coefficients = coefficients

    @cached_property
    def fold(self) -> float:
        """Angle from the axis at which the image radius stops growing; infinite for none."""
        growth = [1.0, *(k * (2 * i + 3) for i, k in enumerate(self._coefficients))]
        return float(np.sqrt(_first_positive_root(Polynomial(growth))))

    def _radius(self, angle: Array) -> tuple[Array, Array]:
        """Image radius (n,) and its derivative by the angle (n,)."""
        k1, k2, k3, k4 = self._coefficients
        s = angle * angle
        radius = angle * (1.0 + s * (k1 + s * (k2 + s * (k3 + s * k4))))
        return radius, 1.0 + s * (3.0 * k1 + s * (5.0 * k2 + s * (7.0 * k3 + s * 9.0 * k4)))

    def image(self, points: Array) -> Array:
        """Image points (n, 2) of points (n, 3) in the camera frame; NaN straight behind it."""
        x, y, z = points.T
        distance = np.hypot(x, y)
        radius, _ = self._radius(np.arctan2(distance, z))
        with np.errstate(divide="ignore", invalid="ignore"):
            # On the axis the image is the pinhole's; behind the camera on the axis there is none.
            scale = np.where(distance > 0.0, radius / distance, np.where(z > 0.0, 1.0 / z, np.nan))
        return np.column_stack([scale * x, scale * y])

    def ideal(self, image_points: Array) -> Array:
        """Pinhole image points (n, 2) of recorded ones (n, 2), by Newton's method for the angle, as OpenCV does.

        NaN where no direction within a right angle of the axis is imaged, and beyond the fold.
        """
        distance = np.linalg.norm(image_points, axis=1)
        angles = np.linspace(0.0, min(self.fold, 0.5 * np.pi), N_STARTS + 1)[:-1]
        angle = np.interp(distance, self._radius(angles)[0], angles)
        with np.errstate(all="ignore"):
            for _ in range(MOST_ITERATIONS):
                radius, slope = self._radius(angle)
                if not (np.abs(radius - distance) > TOLERANCE).any():
                    break
                angle = angle - (radius - distance) / slope
            radius, _ = self._radius(angle)
            # Beyond the fold the search may end at a negative angle, on the other side of the axis.
            is_before = (angle >= 0.0) & (angle < min(self.fold, 0.5 * np.pi))
            good = is_before & (np.abs(radius - distance) <= 1e3 * TOLERANCE)
            scale = np.where(distance > 0.0, np.tan(angle) / distance, 1.0)
        return np.where(good[:, None], scale[:, None] * image_points, np.nan)


@njit(cache=True, nogil=True)
def _projected(points, fx, fy, cx, cy):
    """`Camera.project`, compiled: a fifth of the time for some hundred points."""
    pixels = np.empty((len(points), 2))
    for j in range(len(points)):
        depth = points[j, 2] if points[j, 2] > 0.0 else np.nan
        pixels[j, 0], pixels[j, 1] = fx * points[j, 0] / depth + cx, fy * points[j, 1] / depth + cy
    return pixels


@dataclass(frozen=True)
class Camera:
    """The intrinsics of a camera, in pixels, and its lens.

    Attributes
    ----------
    width, height : of the images
    fx, fy : focal lengths
    cx, cy : principal point
    distortion : k1, k2, p1, p2[, k3[, k4, k5, k6]] of a radial-tangential lens, empty for none; k1, k2, k3, k4 of a
        fisheye
    lens_model : "radial-tangential", or "fisheye" for the equidistant model
    readout_s : seconds from the first row to the last of a rolling shutter, 0 for a global one; negative where the
        last row comes first

    Raises CameraError if the size or the focal lengths are not positive, a number is not finite, the lens model is
    unknown or takes another number of coefficients, or the readout time is longer than `LONGEST_READOUT_S`.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, ...] = ()
    lens_model: LensModel = "radial-tangential"
    readout_s: float = 0.0

    def __post_init__(self) -> None:
        for name in ("width", "height", "fx", "fy"):
            if not 0 < getattr(self, name) < np.inf:
                raise CameraError(f"{name} is {getattr(self, name)}: give the camera's in pixels, above 0")
        if not all(map(isfinite, (self.cx, self.cy, *self.distortion))):
            raise CameraError(
                f"cx, cy and distortion are {(self.cx, self.cy, *self.distortion)}: give finite numbers, or calibrate "
                "the camera anew"
            )
        model, counts, n = self.lens_model, COUNTS.get(self.lens_model), len(self.distortion)
        if counts is None:
            raise CameraError(f"unknown lens model '{model}'; use one of {', '.join(COUNTS)}")
        may_be_none = model == "radial-tangential"
        if n not in counts and (n or not may_be_none):
            known = " or ".join(str(count) for count in counts) + (", or none" if may_be_none else "")
            raise CameraError(f"{model} distortion has {n} values; give {known}")
        if not abs(self.readout_s) <= LONGEST_READOUT_S:
            raise CameraError(
                f"readout_s is {self.readout_s:g}: give the seconds from the first row of an image to its last, at "
                f"most {LONGEST_READOUT_S:g}; usual are 0.01 to 0.035"
            )

    @cached_property
    def _lens(self) -> _RadialTangential | _Fisheye | None:
        """The lens, None where recorded images are the ideal pinhole's."""
        if not self.distortion:
            return None
        return (_Fisheye if self.lens_model == "fisheye" else _RadialTangential)(self.distortion)

    @property
    def matrix(self) -> Array:
        """The intrinsic matrix (3, 3)."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    @property
    def intrinsics(self) -> Array:
        """fx, fy, cx, cy as an array (4,), the form that compiled loops take."""
        return np.array([self.fx, self.fy, self.cx, self.cy])

    def project(self, points: Array) -> Array:
        """Pixels (n, 2) of points (n, 3), or (2,) of one (3,), in the camera frame, metres; NaN where not in front.

        Raises CameraError if points have not three coordinates.
        """
        points = np.ascontiguousarray(points, dtype=np.float64)
        if points.ndim != 2 or points.shape[1] != 3:  # the compiled loop would read what is not there
            if points.shape != (3,):
                raise CameraError(f"points to project have the shape (n, 3), not {points.shape}")
            return self.project(points[None])[0]
        return _projected(points, self.fx, self.fy, self.cx, self.cy)

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
        """Pixels (n, 2), in the image as recorded, of points (n, 3) in the camera frame; NaN where not in front.

        Beyond the fold of a lens, where nothing is seen, they are what its formula says: estimates need it smooth.
        """
        if self._lens is None:
            return self.project(points)
        return self._pixels(self._lens.image(points))

    def distort_pixels(self, pixels: Array) -> Array:
        """Pixels (n, 2), in the image as recorded, of the same points in the undistorted image."""
        return self.project_recorded(self.rays(np.asarray(pixels, dtype=float)))

    def undistort_pixels(self, pixels: Array) -> Array:
        """Pixels (n, 2), in the undistorted image, of the same points in the image as recorded.

        NaN where the lens images nothing that a pinhole could see.
        """
        pixels = np.asarray(pixels, dtype=float)
        if self._lens is None:
            return pixels
        return self._pixels(self._lens.ideal(self.rays(pixels)[:, :2]))

    def _pixels(self, image_points: Array) -> Array:
        """Pixels (n, 2) of image points (n, 2) at unit focal length."""
        return image_points * np.array([self.fx, self.fy]) + np.array([self.cx, self.cy])

    def undistortion_maps(self) -> Maps | None:
        """Maps for `cv2.remap` that undistort an image, or None when there is nothing to undistort.

        The undistorted image has the size and the intrinsics of the recorded one.
        """
        return None if self._lens is None else self.maps_of(self.pixel_rays)

    @property
    def pixel_rays(self) -> Array:
        """Directions (h * w, 3) with z = 1 of all pixels of the undistorted image, row by row."""
        rows, columns = np.mgrid[: self.height, : self.width]
        return self.rays(np.column_stack([columns.ravel(), rows.ravel()]).astype(float))

    def maps_of(self, rays: Array) -> Maps:
        """Maps that take each pixel from where the camera records its ray (h * w, 3), to 1/32 px.

        For interpolation only: the nearest pixel that OpenCV takes by them is mostly another one.
        """
        return cv2.convertMaps(self._seen_at(rays), None, cv2.CV_16SC2)  # type: ignore[call-overload]

    def _seen_at(self, rays: Array) -> NDArray[np.float32]:
        """Where the camera records the ray (h * w, 3) of each pixel, (h, w, 2); outside of the image beyond a fold."""
        pixels = self.project_recorded(rays).astype(np.float32)
        if isinstance(self._lens, _RadialTangential):
            pixels[np.hypot(rays[:, 0], rays[:, 1]) >= self._lens.fold * rays[:, 2]] = np.nan
        # What OpenCV makes of NaN depends on the processor.
        return np.nan_to_num(pixels, nan=NOWHERE_PX).reshape(self.height, self.width, 2)

    @cached_property
    def _undistorted_from(self) -> NDArray[np.float32]:
        """Where the recorded image shows each pixel (h, w, 2) of the undistorted one."""
        return self._seen_at(self.pixel_rays)

    def undistort_unblended(self, values: NDArray, outside: float) -> NDArray:
        """What the undistorted image has of values (h, w) that must not be blended, such as depths.

        Parameters
        ----------
        values : in the image as recorded; of each pixel, those of the nearest recorded one count.
        outside : what pixels get that the recorded image does not show.
        """
        if self._lens is None:
            return values
        # By maps to 1/32 px OpenCV takes the farther neighbour (opencv/opencv#24106).
        at = self._undistorted_from
        return cv2.remap(values, at, None, cv2.INTER_NEAREST, borderValue=outside)  # type: ignore[call-overload]

    def check_focal_length(self, where: str) -> None:
        """Raise CameraError if a lens that is no fisheye has a view so wide that its unit is probably wrong.

        For cameras as users give them: an undistorted picture of a fisheye may have such a view. ``where`` is where it
        was written, and begins the message.
        """
        if self.lens_model == "fisheye":
            return
        for name, focal, side, pixels in (("fx", self.fx, "width", self.width), ("fy", self.fy, "height", self.height)):
            if focal < LEAST_FOCAL_SHARE * pixels:
                degrees = np.degrees(2.0 * np.arctan(0.5 * pixels / focal))
                raise CameraError(
                    f"{where}: {name} = {focal:g} px at a {side} of {pixels} px is a view of {degrees:.0f} degrees: "
                    "fx and fy are in pixels, not in millimetres (f in mm times the pixels per mm of the sensor)"
                )

    def checked_picture(self, image: NDArray, where: str) -> NDArray[np.uint8]:
        """A picture (h, w, 3) or (h, w) as recorded; one (h, w, 1) becomes (h, w).

        Raises CameraError, whose message begins with ``where``, if it is no such picture or not of the camera's size.
        """
        is_array = isinstance(image, np.ndarray)
        if not is_array or image.dtype != np.uint8 or image.shape[2:] not in ((), (1,), (3,)) or image.ndim < 2:
            raise CameraError(
                f"{where} is {_kind(image)}: give its picture as an array of uint8, {(self.height, self.width, 3)} in "
                f"blue, green, red, or {(self.height, self.width)} in grey"
            )
        self.check_image(image, where)
        return image[:, :, 0] if image.shape[2:] == (1,) else image

    def checked_depth(self, depth: NDArray, where: str) -> NDArray:
        """A depth image (h, w) of the camera's size; NaN where it is 0, which depth cameras write for unmeasured.

        Raises CameraError, whose message begins with ``where``, if it is none.
        """
        size = (self.height, self.width)
        if not isinstance(depth, np.ndarray) or depth.dtype.kind != "f" or depth.shape != size:
            raise CameraError(
                f"{where} is {_kind(depth)}: give metres as float32, {size} as the picture that it belongs to, NaN "
                "where nothing was measured"
            )
        unknown = depth == 0.0
        return np.where(unknown, depth.dtype.type(np.nan), depth) if unknown.any() else depth

    def check_image(self, image: NDArray, where: str) -> None:
        """Raise CameraError unless ``image`` (height, width, ...) has the calibrated size."""
        height, width = image.shape[:2]
        if not image.size:
            raise CameraError(f"{where} is {width}x{height} pixels: it holds no picture; give that of the camera")
        if (width, height) != (self.width, self.height):
            raise CameraError(
                f"{where} is {width}x{height} pixels but the camera file is for {self.width}x{self.height}: "
                f"use the calibration of this camera at this size, or resize the images{self._scaled(width, height)}"
            )

    def _scaled(self, width: int, height: int) -> str:
        """The intrinsics for images of another size, for the end of a sentence, if their sides have the same ratio."""
        by = np.array([width / self.width, height / self.height])
        if abs(by[0] / by[1] - 1.0) > SAME_RATIO:
            return ""
        fx, fy, cx, cy = self.intrinsics * np.tile(by, 2) + np.repeat([0.0, 0.5], 2) * (np.tile(by, 2) - 1.0)
        numbers = f"fx: {fx:.2f}, fy: {fy:.2f}, cx: {cx:.2f}, cy: {cy:.2f}"
        return f"; of images that were resized, not cut, it is width: {width}, height: {height}, {numbers}"


@dataclass(frozen=True)
class Rectification:
    """How the images of a stereo pair are turned until their rows coincide.

    Attributes
    ----------
    camera : the ideal pinhole of both rectified images
    rectified_from_left : (3, 3) rotation of the left camera's axes
    left_maps, right_maps : for `cv2.remap`, from the left and the right image
    """

    camera: Camera
    rectified_from_left: Array
    left_maps: Maps
    right_maps: Maps


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

    def rectify(self) -> Rectification:
        """Turn both cameras until their rows coincide, by the smallest turns (Fusiello et al. 2000).

        Raises CameraError if the cameras differ in image size, stand in one place, or the right one is not to the
        right.
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
        left_rays = camera.pixel_rays @ rotation
        right_rays = left_rays @ self.right_from_left.rotation.T
        return Rectification(camera, rotation, left.maps_of(left_rays), right.maps_of(right_rays))

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


def _kind(value: object) -> str:
    """What was given where an array was wanted, for messages."""
    if isinstance(value, np.ndarray):
        return f"an array {value.shape} of {value.dtype}"
    return f"of type {type(value).__name__}"
