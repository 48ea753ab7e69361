"""Following the map from frame to frame: where its points are now, and from them the camera's pose.

Each point is followed from a keyframe that saw it, not from the previous frame, so that errors do not add up; the
previous frame only says where to begin. Where the view has changed much, the keyframe is first warped as if its scene
were a plane at the points' median depth (Klein and Murray 2007 warp each patch by itself). Points lost from sight are
looked for again where the pose says they are. Points that leave the place where a rigid scene has them do not count for
the pose, but are followed on.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

from morph_dslam.slam.frame_images import FrameDepth
from morph_dslam.slam.options import INLIER_PX, LEAST_CORRELATION, LEAST_INLIERS, PATCH_HALF
from morph_dslam.slam.pose import (
    LEAST_DEPTH,
    PoseEstimate,
    camera_centre,
    camera_matrix,
    find_pose,
    inside,
    inverse,
    project,
    refine_pose,
    reprojection_errors,
)
from morph_dslam.slam.result import NoPose, SlamReason
from morph_dslam.slam.rigid_map import (
    CANDIDATE,
    FIRST_RMS_PX,
    GOOD,
    NOWHERE,
    REMOVED,
    Followed,
    Indices,
    Keyframe,
    RigidMap,
)
from morph_dslam.tracking.patches import FLOW_WINDOW, LEVELS, NEUTRAL, follow, patch_correlation

Array = NDArray[np.float64]
#: Keyframes chosen for most points; one that adds fewer points than this is not worth its image.
MOST_VIEWS, LEAST_POINTS = 4, 10


class FewTemplates:
    """Chooses templates in a complete map."""

    def __init__(self, rigid_map: RigidMap) -> None:
        self._map = rigid_map
        self._seen = np.concatenate([keyframe.point_ids for keyframe in rigid_map.keyframes])
        counts = [len(keyframe.point_ids) for keyframe in rigid_map.keyframes]
        self._seen_by = np.repeat(np.arange(len(counts)), counts)

    def choose(self, ids: Indices) -> tuple[Indices, Array]:
        """Keyframe (n,) and pixels (n, 2) there to look for each point from.

        Keyframes that show most of the points left are taken one after the other; the last points keep the
        map's templates.
        """
        views, pixels = self._map.template_keyframe[ids], self._map.template_pixels[ids]
        left, n_keyframes = np.ones(len(ids), dtype=bool), len(self._map.keyframes)
        wanted = np.zeros(len(self._map.state), dtype=bool)
        for _ in range(MOST_VIEWS):
            wanted[:] = False
            wanted[ids[left]] = True
            counts = np.bincount(self._seen_by[wanted[self._seen]], minlength=n_keyframes)
            best = int(counts.argmax())
            if counts[best] < LEAST_POINTS:
                break
            keyframe = self._map.keyframes[best]
            rows, seen = keyframe.rows_of(ids)
            seen &= left
            views[seen], pixels[seen] = best, keyframe.pixels[rows[seen]]
            left &= ~seen
        return views, pixels


Image = NDArray[np.uint8]
#: Patches that are turned by less and scaled by less, along either axis, are followed as they are.
MOST_TURN_DEG, MOST_STRETCH = 14.0, 1.25
#: A warped view is used again while what it lacks is this part of those.
REUSE = 0.5


def plane_homography(keyframe_pose: Array, pose: Array, depth: float, intrinsics: Array) -> Array:
    """Pixels from a keyframe's pixels (3, 3), for a plane at a depth that is parallel to its image.

    Poses (4, 4) are camera_from_world.
    """
    matrix = camera_matrix(intrinsics)
    relative = pose @ inverse(keyframe_pose)
    plane = relative[:3, :3].copy()
    plane[:, 2] += relative[:3, 3] / depth
    return matrix @ plane @ np.linalg.inv(matrix)


def warp_pixels(homography: Array, pixels: Array) -> Array:
    """Pixels (n, 2) moved by a homography (3, 3)."""
    moved = pixels @ homography[:, :2].T + homography[:, 2]
    return moved[:, :2] / moved[:, 2:]


def local_change(homography: Array, pixel: Array) -> Array:
    """Derivative (2, 2) of a homography at a pixel (2,)."""
    x, y, w = homography @ [*pixel, 1.0]
    return np.array([homography[0, :2] * w - x * homography[2, :2], homography[1, :2] * w - y * homography[2, :2]]) / (
        w * w
    )


def is_small(change: Array, part: float = 1.0) -> bool:
    """Whether patches changed by this matrix (2, 2) can be followed as they are."""
    (a, b), (c, d) = change.tolist()
    # The turn of the nearest rotation, and the singular values of a 2 x 2 matrix.
    turn, sheared = math.hypot(a + d, c - b), math.hypot(a - d, c + b)
    largest, smallest = 0.5 * (turn + sheared), 0.5 * (turn - sheared)
    angle = abs(math.degrees(math.atan2(c - b, a + d)))
    limit = MOST_STRETCH**part
    return angle < part * MOST_TURN_DEG and largest < limit and smallest > 1.0 / limit


class WarpedViews:
    """Keyframes as seen from about where the camera is."""

    def __init__(self, intrinsics: Array) -> None:
        self._intrinsics = intrinsics
        self._views: dict[int, tuple[Array, Image]] = {}

    def view(self, number: int, keyframe: Keyframe, pose: Array, depth: float) -> tuple[Image, Array | None]:
        """The image (h, w) to look for patches of, and the homography (3, 3) from the keyframe's pixels.

        That is None where the keyframe itself will do. ``pose`` (4, 4) is camera from world, ``depth`` that
        of the points before the keyframe, in the map's unit.
        """
        now = plane_homography(keyframe.camera_from_world, pose, depth, self._intrinsics)
        centre = self._intrinsics[2:]
        change = local_change(now, centre)
        if is_small(change) or not np.isfinite(change).all() or np.linalg.det(change) <= 0.0:
            return keyframe.normalized, None
        if number in self._views:
            before, image = self._views[number]
            if is_small(change @ np.linalg.inv(local_change(before, centre)), REUSE):
                return image, before
        image = cv2.warpPerspective(keyframe.normalized, now, keyframe.normalized.shape[::-1], borderValue=NEUTRAL)
        self._views[number] = now, np.asarray(image, dtype=np.uint8)
        return self._views[number][1], now


Mask = NDArray[np.bool_]
#: Points are looked for from a keyframe only if they are seen from there at about this angle and distance.
MOST_VIEW_ANGLE_DEG = 35.0
MOST_SCALE_CHANGE = 1.6
#: A point not found in this share of the frames in which it was looked for is looked for after all others.
DOUBTFUL_SHARE = 0.25
#: Points that disagree have moved if they did so in the frame before, too, or if all at once they are more
#: than this share of the points that agree.
MOST_LEAVING = 0.1
#: Lost points looked for in a frame, from at most so many keyframes.
SEARCH_POINTS, SEARCH_KEYFRAMES = 80, 3
#: In a frozen map lost points are looked for while fewer than this are followed.
ENOUGH_POINTS = 340
#: How far from its predicted pixel a lost point may be found.
SEARCH_RADIUS_PX = 5.0
#: Weight of the newest frame in the usual error.
USUAL_RATE = 0.1
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
    long decide.

    Parameters
    ----------
    seen : map points, and where the frame shows them.
    """

    def __init__(self, rigid_map: RigidMap, seen: Followed, intrinsics: Array) -> None:
        self._seen, self._intrinsics = seen, intrinsics
        self._positions, self._baseline_px = rigid_map.positions[seen.ids], rigid_map.baseline_px
        senior = rigid_map.first_keyframe[seen.ids] < len(rigid_map.keyframes) - SENIOR_AGE
        self._judges = senior if senior.sum() >= LEAST_SENIORS else np.ones(len(senior), dtype=bool)
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
        if misfit(self._errors(pose.camera_from_world), self._core_px) > MOST_MISFIT:
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


@dataclass(frozen=True)
class Tracked:
    """A frame's pose and points.

    Attributes
    ----------
    pose : from the map points; its ``inliers`` belong to the rows of ``points`` that are map points.
    points : inliers and candidates.
    disagreeing : points that look like their map point but are not where a rigid scene would have them.
    moved : (m,) those that surely have moved.
    image_motion_px : how far the points moved since the previous frame, median.
    """

    pose: PoseEstimate
    points: Followed
    n_inliers: int
    disagreeing: Followed
    moved: Indices = field(default_factory=lambda: NOWHERE.ids)
    image_motion_px: float = 0.0


class Tracker:
    """Follows the points of a map.

    Attributes
    ----------
    camera_from_world : (4, 4) the newest pose.
    points : what is followed.
    """

    def __init__(self, rigid_map: RigidMap, intrinsics: Array) -> None:
        self._map = rigid_map
        self._intrinsics = intrinsics
        self._motion = np.eye(4)
        self._warped = WarpedViews(intrinsics)
        self._templates: FewTemplates | None = None
        self._astray = NOWHERE
        self.camera_from_world = np.eye(4)
        self.points = NOWHERE

    def place(self, camera_from_world: Array, points: Followed) -> None:
        """Go on from a pose found by other means, as if the camera had stood still."""
        self.camera_from_world, self.points, self._motion = camera_from_world, points, np.eye(4)
        self._astray = NOWHERE

    def correct(self, before: Array, after: Array) -> None:
        """Move along with the newest keyframe, whose pose (4, 4) was ``before`` and now is ``after``."""
        self.camera_from_world = self.camera_from_world @ inverse(before) @ after

    def take_up(self, ids: Indices) -> None:
        """Follow further points, from where the newest pose has them."""
        pixels, _ = project(self.camera_from_world, self._map.positions[ids], self._intrinsics)
        followed = np.concatenate([self.points.ids, self._astray.ids])
        new = Followed(ids, pixels)[np.isfinite(pixels[:, 0]) & ~np.isin(ids, followed)]
        self.points = self.points.joined(new)

    def drop_candidates(self) -> None:
        """Follow map points only."""
        self.points = self.points[self._map.state[self.points.ids] == GOOD]

    def choose_templates(self) -> None:
        """The map is complete: look for points from the few keyframes that show most of them."""
        self._templates = FewTemplates(self._map)

    def track(self, normalized: Image, depth: FrameDepth | None = None) -> Tracked | NoPose:
        """Pose and points of the next frame, or why it is lost; then the newest pose stays what it was."""
        reasons = []
        # The prediction is that the motion goes on; if it has changed abruptly, that the camera stands still.
        for predicted, levels in (
            (self._motion @ self.camera_from_world, LEVELS),
            (self.camera_from_world, LEVELS + 1),
        ):
            found = self._follow(normalized, predicted, levels)
            result = self._estimate(normalized, depth, predicted, found)
            if isinstance(result, Tracked):
                self._motion = result.pose.camera_from_world @ inverse(self.camera_from_world)
                self.camera_from_world = result.pose.camera_from_world
                self.points, self._astray = result.points, result.disagreeing
                rate = 1.0 if self._map.usual_rms_px == FIRST_RMS_PX else USUAL_RATE
                self._map.usual_rms_px += rate * (result.pose.rms_px - self._map.usual_rms_px)
                self._note_candidates(result.points)
                return result
            reasons.append(result)
        return reasons[0]

    def _note_candidates(self, points: Followed) -> None:
        """Let the map know where points without depth are."""
        if self._templates is not None:
            return
        waiting = points[self._map.state[points.ids] == CANDIDATE]
        newest = len(self._map.keyframes) - 1
        at = self._map.keyframes[newest].camera_from_world
        self._map.passing.note(newest, at, self.camera_from_world, waiting.ids, waiting.pixels)

    def _follow(self, normalized: Image, predicted: Array, levels: int) -> Followed:
        """Followed points, astray ones too, found again, begun where the predicted motion takes them."""
        # A further keyframe costs as much as all points of one: those astray come along with others only.
        views = self._map.template_keyframe
        along = np.isin(views[self._astray.ids], views[self.points.ids])
        points = self.points.joined(self._astray[along])
        # The mapper may have taken some out, and the view with their patches too.
        points = points[self._map.state[points.ids] != REMOVED]
        positions = self._map.positions[points.ids]
        before, _ = project(self.camera_from_world, positions, self._intrinsics)
        after, _ = project(predicted, positions, self._intrinsics)
        guesses = points.pixels + np.nan_to_num(after - before)
        return self.find(normalized, Followed(points.ids, guesses), predicted, levels)

    def _still_astray(self, pose: Array, followed: Followed) -> Followed:
        """Those of the points that had left the rigid scene that are still away from their places."""
        followed = followed[self._map.state[followed.ids] == GOOD]
        positions = self._map.positions[followed.ids]
        errors = reprojection_errors(pose, positions, followed.pixels, self._intrinsics)
        return followed[errors > INLIER_PX]

    def find(self, normalized: Image, guesses: Followed, pose: Array, levels: int) -> Followed:
        """Points found near their guessed pixels, by the patches of their keyframes as seen from a pose."""
        ids = guesses.ids
        if self._templates is not None:
            views, templates = self._templates.choose(ids)
        else:
            views, templates = self._map.template_keyframe[ids], self._map.template_pixels[ids]
        found, good = guesses.pixels.copy(), np.zeros(len(ids), dtype=bool)
        for view in np.unique(views):
            rows = np.flatnonzero((views == view) & inside(guesses.pixels, normalized.shape, 0.0))
            source, starts = self._seen_from(pose, int(view), ids[rows], templates[rows])
            pixels, ok = follow(source, normalized, starts, guesses.pixels[rows], levels)
            likeness = patch_correlation(source, normalized, starts, pixels, PATCH_HALF)
            found[rows], good[rows] = pixels, ok & (likeness > LEAST_CORRELATION)
        return Followed(ids, found)[good]

    def _seen_from(self, pose: Array, number: int, ids: Indices, pixels: Array) -> tuple[Image, Array]:
        """A keyframe's image, warped where it looks much different from the pose, and its pixels there."""
        keyframe = self._map.keyframes[number]
        if not len(ids):
            return keyframe.normalized, pixels
        _, depths = project(keyframe.camera_from_world, self._map.positions[ids], self._intrinsics)
        depth = max(float(np.median(depths)), LEAST_DEPTH)
        image, homography = self._warped.view(number, keyframe, pose, depth)
        return image, pixels if homography is None else warp_pixels(homography, pixels)

    def measured(self, found: Followed, pose: Array, depth: FrameDepth | None) -> Followed:
        """Map points with their columns in the right image, where those are near what the pose expects."""
        baseline_px, known = self._map.baseline_px, np.flatnonzero(self._map.state[found.ids] == GOOD)
        if depth is None or not baseline_px:
            return found
        expected, depths = project(pose, self._map.positions[found.ids[known]], self._intrinsics)
        columns = expected[:, 0] - baseline_px / np.maximum(depths, LEAST_DEPTH)
        right = np.full(len(found.ids), np.nan)
        right[known] = depth.right_columns(found.pixels[known], columns)
        return Followed(found.ids, found.pixels, right)

    def _estimate(
        self, normalized: Image, depth: FrameDepth | None, predicted: Array, found: Followed
    ) -> Tracked | NoPose:
        """Pose from what was followed, then with the lost points that are found again."""
        was_astray = np.isin(found.ids, self._astray.ids)
        followed_astray, found = found[was_astray], self.measured(found[~was_astray], predicted, depth)
        pose = self._pose(predicted, found)
        if isinstance(pose, NoPose):
            return pose
        astray = self._still_astray(pose.camera_from_world, followed_astray)
        searched = self._search(normalized, pose.camera_from_world, np.concatenate([found.ids, astray.ids]))
        if len(searched.ids):
            found = found.joined(self.measured(searched, pose.camera_from_world, depth))
            pose = self._pose(pose.camera_from_world, found)
            if isinstance(pose, NoPose):
                return pose
        return self._tracked(normalized, pose, found, astray)

    def _tracked(self, normalized: Image, pose: PoseEstimate, found: Followed, astray: Followed) -> Tracked:
        """Which points obey a pose; counted in the map."""
        known = self._map.state[found.ids] == GOOD
        fits = np.zeros(len(found.ids), dtype=bool)
        fits[known] = pose.inliers
        wanted = self.points.ids[self._map.state[self.points.ids] == GOOD]
        self._map.n_expected[np.union1d(np.union1d(wanted, found.ids[known]), astray.ids)] += 1
        self._map.n_found[found.ids[fits]] += 1
        keep = fits | (self._map.state[found.ids] == CANDIDATE)
        keep &= inside(found.pixels, normalized.shape, PATCH_HALF + 2)
        before, _ = project(self.camera_from_world, self._map.positions[found.ids[fits]], self._intrinsics)
        moved = np.linalg.norm(found.pixels[fits] - np.nan_to_num(before), axis=1)
        leaving = found[known & ~fits]
        left = astray.ids
        if len(leaving.ids) > MOST_LEAVING * fits.sum():
            left = np.concatenate([left, leaving.ids])
        disagreeing = leaving.joined(astray)
        return Tracked(
            pose, found[keep], int(fits.sum()), disagreeing, left, float(np.median(moved)) if len(moved) else 0.0
        )

    def _pose(self, start: Array, found: Followed) -> PoseEstimate | NoPose:
        known = found[self._map.state[found.ids] == GOOD]
        return Sight(self._map, known, self._intrinsics).pose(start)

    def _search(self, normalized: Image, pose: Array, followed: Indices) -> Followed:
        """Map points that are not followed but in view, found where the pose says."""
        # In a complete map points have no need to be seen again for their own sake.
        most = SEARCH_POINTS
        if self._templates is not None:
            most = min(ENOUGH_POINTS - len(followed), most)
            if most <= 0:
                return NOWHERE
        lost = self._map.state == GOOD
        lost[followed] = False
        ids = np.flatnonzero(lost)
        pixels, depths = project(pose, self._map.positions[ids], self._intrinsics)
        seen = inside(pixels, normalized.shape, FLOW_WINDOW) & self.is_similar_view(ids, pose, depths)
        wanted = Followed(ids, pixels)[seen]
        wanted = wanted[self._chosen(wanted.ids, most)]
        if not len(wanted.ids):
            return wanted
        found = self.find(normalized, wanted, pose, 1)
        errors = reprojection_errors(pose, self._map.positions[found.ids], found.pixels, self._intrinsics)
        self._map.n_expected[np.setdiff1d(wanted.ids, found.ids)] += 1
        return found[errors < SEARCH_RADIUS_PX]

    def is_similar_view(self, ids: Indices, pose: Array, depths: Array) -> Mask:
        """Whether points look from here about as from their keyframe."""
        numbers, views = np.unique(self._map.template_keyframe[ids], return_inverse=True)
        poses = np.array([self._map.keyframes[k].camera_from_world for k in numbers]).reshape(-1, 4, 4)
        centres = -np.einsum("kji,kj->ki", poses[:, :3, :3], poses[:, :3, 3])[views]
        points = self._map.positions[ids]
        there, here = centres - points, camera_centre(pose) - points
        far_there, far_here = np.linalg.norm(there, axis=1), np.linalg.norm(here, axis=1)
        cosine = np.einsum("nx,nx->n", there, here) / np.maximum(far_there * far_here, 1e-12)
        ratio = far_here / np.maximum(far_there, 1e-12)
        near = (ratio < MOST_SCALE_CHANGE) & (ratio > 1.0 / MOST_SCALE_CHANGE)
        return near & (cosine > np.cos(np.radians(MOST_VIEW_ANGLE_DEG))) & (depths > 0.0)

    def _chosen(self, ids: Indices, most: int) -> Indices:
        """Rows of at most ``most`` points to look for: of keyframes that saw most, reliable ones first."""
        views = self._map.template_keyframe[ids]
        numbers, counts = np.unique(views, return_counts=True)
        best = numbers[np.argsort(-counts, kind="stable")[:SEARCH_KEYFRAMES]]
        rows = np.flatnonzero(np.isin(views, best))
        expected, found = self._map.n_expected[ids[rows]], self._map.n_found[ids[rows]]
        doubtful = (expected >= 8) & (found < DOUBTFUL_SHARE * expected)
        return rows[np.argsort(doubtful, kind="stable")[:most]]
