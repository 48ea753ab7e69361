"""Parameters that are one over the whole sequence, and how sure an estimate is.

What a point's measurement is off by has two parts. One belongs to the point: its place was read off the
reference view once, and every frame is compared with that view. It is the same in all frames, and alike for
points whose windows overlap there. The other is new in every frame. Only the second averages out.

The filter keeps the estimate of the parameters that are one per sequence, from all frames so far, with its
covariance; in the next frame it is a prior, as in any Kalman filter in the information form. Parameters may
also walk: their variance then grows by that of a step from frame to frame. Beside it goes,
for every point, how its own error has entered the estimate. So the covariance holds the points' errors in
full, however many frames there are: they are "considered" but not estimated, as in Schmidt's filter
(Jazwinski, Stochastic Processes and Filtering Theory, 1970, ch. 8.4).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Generic, Protocol, TypeVar

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from morph_dslam.model import ReducedModel
from morph_dslam.online.estimation.clear_effect import without_clear_effect
from morph_dslam.online.estimation.estimator import Estimate, Prior, State
from morph_dslam.online.estimation.filter_memory import Errors, Past, PointChange, quadratic
from morph_dslam.online.estimation.linear_cost import LinearCost
from morph_dslam.online.uncertainty.measurement_noise import Measured, PixelNoise, RigMeasured

Array = NDArray[np.float64]

#: The weight of the past in the mean of past and frame stays below this.
LARGEST_WEIGHT = 0.999
#: A past with this part of a frame's standard deviation is believed against it.
FAR_SURER = 0.2

#: What was measured in a frame.
Frame = TypeVar("Frame", Measured, RigMeasured)
_Taken = TypeVar("_Taken", Measured, RigMeasured, contravariant=True)


class Fitter(Protocol[_Taken]):
    """What makes estimates from what was measured: `Estimator`, or `RigEstimator`."""

    @property
    def model(self) -> ReducedModel: ...

    def fit(self, measured: _Taken, start: State, prior: Prior | None = None) -> Estimate: ...

    def linear(self, measured: _Taken, estimate: Estimate) -> LinearCost: ...


@dataclass(frozen=True)
class FilterOptions:
    """How the filter trusts the past.

    Attributes
    ----------
    memory : frames over which the past fades, by a factor e.
    gate : a frame whose own estimate is so many standard deviations off the past's changes nothing of it.
        It stands by itself, unless the past is far surer of what does not change.
    patience : after so many such frames in a row the past was wrong and is forgotten.
    """

    memory: float = 600.0
    gate: float = 5.0
    patience: int = 3


class SequenceFilter(Generic[Frame]):
    """Fuses the estimates of the frames of one sequence.

    Parameters
    ----------
    indices : of the parameters that are one per sequence; none is allowed, and only covariances are found.
    steps : of parameters that walk, by index: the standard deviation of their change from frame to frame, SI.
    """

    def __init__(
        self,
        estimator: Fitter[Frame],
        indices: Sequence[int],
        options: FilterOptions | None = None,
        steps: Mapping[int, float] | None = None,
    ) -> None:
        self.options = options or FilterOptions()
        walking = dict(steps or {})
        self._estimator, self._constant = estimator, np.array(indices, dtype=np.int64)
        self._kept = np.concatenate([self._constant, np.array(list(walking), dtype=np.int64)])
        self._step = np.diag([0.0] * len(indices) + [step**2 for step in walking.values()])
        self._walks = bool(walking)
        self._unknowns = len(estimator.model.parameters) + 6
        self._noise = PixelNoise(self.options.memory)
        self._past: Past | None = None
        self._untold = np.zeros(len(self._constant))
        self._conflicts = 0

    @property
    def constant(self) -> NDArray[np.int64]:
        """Indices (k,) of the parameters that are one per sequence."""
        return self._constant

    @property
    def untold(self) -> NDArray[np.bool_]:
        """Of which of these (k,) the last frame told nothing by itself."""
        return self._untold > 0.0

    def change_points(self, change: PointChange) -> None:
        """Go on with the points of another view; what those so far have put into the past stays in it."""
        self._noise.change_points()
        if self._past is not None:
            self._past = self._past.with_points(change, self._kept)

    def fuse(self, measured: Frame, alone: Estimate, known: Prior | None = None) -> Estimate:
        """The estimate of a frame from its measurements and all frames before, with its covariance.

        Parameters
        ----------
        alone : the estimate from the frame's measurements, and ``known``, only.
        known : what is known of the frame's pose or parameters from elsewhere, if anything.
        """
        linear = self._estimator.linear(measured, alone)
        self._noise.add(alone.residuals, measured, _taken(measured, linear, alone.state, known))
        self._untold = self._without_effect(measured, linear, alone, known)
        errors = self._errors(measured, linear, alone.state, known)
        by_itself = self._with_covariance(alone, measured, linear, errors, known)
        if not len(self._kept):
            return by_itself
        conflict = self._past is not None and self._contradicts(self._past, by_itself)
        self._conflicts = self._conflicts + 1 if conflict else 0
        if self._conflicts >= self.options.patience:
            self._past, self._conflicts = None, 0
        if self._past is None:
            self._keep(by_itself, errors)
            return by_itself
        if conflict and (self._walks or not self._is_far_surer(self._past, by_itself)):
            return by_itself
        past = self._prior(self._past, measured, errors)
        prior = past if known is None else past.joined(known)
        fused = self._estimator.fit(measured, self._start(by_itself), prior)
        linear = self._estimator.linear(measured, fused)
        errors = self._errors(measured, linear, fused.state, known, past)
        if not conflict:
            self._keep(fused, errors)
        fused = self._with_covariance(fused, measured, linear, errors, known, past)
        return self._without_walk(fused, by_itself) if self._walks else fused

    def _without_effect(
        self, measured: Frame, linear: LinearCost, alone: Estimate, known: Prior | None
    ) -> Array:
        """Variances (k,) of what is one per sequence where a frame tells nothing of it, else zero."""
        model, d, constant = self._estimator.model, self._unknowns - 6, self._constant
        nothing = np.zeros(len(constant))
        if not 0 < len(constant) < d:
            return nothing
        self._untold = nothing
        held = self._errors(measured, linear.holding(constant), alone.state, known).covariance
        absent = without_clear_effect(
            model,
            linear,
            lambda state: self._estimator.linear(measured, replace(alone, state=state)),
            alone.state,
            np.sqrt(np.diag(held)[:d]),
            constant,
        )
        # Any value in the range is then as likely as any other.
        return np.where(absent, (model.upper - model.lower)[constant] ** 2 / 12.0, 0.0)

    def _with_covariance(
        self,
        estimate: Estimate,
        measured: Frame,
        linear: LinearCost,
        errors: Errors,
        known: Prior | None,
        past: Prior | None = None,
    ) -> Estimate:
        """The estimate with its covariance, and what it would be without a prior on the parameters."""
        told = None
        if known is not None and known.information.any():
            of_pose = replace(known, information=np.zeros_like(known.information))
            told = self._errors(measured, linear, estimate.state, of_pose, past).covariance
        return replace(estimate, covariance=errors.covariance, measured_covariance=told)

    def _without_walk(self, fused: Estimate, by_itself: Estimate) -> Estimate:
        """The estimate with the covariance that its frame alone gives what walks, and all frames the rest."""
        own = by_itself.covariance
        own = own if by_itself.measured_covariance is None else by_itself.measured_covariance
        share = np.ones(len(own))
        rows = self._constant
        share[rows] = np.sqrt(np.minimum(np.diag(fused.covariance)[rows] / np.diag(own)[rows], 1.0))
        return replace(fused, measured_covariance=own * np.outer(share, share))

    def _of_kept(self, matrix: Array) -> Array:
        return matrix[np.ix_(self._kept, self._kept)]

    def _keep(self, estimate: Estimate, errors: Errors) -> None:
        """Make the estimate's parameters that are one per sequence the past of the next frame."""
        grown = np.exp(1.0 / self.options.memory)
        self._past = Past(
            estimate.state.parameters[self._kept],
            grown * self._of_kept(errors.covariance) + self._step,
            np.sqrt(grown) * errors.by_point[:, :, self._kept],
            grown * self._of_kept(errors.by_frames) + self._step,
            np.sqrt(grown) * errors.by_cause[:, self._kept],
            grown * self._of_kept(errors.unseen),
            {view: np.sqrt(grown) * rows[:, self._kept] for view, rows in errors.by_views.items()},
            {} if self._past is None else self._past.left,
        )

    def _start(self, alone: Estimate) -> State:
        """Where to look for the fused state: the frame's, with what the past is surer of."""
        assert self._past is not None
        parameters = alone.state.parameters.copy()
        surer = np.diag(self._past.covariance) < np.diag(alone.covariance)[self._kept]
        parameters[self._kept[surer]] = self._past.mean[surer]
        return replace(alone.state, parameters=parameters)

    def _prior(self, past: Past, measured: Frame, errors: Errors) -> Prior:
        """The past as a term of the frame's cost, of the weight that makes the variance of both least.

        In the basis in which the frame's covariance is 1 and the past's p, with the covariance c of both, the
        weight of the past is (1 - c) / (1 + p - 2 c).
        """
        d, own = self._unknowns - 6, self._of_kept(errors.covariance)
        squared_px = np.trace(np.linalg.solve(self._of_kept(errors.inverse), own)) / len(self._kept)
        p, basis = scipy.linalg.eigh(past.covariance, own)
        shared = quadratic(past.by_point, measured.correlation, errors.by_point[:, :, self._kept])
        causes = min(len(past.by_cause), len(errors.by_cause))
        shared += past.by_cause[:causes].T @ errors.by_cause[:causes, self._kept]
        c = np.einsum("ik,ij,jk->k", basis, shared, basis)
        weight = np.clip((1.0 - c) / np.maximum(1.0 + p - 2.0 * c, 1e-12), 0.0, LARGEST_WEIGHT)
        root = basis * np.sqrt(squared_px * weight / (1.0 - weight))
        mean, information = np.zeros(d), np.zeros((d, d))
        mean[self._kept] = past.mean
        information[np.ix_(self._kept, self._kept)] = root @ root.T
        return Prior(mean, information)

    def _contradicts(self, past: Past, estimate: Estimate) -> bool:
        """Whether a frame by itself says something else than all those before."""
        apart = estimate.state.parameters[self._kept] - past.mean
        spread = self._of_kept(estimate.covariance) + past.covariance
        return float(apart @ np.linalg.solve(spread, apart)) > self.options.gate**2

    def _is_far_surer(self, past: Past, estimate: Estimate) -> bool:
        """Whether the past knows far better than a frame by itself whatever both tell of."""
        shares = scipy.linalg.eigvalsh(past.covariance, self._of_kept(estimate.covariance))
        return float(shares.max()) < FAR_SURER**2

    def _errors(
        self,
        measured: Frame,
        linear: LinearCost,
        state: State,
        known: Prior | None,
        past: Prior | None = None,
    ) -> Errors:
        """How the measurements' errors, and those of what is known otherwise, enter the estimate."""
        d, kept = self._unknowns - 6, self._kept
        common, frame = self._noise.common, self._noise.frame
        by_point = np.sqrt(common) * linear.scores
        by_frames = frame * quadratic(linear.scores, measured.correlation) + linear.of_depths
        by_cause, unseen = np.zeros((0, self._unknowns)), np.zeros_like(linear.hessian)
        by_views: dict[int, Array] = {}
        hessian = linear.hessian.copy()
        if known is not None:
            information, by_cause = known.terms(state)[1], known.lasting_scores
            hessian += information
            by_frames += known.squared_px * information - by_cause.T @ by_cause
        # What a frame does not tell is no better known by many: one more cause that stays the same.
        by_cause = np.vstack([np.sqrt(self._untold)[:, None] * hessian[self._constant], by_cause])
        if past is not None and self._past is not None:
            hessian[:d, :d] += past.information
            weight = self._of_kept(past.information)
            by_point[:, :, kept] += self._past.by_point @ weight
            by_frames[np.ix_(kept, kept)] += weight @ self._past.by_frames @ weight
            by_cause = _longer(by_cause, len(self._past.by_cause))
            by_cause[: len(self._past.by_cause), kept] += self._past.by_cause @ weight
            unseen[np.ix_(kept, kept)] += weight @ self._past.unseen @ weight
            by_views = {view: rows @ weight for view, rows in self._past.by_views.items()}
        linear = replace(linear, hessian=hessian)
        inverse = linear.inverse
        by_point, by_frames, by_cause = by_point @ inverse, inverse @ by_frames @ inverse, by_cause @ inverse
        unseen = inverse @ unseen @ inverse + (common + frame) * linear.unseen
        covariance = quadratic(by_point, measured.correlation) + by_frames + by_cause.T @ by_cause + unseen
        if past is not None and self._past is not None:
            by_views = {view: rows @ inverse[kept] for view, rows in by_views.items()}
            for view, rows in by_views.items():
                covariance += rows.T @ self._past.left[view].covariance @ rows
        return Errors(by_point, by_frames, by_cause, unseen, covariance, inverse, by_views)


def _taken(measured: Measured | RigMeasured, linear: LinearCost, state: State, known: Prior | None) -> float:
    """How many numbers' worth of its measurements' variance an estimate takes up.

    Of errors with the correlation K it is tr(H^-1 J' W^1/2 K W^1/2 J): the number of unknowns where they are
    independent, and more where neighbours err alike.
    """
    hessian = linear.hessian if known is None else linear.hessian + known.terms(state)[1]
    spread = quadratic(linear.scores, measured.correlation)
    return float(np.trace(replace(linear, hessian=hessian).inverse @ spread))


def _longer(rows: Array, count: int) -> Array:
    """A copy with zeros below, so that there are at least ``count`` rows."""
    return np.vstack([rows, np.zeros((max(count - len(rows), 0), rows.shape[1]))])
