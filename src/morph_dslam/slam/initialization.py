"""The start of a map from one moving camera.

Corners of a first view are followed. When their rays have opened far enough, the motions that two views allow
are listed; they wait until a third view has moved on, and only the one that explains all three views, clearly
better than every other, becomes the map. Otherwise nothing is accepted and the reason is said.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from morph_dslam.geometry import rotation_log
from morph_dslam.slam.bundle_adjustment import Observations, adjust
from morph_dslam.slam.frame_images import FrameView
from morph_dslam.slam.options import LEAST_CORRELATION, LEAST_START_POINTS, PATCH_HALF
from morph_dslam.slam.pose import TwoViewHypothesis, rays, refine_pose, reprojection_errors, two_view_hypotheses
from morph_dslam.slam.result import NoPose, SlamReason
from morph_dslam.slam.rolling_shutter import velocities
from morph_dslam.tracking.patches import FLOW_WINDOW, follow, patch_correlation, spread_corners

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
#: Corners that are followed from the first view.
START_CORNERS = 500
#: Median angle between the first two views' rays, degrees.
START_PARALLAX_DEG = 1.2
#: Share of the points that a turn of the camera must explain, as most may lie on one wall that it turns about; and how
#: well, over the distance that belongs to that parallax.
TURNED_SHARE, TURNED = 0.9, 0.55
#: Error in pixels, and share of the points that must fit, in three views.
START_RMS_PX, START_SHARE = 1.0, 0.9
#: How much larger a rejected hypothesis' squared error must be than the accepted one's.
START_CLEARNESS = 1.5
#: Squared error at which an observation stops to count more, px^2.
MOST_SQUARED = 16.0
#: Two hypotheses are the same if their second cameras differ by less than this after adjustment.
SAME_DEG = 1.0
#: Third views that may leave the choice open before the second view is chosen anew.
MOST_OPEN_VIEWS = 8


@dataclass(frozen=True)
class View:
    """A frame and where the corners (n, 2) of the first view are in it."""

    frame: FrameView
    pixels: Array


@dataclass(frozen=True)
class _Structure:
    """Three views explained: poses (3, 4, 4), points (n, 3), which of them fit, and the errors."""

    poses: Array
    points: Array
    fits: Mask
    rms_px: float
    mean_squared: float


@dataclass(frozen=True)
class MapStart:
    """An accepted start: three views of the same points and their structure, first camera at the origin.

    ``twists`` (3, 6) are the cameras' velocities, NaN where unknown.
    """

    views: tuple[View, View, View]
    poses: Array
    points: Array
    twists: Array


def turn_residual_px(first: Array, second: Array, intrinsics: Array) -> float:
    """Distance, in pixels, that a pure turn of the camera leaves at most in `TURNED_SHARE` of matched pixels (n, 2)."""
    a, b = rays(first, intrinsics), rays(second, intrinsics)
    unit_a, unit_b = (x / np.linalg.norm(x, axis=1, keepdims=True) for x in (a, b))
    used = np.ones(len(a), dtype=bool)
    distance = np.zeros(len(a))
    for _ in range(3):
        u, _, vt = np.linalg.svd(unit_b[used].T @ unit_a[used])
        rotation = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
        moved = a @ rotation.T
        distance = np.linalg.norm((moved[:, :2] / moved[:, 2:] - b[:, :2]) * intrinsics[:2], axis=1)
        used = distance <= np.quantile(distance, 0.7)
    return float(np.quantile(distance, TURNED_SHARE))


class MapInitializer:
    """Follows corners until they make a map.

    Parameters
    ----------
    intrinsics : (4,) fx, fy, cx, cy of the undistorted images.
    """

    def __init__(self, intrinsics: Array) -> None:
        self._intrinsics = intrinsics
        self.reset()

    def reset(self) -> None:
        """Forget all views."""
        self._first: View | None = None
        self._soon: View | None = None
        self._alive = np.empty(0, dtype=bool)
        self._pixels = np.empty((0, 2))
        self._drop_second()

    @property
    def followed(self) -> Array:
        """Pixels (n, 2) of the corners followed in the newest frame."""
        return self._pixels[self._alive]

    def process(self, frame: FrameView) -> MapStart | NoPose:
        """Take in a frame; a start, or the reason why there is none yet."""
        if self._first is None:
            return self._take_reference(frame)
        self._follow(frame.normalized)
        if self._alive.sum() < max(LEAST_START_POINTS, 0.4 * len(self._alive)):
            reason = self._take_reference(frame)
            return NoPose(SlamReason.FIRST_VIEW_LOST, cause=reason)
        view = View(frame, self._pixels.copy())
        self._soon = self._soon or view
        return self._verify(view) if self._second is not None else self._propose(view)

    def _take_reference(self, frame: FrameView) -> NoPose:
        mask = np.zeros(frame.normalized.shape, dtype=np.uint8)
        border = FLOW_WINDOW
        mask[border:-border, border:-border] = 255
        corners = spread_corners(frame.normalized, mask, START_CORNERS)
        self.reset()
        if len(corners) < LEAST_START_POINTS:
            return NoPose(SlamReason.LITTLE_TEXTURE, (len(corners),))
        self._first = View(frame, corners)
        self._pixels, self._alive = corners.copy(), np.ones(len(corners), dtype=bool)
        return NoPose(SlamReason.NO_MOTION)

    def _follow(self, normalized: NDArray[np.uint8]) -> None:
        assert self._first is not None
        rows = np.flatnonzero(self._alive)
        start = self._first.pixels[rows]
        first = self._first.frame.normalized
        found, ok = follow(first, normalized, start, self._pixels[rows])
        back, ok_back = follow(normalized, first, found, start)
        ok &= ok_back & (np.linalg.norm(back - start, axis=1) < 1.0)
        likeness = patch_correlation(first, normalized, start, found, PATCH_HALF)
        ok &= likeness > LEAST_CORRELATION
        self._alive[rows[~ok]] = False
        self._pixels[rows] = found

    def _propose(self, view: View) -> NoPose:
        """List what two views allow."""
        assert self._first is not None
        rows = np.flatnonzero(self._alive)
        first, second = self._first.pixels[rows], view.pixels[rows]
        needed = np.radians(START_PARALLAX_DEG) * self._intrinsics[0]
        # No triangulation needed to see that the camera has hardly moved, or only turned.
        if turn_residual_px(first, second, self._intrinsics) < TURNED * needed:
            return NoPose(SlamReason.ONLY_TURNED)
        hypotheses = two_view_hypotheses(first, second, self._intrinsics)
        if not hypotheses or hypotheses[0].good.sum() < START_SHARE * len(rows):
            return NoPose(SlamReason.NO_TWO_VIEW_MOTION)
        likely = [h for h in hypotheses if h.good.sum() >= 0.6 * hypotheses[0].good.sum()]
        parallax_deg = max(h.parallax_deg for h in likely)
        if parallax_deg < START_PARALLAX_DEG:
            return NoPose(SlamReason.LITTLE_PARALLAX, (parallax_deg,))
        self._second, self._hypotheses, self._rows = view, likely, rows
        return NoPose(SlamReason.THIRD_VIEW_NEEDED, (len(likely),))

    def _verify(self, view: View) -> MapStart | NoPose:
        """Accept the hypothesis that a third view singles out."""
        assert self._first is not None
        assert self._second is not None
        alive = self._alive[self._rows]
        rows = self._rows[alive]
        between = turn_residual_px(self._second.pixels[rows], view.pixels[rows], self._intrinsics)
        before = turn_residual_px(self._first.pixels[rows], self._second.pixels[rows], self._intrinsics)
        if between < 0.3 * before:
            return NoPose(SlamReason.THIRD_VIEW_TOO_NEAR)
        views = (self._first, self._second, view)
        pixels = [v.pixels[rows] for v in views]
        found = [self._structure(h, h.points[alive], pixels) for h in self._hypotheses]
        found = sorted((s for s in found if s is not None), key=lambda s: s.mean_squared)
        self._open_views += 1
        reason = self._objection(found, len(rows))
        if reason is not None:
            if self._open_views >= MOST_OPEN_VIEWS:
                self._drop_second()
            return reason
        best = found[0]
        chosen = tuple(View(v.frame, v.pixels[rows][best.fits]) for v in views)
        twists = self._velocities(best, rows[best.fits], view.frame)
        return MapStart(chosen, best.poses, best.points[best.fits], twists)  # type: ignore[arg-type]

    def _velocities(self, best: _Structure, rows: NDArray[np.int64], third: FrameView) -> Array:
        """The cameras' velocities (3, 6): of the first by the frame after it, of the others by each other."""
        assert self._first is not None
        assert self._second is not None
        assert self._soon is not None
        soon = refine_pose(np.eye(4), best.points[best.fits], self._soon.pixels[rows], self._intrinsics)
        frames = [self._first.frame, self._soon.frame, self._second.frame, third]
        poses = np.stack([np.eye(4), soon.camera_from_world, *best.poses[1:]])
        return velocities(np.array([frame.timestamp for frame in frames]), poses)[[0, 2, 3]]

    def _drop_second(self) -> None:
        self._second: View | None = None
        self._hypotheses: list[TwoViewHypothesis] = []
        self._rows = np.empty(0, dtype=np.int64)
        self._open_views = 0

    def _structure(self, hypothesis: TwoViewHypothesis, points: Array, pixels: list[Array]) -> _Structure | None:
        """A hypothesis adjusted to three views; None if the third camera cannot be placed."""
        known = np.isfinite(points[:, 0])
        if known.sum() < LEAST_START_POINTS:
            return None
        pose = refine_pose(
            hypothesis.second_from_first, points[known], pixels[2][known], self._intrinsics, inlier_px=6.0
        ).camera_from_world
        n = int(known.sum())
        observations = Observations(
            np.repeat(np.arange(3), n), np.tile(np.arange(n), 3), np.concatenate([p[known] for p in pixels])
        )
        start = np.stack([np.eye(4), hypothesis.second_from_first, pose])
        fixed = np.array([True, False, False])
        adjusted = adjust(start, points[known], observations, self._intrinsics, fixed, huber_px=1.0, iterations=30)
        errors = np.full((3, len(points)), np.inf)
        for view in range(3):
            errors[view, known] = reprojection_errors(
                adjusted.camera_from_world[view], adjusted.points, pixels[view][known], self._intrinsics
            )
        fits = np.asarray((errors < 2.0).all(axis=0))
        mean_squared = float(np.mean(np.minimum(errors**2, MOST_SQUARED)))
        rms = float(np.sqrt(np.mean(errors[:, fits] ** 2))) if fits.any() else np.inf
        all_points = np.full_like(points, np.nan)
        all_points[known] = adjusted.points
        return _Structure(adjusted.camera_from_world, all_points, fits, rms, mean_squared)

    def _objection(self, found: list[_Structure], n_points: int) -> NoPose | None:
        """Why the best structure may not be accepted; None if it may."""
        if not found:
            return NoPose(SlamReason.THIRD_VIEW_UNEXPLAINED)
        best = found[0]
        if best.fits.sum() < max(LEAST_START_POINTS, START_SHARE * n_points):
            return NoPose(SlamReason.FEW_RIGID_POINTS, (int(best.fits.sum()), n_points))
        if best.rms_px > START_RMS_PX:
            return NoPose(SlamReason.LARGE_RIGID_ERROR, (best.rms_px,))
        for other in found[1:]:
            if other.mean_squared < START_CLEARNESS * best.mean_squared and not _same(best, other):
                return NoPose(SlamReason.AMBIGUOUS_MOTION)
        return None


def _same(one: _Structure, other: _Structure) -> bool:
    """Whether two structures are one up to scale."""
    for view in (1, 2):
        turn = np.linalg.norm(rotation_log(one.poses[view, :3, :3] @ other.poses[view, :3, :3].T))
        a, b = one.poses[view, :3, 3], other.poses[view, :3, 3]
        cosine = a @ b / max(float(np.linalg.norm(a) * np.linalg.norm(b)), 1e-12)
        if np.degrees(turn) > SAME_DEG or cosine < np.cos(np.radians(10.0 * SAME_DEG)):
            return False
    return True
