"""Finding the camera again: which keyframes look alike, and where their points are now.

Keyframes are ranked by a bag of binary words, trained from the map itself (Sivic and Zisserman 2003; binary words as in
Gálvez-López and Tardós 2012; clusters by k-majority, Grana et al. 2013). The points of the likeliest one and of those
that share most points with it are matched with the image's corners; P3P in RANSAC gives a rough pose, which is believed
only if the points are found where it has them, and if no other place explains the view about as well. Before that the
place is tried at which the camera was lost.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from morph_dslam.slam.frame_images import (
    OCTAVES,
    Descriptors,
    FrameView,
    Indices,
    describe,
    least_distances,
    match_points,
)
from morph_dslam.slam.options import INLIER_PX, LEAST_INLIERS, PATCH_HALF
from morph_dslam.slam.pose import PoseEstimate, find_pose, inside, inverse, project, refine_pose, reprojection_errors
from morph_dslam.slam.result import NoPose, SlamReason
from morph_dslam.slam.rigid_map import GOOD, NOWHERE, Followed, RigidMap
from morph_dslam.slam.tracking import Tracker
from morph_dslam.tracking.patches import spread_corners

Array = NDArray[np.float64]
N_WORDS = 400
#: Descriptors that words are trained from, and rounds of clustering.
N_TRAINING, ROUNDS = 6000, 6
#: Words are trained anew when there are this many times the keyframes that they were trained from.
RETRAIN_AT = 1.5


@njit(cache=True, nogil=True)
def bit_counts(descriptors, members, n_words):
    """How many of each word's members (n,), descriptors (n, 32), have each bit (w, 256).

    numpy's sums over groups would hold the interpreter for milliseconds.
    """
    counts = np.zeros((n_words, 8 * descriptors.shape[1]), dtype=np.int64)
    for row in range(len(descriptors)):
        for column in range(descriptors.shape[1]):
            for bit in range(8):
                set_bit = (descriptors[row, column] >> (7 - bit)) & 1
                counts[members[row], 8 * column + bit] += set_bit
    return counts


class Vocabulary:
    """Binary words.

    Attributes
    ----------
    words : (w, 32).
    """

    def __init__(self, descriptors: Descriptors, n_words: int = N_WORDS, seed: int = 0) -> None:
        """Cluster descriptors (n, 32); the same ones give the same words."""
        rng = np.random.default_rng(seed)
        order = rng.permutation(len(descriptors))[:N_TRAINING]
        sample = descriptors[order]
        self.words = sample[:n_words].copy()
        for _ in range(ROUNDS):
            members = self.assign(sample)
            counts = np.bincount(members, minlength=len(self.words))
            majority = 2 * bit_counts(sample, members, len(self.words)) > counts[:, None]
            self.words[counts > 0] = np.packbits(majority[counts > 0], axis=1)

    def assign(self, descriptors: Descriptors) -> Indices:
        """The nearest word (n,) of each descriptor (n, 32)."""
        matches = cv2.BFMatcher(cv2.NORM_HAMMING).match(descriptors, self.words)
        return np.array([match.trainIdx for match in matches], dtype=np.int64)

    def histogram(self, descriptors: Descriptors) -> Array:
        """How often each word (w,) occurs, as parts of one."""
        counts = np.bincount(self.assign(descriptors), minlength=len(self.words)) if len(descriptors) else 0.0
        return np.broadcast_to(counts / max(len(descriptors), 1), len(self.words)).astype(float)


class PlaceIndex:
    """The keyframes of a map by what they look like."""

    def __init__(self, rigid_map: RigidMap) -> None:
        self._map = rigid_map
        self._vocabulary: Vocabulary | None = None
        self._n_trained = 0
        self._histograms = np.empty((0, N_WORDS))
        self._described = np.empty(0, dtype=bool)

    def update(self) -> None:
        """Take in the keyframes that are new, or have been described since."""
        keyframes = self._map.keyframes
        if self._vocabulary is None or len(keyframes) >= RETRAIN_AT * self._n_trained:
            self._vocabulary = Vocabulary(np.concatenate([k.descriptors for k in keyframes]))
            self._n_trained = len(keyframes)
            self._histograms = np.empty((0, len(self._vocabulary.words)))
            self._described = np.empty(0, dtype=bool)
        described = np.array([len(k.descriptors) > 0 for k in keyframes])
        for row in np.flatnonzero(described[: len(self._described)] & ~self._described):
            self._histograms[row] = self._vocabulary.histogram(keyframes[row].descriptors)
        new = [self._vocabulary.histogram(k.descriptors) for k in keyframes[len(self._histograms) :]]
        self._histograms, self._described = np.vstack([self._histograms, *new]), described

    def similarities(self, descriptors: Descriptors) -> Array:
        """How much an image with these descriptors (k, 32) resembles each keyframe (n,), from 0 to 1."""
        assert self._vocabulary is not None
        frequency = (self._histograms > 0.0).mean(axis=0)
        weights = np.log((1.0 + len(self._histograms)) / (1.0 + frequency * len(self._histograms))) + 0.1
        seen = weights * self._vocabulary.histogram(descriptors)
        known = weights * self._histograms
        common = np.minimum(known, seen).sum(axis=1)
        # Keyframes that were taken out resemble nothing.
        common[[not len(keyframe.descriptors) for keyframe in self._map.keyframes]] = 0.0
        return common / np.maximum(np.maximum(known.sum(axis=1), seen.sum()), 1e-12)


#: Corners of the image that are described.
N_CORNERS = 600
#: Keyframes tried in one frame: the one that looks most alike, and one more in turn of those that follow.
N_IN_TURN = 10
#: Keyframes whose points are matched together, and the fewest points that they share.
GROUP, LEAST_SHARED = 4, 20
#: Matches are nearer than this many bits, and clearly nearer than the second best.
MOST_BITS, RATIO = 80, 0.95
#: Matches that agree on a rough pose, within so many pixels.
ROUGH_INLIERS, ROUGH_PX = 8, 6.0
#: A pose is believed if this share of the group's points in view are found where it has them, most of these
#: fit it, and their error is at most so many times the usual one, or this: repeated texture fits badly
#: somewhere else, but beside all keyframes the map's own errors show.
LEAST_SHARE, LEAST_FIT, MOST_ERROR_RATIO, MOST_ERROR_PX = 0.35, 0.7, 2.0, 2.0
#: A place that is not where the camera was lost needs so many points, as in ORB-SLAM (Mur-Artal et al. 2015), or this
#: share of those in view where the map has few.
LEAST_ANEW, SHARE_ANEW = 50, 0.6
#: Places that are looked for by the same keyframes.
N_PLACES = 2
#: Another place is one that has the points so far away. It looks alike with this share of the points of the best one.
APART_PX, ALIKE = 20.0, 0.7
#: A camera held by hand moves by no more than so many times the scene's distance in a second.
MOST_DEPTHS_PER_S = 2.0
#: A pose, and the points that support it.
Found = tuple[PoseEstimate, Followed]


@dataclass(frozen=True)
class Corners:
    """Corners (n, 2) of an image, their descriptors (k, 32), and the row (k,) of each one's corner."""

    pixels: Array
    rows: Indices
    descriptors: Descriptors


def described_corners(view: FrameView) -> Corners:
    """The corners of a view."""
    pixels = spread_corners(view.normalized, np.full(view.normalized.shape, 255, dtype=np.uint8), N_CORNERS)
    return Corners(pixels, *describe(view.grey, pixels, OCTAVES))


class Relocalizer:
    """Finds the camera from the keyframes of a map."""

    def __init__(self, rigid_map: RigidMap, intrinsics: Array) -> None:
        self._map = rigid_map
        self._intrinsics = intrinsics
        self.places = PlaceIndex(rigid_map)
        self._turn = 0

    def find(self, view: FrameView, tracker: Tracker) -> Found | NoPose:
        """The pose and the points that support it, or why there is none."""
        found = self._where_it_was(view, tracker)
        if found is not None:
            return found
        corners = described_corners(view)
        if len(corners.rows) < LEAST_INLIERS:
            return NoPose(SlamReason.LITTLE_TEXTURE, (len(corners.pixels),))
        self.places.update()
        for number in self._candidates(corners.descriptors):
            group = self.group(number)
            places = self._places(group, view, corners, tracker)
            if places:
                places += self._places(self._similar_keyframes(group, corners), view, corners, tracker)
                return self._chosen(places, view, tracker)
        return NoPose(SlamReason.NO_SIMILAR_KEYFRAME)

    def _places(self, group: Indices, view: FrameView, corners: Corners, tracker: Tracker) -> list[Found]:
        """Where the points of some keyframes say that the camera may be: the second explains other matches."""
        points, distances = self._distances(group, corners)
        places = []
        for _ in range(N_PLACES if len(points) else 0):
            rough = self._rough_pose(points, distances, corners)
            if rough is None:
                break
            found = self._confirmed(group, view, rough.camera_from_world, tracker, anew=True)
            if found is not None:
                places.append(found)
            pixels, _ = project(rough.camera_from_world, self._map.positions[points], self._intrinsics)
            away = np.linalg.norm(corners.pixels[: len(distances), None] - pixels, axis=2)
            distances[away < ROUGH_PX] = np.iinfo(distances.dtype).max
        return places

    def _similar_keyframes(self, group: Indices, corners: Corners) -> Indices:
        """The group of the likeliest other keyframe; none if there is none."""
        likeness = self.places.similarities(corners.descriptors)
        likeness[group] = 0.0
        return self.group(int(likeness.argmax())) if likeness.any() else group[:0]

    def _chosen(self, places: list[Found], view: FrameView, tracker: Tracker) -> Found | NoPose:
        """The place that explains a view best; if another one does so about as well, the one that is within reach."""
        first, *others = sorted(places, key=lambda place: -len(place[1].ids))
        least = ALIKE * len(first[1].ids)
        rivals = [place for place in others if len(place[1].ids) > least and self._apart_px(first, place) > APART_PX]
        if not rivals:
            return first
        near = [place for place in (first, *rivals) if self._is_within_reach(place, view, tracker)]
        counts = (len(first[1].ids), len(rivals[0][1].ids))
        return near[0] if len(near) == 1 else NoPose(SlamReason.TWO_PLACES, counts)

    def _apart_px(self, first: Found, second: Found) -> float:
        """How far apart two poses have the points of the first one, median."""
        positions = self._map.positions[first[1].ids]
        pixels, _ = project(first[0].camera_from_world, positions, self._intrinsics)
        errors = reprojection_errors(second[0].camera_from_world, positions, pixels, self._intrinsics)
        return float(np.median(errors))

    def _is_within_reach(self, place: Found, view: FrameView, tracker: Tracker) -> bool:
        """Whether a camera held by hand can have got there since it was lost."""
        if not len(tracker.points.ids):
            return False
        pose = place[0].camera_from_world
        depth = float(np.median(project(pose, self._map.positions[place[1].ids], self._intrinsics)[1]))
        moved = np.linalg.norm(inverse(pose)[:3, 3] - inverse(tracker.camera_from_world)[:3, 3])
        return bool(moved < MOST_DEPTHS_PER_S * depth * (view.timestamp - tracker.timestamp))

    def _where_it_was(self, view: FrameView, tracker: Tracker) -> Found | None:
        """The pose if the camera is still near where it was lost: of places that look alike the likeliest."""
        if not len(tracker.points.ids):
            return None
        number = int(np.bincount(self._map.template_keyframe[tracker.points.ids]).argmax())
        return self._confirmed(self.group(number), view, tracker.camera_from_world, tracker)

    def locate(self, view: FrameView, corners: Corners, group: Indices, tracker: Tracker) -> Found | None:
        """The pose by the points of some keyframes, and the points that support it; None if they do not."""
        rough = self._rough_pose(*self._distances(group, corners), corners)
        return None if rough is None else self._confirmed(group, view, rough.camera_from_world, tracker)

    def _candidates(self, descriptors: Descriptors) -> list[int]:
        order = np.argsort(-self.places.similarities(descriptors), kind="stable").tolist()
        rest = order[1 : 1 + N_IN_TURN]
        self._turn += 1
        return [order[0], *rest[self._turn % max(len(rest), 1) :][:1]]

    def group(self, number: int) -> Indices:
        """A keyframe and those that share most of its points."""
        shared = self._map.shared_points(self._map.good_in(number))
        shared[number] = np.iinfo(np.int64).max
        best = np.argsort(-shared, kind="stable")[:GROUP]
        return best[shared[best] >= LEAST_SHARED]

    def _distances(self, group: Indices, corners: Corners) -> tuple[Indices, NDArray[np.uint16]]:
        """The map points (p,) of some keyframes, and how many bits corners (c,) differ from them (c, p)."""
        keyframes = [self._map.keyframes[k] for k in group]
        if not keyframes:
            return NOWHERE.ids, np.empty((0, 0), dtype=np.uint16)
        ids = np.concatenate([keyframe.described_ids for keyframe in keyframes])
        described = np.concatenate([keyframe.descriptors for keyframe in keyframes])
        good = self._map.state[ids] == GOOD
        points, local = np.unique(ids[good], return_inverse=True)
        return points, least_distances(corners.descriptors, corners.rows, described[good], local)

    def _rough_pose(self, points: Indices, distances: NDArray[np.uint16], corners: Corners) -> PoseEstimate | None:
        """The pose that matches of descriptors agree on."""
        first, second = match_points(distances, RATIO, MOST_BITS)
        positions = self._map.positions[points[second]]
        return find_pose(positions, corners.pixels[first], self._intrinsics, ROUGH_PX, least=ROUGH_INLIERS)

    def _confirmed(
        self, group: Indices, view: FrameView, pose: Array, tracker: Tracker, anew: bool = False
    ) -> Found | None:
        """The pose from all points of the group, found near a rough pose (4, 4); None if too few are.

        ``anew`` : whether the camera may be anywhere.
        """
        ids = np.unique(np.concatenate([self._map.good_in(k) for k in group]))
        guesses, _ = project(pose, self._map.positions[ids], self._intrinsics)
        views = tracker.views_of(group)
        seen = inside(guesses, view.normalized.shape, PATCH_HALF + 2) & tracker.is_similar_view(ids, pose, views)
        found = tracker.find(view.pyramid, Followed(ids[seen], guesses[seen]), pose, 2, views)
        refined = refine_pose(pose, self._map.positions[found.ids], found.pixels, self._intrinsics, inlier_px=INLIER_PX)
        in_view = int(seen.sum())
        enough = max(LEAST_INLIERS, LEAST_FIT * len(found.ids), LEAST_SHARE * in_view)
        if anew:
            enough = max(enough, min(LEAST_ANEW, SHARE_ANEW * in_view))
        most = max(MOST_ERROR_RATIO * self._map.usual_rms_px, MOST_ERROR_PX)
        if refined.inliers.sum() < enough or refined.rms_px > most:
            return None
        found = found[refined.inliers]
        if views is not None:
            tracker.look_from(found.ids, views)
        return refined, found
