"""Fuses the frames of a sequence: parameters that are one per sequence, or walk, and all covariances.

A point's measurement error has two parts. One stays with the point, because its place was read off the
reference view once; it is alike for points whose windows overlap there. The other is new in every frame, and
only that averages out. The past is a prior of the next frame, as in any Kalman filter in the information form.
Beside it goes, for every point, how its own error has entered the estimate: these errors are "considered" but
not estimated, as in Schmidt's filter (Jazwinski, Stochastic Processes and Filtering Theory, 1970, ch. 8.4).

What sensors tell of parameters, with the information K, keeps an estimate from a change of these that the images ask
for, by H^-1 K. Where the past rests on sensors too, with the information I and what they kept from it, T, that is
H^-1 (K + I T), also in a frame in which no sensor tells anything.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Generic, Protocol, TypeVar

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from morph_dslam.model import ReducedModel
from morph_dslam.tracking.estimator import Estimate, LinearCost, Prior, State
from morph_dslam.tracking.known_values import KnownParameters
from morph_dslam.tracking.noise import Correlation, Observations, PixelNoise, RigObservations, quadratic

Array = NDArray[np.float64]


@dataclass(frozen=True)
class PointChange:
    """Another reference view is followed from now on.

    Attributes
    ----------
    left, taken : numbers of the view so far and of the next one
    correlation : (p, p) of the points so far.
    n_points : of the next view, with those of the outline
    kept : numbers of the views that can come back.
    besides : (n, n) covariance of the state so far from errors that the filter does not know of; zero where
        no frame was taken in since the last change.
    """

    left: int
    taken: int
    correlation: Correlation
    n_points: int
    kept: Collection[int]
    besides: Array


@dataclass(frozen=True)
class _LeftPoints:
    """How the lasting errors of a view's points had entered the past when the view was left.

    Attributes
    ----------
    by_point : (p, 2, k), as in `_Errors`.
    covariance : (k, k) from it.
    """

    by_point: Array
    covariance: Array


@dataclass(frozen=True)
class _Errors:
    """How errors enter an estimate.

    Attributes
    ----------
    by_point : (p, 2, n) derivative by the part that stays with a point, in its standard deviations.
    by_frames : (n, n) covariance from what is new in each frame.
    by_factor : (c, n) derivative by what is the same in all frames of a known pose; see `Prior.lasting`.
    unseen : (n, n) covariance of what nothing tells of
    covariance : (n, n) from all of it.
    inverse : (n, n) of the cost's Hessian.
    by_known : (n, n) what is known otherwise of parameters keeps from the estimate, of a change of each unknown.
    by_views : (k, n) by the number of a view that was left: derivative by what its points had put into the
        k parameters then.
    """

    by_point: Array
    by_frames: Array
    by_factor: Array
    unseen: Array
    covariance: Array
    inverse: Array
    by_known: Array
    by_views: dict[int, Array] = field(default_factory=dict)


@dataclass(frozen=True)
class _Past:
    """What the frames so far said of the k parameters that are one per sequence.

    Attributes
    ----------
    mean : (k,), SI
    covariance : (k, k)
    by_point, by_frames, by_factor, unseen, by_known, by_views : as in `_Errors`, (p, 2, k), (k, k), (c, k), (k, k),
        (k, n) and (k, k) each.
    left : the views of ``by_views``, by number.
    """

    mean: Array
    covariance: Array
    by_point: Array
    by_frames: Array
    by_factor: Array
    unseen: Array
    by_known: Array
    by_views: dict[int, Array] = field(default_factory=dict)
    left: dict[int, _LeftPoints] = field(default_factory=dict)

    def with_points(self, change: PointChange, kept: NDArray[np.int64]) -> _Past:
        """The same past, for measurements of another view's points.

        What the points so far have put into it is kept apart, so that their errors are known as the same when
        their view comes back; of views that cannot, only the covariance is left. Errors that the filter does
        not know of, such as the old view's own, are added as ones that no later frame tells of.

        Parameters
        ----------
        kept : indices of the parameters (k,).
        """
        besides = change.besides[np.ix_(kept, kept)]
        covariance = quadratic(self.by_point, change.correlation)
        left = self.left | {change.left: _LeftPoints(self.by_point, covariance)}
        by_views = self.by_views | {change.left: np.eye(len(kept))}
        by_point, unseen = np.zeros((change.n_points, 2, len(kept))), self.unseen + besides
        if change.taken in left:
            # Later frames have carried on, in the same way for all points, what these had put in.
            by_point = left.pop(change.taken).by_point @ by_views.pop(change.taken)
        for view in [view for view in left if view not in change.kept]:
            rows = by_views.pop(view)
            unseen = unseen + rows.T @ left.pop(view).covariance @ rows
        return replace(
            self, covariance=self.covariance + besides, by_point=by_point, unseen=unseen, by_views=by_views, left=left
        )


#: Of a plane vector that is at least so many standard deviations long, the direction's error is that of the
#: linear theory but for some per cent: a vector that points the other way is then less likely than 0.001.
CLEARLY = 4.0
#: An effect that is not so many times the error of the model's sensitivities may be nothing but that error.
TRUE_EFFECT = 2.0


def without_clear_effect(
    model: ReducedModel,
    linear: LinearCost,
    linear_at: Callable[[State], LinearCost],
    state: State,
    others: Array,
    directions: Array,
    spread: Array,
) -> NDArray[np.bool_]:
    """Which of some changes (k,) of the parameters may have no effect on what was measured.

    Some parameters act only while others do, as the side from which a lever is turned. While it is not,
    errors of the lever's angle turn it to a side of their own, and the curvature of the cost takes this for a
    measured side. So an effect counts only where it is `CLEARLY` times what the others' errors make it differ.
    A common factor of two moduli has no effect where displacements are prescribed. A model shows one all the same, by
    errors of its sensitivities, so that it counts only where it exceeds these.

    Parameters
    ----------
    linear : the cost of what was measured, about the ``state`` that was estimated
    linear_at : about another.
    others : (m, d) errors of the other parameters, SI.
    directions : (k, d) the changes, SI, the best known first.
    spread : (k,) standard deviations along these, as parts of them.
    """
    d, k = len(state.parameters), len(directions)
    effects = linear.weighted_jacobian[:, :, :d] @ directions.T
    # What is known worse than a direction, or that itself, says nothing against its effect.
    counts = np.concatenate([np.ones((len(others), k)), np.triu(np.ones((k, k)), 1)])
    changes = np.zeros(k)
    for step, counted in zip(np.concatenate([others, spread[:, None] * directions]), counts, strict=True):
        if not counted.any():
            continue
        parameters = state.parameters + step
        if (parameters < model.lower).any() or (parameters > model.upper).any():
            parameters = np.clip(state.parameters - step, model.lower, model.upper)
        there = linear_at(replace(state, parameters=parameters)).weighted_jacobian[:, :, :d] @ directions.T
        changes += counted * np.sum((there - effects) ** 2, axis=(0, 1))
    single = np.sum(linear.weighted_jacobian[:, :, :d] ** 2, axis=(0, 1))
    by_model = directions**2 @ (sensitivity_errors(model) ** 2 * single)
    return np.sum(effects**2, axis=(0, 1)) <= CLEARLY**2 * changes + TRUE_EFFECT**2 * by_model


def sensitivity_errors(model: ReducedModel) -> Array:
    """Relative errors (d,) of the displacement's sensitivities, as the certificate has them; 0 where it does not."""
    stated = model.certificate.get("sensitivity", {})
    return np.array([stated.get(p.name, {}).get("relative_l2") or 0.0 for p in model.parameters])


#: The weight of the past in the mean of past and frame stays below this.
LARGEST_WEIGHT = 0.999
#: Frames over which the past fades, by a factor e. Of what a frame does not show it does not.
MEMORY = 600.0
#: A frame whose own estimate is so many standard deviations off the past's changes nothing of it; it stands
#: by itself, unless the past is far surer of what does not change. After so many in a row the past is forgotten.
GATE, PATIENCE = 5.0, 3
#: A past with this part of a frame's standard deviation is believed against it.
FAR_SURER = 0.2
#: What was measured in a frame.
Frame = TypeVar("Frame", Observations, RigObservations)
_Taken = TypeVar("_Taken", Observations, RigObservations, contravariant=True)


class Fitter(Protocol[_Taken]):
    """What makes estimates from what was measured: `Estimator`, or `RigEstimator`."""

    @property
    def model(self) -> ReducedModel: ...

    @property
    def known(self) -> KnownParameters: ...

    def known_information(self, parameters: Array) -> tuple[Array, Array]: ...

    def fit(self, measured: _Taken, start: State, prior: Prior | None = None) -> Estimate: ...

    def linear(self, measured: _Taken, estimate: Estimate) -> LinearCost: ...


class SequenceFilter(Generic[Frame]):
    """Fuses the estimates of the frames of one sequence.

    Parameters
    ----------
    indices : of the parameters that are one per sequence; none is allowed, and only covariances are found.
    steps : of parameters that walk, by index: the standard deviation of their change from frame to frame, SI.

    Attributes
    ----------
    past_information : (d + 6, d + 6) with which the past counts in the last estimate, as a term of its cost
    by_known : (d + 6, d + 6) what unknown loads' prior and sensors keep from the last estimate, of a change of each
        unknown
    keeps : whether the last estimate is the past of the next one
    forgot : whether the last frame made it give up what the frames before say of parameters that are one per sequence
    """

    def __init__(
        self, estimator: Fitter[Frame], indices: Sequence[int], steps: Mapping[int, float] | None = None
    ) -> None:
        walking = dict(steps or {})
        self._estimator, self._constant = estimator, np.array(indices, dtype=np.int64)
        self._kept = np.concatenate([self._constant, np.array(list(walking), dtype=np.int64)])
        self._step = np.diag([0.0] * len(indices) + [step**2 for step in walking.values()])
        self._walks = bool(walking)
        self._unknowns = len(estimator.model.parameters) + 6
        self._ranges = (estimator.model.upper - estimator.model.lower)[self._constant]
        self._noise = PixelNoise(MEMORY)
        self._past: _Past | None = None
        self._unobservable = np.zeros((len(self._constant),) * 2)
        self._conflicts = 0
        self.past_information, self.keeps, self.forgot = np.zeros((self._unknowns,) * 2), True, False
        self.by_known = np.zeros((self._unknowns,) * 2)

    @property
    def held(self) -> Array | None:
        """What sensors keep from the last estimate (d + 6, d), for each change of the parameters; None without any."""
        told = self._estimator.known.ever
        return self.by_known[:, :-6] * told if told.any() else None

    def change_points(self, change: PointChange) -> None:
        """Go on with the points of another view; what those so far have put into the past stays in it."""
        self._noise.change_points()
        if self._past is not None:
            self._past = self._past.with_points(change, self._kept)

    def go_on(self, count: int = 1) -> None:
        """Take a step of what walks, for each of ``count`` frames that tell nothing; `fuse` does so for its own."""
        past, steps = self._past, count * self._step
        if past is not None and count:
            covariance, by_frames = past.covariance + steps, past.by_frames + steps
            self._past = replace(past, covariance=covariance, by_frames=by_frames)

    def fuse(self, measured: Frame, alone: Estimate, known: Prior | None = None) -> Estimate:
        """The estimate of a frame from its measurements and all frames before, with its covariance.

        Parameters
        ----------
        alone : the estimate from the frame's measurements, and ``known``, only.
        known : what is known of the frame's pose or parameters from elsewhere, if anything.
        """
        self.past_information, self.keeps, self.forgot = np.zeros((self._unknowns,) * 2), True, False
        linear = self._estimator.linear(measured, alone)
        self._noise.add(alone.residuals, measured, _taken(linear, alone.state, known))
        self._unobservable = self._without_effect(measured, linear, alone, known)
        errors = self._errors(measured, linear, alone.state, known)
        by_itself, self.by_known = self._with_covariance(alone, measured, linear, errors, known), errors.by_known
        if not len(self._kept):
            return by_itself
        conflict = self._past is not None and self._contradicts(self._past, by_itself, len(self._kept))
        self._conflicts = self._conflicts + 1 if conflict else 0
        if self._past is not None and self._conflicts >= PATIENCE:
            self.forgot = self._contradicts(self._past, by_itself, len(self._constant))
            self._past, self._conflicts = None, 0
        if self._past is None:
            self._keep(by_itself, errors)
            return by_itself
        self.keeps = not conflict
        if conflict and (self._walks or not self._is_far_surer(self._past, by_itself)):
            self.go_on()
            return by_itself
        past = self._prior(self._past, measured, errors, linear)
        self.past_information[:-6, :-6] = past.information
        prior = past if known is None else past.joined(known)
        fused = self._estimator.fit(measured, self._start(by_itself), prior)
        linear = self._estimator.linear(measured, fused)
        errors = self._errors(measured, linear, fused.state, known, past)
        self.by_known = errors.by_known
        if not conflict:
            self._keep(fused, errors)
        fused = self._with_covariance(fused, measured, linear, errors, known, past)
        return self._without_walk(fused, by_itself) if self._walks else fused

    def _without_effect(self, measured: Frame, linear: LinearCost, alone: Estimate, known: Prior | None) -> Array:
        """How far shared parameters (k,) are off that are unobservable in a frame, or combinations of them.

        Returns
        -------
        (k, k) by k causes that are the same in all frames, in their standard deviations, SI; zero where all of them are
        observable.
        """
        model, d, constant = self._estimator.model, self._unknowns - 6, self._constant
        self._unobservable = np.zeros((len(constant),) * 2)
        if not 0 < len(constant) < d:
            return self._unobservable
        ranges, variances, axes = self._ranges, np.ones(1), np.eye(1)
        if len(constant) > 1:  # directions, the best known first
            own = self._errors(measured, linear, alone.state, known).covariance[np.ix_(constant, constant)]
            variances, axes = np.linalg.eigh(own / np.outer(ranges, ranges))
        directions = np.zeros((len(constant), d))
        directions[:, constant] = axes.T * ranges
        held = self._errors(measured, linear.holding(constant), alone.state, known).covariance
        spread = np.sqrt(np.diag(held)[:d])
        spread[constant] = 0.0
        others = np.diag(np.minimum(spread, 0.5 * (model.upper - model.lower)))[spread > 0.0]
        absent = without_clear_effect(
            model,
            linear,
            lambda state: self._estimator.linear(measured, replace(alone, state=state)),
            alone.state,
            others,
            directions,
            np.minimum(np.sqrt(np.maximum(variances, 0.0)), 0.5),
        )
        # Any value in the range is then as likely as any other.
        return np.asarray((axes * np.where(absent, np.sqrt(1.0 / 12.0), 0.0)) @ axes.T * ranges)

    def _with_covariance(
        self,
        estimate: Estimate,
        measured: Frame,
        linear: LinearCost,
        errors: _Errors,
        known: Prior | None,
        past: Prior | None = None,
    ) -> Estimate:
        """The estimate with its covariance, and what it would be without a prior on the parameters."""
        by_images = None
        if known is not None and known.information.any():
            of_pose = replace(known, information=np.zeros_like(known.information))
            by_images = self._errors(measured, linear, estimate.state, of_pose, past).covariance
        return replace(estimate, covariance=errors.covariance, measured_covariance=by_images)

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

    def _keep(self, estimate: Estimate, errors: _Errors) -> None:
        """Make the estimate's parameters that are one per sequence the past of the next frame."""
        fades, k = self._fading(), self._kept
        self._past = _Past(
            estimate.state.parameters[k],
            fades @ self._of_kept(errors.covariance) @ fades.T,
            errors.by_point[:, :, k] @ fades.T,
            fades @ self._of_kept(errors.by_frames) @ fades.T,
            errors.by_factor[:, k] @ fades.T,
            fades @ self._of_kept(errors.unseen) @ fades.T,
            errors.by_known[k],
            {view: rows[:, k] @ fades.T for view, rows in errors.by_views.items()},
            {} if self._past is None else self._past.left,
        )
        self.go_on()

    def _fading(self) -> Array:
        """By which errors of the kept parameters (k, k) grow from one frame to the next; what a frame shows fades."""
        growth = np.exp(0.5 / MEMORY)
        fades, n = growth * np.eye(len(self._kept)), len(self._constant)
        fades[:n, :n] -= (growth - 1.0) * self._without_effect_in_ranges() * np.divide.outer(self._ranges, self._ranges)
        return fades

    def _start(self, alone: Estimate) -> State:
        """Where to look for the fused state: the frame's, with what the past is surer of."""
        assert self._past is not None
        parameters = alone.state.parameters.copy()
        surer = np.diag(self._past.covariance) < np.diag(alone.covariance)[self._kept]
        parameters[self._kept[surer]] = self._past.mean[surer]
        return replace(alone.state, parameters=parameters)

    def _prior(self, past: _Past, measured: Frame, errors: _Errors, linear: LinearCost) -> Prior:
        """The past as a term of the frame's cost, of the weight that makes the variance of both least.

        In the basis in which the frame's covariance is 1 and the past's p, with the covariance c of both, the
        weight of the past is (1 - c) / (1 + p - 2 c). Of what has no effect in the frame the past is held.
        """
        d, own = self._unknowns - 6, self._of_kept(errors.covariance)
        p, basis = scipy.linalg.eigh(past.covariance, own)
        shared = quadratic(past.by_point, measured.correlation, errors.by_point[:, :, self._kept])
        error_factors = min(len(past.by_factor), len(errors.by_factor))
        shared += past.by_factor[:error_factors].T @ errors.by_factor[:error_factors, self._kept]
        c = np.einsum("ik,ij,jk->k", basis, shared, basis)
        weight = np.clip((1.0 - c) / np.maximum(1.0 + p - 2.0 * c, 1e-12), 0.0, LARGEST_WEIGHT)
        squared_px = 1.0 / np.einsum("ik,ij,jk->k", basis, self._of_kept(errors.inverse), basis)
        root = basis * np.sqrt(squared_px * weight / (1.0 - weight))
        mean, information = np.zeros(d), np.zeros((d, d))
        mean[self._kept] = past.mean
        information[np.ix_(self._kept, self._kept)] = root @ root.T
        information[np.ix_(self._constant, self._constant)] += self._held_where_without_effect(linear)
        return Prior(mean, information)

    def _held_where_without_effect(self, linear: LinearCost) -> Array:
        """Information (k, k) on shared parameters that leaves what is unobservable in a frame as it was."""
        most = np.max(np.diag(linear.hessian) * linear.scale**2)
        return most * self._without_effect_in_ranges() / np.outer(self._ranges, self._ranges)

    def _without_effect_in_ranges(self) -> Array:
        """Projection (k, k) of shared parameters, as parts of their ranges, to what is unobservable in a frame."""
        return np.sqrt(12.0) * self._unobservable / self._ranges

    def _contradicts(self, past: _Past, estimate: Estimate, count: int) -> bool:
        """Whether a frame by itself says something else than all those before of the first ``count`` that are kept."""
        apart = (estimate.state.parameters[self._kept] - past.mean)[:count]
        spread = (self._of_kept(estimate.covariance) + past.covariance)[:count, :count]
        return float(apart @ np.linalg.solve(spread, apart)) > GATE**2

    def _is_far_surer(self, past: _Past, estimate: Estimate) -> bool:
        """Whether the past knows far better than a frame by itself whatever both tell of."""
        shares = scipy.linalg.eigvalsh(past.covariance, self._of_kept(estimate.covariance))
        return float(shares.max()) < FAR_SURER**2

    def _errors(
        self, measured: Frame, linear: LinearCost, state: State, known: Prior | None, past: Prior | None = None
    ) -> _Errors:
        """How the measurements' errors, and those of what is known otherwise, enter the estimate."""
        d, kept = self._unknowns - 6, self._kept
        common, frame = self._noise.common, self._noise.frame
        by_frames = frame * linear.spread + linear.of_depths
        by_factor, unseen = np.zeros((0, self._unknowns)), np.zeros_like(linear.hessian)
        by_views: dict[int, Array] = {}
        by_point, hessian = np.sqrt(common) * linear.weighted_jacobian, linear.hessian.copy()
        by_known = self._estimator.known_information(state.parameters)[0]
        if known is not None:
            information, by_factor = known.terms(state)[1], known.lasting_push
            hessian += information
            by_frames += known.new_in_frame(information)
        # What a frame does not tell is no better known by many: one more cause that stays the same.
        by_factor = np.vstack([self._unobservable @ hessian[self._constant], linear.in_common, by_factor])
        if past is not None and self._past is not None:
            hessian[:d, :d] += past.information
            weight = self._of_kept(past.information)
            by_point[:, :, kept] += self._past.by_point @ weight
            by_frames[np.ix_(kept, kept)] += weight @ self._past.by_frames @ weight
            by_factor = _longer(by_factor, len(self._past.by_factor))
            by_factor[: len(self._past.by_factor), kept] += self._past.by_factor @ weight
            unseen[np.ix_(kept, kept)] += weight @ self._past.unseen @ weight
            by_known[kept] += weight @ self._past.by_known
            by_views = {view: rows @ weight for view, rows in self._past.by_views.items()}
        # Without a past it is the spread of this frame's points alone, which is known already.
        of_points = common * linear.spread if past is None else quadratic(by_point, measured.correlation)
        linear = linear if known is None and past is None else linear.with_known(hessian)
        inverse = linear.inverse
        by_point = by_point @ inverse if len(kept) else by_point[:0]
        by_frames, by_factor = inverse @ by_frames @ inverse, by_factor @ inverse
        unseen = inverse @ unseen @ inverse + (common + frame) * linear.unseen
        covariance = inverse @ of_points @ inverse + by_frames + by_factor.T @ by_factor + unseen
        if past is not None and self._past is not None:
            by_views = {view: rows @ inverse[kept] for view, rows in by_views.items()}
            for view, rows in by_views.items():
                covariance += rows.T @ self._past.left[view].covariance @ rows
        by_known = linear.inverse_of_seen @ by_known
        return _Errors(by_point, by_frames, by_factor, unseen, covariance, inverse, by_known, by_views)


def _taken(linear: LinearCost, state: State, known: Prior | None) -> float:
    """How many numbers' worth of its measurements' variance an estimate takes up.

    Of errors with the correlation K it is tr(H^-1 J' W^1/2 K W^1/2 J): the number of unknowns where they are
    independent, and more where neighbours err alike.
    """
    informed = linear if known is None else replace(linear, hessian=linear.hessian + known.terms(state)[1])
    return float(np.trace(informed.inverse @ linear.spread))


def _longer(rows: Array, count: int) -> Array:
    """A copy with zeros below, so that there are at least ``count`` rows."""
    return np.vstack([rows, np.zeros((max(count - len(rows), 0), rows.shape[1]))])
