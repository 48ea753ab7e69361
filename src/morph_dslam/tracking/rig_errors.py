"""What the reference state and the model are off by, in estimates from several cameras."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from morph_dslam.tracking.depth import PointDepths
from morph_dslam.tracking.depth_scale import CommonDepthScale
from morph_dslam.tracking.estimator import Estimate, Prior
from morph_dslam.tracking.linearization import Linearization, inverse_of_seen
from morph_dslam.tracking.measurement import PATCH_WINDOW
from morph_dslam.tracking.noise import RigObservations
from morph_dslam.tracking.reference_correction import ReferenceCorrection
from morph_dslam.tracking.reference_misfit import Unexplained
from morph_dslam.tracking.rig import RigCamera
from morph_dslam.tracking.systematic_errors import SystematicErrors
from morph_dslam.tracking.tracker import Tracker

Array = NDArray[np.float64]


@dataclass(frozen=True)
class CameraView:
    """What one camera measured, about the common estimate.

    Attributes
    ----------
    chain : (d + 6, d + 6) from increments in the rig's frame to those in the camera's.
    systematic : errors of the camera's points.
    estimate : in the camera's frame, with the residuals of its texture's points only.
    weights : (p,) of these, zero for those that do not count.
    depths : (p,) of these, where a depth camera saw them.
    of_others : (d + 6, d + 6) in the camera's frame, what depths and an outline add to the Hessian.
    corrected : what of the reference's error the camera's points were corrected by; None where they were not.
    """

    chain: Array
    systematic: SystematicErrors
    estimate: Estimate
    weights: Array
    depths: PointDepths | None
    of_others: Array
    corrected: ReferenceCorrection | None

    @property
    def unexplained(self) -> Unexplained:
        """What the common estimate leaves of the camera's residuals.

        It has several causes: the model's error, the rig's calibration, and images that are not of one instant.
        """
        return self.systematic.unexplained(self.estimate, self.weights > 0.0)


class RigErrors:
    """Adds to covariances what the reference state, and the model, are off by.

    As for one camera (`systematic_errors`), an error e of the reference state enters each estimate through the
    points that were bound by it. Each camera sees e as C e, with C its chain from increments in the rig's frame
    to those in its own, so that the sum of C' J' W M J0 C over the cameras pushes the estimate. In other
    reference images of the undeformed object the same error factors make another e each. Where a camera's outline has
    corrected its points, or its depths have, what is left of the factors takes their place
    (`ReferenceCorrection.left_by_cause`). Its depths' scale is then one of these, in which no other camera has a part.
    What neighbouring points of a camera's image have in common in the residuals enters as for one camera, each
    camera's by itself.

    Parameters
    ----------
    trackers : by camera, each at its one reference view, which knows how its images are off by the error
        factors that are the same for all.
    cameras : of the rig.
    scales : by camera, of its depths. Each depth camera has a scale of its own.
    """

    def __init__(
        self, trackers: Sequence[Tracker], cameras: Sequence[RigCamera], scales: Sequence[CommonDepthScale]
    ) -> None:
        parts = [part for tracker in trackers for part in tracker.reference.parts]
        self._is_known = all(part.error_factors is not None for part in parts)
        self._trackers, self._cameras, self._scale = trackers, cameras, trackers[0].estimator.scale
        self._chains, self._depth_scales = [part.chain(len(self._scale) - 6) for part in cameras], scales
        self._systematic = [
            SystematicErrors(
                tracker.estimator, tracker.reference.points, tracker.reference.parts, PATCH_WINDOW, scale=scale
            )
            for tracker, scale in zip(trackers, scales, strict=True)
        ]  # fmt: skip

    def added(
        self,
        estimate: Estimate,
        views: Sequence[CameraView],
        prior: Prior | None,
        common_px: Sequence[float],
        blurred: Sequence[Array | None] | None = None,
        known: Array | None = None,
    ) -> Estimate:
        """The estimate with a covariance that holds both errors, that of motion blur, and those of the depths' scales.

        Parameters
        ----------
        estimate : a state in the rig's frame.
        views : what it was made from, as of `views`.
        prior : what was known of the frame's pose.
        common_px : by camera, what neighbours have in common in the residuals, as of `CameraView.unexplained`.
        blurred : by camera (p, 2), the paths over which motion smears the points, pixels; None where it does no harm,
            or for all.
        known : (d + 6, d + 6) what something else that measures parameters adds to the Hessian; None for nothing.
        """
        frames = [view.systematic.linearized(view.estimate, view.weights) for view in views]
        both = list(zip(views, frames, strict=True))
        hessian = np.sum([view.chain.T @ (frame.hessian + view.of_others) @ view.chain for view, frame in both], axis=0)
        if prior is not None:
            hessian = hessian + prior.terms(estimate.state)[1]
        if known is not None:
            hessian = hessian + known
        gain, covariance, stated = inverse_of_seen(hessian, self._scale), estimate.covariance, estimate.covariance
        for (view, frame), px, paths in zip(both, common_px, blurred or [None] * len(both), strict=True):
            moved = view.systematic.pushed_by_model(frame, view.chain, gain, px)
            covariance = covariance + moved @ moved.T
            if paths is not None:
                moved = view.systematic.pushed_by_blur(frame, view.chain, gain, paths)
                covariance = covariance + moved @ moved.T
        moved = self._moved_by_depths(hessian, views)
        covariance = covariance + moved @ moved.T
        if self._is_known:
            transfer = gain @ self._pushed_by_reference(both)
            covariance, stated = (part + transfer @ transfer.T for part in (covariance, stated))
        return replace(estimate, covariance=covariance, stated_covariance=stated)

    def _moved_by_depths(self, hessian: Array, views: Sequence[CameraView]) -> Array:
        """How the scale of each camera's depths moves the estimate (d + 6, k), to either side.

        By one deviation, and in squares by what the depths are seen to be off; that of depths by which the reference
        state was found, or which were corrected with it, is among its errors. Steps are finite, with what depths count
        there: the other cameras hold the estimate, so all depths of a camera whose scale is off are far from it, and
        Huber's cost lets them pull no more than they do.
        """
        moved = [np.empty((len(hessian), 0))]
        for scale, tracker, view in zip(self._depth_scales, self._trackers, views, strict=True):
            among_others = scale.in_reference or (self._is_known and view.corrected is not None)
            if view.depths is None or not scale.std or among_others:
                continue
            state, points = view.estimate.state, tracker.reference.points
            ratio = view.depths.ratio_to(points.in_camera(state)[:, 2])
            off = float(np.hypot(scale.std, 0.0 if ratio is None else ratio - 1.0))
            now = view.depths.terms(points, state)
            for factor in (1.0 + off, 1.0 / (1.0 + off)):
                then = view.depths.scaled(factor).terms(points, state)
                more = view.chain.T @ (then[1] - now[1]) @ view.chain
                step = inverse_of_seen(hessian + more, self._scale) @ view.chain.T @ (now[2] - then[2])
                moved.append(step[:, None] / np.sqrt(2.0))
        return np.concatenate(moved, axis=1)

    def _pushed_by_reference(self, views: Sequence[tuple[CameraView, Linearization]]) -> Array:
        """How the reference's error enters the gradient of all cameras (d + 6, k), by independent causes.

        Beyond the factors of the reference, a camera that was corrected has that of its depths' scale.

        Parameters
        ----------
        views : with the points about the estimate.
        """
        factors = self._trackers[0].reference.parts[0].error_factors
        assert factors is not None
        in_common, by_one = [], []
        for view, frame in views:
            push = view.chain.T @ view.systematic.pushed(frame, view.estimate.state, view.depths)
            if view.corrected is not None:
                push = push[:, : len(view.corrected.left)]
                of_factors, of_noise = view.corrected.left_by_cause()
                by_one += [push @ of_noise, push @ of_factors[:, factors.shape[1] :]]
                push = push @ of_factors
            in_common.append(push[:, : factors.shape[1]])
        return np.concatenate([np.sum(in_common, axis=0), *by_one], axis=1)

    def views(
        self,
        estimate: Estimate,
        measured: RigObservations,
        corrected: Sequence[ReferenceCorrection | None] | None = None,
    ) -> list[CameraView]:
        """What each camera measured, about an estimate, a state in the rig's frame, that was made from it.

        ``corrected`` : by camera as in `CameraView`; None for none.
        """
        views, corrections = [], corrected or [None] * len(self._cameras)
        for part, chain, systematic, tracker, view, residuals, correction in zip(
            self._cameras, self._chains, self._systematic, self._trackers, measured.views,
            measured.split(estimate.residuals), corrections, strict=True,
        ):  # fmt: skip
            points, state = tracker.reference.points, part.seen(estimate.state)
            count, others = len(points), np.arange(len(points), len(view.weights))
            outline = view.pixels[others], view.weights[others], state, view.normals[others]
            of_others = tracker.estimator.of_pixels(view.points.take(others), *outline)[1]
            depths = None if view.depths is None else view.depths.take(np.arange(count))
            if depths is not None:
                of_others = of_others + depths.terms(points, state)[1]
            seen = replace(estimate, state=state, residuals=residuals[:count])
            views.append(CameraView(chain, systematic, seen, view.weights[:count], depths, of_others, correction))
        return views
