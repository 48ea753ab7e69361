"""Tracking a free object: pose and parameters together in every frame, without a static scene.

`Tracker.process_frame` is the method: follow the bound points from the previous frame, estimate, correct
against the rendered reference view so that nothing drifts, and accept the result on evidence; a lost object
is found again from the reference view's features. The estimate uses no temporal prior: the previous frames
only say where to start.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from morph_dslam.camera import PinholeCamera
from morph_dslam.errors import RegistrationError, TrackingError
from morph_dslam.model import ReducedModel
from morph_dslam.online.appearance import ReferenceAppearance
from morph_dslam.online.binding import DrawnSurface, View, bind_pixels, draw_view, view_of
from morph_dslam.online.estimation import BoundPoints, Estimate, Estimator, State
from morph_dslam.online.features import interior, spread_corners
from morph_dslam.online.flow import flatten, follow
from morph_dslam.online.frame_result import (
    FOLLOWED,
    FOUND_AGAIN,
    RECOVERED,
    STAGES,
    UNEXPLAINED,
    FrameResult,
)
from morph_dslam.online.measurement import (
    Measurement,
    compare_with_rendering,
    visible_surface,
)
from morph_dslam.online.measurement_noise import Measured, window_correlation
from morph_dslam.online.outline import Outline, OutlineMeasurement
from morph_dslam.online.reference_refinement import Keyframe
from morph_dslam.online.relocalisation import Relocaliser
from morph_dslam.online.sequence_filter import SequenceFilter
from morph_dslam.online.shape_search import ShapeSearch, with_undetermined_at_default
from morph_dslam.online.systematic_errors import SystematicErrors
from morph_dslam.online.timing import StageClock
from morph_dslam.online.tracker_options import TrackerOptions

Array = NDArray[np.float64]

#: Share of the cost below which another shape is a better explanation and not the same one.
CLEARLY_BETTER = 0.95


@dataclass(frozen=True)
class _Picture:
    """A frame made ready: the undistorted grey image (h, w), and flattened."""

    grey: NDArray[np.uint8]
    flat: NDArray[np.uint8]


@dataclass(frozen=True)
class _Attempt:
    """An estimate, which measurements support it (p,), and all the measurements."""

    estimate: Estimate
    inliers: NDArray[np.bool_]
    measurement: Measurement
    outline: OutlineMeasurement | None = None


class Tracker:
    """Follows one object from its registered reference view.

    Parameters
    ----------
    reference : the reference frame (h, w, 3) uint8, as recorded. state : the object in it.
    in_sequence : whether the first frame to process is the reference frame or follows it; if not, the object
        is looked for as after a loss. reference_covariance : (d + 6, d + 6) of ``state``; it enters that of
        every frame. None where nothing is known of the error of ``state``.

    Raises
    ------
    RegistrationError
        If the object shows too few corners in the reference frame.
    """

    def __init__(
        self,
        model: ReducedModel,
        camera: PinholeCamera,
        reference: NDArray[np.uint8],
        state: State,
        options: TrackerOptions | None = None,
        in_sequence: bool = True,
        reference_covariance: Array | None = None,
    ) -> None:
        self.model, self.camera, self.options = model, camera, options or TrackerOptions()
        self.estimator = Estimator(model, camera, self.options.estimation)
        self._undistortion = camera.undistortion_maps()
        picture = self._prepare(reference)
        surface = DrawnSurface.of(model)
        self._drawn = surface.model
        view = view_of(self._drawn, camera, state)
        self.appearance = ReferenceAppearance(self._drawn, camera, picture.flat, view, surface.closed)
        margin = self.options.measurement.patch_half + 2
        mask = interior(draw_view(view, self._drawn.triangles, camera).covered, margin)
        self.points = self._choose_points(picture, mask, view)
        self.relocaliser = Relocaliser(self.estimator, self._drawn, picture.grey, mask, view)
        self.outline = None
        if self.options.use_outline:
            self.outline = Outline(model, camera, picture.grey, state, self.options.outline)
            self._with_outline = self.points.joined(self.outline.points)
        self._picture, self._reference = picture, state
        self._pixels = self.reference_pixels = camera.project(self.points.in_camera(state))
        self.last_seen: Keyframe | None = None
        self._supported = np.ones(len(self.points), dtype=bool)
        self._search = ShapeSearch(model, self.options.searches)
        brief = replace(self.options.estimation, max_iterations=10, tolerance=1e-3)
        self._scout = Estimator(model, camera, brief)
        self._filter, self._correlation = self._new_filter()
        window = self.options.flow.window
        self._systematic = SystematicErrors(self.estimator, self.points, state, reference_covariance, window)
        self._last, self._velocity_base, self._lost = state, state, not in_sequence
        self._start = state

    def process_frame(self, image: NDArray[np.uint8]) -> FrameResult:
        """Find the object in the next frame (h, w, 3) uint8, as recorded."""
        clock = StageClock(STAGES)
        with clock.stage("prepare"):
            picture = self._prepare(image)
        attempt = self._attempt_from_last(picture, clock)
        with clock.stage("search"):
            attempt = self._search_other_shapes(attempt)
        refusal, how = self._refusal(attempt), FOUND_AGAIN if self._lost else FOLLOWED
        if refusal:
            attempt, refusal, how = self._recover(picture, attempt, refusal, clock)
        if not refusal:
            if self.outline is not None:
                with clock.stage("outline"):
                    attempt = self._fit_outline(picture, attempt, self.outline)
            with clock.stage("fuse"):
                attempt = self._fuse(attempt)
        self._remember(picture, attempt, bool(refusal))
        return self._result(attempt, refusal, how, clock)

    def _recover(
        self, picture: _Picture, attempt: _Attempt, refusal: str, clock: StageClock
    ) -> tuple[_Attempt, str, str]:
        """Look for the object by its features in the whole frame; refused if it may be in two places."""
        found, matches = self._find(picture, None, clock)
        if matches is not None:
            return attempt, f"{refusal}; only {matches} features of the reference view were found again", ""
        if found is None:
            return attempt, refusal, ""
        with clock.stage("recover"):
            covered = draw_view(
                view_of(self._drawn, self.camera, found.estimate.state), self._drawn.triangles, self.camera
            ).covered
            elsewhere = np.where(covered, 0, 255).astype(np.uint8)
        other, _ = self._find(picture, elsewhere, clock)
        if other is not None and self._apart(found, other):
            counts = f"{int(found.inliers.sum())} and {int(other.inliers.sum())} points agree"
            return attempt, f"{refusal}; it could be in two places, where {counts}", ""
        return found, "", RECOVERED

    def _find(
        self, picture: _Picture, mask: NDArray[np.uint8] | None, clock: StageClock
    ) -> tuple[_Attempt | None, int | None]:
        """A place where the object is to be believed, or None; and how many features agreed, if too few."""
        with clock.stage("recover"):
            state, matches = self.relocaliser.find(picture.grey, self._shapes(), mask)
        if state is None:
            return None, matches
        candidate = self._correct(picture, state, None, clock)
        candidate = self._correct(picture, candidate.estimate.state, None, clock)
        return (None if self._refusal(candidate) else candidate), None

    def _apart(self, found: _Attempt, other: _Attempt) -> bool:
        """Whether two attempts are of different places in the image."""
        between = np.linalg.norm(found.measurement.pixels - other.measurement.pixels, axis=1)
        return float(np.nanmedian(between)) > self.options.measurement.largest_correction_px

    def _attempt_from_last(self, picture: _Picture, clock: StageClock) -> _Attempt:
        """Estimate from the last known state; by way of the previous frame if the object was seen there."""
        if self._lost:
            return self._correct(picture, self._last, None, clock)
        with clock.stage("flow"):
            followed = self._follow(picture)
        with clock.stage("estimate"):
            start = self.estimator.estimate(
                self.points, followed.pixels, followed.valid.astype(float), self._start
            )
        return self._correct(picture, start.state, followed, clock)

    def _follow(self, picture: _Picture) -> Measurement:
        """Follow the points that supported the previous frame's estimate from that frame to this one."""
        rows = np.flatnonzero(self._supported)
        guesses = self._pixels + self._expected_motion()
        found, ok = follow(
            self._picture.flat, picture.flat, self._pixels[rows], guesses[rows], self.options.flow
        )
        pixels, valid = guesses, np.zeros(len(guesses), dtype=bool)
        pixels[rows], valid[rows] = found, ok
        return Measurement(pixels, valid, self._supported)

    def _correct(
        self, picture: _Picture, state: State, followed: Measurement | None, clock: StageClock
    ) -> _Attempt:
        """Measure against the reference view rendered in ``state`` and estimate from these measurements."""
        with clock.stage("render"):
            view = view_of(self._drawn, self.camera, state)
            rendering = self.appearance.render(view)
        with clock.stage("correct"):
            positions = self.points.in_camera(state)
            predicted = self.camera.project(positions)
            visible = visible_surface(
                self.points.surface,
                positions,
                predicted,
                view,
                self._drawn.triangles,
                self.appearance,
                rendering,
            )
            guesses = (
                predicted
                if followed is None
                else np.where(followed.valid[:, None], followed.pixels, predicted)
            )
            measurement = compare_with_rendering(
                picture.flat,
                rendering,
                predicted,
                guesses,
                visible,
                self.options.flow,
                self.options.measurement,
            )
        with clock.stage("estimate"):
            estimate, inliers = self._estimate_trimmed(measurement, state)
        return _Attempt(estimate, inliers, measurement)

    def _estimate_trimmed(self, measurement: Measurement, start: State) -> tuple[Estimate, NDArray[np.bool_]]:
        """Estimate from all valid measurements, then from those that agree with the first estimate."""
        estimate, used = None, measurement.valid
        for _ in range(2):
            estimate = self.estimator.estimate(self.points, measurement.pixels, used.astype(float), start)
            limit = np.clip(self.options.inlier_sigmas * estimate.sigma_px, *self.options.inlier_px)
            with np.errstate(invalid="ignore"):
                close = np.linalg.norm(estimate.residuals, axis=1) < limit
            agreeing = measurement.valid & close
            if (agreeing == used).all():
                break
            start, used = estimate.state, agreeing
        assert estimate is not None
        return estimate, used

    def _search_other_shapes(self, attempt: _Attempt) -> _Attempt:
        """The attempt, or a clearly better explanation of its measurements reached from another shape."""
        measurement, estimate = attempt.measurement, attempt.estimate
        if not self.options.search_above_px < estimate.sigma_px < np.inf:
            return attempt
        weights = measurement.valid.astype(float)
        cost = self.estimator.evaluate(self.points, measurement.pixels, weights, estimate.state)[0]
        starts = self._search.next_starts(estimate.state.camera_from_object)
        best = self._scout.estimate_from(self.points, measurement.pixels, weights, starts)[0]
        if best.cost > CLEARLY_BETTER * cost:
            return attempt
        return _Attempt(*self._estimate_trimmed(measurement, best.state), measurement)

    def _fit_outline(self, picture: _Picture, attempt: _Attempt, outline: Outline) -> _Attempt:
        """Estimate from the supporting points and the outline together; searched far first, then near."""
        estimate, count, seen = attempt.estimate, len(self.points), None
        for reach in (self.options.outline.reach_px, self.options.outline.reach_px // 2):
            seen = outline.measure(picture.grey, estimate.state, reach)
            estimate = self.estimator.estimate(
                self._with_outline,
                np.concatenate([attempt.measurement.pixels, seen.pixels]),
                np.concatenate([attempt.inliers, self.options.outline.weight * seen.valid]).astype(float),
                estimate.state,
                np.concatenate([np.zeros((count, 2)), seen.normals]),
            )
        return replace(attempt, estimate=estimate, outline=seen)

    def _new_filter(self) -> tuple[SequenceFilter, Array]:
        """The filter of what is one per sequence, and how the errors of all points are correlated."""
        names = [parameter.name for parameter in self.model.parameters]
        unknown = [name for name in self.options.per_sequence if name not in names]
        if unknown:
            raise TrackingError(
                f"'{unknown[0]}' cannot be one over the sequence: the model's parameters are "
                + ", ".join(names)
            )
        points = self.points if self.outline is None else self._with_outline
        places = self.camera.project(points.in_camera(self._reference))
        indices = [names.index(name) for name in self.options.per_sequence]
        correlation = window_correlation(places, self.options.flow.window)
        return SequenceFilter(self.estimator, indices, self.options.filter), correlation

    def _fuse(self, attempt: _Attempt) -> _Attempt:
        """The attempt with what earlier frames tell of the parameters that are one per sequence."""
        points, pixels = self.points, attempt.measurement.pixels
        weights = np.where(attempt.inliers, 1.0, 0.0)
        normals = np.zeros_like(pixels)
        if attempt.outline is not None:
            points, seen = self._with_outline, attempt.outline
            pixels, normals = np.concatenate([pixels, seen.pixels]), np.concatenate([normals, seen.normals])
            weights = np.concatenate([weights, np.where(seen.valid, self.options.outline.weight, 0.0)])
        measured = Measured(points, pixels, weights, normals, self._correlation)
        estimate = self._filter.fuse(measured, attempt.estimate)
        return replace(attempt, estimate=replace(estimate, residuals=estimate.residuals[: len(self.points)]))

    def _refusal(self, attempt: _Attempt) -> str:
        """Why an attempt is not to be believed; empty when it is."""
        needed = min(self.options.least_inliers, int(np.ceil(self.options.least_share * len(self.points))))
        count, visible = int(attempt.inliers.sum()), int(attempt.measurement.visible.sum())
        if count < needed:
            return f"{count} of {visible} points agree, at least {needed} needed"
        return ""

    def _expected_motion(self) -> Array:
        """Image motion (p, 2) at the velocity of the two previous frames; only a first guess."""
        before = self.camera.project(self.points.in_camera(self._velocity_base))
        motion = self.camera.project(self.points.in_camera(self._last)) - before
        return np.nan_to_num(motion)

    def _shapes(self) -> list[Array]:
        """Parameters to relocalise with: the last known, the default, each parameter near both ends."""
        lower, upper, default = self.model.lower, self.model.upper, self.model.default
        shapes = [self._last.parameters, default]
        for k in range(len(default)):
            for share in (1 / 6, 5 / 6):
                shape = default.copy()
                shape[k] = lower[k] + share * (upper[k] - lower[k])
                shapes.append(shape)
        return shapes

    def _remember(self, picture: _Picture, attempt: _Attempt, lost: bool) -> None:
        """Keep what the next frame starts from; a lost frame keeps the last known state."""
        if not lost:
            estimate, weights = attempt.estimate, attempt.inliers.astype(float)
            self.last_seen = Keyframe(
                attempt.measurement.pixels, weights, estimate.state, estimate.sigma_px, attempt.outline
            )
            self._velocity_base = attempt.estimate.state if self._lost else self._last
            self._last = attempt.estimate.state
            self._start = with_undetermined_at_default(self.model, attempt.estimate)
            self._supported = attempt.inliers
            projected = self.camera.project(self.points.in_camera(self._last))
            self._pixels = np.where(attempt.inliers[:, None], attempt.measurement.pixels, projected)
        self._picture, self._lost = picture, lost

    def _result(self, attempt: _Attempt, refusal: str, how: str, clock: StageClock) -> FrameResult:
        visible, count = int(attempt.measurement.visible.sum()), int(attempt.inliers.sum())
        times, total = clock.milliseconds, clock.total
        if refusal:
            return FrameResult("lost", f"lost: {refusal}", None, np.nan, visible, count, times, total)
        residuals = attempt.estimate.residuals[attempt.inliers]
        rms = float(np.sqrt(np.mean(np.sum(residuals**2, axis=1))))
        left = self._systematic.unexplained(attempt.estimate, attempt.inliers)
        estimate = self._systematic.added(attempt.estimate, attempt.inliers, left)
        reason = f"{how}; {UNEXPLAINED}: {left.px:.1f} px are left" if left.is_failure else how
        recovered = how != FOLLOWED
        return FrameResult("tracked", reason, estimate, rms, visible, count, times, total, recovered, left.px)

    def _prepare(self, image: NDArray[np.uint8]) -> _Picture:
        grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
        if self._undistortion is not None:
            grey = cv2.remap(grey, *self._undistortion, interpolation=cv2.INTER_LINEAR)
        flat = flatten(grey, self.options.flow.flatten_window)  # type: ignore[arg-type]
        return _Picture(grey, flat)  # type: ignore[arg-type]

    def _choose_points(self, picture: _Picture, mask: NDArray[np.uint8], view: View) -> BoundPoints:
        corners = spread_corners(picture.flat, mask, self.options.n_points)
        surface, _ = bind_pixels(self._drawn, self.camera, view, corners)
        if len(surface) < 2 * (len(self.model.parameters) + 6):
            raise RegistrationError(
                f"the object shows only {len(surface)} corners in the reference frame, too few to follow it: "
                "take a sharper reference frame, or give the object a printed texture"
            )
        return BoundPoints.from_surface(self.model, surface)
