"""The discrepancy between model and object in one frame: what moves the points beyond the model's shape.

The state is estimated first, by the model alone. Then the smooth displacement is sought that explains what is
left of the residuals, is as small as a Gaussian process makes it (`morph_dslam.model.discrepancy`), and
stretches the surface as little as a given strain. It is found by Gauss-Newton steps on a quadratic of 3 m
numbers. Pose and parameters stay as they are: a rigid part of what is left counts with the discrepancy.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve
from scipy.spatial import KDTree

from morph_dslam.camera import Camera
from morph_dslam.model import ReducedModel, SurfacePoints
from morph_dslam.model.discrepancy import Discrepancy, DiscrepancyBasis, DiscrepancyDeviation, farthest_points
from morph_dslam.tracking.binding import bind_pixels, view_of
from morph_dslam.tracking.estimator import Estimator
from morph_dslam.tracking.noise import Observations
from morph_dslam.tracking.option_values import CheckedOptions, Positive, PositiveCount
from morph_dslam.tracking.refinement import Keyframe
from morph_dslam.tracking.state import BoundPoints, State

Array = NDArray[np.float64]
#: Each sample of the surface counts for so many independent strains of the lines to its neighbours.
STRAINS_A_SAMPLE = 0.2


@dataclass(frozen=True)
class DiscrepancyOptions(CheckedOptions):
    """What is taken for likely before any image is seen.

    Attributes
    ----------
    amplitude : standard deviation of the discrepancy, as a share of the object's diagonal.
    length : its correlation length, as a share of the diagonal.
    strain : standard deviation of the strain of the surface that it makes.
    centres : points at which it is given.
    samples, neighbours : points of the surface between which the strain is looked at, and lines from each.
    point_px, outline_px : standard deviation of a point's pixels, neighbours of which have much in common,
        and of the distance of the outline
    huber_px : residual where the cost turns linear.
    steps : Gauss-Newton steps in a frame; one will do from the discrepancy of the frame before.
    """

    amplitude: Positive = 0.02
    length: Positive = 0.2
    strain: Positive = 3e-3
    centres: PositiveCount = 30
    samples: PositiveCount = 100
    neighbours: PositiveCount = 6
    point_px: Positive = 0.5
    outline_px: Positive = 2.0
    huber_px: Positive = 1.5
    steps: PositiveCount = 2


@dataclass(frozen=True)
class _Quadratic:
    """The cost of a step of the centres' displacements (m, 3), its numbers component by component.

    Attributes
    ----------
    hessian : (3 m, 3 m)
    gradient : (3 m,).
    """

    hessian: Array
    gradient: Array

    def __add__(self, other: _Quadratic) -> _Quadratic:
        return _Quadratic(self.hessian + other.hessian, self.gradient + other.gradient)

    @classmethod
    def of_rows(cls, weights: Array, forces: Array, influence: Array) -> _Quadratic:
        """By the second derivatives (p, 3, 3) and the gradient (p, 3) by the displacements of p points.

        ``influence`` (p, m) is the centres' on them.
        """
        return cls(symmetric_gram(weights, influence), (influence.T @ forces).T.ravel())

    @classmethod
    def of_residuals(cls, rows: Array, residuals: Array, weights: Array, influence: Array) -> _Quadratic:
        """By residuals (p, k) with ``weights`` (p,) and their derivatives (p, k, 3) by p displacements."""
        return cls.of_rows(*_curvature(np.ascontiguousarray(rows), residuals, weights), influence)

    @cached_property
    def _factor(self) -> tuple[Array, bool]:
        """The Hessian's Cholesky factor, as `cho_solve` takes it."""
        return cho_factor(self.hessian)

    def minimum(self) -> Array:
        """The step (m, 3) that lowers the cost most."""
        return as_displacements(-cho_solve(self._factor, self.gradient))

    def inverse(self) -> Array:
        """Of the Hessian (3 m, 3 m)."""
        return np.asarray(cho_solve(self._factor, np.eye(len(self.gradient))), dtype=np.float64)


def as_displacements(numbers: Array) -> Array:
    """Centres' displacements (m, 3) from their numbers (3 m,), component by component."""
    return numbers.reshape(3, -1).T


def weighted_gram(weights: Array, influence: Array) -> Array:
    """Sums (3 m, 3 m) over p points of ``influence`` (p, m) times ``weights`` (p, 3, 3) times influence."""
    rows, count = influence.shape
    # One matrix product for all nine blocks.
    weighted = (weights[..., None] * influence[:, None, None]).reshape(rows, 9 * count)
    blocks = (influence.T @ weighted).reshape(count, 3, 3, count)
    return blocks.transpose(1, 0, 2, 3).reshape(3 * count, 3 * count)


#: The components of a symmetric 3 x 3 matrix.
PAIRS = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))


def symmetric_gram(weights: Array, influence: Array) -> Array:
    """`weighted_gram` of symmetric weights: six blocks in place of nine."""
    count, size = influence.shape[1], 3 * influence.shape[1]
    blocks = influence.T @ _weighted_influence(weights, influence)
    result = np.empty((size, size))
    for k, (a, b) in enumerate(PAIRS):
        block = blocks[:, k * count : (k + 1) * count]
        result[a * count : (a + 1) * count, b * count : (b + 1) * count] = block
        result[b * count : (b + 1) * count, a * count : (a + 1) * count] = block
    return result


@njit(cache=True, nogil=True)
def _weighted_influence(weights, influence):
    """Influence (p, m) times each of the `PAIRS` of ``weights`` (p, 3, 3), side by side: (p, 6 m)."""
    points, count = influence.shape
    found = np.empty((points, 6 * count))
    for j in range(points):
        for k, (a, b) in enumerate(PAIRS):
            line = found[j, k * count : (k + 1) * count]
            for i in range(count):
                line[i] = weights[j, a, b] * influence[j, i]
    return found


@njit(cache=True, nogil=True)
def _curvature(rows, residuals, weights):
    """J' W J (p, 3, 3) and J' W r (p, 3) of each point's rows J (p, k, 3), residuals r (p, k) and weight (p,)."""
    curvature, forces = np.zeros((len(rows), 3, 3)), np.zeros((len(rows), 3))
    for j in range(len(rows)):
        for k in range(rows.shape[1]):
            for a in range(3):
                slope = weights[j] * rows[j, k, a]
                forces[j, a] += slope * residuals[j, k]
                for b in range(3):
                    curvature[j, a, b] += slope * rows[j, k, b]
    return curvature, forces


@njit(cache=True, nogil=True)
def _seen(positions, intrinsics, pixels, normals, weights, huber, point_px, outline_px):
    """What `DiscrepancyFit.seen` returns, compiled."""
    count = len(positions)
    rows, residuals, counts = np.zeros((count, 2, 3)), np.zeros((count, 2)), np.zeros(count)
    for j in range(count):
        x, y, z = positions[j, 0], positions[j, 1], positions[j, 2]
        right = intrinsics[0] * x / z + intrinsics[2] - pixels[j, 0]
        down = intrinsics[1] * y / z + intrinsics[3] - pixels[j, 1]
        if not (weights[j] > 0.0 and z > 0.0 and np.isfinite(right + down)):
            continue
        across, along = (intrinsics[0] / z, -intrinsics[0] * x / z**2), (intrinsics[1] / z, -intrinsics[1] * y / z**2)
        n0, n1 = normals[j, 0], normals[j, 1]
        if n0 != 0.0 or n1 != 0.0:
            rows[j, 0, 0], rows[j, 0, 1], rows[j, 0, 2] = n0 * across[0], n1 * along[0], n0 * across[1] + n1 * along[1]
            residuals[j, 0] = n0 * right + n1 * down
            # The outline has a deviation of its own here, whatever the estimate counts it by.
            weight = 1.0 / outline_px**2
        else:
            rows[j, 0, 0], rows[j, 0, 2], rows[j, 1, 1], rows[j, 1, 2] = across[0], across[1], along[0], along[1]
            residuals[j, 0], residuals[j, 1] = right, down
            weight = weights[j] / point_px**2
        length = np.sqrt(residuals[j, 0] ** 2 + residuals[j, 1] ** 2)
        counts[j] = weight * min(1.0, huber / max(length, 1e-12))
    return rows, residuals, counts


@njit(cache=True, nogil=True)
def _strains(shape, rotation, lines, lengths, beyond, share):
    """Curvature (e, 3, 3) and forces (e, 3) by what lines (e, 2) between samples (s, 3) have beyond the model's.

    Parameters
    ----------
    shape : (s, 3) samples in the model's state, camera frame.
    rotation : (3, 3) of that state's pose.
    lengths : (e,) of the lines in the undeformed object.
    beyond : (e, 3) by which the discrepancy's displacements of their ends differ.
    share : the weight of a squared strain.
    """
    curvature, forces = np.empty((len(lines), 3, 3)), np.empty((len(lines), 3))
    line = np.empty(3)
    for e in range(len(lines)):
        first, second = shape[lines[e, 0]], shape[lines[e, 1]]
        before = np.sqrt((first[0] - second[0]) ** 2 + (first[1] - second[1]) ** 2 + (first[2] - second[2]) ** 2)
        for a in range(3):
            line[a] = beyond[e, a]
            for k in range(3):
                line[a] += (first[k] - second[k]) * rotation[k, a]
        now = np.sqrt(line[0] ** 2 + line[1] ** 2 + line[2] ** 2)
        strain = (now - before) / lengths[e]
        for a in range(3):
            slope = share * line[a] / (now * lengths[e])
            forces[e, a] = slope * strain
            for b in range(3):
                curvature[e, a, b] = slope * line[b] / (now * lengths[e])
    return curvature, forces


class DiscrepancyFit:
    """Finds the discrepancy of one object.

    Parameters
    ----------
    camera : of undistorted images.

    Attributes
    ----------
    basis : the centres on the model's surface.
    """

    def __init__(self, model: ReducedModel, camera: Camera, options: DiscrepancyOptions) -> None:
        self.camera, self.options = camera, options
        used, first = np.unique(model.triangles, return_index=True)
        nodes = model.nodes[used]
        diagonal = float(np.linalg.norm(np.ptp(nodes, axis=0)))
        self.basis = DiscrepancyBasis.spread_over(nodes, options.centres, options.length * diagonal)
        self._amplitude = options.amplitude * diagonal
        precision = self.basis.precision / self._amplitude**2
        self._precision: Array = np.kron(np.eye(3), precision).astype(np.float64)
        rows = farthest_points(nodes, options.samples)
        corners = first[rows]
        weights = np.eye(3)[corners % 3]
        self._samples = BoundPoints.from_surface(model, SurfacePoints(corners // 3, weights))
        self._surface = DiscrepancyBasis(np.ascontiguousarray(self._samples.rest), self.basis.length)
        self._lines = _neighbour_lines(self._samples.rest, options.neighbours)
        start, end = self._samples.rest[self._lines.T]
        self._lengths = np.linalg.norm(start - end, axis=1)
        influence = self.basis.influence_on(self._samples.rest)
        self._stretching = influence[self._lines[:, 0]] - influence[self._lines[:, 1]]
        self._known: tuple[Array, Array] | None = None

    def fit(self, measured: Observations, state: State, last: Discrepancy | None = None) -> Discrepancy:
        """The discrepancy of the frame that was measured, with the model in the estimated state.

        ``last`` is that of the frame before, to start from; None where it is not known.
        """
        influence = self._influence_on(measured.points.rest)
        values = np.zeros((len(self.basis.centres), 3)) if last is None else last.values
        positions, shape = measured.points.in_camera(state), self._samples.in_camera(state)
        rotation = state.camera_from_object.rotation
        for _ in range(self.options.steps if last is None else 1):
            there = positions + influence @ values @ rotation.T
            derivatives, residuals, weights = self.seen(measured, there)
            data = _Quadratic.of_residuals(derivatives @ rotation, residuals, weights, influence)
            cost = self.prior(shape, rotation, values) + data
            values = values + cost.minimum()
        deviation = DiscrepancyDeviation(cost.inverse(), self._amplitude, self._surface)
        return Discrepancy(self.basis, values, deviation)

    def _influence_on(self, rest: Array) -> Array:
        """The centres' influence (p, m) on points (p, 3), most of which are where they were in the last call."""
        if self._known is None or len(self._known[0]) != len(rest):
            self._known = rest, self.basis.influence_on(rest)
        else:
            last, influence = self._known
            moved = (rest != last).any(axis=1)
            influence = influence.copy()
            influence[moved] = self.basis.influence_on(rest[moved])
            self._known = rest, influence
        return self._known[1]

    def seen(self, measured: Observations, positions: Array) -> tuple[Array, Array, Array]:
        """Residuals at positions (p, 3) in the camera frame, with their derivatives and weights.

        Returns
        -------
        derivatives : (p, 2, 3) of pixels by the position, or of the distance from the outline and 0.
        residuals : (p, 2) pixels
        weights : (p,) inverse variances with Huber's factor.
        """
        options = self.options
        return _seen(
            positions, self.camera.intrinsics, measured.pixels, measured.normals, measured.weights,
            options.huber_px, options.point_px, options.outline_px,
        )  # fmt: skip

    def shape(self, state: State) -> Array:
        """The samples (s, 3) of the surface in the camera frame, in a state of the model, metres."""
        return self._samples.in_camera(state)

    def prior(self, shape: Array, rotation: Array, values: Array) -> _Quadratic:
        """The cost of the process and of the strain beyond the model's at ``values`` (m, 3).

        Parameters
        ----------
        shape : (s, 3) samples of the surface in the model's state, as `shape` has them.
        rotation : (3, 3) of that state's pose.
        """
        process = _Quadratic(self._precision, self._precision @ values.T.ravel())
        share = STRAINS_A_SAMPLE * len(shape) / len(self._lines) / self.options.strain**2
        beyond = self._stretching @ values
        terms = _strains(shape, rotation, self._lines, self._lengths, beyond, share)
        return process + _Quadratic.of_rows(*terms, self._stretching)


def _neighbour_lines(points: Array, count: int) -> NDArray[np.int64]:
    """Pairs (e, 2) of each point and its ``count`` nearest others, each pair once."""
    near = np.asarray(KDTree(points).query(points, min(count + 1, len(points)))[1])
    pairs = np.column_stack([np.repeat(near[:, 0], near.shape[1] - 1), near[:, 1:].ravel()])
    return np.unique(np.sort(pairs, axis=1), axis=0)


#: Gauss-Newton steps: after five the displacements change by less than a tenth of a millimetre.
STEPS = 5


@dataclass(frozen=True)
class Reference:
    """The reference view and what is known of it.

    Attributes
    ----------
    state : of the model in it
    pixels : (p, 2) of the followed points.
    landmarks, landmark_pixels : (k) points and where they are seen (k, 2), undistorted.
    landmark_px : their standard deviation.
    """

    state: State
    pixels: Array
    landmarks: BoundPoints
    landmark_pixels: Array
    landmark_px: float


def refine_discrepancy(
    fit: DiscrepancyFit, estimator: Estimator, reference: Reference, keyframes: Sequence[Keyframe]
) -> Discrepancy:
    """The discrepancy in the reference view that explains landmarks and keyframes best.

    Where the object departs from the model in the reference view, points are bound beside their places, and
    no shape of another frame explains all of them. So the discrepancies of the reference view and of the
    keyframes are sought together; those of the keyframes are eliminated by Schur complements.

    Parameters
    ----------
    fit : of the same model.
    """
    adjustment = _Adjustment(fit, estimator, reference, keyframes)
    for _ in range(STEPS):
        adjustment.step()
    return Discrepancy(fit.basis, adjustment.values)


@dataclass
class _Frame:
    """A keyframe.

    Attributes
    ----------
    measured : in it
    state : of the model
    positions : (p, 3) of the points and shape : (s, 3) of the samples of the surface in that state, camera
        frame.
    sliding : (p, 3, 3) how the points move as the reference's discrepancy slides them along the surface.
    influence : (p, m) of the centres on the points
    values : (m, 3) the discrepancy.
    """

    measured: Observations
    state: State
    positions: Array
    shape: Array
    sliding: Array
    influence: Array
    values: Array


class _Adjustment:
    def __init__(
        self, fit: DiscrepancyFit, estimator: Estimator, reference: Reference, keyframes: Sequence[Keyframe]
    ) -> None:
        self._fit, self._reference, self._estimator = fit, reference, estimator
        model, camera = estimator.model, estimator.camera
        surface, self._met = bind_pixels(model, camera, view_of(model, camera, reference.state), reference.pixels)
        self._points = BoundPoints.from_surface(model, surface)
        self.values = np.zeros((len(fit.basis.centres), 3))
        self._along = self._moves_along_surface()
        self._frames = [self._frame(keyframe) for keyframe in keyframes]

    def _moves_along_surface(self) -> Array:
        """By how much a displacement slides the points (p, 2, 3) along two edges of their triangles.

        They stay in their pixels: P (E b + R u) = 0 for projection P, edges E and displacement u.
        """
        state, camera = self._reference.state, self._estimator.camera
        projection = camera.projection_jacobian(self._points.in_camera(state))
        rotated = projection @ state.camera_from_object.rotation
        return np.asarray(-np.linalg.solve(projection @ self._edges(state), rotated), dtype=np.float64)

    def _edges(self, state: State) -> Array:
        """Two edges (p, 3, 2) of the points' triangles in the camera frame."""
        model = self._estimator.model
        nodes = view_of(model, self._estimator.camera, state).nodes
        corners = nodes[model.triangles[self._points.surface.triangles]]
        return np.stack([corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]], axis=2)

    def _frame(self, keyframe: Keyframe) -> _Frame:
        measured = keyframe.measured(self._points, self._met)
        points, state = measured.points, self._estimator.fit(measured, keyframe.state).state
        sliding = np.zeros((len(points), 3, 3))
        sliding[: len(self._points)] = self._edges(state) @ self._along
        influence, values = self._fit.basis.influence(points.rest), np.zeros_like(self.values)
        shape = self._fit.shape(state)
        return _Frame(measured, state, points.in_camera(state), shape, sliding, influence, values)

    def step(self) -> None:
        """One Gauss-Newton step of all discrepancies."""
        total, frames = self._of_reference(), []
        for frame in self._frames:
            own, shared, coupling = self._costs(frame)
            solved = cho_solve(cho_factor(own.hessian), np.column_stack([coupling, own.gradient]))
            schur = _Quadratic(coupling.T @ solved[:, :-1], coupling.T @ solved[:, -1])
            total = _Quadratic(
                total.hessian + shared.hessian - schur.hessian, total.gradient + shared.gradient - schur.gradient
            )
            frames.append(solved)
        step = -cho_solve(cho_factor(total.hessian), total.gradient)
        self.values = self.values + as_displacements(step)
        for frame, solved in zip(self._frames, frames, strict=True):
            frame.values = frame.values - as_displacements(solved[:, -1] + solved[:, :-1] @ step)

    def _of_reference(self) -> _Quadratic:
        """What is known of the reference view's discrepancy by itself: the prior and the landmarks."""
        state, known, camera = self._reference.state, self._reference, self._estimator.camera
        rotation = state.camera_from_object.rotation
        influence = self._fit.basis.influence(known.landmarks.rest)
        there = known.landmarks.in_camera(state) + influence @ self.values @ rotation.T
        landmarks = _Quadratic.of_residuals(
            camera.projection_jacobian(there) @ rotation,
            camera.project(there) - known.landmark_pixels,
            np.full(len(there), known.landmark_px**-2),
            influence,
        )
        return landmarks + self._fit.prior(self._fit.shape(state), rotation, self.values)

    def _costs(self, frame: _Frame) -> tuple[_Quadratic, _Quadratic, Array]:
        """A keyframe's cost by its own discrepancy and by the reference's, and the mixed derivatives."""
        rotation, influence = frame.state.camera_from_object.rotation, frame.influence
        slid = np.einsum("pxa,pa->px", frame.sliding, influence @ self.values)
        there = frame.positions + slid + influence @ frame.values @ rotation.T
        derivatives, residuals, weights = self._fit.seen(frame.measured, there)
        own, shared = derivatives @ rotation, derivatives @ frame.sliding
        prior = self._fit.prior(frame.shape, rotation, frame.values)
        coupling = weighted_gram(np.einsum("p,pka,pkb->pab", weights, own, shared), influence)
        by_own, by_shared = (_Quadratic.of_residuals(rows, residuals, weights, influence) for rows in (own, shared))
        return by_own + prior, by_shared, coupling
