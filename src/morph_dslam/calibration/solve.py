"""Intrinsics from views of a board: least squares over intrinsics and poses (Zhang 2000), by OpenCV.

Printed boards are bent, and a third of a millimetre can shift the focal length by 0.2 per cent. Where there
are enough views the board's own shape is solved for as well (Strobl and Hirzinger 2011).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from morph_dslam.calibration.board import CalibrationBoard
from morph_dslam.calibration.views import View
from morph_dslam.camera import Camera, LensModel
from morph_dslam.errors import CameraError
from morph_dslam.geometry import RigidTransform, rotation_exp

Array = NDArray[np.float64]
#: Three views determine the intrinsics; five let a bad one show.
FEWEST_VIEWS = 5
#: From so many views on the shape of the board is solved for; OpenCV does so for radial-tangential lenses.
FEWEST_FOR_SHAPE = 8
#: A view whose residual is this many times the median one is left out, unless it is below `HARMLESS` pixels.
OUTLIER_RATIO = 3.0
HARMLESS = 0.3
#: Without a view in which the board is tilted this much, focal length and distance are ambiguous.
LEAST_TILT = np.deg2rad(10.0)
#: A focal length known less well than this, as standard deviation over value, is refused.
MOST_UNCERTAIN = 0.01
#: Fisheyes are solved for from these angles across the width of the image, radians, until one fits.
FISHEYE_ANGLES = (1.5, 2.0, 2.5, 3.1, 4.0)
_CRITERIA = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-9)


@dataclass(frozen=True)
class Solution:
    """Intrinsics, and where the board is in each view.

    Attributes
    ----------
    camera : as solved for
    views : (v) those used, with the board as its maker says
    left_out : names of views that do not fit
    camera_from_board : (v) poses
    residuals : (v) arrays (n, 2) of found minus projected corners, pixels
    focal_deviation : standard deviation of fx and fy, pixels
    centre_deviation : of cx and cy, pixels
    shape : (n, 3) the corners as solved for, metres; None where the board is taken as flat
    """

    camera: Camera
    views: tuple[View, ...]
    left_out: tuple[str, ...]
    camera_from_board: tuple[RigidTransform, ...]
    residuals: tuple[Array, ...]
    focal_deviation: tuple[float, float]
    centre_deviation: tuple[float, float]
    shape: Array | None = None

    @property
    def view_rms(self) -> Array:
        """Root mean square residual (v,) of each view, pixels."""
        return np.array([np.sqrt((of_view**2).sum(axis=1).mean()) for of_view in self.residuals])

    @property
    def rms(self) -> float:
        """Root mean square residual of all views, pixels."""
        return float(np.sqrt((self.view_rms**2).mean()))

    @property
    def flatness(self) -> float:
        """Largest distance of a corner, as solved for, from the plane that fits the board best, metres."""
        if self.shape is None:
            return 0.0
        centred = self.shape - self.shape.mean(axis=0)
        return float(np.abs(centred @ np.linalg.svd(centred)[2][2]).max())

    @property
    def tilts(self) -> Array:
        """Angle (v,) between the board's normal and the optical axis in each view, radians."""
        return np.array([np.arccos(min(abs(pose.rotation[2, 2]), 1.0)) for pose in self.camera_from_board])


def solve_intrinsics(
    views: Sequence[View], board: CalibrationBoard, size: tuple[int, int], lens_model: LensModel = "radial-tangential"
) -> Solution:
    """Calibrate from views of the board, leaving out those that do not fit the others.

    Raises CameraError if there are too few views, or they do not determine the focal length.
    """
    solve = _solve_fisheye if lens_model == "fisheye" else _solve_radial_tangential
    kept, left_out = list(views), []
    while True:
        if len(kept) < FEWEST_VIEWS:
            without = f" ({', '.join(left_out)} fit no camera)" if left_out else ""
            raise CameraError(
                f"the board was found in {len(kept)} images only{without}; {FEWEST_VIEWS} are needed, 15 are good"
            )
        solution = solve(kept, size)
        rms = solution.view_rms
        bad = (rms > OUTLIER_RATIO * np.median(rms)) & (rms > HARMLESS)
        if not bad.any():
            break
        left_out += [view.name for view, is_bad in zip(kept, bad, strict=True) if is_bad]
        kept = [view for view, is_bad in zip(kept, bad, strict=True) if not is_bad]
    _check_determined(solution)
    if lens_model != "fisheye" and board.held_corner >= 0 and len(kept) >= FEWEST_FOR_SHAPE:
        solution = _solve_radial_tangential(kept, size, board.held_corner)
    return replace(solution, left_out=tuple(left_out))


def _check_determined(solution: Solution) -> None:
    """Raise CameraError where focal length and distance are ambiguous."""
    advice = "tilt the board by 20 to 45 degrees to different sides, and fill the image with it"
    largest = float(solution.tilts.max())
    if largest < LEAST_TILT:
        raise CameraError(
            f"the focal length is not determined: all {len(solution.views)} views show the board face on "
            f"(tilted by {np.rad2deg(largest):.0f} degrees at most); {advice}"
        )
    deviation, focal = solution.focal_deviation[0], solution.camera.fx
    if not deviation <= MOST_UNCERTAIN * focal:
        raise CameraError(
            f"the focal length is not determined: it is {focal:.0f} pixels with a standard deviation of "
            f"{deviation:.0f}; {advice}"
        )


def _solve_radial_tangential(views: Sequence[View], size: tuple[int, int], held_corner: int = -1) -> Solution:
    """By OpenCV, with the board's shape too where a corner is held."""
    found = cv2.calibrateCameraROExtended(
        [view.points.astype(np.float32) for view in views],
        [view.corners.astype(np.float32) for view in views],
        size,
        held_corner,
        np.eye(3),
        np.zeros(5),
        criteria=_CRITERIA,  # type: ignore[call-overload]
    )
    _, matrix, coefficients, rotations, translations, points, deviations = found[:7]
    camera, of_camera = _camera(size, matrix, coefficients, "radial-tangential"), np.ravel(deviations)[:4]
    if held_corner < 0:
        return _solution(camera, views, rotations, translations, of_camera)
    shape = np.asarray(points, dtype=float).reshape(-1, 3)
    shaped = [replace(view, points=shape) for view in views]
    solved = _solution(camera, shaped, rotations, translations, of_camera)
    return replace(solved, views=tuple(views), shape=shape)


def _solve_fisheye(views: Sequence[View], size: tuple[int, int]) -> Solution:
    objects = [view.points.reshape(1, -1, 3) for view in views]
    corners = [np.ascontiguousarray(view.corners).reshape(1, -1, 2) for view in views]
    # Since version 5 OpenCV keeps these flags with those of other cameras.
    known: Any = cv2.fisheye if hasattr(cv2.fisheye, "CALIB_FIX_SKEW") else cv2
    flags = known.CALIB_RECOMPUTE_EXTRINSIC | known.CALIB_FIX_SKEW | known.CALIB_USE_INTRINSIC_GUESS
    fits: list[Solution] = []
    for angle in FISHEYE_ANGLES:
        focal = size[0] / angle
        start = np.array([[focal, 0.0, 0.5 * (size[0] - 1)], [0.0, focal, 0.5 * (size[1] - 1)], [0.0, 0.0, 1.0]])
        try:
            found = cv2.fisheye.calibrate(objects, corners, size, start, np.zeros(4), flags=flags, criteria=_CRITERIA)
            _, matrix, coefficients, rotations, translations = found
            camera = _camera(size, matrix, coefficients, "fisheye")
        except (cv2.error, CameraError):
            continue  # no pose of the board is seen through a lens of this angle, or only a mirrored one
        deviations = _fisheye_deviations(views, matrix, coefficients, rotations, translations)
        fits.append(_solution(camera, views, rotations, translations, deviations))
        if fits[-1].rms < HARMLESS:
            break
    if not fits:
        raise CameraError("the views fit no fisheye: leave out --lens fisheye")
    return min(fits, key=lambda fit: fit.rms)


def _fisheye_deviations(
    views: Sequence[View],
    matrix: NDArray,
    coefficients: NDArray,
    rotations: Sequence[NDArray],
    translations: Sequence[NDArray],
) -> Array:
    """Standard deviations (4,) of fx, fy, cx, cy, pixels, from the curvature of the sum of squares at its least."""
    ends, squares = 2 * np.cumsum([0, *(len(view.points) for view in views)]), 0.0
    slopes = np.zeros((ends[-1], 8 + 6 * len(views)))
    for k, (view, rotation, translation) in enumerate(zip(views, rotations, translations, strict=True)):
        points, rows = view.points.reshape(1, -1, 3), slice(ends[k], ends[k + 1])
        pixels, by = cv2.fisheye.projectPoints(points, rotation, translation, matrix, coefficients)
        # The columns are f, c, the distortion, the rotation, the translation, and the skew.
        slopes[rows, :8] = by[:, :8]
        slopes[rows, 8 + 6 * k : 14 + 6 * k] = by[:, 8:14]
        squares += float(((pixels.reshape(-1, 2) - view.corners) ** 2).sum())
    # Columns differ by orders of magnitude; scaled, the pseudo-inverse drops only what is undetermined.
    scale = np.maximum(np.linalg.norm(slopes, axis=0), 1e-300)
    covariance = np.linalg.pinv((slopes / scale).T @ (slopes / scale), hermitian=True)
    variance = squares / max(len(slopes) - slopes.shape[1], 1)
    return np.sqrt(np.maximum(np.diag(covariance)[:4], 0.0) * variance) / scale[:4]


def _camera(size: tuple[int, int], matrix: NDArray, coefficients: NDArray, lens_model: LensModel) -> Camera:
    fx, fy, cx, cy = (float(matrix[i]) for i in ((0, 0), (1, 1), (0, 2), (1, 2)))
    return Camera(*size, fx, fy, cx, cy, tuple(float(value) for value in np.ravel(coefficients)), lens_model)


def _solution(
    camera: Camera,
    views: Sequence[View],
    rotations: Sequence[NDArray],
    translations: Sequence[NDArray],
    deviations: NDArray,
) -> Solution:
    """The solution of what OpenCV found; deviations (4,) of fx, fy, cx, cy."""
    poses = tuple(
        RigidTransform(rotation_exp(np.ravel(r).astype(float)), np.ravel(t).astype(float))
        for r, t in zip(rotations, translations, strict=True)
    )
    placed = [pose.apply(view.points) for view, pose in zip(views, poses, strict=True)]
    residuals = tuple(view.corners - camera.project_recorded(at) for view, at in zip(views, placed, strict=True))
    fx, fy, cx, cy = deviations.tolist()
    return Solution(camera, tuple(views), (), poses, residuals, (fx, fy), (cx, cy))
