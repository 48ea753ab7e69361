"""The camera's pose by the map points that one frame shows, where parts of the scene may move."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from morph_dslam.slam.options import INLIER_PX, LEAST_INLIERS
from morph_dslam.slam.pose import PoseEstimate, find_pose, refine_pose, reprojection_errors
from morph_dslam.slam.result import NoPose, SlamReason
from morph_dslam.slam.rigid_map import Followed, RigidMap

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
#: Errors beyond these multiples of the usual one count linearly, and not at all; within bounds, in pixels.
#: With wider ones a near object that moves draws the pose along: a turn and a move of the camera nearly
#: explain it.
HUBER_RATIO, MOST_HUBER_PX = 1.5, 1.5
INLIER_RATIO, LEAST_INLIER_PX = 4.0, 1.5
#: For the same reason points do not count at first that miss the prediction by this multiple of the median.
TRUSTED_RATIO = 3.0
#: A point fits as well as usual within this multiple of the usual error, at least in so many pixels. A misfit
#: (`misfit`) above this calls for another pose, which has to lower it to this part.
CORE_RATIO, LEAST_CORE_PX = 2.0, 0.6
MOST_MISFIT, CLEARLY_BETTER = 0.35, 0.85
#: Points first seen so many keyframes ago decide between two poses, if there are enough: points that came
#: with an object while it moved along with the camera must not outvote them.
SENIOR_AGE, LEAST_SENIORS = 3, 30
#: Points that leave together, by a motion of their own, and are as many as this part of those that stay: then
#: which of them stands still is ambiguous.
RIVAL_SHARE = 0.6


def misfit(errors: Array, core_px: float) -> float:
    """Mean of squared errors (n,) in units of ``core_px``, each at most 1."""
    return float(np.mean(np.minimum(errors / core_px, 1.0) ** 2))


class Sight:
    """Points of a map as one frame shows them, and the pose that most of them agree on.

    Least squares from the predicted pose is exact while nearly all points obey the rigid scene. When a part of the
    scene begins to move slowly, such a fit gives way a little everywhere. So a fit that is worse than usual is compared
    with what RANSAC finds: the pose for which most points fit as well as usual. Points that have been in the map for
    long decide; without them, in a map of one camera, least squares does.

    Parameters
    ----------
    seen : map points, and where the frame shows them.
    """

    def __init__(self, rigid_map: RigidMap, seen: Followed, intrinsics: Array) -> None:
        self._seen, self._intrinsics = seen, intrinsics
        self._positions, self._baseline_px = rigid_map.positions[seen.ids], rigid_map.baseline_px
        senior = rigid_map.first_keyframe[seen.ids] < len(rigid_map.keyframes) - SENIOR_AGE
        has_seniors = senior.sum() >= LEAST_SENIORS
        self._judges = senior if has_seniors else np.ones(len(senior), dtype=bool)
        # One camera's first keyframes are so near to each other that the depths are still inexact: then parts of the
        # scene at other distances seem to move.
        self._is_reliable = has_seniors or rigid_map.is_metric
        usual_px = rigid_map.usual_rms_px
        self._huber_px = min(HUBER_RATIO * usual_px, MOST_HUBER_PX)
        self._inlier_px = min(max(INLIER_RATIO * usual_px, LEAST_INLIER_PX), INLIER_PX)
        self._core_px = min(max(CORE_RATIO * usual_px, LEAST_CORE_PX), self._inlier_px)

    def pose(self, predicted: Array) -> PoseEstimate | NoPose:
        """The pose, from a predicted one (4, 4), or why there is none.

        Least squares first; where that is worse than usual, RANSAC with P3P (Fischler and Bolles 1981).
        """
        n_seen, least = len(self._seen.ids), LEAST_INLIERS
        if n_seen < least:
            return NoPose(SlamReason.FEW_POINTS, (n_seen,))
        errors = self._errors(predicted)
        near = errors < max(TRUSTED_RATIO * float(np.median(errors)), self._inlier_px)
        pose = self._fit(predicted, near)
        if self._is_reliable and misfit(self._errors(pose.camera_from_world), self._core_px) > MOST_MISFIT:
            pose = self._of_most(pose)
        n = int(pose.inliers.sum())
        if n < max(least, 0.3 * n_seen):
            return NoPose(SlamReason.FEW_INLIERS, (n, n_seen))
        if self._has_rival(pose):
            return NoPose(SlamReason.RIVAL_MOTIONS)
        return pose

    def _errors(self, pose: Array) -> Array:
        return reprojection_errors(pose, self._positions, self._seen.pixels, self._intrinsics)

    def _fit(self, near: Array, trusted: Mask) -> PoseEstimate:
        return refine_pose(
            near,
            self._positions,
            self._seen.pixels,
            self._intrinsics,
            huber_px=self._huber_px,
            inlier_px=self._inlier_px,
            trusted=trusted,
            right=self._seen.right,
            baseline_px=self._baseline_px,
        )

    def _found(self, rows: Mask, most_px: float, least: int) -> PoseEstimate | None:
        return find_pose(self._positions[rows], self._seen.pixels[rows], self._intrinsics, most_px, least)

    def _of_most(self, fitted: PoseEstimate) -> PoseEstimate:
        """The pose that the judging points fit clearly better than ``fitted``, if there is one."""
        judges = self._judges
        found = self._found(judges, self._core_px, LEAST_INLIERS)
        if found is None:
            return fitted
        near = judges & (self._errors(found.camera_from_world) < self._inlier_px)
        other = self._fit(found.camera_from_world, near)
        before, after = (misfit(self._errors(p.camera_from_world)[judges], self._core_px) for p in (fitted, other))
        return other if after < CLEARLY_BETTER * before else fitted

    def _has_rival(self, pose: PoseEstimate) -> bool:
        """Whether judges that do not fit agree on another pose, and are nearly as many as the rest."""
        others, n_fit = self._judges & ~pose.inliers, int((self._judges & pose.inliers).sum())
        enough = max(LEAST_INLIERS, int(np.ceil(RIVAL_SHARE * n_fit)))
        return bool(others.sum() >= enough) and self._found(others, self._inlier_px, enough) is not None
