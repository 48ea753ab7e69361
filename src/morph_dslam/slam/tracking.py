"""Following the map from frame to frame: where its points are now, and from them the camera's pose.

Each point is followed from a keyframe that saw it, not from the previous frame, so that errors do not add up; the
previous frame only says where to begin. A few points are followed over large motions and give a rough pose; from there
all others, and points lost from sight, are looked for where it says they are. Points that leave the place where a rigid
scene has them do not count for the pose, but are followed on.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np
from numba import njit
from numpy.typing import NDArray

from morph_dslam.camera import Camera
from morph_dslam.slam.frame_images import FrameDepth, FrameView
from morph_dslam.slam.options import INLIER_PX, LEAST_CORRELATION, LEAST_INLIERS, PATCH_HALF
from morph_dslam.slam.pose import LEAST_DEPTH, PoseEstimate, inside, inverse, project, refine_pose, reprojection_errors
from morph_dslam.slam.result import NoPose
from morph_dslam.slam.rigid_map import (
    CANDIDATE,
    FIRST_RMS_PX,
    GOOD,
    NOWHERE,
    REMOVED,
    UNKNOWN_TWIST,
    Followed,
    Indices,
    RigidMap,
)
from morph_dslam.slam.rolling_shutter import MOST_GAP_S, seen_at_middle_row, twist_of
from morph_dslam.slam.sight import Sight
from morph_dslam.slam.templates import Pyramid, Templates, image_pyramid, shape_of
from morph_dslam.tracking.patches import FLOW_WINDOW, LEVELS

Array = NDArray[np.float64]
#: Keyframes chosen for most points; one that adds fewer points than this is not worth its view.
MOST_VIEWS, LEAST_POINTS = 4, 10


class FewViews:
    """Chooses the keyframes that points of a complete map are looked for from.

    Attributes
    ----------
    template_keyframe, template_pixels : (p,), (p, 2) of each point of the map.
    """

    def __init__(self, rigid_map: RigidMap) -> None:
        self._map = rigid_map
        self.template_keyframe, self.template_pixels = (
            rigid_map.template_keyframe.copy(),
            rigid_map.template_pixels.copy(),
        )
        self._seen = np.concatenate([keyframe.point_ids for keyframe in rigid_map.keyframes])
        counts = [len(keyframe.point_ids) for keyframe in rigid_map.keyframes]
        self._seen_by = np.repeat(np.arange(len(counts)), counts)

    def choose(self, ids: Indices) -> None:
        """Choose for these points (n,).

        Keyframes that show most of the points left are taken one after the other; the last points keep what they had.
        """
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
            self.template_keyframe[ids[seen]] = best
            self.template_pixels[ids[seen]] = keyframe.pixels[rows[seen]]
            left &= ~seen


class ViewsOf:
    """Points are looked for from the first of some keyframes that sees them; others as the map has it.

    After a dark or blurred stretch, the map has its points as they were seen there.

    Attributes
    ----------
    template_keyframe, template_pixels : (p,), (p, 2) of each point of the map.
    """

    def __init__(self, rigid_map: RigidMap, keyframes: Indices) -> None:
        self.template_keyframe = rigid_map.template_keyframe.copy()
        self.template_pixels = rigid_map.template_pixels.copy()
        for number in keyframes[::-1].tolist():
            keyframe = rigid_map.keyframes[number]
            self.template_keyframe[keyframe.point_ids] = number
            self.template_pixels[keyframe.point_ids] = keyframe.pixels


Mask = NDArray[np.bool_]
#: Points are looked for from a keyframe only if they are seen from there at about this angle and distance.
MOST_VIEW_ANGLE_DEG = 35.0
MOST_SCALE_CHANGE = 1.6
#: A point not found in this share of the frames in which it was looked for is looked for after all others.
DOUBTFUL_SHARE = 0.25
#: Points that disagree have moved if they did so in the frame before, too, or if all at once they are more
#: than this share of the points that agree.
MOST_LEAVING = 0.1
#: Points that are followed over large motions to give a rough pose, the share of them that has to agree on it, and the
#: levels on which points are looked for whose place is known that well.
N_PILOTS, AGREEING_PILOTS, NEAR_LEVELS = 64, 0.5, 2
#: Keyframes whose pyramids are kept.
MOST_PYRAMIDS = 8
#: Lost points looked for in a frame, from at most so many keyframes.
SEARCH_POINTS, SEARCH_KEYFRAMES = 80, 3
#: In a frozen map lost points are looked for while fewer than this are followed, and so many are missing.
ENOUGH_POINTS, WORTH_A_SEARCH = 340, 20
#: How far from its predicted pixel a lost point may be found, and how far the search may go.
SEARCH_RADIUS_PX, SEARCH_REACH_PX = 5.0, 16.0
#: Weight of the newest frame in the usual error.
USUAL_RATE = 0.1


@njit(cache=True, nogil=True)
def similar_views(pose, keyframes, rows, points):
    """Whether points (n, 3) look from a pose (4, 4) about as from keyframes (k, 4, 4), each from that of its row."""
    result = np.empty(len(points), dtype=np.bool_)
    least, there, here = math.cos(math.radians(MOST_VIEW_ANGLE_DEG)), np.empty(3), np.empty(3)
    for i in range(len(points)):
        keyframe = keyframes[rows[i]]
        # From the point to the centres of both cameras, and its depth.
        depth = pose[2, 3]
        for j in range(3):
            there[j] = here[j] = -points[i, j]
            for k in range(3):
                there[j] -= keyframe[k, j] * keyframe[k, 3]
                here[j] -= pose[k, j] * pose[k, 3]
            depth += pose[2, j] * points[i, j]
        product = there[0] * here[0] + there[1] * here[1] + there[2] * here[2]
        far_there = math.sqrt(there[0] ** 2 + there[1] ** 2 + there[2] ** 2)
        far_here = math.sqrt(here[0] ** 2 + here[1] ** 2 + here[2] ** 2)
        near = far_here < MOST_SCALE_CHANGE * far_there and far_there < MOST_SCALE_CHANGE * far_here
        result[i] = near and product > least * far_there * far_here and depth > 0.0
    return result


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
    twist : (6,) the camera's velocity, as of `Keyframe`.
    """

    pose: PoseEstimate
    points: Followed
    n_inliers: int
    disagreeing: Followed
    moved: Indices = field(default_factory=lambda: NOWHERE.ids)
    image_motion_px: float = 0.0
    twist: Array = field(default_factory=lambda: UNKNOWN_TWIST)


class Tracker:
    """Follows the points of a map.

    With a rolling shutter, poses are those of the middle rows' instants; pixels of points stay where they were seen.

    Attributes
    ----------
    camera_from_world : (4, 4) the newest pose.
    timestamp : of the frame that was tracked last, seconds.
    points : what is followed.
    """

    def __init__(self, rigid_map: RigidMap, camera: Camera) -> None:
        self._map = rigid_map
        self._camera, self._intrinsics = camera, camera.intrinsics
        self._motion, self._twist, self.timestamp = np.eye(4), UNKNOWN_TWIST, -np.inf
        # Of the newest pose, which may have been found by other means since.
        self._pose_time = -np.inf
        self._templates, self._pyramids = Templates(self._intrinsics), dict[int, Pyramid]()
        self._views: FewViews | None = None
        self._astray = NOWHERE
        self.camera_from_world = np.eye(4)
        self.points = NOWHERE

    def place(self, camera_from_world: Array, points: Followed, timestamp: float) -> None:
        """Go on from a pose of some time in seconds, found by other means, as if the camera had stood still."""
        self.camera_from_world, self.points, self._motion = camera_from_world, points, np.eye(4)
        self._astray, self._twist, self._pose_time = NOWHERE, UNKNOWN_TWIST, timestamp

    def correct(self, before: Array, after: Array) -> None:
        """Move along with the newest keyframe, whose pose (4, 4) was ``before`` and now is ``after``."""
        self.camera_from_world = self.camera_from_world @ inverse(before) @ after

    def forget_patches(self) -> None:
        """Cut the points' patches out of their keyframes anew: they are elsewhere there."""
        self._templates = Templates(self._intrinsics)

    def take_up(self, ids: Indices) -> None:
        """Follow further points, from where the newest pose has them."""
        pixels, _ = project(self.camera_from_world, self._map.positions[ids], self._intrinsics)
        followed = np.concatenate([self.points.ids, self._astray.ids])
        new = Followed(ids, pixels)[np.isfinite(pixels[:, 0]) & ~np.isin(ids, followed)]
        self.points = self.points.joined(new)

    def drop_candidates(self) -> None:
        """Follow map points only."""
        self.points = self.points[self._map.state[self.points.ids] == GOOD]

    def choose_views(self) -> None:
        """The map is complete: look for points from the few keyframes that show most of them."""
        self._views = FewViews(self._map)

    def track(self, view: FrameView) -> Tracked | NoPose:
        """Pose and points of the next frame, or why it is lost; then the newest pose stays what it was."""
        reasons = []
        # The prediction is that the motion goes on; if it has changed abruptly, that the camera stands still.
        for predicted, levels in (
            (self._motion @ self.camera_from_world, LEVELS),
            (self.camera_from_world, LEVELS + 1),
        ):
            result = self._attempt(view, predicted, levels)
            if isinstance(result, Tracked):
                self._motion = result.pose.camera_from_world @ inverse(self.camera_from_world)
                gap = view.timestamp - self._pose_time
                self.timestamp = self._pose_time = view.timestamp
                self._twist = twist_of(self._motion, gap) if 0.0 < gap < MOST_GAP_S else UNKNOWN_TWIST
                result = replace(result, twist=self._twist)
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
        if self._views is not None:
            return
        waiting = points[self._map.state[points.ids] == CANDIDATE]
        newest = len(self._map.keyframes) - 1
        at = self._map.keyframes[newest].camera_from_world
        self._map.passing.note(newest, at, self.camera_from_world, waiting.ids, waiting.pixels)

    def _attempt(self, view: FrameView, predicted: Array, levels: int) -> Tracked | NoPose:
        """Pose and points, if the motion is about as predicted: within what so many levels reach."""
        points = self._followable()
        if self._views is not None:
            self._views.choose(points.ids)
        pilots = self._pilots(points)
        found = self._follow(view.pyramid, points[pilots], predicted, levels)
        rough = self._rough_pose(predicted, found)
        rest = np.ones(len(points.ids), dtype=bool)
        rest[pilots] = False
        if rough is None:
            found = found.joined(self._follow(view.pyramid, points[rest], predicted, levels))
        else:
            found = found.joined(self._follow(view.pyramid, points[rest], rough, NEAR_LEVELS))
        was_astray = self._among(self._astray.ids)[found.ids]
        astray, found = found[was_astray], found[~was_astray]
        if rough is not None:
            astray = self._still_astray(rough, astray)
            found = found.joined(self._search(view.pyramid, rough, np.concatenate([found.ids, astray.ids])))
        found = self.measured(found, predicted if rough is None else rough, view.depth)
        # From the prediction, so that no few points decide which others are trusted.
        pose = self._pose(predicted, found)
        if isinstance(pose, NoPose):
            return pose
        if rough is None:
            astray = self._still_astray(pose.camera_from_world, astray)
        return self._tracked(view.normalized.shape, pose, found, astray)

    def _among(self, ids: Indices) -> Mask:
        """Of all points of the map, which are these."""
        result = np.zeros(len(self._map.state), dtype=bool)
        result[ids] = True
        return result

    def _followable(self) -> Followed:
        """Followed points, astray ones too; the mapper may have taken some out."""
        points = self.points.joined(self._astray)
        return points[self._map.state[points.ids] != REMOVED]

    def _pilots(self, points: Followed) -> Indices:
        """Rows of a few of the points, spread over them, whose depth is known and that have not left the scene."""
        rows = np.flatnonzero((self._map.state[points.ids] == GOOD) & ~self._among(self._astray.ids)[points.ids])
        return rows[np.linspace(0, len(rows) - 1, N_PILOTS).astype(int)] if len(rows) > N_PILOTS else rows

    def _rough_pose(self, start: Array, pilots: Followed) -> Array | None:
        """The pose (4, 4) that the few points found first agree on, if most of them do."""
        if len(pilots.ids) < LEAST_INLIERS:
            return None
        positions = self._map.positions[pilots.ids]
        pixels = self._at_middle_row(pilots, start).pixels
        pose = refine_pose(start, positions, pixels, self._intrinsics, inlier_px=INLIER_PX)
        return pose.camera_from_world if pose.inliers.mean() > AGREEING_PILOTS else None

    def _follow(self, image: Pyramid, points: Followed, pose: Array, levels: int) -> Followed:
        """Those of the points that are found where the motion to a pose (4, 4) takes them."""
        positions = self._map.positions[points.ids]
        before, _ = project(self.camera_from_world, positions, self._intrinsics)
        after, _ = project(pose, positions, self._intrinsics)
        guesses = points.pixels + np.nan_to_num(after - before)
        return self._look_for(image, Followed(points.ids, guesses), pose, levels)

    def _still_astray(self, pose: Array, followed: Followed) -> Followed:
        """Those of the points that had left the rigid scene that are still away from their places."""
        followed = followed[self._map.state[followed.ids] == GOOD]
        positions = self._map.positions[followed.ids]
        pixels = self._at_middle_row(followed, pose).pixels
        return followed[reprojection_errors(pose, positions, pixels, self._intrinsics) > INLIER_PX]

    def _at_middle_row(self, seen: Followed, pose: Array) -> Followed:
        """Where points are seen, at the instant of the frame's middle row, as far as the motion goes on."""
        return seen_at_middle_row(self._camera, pose, self._twist, self._map.positions[seen.ids], seen)

    def find(
        self, image: Pyramid, guesses: Followed, pose: Array, levels: int, views: ViewsOf | None = None
    ) -> Followed:
        """Points found near their guessed pixels, by the patches of their keyframes as seen from a pose (4, 4).

        In a map that grows ``views`` may say which keyframes these are (`views_of`).
        """
        if self._views is not None:
            self._views.choose(guesses.ids)
        return self._look_for(image, guesses, pose, levels, views=views)

    def _look_for(
        self,
        image: Pyramid,
        guesses: Followed,
        pose: Array,
        levels: int,
        reach: float = np.inf,
        views: ViewsOf | None = None,
    ) -> Followed:
        guesses = guesses[inside(guesses.pixels, shape_of(image), 0.0)]
        ids = guesses.ids
        if not len(ids):
            return guesses
        of_views = self._views or views or self._map
        seen_from, pixels = of_views.template_keyframe[ids], of_views.template_pixels[ids]
        keyframes = self._keyframe_poses(seen_from)
        outdated = self._templates.outdated(ids, seen_from, pose, keyframes, self._map.positions, pixels)
        for number in np.unique(seen_from[outdated]).tolist():
            rows = outdated & (seen_from == number)
            self._templates.make(ids[rows], pixels[rows], self._pyramid_of(number))
        found, likeness = self._templates.align(ids, image, guesses.pixels, levels, reach)
        return Followed(ids, found)[likeness > LEAST_CORRELATION]

    def _keyframe_poses(self, views: Indices) -> tuple[Array, Indices]:
        """Poses (k, 4, 4) of the keyframes among some, and the row (n,) of each."""
        numbers, rows = np.unique(views, return_inverse=True)
        return np.array([self._map.keyframes[k].camera_from_world for k in numbers]).reshape(-1, 4, 4), rows

    def _pyramid_of(self, number: int) -> Pyramid:
        """The images of a keyframe; those used last are kept."""
        image = self._pyramids.pop(number, None) or image_pyramid(self._map.keyframes[number].normalized)
        self._pyramids[number] = image
        if len(self._pyramids) > MOST_PYRAMIDS:
            del self._pyramids[next(iter(self._pyramids))]
        return image

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

    def _tracked(self, shape: tuple[int, ...], pose: PoseEstimate, found: Followed, astray: Followed) -> Tracked:
        """Which points obey a pose; counted in the map."""
        known = self._map.state[found.ids] == GOOD
        fits = np.zeros(len(found.ids), dtype=bool)
        fits[known] = pose.inliers
        wanted = self.points.ids[self._map.state[self.points.ids] == GOOD]
        self._map.n_expected += self._among(np.concatenate([wanted, found.ids[known], astray.ids]))
        self._map.n_found[found.ids[fits]] += 1
        keep = fits | (self._map.state[found.ids] == CANDIDATE)
        keep &= inside(found.pixels, shape, PATCH_HALF + 2)
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
        known = self._at_middle_row(found[self._map.state[found.ids] == GOOD], start)
        return Sight(self._map, known, self._intrinsics).pose(start)

    def _search(self, image: Pyramid, pose: Array, followed: Indices) -> Followed:
        """Map points that are not followed but in view, found where the pose says."""
        # In a complete map points have no need to be seen again for their own sake.
        most = SEARCH_POINTS
        if self._views is not None:
            most = min(ENOUGH_POINTS - len(followed), most)
            if most < WORTH_A_SEARCH:
                return NOWHERE
        lost = self._map.state == GOOD
        lost[followed] = False
        ids = np.flatnonzero(lost)
        pixels, _ = project(pose, self._map.positions[ids], self._intrinsics)
        wanted = Followed(ids, pixels)[inside(pixels, shape_of(image), FLOW_WINDOW)]
        wanted = wanted[self.is_similar_view(wanted.ids, pose)]
        wanted = wanted[self._chosen(wanted.ids, most)]
        # Where they would be seen is as far from there, the other way, as what is seen from the middle row's instant.
        moved = self._at_middle_row(wanted, pose).pixels - wanted.pixels
        guesses = Followed(wanted.ids, wanted.pixels - moved)
        found = self._look_for(image, guesses, pose, NEAR_LEVELS, SEARCH_REACH_PX)
        pixels = self._at_middle_row(found, pose).pixels
        errors = reprojection_errors(pose, self._map.positions[found.ids], pixels, self._intrinsics)
        self._map.n_expected[wanted.ids[~self._among(found.ids)[wanted.ids]]] += 1
        return found[errors < SEARCH_RADIUS_PX]

    def views_of(self, keyframes: Indices) -> ViewsOf | None:
        """Some keyframes to look for points from; None in a complete map, of which views are chosen anyway."""
        return None if self._views is not None else ViewsOf(self._map, keyframes)

    def look_from(self, ids: Indices, views: ViewsOf) -> None:
        """Look for points from other keyframes from now on."""
        self._map.template_keyframe[ids] = views.template_keyframe[ids]
        self._map.template_pixels[ids] = views.template_pixels[ids]

    def is_similar_view(self, ids: Indices, pose: Array, views: ViewsOf | None = None) -> Mask:
        """Whether points look from here about as from their keyframe, or from the one that ``views`` has."""
        poses, rows = self._keyframe_poses((views or self._map).template_keyframe[ids])
        return similar_views(pose, poses, rows, self._map.positions[ids])

    def _chosen(self, ids: Indices, most: int) -> Indices:
        """Rows of at most ``most`` points to look for: of keyframes that saw most, reliable ones first."""
        views = self._map.template_keyframe[ids]
        numbers, counts = np.unique(views, return_counts=True)
        best = numbers[np.argsort(-counts, kind="stable")[:SEARCH_KEYFRAMES]]
        rows = np.flatnonzero(np.isin(views, best))
        expected, found = self._map.n_expected[ids[rows]], self._map.n_found[ids[rows]]
        doubtful = (expected >= 8) & (found < DOUBTFUL_SHARE * expected)
        return rows[np.argsort(doubtful, kind="stable")[:most]]
