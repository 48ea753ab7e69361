"""Closing loops: the camera is back where it was, but what drifted in between says that it is elsewhere.

A new keyframe that resembles old ones, which share none of its points, is located by their points alone. The drift is
spread over all keyframes by a pose graph of similarity transforms, since the scale of a map made by one camera drifts
too (Strasdat, Montiel and Davison, Scale Drift-Aware Large Scale Monocular SLAM, 2010); points that were mapped twice
are made one, and the whole map is adjusted.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.linalg import spsolve
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from morph_dslam.camera import Camera
from morph_dslam.slam.frame_images import FrameView
from morph_dslam.slam.mapping import Mapper, Work
from morph_dslam.slam.pose import project
from morph_dslam.slam.relocalization import Relocalizer, described_corners
from morph_dslam.slam.rigid_map import GOOD, Followed, RigidMap
from morph_dslam.slam.tracking import Tracker

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
#: Step of the numerical derivatives, and when iterations end: at such a step, or after so many.
DIFFERENCE, LEAST_STEP, MOST_ITERATIONS = 1e-6, 1e-8, 20


@dataclass(frozen=True)
class Similarities:
    """Transforms world_from_camera: scales (n,), rotations (n, 3, 3), translations (n, 3)."""

    scales: Array
    rotations: Array
    translations: Array

    @classmethod
    def of_poses(cls, camera_from_world: Array) -> Similarities:
        """The inverses of rigid poses (n, 4, 4)."""
        rotations = camera_from_world[:, :3, :3].transpose(0, 2, 1)
        translations = -np.einsum("nij,nj->ni", rotations, camera_from_world[:, :3, 3])
        return cls(np.ones(len(rotations)), rotations, translations)

    def __getitem__(self, rows: Indices) -> Similarities:
        return Similarities(self.scales[rows], self.rotations[rows], self.translations[rows])

    def __matmul__(self, other: Similarities) -> Similarities:
        return Similarities(
            self.scales * other.scales, self.rotations @ other.rotations, self.apply(other.translations)
        )

    @property
    def inverse(self) -> Similarities:
        """The transforms the other way round."""
        rotations = self.rotations.transpose(0, 2, 1)
        turned = np.einsum("nij,nj->ni", rotations, self.translations)
        return Similarities(1.0 / self.scales, rotations, -turned / self.scales[:, None])

    def apply(self, points: Array) -> Array:
        """Move points (n, 3), each by its own transform."""
        return self.scales[:, None] * np.einsum("nij,nj->ni", self.rotations, points) + self.translations

    def camera_from_world(self) -> Array:
        """Poses (n, 4, 4) of the cameras; their scales are left to the points."""
        poses = np.tile(np.eye(4), (len(self.scales), 1, 1))
        poses[:, :3, :3] = self.rotations.transpose(0, 2, 1)
        poses[:, :3, 3] = -np.einsum("nij,nj->ni", poses[:, :3, :3], self.translations)
        return poses


def _small(steps: Array) -> Similarities:
    """Transforms near the identity from rotation vector, translation and logarithm of the scale (n, 7)."""
    rotations = Rotation.from_rotvec(steps[:, :3]).as_matrix()
    return Similarities(np.exp(steps[:, 6]), rotations, steps[:, 3:6])


def _residuals(first: Similarities, second: Similarities, measured: Similarities) -> Array:
    """What is left (m, 7) between the measured second_from_first and the estimated one."""
    left = measured @ (first.inverse @ second).inverse
    turns = Rotation.from_matrix(left.rotations).as_rotvec()
    return np.column_stack([turns, left.translations, np.log(left.scales)])


def optimise(start: Similarities, edges: Indices, measured: Similarities, with_scale: bool) -> Similarities:
    """Transforms that agree best with the measured first_from_second of edges; the first one stays.

    Parameters
    ----------
    edges : (m, 2) rows of the first and the second transform of each edge.
    measured : (m,).
    with_scale : whether scales are unknown too.
    """
    n_free = 7 if with_scale else 6
    current = start
    for _ in range(MOST_ITERATIONS):
        residuals = _residuals(current[edges[:, 0]], current[edges[:, 1]], measured)
        jacobian = _jacobian(current, edges, measured, residuals, n_free)
        matrix = (jacobian.T @ jacobian).tocsc() + 1e-12 * sparse.identity(
            n_free * (len(start.scales) - 1), format="csc"
        )
        step = np.zeros((len(start.scales), 7))
        step[1:, :n_free] = -spsolve(matrix, jacobian.T @ residuals.ravel()).reshape(-1, n_free)
        current = current @ _small(step)
        if np.abs(step).max() < LEAST_STEP:
            break
    return current


def _jacobian(
    current: Similarities, edges: Indices, measured: Similarities, residuals: Array, n_free: int
) -> sparse.csr_array:
    """Derivatives (7 m, n_free (n - 1)) by steps of all transforms but the first, from the right."""
    rows, columns, values = [], [], []
    for end in (0, 1):
        free = edges[:, end] > 0
        for component in range(n_free):
            step = np.zeros((len(edges), 7))
            step[:, component] = DIFFERENCE
            ends = [current[edges[:, 0]], current[edges[:, 1]]]
            ends[end] = ends[end] @ _small(step)
            derivative = (_residuals(ends[0], ends[1], measured) - residuals) / DIFFERENCE
            rows.append((7 * np.flatnonzero(free)[:, None] + np.arange(7)).ravel())
            columns.append(np.repeat(n_free * (edges[free, end] - 1) + component, 7))
            values.append(derivative[free].ravel())
    shape = (7 * len(edges), n_free * (len(current.scales) - 1))
    entries = np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))
    return sparse.csr_array(entries, shape=shape)


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
    number : the new keyframe.
    old : (g,) the old ones.
    camera_from_world : (4, 4) the new one by the old points.
    scale : of old lengths to new ones.
    found : old points in the new view.
    pairs : (p, 2) old and new numbers of points that are one.
    """

    number: int
    old: Indices
    camera_from_world: Array
    scale: float
    found: Followed
    pairs: Indices


def spread(rigid_map: RigidMap, before: Similarities, after: Similarities) -> None:
    """Move all keyframes of a map from where they were, and points with the keyframes that saw them.

    Where the scale around a keyframe changes, so does how far from it those are that it stands for.
    """
    owners = rigid_map.template_keyframe
    moved = after[owners] @ before[owners].inverse
    rigid_map.positions[:] = moved.apply(rigid_map.positions)
    grown = after.scales / before.scales
    for keyframe, pose in zip(rigid_map.keyframes, after.camera_from_world(), strict=True):
        keyframe.camera_from_world = pose
        if keyframe.carrier >= 0:
            # A new array: copies of the map may have the same.
            keyframe.from_carrier = keyframe.from_carrier.copy()
            keyframe.from_carrier[:3, 3] *= grown[keyframe.carrier]


class LoopCloser:
    """Finds and closes loops.

    Attributes
    ----------
    n_closed : loops closed so far.
    """

    def __init__(self, rigid_map: RigidMap, camera: Camera, mapper: Mapper) -> None:
        self._map, self._intrinsics, self._mapper = rigid_map, camera.intrinsics, mapper
        # Loops are looked for in the map as it was, while it goes on growing.
        self._copy = RigidMap(rigid_map.baseline_px)
        self._relocaliser = Relocalizer(self._copy, camera.intrinsics)
        self._tracker = Tracker(self._copy, camera)
        self._found: Loop | None = None
        self.n_closed = 0

    @property
    def has_found(self) -> bool:
        """Whether there is a loop to close."""
        return self._found is not None

    def search(self, view: FrameView) -> Work:
        """Look for a loop that the newest keyframe ends, in the map as it is when this is called."""
        self._copy.copy_of(self._map)
        return self._look(view)

    def _look(self, view: FrameView) -> Work:
        group = self._group_that_resembles()
        if group is None:
            return
        yield
        corners = described_corners(view)
        yield
        located = self._relocaliser.locate(view, corners, group, self._tracker)
        if located is not None:
            self._found = self._loop(len(self._copy.keyframes) - 1, group, located[0].camera_from_world, located[1])

    def close(self) -> None:
        """Close the loop that was found."""
        loop, self._found = self._found, None
        assert loop is not None
        before = Similarities.of_poses(np.array([k.camera_from_world for k in self._map.keyframes]))
        edges, measured = self._pose_graph(loop, before)
        after = optimise(before, edges, measured, with_scale=not self._map.is_metric)
        spread(self._map, before, after)
        self._join(loop)
        self._mapper.adjust_all()
        self.n_closed += 1

    def _group_that_resembles(self) -> Indices | None:
        """Old keyframes that the newest one resembles as much as its neighbours."""
        number = len(self._copy.keyframes) - 1
        shared = self._copy.shared_points(self._copy.good_in(number))
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
        return self._relocaliser.group(best)

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
        new_depths = project(keyframe.camera_from_world, self._copy.positions[pairs[:, 1]], self._intrinsics)[1]
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

    def _edges(self) -> Indices:
        """Pairs of keyframes that follow each other, or see many of the same points."""
        seen = np.zeros((len(self._map.keyframes), len(self._map.state)), dtype=np.float32)
        for row, keyframe in zip(seen, self._map.keyframes, strict=True):
            row[self._map.good_among(keyframe.point_ids)] = 1.0
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
