"""Structure from two views: essential matrix or homography, whichever explains the motion, and triangulation.

The choice follows ORB-SLAM (Mur-Artal et al. 2015, IV-B): where a homography explains the matches about as
well as an essential matrix does, the scene is plane or the camera has only turned, and the motion is taken
from the homography's decomposition (Malis and Vargas 2007). A plane leaves two solutions; both are returned,
and a third view decides.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

#: Share of homography score above which the homography is believed (ORB-SLAM's value).
PLANE_SHARE = 0.45
#: Squared errors that 95 % of the inliers stay below, for one and two degrees of freedom, in pixel variances.
CHI2_ONE, CHI2_TWO = 3.841, 5.991


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


def triangulate(
    first_from_world: Array, second_from_world: Array, first_rays: Array, second_rays: Array
) -> Array:
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
        local = points @ pose[:3, :3].T + pose[:3, 3]
        with np.errstate(divide="ignore", invalid="ignore"):
            projected = local[:, :2] / local[:, 2:] * intrinsics[:2] + intrinsics[2:]
            good &= (local[:, 2] > 0.0) & (np.linalg.norm(projected - seen, axis=1) < max_px)
    return good


def _score(squared_errors: Array, limit: float) -> float:
    """ORB-SLAM's score: what each inlier gains over the largest error that two degrees of freedom allow."""
    return float(np.sum(np.where(squared_errors < limit, CHI2_TWO - squared_errors, 0.0)))


def _epipolar_errors(essential: Array, first: Array, second: Array, intrinsics: Array) -> tuple[Array, Array]:
    """Squared distances (n,) to the epipolar lines in either image, px^2."""
    inverse = np.diag([1.0 / intrinsics[0], 1.0 / intrinsics[1], 1.0])
    inverse[:2, 2] = -intrinsics[2:] / intrinsics[:2]
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


def two_view_hypotheses(
    first: Array, second: Array, intrinsics: Array, noise_px: float = 1.0
) -> list[TwoViewHypothesis]:
    """Relative poses that matched pixels (n, 2) allow, most points in front first; empty if none is clear."""
    matrix = np.array(
        [[intrinsics[0], 0.0, intrinsics[2]], [0.0, intrinsics[1], intrinsics[3]], [0.0, 0.0, 1.0]]
    )
    cv2.setRNGSeed(0)
    essential, _ = cv2.findEssentialMat(
        first, second, matrix, method=cv2.USAC_MAGSAC, threshold=1.5 * noise_px, prob=0.9999
    )
    homography, _ = cv2.findHomography(first, second, cv2.USAC_MAGSAC, 2.0 * noise_px, None, 2000, 0.9999)
    if essential is None or homography is None or essential.shape != (3, 3):
        return []
    essential, homography = np.asarray(essential, dtype=float), np.asarray(homography, dtype=float)
    variance = noise_px**2
    by_lines = sum(
        _score(e / variance, CHI2_ONE) for e in _epipolar_errors(essential, first, second, intrinsics)
    )
    by_plane = sum(_score(e / variance, CHI2_TWO) for e in _transfer_errors(homography, first, second))
    if by_plane > PLANE_SHARE * (by_plane + by_lines):
        _, rotations, shifts, _ = cv2.decomposeHomographyMat(homography, matrix)
        motions = [(r, s.ravel()) for r, s in zip(rotations, shifts, strict=True) if np.linalg.norm(s) > 1e-9]
    else:
        one, other, shift = cv2.decomposeEssentialMat(essential)
        motions = [(r, sign * shift.ravel()) for r in (one, other) for sign in (1.0, -1.0)]
    hypotheses = [
        _hypothesis(
            np.asarray(r, dtype=float), np.asarray(s, dtype=float), first, second, intrinsics, noise_px
        )
        for r, s in motions
    ]
    hypotheses.sort(key=lambda hypothesis: -int(hypothesis.good.sum()))
    return hypotheses


def _hypothesis(
    rotation: Array, shift: Array, first: Array, second: Array, intrinsics: Array, noise_px: float
) -> TwoViewHypothesis:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, shift / np.linalg.norm(shift)
    rays = [
        np.column_stack([(p - intrinsics[2:]) / intrinsics[:2], np.ones(len(p))]) for p in (first, second)
    ]
    points = triangulate(np.eye(4), pose, *rays)
    good = check_points(points, [np.eye(4), pose], [first, second], intrinsics, 2.5 * noise_px)
    points[~good] = np.nan
    angles = ray_angles(points[good], np.zeros(3), camera_centre(pose))
    return TwoViewHypothesis(pose, points, float(np.median(angles)) if good.any() else 0.0)
