"""Parameters that are one over the whole sequence, and how sure an estimate is.

What a point's measurement is off by has two parts. One belongs to the point: its place was read off the
reference view once, and every frame is compared with that view. It is the same in all frames, and alike for
points whose windows overlap there. The other is new in every frame. Only the second averages out.

The filter keeps the estimate of the parameters that are one per sequence, from all frames so far, with its
covariance; in the next frame it is a prior, as in any Kalman filter in the information form. Beside it goes,
for every point, how its own error has entered the estimate. So the covariance holds the points' errors in
full, however many frames there are: they are "considered" but not estimated, as in Schmidt's filter
(Jazwinski, Stochastic Processes and Filtering Theory, 1970, ch. 8.4).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from morph_dslam.online.estimation import BoundPoints, Estimate, Estimator, Prior, State
from morph_dslam.online.reprojection import project_with_jacobian
from morph_dslam.online.robust_covariance import EIGENVALUE_FLOOR

Array = NDArray[np.float64]

#: The weight of the past in the mean of past and frame stays below this.
LARGEST_WEIGHT = 0.999


@dataclass(frozen=True)
class FilterOptions:
    """How the filter trusts the past.

    Attributes
    ----------
    memory : frames over which the past fades, by a factor e.
    gate : a frame whose own estimate is so many standard deviations off the past's does not take part.
    patience : after so many such frames in a row the past was wrong and is forgotten.
    """

    memory: float = 600.0
    gate: float = 5.0
    patience: int = 3


@dataclass(frozen=True)
class Measured:
    """What an estimate was made from, in one frame.

    Attributes
    ----------
    points : p of them. pixels : (p, 2) as measured. weights : (p,).
    normals : (p, 2), zero for points that count in both directions; see `reprojection.linearise`.
    correlation : (p, p) of the errors of the points' measurements.
    """

    points: BoundPoints
    pixels: Array
    weights: Array
    normals: Array
    correlation: Array


def window_correlation(pixels: Array, window: int) -> Array:
    """Correlation (p, p) of measurements at ``pixels`` (p, 2): the share of their windows that is the same.

    ``window`` is the side of the square that is compared, in pixels.
    """
    overlap = np.ones((len(pixels), len(pixels)))
    for column in pixels.T:
        overlap *= np.maximum(0.0, 1.0 - np.abs(column[:, None] - column[None]) / window)
    return overlap


class SequenceFilter:
    """Fuses the estimates of the frames of one sequence.

    Parameters
    ----------
    indices : of the parameters that are one per sequence; none is allowed, and only covariances are found.
    """

    def __init__(
        self, estimator: Estimator, indices: Sequence[int], options: FilterOptions | None = None
    ) -> None:
        self.options = options or FilterOptions()
        self._estimator, self._kept = estimator, np.array(indices, dtype=np.int64)
        self._unknowns = len(estimator.model.parameters) + 6
        self._noise = _Noise(self.options.memory)
        self._past: _Past | None = None
        self._conflicts = 0

    def fuse(self, measured: Measured, alone: Estimate) -> Estimate:
        """The estimate of a frame from its measurements and all frames before, with its covariance.

        Parameters
        ----------
        alone : the estimate from the frame's measurements only.
        """
        self._noise.add(alone.residuals, measured, self._unknowns)
        linear = self._linear(measured, alone)
        errors = self._errors(measured, linear)
        by_itself = replace(alone, covariance=errors.covariance)
        if not len(self._kept):
            return by_itself
        if self._past is not None and self._contradicts(self._past, by_itself):
            self._conflicts += 1
            if self._conflicts < self.options.patience:
                return by_itself
            self._past = None
        self._conflicts = 0
        if self._past is None:
            self._keep(by_itself, errors)
            return by_itself
        prior = self._prior(self._past, measured, errors, linear)
        fused = self._estimator.estimate(
            measured.points,
            measured.pixels,
            measured.weights,
            self._start(by_itself),
            measured.normals,
            prior,
        )
        errors = self._errors(measured, self._linear(measured, fused), prior)
        fused = replace(fused, covariance=errors.covariance)
        self._keep(fused, errors)
        return fused

    def _of_kept(self, matrix: Array) -> Array:
        return matrix[np.ix_(self._kept, self._kept)]

    def _keep(self, estimate: Estimate, errors: _Errors) -> None:
        """Make the estimate's parameters that are one per sequence the past of the next frame."""
        grown = np.exp(1.0 / self.options.memory)
        self._past = _Past(
            estimate.state.parameters[self._kept],
            grown * self._of_kept(errors.covariance),
            np.sqrt(grown) * errors.by_point[:, :, self._kept],
            grown * self._of_kept(errors.by_frames),
        )

    def _start(self, alone: Estimate) -> State:
        """Where to look for the fused state: the frame's, with what the past is surer of."""
        assert self._past is not None
        parameters = alone.state.parameters.copy()
        surer = np.diag(self._past.covariance) < np.diag(alone.covariance)[self._kept]
        parameters[self._kept[surer]] = self._past.mean[surer]
        return replace(alone.state, parameters=parameters)

    def _prior(self, past: _Past, measured: Measured, errors: _Errors, linear: _Linear) -> Prior:
        """The past as a term of the frame's cost, of the weight that makes the variance of both least.

        In the basis in which the frame's covariance is 1 and the past's p, with the covariance c of both, the
        weight of the past is (1 - c) / (1 + p - 2 c).
        """
        d, own = self._unknowns - 6, self._of_kept(errors.covariance)
        squared_px = np.trace(np.linalg.solve(self._of_kept(linear.inverse), own)) / len(self._kept)
        p, basis = scipy.linalg.eigh(past.covariance, own)
        shared = _quadratic(past.by_point, measured.correlation, errors.by_point[:, :, self._kept])
        c = np.einsum("ik,ij,jk->k", basis, shared, basis)
        weight = np.clip((1.0 - c) / np.maximum(1.0 + p - 2.0 * c, 1e-12), 0.0, LARGEST_WEIGHT)
        root = basis * np.sqrt(squared_px * weight / (1.0 - weight))
        mean, information = np.zeros(d), np.zeros((d, d))
        mean[self._kept] = past.mean
        information[np.ix_(self._kept, self._kept)] = root @ root.T
        return Prior(mean, information)

    def _contradicts(self, past: _Past, estimate: Estimate) -> bool:
        """Whether a frame by itself says something else than all those before."""
        apart = estimate.state.parameters[self._kept] - past.mean
        spread = self._of_kept(estimate.covariance) + past.covariance
        return float(apart @ np.linalg.solve(spread, apart)) > self.options.gate**2

    def _linear(self, measured: Measured, estimate: Estimate) -> _Linear:
        """The cost about an estimate."""
        state, points = estimate.state, measured.points
        pose = state.camera_from_object
        _, jacobian = project_with_jacobian(
            points.field.functions.rows(state.parameters), pose.rotation, pose.translation, points.rest,
            points.field.modes, self._estimator.camera.intrinsics,
        )  # fmt: skip
        directed = (measured.normals != 0.0).any(axis=1)
        normals = measured.normals[directed]
        jacobian[directed] = (normals[:, :, None] * normals[:, None, :]) @ jacobian[directed]
        length = np.linalg.norm(estimate.residuals, axis=1)
        used = (measured.weights > 0.0) & np.isfinite(length)
        jacobian[~used] = 0.0
        huber = self._estimator.options.huber_px
        factor = np.minimum(1.0, huber / np.maximum(np.where(used, length, 0.0), 1e-300))
        scores = (measured.weights * factor)[:, None, None] * jacobian
        return _Linear(scores, np.tensordot(scores, jacobian, axes=([0, 1], [0, 1])), self._estimator.scale)

    def _errors(self, measured: Measured, linear: _Linear, prior: Prior | None = None) -> _Errors:
        """How the measurements' errors, and those of the past if there is a prior, enter the estimate."""
        d, kept = self._unknowns - 6, self._kept
        common, frame = self._noise.common, self._noise.frame
        by_point = np.sqrt(common) * linear.scores
        by_frames = frame * _quadratic(linear.scores, measured.correlation)
        if prior is not None and self._past is not None:
            hessian = linear.hessian.copy()
            hessian[:d, :d] += prior.information
            linear = replace(linear, hessian=hessian)
            weight = self._of_kept(prior.information)
            by_point[:, :, kept] += self._past.by_point @ weight
            by_frames[np.ix_(kept, kept)] += weight @ self._past.by_frames @ weight
        inverse = linear.inverse
        by_point, by_frames = by_point @ inverse, inverse @ by_frames @ inverse
        unseen = (common + frame) * linear.unseen
        return _Errors(by_point, by_frames, _quadratic(by_point, measured.correlation) + by_frames + unseen)


@dataclass(frozen=True)
class _Past:
    """What the frames so far said of the k parameters that are one per sequence.

    Attributes
    ----------
    mean : (k,), SI. covariance : (k, k). by_point, by_frames : as in `_Errors`, (p, 2, k) and (k, k).
    """

    mean: Array
    covariance: Array
    by_point: Array
    by_frames: Array


@dataclass(frozen=True)
class _Linear:
    """A cost about its minimum.

    Attributes
    ----------
    scores : (p, 2, n) by which an error of a pixel enters the gradient. hessian : (n, n). scale : (n,) of
        the unknowns.
    """

    scores: Array
    hessian: Array
    scale: Array

    @cached_property
    def _spectrum(self) -> tuple[Array, Array, float]:
        """Eigenvalues and eigenvectors in scaled unknowns, and the least value that counts."""
        values, vectors = np.linalg.eigh(self.hessian * np.outer(self.scale, self.scale))
        return values, self.scale[:, None] * vectors, max(values[-1], 1e-30) * EIGENVALUE_FLOOR

    @cached_property
    def inverse(self) -> Array:
        """H^-1 (n, n); what is not seen at all gets the inverse of the least value."""
        values, vectors, floor = self._spectrum
        return (vectors / np.maximum(values, floor)) @ vectors.T

    @property
    def unseen(self) -> Array:
        """The part (n, n) of `inverse` that is not seen at all."""
        values, vectors, floor = self._spectrum
        return (vectors * np.where(values > floor, 0.0, 1.0 / floor)) @ vectors.T


@dataclass(frozen=True)
class _Errors:
    """How errors of pixels enter an estimate.

    Attributes
    ----------
    by_point : (p, 2, n) derivative by the part that stays with a point, in its standard deviations.
    by_frames : (n, n) covariance from what is new in each frame. covariance : (n, n) from both.
    """

    by_point: Array
    by_frames: Array
    covariance: Array


class _Noise:
    """The variance of a pixel coordinate: its part that stays with the point, and its part in one frame."""

    def __init__(self, memory: float) -> None:
        self._fade, self._count, self._product = np.exp(-1.0 / memory), 0.0, 0.0
        self._before: Array | None = None
        self.common, self.frame = 0.0, 0.0

    def add(self, residuals: Array, measured: Measured, unknowns: int) -> None:
        """Learn from the residuals (p, 2) of a frame; those of the frame before tell what stays."""
        used = (measured.weights > 0.0) & np.isfinite(residuals).all(axis=1)
        numbers = np.where((measured.normals[used] != 0.0).any(axis=1), 1, 2).sum()
        residuals = np.where(used[:, None], residuals, np.nan)
        total = np.nansum(measured.weights[:, None] * residuals**2) / max(numbers - unknowns, 1)
        if self._before is not None:
            products = residuals * self._before
            pairs = np.isfinite(products)
            self._count = self._fade * self._count + pairs.sum()
            self._product = self._fade * self._product + np.nansum(products)
        self._before = residuals
        # As long as there is nothing to compare with, all of it is taken to stay.
        stays = self._product / self._count if self._count else np.inf
        self.common = float(np.clip(stays, 0.0, total))
        self.frame = float(total - self.common)


def _quadratic(scores: Array, correlation: Array, others: Array | None = None) -> Array:
    """sum_ij K_ij W_i' V_j (n, n) of scores (p, 2, n), twice the same or two, and correlation K (p, p)."""
    others = scores if others is None else others
    spread = (correlation @ others.reshape(len(others), -1)).reshape(others.shape)
    return np.tensordot(scores, spread, axes=([0, 1], [0, 1]))
