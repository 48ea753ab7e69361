"""The result of a frame from what was estimated in it: status, deviations with all known errors, and warnings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from morph_dslam.model import ReducedModel
from morph_dslam.model.model_errors import ModelErrors
from morph_dslam.registration.registration import PosePrior
from morph_dslam.tracking.displacement_jumps import DisplacementJump, largest_jump
from morph_dslam.tracking.estimator import Estimate
from morph_dslam.tracking.flat_sides import FlatSides
from morph_dslam.tracking.hypothesis import PoseHypothesis
from morph_dslam.tracking.known_check import refuted_values
from morph_dslam.tracking.motion_blur import path_length
from morph_dslam.tracking.outcomes import (
    BlurredByMotion,
    CameraLost,
    FewPointsAgree,
    ModelDoesNotExplain,
    ObjectMoved,
    OtherReferenceView,
    PastForgotten,
    PoseSource,
    ReferenceBlurred,
    ReferenceWidened,
    Rejection,
    Status,
    SurfaceJumps,
    TiltAmbiguous,
    TrackingWarning,
)
from morph_dslam.tracking.range_limits import cut_down, mean_squares_in_ranges
from morph_dslam.tracking.reference_misfit import CLEARLY_WORSE
from morph_dslam.tracking.result import FrameResult
from morph_dslam.tracking.sequence_filter import SequenceFilter
from morph_dslam.tracking.views import ActiveView

#: The mirrored tilt is named where it is at least as probable as this, and the object turned by more, rad.
LIKELY_TILT, MUCH_TILTED = 0.05, np.radians(5.0)


def warnings_of_place(
    has_moved: bool, jumps: Sequence[DisplacementJump], view: int, why_lost: str
) -> list[TrackingWarning]:
    """What is to be said of where an object is, whether it is tracked or lost.

    Parameters
    ----------
    has_moved : whether it has left its place in the map.
    jumps : where its surface was found open.
    view : number of the reference view, 0 for the first one.
    why_lost : why the camera is lost; empty if it is not.
    """
    warnings: list[TrackingWarning] = [ObjectMoved()] if has_moved else []
    if jumps:
        warnings.append(SurfaceJumps(largest_jump(jumps).text))
    if view:
        warnings.append(OtherReferenceView(view))
    if why_lost:
        warnings.append(CameraLost(why_lost))
    return warnings


def lost_result(
    model: ReducedModel,
    hypothesis: PoseHypothesis,
    rejection: Rejection,
    placed: PosePrior | None,
    warnings: Sequence[TrackingWarning],
) -> FrameResult:
    """The result of a frame in which a hypothesis is rejected: hidden where the map has the pose, or else lost.

    Parameters
    ----------
    model : of the object.
    hypothesis : that is rejected.
    rejection : why.
    placed : the pose by the map, if it is known.
    warnings : of the frame.
    """
    is_hidden, (n_points, n_inliers) = placed is not None, hypothesis.counts
    return FrameResult(
        model,
        Status.HIDDEN if is_hidden else Status.LOST,
        rejection=rejection,
        warnings=tuple(warnings),
        pose_from=PoseSource.MAP if is_hidden else PoseSource.NONE,
        pose_prior=placed,
        n_points=n_points,
        n_inliers=n_inliers,
    )


def tracked_result(
    model: ReducedModel,
    hypothesis: PoseHypothesis,
    view: ActiveView,
    past: SequenceFilter,
    warnings: Sequence[TrackingWarning],
    errors: ModelErrors | None = None,
) -> FrameResult:
    """The result of a frame with an accepted hypothesis.

    Parameters
    ----------
    model : of the object.
    hypothesis : that is accepted.
    view : that the frame was compared with.
    past : what earlier frames tell.
    warnings : of where the object is.
    errors : of the model's mesh and reduction; None where none are known.
    """
    estimate, unexplained_px, more = _with_systematic_errors(hypothesis, view, past, errors)
    if hypothesis.depth_unused is not None:
        more.append(hypothesis.depth_unused)
    if (tilt := hypothesis.other_tilt) is not None:
        estimate = replace(estimate, covariance=estimate.covariance + tilt.spread)
        if tilt.probability > LIKELY_TILT and tilt.angle > MUCH_TILTED:
            more.append(TiltAmbiguous(tilt.probability, float(np.degrees(tilt.angle))))
    residuals, (n_points, n_inliers) = hypothesis.estimate.residuals[hypothesis.supporting], hypothesis.counts
    return FrameResult(
        model,
        Status.TRACKED,
        estimate,
        warnings=(*warnings, *more),
        by_outline=hypothesis.outline_alone,
        few_corners=view.reference.few_corners,
        n_points=n_points,
        n_inliers=n_inliers,
        residual_rms_px=float(np.sqrt(np.mean(np.sum(residuals**2, axis=1)))),
        unexplained_px=unexplained_px,
        reference_factor=1.0 if view.systematic is None else view.systematic.reference_factor,
        discrepancy=hypothesis.discrepancy,
    )


def _with_systematic_errors(
    hypothesis: PoseHypothesis, view: ActiveView, past: SequenceFilter, errors: ModelErrors | None
) -> tuple[Estimate, float, list[TrackingWarning]]:
    """The estimate with errors that do not average out in its covariance, and what that says of it."""
    systematic, recovery, beside = view.systematic, view.recovery, view.estimation.beside
    if systematic is None:  # what is measured refers to no other image
        left = view.estimation.alone.left(hypothesis)
        return hypothesis.estimate, left.px, [ModelDoesNotExplain(left.px)] if left.is_failure else []
    left = systematic.unexplained(hypothesis.estimate, hypothesis.inliers)
    doubt_px, blurred = recovery.doubt(hypothesis), hypothesis.blurred
    # Of points beside something that hides others, or of others that look alike, residuals are not the object's.
    is_its_own = not (recovery.partly_hidden(hypothesis) or recovery.is_loose(hypothesis))
    # What is found on a blurred path errs with the texture: all that is left may be alike for neighbours.
    common_px = max(left.px, doubt_px if blurred is None else left.total_px)
    known = (past.past_information, past.keeps)
    refuted = refuted_values(hypothesis, beside, systematic, errors, doubt_px, is_its_own)
    # Learned from the images alone.
    learns = is_its_own and blurred is None and not len(beside.estimator.known.indices)
    found, prior = hypothesis.estimate, hypothesis.prior
    of_outline, whole = (of(hypothesis, found.state) for of in (beside.hessian_of_outline, beside.whole_outline))
    others = hypothesis.corrected_depths, of_outline, hypothesis.correction, whole
    estimate = systematic.added(found, hypothesis.weights, common_px, prior, learns, *known, blurred, *others)
    warnings: list[TrackingWarning] = [*refuted, *([PastForgotten()] if past.forgot else [])]
    if blurred is not None:
        warnings.append(BlurredByMotion(path_length(blurred[hypothesis.inliers])))
    elif doubt_px:
        warnings.append(FewPointsAgree(hypothesis.estimate.sigma_px))
    if hypothesis.reference_blur_px:
        warnings.append(ReferenceBlurred(hypothesis.reference_blur_px))
    beyond = systematic.beyond_reference
    if left.is_failure or (beyond is not None and beyond.is_failure):
        shift_px = systematic.common_shift(hypothesis.estimate, hypothesis.weights)
        warnings.append(ModelDoesNotExplain(left.px, shift_px))
    if systematic.reference_factor > CLEARLY_WORSE:
        warnings.append(ReferenceWidened(systematic.reference_factor))
    return estimate, left.px, warnings


def with_model_errors(
    result: FrameResult, errors: ModelErrors | None, held: NDArray[np.float64] | None = None
) -> FrameResult:
    """The result with the errors of the model's mesh and of its reduction in its deviations.

    They are the same in frames alike, so that they weigh no frame against another: only results have them. A parameter
    that a sensor tells makes them good by the images' share in it, and the other unknowns by what it leaves. For a
    change e of the parameters that the images ask for, the estimate moves by e - ``held`` e: the parameters err by
    that, shape and pose by the rest, -``held`` e.

    Parameters
    ----------
    result : of a frame.
    errors : of its model; None where none are known.
    held : (d + 6, d) the change of the unknowns that something else than the images keeps from them, for each change of
        the parameters; None where the images alone tell.
    """
    estimate = result.estimate
    if errors is None or estimate is None:
        return result
    mu, covariance = estimate.state.parameters, estimate.covariance.copy()
    d, made_good, of_shape = len(mu), np.eye(len(covariance), len(mu)), estimate.covariance
    sought, by_model = np.diag(covariance)[:d] > 0.0, errors.at(mu)
    seen = np.outer(sought, sought)
    by_mesh, by_reduction = seen * by_model.by_mesh, seen * by_model.by_reduction
    if held is not None:
        of_shape = of_shape + held @ (by_mesh + by_reduction) @ held.T
        covariance[d:, d:] += held[d:] @ by_mesh @ held[d:].T
        # The mesh's error is that of other states, where the other parameters make good what they do in these.
        known = np.flatnonzero(held.any(axis=0))
        by_mesh = seen * errors.holding(known, held[np.ix_(known, known)]).at(mu).by_mesh
        made_good = made_good - held
    of_reduction = made_good @ by_reduction @ made_good.T
    by_model = replace(by_model, by_mesh=by_mesh, by_reduction=of_reduction[:d, :d])
    covariance += of_reduction
    covariance[:d, :d] += by_mesh
    found = replace(estimate, covariance=covariance, by_model=by_model, of_shape=of_shape)
    return replace(result, estimate=found)


def with_flat_sides(result: FrameResult, sides: FlatSides) -> FrameResult:
    """The result with wider deviations of parameters that change nothing on one side, see `flat_sides`.

    Parameters
    ----------
    result : of a frame, with all errors in its deviations.
    sides : of its model.
    """
    estimate = result.estimate
    if estimate is None or (flat := sides.variances(estimate.state.parameters, estimate.parameter_std)) is None:
        return result
    return replace(result, estimate=replace(estimate, flat=flat))


def within_ranges(result: FrameResult) -> FrameResult:
    """The result with no larger deviation of a parameter than its range allows, see `range_limits`.

    What is observable goes by the deviations without it: they stay in ``measured_covariance``.

    Parameters
    ----------
    result : of a frame, with all errors in its deviations.
    """
    estimate = result.estimate
    if estimate is None:
        return result
    limits = mean_squares_in_ranges(result.model, estimate.state.parameters)
    covariance, of_shape = cut_down(estimate.covariance, limits), estimate.of_shape
    of_shape = None if of_shape is None else cut_down(of_shape, limits)
    measured, flat = estimate.measured_covariance, estimate.flat
    is_cut = covariance is not estimate.covariance or of_shape is not estimate.of_shape
    if is_cut and measured is None:
        measured = estimate.image_covariance
    if flat is not None:
        flat = np.minimum(flat, np.maximum(limits - np.diag(covariance)[: len(flat)], 0.0))
    found = replace(estimate, covariance=covariance, measured_covariance=measured, of_shape=of_shape, flat=flat)
    return replace(result, estimate=found)


def pose_source(hypothesis: PoseHypothesis, still: bool) -> PoseSource:
    """Where an accepted hypothesis has its pose from; ``still`` where one pose holds over the sequence."""
    if still:
        return PoseSource.SEQUENCE
    if hypothesis.outline_alone:
        return PoseSource.OUTLINE if hypothesis.prior is None else PoseSource.OUTLINE_AND_MAP
    return PoseSource.POINTS if hypothesis.prior is None else PoseSource.POINTS_AND_MAP
