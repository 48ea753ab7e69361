"""What a map's points say about the poses of its keyframes, the points themselves being eliminated.

The points stand still with the object, so they are points of its frame. What the pixels say about the poses
when every point may be where it fits best is the Schur complement of the points (Triggs et al., Bundle
Adjustment - A Modern Synthesis, 2000, section 6).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from morph_dslam.camera import Camera
from morph_dslam.geometry import RigidTransform, SimilarityTransform
from morph_dslam.registration.texture import pose_jacobian
from morph_dslam.slam.rigid_map import GOOD, RigidMap

Array = NDArray[np.float64]

#: At most so many points, those that most views saw.
MOST_POINTS = 2000

#: Iterations for the points' places, and how far a point's block is from singular at the least.
ITERATIONS, RIDGE = 3, 1e-6

#: Points nearer than this part of the usual depth do not count.
LEAST_DEPTH = 0.05


@dataclass(frozen=True)
class PoseScores:
    """What measurements say about the poses of K views.

    Attributes
    ----------
    information : (6 K, 6 K). scores : (c, 6 K), gradients by independent groups of measurements, which add up
        to the right-hand side. sigma_px : standard deviation of a pixel coordinate.
    """

    information: Array
    scores: Array
    sigma_px: float


class StaticPoints:
    """Points of the map that at least two of the views saw.

    Parameters
    ----------
    positions : (n, 3) of all points, object frame, metres. views : with ``point_ids`` among these.
    """

    def __init__(self, positions: Array, views: Sequence[View], camera: Camera) -> None:
        self._camera = camera
        counts = np.bincount(np.concatenate([view.point_ids for view in views]), minlength=len(positions))
        chosen = np.argsort(-counts, kind="stable")[:MOST_POINTS]
        chosen = np.sort(chosen[counts[chosen] >= 2])
        row = np.full(len(positions), -1)
        row[chosen] = np.arange(len(chosen))
        rows = [row[view.point_ids] for view in views]
        self._view = np.concatenate([np.full((r >= 0).sum(), k) for k, r in enumerate(rows)])
        self._point = np.concatenate([r[r >= 0] for r in rows])
        self._pixels = np.concatenate([v.pixels[r >= 0] for v, r in zip(views, rows, strict=True)])
        self._positions = positions[chosen]

    def __len__(self) -> int:
        return len(self._positions)

    def linearise(self, poses: Sequence[RigidTransform]) -> PoseScores:
        """Moves the points to where they fit these poses best, and says where the poses should go."""
        for _ in range(ITERATIONS):
            residuals, by_point, _ = self._residuals(poses)
            weights, _ = self._weights(residuals)
            blocks, right = self._point_system(residuals, by_point, weights)
            self._positions = self._positions + np.linalg.solve(blocks, right[:, :, None])[:, :, 0]
        residuals, by_point, by_pose = self._residuals(poses)
        weights, sigma = self._weights(residuals)
        weights = weights / sigma**2
        blocks, right = self._point_system(residuals, by_point, weights)
        n, k = len(self), len(poses)
        weighted = by_pose * weights[:, None, None]
        cross, gradient = np.zeros((n, k, 6, 3)), np.zeros((n, k, 6))
        np.add.at(cross, (self._point, self._view), np.einsum("oij,oik->ojk", weighted, by_point))
        np.add.at(gradient, (self._point, self._view), np.einsum("oij,oi->oj", weighted, residuals))
        own = np.zeros((k, 6, 6))
        np.add.at(own, self._view, np.einsum("oij,oik->ojk", weighted, by_pose))
        cross = cross.reshape(n, 6 * k, 3)
        half = np.linalg.solve(np.linalg.cholesky(blocks), cross.transpose(0, 2, 1)).reshape(3 * n, 6 * k)
        information = -half.T @ half
        for view in range(k):
            part = slice(6 * view, 6 * view + 6)
            information[part, part] += own[view]
        away = np.linalg.solve(blocks, right[:, :, None])
        return PoseScores(information, gradient.reshape(n, 6 * k) - (cross @ away)[:, :, 0], sigma)

    def _residuals(self, poses: Sequence[RigidTransform]) -> tuple[Array, Array, Array]:
        """Residuals (o, 2), seen minus expected, and derivatives of the expected pixels by point and pose."""
        rotations = np.array([pose.rotation for pose in poses])[self._view]
        shifts = np.array([pose.translation for pose in poses])[self._view]
        local = np.einsum("oij,oj->oi", rotations, self._positions[self._point]) + shifts
        near = local[:, 2] < LEAST_DEPTH * float(np.median(local[:, 2]))
        local[near] = [0.0, 0.0, float(np.median(local[:, 2]))]
        residuals = self._pixels - self._camera.project(local)
        slopes = self._camera.projection_jacobian(local)
        residuals[near], slopes[near] = 0.0, 0.0
        by_pose = np.empty((len(local), 2, 6))
        for view, pose in enumerate(poses):
            mine = self._view == view
            by_pose[mine] = slopes[mine] @ pose_jacobian(local[mine], pose)
        return residuals, slopes @ rotations, by_pose

    def _weights(self, residuals: Array) -> tuple[Array, float]:
        """Huber weights (o,), and the robust standard deviation of a coordinate."""
        freedom = max(2 * len(residuals) - 3 * len(self), 1) / max(2 * len(residuals), 1)
        return huber_weights(residuals, freedom)

    def _point_system(self, residuals: Array, by_point: Array, weights: Array) -> tuple[Array, Array]:
        """Blocks (n, 3, 3), kept invertible, and right-hand sides (n, 3)."""
        blocks, right = np.zeros((len(self), 3, 3)), np.zeros((len(self), 3))
        weighted = by_point * weights[:, None, None]
        np.add.at(blocks, self._point, np.einsum("oij,oik->ojk", weighted, by_point))
        np.add.at(right, self._point, np.einsum("oij,oi->oj", weighted, residuals))
        ridge = RIDGE * np.trace(blocks, axis1=1, axis2=2) + 1e-12
        return blocks + ridge[:, None, None] * np.eye(3), right


def huber_weights(residuals: Array, freedom: float = 1.0) -> tuple[Array, float]:
    """Weights (p,) of residuals (p, 2), which fall beyond two standard deviations, and the latter.

    The length of a Gaussian pair has the median 1.1774 sigma (Rayleigh). ``freedom`` is the share of the
    numbers that no unknown takes up.
    """
    lengths = np.linalg.norm(residuals, axis=1)
    sigma = max(float(np.median(lengths)) / 1.1774 / np.sqrt(freedom), 1e-3)
    return 2.0 * sigma / np.maximum(lengths, 2.0 * sigma), sigma


# A map of the rigid scene as registration takes it: points with where they were seen from, and views.


#: A view sees an object of which at least this part projects into its image.
SEEN_SHARE = 0.5


@dataclass(frozen=True)
class MapPoints:
    """Points (n, 3) of a map, and from where (n, 3) each was seen, world."""

    positions: Array
    viewpoints: Array

    def __getitem__(self, rows: NDArray) -> MapPoints:
        return MapPoints(self.positions[rows], self.viewpoints[rows])

    def __len__(self) -> int:
        return len(self.positions)


@dataclass(frozen=True)
class View:
    """A keyframe.

    Attributes
    ----------
    frame : its number in the recording.
    normalized : (h, w) uint8 its contrast-normalized image, undistorted. camera_from_world : its pose.
    point_ids : (k,) rows of the map points seen. pixels : (k, 2) where.
    """

    frame: int
    normalized: NDArray[np.uint8]
    camera_from_world: RigidTransform
    point_ids: NDArray[np.int64]
    pixels: Array


def scene_of_map(rigid_map: RigidMap) -> tuple[MapPoints, Sequence[View]]:
    """Points and views of a map; each point's viewpoint is the mean place of the keyframes that saw it."""
    good = np.flatnonzero(rigid_map.state == GOOD)
    row = np.full(len(rigid_map.state), -1)
    row[good] = np.arange(len(good))
    views, total, count = [], np.zeros((len(good), 3)), np.zeros(len(good))
    for keyframe in (rigid_map.keyframes[k] for k in rigid_map.kept_keyframes):
        pose = RigidTransform.from_matrix(keyframe.camera_from_world)
        seen = row[keyframe.point_ids]
        kept = seen >= 0
        views.append(View(keyframe.index, keyframe.normalized, pose, seen[kept], keyframe.pixels[kept]))
        total[seen[kept]] += pose.inverse.translation
        count[seen[kept]] += 1.0
    used = count > 0
    everywhere = total.sum(axis=0) / max(count.sum(), 1.0)
    viewpoints = np.where(used[:, None], total / np.maximum(count, 1.0)[:, None], everywhere)
    return MapPoints(rigid_map.positions[good], viewpoints), views


def spread_views(views: Sequence[View], most: int) -> list[View]:
    """At most so many of the views, spread over all."""
    chosen = np.unique(np.linspace(0, len(views) - 1, min(most, len(views))).round().astype(int))
    return [views[index] for index in chosen]


def camera_from_object(view: View, world_from_object: SimilarityTransform) -> RigidTransform:
    """The object's pose in a view, metres."""
    camera, placed = view.camera_from_world, world_from_object
    return RigidTransform(camera.rotation @ placed.rotation, camera.apply(placed.translation) / placed.scale)


def views_of(nodes: Array, placed: SimilarityTransform, views: Sequence[View], camera: Camera, most: int) -> list[View]:
    """At most so many of the views that have the object in their image, spread over all.

    ``nodes`` are its (n, 3), metres.
    """
    seeing = []
    for view in views:
        local = camera_from_object(view, placed).apply(nodes[:: max(1, len(nodes) // 200)])
        pixels = camera.project(local)
        inside = (local[:, 2] > 0.0) & ((pixels >= 0.0) & (pixels < [camera.width, camera.height])).all(axis=1)
        if inside.mean() >= SEEN_SHARE:
            seeing.append(view)
    return spread_views(seeing, most)
