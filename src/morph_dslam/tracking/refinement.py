"""Refinement of the reference state over a sequence (like the paper's parameters that are one per sequence).

The landmarks of one view fix the reference state only to a few millimetres along the sight line, and every
followed point is bound to the mesh by it. Other frames tell more: a wrong reference state binds the points
wrongly, and no state of another frame then explains all of them. So the residuals of what the registration rests on and
those of keyframes, each at its own best state (variable projection), are minimised over the reference state.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import OptimizeResult, approx_fprime, least_squares

from morph_dslam.model import ReducedModel
from morph_dslam.tracking.binding import bind_pixels, view_of
from morph_dslam.tracking.depth import SCALE_STD, PointDepths
from morph_dslam.tracking.depth_scale import LARGER, SMALLER, STEP
from morph_dslam.tracking.estimator import BoundPoints, Estimator, State, moved
from morph_dslam.tracking.known_state import LandmarkTerm, StateTerm
from morph_dslam.tracking.noise import Observations
from morph_dslam.tracking.outline import OutlineMeasurement
from morph_dslam.tracking.reprojection import huber_weights

Array = NDArray[np.float64]
#: Step of scaled unknowns that derivatives are differences over, on the way to a minimum and for its covariance.
DIFFERENCE, WIDE = 1e-2, 0.3
#: Scale of a parameter of the reference state, as a share of half its range.
SHARE_OF_RANGE = 0.05


@dataclass(frozen=True)
class Keyframe:
    """Where the points of the reference view were seen in another frame.

    Attributes
    ----------
    pixels : (p, 2)
    weights : (p,), 0 for points that were not seen
    state : estimated there.
    sigma_px : robust standard deviation of the residuals in it.
    outline : where the outline was seen, if it was looked for: it ties the texture to the object's edges.
    recorded : (p, 2) where a rolling shutter shows what is at ``pixels`` at the middle row's instant; None if the same.
    depths : (p,) of the points, where a depth camera saw them; None without one.
    """

    pixels: Array
    weights: Array
    state: State
    sigma_px: float
    outline: OutlineMeasurement | None = None
    recorded: Array | None = None
    depths: PointDepths | None = None

    def measured(self, points: BoundPoints, met: NDArray[np.bool_]) -> Observations:
        """The pixels of ``points`` (those of the reference view that ``met``) and of the outline."""
        pixels, weights = self.pixels[met], self.weights[met].astype(np.float64)
        normals, seen = np.zeros_like(pixels), self.outline
        if seen is not None:
            points = points.joined(seen.points)
            pixels, normals = np.concatenate([pixels, seen.pixels]), np.concatenate([normals, seen.normals])
            weights = np.concatenate([weights, seen.weights])
        return Observations(points, pixels, weights, normals)


#: How many independent points a keyframe counts for: its residuals are mostly the model's, which are alike
#: over wide parts of the surface.
EFFECTIVE_POINTS = 30.0
#: Residuals smaller than this, pixels, say no more.
LEAST_SIGMA_PX = 0.3
#: Keyframes used, spread over the sequence.
N_KEYFRAMES = 25
#: Standard deviation of a landmark, pixels, where the registration does not say it, and the least that is believed.
LANDMARK_PX, LEAST_LANDMARK_PX = 0.5, 0.1


def landmark_deviation(fitted_px: float) -> float:
    """Standard deviation of a landmark, pixels: how well they fit shows it, where they are enough."""
    return max(fitted_px, LEAST_LANDMARK_PX) if np.isfinite(fitted_px) else LANDMARK_PX


def relied_on(seen: Sequence[tuple[int, Keyframe]], mistaken: Collection[int], end: float) -> list[Keyframe]:
    """Keyframes, of the frames ``seen`` by number, that count for what is the same in the whole sequence.

    Those from frame ``end`` on do not, in which the surface is open, nor the ``mistaken`` ones, whose results are not
    to be relied on: no pose explains them. Without others the latter have to do.
    """
    known = [(frame, keyframe) for frame, keyframe in seen if frame < end]
    return [keyframe for frame, keyframe in known if frame not in mistaken] or [keyframe for _, keyframe in known]


def choose_keyframes(keyframes: Sequence[Keyframe], count: int = N_KEYFRAMES) -> list[Keyframe]:
    """At most ``count`` of them, evenly spread over the sequence."""
    rows = np.unique(np.linspace(0, len(keyframes) - 1, count).round().astype(int))
    return [keyframes[row] for row in rows] if len(keyframes) else []


def reference_scale(model: ReducedModel) -> Array:
    """Scale (d + 6,) of the unknowns of a reference state: parameters and pose, SI."""
    return np.concatenate([SHARE_OF_RANGE * 0.5 * (model.upper - model.lower), np.full(3, 0.01), np.full(3, 0.005)])


def refine_reference(
    estimator: Estimator,
    known: LandmarkTerm | StateTerm,
    reference_pixels: Array,
    start: State,
    keyframes: Sequence[Keyframe],
    depth_scale_std: float = SCALE_STD,
) -> tuple[State, Array]:
    """The reference state that explains the registration and the keyframes best, in which no unknown loads act.

    Parameters
    ----------
    known : what the registration rests on.
    reference_pixels : (p, 2) of the followed points in the reference view.
    start : the registered state.
    keyframes : where these points were seen in other frames.
    depth_scale_std : standard deviation of what all depths are off by together, a share.

    Returns
    -------
    state : parameters and pose.
    covariance : (d + 6, d + 6) of it.
    """
    model, camera = estimator.model, estimator.camera
    inner = Estimator(model, camera, replace(estimator.options, max_iterations=8, tolerance=1e-5))
    inner.loads = estimator.loads
    d = len(model.parameters)
    scale = reference_scale(model)
    free = np.r_[: d - model.n_loads, d : d + 6]

    def reference(step: Array) -> State:
        whole = np.zeros(d + 6)
        whole[free] = step
        state = moved(start, whole * scale)
        return replace(state, parameters=np.clip(state.parameters, model.lower, model.upper))

    def residuals(step: Array) -> Array:
        state = reference(step)
        parts = [known.residuals(camera, state)]
        surface, met = bind_pixels(model, camera, view_of(model, camera, state), reference_pixels)
        points = BoundPoints.from_surface(model, surface)
        for frame in keyframes:
            parts.append(_frame_residuals(inner, points, met, frame))
        return np.concatenate(parts)

    bounds = np.full((2, d + 6), np.inf) * [[-1.0], [1.0]]
    bounds[0, :d] = (model.lower - start.parameters) / scale[:d] - 1e-6
    bounds[1, :d] = (model.upper - start.parameters) / scale[:d] + 1e-6
    found = minimum(residuals, np.zeros(len(free)), (bounds[0, free], bounds[1, free]), 10)
    n_known, n_points = len(known.residuals(camera, start)), len(reference_pixels)
    jacobian = _derivatives(residuals, found.x, n_known)
    rows = np.split(jacobian[n_known:], np.cumsum(_sizes(keyframes, n_points))[:-1]) if keyframes else []
    covariance, refined = np.zeros((d + 6, d + 6)), reference(found.x)
    # All depths may be off by one factor; what no depth enters does not move with it.
    larger, smaller = (known.scaled(factor).residuals(camera, refined) for factor in (LARGER, SMALLER))
    by_scale = depth_scale_std * ((larger - smaller) / (2.0 * STEP))
    covariance[np.ix_(free, free)] = _covariance(jacobian[:n_known], rows, 2 * n_points, by_scale)
    return refined, covariance * np.outer(scale, scale)


def _derivatives(residuals: Callable[[Array], Array], at: Array, n_known: int) -> Array:
    """Derivatives (r, k) at some unknowns (k,), zero of points that do not meet the surface a step beside it.

    The residual of such a point is zero: its jump over a short step is no derivative.

    Parameters
    ----------
    n_known : the first residuals, which are of no such points.
    """
    steps = WIDE * np.eye(len(at))
    ahead, behind = (np.array([residuals(at + sign * step) for step in steps]) for sign in (1.0, -1.0))
    met = (ahead != 0.0).all(axis=0) & (behind != 0.0).all(axis=0)
    met[:n_known] = True
    return np.asarray(np.where(met, (ahead - behind) / (2.0 * WIDE), 0.0).T)


def _sizes(keyframes: Sequence[Keyframe], n_points: int) -> list[int]:
    """How many residuals each keyframe has, those of the points first."""
    return [2 * (n_points + (0 if frame.outline is None else len(frame.outline.pixels))) for frame in keyframes]


def _covariance(known: Array, keyframes: Sequence[Array], n_points: int, by_scale: Array) -> Array:
    """That of the minimum (k, k) by derivatives of the residuals by its k unknowns.

    A point errs alike in all keyframes: its place was read off the reference view once, and the model is off in the
    same way. So many keyframes do not average that out.

    Parameters
    ----------
    known : (n, k) of what the registration rests on.
    keyframes : (m, k) of each, those of ``n_points`` numbers of the reference view first.
    by_scale : (n,) by which the scale of all depths, of one standard deviation, moves the residuals of ``known``.
    """
    lasting = np.sum([rows[:n_points] for rows in keyframes], axis=0) if keyframes else known[:0]
    independent = [known, *(rows[n_points:] for rows in keyframes)]
    pushed = known.T @ by_scale
    spread = np.outer(pushed, pushed) + lasting.T @ lasting + np.sum([rows.T @ rows for rows in independent], axis=0)
    inverse = np.linalg.pinv(known.T @ known + np.sum([rows.T @ rows for rows in keyframes], axis=0))
    return np.asarray(inverse @ spread @ inverse)


def minimum(
    residuals: Callable[[Array], Array], start: Array, bounds: tuple[Array, Array], steps: int
) -> OptimizeResult:
    """The unknowns, scaled, of the least squares of residuals that are minima over other unknowns themselves.

    Such residuals are known as well as those minima are found, so derivatives are differences over `DIFFERENCE`; the
    steps that SciPy takes by itself are shares of the unknowns, and vanish where these are zero.
    """

    derivatives: Any = partial(differences, residuals, bounds=bounds)  # SciPy's types know names of methods only
    return least_squares(residuals, start, derivatives, bounds, max_nfev=steps, ftol=1e-4)


def differences(residuals: Callable[[Array], Array], at: Array, bounds: tuple[Array, Array]) -> Array:
    """Derivatives (r, k) at some unknowns (k,) by differences over `DIFFERENCE`, to where it is within the bounds."""
    return np.asarray(approx_fprime(at, residuals, np.where(at + DIFFERENCE > bounds[1], -DIFFERENCE, DIFFERENCE)))


def _frame_residuals(inner: Estimator, points: BoundPoints, met: NDArray[np.bool_], frame: Keyframe) -> Array:
    """Scaled residuals of a keyframe at its best state, with Huber weights; 0 for points unused."""
    measured = frame.measured(points, met)
    estimate, weights = inner.fit(measured, frame.state), measured.weights
    huber = huber_weights(np.linalg.norm(estimate.residuals, axis=1), inner.options.huber_px)
    sigma = max(frame.sigma_px, LEAST_SIGMA_PX)
    share = np.sqrt(EFFECTIVE_POINTS / max(weights.sum(), 1.0)) / sigma
    found = (share * np.sqrt(weights * huber))[:, None] * np.nan_to_num(estimate.residuals)
    scaled = np.zeros((len(met) + len(found) - int(met.sum()), 2))
    scaled[: len(met)][met], scaled[len(met) :] = found[: met.sum()], found[met.sum() :]
    return scaled.ravel()
