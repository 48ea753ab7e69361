"""Intrinsics from views of a board: least squares over intrinsics and poses (Zhang 2000).

Printed boards are bent, and a third of a millimetre can shift the focal length by 0.2 per cent. Where there
are enough views the board's own shape is solved for as well (Strobl and Hirzinger 2011).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from morph_dslam.calibration.adjustment import Estimate, adjust, focal_deviation
from morph_dslam.calibration.board import Board
from morph_dslam.calibration.views import View
from morph_dslam.camera import PinholeCamera
from morph_dslam.errors import CameraError
from morph_dslam.geometry import RigidTransform, rotation_exp
from morph_dslam.lens import LensModel

Array = NDArray[np.float64]

#: Three views determine the intrinsics; five let a bad one show.
FEWEST_VIEWS = 5

#: From so many views on the shape of the board is solved for.
FEWEST_FOR_SHAPE = 8

#: A view whose residual is this many times the median one is left out, unless it is below `HARMLESS` pixels.
OUTLIER_RATIO = 3.0
HARMLESS = 0.3

#: Without a view in which the board is tilted this much, focal length and distance cannot be told apart.
LEAST_TILT = np.deg2rad(10.0)

#: A focal length known less well than this, as standard deviation over value, is refused.
MOST_UNCERTAIN = 0.01

#: Fisheyes are solved for from these angles across the width of the image, radians, until one fits.
FISHEYE_ANGLES = (1.5, 2.0, 2.5, 3.1, 4.0)


@dataclass(frozen=True)
class Solution:
    """Intrinsics, and where the board is in each view.

    Attributes
    ----------
    views : (v) those used. left_out : names of views that do not fit.
    board_points : (n, 3) the corners as solved for, metres.
    camera_from_board : (v) poses. residuals : (v, n, 2) found minus projected corners, pixels.
    focal_deviation : standard deviation of fx and fy, pixels.
    """

    camera: PinholeCamera
    views: tuple[View, ...]
    left_out: tuple[str, ...]
    board_points: Array
    camera_from_board: tuple[RigidTransform, ...]
    residuals: Array
    focal_deviation: tuple[float, float]

    @property
    def view_rms(self) -> Array:
        """Root mean square residual (v,) of each view, pixels."""
        return np.sqrt((self.residuals**2).sum(axis=2).mean(axis=1))

    @property
    def rms(self) -> float:
        """Root mean square residual over all corners, pixels."""
        return float(np.sqrt((self.view_rms**2).mean()))

    @property
    def tilts(self) -> Array:
        """Angle (v,) between the board's normal and the optical axis in each view, radians."""
        return np.array([np.arccos(min(abs(pose.rotation[2, 2]), 1.0)) for pose in self.camera_from_board])

    @property
    def flatness(self) -> float:
        """Largest distance of a corner from the plane that fits the board best, metres."""
        centred = self.board_points - self.board_points.mean(axis=0)
        return float(np.abs(centred @ np.linalg.svd(centred)[2][2]).max())


def solve_intrinsics(
    views: Sequence[View], board: Board, size: tuple[int, int], lens_model: LensModel = "radial-tangential"
) -> Solution:
    """Calibrate from views of the board, leaving out those that do not fit the others.

    Raises
    ------
    CameraError
        If there are too few views, or they do not determine the focal length.
    """
    solution, left_out = _solve_without_outliers(views, board, size, lens_model)
    _check_determined(solution)
    if board.has_one_orientation and len(solution.views) >= FEWEST_FOR_SHAPE:
        solution = _solve_with_shape(solution, board)
    return replace(solution, left_out=left_out)


def _solve_without_outliers(
    views: Sequence[View], board: Board, size: tuple[int, int], lens_model: LensModel
) -> tuple[Solution, tuple[str, ...]]:
    """The solution with a flat board from views that fit each other, and the names of the others."""
    kept, left_out = list(views), []
    while True:
        if len(kept) < FEWEST_VIEWS:
            without = f" ({', '.join(left_out)} fit no camera)" if left_out else ""
            raise CameraError(
                f"the board was found in {len(kept)} images only{without}; {FEWEST_VIEWS} are needed, "
                "15 are good"
            )
        solve = _solve_fisheye if lens_model == "fisheye" else _solve_radial_tangential
        solution = solve(kept, board, size)
        rms = solution.view_rms
        bad = (rms > OUTLIER_RATIO * np.median(rms)) & (rms > HARMLESS)
        if not bad.any():
            return solution, tuple(left_out)
        left_out += [view.name for view, is_bad in zip(kept, bad, strict=True) if is_bad]
        kept = [view for view, is_bad in zip(kept, bad, strict=True) if not is_bad]


def _check_determined(solution: Solution) -> None:
    """Raise CameraError where views do not tell the focal length from the distance."""
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


def _solve_radial_tangential(views: Sequence[View], board: Board, size: tuple[int, int]) -> Solution:
    objects = [board.points.astype(np.float32)] * len(views)
    images = [view.corners.astype(np.float32) for view in views]
    found = cv2.calibrateCamera(objects, images, size, np.eye(3), np.zeros(5))
    _, matrix, coefficients, rotations, translations = found[:5]
    fx, fy, cx, cy = (float(matrix[i]) for i in ((0, 0), (1, 1), (0, 2), (1, 2)))
    camera = PinholeCamera(*size, fx, fy, cx, cy, tuple(float(value) for value in np.ravel(coefficients)))
    poses = tuple(
        RigidTransform(rotation_exp(np.ravel(r).astype(float)), np.ravel(t).astype(float))
        for r, t in zip(rotations, translations, strict=True)
    )
    return _solution(Estimate(camera, poses, board.points), views, np.zeros(board.points.shape, dtype=bool))


def _solve_with_shape(flat: Solution, board: Board) -> Solution:
    """The solution whose board has the shape that fits best, from the one with a flat board."""
    free = np.ones((len(board.points), 3), dtype=bool)
    # Three corners hold the board's place and scale: both ends of the first row, and the last row's start.
    free[[0, board.columns - 1]] = False
    free[-board.columns, 2] = False
    corners = np.array([view.corners for view in flat.views])
    start = Estimate(flat.camera, flat.camera_from_board, flat.board_points)
    return _solution(adjust(start, corners, free), flat.views, free)


def _solve_fisheye(views: Sequence[View], board: Board, size: tuple[int, int]) -> Solution:
    corners = np.array([view.corners for view in views])
    flat = np.zeros(board.points.shape, dtype=bool)
    centre = (0.5 * (size[0] - 1), 0.5 * (size[1] - 1))
    fits = []
    for angle in FISHEYE_ANGLES:
        focal = size[0] / angle
        start = PinholeCamera(*size, focal, focal, *centre, (0.0, 0.0, 0.0, 0.0), "fisheye")
        poses = [_planar_pose(start, board, view) for view in corners]
        if all(pose is not None for pose in poses):
            known = tuple(pose for pose in poses if pose is not None)
            fits.append(_solution(adjust(Estimate(start, known, board.points), corners, flat), views, flat))
            if fits[-1].rms < HARMLESS:
                break
    if not fits:
        raise CameraError("the views fit no fisheye: leave out --lens fisheye")
    return min(fits, key=lambda fit: fit.rms)


def _planar_pose(camera: PinholeCamera, board: Board, corners: Array) -> RigidTransform | None:
    """The pose of the flat board in one view, None where the camera cannot see it so."""
    rays = camera.rays(camera.undistort_pixels(corners))[:, :2]
    if not np.isfinite(rays).all():
        return None
    found, rotation, translation = cv2.solvePnP(
        board.points, np.ascontiguousarray(rays), np.eye(3), np.zeros(4), flags=cv2.SOLVEPNP_IPPE
    )
    return (
        RigidTransform(rotation_exp(rotation.ravel()), translation.ravel().astype(float)) if found else None
    )


def _solution(estimate: Estimate, views: Sequence[View], free: NDArray[np.bool_]) -> Solution:
    """What was solved for, with its residuals and deviations; ``free`` as of `adjust`."""
    corners = np.array([view.corners for view in views])
    return Solution(
        camera=estimate.camera,
        views=tuple(views),
        left_out=(),
        board_points=estimate.points,
        camera_from_board=estimate.poses,
        residuals=estimate.residuals(corners),
        focal_deviation=focal_deviation(estimate, corners, free),
    )
