"""Pose and parameters that explain landmarks, from all starts, and refusals where none do."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from morph_dslam.better_fit import chance_of_better_fit
from morph_dslam.camera import Camera
from morph_dslam.errors import RegistrationError, RegistrationFailure
from morph_dslam.geometry import RigidTransform, rotation_exp
from morph_dslam.model import ReducedModel, SurfacePoints
from morph_dslam.registration.landmark_binding import FEWEST_FOR_FIT, BoundLandmarks
from morph_dslam.registration.messages import NotAtRest
from morph_dslam.registration.other_values import as_set, plausible_minima
from morph_dslam.registration.outline_snap import EXCLUDED, distinct_states, spread_of_turns, turned_states
from morph_dslam.registration.plausible_states import MeasuredPoints
from morph_dslam.registration.rig_check import cameras_contradict
from morph_dslam.registration.starts import pose_starts, shape_starts
from morph_dslam.tracking.covariance import floored_inverse
from morph_dslam.tracking.estimator import BoundPoints, Estimate, EstimationOptions, State
from morph_dslam.tracking.other_tilt import mirrored_tilt
from morph_dslam.tracking.rig import PointsEstimator, RigCamera

Array = NDArray[np.float64]
#: Least standard deviation of landmarks' pixels that is believed.
LEAST_PX = 0.1
#: Landmarks that fit so many times worse than carefully set ones, and worse than this share of the image's diagonal,
#: are flagged; deviations are as wide as the fit asks for anyway.
POOR_FIT, POOR_SHARE = 2.0, 1.0 / 800.0
#: Largest residual (root mean square) as a share of the image's diagonal, and that of hints about an object whose edges
#: give its place in the end: they need not be exact, but no mistakes.
RESIDUAL_SHARE, HINT_RESIDUAL_SHARE = 0.005, 0.02
#: Landmarks must be beside a line by so many times their error, all together (root of the sum of squares): the turn
#: about it is then known to a twelfth of a radian, seen edge-on. With less, linear theory does not state its error.
LEAST_BESIDE = 12.0
#: Landmarks no farther beside a line than this share of their spread along it have no pose to begin with.
EXACT_LINE = 1e-4
#: Landmarks that are right fit better by free parameters, as much as is said of, with this chance at most.
REST_CHANCE = 1e-3
#: Of landmarks that fit well at rest too, the surface must move by this share of the object's size: a lens or
#: dimensions that are slightly off move it by less.
MOVED_SHARE = 0.03
#: The mirrored tilts of so many states are tried.
MOST_TILTS = 8


@dataclass(frozen=True)
class LandmarkFit:
    """What landmarks alone say of the object.

    Attributes
    ----------
    estimator : of pose and parameters from them; where the object is at rest, its parameters have no range.
    landmarks : of all cameras.
    plausible : estimates that explain them, which landmarks of the stated accuracy cannot exclude, the best first.
    click_px : standard deviation of a carefully set landmark.
    """

    estimator: PointsEstimator
    landmarks: BoundLandmarks
    plausible: Sequence[Estimate]
    click_px: float

    @property
    def is_shape_known(self) -> bool:
        """Whether the pose alone is unknown: of an object at rest, or a rigid one."""
        return _is_shape_known(self.estimator)

    @property
    def best(self) -> Estimate:
        return self.plausible[0]

    @property
    def covariance(self) -> Array:
        """(d + 6, d + 6); a few landmarks that happen to fit well, or that a wrong model fits, are not exact for it."""
        covariance = self.best.covariance * as_set(self.best, self.click_px)
        if self.is_shape_known:
            best, variance = self.best, max(self.click_px, self.best.sigma_px) ** 2
            rises = [(other.state, 2.0 * (other.cost - best.cost) / variance) for other in self.plausible[1:]]
            covariance[-6:, -6:] += spread_of_turns(self.estimator.model, best.state, rises)
        return covariance

    @property
    def others(self) -> tuple[State, ...]:
        """States beside the best one that landmarks cannot exclude: distinct ones, and turned ones of a known shape.

        These look the same, and what corrects landmarks may tell them apart.
        """
        model, best, states = self.estimator.model, self.best.state, [one.state for one in self.plausible[1:]]
        turned = turned_states(model, best, states) if self.is_shape_known else []
        return (*distinct_states(model, best, states), *(states[row] for row in turned))

    @property
    def rms_px(self) -> float:
        """Root mean square of the best estimate's residuals."""
        return _rms(self.best)

    @property
    def poor_px(self) -> float:
        """Landmarks that fit worse than this are flagged."""
        return poor_px(self.estimator.camera, self.click_px)

    @property
    def measured(self) -> MeasuredPoints:
        """The landmarks as measurements, as exact as they fit or were set."""
        pixels, variance = self.landmarks.pixels, max(self.click_px, self.best.sigma_px) ** 2
        weights, normals = np.ones(len(self.landmarks)), np.zeros_like(pixels)
        return MeasuredPoints(self.estimator, self.landmarks.points, pixels, weights, normals, variance)

    def not_at_rest(self, shapes: Sequence[Array]) -> NotAtRest | None:
        """That the object is hardly at rest, as was said, where landmarks fit better otherwise; None if it may be.

        The statistic is F of the parameters that are set free, given the error that the landmarks show then, or that of
        carefully set ones if that is larger. It counts squares: Huber's cost is less than these where the object does
        not fit, and would hide that. Further starts have the ``shapes`` (d,).
        """
        estimator, points, pixels, resting = self.estimator, self.landmarks.points, self.landmarks.pixels, self.best
        model, d = estimator.model, len(estimator.model.study_parameters)
        freedom = 2 * len(points) - 6 - d

        def is_chance(left: float) -> bool:
            return chance_of_better_fit(_squares(resting), left, d, freedom, self.click_px) > REST_CHANCE

        # The largest F, of free parameters that explain all of it, spares most fits the search.
        if not d or freedom < 1 or is_chance(0.0):
            return None
        lower, upper = estimator.box.lower.copy(), estimator.box.upper.copy()
        lower[:d], upper[:d] = model.lower[:d], model.upper[:d]
        free = estimator.within(replace(estimator.box, lower=lower, upper=upper))
        starts = [resting.state, *pose_starts(shapes, estimator, points, pixels)]
        found = free.estimate_from(points, pixels, np.ones(len(points)), starts)
        best = next((estimate for estimate in found if np.isfinite(estimate.residuals).all()), resting)
        motion = model.positions(best.state.parameters) - model.positions(model.default)
        moved, size = np.linalg.norm(motion, axis=1).max(), np.linalg.norm(np.ptp(model.nodes, axis=0))
        least_share = 0.0 if resting.sigma_px > self.poor_px else MOVED_SHARE
        if is_chance(_squares(best)) or moved < least_share * size:
            return None
        away = (best.state.parameters - model.default)[:d] ** 2 > EXCLUDED * np.diag(best.covariance)[:d]
        values = zip(model.study_parameters, best.state.parameters[:d], away, strict=True)
        given = ", ".join(
            f"{p.name} = {p.display(v):.2g} {p.unit}".removesuffix(" 1") for p, v, is_away in values if is_away
        )
        if not given:
            return None
        return NotAtRest(resting.sigma_px, self.click_px, float(np.sqrt(2.0 * best.cost / freedom)), given)


def poor_px(camera: Camera, click_px: float) -> float:
    """Deviation of a coordinate, pixels, from which on landmarks are flagged, where carefully set ones have another."""
    return max(POOR_FIT * click_px, POOR_SHARE * float(np.hypot(camera.width, camera.height)))


def fit_landmarks(
    model: ReducedModel,
    cameras: Sequence[RigCamera],
    landmarks: BoundLandmarks,
    click_px: float,
    at_rest: bool = False,
    near: State | None = None,
) -> LandmarkFit:
    """Explain landmarks by the object.

    Parameters
    ----------
    model : of the object.
    cameras : of the rig.
    landmarks : in these.
    click_px : standard deviation of a carefully set landmark.
    at_rest : whether the parameters are their defaults.
    near : a state close by that alone is started from; None for shapes spread over the parameters' ranges.

    Raises RegistrationError if nothing explains them, or they are on one line of an object of known shape.
    """
    points, pixels = landmarks.points, landmarks.pixels
    estimator = _estimator(model, cameras, landmarks, at_rest)
    if _is_shape_known(estimator):
        _, spread, _ = np.linalg.svd(points.rest - points.rest.mean(axis=0))
        if spread[1] < EXACT_LINE * spread[0]:
            raise _on_one_line(0.0, click_px)
    shapes = shape_starts(model)
    if at_rest or 2 * len(landmarks) < len(model.parameters) + 6:
        # Too few landmarks leave the shape at its default; the damped iteration departs no more than it must.
        shapes = [model.default]
    starts = list(pose_starts(shapes, estimator, points, pixels)) if near is None else [near]
    found = _estimates(estimator, landmarks, starts)
    if near is None:
        found = _with_other_tilts(estimator, landmarks, found, click_px)
    if at_rest:
        found = [_of_pose_alone(estimator, points, pixels, estimate) for estimate in found]
    fit = LandmarkFit(estimator, landmarks, plausible_minima(found, click_px, estimator.box.n_unknowns), click_px)
    if (limit := _residual_above(estimator, fit.best)) is not None:
        moved = fit.not_at_rest([] if near is not None else shape_starts(model)) if at_rest else None
        raise _refusal(estimator, landmarks, fit.best, limit, moved)
    if fit.is_shape_known:
        _check_beside_line(fit)
    return fit


def _with_other_tilts(
    estimator: PointsEstimator, landmarks: BoundLandmarks, found: list[Estimate], click_px: float
) -> list[Estimate]:
    """The estimates, and those from the mirrored tilts of what landmarks cannot exclude, the best first.

    Landmarks that lie nearly in a plane fit nearly as well there if they are far away, and PnP gives one tilt alone.
    """
    points, starts = landmarks.points, list[State]()
    best, *others = (estimate.state for estimate in plausible_minima(found, click_px, estimator.box.n_unknowns))
    for state in [best, *distinct_states(estimator.model, best, others)][:MOST_TILTS]:
        positions = points.rest + points.field.value(state.parameters)
        starts.append(State(state.parameters, mirrored_tilt(positions, state.camera_from_object)))
    further = estimator.estimate_from(points, landmarks.pixels, np.ones(len(landmarks)), starts)
    further = [estimate for estimate in further if np.isfinite(estimate.residuals).all()]
    return sorted([*found, *further], key=lambda estimate: estimate.cost)


def check_at_rest(
    model: ReducedModel, camera: Camera, surface: SurfacePoints, pixels: Array, numbers: NDArray[np.int64]
) -> None:
    """Refuse landmarks of one frame that contradict each other grossly: as hints they need not fit closely.

    Parameters
    ----------
    model : of the object.
    camera : that took the frame.
    surface : the landmarks on the undeformed object, `FEWEST_FOR_FIT` or more.
    pixels : (k, 2) where they were seen, without the lens's distortion.
    numbers : (k,) theirs in the messages.
    """
    points = BoundPoints.from_surface(model, surface)
    landmarks = BoundLandmarks(points, pixels, np.zeros(len(points), dtype=np.int64), numbers)
    estimator = _estimator(model, [RigCamera(camera, RigidTransform.identity())], landmarks, at_rest=True)
    best = _estimates(estimator, landmarks, list(pose_starts([model.default], estimator, points, pixels)))[0]
    if (limit := _residual_above(estimator, best, HINT_RESIDUAL_SHARE)) is not None:
        raise _refusal(estimator, landmarks, best, limit)


def without_parameters(covariance: Array) -> Array:
    """A covariance (d + 6, d + 6) of a state whose parameters are known."""
    known, d = np.zeros_like(covariance), len(covariance) - 6
    known[d:, d:] = covariance[d:, d:]
    return known


def _estimator(
    model: ReducedModel, cameras: Sequence[RigCamera], landmarks: BoundLandmarks, at_rest: bool
) -> PointsEstimator:
    options = EstimationOptions(huber_px=3.0, max_iterations=60)
    estimator = PointsEstimator(model, cameras, landmarks.of_points, options)
    if at_rest:
        estimator.box = replace(estimator.box, lower=model.default, upper=model.default)
    return estimator


def _estimates(estimator: PointsEstimator, landmarks: BoundLandmarks, starts: list[State]) -> list[Estimate]:
    """What explains landmarks, the best first; raises RegistrationError if nothing does."""
    found = estimator.estimate_from(landmarks.points, landmarks.pixels, np.ones(len(landmarks)), starts)
    found = [estimate for estimate in found if np.isfinite(estimate.residuals).all()]
    if not found:
        raise RegistrationError(
            "no pose of the object explains the landmarks: check that points and pixels belong together",
            RegistrationFailure.LANDMARKS_DO_NOT_FIT,
        )
    return found


def _of_pose_alone(estimator: PointsEstimator, bound: BoundPoints, pixels: Array, found: Estimate) -> Estimate:
    """An estimate whose parameters were known, with the covariance of the pose alone."""
    d, covariance = len(estimator.model.parameters), np.zeros_like(found.covariance)
    _, hessian, _, _ = estimator.evaluate(bound, pixels, np.ones(len(bound)), found.state)
    freedom = max(2 * len(bound) - estimator.box.n_unknowns, 1)
    variance = max(2.0 * found.cost / freedom, LEAST_PX**2)
    scale = estimator.scale[d:]
    covariance[d:, d:] = variance * np.outer(scale, scale) * floored_inverse(hessian[d:, d:] * np.outer(scale, scale))
    return replace(found, covariance=covariance, at_bound=np.zeros(d, dtype=bool), sigma_px=float(np.sqrt(variance)))


def _squares(estimate: Estimate) -> float:
    """Sum of the landmarks' squared residuals, squared pixels."""
    return float(np.sum(estimate.residuals**2))


def _rms(estimate: Estimate) -> float:
    """Root mean square of the landmarks' residuals, pixels."""
    return float(np.sqrt(_squares(estimate) / len(estimate.residuals)))


def _residual_above(estimator: PointsEstimator, best: Estimate, share: float = RESIDUAL_SHARE) -> float | None:
    """The share of the image's diagonal, pixels, that landmarks fit worse than; None if they fit to that."""
    camera = estimator.camera
    limit = share * float(np.hypot(camera.width, camera.height))
    return None if _rms(best) <= limit else limit


def _refusal(
    estimator: PointsEstimator, landmarks: BoundLandmarks, best: Estimate, limit: float, moved: NotAtRest | None = None
) -> RegistrationError:
    """Why landmarks are refused that fit worse than to the ``limit``, pixels.

    A load moves several landmarks, which then seem to contradict a right one: so it is named first where it explains
    them (``moved``).
    """
    why = RegistrationFailure.LANDMARKS_DO_NOT_FIT
    if contradiction := cameras_contradict(estimator, landmarks.points, landmarks.pixels, best, limit, is_far=True):
        return RegistrationError(str(contradiction), why)
    rms, is_shape_known = _rms(best), _is_shape_known(estimator)
    if moved is not None:
        return RegistrationError(
            f"the landmarks do not fit the object at rest: their residual is {rms:.1f} px (root mean square, at most "
            f"{limit:.1f} px). They fit with {moved.parameters}: if a load may act in this frame, leave out --at-rest "
            "(at_rest), else check their points and pixels, and the object's dimensions",
            why,
        )
    wrong = _contradicted(estimator, landmarks, limit) if is_shape_known else None
    if wrong is not None:
        row, away, agreeing = wrong
        return RegistrationError(
            f"landmark {landmarks.name(row)} is {away:.1f} px from where the other {len(landmarks) - 1} have it, which "
            f"fit the object to {agreeing:.1f} px (at most {limit:.1f} px): check its point and its pixel",
            why,
        )
    lengths = np.linalg.norm(best.residuals, axis=1)
    worst = int(lengths.argmax())
    shape = "the object has its mesh's shape there" if is_shape_known else "the model reaches this shape"
    more = "; five or more show which of them is wrong" if is_shape_known and len(landmarks) == FEWEST_FOR_FIT else ""
    return RegistrationError(
        f"the landmarks do not fit the object: their residual is {rms:.1f} px (root mean square, at most "
        f"{limit:.1f} px), the worst is landmark {landmarks.name(worst)} with {lengths[worst]:.1f} px; check "
        f"its pixel, the order of the landmarks, the camera file, and that {shape}{more}",
        why,
    )


def _is_shape_known(estimator: PointsEstimator) -> bool:
    """Whether the pose alone is unknown."""
    return np.array_equal(estimator.box.lower, estimator.box.upper)


def _check_beside_line(fit: LandmarkFit) -> None:
    """Refuse landmarks of an object of known shape that are all on one line: it may be turned about it."""
    points, state = fit.landmarks.points, fit.best.state
    positions = points.rest + points.field.value(state.parameters)
    middle = positions.mean(axis=0)
    axis = np.linalg.svd(positions - middle, full_matrices=False)[2][0]
    turned = []
    for quarter in range(4):
        rotation = rotation_exp(0.5 * np.pi * quarter * axis)
        pose = state.camera_from_object @ RigidTransform(rotation, middle - rotation @ middle)
        turned.append(fit.estimator.pixels(points, replace(state, camera_from_object=pose)))
    # Quarter turns show how far a landmark is beside the line, whichever way it is off it in the image.
    beside_px = np.sqrt(0.5 * np.sum((turned - np.mean(turned, axis=0)) ** 2, axis=(0, 2)))
    error_px = max(fit.click_px, fit.best.sigma_px)
    if np.linalg.norm(beside_px) < LEAST_BESIDE * error_px:
        raise _on_one_line(float(beside_px.max()), error_px)


def _on_one_line(beside_px: float, error_px: float) -> RegistrationError:
    return RegistrationError(
        f"the landmarks are on one line, {beside_px:.1f} px beside it at most with errors of {error_px:.1f} px, about "
        "which the object may be turned by any angle: set some of them farther beside it"
    )


def _contradicted(
    estimator: PointsEstimator, landmarks: BoundLandmarks, limit: float
) -> tuple[int, float, float] | None:
    """The landmark without which the others fit an object of known shape to the limit; None if there is none.

    Returns
    -------
    Its row, how far it is from where the others have it, and how they fit, pixels.
    """
    if len(landmarks) <= FEWEST_FOR_FIT:
        return None
    found = []
    for row in range(len(landmarks)):
        others = np.delete(np.arange(len(landmarks)), row)
        kept, fewer = landmarks.take(others), estimator.taking(others)
        starts = list(pose_starts([estimator.model.default], fewer, kept.points, kept.pixels))
        for estimate in fewer.estimate_from(kept.points, kept.pixels, np.ones(len(kept)), starts)[:1]:
            there = estimator.pixels(landmarks.points, estimate.state)[row]
            found.append((_rms(estimate), row, float(np.linalg.norm(landmarks.pixels[row] - there))))
    agreeing, row, away = min(found, default=(np.inf, 0, 0.0))
    return (row, away, agreeing) if agreeing <= limit else None
