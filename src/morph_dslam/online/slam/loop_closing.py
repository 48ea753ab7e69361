"""Closing loops: the camera is back where it was, but what drifted in between says that it is elsewhere.

A new keyframe that resembles old ones, which share none of its points, is located by their points alone. If
it is found, the drift is known: it is spread over all keyframes (`pose_graph`), points that were mapped twice
are made one, and the whole map is adjusted.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from morph_dslam.online.slam.frame_images import FrameView
from morph_dslam.online.slam.mapping import Mapper
from morph_dslam.online.slam.mapping_work import Work, one_step
from morph_dslam.online.slam.options import SlamOptions
from morph_dslam.online.slam.pose_graph import Similarities, optimise
from morph_dslam.online.slam.projection import project
from morph_dslam.online.slam.relocalisation import Relocaliser
from morph_dslam.online.slam.rigid_map import GOOD, Followed, Indices, RigidMap
from morph_dslam.online.slam.tracking import Tracker

Array = NDArray[np.float64]

#: Old keyframes are at least so many keyframes older, and share fewer points with the new one.
LEAST_AGE, MOST_SHARED = 8, 15
#: An old keyframe has to resemble the new one this much as the best of its neighbours does.
LEAST_LIKENESS = 0.6
#: Old points found in the new view, and of them those that are new points as well, within so many pixels.
LEAST_FOUND, LEAST_PAIRS, PAIR_PX = 40, 12, 3.0
#: Keyframes that share so many points hold each other in the pose graph.
LEAST_COVISIBLE = 40


@dataclass(frozen=True)
class Loop:
    """A keyframe seen by an old part of the map.

    Attributes
    ----------
    number : the new keyframe. old : (g,) the old ones.
    camera_from_world : (4, 4) the new one by the old points. scale : of old lengths to new ones.
    found : old points in the new view. pairs : (p, 2) old and new numbers of points that are one.
    """

    number: int
    old: Indices
    camera_from_world: Array
    scale: float
    found: Followed
    pairs: Indices


class LoopCloser:
    """Finds and closes loops.

    Attributes
    ----------
    n_closed : loops closed so far.
    """

    def __init__(self, rigid_map: RigidMap, intrinsics: Array, options: SlamOptions, mapper: Mapper) -> None:
        self._map, self._intrinsics, self._mapper = rigid_map, intrinsics, mapper
        # Loops are looked for in the map as it was, while it goes on growing.
        self._copy = RigidMap(rigid_map.baseline_px)
        self._relocaliser = Relocaliser(self._copy, intrinsics, options)
        self._tracker = Tracker(self._copy, intrinsics, options)
        self._found: Loop | None = None
        self.n_closed = 0

    @property
    def has_found(self) -> bool:
        """Whether there is a loop to close."""
        return self._found is not None

    def search(self, view: FrameView) -> Work:
        """Look for a loop that the newest keyframe ends, in the map as it is when this is called."""
        self._copy.share(self._map)
        return one_step(partial(self._look, view))

    def _look(self, view: FrameView) -> None:
        self._found = self._find(view)

    def close(self) -> None:
        """Close the loop that was found."""
        loop, self._found = self._found, None
        assert loop is not None
        before = Similarities.of_poses(np.array([k.camera_from_world for k in self._map.keyframes]))
        edges, measured = self._pose_graph(loop, before)
        after = optimise(before, edges, measured, with_scale=not self._map.is_metric)
        self._spread(before, after)
        self._join(loop)
        self._mapper.adjust_all()
        self.n_closed += 1

    def _find(self, view: FrameView) -> Loop | None:
        number = len(self._copy.keyframes) - 1
        ids = self._copy.keyframes[number].point_ids
        shared = self._copy.shared_points(ids[self._copy.state[ids] == GOOD])
        old = shared < MOST_SHARED
        old[max(number - LEAST_AGE, 0) :] = False
        if not old.any():
            return None
        places = self._relocaliser.places
        places.update()
        likeness = places.similarities(self._copy.keyframes[number].descriptors)
        neighbours = (shared >= MOST_SHARED) & (np.arange(len(shared)) != number)
        best = int(np.where(old, likeness, -1.0).argmax())
        if neighbours.any() and likeness[best] < LEAST_LIKENESS * likeness[neighbours].max():
            return None
        group = self._relocaliser.group(best)
        located = self._relocaliser.locate(view, group, self._tracker)
        return (
            None if located is None else self._loop(number, group, located[0].camera_from_world, located[1])
        )

    def _loop(self, number: int, group: Indices, pose: Array, found: Followed) -> Loop | None:
        """The drift, from points that the new view sees twice, as old and as new ones."""
        keyframe = self._copy.keyframes[number]
        new = keyframe.seen[self._copy.state[keyframe.point_ids] == GOOD]
        found = found[~np.isin(found.ids, new.ids)]
        if len(found.ids) < LEAST_FOUND or not len(new.ids):
            return None
        distances, nearest = KDTree(new.pixels).query(found.pixels)
        near = np.asarray(distances) < PAIR_PX
        # Of old points at one new point the first counts.
        rows, kept = np.unique(np.asarray(nearest)[near], return_index=True)
        if len(rows) < LEAST_PAIRS:
            return None
        pairs = np.column_stack([found.ids[near][kept], new.ids[rows]])
        old_depths = project(pose, self._copy.positions[pairs[:, 0]], self._intrinsics)[1]
        new_depths = project(keyframe.camera_from_world, self._copy.positions[pairs[:, 1]], self._intrinsics)[
            1
        ]
        scale = 1.0 if self._copy.is_metric else float(np.median(old_depths / new_depths))
        return Loop(number, group, pose, scale, found, pairs)

    def _pose_graph(self, loop: Loop, before: Similarities) -> tuple[Indices, Similarities]:
        """Pairs of keyframes (m, 2) that hold each other, and how each first one is seen from the second."""
        edges = self._edges()
        measured = before[edges[:, 0]].inverse @ before[edges[:, 1]]
        closed = Similarities.of_poses(np.repeat(loop.camera_from_world[None], len(loop.old), axis=0))
        closed = Similarities(np.full(len(loop.old), loop.scale), closed.rotations, closed.translations)
        held = before[loop.old].inverse @ closed
        edges = np.vstack([edges, np.column_stack([loop.old, np.full(len(loop.old), loop.number)])])
        measured = Similarities(
            np.concatenate([measured.scales, held.scales]),
            np.concatenate([measured.rotations, held.rotations]),
            np.concatenate([measured.translations, held.translations]),
        )
        return edges, measured

    def _spread(self, before: Similarities, after: Similarities) -> None:
        """Move keyframes, and points with the keyframes that saw them."""
        owners = self._map.template_keyframe
        moved = after[owners] @ before[owners].inverse
        self._map.positions[:] = moved.apply(self._map.positions)
        for keyframe, pose in zip(self._map.keyframes, after.camera_from_world(), strict=True):
            keyframe.camera_from_world = pose

    def _edges(self) -> Indices:
        """Pairs of keyframes that follow each other, or see many of the same points."""
        n, state = len(self._map.keyframes), self._map.state
        seen = np.zeros((n, len(state)), dtype=np.float32)
        for row, keyframe in zip(seen, self._map.keyframes, strict=True):
            row[keyframe.point_ids[state[keyframe.point_ids] == GOOD]] = 1.0
        first, second = np.nonzero(np.triu(seen @ seen.T >= LEAST_COVISIBLE, k=1))
        kept = self._map.kept_keyframes
        pairs = np.concatenate([np.column_stack([kept[:-1], kept[1:]]), np.column_stack([first, second])])
        return np.unique(pairs, axis=0)

    def _join(self, loop: Loop) -> None:
        """Make one of points that are one, and let the new view see the other old points too."""
        for old, new in loop.pairs.tolist():
            if self._map.state[old] == GOOD and self._map.state[new] == GOOD:
                self._map.merge(old, new)
        keyframe = self._map.keyframes[loop.number]
        known = self._map.state[loop.found.ids] == GOOD
        other = loop.found[known & ~np.isin(loop.found.ids, keyframe.point_ids)]
        self._map.extend_keyframe(loop.number, other)
        keyframe.keep(np.argsort(keyframe.point_ids))
