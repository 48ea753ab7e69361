"""A registration by landmarks, corrected by the object's outline in the same frame.

Landmarks that people set are off by a pixel or two each, an outline of a hundred points only by a fraction of one. So
the outline is searched for where the landmarks have it, and near there where they tell least, and pose and parameters
are fitted to both. How exact the outline is, and how many of its points count as one because they err alike, is seen
from what the fit leaves of it (`tracking.outline_weight`). What all of it is off by no fit shows: it is in the
covariance, by how exact single points are. Where too little of the outline is seen, where it fits worse
than landmarks do, or where it pulls the object off them, it is not believed.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from morph_dslam.better_fit import chance_of_better_fit
from morph_dslam.model import ReducedModel
from morph_dslam.registration.messages import OutlineContradicts, OutlineInexact, OutlineUnseen, RegistrationWarning
from morph_dslam.registration.plausible_states import MeasuredPoints
from morph_dslam.tracking.binding import DrawnSurface
from morph_dslam.tracking.covariance import floored_inverse
from morph_dslam.tracking.estimator import BoundPoints, Estimate, Estimator, State, moved
from morph_dslam.tracking.other_tilt import SAME_MINIMUM
from morph_dslam.tracking.outline import Outline, OutlineMeasurement
from morph_dslam.tracking.outline_weight import LEAST_SPREAD_PX, OutlineBalance, whole_deviation
from morph_dslam.tracking.reprojection import weighted_derivatives
from morph_dslam.tracking.state import pose_increment

Array = NDArray[np.float64]
#: How far, pixels, the outline is searched for in turn.
REACHES = (14, 10, 6, 4, 3, 3)
#: Share of the outline that must be seen where the result has it.
LEAST_SEEN = 0.5
#: Rise of the chi-squared that excludes a minimum: three standard deviations. Mean distance, as a share of the object's
#: size, by which states differ.
EXCLUDED, DISTINCT_SHARE = 9.0, 0.02
#: A point of the outline counts for no more than if it were so many squared standard deviations off.
MOST_SQUARED = 9.0
#: The outline is also looked for from states so many standard deviations off, in so many directions that landmarks tell
#: least of: from theirs alone it may be led to edges beside it.
BESIDE, DIRECTIONS = 2.0, 2
#: Such a state is none if its nodes are no farther off on average than this share of the object's size.
SAME_SHAPE = 1e-4
#: Chance by which landmarks of the size of error that they show fit so much worse beside the right outline.
LEAST_CHANCE = 1e-3


def mesh_in_camera(model: ReducedModel, state: State) -> Array:
    """The nodes (n, 3) of a model in a state, in the camera frame, metres."""
    return state.camera_from_object.apply(model.positions(state.parameters))


def shape_distance(model: ReducedModel, one: State, other: State) -> float:
    """Mean distance of the nodes in two states, as a share of the object's size."""
    away = np.linalg.norm(mesh_in_camera(model, one) - mesh_in_camera(model, other), axis=1).mean()
    return float(away / np.linalg.norm(np.ptp(model.nodes, axis=0)))


def distinct_states(model: ReducedModel, best: State, others: Iterable[State]) -> tuple[State, ...]:
    """Those states that differ from the best and from each other: by their nodes' mean distance."""
    least = DISTINCT_SHARE * float(np.linalg.norm(np.ptp(model.nodes, axis=0)))
    shapes, distinct = [mesh_in_camera(model, best)], []
    for state in others:
        shape = mesh_in_camera(model, state)
        if all(float(np.linalg.norm(shape - other, axis=1).mean()) > least for other in shapes):
            shapes.append(shape)
            distinct.append(state)
    return tuple(distinct)


def turned_states(model: ReducedModel, best: State, others: Sequence[State]) -> list[int]:
    """Rows of those states that have the surface where the best one has it, and are turned against it and each other.

    A slender object may be turned so about its length.
    """
    aparts, rows = [np.zeros(6)], []
    for row, state in enumerate(others):
        apart = pose_increment(best.camera_from_object, state.camera_from_object)
        is_new = min(float(np.linalg.norm((apart - one)[:3])) for one in aparts) > SAME_MINIMUM
        if is_new and shape_distance(model, best, state) <= DISTINCT_SHARE:
            aparts.append(apart)
            rows.append(row)
    return rows


def spread_of_turns(model: ReducedModel, best: State, others: Sequence[tuple[State, float]]) -> Array:
    """What `turned_states` add to the covariance (6, 6) of the pose of an object whose shape is known.

    Parameters
    ----------
    model : of the object.
    best : the state that explains most.
    others : further ones, and by what the chi-squared is larger there.
    """
    turned = [others[row] for row in turned_states(model, best, [state for state, _ in others])]
    aparts = [pose_increment(best.camera_from_object, state.camera_from_object) for state, _ in turned]
    weights, rows = np.exp([-0.5 * rise for _, rise in turned]), np.array(aparts).reshape(-1, 6)
    return np.asarray((rows.T * weights / (1.0 + weights.sum())) @ rows)


@dataclass(frozen=True)
class Snap:
    """A state that landmarks and outline have together.

    Attributes
    ----------
    estimate : the state; its covariance counts points of the outline that err alike as one, and has what the whole
        outline may be off by.
    measured : landmarks, of weight 1, and outline.
    landmarks_squared : sum of the landmarks' squared residuals beside the outline, large ones by Huber's cost, px^2.
    outline_px : (p,) how far the outline is off each point where the state has it; infinite where it was not found.
    variance : of a point of the outline, px^2, and redundancy : how many points err as one.
    landmarks_px : root mean square of the landmarks' residuals alone, and beside the outline.
    seen : share of the outline that was found where the state has it.
    chance : by which right landmarks fit so much worse beside the outline than alone.
    """

    estimate: Estimate
    measured: MeasuredPoints
    landmarks_squared: float
    outline_px: Array
    variance: float
    redundancy: float
    landmarks_px: tuple[float, float]
    seen: float
    chance: float

    def chi_squared(self, sigma: float, surest: Snap) -> float:
        """Of landmarks off by ``sigma``, px, and of all of the outline, which is as exact as in ``surest``.

        Points that were not found count, too: else a state that has the outline where there is none fits best.
        """
        outline = np.minimum(self.outline_px**2 / surest.variance, MOST_SQUARED).sum() / surest.redundancy
        return self.landmarks_squared / sigma**2 + float(outline)


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
        self, best: Estimate, others: Sequence[State]
    ) -> tuple[Snap | None, tuple[State, ...], tuple[RegistrationWarning, ...]]:
        """A registration by landmarks as the outline corrects it.

        Parameters
        ----------
        best : by the landmarks alone.
        others : states that they cannot exclude.

        Returns
        -------
        found : the corrected one; None where the outline is not believed.
        alternatives : distinct ones that landmarks and outline together cannot exclude.
        warnings : why the outline is not believed; none where it is.
        """
        model, alternatives = self._estimator.model, distinct_states(self._estimator.model, best.state, others)
        starts = [(state, state) for state in (best.state, *others)]
        snaps = [self.snapped(*start) for start in starts + [(near, best.state) for near in self._beside(best)]]
        seen = [snap for snap in snaps if snap.seen >= LEAST_SEEN]
        if not seen:
            return None, alternatives, (OutlineUnseen(max(snap.seen for snap in snaps)),)
        exact = [snap for snap in seen if snap.variance <= self._sigma**2]
        if not exact:
            least_px = float(np.sqrt(min(snap.variance for snap in seen)))
            return None, alternatives, (OutlineInexact(least_px, self._sigma),)
        allowed = [snap for snap in exact if snap.chance >= LEAST_CHANCE]
        if not allowed:
            alone_px, beside_px = exact[0].landmarks_px
            return None, alternatives, (OutlineContradicts(beside_px, alone_px),)
        surest = min(allowed, key=lambda snap: snap.variance)
        rated = sorted(((snap.chi_squared(self._sigma, surest), snap) for snap in allowed), key=lambda each: each[0])
        (least, first), *rest = rated
        rises = [(snap.estimate.state, chi_squared - least) for chi_squared, snap in rest]
        left = [state for state, rise in rises if rise < EXCLUDED]
        return self._widened(first, rises), distinct_states(model, first.estimate.state, left), ()

    def _widened(self, first: Snap, others: Sequence[tuple[State, float]]) -> Snap:
        """With what other poses that look the same add where the shape is known."""
        box, estimate = self._estimator.box, first.estimate
        if not np.array_equal(box.lower, box.upper):
            return first
        covariance = estimate.covariance.copy()
        covariance[-6:, -6:] += spread_of_turns(self._estimator.model, estimate.state, others)
        return replace(first, estimate=replace(estimate, covariance=covariance))

    def _beside(self, best: Estimate) -> list[State]:
        """States that landmarks hardly tell from the one that they have."""
        if not np.isfinite(best.covariance).all():
            return []
        box = self._estimator.box
        values, vectors = np.linalg.eigh(best.covariance / np.outer(box.scale, box.scale))
        steps = BESIDE * np.sqrt(np.maximum(values, 0.0)) * vectors * box.scale[:, None]
        least_seen = steps.T[::-1][:DIRECTIONS]
        beside = [box.nearest(moved(best.state, sign * step)) for step in least_seen for sign in (1.0, -1.0)]
        # A parameter that changes nothing that is seen keeps its value.
        model = self._estimator.model
        return [state for state in beside if shape_distance(model, best.state, state) > SAME_SHAPE]

    def snapped(self, start: State, by_landmarks: State) -> Snap:
        """What landmarks and outline have together near a state, beside the one that landmarks alone have."""
        outline = Outline(self._estimator.model, self._estimator.camera, self._surface)
        state, sigma, variance, redundancy, k = start, self._sigma, 1.0, 1.0, len(self._pixels)
        for reach in REACHES:
            seen = self._agreeing(outline.measure(self._grey, state, reach), state)
            estimate = self._estimator.estimate(*self._measured(seen, sigma, redundancy * variance).at(state))
            balance, state = OutlineBalance(), estimate.state
            balance.learn_outline(seen, estimate.residuals[k:], self._estimator.box.n_unknowns)
            if np.isfinite(balance.outline.variance):
                redundancy = balance.outline.redundancy
                variance = max(balance.outline.variance, LEAST_SPREAD_PX**2)
            # Few landmarks fit better alone than they were set; beside the outline they show how well.
            sigma = max(self._sigma, float(np.sqrt(np.mean(estimate.residuals[:k] ** 2))))
            outline.take_brightness(self._grey, state)
        return self._judged(by_landmarks, estimate, seen, sigma, variance, redundancy)

    def _agreeing(self, seen: OutlineMeasurement, state: State) -> OutlineMeasurement:
        """Those points of an outline that are as far off the state as most of them, or less."""
        place = np.ones(len(seen.pixels))
        _, _, _, away = self._estimator.evaluate(seen.points, seen.pixels, place, state, seen.normals)
        return seen.weighted(1.0, OutlineBalance().agreeing_alone(seen, np.nan_to_num(away, nan=np.inf), near=False))

    def _measured(self, seen: OutlineMeasurement, sigma: float, variance: float) -> MeasuredPoints:
        """Landmarks and outline; a landmark has the weight 1.

        ``sigma`` is the deviation of a landmark's pixel, ``variance`` that of independent points of the outline.
        """
        k = len(self._pixels)
        return MeasuredPoints(
            self._estimator,
            self._landmarks.joined(seen.points),
            np.concatenate([self._pixels, seen.pixels]),
            np.concatenate([np.ones(k), sigma**2 / variance * seen.weights]),
            np.concatenate([np.zeros((k, 2)), seen.normals]),
            sigma**2,
        )

    def _judged(
        self,
        by_landmarks: State,
        estimate: Estimate,
        seen: OutlineMeasurement,
        sigma: float,
        variance: float,
        redundancy: float,
    ) -> Snap:
        k, n = len(self._pixels), self._estimator.box.n_unknowns
        measured = self._measured(seen, sigma, redundancy * variance)
        (_, alone), (cost, beside) = (self._of_landmarks(state) for state in (by_landmarks, estimate.state))
        away = np.linalg.norm(estimate.residuals[k:], axis=1)
        return Snap(
            replace(estimate, covariance=self._covariance(measured, estimate, sigma, variance)),
            measured,
            2.0 * cost,
            np.where(seen.valid, away, np.inf)[seen.expected],
            variance,
            redundancy,
            (float(np.sqrt(alone / k)), float(np.sqrt(beside / k))),
            float(seen.valid.sum()) / max(int(seen.expected.sum()), 1),
            chance_of_better_fit(beside, alone, n, max(2 * k - n, 1), self._sigma),
        )

    def _covariance(self, measured: MeasuredPoints, estimate: Estimate, sigma: float, variance: float) -> Array:
        """The estimate's covariance (d + 6, d + 6) by errors of single points, and by what the whole outline is off by.

        Parameters
        ----------
        measured : landmarks, of weight 1 and the deviation ``sigma``, and outline.
        estimate : made from it.
        variance : of a point of the outline, px^2.
        """
        points, camera, huber_px = measured.points, self._estimator.camera, self._estimator.options.huber_px
        seen = estimate.residuals, measured.weights, measured.normals, huber_px
        _, hessian, by_one_px = weighted_derivatives(*points.in_state(estimate.state), camera.intrinsics, *seen)
        inverse = self._inverse(hessian)
        moved_by_whole = whole_deviation(variance) * by_one_px @ inverse
        return sigma**2 * inverse + moved_by_whole.T @ moved_by_whole

    def _of_landmarks(self, state: State) -> tuple[float, float]:
        """Huber's cost of the landmarks in a state, and the sum of their squared residuals, squared pixels.

        The cost is less than half of the squares where they do not fit, and would hide that they contradict.
        """
        ones = np.ones(len(self._pixels))
        cost, _, _, residuals = self._estimator.evaluate(self._landmarks, self._pixels, ones, state)
        return cost, float(np.sum(residuals**2))

    def _inverse(self, hessian: Array) -> Array:
        """The inverse (d + 6, d + 6) in the unknowns that are free, zero in those that are known."""
        box, d = self._estimator.box, len(self._estimator.model.parameters)
        free = np.append(np.flatnonzero(box.upper > box.lower), np.arange(d, d + 6))
        scale = np.outer(box.scale[free], box.scale[free])
        inverse = np.zeros_like(hessian)
        inverse[np.ix_(free, free)] = scale * floored_inverse(hessian[np.ix_(free, free)] * scale)
        return inverse
