"""Views of the board: found in images or in the frames of a video, and chosen to cover the image."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from morph_dslam.calibration.board import Board, find_corners
from morph_dslam.camera import Camera, LensModel
from morph_dslam.errors import CameraError
from morph_dslam.geometry import RigidTransform, cross_matrix, rotation_exp
from morph_dslam.sources import open_source
from morph_dslam.sources.frames import SUFFIXES, read_image

Array = NDArray[np.float64]

#: So many frames of a video are searched for the board, evenly spread over it.
MOST_SEARCHED = 120

#: So many of those where it is found are used: more add time and no accuracy.
MOST_FRAMES = 30


@dataclass(frozen=True)
class View:
    """The board's corners (n, 2) as pixels of the image ``name``."""

    name: str
    corners: Array


@dataclass(frozen=True)
class Views:
    """What was found: the views, the size (width, height) of the images, and how many were searched."""

    views: tuple[View, ...]
    size: tuple[int, int]
    n_searched: int


def collect_views(sources: Sequence[Path], board: Board, ignored: Path | None = None) -> Views:
    """The views in images, in a folder of images, or in a video or another recording.

    Of a recording with many views, those are kept that cover positions, distances and tilts best. The image
    ``ignored`` is passed over: a picture that an earlier calibration left in the folder.

    Raises
    ------
    CameraError
        If the board is found nowhere, or the images differ in size.
    SourceError
        If an image or a video cannot be read.
    """
    files = [path for path in _image_files(sources) if ignored is None or path.resolve() != ignored.resolve()]
    images, total = (_read(files), len(files)) if files else _sampled(sources)
    views, size, n_searched = [], None, 0
    for name, image in tqdm(images, total=total, desc="searching the board", unit="image", disable=None):
        height, width = image.shape[:2]
        size = size or (width, height)
        if (width, height) != size:
            raise CameraError(
                f"{name} is {width}x{height} pixels, the images before it are {size[0]}x{size[1]}: "
                "calibrate with images of one size, that of the video to be tracked"
            )
        n_searched += 1
        corners = find_corners(np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), dtype=np.uint8), board)
        if corners is not None:
            views.append(View(name, corners))
    if not views or size is None:
        raise CameraError(
            f"no board of {board.columns}x{board.rows} inner corners was found in {n_searched} images: "
            "count the corners where four squares meet (a board of 10x7 squares has 9x6), and show the whole "
            "board with its white margin, sharp and evenly lit"
        )
    chosen = views if files else [views[i] for i in select_by_coverage([v.corners for v in views], board.columns, size)]
    return Views(tuple(chosen), size, n_searched)


def _image_files(sources: Sequence[Path]) -> list[Path]:
    """The image files named, or in the folder named; none if the source is a recording."""
    if len(sources) == 1 and sources[0].is_dir():
        return sorted(path for path in sources[0].iterdir() if path.suffix.lower() in SUFFIXES)
    if all(path.suffix.lower() in SUFFIXES for path in sources):
        return list(sources)
    if len(sources) > 1:
        raise CameraError(f"give images, or one folder, or one recording; {sources[0]} is not the only source")
    return []


def _read(files: Iterable[Path]) -> Iterator[tuple[str, NDArray[np.uint8]]]:
    for path in files:
        yield path.name, read_image(path, "calibration image")


def _sampled(sources: Sequence[Path]) -> tuple[Iterator[tuple[str, NDArray[np.uint8]]], int]:
    """Frames evenly spread over a recording, and how many."""
    source = open_source(sources[0])
    step = -(-len(source) // MOST_SEARCHED)
    frames = ((f"frame {frame.index}", frame.image) for count, frame in enumerate(source) if count % step == 0)
    return frames, -(-len(source) // step)


def select_by_coverage(
    corners: Sequence[Array], columns: int, size: tuple[int, int], most: int = MOST_FRAMES
) -> list[int]:
    """Which of many views to use: each one next that differs most from those chosen.

    Parameters
    ----------
    corners : (n, 2) pixels in each view, row by row. columns : corners in a row. size : of the images.

    Returns
    -------
    Indices, ascending; all where there are at most ``most``.
    """
    descriptors = np.array([_descriptor(view, columns, size) for view in corners])
    distances = np.linalg.norm(descriptors - descriptors.mean(axis=0), axis=1)
    chosen = [int(distances.argmax())]
    distances = np.full(len(descriptors), np.inf)
    while len(chosen) < min(most, len(descriptors)):
        newest = descriptors[chosen[-1]]
        distances = np.minimum(distances, np.linalg.norm(descriptors - newest, axis=1))
        distances[chosen] = -1.0
        chosen.append(int(distances.argmax()))
    return sorted(chosen)


def _descriptor(corners: Array, columns: int, size: tuple[int, int]) -> Array:
    """Where the board is and how large, in image sizes; how it is tilted, by the ratios of opposite sides."""
    a, b, c, d = corners[0], corners[columns - 1], corners[-1], corners[-columns]
    top, right, bottom, left = (np.linalg.norm(p - q) for p, q in ((a, b), (b, c), (c, d), (d, a)))
    extent = np.sqrt((top + bottom) * (left + right) / (4.0 * size[0] * size[1]))
    return np.array([*(corners.mean(axis=0) / np.array(size)), extent, np.log(top / bottom), np.log(left / right)])


# Least squares over intrinsics, poses and the shape of the board, with its covariance.


MOST_ITERATIONS = 50

#: The sum of squares has converged when it falls by less than this part of itself.
LEAST_DECREASE = 1e-9


@dataclass(frozen=True)
class Estimate:
    """What is solved for: the camera, the poses (v) camera_from_board, the corners (n, 3), metres."""

    camera: Camera
    poses: tuple[RigidTransform, ...]
    points: Array

    def residuals(self, corners: Array) -> Array:
        """Found corners (v, n, 2) minus projected ones, pixels."""
        projected = [self.camera.project_recorded(pose.apply(self.points)) for pose in self.poses]
        return corners - np.array(projected)

    def moved(self, step: Array, free: NDArray[np.bool_]) -> Estimate:
        """The estimate after a step in the unknowns of `jacobian`."""
        camera = self.camera
        n_intrinsics = 4 + len(camera.distortion)
        fx, fy, cx, cy = (float(value) for value in camera.intrinsics + step[:4])
        coefficients = np.array(camera.distortion) + step[4:n_intrinsics]
        by_pose = step[n_intrinsics : n_intrinsics + 6 * len(self.poses)].reshape(-1, 6)
        poses = tuple(
            RigidTransform(rotation_exp(change[:3]) @ pose.rotation, pose.translation + change[3:])
            for pose, change in zip(self.poses, by_pose, strict=True)
        )
        points = self.points.copy()
        points[free] += step[n_intrinsics + 6 * len(self.poses) :]
        changed = replace(camera, fx=fx, fy=fy, cx=cx, cy=cy, distortion=tuple(float(value) for value in coefficients))
        return Estimate(changed, poses, points)


def jacobian(estimate: Estimate, free: NDArray[np.bool_]) -> Array:
    """Derivative of all pixels (2 v n) by the unknowns.

    Parameters
    ----------
    free : (n, 3) which coordinates of the corners are unknown.

    Returns
    -------
    (2 v n, m); the columns are fx, fy, cx, cy, the distortion, a turn and a translation for each pose, and
    the free coordinates.
    """
    camera, poses, points = estimate.camera, estimate.poses, estimate.points
    n, n_intrinsics = len(points), 4 + len(camera.distortion)
    result = np.zeros((len(poses), 2 * n, n_intrinsics + 6 * len(poses) + int(free.sum())))
    for k, pose in enumerate(poses):
        moved = pose.apply(points)
        by_point = camera.recorded_jacobian(moved)
        # A turn e about the board's origin moves a point by e x (R p).
        turns = -cross_matrix(moved - pose.translation)
        by_pose = np.concatenate([by_point @ turns, by_point], axis=2)
        first = n_intrinsics + 6 * k
        result[k, :, :n_intrinsics] = _intrinsic_jacobian(camera, moved)
        result[k, :, first : first + 6] = by_pose.reshape(-1, 6)
        if free.any():
            by_shape = np.zeros((n, 2, n, 3))
            by_shape[np.arange(n), :, np.arange(n)] = by_point @ pose.rotation
            result[k, :, n_intrinsics + 6 * len(poses) :] = by_shape.reshape(2 * n, 3 * n)[:, free.ravel()]
    return result.reshape(-1, result.shape[2])


def _intrinsic_jacobian(camera: Camera, points: Array) -> Array:
    """Derivative (2 n, 4 + d) of the recorded pixels by fx, fy, cx, cy and the distortion."""
    pixels = camera.project_recorded(points)
    image = (pixels - camera.intrinsics[2:]) / camera.intrinsics[:2]
    u, v = np.eye(2)
    ones = np.ones((len(points), 1))
    columns = [image * u, image * v, ones * u, ones * v]
    for k in range(len(camera.distortion)):
        # The image is linear in each coefficient (up to the fifth), so that a step of one is exact.
        changed = list(camera.distortion)
        changed[k] += 1.0
        columns.append(replace(camera, distortion=tuple(changed)).project_recorded(points) - pixels)
    return np.stack([column.ravel() for column in columns], axis=1)


def adjust(estimate: Estimate, corners: Array, free: NDArray[np.bool_]) -> Estimate:
    """The estimate that fits corners (v, n, 2) best, by Levenberg-Marquardt from a good start."""
    damping = 1e-4
    residuals = estimate.residuals(corners).ravel()
    for _ in range(MOST_ITERATIONS):
        slopes = jacobian(estimate, free)
        normal, gradient = slopes.T @ slopes, slopes.T @ residuals
        step = np.asarray(np.linalg.solve(normal + damping * np.diag(np.diag(normal)), gradient), dtype=float)
        candidate = estimate.moved(step, free)
        changed = candidate.residuals(corners).ravel()
        decrease = 1.0 - (changed @ changed) / (residuals @ residuals)
        if not decrease > 0.0:
            damping *= 10.0
            if damping > 1e6:
                break
            continue
        estimate, residuals, damping = candidate, changed, 0.1 * damping
        if decrease < LEAST_DECREASE:
            break
    return estimate


def focal_deviation(estimate: Estimate, corners: Array, free: NDArray[np.bool_]) -> tuple[float, float]:
    """Standard deviations of fx and fy, pixels, from the curvature of the sum of squares at its least."""
    residuals = estimate.residuals(corners)
    slopes = jacobian(estimate, free)
    # Columns differ by orders of magnitude; scaled, the pseudo-inverse drops only what is undetermined.
    scale = np.maximum(np.linalg.norm(slopes, axis=0), 1e-300)
    covariance = np.linalg.pinv((slopes / scale).T @ (slopes / scale), hermitian=True)
    variance = float((residuals**2).sum()) / max(residuals.size - slopes.shape[1], 1)
    fx, fy = np.sqrt(np.maximum(np.diag(covariance)[:2], 0.0) * variance) / scale[:2]
    return float(fx), float(fy)


# Intrinsics from views of a board: least squares over intrinsics and poses (Zhang 2000).
# Printed boards are bent, and a third of a millimetre can shift the focal length by 0.2 per cent. Where there
# are enough views the board's own shape is solved for as well (Strobl and Hirzinger 2011).


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

    camera: Camera
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
                f"the board was found in {len(kept)} images only{without}; {FEWEST_VIEWS} are needed, 15 are good"
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
    camera = Camera(*size, fx, fy, cx, cy, tuple(float(value) for value in np.ravel(coefficients)))
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
        start = Camera(*size, focal, focal, *centre, (0.0, 0.0, 0.0, 0.0), "fisheye")
        poses = [_planar_pose(start, board, view) for view in corners]
        if all(pose is not None for pose in poses):
            known = tuple(pose for pose in poses if pose is not None)
            fits.append(_solution(adjust(Estimate(start, known, board.points), corners, flat), views, flat))
            if fits[-1].rms < HARMLESS:
                break
    if not fits:
        raise CameraError("the views fit no fisheye: leave out --lens fisheye")
    return min(fits, key=lambda fit: fit.rms)


def _planar_pose(camera: Camera, board: Board, corners: Array) -> RigidTransform | None:
    """The pose of the flat board in one view, None where the camera cannot see it so."""
    rays = camera.rays(camera.undistort_pixels(corners))[:, :2]
    if not np.isfinite(rays).all():
        return None
    found, rotation, translation = cv2.solvePnP(
        board.points, np.ascontiguousarray(rays), np.eye(3), np.zeros(4), flags=cv2.SOLVEPNP_IPPE
    )
    return RigidTransform(rotation_exp(rotation.ravel()), translation.ravel().astype(float)) if found else None


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
