"""Following the map from frame to frame: where its points are now, and from them the camera's pose.

Each point is followed from the keyframe that last saw it, not from the previous frame, so that errors do not
add up between keyframes; the previous frame only says where to begin. Points lost from sight are looked for
again where the pose says they are. Points that leave the place where a rigid scene has them do not count for
the pose, but are followed on.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from morph_dslam.online.measuring.flow import FlowOptions, follow
from morph_dslam.online.measuring.patches import patch_correlation
from morph_dslam.online.slam.consensus import Sight
from morph_dslam.online.slam.depth import FrameDepth
from morph_dslam.online.slam.options import SlamOptions
from morph_dslam.online.slam.pose import LEAST_DEPTH, PoseEstimate, reprojection_errors
from morph_dslam.online.slam.projection import inside, inverse, project
from morph_dslam.online.slam.rigid_map import (
    CANDIDATE,
    FIRST_RMS_PX,
    GOOD,
    NOWHERE,
    REMOVED,
    Followed,
    Indices,
    RigidMap,
)
from morph_dslam.online.slam.template_choice import FewTemplates
from morph_dslam.online.slam.two_view import camera_centre
from morph_dslam.online.slam.view_warp import WarpedViews, warp_pixels

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Image = NDArray[np.uint8]

#: Points are looked for from a keyframe only if they are seen from there at about this angle and distance.
MOST_VIEW_ANGLE_DEG = 35.0
MOST_SCALE_CHANGE = 1.6
#: A point not found in this share of the frames in which it was looked for is looked for after all others.
DOUBTFUL_SHARE = 0.25
#: Points that disagree have moved if they did so in the frame before, too, or if all at once they are more
#: than this share of the points that agree.
MOST_LEAVING = 0.1
#: Weight of the newest frame in the usual error.
USUAL_RATE = 0.1


@dataclass(frozen=True)
class Tracked:
    """A frame's pose and points.

    Attributes
    ----------
    pose : from the map points; its ``inliers`` belong to the rows of ``points`` that are map points.
    points : inliers and candidates. disagreeing : points that look like their map point but are not where a
        rigid scene would have them. moved : (m,) those that surely have moved.
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
    camera_from_world : (4, 4) the newest pose. points : what is followed.
    """

    def __init__(self, rigid_map: RigidMap, intrinsics: Array, options: SlamOptions) -> None:
        self._map = rigid_map
        self._intrinsics = intrinsics
        self._options = options
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

    def track(self, flat: Image, depth: FrameDepth | None = None) -> Tracked | str:
        """Pose and points of the next frame, or why it is lost; then the newest pose stays what it was."""
        reason = ""
        deeper = FlowOptions(self._options.flow.window, self._options.flow.levels + 1)
        # The prediction is that the motion goes on; if it has changed abruptly, that the camera stands still.
        for predicted, flow in (
            (self._motion @ self.camera_from_world, self._options.flow),
            (self.camera_from_world, deeper),
        ):
            found = self._follow(flat, predicted, flow)
            result = self._estimate(flat, depth, predicted, found)
            if isinstance(result, Tracked):
                self._motion = result.pose.camera_from_world @ inverse(self.camera_from_world)
                self.camera_from_world = result.pose.camera_from_world
                self.points, self._astray = result.points, result.disagreeing
                rate = 1.0 if self._map.usual_rms_px == FIRST_RMS_PX else USUAL_RATE
                self._map.usual_rms_px += rate * (result.pose.rms_px - self._map.usual_rms_px)
                self._note_candidates(result.points)
                return result
            reason = reason or result
        return reason

    def _note_candidates(self, points: Followed) -> None:
        """Let the map know where points without depth are."""
        if self._templates is not None:
            return
        waiting = points[self._map.state[points.ids] == CANDIDATE]
        newest = len(self._map.keyframes) - 1
        at = self._map.keyframes[newest].camera_from_world
        self._map.passing.note(newest, at, self.camera_from_world, waiting.ids, waiting.pixels)

    def _follow(self, flat: Image, predicted: Array, flow: FlowOptions) -> Followed:
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
        return self.find(flat, Followed(points.ids, guesses), predicted, flow)

    def _still_astray(self, pose: Array, followed: Followed) -> Followed:
        """Those of the points that had left the rigid scene that are still away from their places."""
        followed = followed[self._map.state[followed.ids] == GOOD]
        positions = self._map.positions[followed.ids]
        errors = reprojection_errors(pose, positions, followed.pixels, self._intrinsics)
        return followed[errors > self._options.inlier_px]

    def find(self, flat: Image, guesses: Followed, pose: Array, flow: FlowOptions) -> Followed:
        """Points found near their guessed pixels, by the patches of their keyframes as seen from a pose."""
        ids = guesses.ids
        if self._templates is not None:
            views, templates = self._templates.choose(ids)
        else:
            views, templates = self._map.template_keyframe[ids], self._map.template_pixels[ids]
        found, good = guesses.pixels.copy(), np.zeros(len(ids), dtype=bool)
        for view in np.unique(views):
            rows = np.flatnonzero((views == view) & inside(guesses.pixels, flat.shape, 0.0))
            source, starts = self._seen_from(pose, int(view), ids[rows], templates[rows])
            pixels, ok = follow(source, flat, starts, guesses.pixels[rows], flow)
            likeness = patch_correlation(source, flat, starts, pixels, self._options.patch_half)
            found[rows], good[rows] = pixels, ok & (likeness > self._options.least_correlation)
        return Followed(ids, found)[good]

    def _seen_from(self, pose: Array, number: int, ids: Indices, pixels: Array) -> tuple[Image, Array]:
        """A keyframe's image, warped where it looks much different from the pose, and its pixels there."""
        keyframe = self._map.keyframes[number]
        if not len(ids):
            return keyframe.flat, pixels
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
        self, flat: Image, depth: FrameDepth | None, predicted: Array, found: Followed
    ) -> Tracked | str:
        """Pose from what was followed, then with the lost points that are found again."""
        was_astray = np.isin(found.ids, self._astray.ids)
        followed_astray, found = found[was_astray], self.measured(found[~was_astray], predicted, depth)
        pose = self._pose(predicted, found)
        if isinstance(pose, str):
            return pose
        astray = self._still_astray(pose.camera_from_world, followed_astray)
        searched = self._search(flat, pose.camera_from_world, np.concatenate([found.ids, astray.ids]))
        if len(searched.ids):
            found = found.joined(self.measured(searched, pose.camera_from_world, depth))
            pose = self._pose(pose.camera_from_world, found)
            if isinstance(pose, str):
                return pose
        return self._tracked(flat, pose, found, astray)

    def _tracked(self, flat: Image, pose: PoseEstimate, found: Followed, astray: Followed) -> Tracked:
        """Which points obey a pose; counted in the map."""
        known = self._map.state[found.ids] == GOOD
        fits = np.zeros(len(found.ids), dtype=bool)
        fits[known] = pose.inliers
        wanted = self.points.ids[self._map.state[self.points.ids] == GOOD]
        self._map.n_expected[np.union1d(np.union1d(wanted, found.ids[known]), astray.ids)] += 1
        self._map.n_found[found.ids[fits]] += 1
        keep = fits | (self._map.state[found.ids] == CANDIDATE)
        keep &= inside(found.pixels, flat.shape, self._options.patch_half + 2)
        before, _ = project(self.camera_from_world, self._map.positions[found.ids[fits]], self._intrinsics)
        moved = np.linalg.norm(found.pixels[fits] - np.nan_to_num(before), axis=1)
        leaving = found[known & ~fits]
        left = astray.ids
        if len(leaving.ids) > MOST_LEAVING * fits.sum():
            left = np.concatenate([left, leaving.ids])
        disagreeing = leaving.joined(astray)
        return Tracked(
            pose,
            found[keep],
            int(fits.sum()),
            disagreeing,
            left,
            float(np.median(moved)) if len(moved) else 0.0,
        )

    def _pose(self, start: Array, found: Followed) -> PoseEstimate | str:
        known = found[self._map.state[found.ids] == GOOD]
        return Sight(self._map, known, self._intrinsics, self._options).pose(start)

    def _search(self, flat: Image, pose: Array, followed: Indices) -> Followed:
        """Map points that are not followed but in view, found where the pose says."""
        options = self._options
        # In a complete map points have no need to be seen again for their own sake.
        most = options.search_points
        if self._templates is not None:
            most = min(options.enough_points - len(followed), most)
            if most <= 0:
                return NOWHERE
        lost = self._map.state == GOOD
        lost[followed] = False
        ids = np.flatnonzero(lost)
        pixels, depths = project(pose, self._map.positions[ids], self._intrinsics)
        seen = inside(pixels, flat.shape, options.flow.window) & self.looks_alike(ids, pose, depths)
        wanted = Followed(ids, pixels)[seen]
        wanted = wanted[self._chosen(wanted.ids, most)]
        if not len(wanted.ids):
            return wanted
        found = self.find(flat, wanted, pose, FlowOptions(options.flow.window, 1))
        errors = reprojection_errors(pose, self._map.positions[found.ids], found.pixels, self._intrinsics)
        self._map.n_expected[np.setdiff1d(wanted.ids, found.ids)] += 1
        return found[errors < options.search_radius_px]

    def looks_alike(self, ids: Indices, pose: Array, depths: Array) -> Mask:
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
        best = numbers[np.argsort(-counts, kind="stable")[: self._options.search_keyframes]]
        rows = np.flatnonzero(np.isin(views, best))
        expected, found = self._map.n_expected[ids[rows]], self._map.n_found[ids[rows]]
        doubtful = (expected >= 8) & (found < DOUBTFUL_SHARE * expected)
        return rows[np.argsort(doubtful, kind="stable")[:most]]
