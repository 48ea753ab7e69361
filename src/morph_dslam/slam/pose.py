"""Projection of map points, the pose of a camera from them, and the motion between two views.

Poses are refined by Huber-weighted Gauss-Newton, or found by P3P in RANSAC without a start. Between two views the
choice of essential matrix or homography follows ORB-SLAM (Mur-Artal et al. 2015, IV-B): where a homography explains the
matches about as well, the scene is plane or the camera has only turned, and the motion is taken from its decomposition
(Malis and Vargas 2007). A plane leaves two solutions; both are returned, and a third view decides.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from morph_dslam.geometry import RigidTransform, rotation_exp
from morph_dslam.slam.bundle_adjustment import (
    LEAST_DEPTH,
    huber,
    in_camera,
    jacobians,
    make_orthonormal,
    residual,
    turned_and_shifted,
)
from morph_dslam.small_arrays import cholesky_solve, median

Array = NDArray[np.float64]
#: The number of a camera that is the only one. Compiled loops take a plain integer as a type of its own.
ONLY = np.int64(0)


def camera_matrix(intrinsics: Array) -> Array:
    """The matrix (3, 3) of fx, fy, cx, cy (4,)."""
    fx, fy, cx, cy = intrinsics
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def project(camera_from_world: Array, points: Array, intrinsics: Array) -> tuple[Array, Array]:
    """Pixels (n, 2) and depths (n,) of points (n, 3); pixels are NaN where a point is not in front."""
    local = points @ camera_from_world[:3, :3].T + camera_from_world[:3, 3]
    depth = np.where(local[:, 2] > LEAST_DEPTH, local[:, 2], np.nan)
    return local[:, :2] / depth[:, None] * intrinsics[:2] + intrinsics[2:], local[:, 2]


def rays(pixels: Array, intrinsics: Array) -> Array:
    """Directions (n, 3) with z = 1 of pixels (n, 2) in the camera frame."""
    return np.column_stack([(pixels - intrinsics[2:]) / intrinsics[:2], np.ones(len(pixels))])


def world_points(camera_from_world: Array, pixels: Array, depths: Array | float, intrinsics: Array) -> Array:
    """Points (n, 3) in the world, seen at pixels (n, 2) at these depths."""
    local = rays(pixels, intrinsics) * np.reshape(depths, (-1, 1))
    return (local - camera_from_world[:3, 3]) @ camera_from_world[:3, :3]


def inverse(pose: Array) -> Array:
    """Inverse (4, 4) of a rigid transform."""
    result = np.eye(4)
    result[:3, :3] = pose[:3, :3].T
    result[:3, 3] = -pose[:3, :3].T @ pose[:3, 3]
    return result


def inside(pixels: Array, shape: tuple[int, ...], margin: float) -> NDArray[np.bool_]:
    """Which pixels (n, 2) lie in an image (h, w) and this far from its border; NaN do not."""
    height, width = shape[:2]
    with np.errstate(invalid="ignore"):
        return (
            (pixels[:, 0] >= margin)
            & (pixels[:, 1] >= margin)
            & (pixels[:, 0] <= width - 1 - margin)
            & (pixels[:, 1] <= height - 1 - margin)
        )


#: Points that miss by more than this multiple of the inliers' median do not count in the next round: without
#: this a few points that move draw the pose along for as long as they stay below ``inlier_px``. Pixels below
#: which all count.
CORE_RATIO, LEAST_CORE_PX = 3.0, 0.6
#: Rounds in which a pose is refined.
ROUNDS = 2


@njit(cache=True, nogil=True)
def _normal_equations(pose, points, pixels, camera, width, used):
    """Huber cost, J'WJ (6, 6) and -J'Wr (6,) by the pose's twist from the left (rotation, translation)."""
    matrix, right, cost = np.zeros((6, 6)), np.zeros(6), 0.0
    poses, rows, by_point, misses = pose.reshape(1, 4, 4), np.zeros((3, 6)), np.zeros((3, 3)), np.zeros(3)
    for i in range(len(points)):
        if not used[i]:
            continue
        x, y, z = in_camera(poses, ONLY, points, i)
        if z < LEAST_DEPTH:
            cost += width * 1000.0
            continue
        misses[0], misses[1], misses[2] = residual(x, y, z, pixels, i, camera)
        term, weight = huber(np.sqrt(misses[0] ** 2 + misses[1] ** 2 + misses[2] ** 2), width)
        cost += term
        jacobians(x, y, z, poses, ONLY, camera, rows, by_point)
        for row in range(2 if np.isnan(pixels[i, 2]) else 3):
            for j in range(6):
                weighted = weight * rows[row, j]
                right[j] -= weighted * misses[row]
                for k in range(j + 1):
                    matrix[j, k] += weighted * rows[row, k]
    for j in range(6):
        for k in range(j):
            matrix[k, j] = matrix[j, k]
    return cost, matrix, right


@njit(cache=True, nogil=True)
def _refine(pose, points, pixels, camera, width, used, iterations):
    cost, matrix, right = _normal_equations(pose, points, pixels, camera, width, used)
    damping = 1e-6
    for _ in range(iterations):
        damped = matrix.copy()
        for j in range(6):
            damped[j, j] += damping * matrix[j, j] + 1e-9
        step = cholesky_solve(damped, right)
        moved = pose.copy()
        turned_and_shifted(pose, rotation_exp(step[:3]), step[3:], moved)
        new_cost, new_matrix, new_right = _normal_equations(moved, points, pixels, camera, width, used)
        if new_cost > cost:
            damping = max(10.0 * damping, 1e-4)
            continue
        small = cost - new_cost < 1e-7 * cost
        pose, cost, matrix, right = moved, new_cost, new_matrix, new_right
        damping *= 0.1
        if small:
            break
    return pose, matrix


@njit(cache=True, nogil=True)
def _errors(pose, points, pixels, camera):
    """Distances (n,) in pixels between projected points (n, 3) and pixels (n, 2 or 3); inf behind the camera."""
    result, poses = np.empty(len(points)), pose.reshape(1, 4, 4)
    for i in range(len(points)):
        x, y, z = in_camera(poses, ONLY, points, i)
        result[i] = np.inf
        if z > LEAST_DEPTH:
            result[i] = math.hypot(
                camera[0] * x / z + camera[2] - pixels[i, 0], camera[1] * y / z + camera[3] - pixels[i, 1]
            )
    return result


@njit(cache=True, nogil=True)
def _inverse_of_normal(matrix):
    """The inverse (6, 6) of normal equations, solved in units in which their diagonal is 1."""
    scale = np.empty(6)
    for j in range(6):
        scale[j] = 1.0 / math.sqrt(max(matrix[j, j], 1e-300))
    scaled, unit, result = np.empty((6, 6)), np.zeros(6), np.empty((6, 6))
    for j in range(6):
        for k in range(6):
            scaled[j, k] = matrix[j, k] * scale[j] * scale[k]
    for j in range(6):
        unit[:] = 0.0
        unit[j] = 1.0
        column = cholesky_solve(scaled, unit)
        for k in range(6):
            result[k, j] = column[k] * scale[j] * scale[k]
    return result


@njit(cache=True, nogil=True)
def _refine_in_rounds(pose, points, pixels, camera, huber_px, inlier_px, used):
    """A pose refined by the points that fit: pose, covariance, errors (n,) and their root mean square, `inf` without.

    After each round the points that miss by more than ``inlier_px``, or by much more than most inliers, are left out.
    """
    matrix, errors = np.zeros((6, 6)), np.full(len(points), np.inf)
    for _ in range(ROUNDS):
        if used.sum() < 4:
            return pose, matrix, np.full(len(points), np.inf), np.inf
        pose, matrix = _refine(pose, points, pixels, camera, huber_px, used, 10)
        make_orthonormal(pose)
        errors = _errors(pose, points, pixels, camera)
        inliers, count, used = np.empty(len(errors)), 0, np.empty(len(errors), np.bool_)
        for i in range(len(errors)):
            if errors[i] < inlier_px:
                inliers[count] = errors[i]
                count += 1
        core_px = min(inlier_px, max(CORE_RATIO * median(inliers[:count]), LEAST_CORE_PX)) if count else 0.0
        for i in range(len(errors)):
            used[i] = errors[i] < core_px
    square, n = 0.0, 0
    for error in errors:
        if error < inlier_px:
            square += error * error
            n += 1
    rms = math.sqrt(square / n) if n else np.inf
    # Two residuals a point, of which the pose takes up six.
    variance = max(rms, 0.1) ** 2 * n / max(2 * n - 6, 1)
    return pose, _inverse_of_normal(matrix) * variance, errors, rms


@dataclass(frozen=True)
class PoseEstimate:
    """A camera's pose.

    Attributes
    ----------
    camera_from_world : (4, 4).
    covariance : (6, 6) of the twist from the left (rotation rad, translation), for the measured pixel noise.
    inliers : (n,) points that agree with it.
    rms_px : root mean square error of the inliers.
    """

    camera_from_world: Array
    covariance: Array
    inliers: NDArray[np.bool_]
    rms_px: float


def reprojection_errors(camera_from_world: Array, points: Array, pixels: Array, intrinsics: Array) -> Array:
    """Distances (n,) in pixels between projected points (n, 3) and pixels (n, 2); inf behind the camera."""
    return _errors(
        np.ascontiguousarray(camera_from_world), np.ascontiguousarray(points), np.ascontiguousarray(pixels), intrinsics
    )


def refine_pose(
    start: Array,
    points: Array,
    pixels: Array,
    intrinsics: Array,
    huber_px: float = 1.5,
    inlier_px: float = 3.0,
    right: Array | None = None,
    baseline_px: float = 0.0,
    trusted: NDArray[np.bool_] | None = None,
) -> PoseEstimate:
    """Pose (4, 4) from points (n, 3) and their pixels (n, 2), started at ``start``.

    ``right`` (n,) are columns in a right image at ``baseline_px``, NaN where depth was not measured. After
    each round the points that miss by more than ``inlier_px``, or by much more than most inliers, are left
    out of the next; the first one uses the ``trusted`` points (n,), all by default. Without four points that
    fit there is no inlier and the covariance is infinite.
    """
    pose, n = np.array(start, dtype=np.float64, order="C"), len(points)
    rows, camera = np.empty((n, 3)), np.append(intrinsics, baseline_px)
    rows[:, :2], rows[:, 2] = pixels, np.nan if right is None else right
    used = np.ones(n, dtype=np.bool_) if trusted is None else trusted
    pose, covariance, errors, rms = _refine_in_rounds(
        pose, np.ascontiguousarray(points), rows, camera, float(huber_px), float(inlier_px), used
    )
    if not np.isfinite(rms):
        return PoseEstimate(pose, np.full((6, 6), np.inf), np.zeros(n, dtype=np.bool_), rms)
    return PoseEstimate(pose, covariance, errors < inlier_px, rms)


def ransac_pose(
    points: Array, pixels: Array, matrix: Array, inlier_px: float, method: int, iterations: int, confidence: float
) -> tuple[RigidTransform, NDArray[np.bool_]] | None:
    """A pose with which most points (n, 3) are near their pixels (n, 2), and which are; None if none is found.

    Parameters
    ----------
    matrix : (3, 3) of the camera.
    inlier_px : how far points may miss their pixels.
    method : OpenCV's flag of the solver for the least number of points.
    iterations : samples tried at most.
    confidence : probability at which no more samples are tried.
    """
    try:
        found, turn, shift, rows = cv2.solvePnPRansac(
            points,
            pixels,
            matrix,
            None,  # type: ignore[arg-type]
            iterationsCount=iterations,
            reprojectionError=inlier_px,
            confidence=confidence,
            flags=method,
        )
    except cv2.error:
        return None  # matches of nearly the same few points span no pose
    if not found or rows is None:
        return None
    agreeing = np.zeros(len(points), dtype=bool)
    agreeing[np.asarray(rows, dtype=np.int64).ravel()] = True
    return RigidTransform(rotation_exp(turn.ravel()), np.asarray(shift, dtype=float).ravel()), agreeing


def find_pose(
    points: Array, pixels: Array, intrinsics: Array, inlier_px: float = 4.0, least: int = 15
) -> PoseEstimate | None:
    """Pose from matches among which many are wrong (P3P in RANSAC); None if fewer than ``least`` agree."""
    if len(points) < least:
        return None
    cv2.setRNGSeed(0)
    found = ransac_pose(points, pixels, camera_matrix(intrinsics), inlier_px, cv2.SOLVEPNP_AP3P, 1000, 0.999)
    if found is None or found[1].sum() < least:
        return None
    # The matches that RANSAC rejects are too many for a Huber weight.
    pose, agreeing = found
    start = refine_pose(pose.matrix, points[agreeing], pixels[agreeing], intrinsics).camera_from_world
    used = reprojection_errors(start, points, pixels, intrinsics) < inlier_px
    estimate = refine_pose(start, points[used], pixels[used], intrinsics, inlier_px=inlier_px)
    used[used] = estimate.inliers
    estimate = replace(estimate, inliers=used)
    return estimate if estimate.inliers.sum() >= least else None


#: Share of homography score above which the homography is believed (ORB-SLAM's value).
PLANE_SHARE = 0.45
#: Squared errors that 95 % of the inliers stay below, for one and two degrees of freedom, in pixel variances.
CHI2_ONE, CHI2_TWO = 3.841, 5.991
#: How far points of two views may miss their pixels, whose noise is taken to be a pixel.
MOST_MISS_PX = 2.5


@dataclass(frozen=True)
class TwoViewHypothesis:
    """A relative pose and what it makes of the matches.

    Attributes
    ----------
    second_from_first : (4, 4), translation of length 1.
    points : (n, 3) in the first camera, NaN where triangulation failed.
    parallax_deg : median angle between the rays of the good points.
    """

    second_from_first: Array
    points: Array
    parallax_deg: float

    @property
    def good(self) -> NDArray[np.bool_]:
        """Matches (n,) that have a point."""
        return np.isfinite(self.points[:, 0])


def triangulate(first_from_world: Array, second_from_world: Array, first_rays: Array, second_rays: Array) -> Array:
    """Points (n, 3) in the world from rays (n, 3) with z = 1 in two cameras (linear, Hartley and Sturm)."""
    points = cv2.triangulatePoints(
        first_from_world[:3], second_from_world[:3], first_rays[:, :2].T.copy(), second_rays[:, :2].T.copy()
    )
    with np.errstate(divide="ignore", invalid="ignore"):
        return (points[:3] / points[3]).T


def ray_angles(points: Array, first_centre: Array, second_centre: Array) -> Array:
    """Angle (n,) at each point between the directions to two camera centres, degrees."""
    a, b = first_centre - points, second_centre - points
    with np.errstate(divide="ignore", invalid="ignore"):
        cosine = np.einsum("nx,nx->n", a, b) / (np.linalg.norm(a, axis=1) * np.linalg.norm(b, axis=1))
    return np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))


def camera_centre(camera_from_world: Array) -> Array:
    """Position (3,) of the camera in the world."""
    return -camera_from_world[:3, :3].T @ camera_from_world[:3, 3]


def check_points(
    points: Array, poses: list[Array], pixels: list[Array], intrinsics: Array, max_px: float
) -> NDArray[np.bool_]:
    """Which points (n, 3) lie in front of every camera and project within ``max_px`` of their pixels."""
    good = np.asarray(np.isfinite(points).all(axis=1))
    for pose, seen in zip(poses, pixels, strict=True):
        good &= reprojection_errors(pose, points, seen, intrinsics) < max_px
    return good


def _score(squared_errors: Array, limit: float) -> float:
    """ORB-SLAM's score: what each inlier gains over the largest error that two degrees of freedom allow."""
    return float(np.sum(np.where(squared_errors < limit, CHI2_TWO - squared_errors, 0.0)))


def epipolar_errors(essential: Array, first: Array, second: Array, intrinsics: Array) -> tuple[Array, Array]:
    """Squared distances (n,) of matched pixels (n, 2) to their epipolar lines in either image, px^2."""
    inverse = np.linalg.inv(camera_matrix(intrinsics))
    fundamental = inverse.T @ essential @ inverse
    a, b = np.column_stack([first, np.ones(len(first))]), np.column_stack([second, np.ones(len(second))])
    in_second, in_first = a @ fundamental.T, b @ fundamental
    product = np.einsum("nx,nx->n", b, in_second) ** 2
    return product / (in_first[:, :2] ** 2).sum(axis=1), product / (in_second[:, :2] ** 2).sum(axis=1)


def _transfer_errors(homography: Array, first: Array, second: Array) -> tuple[Array, Array]:
    """Squared distances (n,) between mapped and seen pixels in either image, px^2."""

    def map_by(matrix: Array, pixels: Array) -> Array:
        mapped = np.column_stack([pixels, np.ones(len(pixels))]) @ matrix.T
        return mapped[:, :2] / mapped[:, 2:]

    forward = ((map_by(homography, first) - second) ** 2).sum(axis=1)
    backward = ((map_by(np.asarray(np.linalg.inv(homography), dtype=float), second) - first) ** 2).sum(axis=1)
    return backward, forward


def two_view_hypotheses(first: Array, second: Array, intrinsics: Array) -> list[TwoViewHypothesis]:
    """Relative poses that matched pixels (n, 2) allow, most points in front first; empty if none is clear."""
    matrix = camera_matrix(intrinsics)
    cv2.setRNGSeed(0)
    essential, _ = cv2.findEssentialMat(first, second, matrix, method=cv2.USAC_MAGSAC, threshold=1.5, prob=0.9999)
    homography, _ = cv2.findHomography(first, second, cv2.USAC_MAGSAC, 2.0, None, 2000, 0.9999)
    if essential is None or homography is None or essential.shape != (3, 3):
        return []
    essential, homography = np.asarray(essential, dtype=float), np.asarray(homography, dtype=float)
    by_lines = sum(_score(e, CHI2_ONE) for e in epipolar_errors(essential, first, second, intrinsics))
    by_plane = sum(_score(e, CHI2_TWO) for e in _transfer_errors(homography, first, second))
    if by_plane > PLANE_SHARE * (by_plane + by_lines):
        _, rotations, shifts, _ = cv2.decomposeHomographyMat(homography, matrix)
        motions = [(r, s.ravel()) for r, s in zip(rotations, shifts, strict=True) if np.linalg.norm(s) > 1e-9]
    else:
        one, other, shift = cv2.decomposeEssentialMat(essential)
        motions = [(r, sign * shift.ravel()) for r in (one, other) for sign in (1.0, -1.0)]
    hypotheses = [
        _hypothesis(np.asarray(r, dtype=float), np.asarray(s, dtype=float), first, second, intrinsics)
        for r, s in motions
    ]
    hypotheses.sort(key=lambda hypothesis: -int(hypothesis.good.sum()))
    return hypotheses


def _hypothesis(rotation: Array, shift: Array, first: Array, second: Array, intrinsics: Array) -> TwoViewHypothesis:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, shift / np.linalg.norm(shift)
    points = triangulate(np.eye(4), pose, rays(first, intrinsics), rays(second, intrinsics))
    good = check_points(points, [np.eye(4), pose], [first, second], intrinsics, MOST_MISS_PX)
    points[~good] = np.nan
    angles = ray_angles(points[good], np.zeros(3), camera_centre(pose))
    return TwoViewHypothesis(pose, points, float(np.median(angles)) if good.any() else 0.0)
