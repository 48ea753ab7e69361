"""Finding the camera again after it was lost: which keyframes look alike, and where their points are now.

Keyframes are ranked by how much their thumbnails resemble the image (as in PTAM, Klein and Murray 2008). ORB
descriptors, turned upright by each patch's intensity centroid (Rublee et al. 2011), are computed at the map
points of a keyframe and at the corners of the image, both at several scales, since neither came from ORB's
detector.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from morph_dslam.online.features import match_descriptors, spread_corners
from morph_dslam.online.flow import FlowOptions
from morph_dslam.online.slam.options import SlamOptions
from morph_dslam.online.slam.pose import PoseEstimate, find_pose, refine_pose
from morph_dslam.online.slam.projection import inside, project
from morph_dslam.online.slam.rigid_map import GOOD, Followed, Indices, RigidMap
from morph_dslam.online.slam.tracking import Tracker

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

#: ORB's patch radius in pixels, and what it needs around a keypoint at the first scale.
PATCH_RADIUS, BORDER = 15, 32
SCALE_STEP = 1.2
#: Octaves described at map points, and at the image's corners.
MAP_OCTAVES, IMAGE_OCTAVES = (0, 2, 4), (0, 2)
THUMBNAIL = (40, 30)
N_CORNERS = 700
#: Keyframes tried in one frame: the two that look most alike, and one more in turn.
N_ALIKE = 2
#: Matches that agree on a rough pose, within so many pixels.
ROUGH_INLIERS, ROUGH_PX = 12, 6.0
#: A pose is believed if this share of the keyframe's points in view fit it, with an error of at most so many
#: times the usual one: repeated texture fits badly somewhere else.
LEAST_SHARE, MOST_ERROR_RATIO = 0.35, 2.0


def thumbnail(flat: Image) -> Array:
    """The image (30 * 40,) small, blurred, without its mean and of length 1."""
    small = cv2.GaussianBlur(cv2.resize(flat, THUMBNAIL, interpolation=cv2.INTER_AREA), (0, 0), 1.5)
    values = small.astype(float).ravel()
    values -= values.mean()
    return values / max(float(np.linalg.norm(values)), 1e-9)


def orientations(flat: Image, points: Array) -> Array:
    """Direction (n,), degrees, from each point (n, 2) to the centroid of grey of the disc around it."""
    offsets = np.arange(-PATCH_RADIUS, PATCH_RADIUS + 1)
    dx, dy = np.meshgrid(offsets, offsets)
    disc = (dx**2 + dy**2 <= PATCH_RADIUS**2).ravel()
    dx, dy = dx.ravel()[disc], dy.ravel()[disc]
    columns, rows = np.rint(points).astype(int).T
    grey = flat[rows[:, None] + dy, columns[:, None] + dx].astype(np.float32)
    return np.degrees(np.arctan2(grey @ dy.astype(np.float32), grey @ dx.astype(np.float32))) % 360.0


def describe(flat: Image, points: Array, octaves: tuple[int, ...]) -> tuple[Indices, NDArray[np.uint8]]:
    """ORB descriptors (k, 32) of points (n, 2), at several scales, and the row (k,) of each one's point."""
    whole = np.flatnonzero(inside(points, flat.shape, BORDER))
    angles = orientations(flat, points[whole])
    orb = cv2.ORB_create(nlevels=max(octaves) + 1, scaleFactor=SCALE_STEP)  # type: ignore[attr-defined]
    rows, descriptors = [], []
    for octave in octaves:
        # OpenCV drops keypoints too near the border at their scale: class_id says which remain.
        keypoints = [
            cv2.KeyPoint(float(x), float(y), 31.0 * SCALE_STEP**octave, float(angle), 1.0, octave, int(row))
            for row, (x, y), angle in zip(whole, points[whole], angles, strict=True)
        ]
        kept, described = orb.compute(flat, keypoints)
        if described is not None:
            rows.append(np.array([k.class_id for k in kept], dtype=np.int64))
            descriptors.append(described)
    if not rows:
        return np.empty(0, dtype=np.int64), np.empty((0, 32), dtype=np.uint8)
    return np.concatenate(rows), np.concatenate(descriptors)


class Relocaliser:
    """Finds the camera from the keyframes of a map."""

    def __init__(self, rigid_map: RigidMap, intrinsics: Array, options: SlamOptions) -> None:
        self._map = rigid_map
        self._intrinsics = intrinsics
        self._options = options
        self._thumbnails: list[Array] = []
        self._turn = 0

    def find(self, flat: Image, tracker: Tracker) -> tuple[PoseEstimate, Followed] | str:
        """The pose and the points that support it, or why there is none."""
        mask = np.full(flat.shape, 255, dtype=np.uint8)
        corners = spread_corners(flat, mask, N_CORNERS)
        if len(corners) < self._options.least_inliers:
            return f"too little texture: {len(corners)} corners"
        rows, descriptors = describe(flat, corners, IMAGE_OCTAVES)
        for number in self._candidates(flat):
            found = self._from_keyframe(number, flat, corners[rows], descriptors, tracker)
            if found is not None:
                return found
        return "the view resembles no keyframe"

    def _candidates(self, flat: Image) -> list[int]:
        keyframes = self._map.keyframes
        self._thumbnails += [thumbnail(keyframe.flat) for keyframe in keyframes[len(self._thumbnails) :]]
        order = np.argsort(-np.array(self._thumbnails) @ thumbnail(flat), kind="stable").tolist()
        self._turn += 1
        in_turn = order[N_ALIKE + self._turn % (len(order) - N_ALIKE)] if len(order) > N_ALIKE else order[0]
        return list(dict.fromkeys([*order[:N_ALIKE], in_turn]))

    def _from_keyframe(
        self, number: int, flat: Image, pixels: Array, descriptors: NDArray[np.uint8], tracker: Tracker
    ) -> tuple[PoseEstimate, Followed] | None:
        keyframe = self._map.keyframes[number]
        known = self._map.state[keyframe.point_ids] == GOOD
        ids = keyframe.point_ids[known]
        rows, described = describe(keyframe.flat, keyframe.pixels[known], MAP_OCTAVES)
        # Scales of one point compete with each other, so the second best says nothing: RANSAC sorts it out.
        first, second = match_descriptors(described, descriptors, ratio=1.0)
        rough = find_pose(
            self._map.positions[ids[rows[first]]],
            pixels[second],
            self._intrinsics,
            ROUGH_PX,
            least=ROUGH_INLIERS,
        )
        return None if rough is None else self._confirmed(number, flat, rough, tracker)

    def _confirmed(
        self, number: int, flat: Image, rough: PoseEstimate, tracker: Tracker
    ) -> tuple[PoseEstimate, Followed] | None:
        """The pose from all points of the keyframe, found where the rough pose has them; None if too few."""
        keyframe = self._map.keyframes[number]
        ids = keyframe.point_ids[self._map.state[keyframe.point_ids] == GOOD]
        guesses, _ = project(rough.camera_from_world, self._map.positions[ids], self._intrinsics)
        seen = inside(guesses, flat.shape, self._options.patch_half + 2)
        flow = FlowOptions(self._options.flow.window, 2)
        found = tracker.find(flat, Followed(ids[seen], guesses[seen]), flow)
        pose = refine_pose(
            rough.camera_from_world,
            self._map.positions[found.ids],
            found.pixels,
            self._intrinsics,
            inlier_px=self._options.inlier_px,
        )
        enough = max(self._options.least_inliers, 0.5 * len(found.ids), LEAST_SHARE * int(seen.sum()))
        if pose.inliers.sum() < enough or pose.rms_px > MOST_ERROR_RATIO * self._map.usual_rms_px:
            return None
        return pose, found[pose.inliers]
