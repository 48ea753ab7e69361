"""A registration by landmarks, corrected by the object's outline in the same frame.

Landmarks that people set are off by a pixel or two each, an outline of a hundred points only by a fraction of one. So
the outline is searched for where the landmarks have it, and pose and parameters are fitted to both. How exact the
outline is, and how many of its points count as one because they err alike, is seen from what the fit leaves of it
(`tracking.outline_weight`). Where too little of the outline is seen, or where it pulls the object off its landmarks, it
is not believed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import fdtrc

from morph_dslam.model import ReducedModel
from morph_dslam.registration.messages import OutlineContradicts, OutlineUnseen, RegistrationWarning
from morph_dslam.tracking.binding import DrawnSurface
from morph_dslam.tracking.estimator import BoundPoints, Estimate, Estimator, State
from morph_dslam.tracking.outline import Outline, OutlineMeasurement
from morph_dslam.tracking.outline_weight import LEAST_SPREAD_PX, OutlineBalance

Array = NDArray[np.float64]
#: How far, pixels, the outline is searched for in turn.
REACHES = (14, 10, 6, 4, 3, 3)
#: Share of the outline that must be seen where the result has it.
LEAST_SEEN = 0.5
#: Rise of the chi-squared that excludes a minimum: three standard deviations. Mean distance, as a share of the object's
#: size, by which states differ.
EXCLUDED, DISTINCT_SHARE = 9.0, 0.02
#: Chance by which landmarks of the size of error that they show fit so much worse beside the right outline.
LEAST_CHANCE = 1e-3


def mesh_in_camera(model: ReducedModel, state: State) -> Array:
    """The nodes (n, 3) of a model in a state, in the camera frame, metres."""
    return state.camera_from_object.apply(model.positions(state.parameters))


def are_distinct(model: ReducedModel, one: Array, other: Array) -> bool:
    """Whether the nodes (n, 3) of two states, in the camera frame, are so far apart that these are different ones."""
    size = float(np.linalg.norm(np.ptp(model.nodes, axis=0)))
    return float(np.linalg.norm(one - other, axis=1).mean()) > DISTINCT_SHARE * size


@dataclass(frozen=True)
class Snap:
    """A state that landmarks and outline have together.

    Attributes
    ----------
    estimate : the state, its covariance counts points of the outline that err alike as one.
    chi_squared : of landmarks and outline, in their standard deviations.
    landmarks_px : root mean square of the landmarks' residuals alone, and beside the outline.
    seen : share of the outline that was found where the state has it.
    chance : by which right landmarks fit so much worse beside the outline than alone.
    """

    estimate: Estimate
    chi_squared: float
    landmarks_px: tuple[float, float]
    seen: float
    chance: float


class OutlineSnap:
    """Fits landmarks and the outline around them in one image.

    Parameters
    ----------
    estimator : with the box that the parameters are in.
    landmarks : k of them, bound.
    pixels : (k, 2) of them, undistorted.
    sigma_px : standard deviation of a landmark's pixel coordinate, as they fit alone.
    grey : (h, w) undistorted image.
    """

    def __init__(
        self, estimator: Estimator, landmarks: BoundPoints, pixels: Array, sigma_px: float, grey: NDArray[np.uint8]
    ) -> None:
        self._estimator, self._landmarks, self._pixels = estimator, landmarks, pixels
        self._sigma, self._grey, self._surface = sigma_px, grey, DrawnSurface.of(estimator.model)

    def corrected(
        self, best: Estimate, alternatives: Sequence[State]
    ) -> tuple[Estimate, tuple[State, ...], tuple[RegistrationWarning, ...]]:
        """A registration by landmarks as the outline corrects it.

        Parameters
        ----------
        best : by the landmarks alone.
        alternatives : states that they cannot exclude.

        Returns
        -------
        best : corrected, or as it was where the outline is not believed.
        alternatives : those that landmarks and outline together cannot exclude.
        warnings : why the outline is not believed; none where it is.
        """
        snaps = [self.snapped(state) for state in (best.state, *alternatives)]
        seen = [snap for snap in snaps if snap.seen >= LEAST_SEEN]
        if not seen:
            return best, tuple(alternatives), (OutlineUnseen(max(snap.seen for snap in snaps)),)
        allowed = sorted((snap for snap in seen if snap.chance >= LEAST_CHANCE), key=lambda snap: snap.chi_squared)
        if not allowed:
            alone_px, beside_px = seen[0].landmarks_px
            return best, tuple(alternatives), (OutlineContradicts(beside_px, alone_px),)
        first, *others = allowed
        limit = first.chi_squared + EXCLUDED
        left = [snap.estimate.state for snap in others if snap.chi_squared < limit]
        distinct = [state for state in left if self._apart(state, first.estimate.state)]
        return first.estimate, tuple(distinct), ()

    def snapped(self, start: State) -> Snap:
        """What landmarks and outline have together near a state as landmarks alone have it."""
        outline = Outline(self._estimator.model, self._estimator.camera, self._surface)
        state, sigma, variance, k = start, self._sigma, 1.0, len(self._pixels)
        for reach in REACHES:
            seen = self._agreeing(outline.measure(self._grey, state, reach), state)
            estimate = self._estimator.estimate(*self._measured(seen, sigma, variance, state))
            balance, state = OutlineBalance(), estimate.state
            balance.learn_outline(seen, estimate.residuals[k:], self._n_unknowns)
            if np.isfinite(balance.outline.variance):
                variance = balance.outline.redundancy * max(balance.outline.variance, LEAST_SPREAD_PX**2)
            # Few landmarks fit better alone than they were set; beside the outline they show how well.
            sigma = max(self._sigma, float(np.sqrt(np.mean(estimate.residuals[:k] ** 2))))
            outline.take_brightness(self._grey, state)
        return self._judged(start, estimate, seen, sigma, variance)

    @property
    def _n_unknowns(self) -> int:
        box = self._estimator.box
        return int((box.upper > box.lower).sum()) + 6

    def _apart(self, one: State, other: State) -> bool:
        """Whether two states are different ones."""
        model = self._estimator.model
        return are_distinct(model, mesh_in_camera(model, one), mesh_in_camera(model, other))

    def _agreeing(self, seen: OutlineMeasurement, state: State) -> OutlineMeasurement:
        """Those points of an outline that are as far off the state as most of them, or less."""
        place = np.ones(len(seen.pixels))
        _, _, _, away = self._estimator.evaluate(seen.points, seen.pixels, place, state, seen.normals)
        return seen.weighted(1.0, OutlineBalance().agreeing_alone(seen, np.nan_to_num(away, nan=np.inf), near=False))

    def _measured(
        self, seen: OutlineMeasurement, sigma: float, variance: float, state: State
    ) -> tuple[BoundPoints, Array, Array, State, Array]:
        """Landmarks and outline beside a state, as an estimate takes them; a landmark has the weight 1.

        ``sigma`` is the deviation of a landmark's pixel, ``variance`` that of independent points of the outline.
        """
        k = len(self._pixels)
        return (
            self._landmarks.joined(seen.points),
            np.concatenate([self._pixels, seen.pixels]),
            np.concatenate([np.ones(k), sigma**2 / variance * seen.weights]),
            state,
            np.concatenate([np.zeros((k, 2)), seen.normals]),
        )

    def _judged(
        self, start: State, estimate: Estimate, seen: OutlineMeasurement, sigma: float, variance: float
    ) -> Snap:
        k, n, ones = len(self._pixels), self._n_unknowns, np.ones(len(self._pixels))
        cost, hessian, _, _ = self._estimator.evaluate(*self._measured(seen, sigma, variance, estimate.state))
        alone, beside = (
            self._estimator.evaluate(self._landmarks, self._pixels, ones, state)[0] for state in (start, estimate.state)
        )
        rise = 2.0 * max(beside - alone, 0.0) / self._sigma**2 / n
        return Snap(
            replace(estimate, covariance=sigma**2 * self._inverse(hessian)),
            2.0 * cost / sigma**2,
            (float(np.sqrt(2.0 * alone / k)), float(np.sqrt(2.0 * beside / k))),
            float(seen.valid.sum()) / max(int(seen.expected.sum()), 1),
            float(fdtrc(n, max(2 * k - n, 1), rise)),
        )

    def _inverse(self, hessian: Array) -> Array:
        """The inverse (d + 6, d + 6) in the unknowns that are free, zero in those that are known."""
        box, d = self._estimator.box, len(self._estimator.model.parameters)
        free = np.append(np.flatnonzero(box.upper > box.lower), np.arange(d, d + 6))
        scale = np.outer(box.scale[free], box.scale[free])
        inverse = np.zeros_like(hessian)
        inverse[np.ix_(free, free)] = scale * np.linalg.pinv(hessian[np.ix_(free, free)] * scale, hermitian=True)
        return inverse
