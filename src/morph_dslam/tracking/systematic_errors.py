"""Errors that more points and more frames do not average out: of the reference state, and of the model.

The points were bound to the mesh in the reference view, so an error e of the object's state there moves their pixels
by -M J0 e in another view (`reference_factors`). The frame's estimate takes this for motion, H^-1 J' W M J0 e, to first
order; H is that of all that it was made from, depths and an outline too. Of points alone in the reference view itself
that is e. What it cannot take up stays in the residuals; where they show more of it than the stated covariance of e
explains, `ReferenceMisfit` says by how much that is too small.

A model that cannot take the object's shape leaves residuals that are alike over parts of the surface much
wider than the windows that are compared. Their covariance is measured from pairs of points whose windows do
not overlap, and enters the estimate through the same H^-1 J' W. An estimate takes up most of such an error by
a wrong pose and shape, so that its residuals show only the rest: what they show is divided by that share, as
in restricted maximum likelihood (Patterson & Thompson 1971).

Where earlier frames decide on an estimate too, with the information I, H is the sum of both, and the error T
of their estimate enters as H^-1 I T. Both errors are thus considered over all frames, as in Schmidt's filter.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from morph_dslam.tracking.covariance import BoundPart, SharedErrors
from morph_dslam.tracking.depth import PointDepths
from morph_dslam.tracking.depth_scale import CommonDepthScale
from morph_dslam.tracking.estimator import BoundPoints, Estimate, Estimator, Prior, State
from morph_dslam.tracking.linearization import Linearization, inverse_of_seen
from morph_dslam.tracking.reference_correction import PushedTexture, ReferenceCorrection
from morph_dslam.tracking.reference_factors import ReferenceFactors
from morph_dslam.tracking.reference_misfit import FLOOR_PX, BeyondReference, ReferenceMisfit, Unexplained
from morph_dslam.tracking.reprojection import project_with_jacobian

Array = NDArray[np.float64]


class SystematicErrors:
    """Adds to covariances what the reference and the model are off by.

    Parameters
    ----------
    estimator : of the model and the camera
    points : (p) the texture's points
    parts : the reference images that they were bound in
    window : side of the square that is compared around a point, pixels
    still : whether the reference view's pose is that of every frame, with the same error
    scale : of the depths, if a depth camera sees the points.
    with_outline : (d + 6, 3) covariance of the reference state's error with what outlines are off by as a whole, each
        in its deviation, where frames beside an outline have found that state; None where they have not.

    Attributes
    ----------
    beyond_reference : of the last frame; None where that does not tell, or the reference gets no blame.
    with_scale : (d + 6,) covariance of the error of the last frame that was kept with by what share all depths are too
        large, as far as the reference's error and the depths' scale make it.
    with_outline : (d + 6, 3) covariance of that error with what its outline was off by as a whole, each in its
        deviation: outwards, and in both directions.
    """

    def __init__(
        self,
        estimator: Estimator,
        points: BoundPoints,
        parts: Sequence[BoundPart],
        window: int,
        still: bool = False,
        scale: CommonDepthScale | None = None,
        with_outline: Array | None = None,
    ) -> None:
        self._estimator, self._points, self._still = estimator, points, still
        self._reference = ReferenceFactors(estimator, points, parts, scale or CommonDepthScale(), with_outline)
        self._told_by_depths = scale is None or scale.with_state is None
        self._misfit = ReferenceMisfit()
        self._common = SharedErrors(self._places(parts[0].state), window)
        self.beyond_reference: BeyondReference | None = None
        self.forget_frames()

    def _places(self, state: State) -> Array:
        """Places (p, 3) of the points in an object of this state, in pixels at its depth."""
        camera, positions = self._estimator.camera, self._points.in_camera(state)
        return np.asarray(positions * 0.5 * (camera.fx + camera.fy) / np.median(positions[:, 2]))

    def forget_frames(self) -> None:
        """The next estimate does not rest on earlier ones, or their errors are in its covariance already."""
        size = len(self._estimator.scale)
        self._by_reference = np.zeros((size, len(self._reference.shares)))
        self._by_outline, self.with_outline, self.with_scale = np.zeros((size, 3)), np.zeros((size, 3)), np.zeros(size)
        self._by_model = np.zeros((size, 2 * self._common.factor.shape[1]))
        self._corrected: ReferenceCorrection | None = None

    def unexplained(self, estimate: Estimate, used: NDArray[np.bool_]) -> Unexplained:
        """What the model leaves of the residuals of the points ``used`` (p,)."""
        residuals = np.where(used[:, None], estimate.residuals[: len(used)], 0.0)
        total = float(np.sum(residuals**2)) / max(2 * int(used.sum()), 1)
        common = float(self._common.in_common(residuals[:, :, None], self._common.n_pairs(used))[0, 0])
        return Unexplained(float(np.sqrt(max(common, 0.0))), float(np.sqrt(total)))

    def common_shift(self, estimate: Estimate, weights: Array) -> float:
        """The one shift of all points, pixels, that explains most of the residuals; 0 if none does.

        With it other parameters leave less than half of what they leave alone, and it is half as large as the residuals
        or larger. It is looked for where one pose holds over the sequence: a free one takes it up. ``weights`` (p,) are
        the points'.
        """
        if not self._still:
            return 0.0
        frame, d = self.linearized(estimate, weights), len(estimate.state.parameters)
        left = frame.residuals[frame.usable].ravel()
        by_parameters = (frame.jacobian * self._estimator.scale)[frame.usable, :, :d].reshape(-1, d)
        columns = np.column_stack([by_parameters, np.tile(np.eye(2), (len(left) // 2, 1))])
        alone = left - by_parameters @ np.linalg.lstsq(by_parameters, left)[0]
        found = np.linalg.lstsq(columns, left)[0]
        shift = float(np.linalg.norm(found[d:]))
        explained = np.linalg.norm(left - columns @ found) < 0.5 * np.linalg.norm(alone)
        return shift if explained and shift**2 * len(left) > 0.5 * float(left @ left) else 0.0

    @property
    def reference_factor(self) -> float:
        """By how much larger than stated the reference's deviation is, as the frames so far show it."""
        return float(np.sqrt(self._misfit.factor))

    def added(
        self,
        estimate: Estimate,
        weights: Array,
        common_px: float,
        prior: Prior | None = None,
        learns: bool = True,
        past_information: Array | None = None,
        keeps: bool = True,
        blurred: Array | None = None,
        depths: PointDepths | None = None,
        of_outline: Array | None = None,
        corrected: ReferenceCorrection | None = None,
        whole: Array | None = None,
    ) -> Estimate:
        """The estimate with a covariance that holds both errors, that of motion blur, and that of the depths' scale.

        Parameters
        ----------
        estimate : of a frame
        weights : (p,) of the points, zero for those that do not support it
        common_px : standard deviation of a pixel coordinate that neighbours have in common in the residuals,
            as of `unexplained`
        prior : what was known of the frame's pose
        learns : whether the residuals are the object's, so that they show how well the reference is known
        past_information : (d + 6, d + 6) with which earlier frames count in it; None where they do not
        keeps : whether later frames rest on it
        blurred : (p, 2) pixels, the paths over which motion smears the points; None where it does no harm.
        depths : (p,) of the points, where a depth camera saw them; None without one.
        of_outline : (d + 6, d + 6) the Hessian of an outline beside the points; None without one.
        corrected : what of the reference's error the points were corrected by; None where they were not.
        whole : (3, d + 6) how what that outline is off by as a whole enters the gradient, as of `LinearCost`. The
            estimate's covariance has it already, but not what it has in common with the reference's error.
        """
        frame = self.linearized(estimate, weights)
        past = np.zeros_like(estimate.covariance) if past_information is None else past_information
        others = np.zeros_like(past) if of_outline is None else of_outline
        if depths is not None:
            others = others + depths.terms(self._points, estimate.state)[1]
        hessian = frame.hessian + others + past + self._estimator.known_information(estimate.state.parameters)[0]
        if prior is not None:
            hessian = hessian + prior.terms(estimate.state)[1]
        gain, n_pairs = inverse_of_seen(hessian, self._estimator.scale), self._common.n_pairs(frame.usable)
        covariance, by_reference, self.beyond_reference = estimate.covariance.copy(), self._by_reference, None
        stated = estimate.covariance
        by_outline = with_outline = gain @ ((0.0 if whole is None else whole.T) + past @ self._by_outline)
        if self._reference.moved is not None:
            moved, left = self._reference.in_view(estimate.state), None if corrected is None else corrected.left
            push = self.pushed(frame, estimate.state, depths, moved)
            push = (push if left is None else push @ left) + past @ self._by_reference
            by_reference = self._moved_by(gain, push, frame.hessian + others)
            # A pose that is one over the sequence comes from all frames, with a covariance by what they leave.
            if learns and not self._still and self._reference.n_of_state:
                # The correction is along what the points alone take for motion: what they leave is the same.
                rest = frame.left(moved, by_reference if corrected is None else corrected.transfer)
                self.beyond_reference = self._beyond_reference(frame, rest, gain, n_pairs)
                self._learn_reference(frame, rest[:, :, : self._reference.n_of_state], n_pairs)
            widened = by_reference * self._widening
            covariance += widened @ widened.T
            stated = stated + by_reference @ by_reference.T
            if keeps:
                shares = self._reference.shares
                self.with_scale = widened @ (shares if left is None else left @ shares)
            shares = self._reference.with_outline if corrected is None else corrected.with_outline
            with_outline = by_outline + widened @ shares
            for total, part in ((covariance, widened), (stated, by_reference)):
                in_common = part @ shares @ by_outline.T
                total += in_common + in_common.T
        gradients = self._common.gradients(frame.weighted_jacobian)
        share = self._common.share_left(frame.usable, frame.jacobian, gradients, gain, n_pairs)
        by_model = gain @ (common_px / np.sqrt(share) * gradients.T + past @ self._by_model)
        covariance += by_model @ by_model.T
        if blurred is not None:
            by_blur = self.pushed_by_blur(frame, np.eye(len(gain)), gain, blurred)
            covariance += by_blur @ by_blur.T
        if keeps:
            self._by_reference, self._by_model, self._corrected = by_reference, by_model, corrected
            self._by_outline, self.with_outline = by_outline, with_outline
        return replace(estimate, covariance=covariance, stated_covariance=stated)

    def _moved_by(self, gain: Array, push: Array, hessian: Array) -> Array:
        """How the reference's error factors move an estimate (d + 6, c).

        ``hessian`` (d + 6, d + 6) is that of what the frame measured. The pose's error moves the points on the surface,
        and where that pose is one over the sequence, the object with them: both count together.
        """
        of_state = self._reference.of_state
        if not self._still or of_state is None:
            return gain @ push
        d = len(gain) - 6
        by_reference = gain @ (push - hessian[:, d:] @ of_state[d:])
        by_reference[d:] = of_state[d:]
        return by_reference

    @property
    def _widening(self) -> Array:
        """By how much larger than stated each error factor (c,) is: those of the reference alone, not the depths'."""
        widening = np.ones(len(self._reference.shares))
        widening[: self._reference.n_of_state] = self.reference_factor
        return widening

    def _learn_reference(self, frame: Linearization, left: Array, n_pairs: float) -> None:
        """Take in what a frame shows of the reference's error, which would leave ``left`` (p, 2, c) in it.

        ``n_pairs`` is as of `SharedErrors.n_pairs`, of the points that count.
        """
        both = np.concatenate([frame.residuals[:, :, None], left], axis=2)
        shown, *expected = np.diag(self._common.in_common(both, n_pairs))
        self._misfit.learn(float(shown), float(sum(expected)))

    def _beyond_reference(self, frame: Linearization, left: Array, gain: Array, n_pairs: float) -> BeyondReference:
        """What a frame shows that no error of the reference explains, errors of any size being fitted.

        Parameters
        ----------
        frame : about its estimate, with residuals r = (I - J gain J' W) r0.
        left : L (p, 2, c), what the errors leave of the motions of the pixels: they leave (I - L (L' W L)^-1 L' W) r.
        gain : (n, n) of the estimate.
        n_pairs : as of `SharedErrors.n_pairs`, of the points that count.
        """
        n, c = len(gain), left.shape[2]
        both, rows = frame.with_unknowns(left), frame.residuals[:, :, None]
        normal = both.products(left)[n:]
        sizes = np.sqrt(np.diag(normal))
        inverse = inverse_of_seen(normal, 1.0 / np.where(sizes > 0.0, sizes, 1.0))
        taken = np.zeros((n + c, n + c))
        taken[:n, :n], taken[n:, n:] = gain, inverse
        taken[n:, :n] = -inverse @ both.products(frame.jacobian)[n:] @ gain
        rest = rows - left @ (inverse @ both.products(rows)[n:])
        shown, common = np.diag(self._common.in_common(np.concatenate([rows, rest], axis=2), n_pairs))
        noise = max(float(np.sum(rows**2)) / max(2 * int(frame.usable.sum()), 1) - max(float(shown), 0.0), FLOOR_PX**2)
        gradients = self._common.gradients(both.weighted_jacobian)
        share = self._common.share_left(frame.usable, both.jacobian, gradients, taken, n_pairs)
        return BeyondReference(float(common), self._common.chance(noise, n_pairs), share, noise)

    def pushed(
        self, frame: Linearization, state: State, depths: PointDepths | None = None, moved: Array | None = None
    ) -> Array:
        """J' W M J0 times the error factors of the reference (d + 6, c): how its error enters a frame's estimate.

        With ``depths`` (p,) of the points, also how it enters by these; ``moved`` (p, 2, c) is how the factors move the
        points in the frame, if known.
        """
        moved = self._reference.in_view(state) if moved is None else moved
        by_pixels = frame.products(moved)
        if depths is None:
            return by_pixels
        of_depths = self._reference.pushed_depths(state, depths, moved)
        return by_pixels + of_depths.slopes.T @ of_depths.pushes

    @property
    def knows_reference(self) -> bool:
        """Whether the reference's error is known, and none of the pose that holds in all frames."""
        return self._reference.n_of_state > 0 and not self._still

    @property
    def told_by_depths(self) -> bool:
        """Whether depths tell of the reference's error: not of a state that frames with such depths have found.

        That is off by what these are off by, alike in further frames, of which only the scale is known.
        """
        return self.knows_reference and self._told_by_depths

    def pushed_texture(
        self, state: State, residuals: Array, weights: Array, depths: PointDepths | None = None
    ) -> PushedTexture:
        """The points in a frame, and how these alone take the reference's error for motion, where it is known.

        Parameters
        ----------
        state : of the frame, to linearise about.
        residuals : (p, 2) that it leaves of the points, pixels.
        weights : (p,) of these.
        depths : (p,) of these; None where no depth camera saw them.
        """
        frame = Linearization.of(self._project(state)[1], residuals, weights, self._estimator.options.huber_px)
        moved = self._reference.in_view(state)
        transfer = inverse_of_seen(frame.hessian, self._estimator.scale) @ frame.products(moved)
        of_depths = None if depths is None else self._reference.pushed_depths(state, depths, moved)
        return PushedTexture(frame, transfer, of_depths, self._reference.with_outline)

    def pushed_by_model(self, frame: Linearization, chain: Array, gain: Array, common_px: float) -> Array:
        """How an estimate from several cameras moves (n, c) by what the model is off in this one.

        Parameters
        ----------
        frame : what this camera measured.
        chain : (d + 6, n) from the common unknowns to this camera's
        gain : (n, n) H^-1 of all cameras together
        common_px : standard deviation of a pixel coordinate that neighbours have in common in the residuals
        """
        gradients = self._common.gradients(frame.weighted_jacobian @ chain)
        n_pairs = self._common.n_pairs(frame.usable)
        share = self._common.share_left(frame.usable, frame.jacobian @ chain, gradients, gain, n_pairs)
        return np.asarray(gain @ (common_px / np.sqrt(share) * gradients.T), dtype=np.float64)

    def pushed_by_blur(self, frame: Linearization, chain: Array, gain: Array, blurred: Array) -> Array:
        """How an estimate moves (n, r) by where on their paths the points were found in a picture that motion blurs.

        Any place on its path is as likely for a point as any other, and alike for neighbours.

        Parameters
        ----------
        frame, chain, gain : as in `pushed_by_model`.
        blurred : (p, 2) pixels, the paths.
        """
        along = np.einsum("pkn,pk->pn", frame.weighted_jacobian, blurred / np.sqrt(12.0)) @ chain
        return np.asarray(gain @ (self._common.factor.T @ along).T, dtype=np.float64)

    def deformation_errors(
        self, state: State, by_known: Array, of_model: Callable[[Array], tuple[Array, float]] | None
    ) -> Callable[[], Array]:
        """By how much what the deformation moves the pixels by (p, 2, c) may be off in the last frame that was kept.

        The columns are the error factors of the reference, in their deviations (of corrected points what is left of
        them, and what was made good), those of the model and the displacement's modes. Where nothing but the images
        tells of the parameters, these make the model's good. Few frames are asked: all is computed when one is.

        Parameters
        ----------
        state : of the frame.
        by_known : (d + 6, d + 6), as of `SequenceFilter`.
        of_model : at parameters (d,), changes of them (d, k) that move the surface as errors of the model do, SI, and
            what no parameters make good of the displacement, root mean square length, metres; None without.
        """
        by_reference = self._widening * self._by_reference
        return partial(self._of_deformation, state, by_reference, self._corrected, by_known, of_model)

    def _of_deformation(
        self,
        state: State,
        by_reference: Array,
        corrected: ReferenceCorrection | None,
        by_known: Array,
        of_model: Callable[[Array], tuple[Array, float]] | None,
    ) -> Array:
        changes, left = (np.zeros((0, 0)), 0.0) if of_model is None else of_model(state.parameters)
        modes, rows = self._points.field.modes, self._points.field.functions.rows(state.parameters)
        d, m = len(rows) - 1, len(modes)
        # Errors of any smooth shape, as likely one as the other: the modes are the shapes that the object takes.
        sizes = np.sqrt(m * np.mean(np.sum(modes.astype(np.float64) ** 2, axis=2), axis=1))
        by_modes = np.diag(left / np.where(sizes > 0.0, sizes, np.inf))
        all_columns = self._project(state, np.concatenate([rows, by_modes]))[1]
        all_columns[:, :, d + m :] -= self._project(state, 0.0 * rows)[1][:, :, d:]
        all_columns[~np.isfinite(all_columns).all(axis=(1, 2))] = 0.0
        by_state = np.delete(all_columns, np.s_[d : d + m], axis=2)
        of_reference = by_state @ by_reference
        if self._reference.moved is not None:
            slid = self.reference_factor * self._reference.by_deformation(state)
            if corrected is None:
                of_reference += slid
            else:
                # What is left of the reference's error has the state off. The points stay where all of it has put them.
                of_reference = np.concatenate(
                    [of_reference + slid @ corrected.left, slid @ corrected.made_good], axis=2
                )
        not_made_good = by_state @ by_known[:, : len(changes)] @ changes
        return np.concatenate([of_reference, not_made_good, all_columns[:, :, d : d + m]], axis=2)

    def linearized(self, estimate: Estimate, weights: Array) -> Linearization:
        """The frame of an estimate whose points had these ``weights`` (p,)."""
        _, jacobian = self._project(estimate.state)
        residuals, huber = estimate.residuals[: len(weights)], self._estimator.options.huber_px
        return Linearization.of(jacobian, residuals, weights, huber)

    def warped(self, state: State, moved: Array) -> Array:
        """How pixels move (p, 2) in the view of a state where they move by ``moved`` (p, 2) in the reference view."""
        return self._reference.warped(state, moved)

    def _project(self, state: State, rows: Array | None = None) -> tuple[Array, Array]:
        """Pixels (p, 2) and their derivatives, by other values and derivatives (1 + d, m) of the functions if given."""
        return project_with_jacobian(*self._points.in_state(state, rows), self._estimator.camera.intrinsics)
