"""The keyframes' poses about the registered object, adjusted together.

A map's camera path has its own errors, and a similarity that lays the object into the map inherits them.
So in the end each keyframe gets a pose of its own about the object, in metres: those with which the images
agree on the mesh, and with which the map's points, which stand still beside it, agree as well. It is a bundle
adjustment in which the object's points lie on its surface and the others are free.

Images of a few plane faces do not tell the size of an object: scaled about the corner where they meet, all faces stay
where they are. What images leave open stays as it was before, by the object's edges or the map's points, and has the
covariance that it had.

The covariance is a sandwich (Huber & Ronchetti, Robust Statistics, 6.3): neighbouring measurements share
their errors, and so do all pairs of views that show one patch of the surface. So the gradients are summed by
patches, and by points, before their squares are.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from morph_dslam.camera import Camera
from morph_dslam.geometry import RigidTransform, SimilarityTransform
from morph_dslam.registration.adjusted_keyframes import AdjustedKeyframes, sight_metric
from morph_dslam.registration.increments import moved_pose, pose_jacobian, similarity_jacobian
from morph_dslam.registration.registration import Axis
from morph_dslam.registration.scene import MapPoints, View, camera_from_object, views_of
from morph_dslam.registration.texture import WINDOW, PairDisplacements, TextureComparison

Array = NDArray[np.float64]
ITERATIONS = 8
#: Steps are prolonged by at most so many times.
MOST_EXTRAPOLATED = 4.0
#: Keyframes adjusted, spread over all that see the object.
MOST_VIEWS = 24
#: Fewer measurements for each view are no evidence.
FEWEST = 30
#: Windows as large as the patches reach into the next ones: the sum over a patch holds only (2 / 3)^2 of what
#: they have in common.
ACROSS_PATCHES = 9.0 / 4.0
#: What else neighbouring patches and points have in common, in variance: so much larger were the errors in
#: ten rendered scans with known truth (benchmarks/registration_seeds.py, the first ten seeds).
IN_COMMON = 16.0 / 9.0
#: At most so many points, those that most views saw.
MOST_STATIC = 2000
#: Corners of images are no more exact, pixels.
LEAST_STATIC_PX = 0.1
#: Iterations for the points' places, and how far a point's block is from singular at the least.
POINT_ITERATIONS, RIDGE = 3, 1e-6
#: Points nearer than this part of the usual depth do not count.
LEAST_DEPTH = 0.05
#: Directions that are seen worse than this, over the best one, stay as they are.
LEAST_SEEN = 1e-9
#: Where nothing is known of the place before: standard deviations of the log scale, of the turn, radians, and of the
#: shift as a share of the object's size. They hold where the images leave a direction open.
VAGUE = 0.1


@dataclass(frozen=True)
class _PoseTerms:
    """What measurements add to the normal equations of the poses of K views.

    Attributes
    ----------
    information : (6 K, 6 K).
    gradients : (c, 6 K) by independent groups of measurements, which add up to the right-hand side.
    sigma_px : standard deviation of a pixel coordinate.
    """

    information: Array
    gradients: Array
    sigma_px: float


@dataclass(frozen=True)
class KnownPlace:
    """Where an object is by what is no image of its surface.

    Attributes
    ----------
    place : world_from_object.
    covariance : (7, 7) of log scale, rotation vector and translation about the mean node, world; None if not known.
    """

    place: SimilarityTransform
    covariance: Array | None = None

    def information(self, size: float) -> Array:
        """Inverse covariance (7, 7) of log scale, turn, and shift, metres, of an object of this size, in its frame."""
        vague = np.diag([VAGUE**-2] * 4 + [(VAGUE * size) ** -2] * 3)
        if self.covariance is None or not self.covariance.any():
            return vague
        back = self.place.rotation.T
        chain = np.asarray(block_diag(1.0, back, back / self.place.scale), dtype=np.float64)
        return np.asarray(np.linalg.inv(chain @ self.covariance @ chain.T), dtype=np.float64) + vague


def common_motion(poses: Sequence[RigidTransform], centre: Array) -> Array:
    """How poses' increments (6 K, 7) go with log scale, turn and shift, metres, of the object against all cameras.

    Turn and shift are about the ``centre``, in the object's frame.
    """
    own = SimilarityTransform.identity()
    return np.concatenate([similarity_jacobian(pose, own, centre) for pose in poses])


class _PriorTerms:
    """How exactly the place before tells what all poses have in common.

    Parameters
    ----------
    known : the place before.
    centre : (3,) mean node of the object.
    size : of the object, metres.
    """

    def __init__(self, known: KnownPlace, centre: Array, size: float) -> None:
        self._centre, self._root = centre, np.linalg.cholesky(known.information(size)).T

    def factor(self, poses: Sequence[RigidTransform], motion: Array) -> Array:
        """Factor F (7, 6 K) of the information F' F about the poses, whose `common_motion` (6 K, 7) is ``motion``."""
        metric = np.asarray(block_diag(*(sight_metric(pose, self._centre) for pose in poses)), dtype=np.float64)
        return np.asarray(self._root @ np.linalg.pinv(metric @ motion) @ metric, dtype=np.float64)


class _StaticPoints:
    """Points of the map that at least two of the views saw, free in the object's frame.

    What their pixels say about the poses when every point may be where it fits best is the Schur complement of
    the points (Triggs et al., Bundle Adjustment - A Modern Synthesis, 2000, section 6).

    Parameters
    ----------
    positions : (n, 3) of all points, object frame, metres.
    views : with ``point_ids`` among these.
    camera : of the views, without distortion.
    """

    def __init__(self, positions: Array, views: Sequence[View], camera: Camera) -> None:
        self._camera = camera
        counts = np.bincount(np.concatenate([view.point_ids for view in views]), minlength=len(positions))
        chosen = np.argsort(-counts, kind="stable")[:MOST_STATIC]
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

    def linearise(self, poses: Sequence[RigidTransform]) -> _PoseTerms:
        """Moves the points to where they fit these poses best, and says where the poses should go."""
        for _ in range(POINT_ITERATIONS):
            residuals, by_point, _ = self._residuals(poses)
            weights, _ = self._weights(residuals)
            blocks, right = self._point_system(residuals, by_point, weights)
            self._positions = self._positions + np.linalg.solve(blocks, right[:, :, None])[:, :, 0]
        residuals, by_point, by_pose = self._residuals(poses)
        weights, sigma = self._weights(residuals)
        weights = weights / max(sigma, LEAST_STATIC_PX) ** 2
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
        return _PoseTerms(information, gradient.reshape(n, 6 * k) - (cross @ away)[:, :, 0], sigma)

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


class KeyframeAdjustment:
    """Adjusts the keyframes of a map about an object.

    Parameters
    ----------
    nodes : (n, 3) of the undeformed mesh, metres.
    triangles : (m, 3) node indices.
    camera : of the views, without distortion.
    points : of the map.
    views : keyframes of the map.
    axis : about which the object may be turned without a difference; None if there is none.
    """

    def __init__(
        self,
        nodes: Array,
        triangles: NDArray[np.int64],
        camera: Camera,
        points: MapPoints,
        views: Sequence[View],
        axis: Axis | None,
    ) -> None:
        self._nodes, self._camera, self._points, self._all_views = nodes, camera, points, views
        self._comparison, self._axis = TextureComparison(nodes, triangles, camera), axis
        self._size = float(np.linalg.norm(np.ptp(nodes, axis=0)))

    def adjust(self, placed: SimilarityTransform, known: KnownPlace | None = None) -> AdjustedKeyframes | None:
        """Poses near those of a registration; None where too little can be compared.

        Parameters
        ----------
        placed : world_from_object to begin at.
        known : how exactly the place is known by what is no image of the surface; None where it hardly is.
        """
        views = views_of(self._nodes, placed, self._all_views, self._camera, MOST_VIEWS)
        if len(views) < 2:
            return None
        poses = [camera_from_object(view, placed) for view in views]
        static = _StaticPoints(placed.inverse.apply(self._points.positions), views, self._camera)
        before = _PriorTerms(known or KnownPlace(placed), self._nodes.mean(axis=0), self._size)
        images, units = [view.normalized for view in views], self._units(len(views))
        mixing = _Mixing()
        for _ in range(ITERATIONS):
            measured = self._comparison.measure(images, poses)
            if sum(len(pair.offsets) for pair in measured) < FEWEST * len(views):
                return None
            on_mesh, beside = self._mesh_terms(measured, poses), static.linearise(poses)
            step, covariance = self._solved(on_mesh, beside, before, poses)
            step = units * mixing.mixed(step / units)
            poses = [moved_pose(pose, part) for pose, part in zip(poses, step.reshape(-1, 6), strict=True)]
        return AdjustedKeyframes(views, poses, covariance, on_mesh.sigma_px)

    def _mesh_terms(self, measured: list[PairDisplacements], poses: list[RigidTransform]) -> _PoseTerms:
        """What the displacements on the mesh say, by patches of the surface as large as a window."""
        offsets = np.concatenate([pair.offsets for pair in measured])
        places = np.concatenate([pair.places for pair in measured])
        views = np.concatenate([np.full(len(pair.offsets), pair.first) for pair in measured])
        weights, sigma = huber_weights(offsets)
        patch = WINDOW * self._pixel_size(poses)
        cells = np.floor((places - places.min(axis=0)) / patch).astype(np.int64)
        _, cell = np.unique(cells, axis=0, return_inverse=True)
        cell = cell.ravel()
        # Windows overlap, and each is compared with many others: as many of the measurements are independent
        # as there are windows beside each other in all views.
        independent = len(np.unique(np.column_stack([views, cell]), axis=0)) / len(offsets)
        weights = weights * independent / sigma**2
        n = len(poses)
        information, gradients = np.zeros((6 * n, 6 * n)), np.zeros((cell.max() + 1, n, 6))
        row = 0
        for pair in measured:
            rows = slice(row, row + len(pair.offsets))
            row = rows.stop
            slopes = {pair.first: pair.by_first, pair.second: pair.by_second}
            for i, by_i in slopes.items():
                weighted = by_i * weights[rows, None, None]
                np.add.at(gradients[:, i], cell[rows], np.einsum("pij,pi->pj", weighted, pair.offsets))
                for j, by_j in slopes.items():
                    block = np.einsum("pij,pik->jk", weighted, by_j)
                    information[6 * i : 6 * i + 6, 6 * j : 6 * j + 6] += block
        return _PoseTerms(information, gradients.reshape(-1, 6 * n), sigma)

    def _pixel_size(self, poses: list[RigidTransform]) -> float:
        """What a pixel covers on the object, metres."""
        middle = self._nodes.mean(axis=0)
        depth = float(np.median([pose.apply(middle)[2] for pose in poses]))
        return depth / max(self._camera.fx, self._camera.fy)

    def _solved(
        self, on_mesh: _PoseTerms, beside: _PoseTerms, before: _PriorTerms, poses: list[RigidTransform]
    ) -> tuple[Array, Array]:
        """The step (6 K,) of all poses, and their covariance (6 K, 6 K).

        What keeps the blocks of free points invertible holds the step where images leave it open. It is no information,
        so the covariance has the place before in its stead.
        """
        units, turn = self._units(len(poses)), self._turn(poses)
        of_mesh, static = (terms.information * np.outer(units, units) for terms in (on_mesh, beside))
        mesh_gradients, gradients = on_mesh.gradients * units, beside.gradients * units
        step = _inverse(of_mesh + static, turn / units) @ (mesh_gradients.sum(axis=0) + gradients.sum(axis=0))
        motion = common_motion(poses, self._nodes.mean(axis=0))
        basis = np.linalg.qr(motion / units[:, None])[0]
        rest = np.eye(len(units)) - basis @ basis.T
        of_prior = before.factor(poses, motion) * units
        inverse = _inverse(of_mesh + rest @ static @ rest + of_prior.T @ of_prior, turn / units)
        half = np.concatenate([np.sqrt(ACROSS_PATCHES) * mesh_gradients, gradients @ rest]) @ inverse
        prior_half = of_prior @ inverse
        covariance = IN_COMMON * half.T @ half + prior_half.T @ prior_half
        return step * units, covariance * np.outer(units, units)

    def _units(self, count: int) -> Array:
        """What makes the increments (6 K,) of poses comparable."""
        return np.tile([1.0] * 3 + [self._size] * 3, count)

    def _turn(self, poses: list[RigidTransform]) -> Array:
        """The increments (6 K,) that turn the object about its axis of revolution; zero without one."""
        if self._axis is None:
            return np.zeros(6 * len(poses))
        parts = []
        for pose in poses:
            turn = pose.rotation @ self._axis.direction
            parts.append(np.concatenate([turn, np.cross(turn, pose.translation - pose.apply(self._axis.point))]))
        return np.concatenate(parts)


class _Mixing:
    """Steps of a fixed-point iteration mixed with the last ones (Anderson 1965, with a memory of one).

    A window is as wide as a fold of an object, so its displacement is not quite that of its centre, and plain
    steps take up only a part of what is left in the directions that are seen worst.
    """

    def __init__(self) -> None:
        self._plain: Array | None = None
        self._taken: Array | None = None

    def mixed(self, step: Array) -> Array:
        """The step (u,) to take instead of the plain one."""
        taken = step
        if self._plain is not None and self._taken is not None:
            change = step - self._plain
            share = float(np.clip(step @ change / max(change @ change, 1e-300), -MOST_EXTRAPOLATED, 1.0))
            taken = step - share * (self._taken + change)
        self._plain, self._taken = step, taken
        return taken


def _inverse(information: Array, fixed: Array) -> Array:
    """Inverse of an information matrix (u, u) in which the direction ``fixed`` (u,), if not zero, stays."""
    length = float(np.linalg.norm(fixed))
    direction = fixed / length if length > 0.0 else fixed
    keep = np.eye(len(fixed)) - np.outer(direction, direction)
    values, vectors = np.linalg.eigh(keep @ information @ keep)
    inverse = (vectors / np.maximum(values, LEAST_SEEN * values[-1])) @ vectors.T
    return keep @ inverse @ keep
