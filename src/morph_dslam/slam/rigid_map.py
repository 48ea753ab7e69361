"""The map of the rigid scene: points, keyframes, and which keyframe saw which point where.

A point begins as a candidate: a corner that is followed without its depth being known. Once rays from two
keyframes meet at a sufficient angle it becomes a map point. Numbers of points never change; removed ones
keep theirs.
"""

from __future__ import annotations

from collections.abc import Generator
from copy import copy
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from morph_dslam.notices import Notice
from morph_dslam.slam.frame_images import OCTAVES, FrameView, describe
from morph_dslam.slam.pose import inverse, reprojection_errors

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
Mask = NDArray[np.bool_]
CANDIDATE, GOOD, REMOVED = 0, 1, 2
#: Arrays of a map with one row a point.
POINT_ARRAYS = (
    "positions",
    "state",
    "first_keyframe",
    "first_pixels",
    "template_keyframe",
    "template_pixels",
    "n_expected",
    "n_found",
)
#: These and what is of no use to later runs, so not kept in files.
_ALL_POINT_ARRAYS = (*POINT_ARRAYS, "merged_into")
#: A frame is kept when the points have moved this far since the last one kept (median), pixels.
LEAST_MOTION_PX = 2.0
#: Frames kept at most; then every other one is left out.
MOST_VIEWS = 16
#: A point has to fit this share of the frames that it was followed in.
LEAST_SHARE = 0.75
#: Error that poses are taken to have before there is any.
FIRST_RMS_PX = 4.0
#: Velocity of a camera of which nothing is known.
UNKNOWN_TWIST = np.full(6, np.nan)


@dataclass
class Keyframe:
    """A view that the map keeps.

    Attributes
    ----------
    index, timestamp : of its frame.
    normalized : (h, w) its contrast-normalized image.
    camera_from_world : (4, 4).
    point_ids : (k,) points seen, ascending.
    pixels : (k, 2) where.
    right : (k,) their columns in a right image (`Followed`); all unmeasured by default.
    described_ids, descriptors : (d,), (d, 32) what points looked like, by `frame_images.describe`.
    depths : (m, 3) column, row and depth, metres, where a depth image measured it (`FrameDepth.samples`).
    carrier : number of the keyframe that stands for this one since it was taken out, -1 before.
    from_carrier : (4, 4) this one as seen from it.
    twist : (6,) velocity of the camera by its own axes, as of `rolling_shutter.velocities`; NaN if unknown.
    """

    index: int
    timestamp: float
    normalized: NDArray[np.uint8]
    camera_from_world: Array
    point_ids: Indices
    pixels: Array
    right: Array = None  # type: ignore[assignment]
    described_ids: Indices = field(default_factory=lambda: np.empty(0, dtype=np.int64))
    descriptors: NDArray[np.uint8] = field(default_factory=lambda: np.empty((0, 32), dtype=np.uint8))
    depths: NDArray[np.float32] = field(default_factory=lambda: np.empty((0, 3), dtype=np.float32))
    carrier: int = field(default=-1, kw_only=True)
    from_carrier: Array = field(default_factory=lambda: np.eye(4), kw_only=True)
    twist: Array = field(default_factory=lambda: UNKNOWN_TWIST, kw_only=True)

    def __post_init__(self) -> None:
        if self.right is None:
            self.right = np.full(len(self.point_ids), np.nan)

    @classmethod
    def of_view(
        cls, view: FrameView, camera_from_world: Array, seen: Followed, twist: Array = UNKNOWN_TWIST
    ) -> Keyframe:
        """A frame at a pose (4, 4), with the points seen in it, and the camera's velocity (6,)."""
        keyframe = cls(
            view.index,
            view.timestamp,
            view.normalized,
            camera_from_world,
            seen.ids,
            seen.pixels,
            seen.right,
            twist=twist,
        )
        if view.depth is not None:
            keyframe.depths = view.depth.samples()
        return keyframe

    def describe(self, grey: NDArray[np.uint8]) -> Generator[None, None, None]:
        """Describe its points in its grey image (h, w), scale by scale, so that they can be recognised."""
        parts = []
        for octave in OCTAVES:
            parts.append(describe(grey, self.pixels, (octave,)))
            yield
        rows, descriptors = zip(*parts, strict=True)
        self.described_ids, self.descriptors = self.point_ids[np.concatenate(rows)], np.concatenate(descriptors)

    @property
    def seen(self) -> Followed:
        """The points and where they are."""
        return Followed(self.point_ids, self.pixels, self.right)

    def keep(self, rows: NDArray) -> None:
        """Keep the chosen observations only, in the chosen order."""
        self.point_ids, self.pixels, self.right = self.point_ids[rows], self.pixels[rows], self.right[rows]

    def rows_of(self, ids: Indices) -> tuple[Indices, NDArray[np.bool_]]:
        """Rows of points (n,), and which of them (n,) were seen; the rows of the others mean nothing."""
        if not len(self.point_ids):
            return np.zeros(len(ids), dtype=np.int64), np.zeros(len(ids), dtype=bool)
        rows = np.minimum(np.searchsorted(self.point_ids, ids), len(self.point_ids) - 1)
        return rows, self.point_ids[rows] == ids


class Followed:
    """Points in a frame.

    Attributes
    ----------
    ids : (n,) their numbers.
    pixels : (n, 2).
    right : (n,) their columns in a right image at the map's baseline, NaN where depth was not measured.
    """

    __slots__ = ("ids", "pixels", "right")

    def __init__(self, ids: Indices, pixels: Array, right: Array | None = None) -> None:
        self.ids, self.pixels = ids, pixels
        self.right = np.full(len(ids), np.nan) if right is None else right

    def __getitem__(self, rows: NDArray) -> Followed:
        return Followed(self.ids[rows], self.pixels[rows], self.right[rows])

    def without_unmeasured(self) -> Followed:
        """The same in less memory, where no depth was measured."""
        unmeasured = np.broadcast_to(np.nan, len(self.ids))
        return self if np.isfinite(self.right).any() else Followed(self.ids, self.pixels, unmeasured)

    def joined(self, other: Followed) -> Followed:
        """These points and others."""
        return Followed(
            np.concatenate([self.ids, other.ids]),
            np.concatenate([self.pixels, other.pixels]),
            np.concatenate([self.right, other.right]),
        )


NOWHERE = Followed(np.empty(0, dtype=np.int64), np.empty((0, 2)))


@dataclass(frozen=True)
class _View:
    """A frame by its place in a keyframe's frame (4, 4), and where points (n,) were in it (n, 2)."""

    keyframe: int
    from_keyframe: Array
    ids: Indices
    pixels: Array


class PassingViews:
    """Frames between keyframes, kept while candidates have to show that they belong to the rigid scene.

    Two views alone cannot tell a point that stands still from one that moves along its epipolar line; where it was in
    between does, unless it keeps to the camera's pace. Copies stay what they are while the original goes on: lists of
    frames are replaced, not changed.
    """

    def __init__(self, views: list[_View] | None = None) -> None:
        self._views = views or []

    def copy(self) -> PassingViews:
        """The same views, to which others can be added apart."""
        return PassingViews(self._views)

    def note(self, keyframe: int, at: Array, camera_from_world: Array, ids: Indices, pixels: Array) -> None:
        """Keep a frame and its points without depth (n,) at pixels (n, 2), if these have moved on.

        ``at`` is the pose (4, 4) of the keyframe, whose later adjustments carry the frame along. Frames that
        show none of these points are not needed any more.
        """
        if not len(ids) or not self._has_moved_on(ids, pixels):
            return
        views = [view for view in self._views if np.isin(view.ids, ids).any()]
        views = views[::2] if len(views) >= MOST_VIEWS else views
        self._views = [*views, _View(keyframe, camera_from_world @ inverse(at), ids, pixels)]

    def agree(self, ids: Indices, points: Array, keyframe_poses: Array, intrinsics: Array, most_px: float) -> Mask:
        """Which points (n,), put at ``points`` (n, 3), are where they were seen; all that were never seen.

        ``keyframe_poses`` (k, 4, 4) are what the map has now.
        """
        seen, fitting = np.zeros(len(ids)), np.zeros(len(ids))
        order = np.argsort(ids)
        for view in self._views:
            common, rows, there = np.intersect1d(ids[order], view.ids, return_indices=True)
            if not len(common):
                continue
            rows = order[rows]
            pose = view.from_keyframe @ keyframe_poses[view.keyframe]
            errors = reprojection_errors(pose, points[rows], view.pixels[there], intrinsics)
            seen[rows] += 1
            fitting[rows] += errors < most_px
        return fitting >= LEAST_SHARE * seen

    def _has_moved_on(self, ids: Indices, pixels: Array) -> bool:
        if not self._views:
            return True
        last = self._views[-1]
        common, now, before = np.intersect1d(ids, last.ids, return_indices=True)
        if not len(common):
            return True
        moved = np.linalg.norm(pixels[now] - last.pixels[before], axis=1)
        return bool(np.median(moved) > LEAST_MOTION_PX)


class RigidMap:
    """Points and keyframes.

    Attributes
    ----------
    keyframes : in the order in which they came.
    positions : (n, 3) in the world; provisional for candidates.
    state : (n,) CANDIDATE, GOOD or REMOVED.
    first_keyframe, first_pixels : (n,), (n, 2) where a point was first seen.
    template_keyframe, template_pixels : (n,), (n, 2) the view whose patch stands for the point.
    merged_into : (n,) the point that a point was made one with, by `merge`; its own number otherwise.
    n_expected, n_found : (n,) frames in which it should have been seen, and in which it was.
    usual_rms_px : running mean of the errors of the poses found in it.
    baseline_px : focal length times the baseline that right columns refer to, px m; 0 where no depth is
        measured, and lengths are in map units instead of metres.
    has_given_lengths : whether lengths are those of poses that were given.
    renumbered : what each recording that it grew by added to the numbers of all keyframes before, the latest last.
    passing : frames that are not kept, but tell which candidates move.
    camera_notes : what its recording showed to be wrong with its camera, for people.
    notices : what its recording showed to be wrong with the map itself.
    """

    def __init__(self, baseline_px: float = 0.0) -> None:
        self.baseline_px = baseline_px
        self.keyframes: list[Keyframe] = []
        self.usual_rms_px = FIRST_RMS_PX
        self.camera_notes: tuple[str, ...] = ()
        self.notices: tuple[Notice, ...] = ()
        self.has_given_lengths = False
        self.renumbered: tuple[int, ...] = ()
        self.passing = PassingViews()
        self.positions = np.empty((0, 3))
        self.state = np.empty(0, dtype=np.int8)
        self.first_keyframe, self.first_pixels = np.empty(0, dtype=np.int64), np.empty((0, 2))
        self.template_keyframe, self.template_pixels = np.empty(0, dtype=np.int64), np.empty((0, 2))
        self.merged_into = np.empty(0, dtype=np.int64)
        self.n_expected, self.n_found = np.empty(0, dtype=np.int64), np.empty(0, dtype=np.int64)

    @property
    def is_metric(self) -> bool:
        """Whether lengths are metres."""
        return self.baseline_px > 0.0

    @property
    def good(self) -> Indices:
        """Numbers of the map points."""
        return np.flatnonzero(self.state == GOOD)

    def good_in(self, number: int) -> Indices:
        """Numbers of the map points that a keyframe sees."""
        return self.good_among(self.keyframes[number].point_ids)

    def good_among(self, ids: Indices) -> Indices:
        """Those of some points that are map points."""
        return ids[self.state[ids] == GOOD]

    def copy_of(self, other: RigidMap) -> None:
        """Become what another map is now, and stay so while it changes."""
        self.usual_rms_px, self.passing = other.usual_rms_px, other.passing.copy()
        self.keyframes = [copy(keyframe) for keyframe in other.keyframes]
        for name in _ALL_POINT_ARRAYS:
            setattr(self, name, getattr(other, name).copy())

    def copied(self) -> RigidMap:
        """Another map that is what this one is now, and may change by itself."""
        other = RigidMap(self.baseline_px)
        other.camera_notes, other.has_given_lengths = self.camera_notes, self.has_given_lengths
        other.renumbered, other.notices = self.renumbered, self.notices
        other.copy_of(self)
        return other

    def share(self, other: RigidMap) -> None:
        """Become what another map is now, at once: with the same arrays, which must not change any more."""
        self.usual_rms_px, self.keyframes = other.usual_rms_px, other.keyframes
        for name in _ALL_POINT_ARRAYS:
            setattr(self, name, getattr(other, name))

    def take_over(self, draft: RigidMap) -> None:
        """Become what has been made of a copy of this map, at once; what tracking counted since stays."""
        new = np.zeros(len(draft.state) - len(self.state), dtype=np.int64)
        expected, found = (np.concatenate([count, new]) for count in (self.n_expected, self.n_found))
        usual = self.usual_rms_px
        self.share(draft)
        self.n_expected, self.n_found, self.usual_rms_px = expected, found, usual

    def add_points(self, positions: Array, pixels: Array, keyframe: int, state: int) -> Indices:
        """New points (n, 3), first seen at ``pixels`` (n, 2) of a keyframe; returns their numbers (n,)."""
        n, before = len(positions), len(self.positions)
        views = np.full(n, keyframe, dtype=np.int64)
        self.positions = np.concatenate([self.positions, positions])
        self.state = np.concatenate([self.state, np.full(n, state, dtype=np.int8)])
        self.first_keyframe = np.concatenate([self.first_keyframe, views])
        self.first_pixels = np.concatenate([self.first_pixels, pixels])
        self.template_keyframe = np.concatenate([self.template_keyframe, views])
        self.template_pixels = np.concatenate([self.template_pixels, pixels])
        self.n_expected = np.concatenate([self.n_expected, np.zeros(n, dtype=np.int64)])
        self.n_found = np.concatenate([self.n_found, np.zeros(n, dtype=np.int64)])
        numbers = np.arange(before, before + n)
        self.merged_into = np.concatenate([self.merged_into, numbers])
        return numbers

    def add_keyframe(self, keyframe: Keyframe) -> int:
        """Append a view, which becomes the template of the points it sees; returns its number."""
        keyframe.keep(np.argsort(keyframe.point_ids))
        self.keyframes.append(keyframe)
        number = len(self.keyframes) - 1
        self.template_keyframe[keyframe.point_ids] = number
        self.template_pixels[keyframe.point_ids] = keyframe.pixels
        return number

    @property
    def kept_keyframes(self) -> Indices:
        """Numbers of the keyframes that have not been taken out."""
        return np.array([k for k, keyframe in enumerate(self.keyframes) if keyframe.carrier < 0], dtype=int)

    def seen_in_keyframes(self, since: int = 0) -> dict[int, Followed]:
        """What the keyframes from ``since`` on see that have not been taken out, by the numbers of their frames."""
        return {self.keyframes[k].index: self.keyframes[k].seen for k in self.kept_keyframes if k >= since}

    def pose_of(self, number: int) -> Array:
        """camera_from_world (4, 4) of a keyframe; one that was taken out moves along with its carrier."""
        keyframe, moved = self.keyframes[number], np.eye(4)
        while keyframe.carrier >= 0:
            moved = moved @ keyframe.from_carrier
            keyframe = self.keyframes[keyframe.carrier]
        return moved @ keyframe.camera_from_world

    def remove_keyframe(self, number: int, carrier: int) -> None:
        """Take a keyframe out; it keeps its number, and another one stands for it.

        Its points go over to the newest keyframes that see them; map points that fewer than two see go too.
        """
        old = self.keyframes[number]
        relative = old.camera_from_world @ np.linalg.inv(self.keyframes[carrier].camera_from_world)
        self.keyframes[number] = Keyframe(
            old.index,
            old.timestamp,
            np.empty((0, 0), dtype=np.uint8),
            old.camera_from_world,
            old.point_ids[:0],
            old.pixels[:0],
            carrier=carrier,
            from_carrier=relative,
        )
        self.remove(np.flatnonzero((self.state == GOOD) & (self.n_observations() < 2)))
        for views, pixels in ((self.template_keyframe, self.template_pixels), (self.first_keyframe, self.first_pixels)):
            left = np.flatnonzero((views == number) & (self.state != REMOVED))
            for k in range(len(self.keyframes) - 1, -1, -1):
                if not len(left):
                    break
                rows, seen = self.keyframes[k].rows_of(left)
                views[left[seen]], pixels[left[seen]] = k, self.keyframes[k].pixels[rows[seen]]
                left = left[~seen]

    def extend_keyframe(self, number: int, new: Followed) -> None:
        """Add observations of points newer than all that the keyframe has."""
        keyframe = self.keyframes[number]
        seen = keyframe.seen.joined(new)
        keyframe.point_ids, keyframe.pixels, keyframe.right = seen.ids, seen.pixels, seen.right

    def remove(self, ids: Indices) -> None:
        """Take points out, with their observations."""
        self.state[ids] = REMOVED
        gone = np.zeros(len(self.state), dtype=bool)
        gone[ids] = True
        for keyframe in self.keyframes:
            rows = gone[keyframe.point_ids]
            if rows.any():
                keyframe.keep(~rows)

    def merge(self, kept: int, dropped: int) -> None:
        """Make two points that are one: ``kept`` takes the observations of ``dropped``."""
        for keyframe in self.keyframes:
            rows, seen = keyframe.rows_of(np.array([kept, dropped]))
            if seen[1] and not seen[0]:
                # Copies of the map may have the same array.
                ids = keyframe.point_ids.copy()
                ids[rows[1]] = kept
                keyframe.point_ids = ids
                keyframe.keep(np.argsort(ids))
        self.remove(np.array([dropped]))
        self.merged_into[dropped] = kept

    def good_of(self, seen: Followed) -> Followed:
        """Those of the points seen in a frame that are map points now, by the numbers that they have now."""
        ids = seen.ids
        while (self.merged_into[ids] != ids).any():
            ids = self.merged_into[ids]
        _, first = np.unique(ids, return_index=True)
        rows = np.sort(first)
        rows = rows[self.state[ids[rows]] == GOOD]
        return Followed(ids[rows], seen.pixels[rows], seen.right[rows])

    def shared_points(self, ids: Indices) -> Indices:
        """How many of these points each keyframe (k,) saw: covisibility."""
        wanted = np.zeros(len(self.state), dtype=bool)
        wanted[ids] = True
        return np.array([int(wanted[keyframe.point_ids].sum()) for keyframe in self.keyframes])

    def n_observations(self) -> Indices:
        """Keyframes (n,) that saw each point; one that measured its depth places it and counts twice."""
        counts = np.zeros(len(self.state), dtype=np.int64)
        for keyframe in self.keyframes:
            counts[keyframe.point_ids] += 1 + np.isfinite(keyframe.right)
        return counts
