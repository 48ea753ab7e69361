"""The reference views of a tracked object: keyframes of a scan, and frames that become views while tracking.

All that is measured against a view is bound by the state in its image, so both must be good: the points agree
closely and nearly all of them, the surface's place is known, and the image is sharp.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from morph_dslam.errors import RegistrationError
from morph_dslam.registration.registration import Registration
from morph_dslam.slam.rigid_map import Keyframe
from morph_dslam.timing import stage
from morph_dslam.tracking.binding import DrawnSurface, draw_view, view_of
from morph_dslam.tracking.depth_scale import CommonDepthScale
from morph_dslam.tracking.estimator import Estimate, Estimator, State
from morph_dslam.tracking.frame_estimation import FrameEstimation
from morph_dslam.tracking.hypothesis import Image, PoseHypothesis, reject
from morph_dslam.tracking.measurement import PATCH_HALF, PATCH_WINDOW, Rendering
from morph_dslam.tracking.observability import position_std
from morph_dslam.tracking.options import TrackerOptions
from morph_dslam.tracking.patches import normalize_contrast
from morph_dslam.tracking.recovery import Recovery
from morph_dslam.tracking.reference import PosedImage, ReferenceView, SurfaceSamples, choose_view, covered_share
from morph_dslam.tracking.reference_factors import error_factors_of
from morph_dslam.tracking.reference_misfit import UNEXPLAINED_PX
from morph_dslam.tracking.sequence_filter import PointChange
from morph_dslam.tracking.systematic_errors import SystematicErrors

Array = NDArray[np.float64]
#: Share of the visible points that must agree, and the largest robust spread of their residuals, pixels.
LEAST_AGREEING, LARGEST_SIGMA_PX = 0.6, 1.0
#: Largest standard deviation of the surface's position, root mean square, as a share of the object's size.
LARGEST_SPREAD = 0.05
#: An image whose edges are so much softer than those of the view it is compared with is blurred.
LEAST_SHARPNESS = 0.8
#: Around points that disagree something else may be in front of the object; so far, pixels, nothing is bound.
KEEP_OFF_PX = 12
#: How far the filters look that measure sharpness, pixels.
REACH_PX = 8


def surface_spread(samples: SurfaceSamples, stated: Estimate) -> float:
    """Root mean square standard deviation of the surface's position, metres."""
    return float(np.sqrt(np.mean(position_std(samples.model, stated) ** 2)))


def is_known_well(attempt: PoseHypothesis, spread: float, unexplained_px: float, options: TrackerOptions) -> bool:
    """Whether the state in a frame is known well enough for a reference view.

    Parameters
    ----------
    spread : see `surface_spread`, of the estimate with all errors, as a share of the object's size.
    unexplained_px : what the model leaves of the residuals.
    """
    agreeing, visible = int(attempt.inliers.sum()), int(attempt.measurement.visible.sum())
    if agreeing < max(options.least_inliers, LEAST_AGREEING * visible):
        return False
    if not attempt.estimate.sigma_px < LARGEST_SIGMA_PX or not unexplained_px < UNEXPLAINED_PX:
        return False
    return spread < LARGEST_SPREAD


def is_sharp(picture: Image, attempt: PoseHypothesis, view: ReferenceView, half: int) -> bool:
    """Whether a frame is as sharp as the view that it was compared with, where its points have that view's texture.

    Parameters
    ----------
    attempt : made against ``view``.
    half : of the side of the squares about points in which sharpness is compared, pixels.
    """
    near = around(picture, attempt.measurement.pixels[attempt.inliers], half)
    should_be = view.rendered(attempt.points_state)
    return sharpness(picture.normalized, near) > LEAST_SHARPNESS * sharpness(should_be.image, near)


def seen_part(picture: Image, attempt: PoseHypothesis, should_be: Rendering, view: ReferenceView) -> NDArray[np.bool_]:
    """Pixels (h, w) that show the object, and where nothing else may be before it.

    Parameters
    ----------
    attempt : made against ``view``.
    should_be : that view in the state of the attempt.
    """
    disagree = attempt.measurement.visible & ~attempt.inliers
    seen = np.isfinite(should_be.depth)
    seen &= ~around(picture, view.projected(attempt.estimate.state)[disagree], KEEP_OFF_PX)
    if picture.occluder_depth is not None:
        seen &= picture.occluder_depth >= should_be.depth
    return seen


def sharpness(normalized: NDArray[np.uint8], where: NDArray[np.bool_]) -> float:
    """Squared slope of an image (h, w) over its variance ``where`` (h, w): blur lowers it, light does not."""
    if not where.any():
        return 0.0
    normalized, where = _cut_out(normalized, where)
    smooth = cv2.GaussianBlur(normalized, (0, 0), 1.0).astype(np.float32)
    x, y = (cv2.Sobel(smooth, cv2.CV_32F, *order) / 8.0 for order in ((1, 0), (0, 1)))
    return float(np.mean((x**2 + y**2)[where]) / max(float(np.var(smooth[where])), 1e-6))


def _cut_out(normalized: NDArray[np.uint8], where: NDArray[np.bool_]) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """The part of both (h, w) that holds all of ``where``, with as much around it as filters reach."""
    left, top, width, height = cv2.boundingRect(where.astype(np.uint8))
    rows = slice(max(top - REACH_PX, 0), top + height + REACH_PX)
    columns = slice(max(left - REACH_PX, 0), left + width + REACH_PX)
    return np.ascontiguousarray(normalized[rows, columns]), where[rows, columns]


def around(picture: Image, pixels: Array, half: int) -> NDArray[np.bool_]:
    """Pixels (h, w) in squares about points (p, 2)."""
    height, width = picture.normalized.shape[:2]
    marks = np.zeros((height, width), np.uint8)
    places = np.rint(pixels).astype(np.int64).reshape(-1, 2)
    columns, rows = places[:, 0], places[:, 1]
    inside = (columns >= 0) & (columns < width) & (rows >= 0) & (rows < height)
    marks[rows[inside], columns[inside]] = 1
    return cv2.dilate(marks, np.ones((2 * half + 1,) * 2, np.uint8)) > 0


#: Another picture is taken as long as it adds this share of what all of them show, and at most so many are.
LEAST_GAIN, MOST_FURTHER = 0.03, 5


@dataclass(frozen=True)
class KeyframeViews:
    """Other pictures of the object than the first.

    Attributes
    ----------
    error_factors : (d + 6, c) of the first view, as in `PosedImage`; those of all are the same.
    """

    error_factors: Array | None
    views: tuple[PosedImage, ...] = ()


def registered_keyframes(registration: Registration) -> dict[int, Keyframe]:
    """The keyframes of the scene by frame, if that of the registration can be the reference view.

    Keyframes have contrast-normalized images only.
    """
    if registration.scene is None:
        return {}
    return {keyframe.index: keyframe for keyframe in registration.scene.keyframes}


def image_of(keyframe: Keyframe) -> Image:
    """A keyframe's image as a tracker takes it."""
    return Image(keyframe.normalized, keyframe.normalized)


def registered_images(registration: Registration, images: Mapping[int, Image]) -> list[PosedImage]:
    """The undeformed object in keyframes of the map, that of the registration first.

    Parameters
    ----------
    registration : in the map.
    images : of keyframes, by frame; others are left out.
    """
    model, found = registration.model, []
    for view in registration.views:
        if view.frame in images and view.error_factors is not None:
            state = State(model.default, view.pose)
            exact = np.zeros((len(model.parameters), view.error_factors.shape[1]))
            factors = np.vstack([exact, view.error_factors])
            found.append(PosedImage(images[view.frame], state, factors, frame=view.frame))
    return found


def choose_keyframe_views(
    estimator: Estimator, first: PosedImage, others: Sequence[PosedImage], options: TrackerOptions
) -> KeyframeViews:
    """What to take beside the first view; nothing where the object shows too few corners in it."""
    chosen = _most_shown(estimator, [first, *others])
    try:
        agreed = _agreed(estimator, [first, *(others[k] for k in chosen)], [first, *others], options)
    except RegistrationError:
        agreed = [first]
    return KeyframeViews(first.error_factors, tuple(agreed[1:]))


def _most_shown(estimator: Estimator, views: Sequence[PosedImage]) -> list[int]:
    """Indices into ``views`` without the first, which is taken anyway; those that show most first."""
    drawn = DrawnSurface.of(estimator.model)
    surface, samples = drawn.model, SurfaceSamples(estimator, drawn)
    meshes = [view_of(surface, estimator.camera, view.state) for view in views]
    depths = [
        view.shown(draw_view(mesh, surface.triangles, estimator.camera))[1]
        for view, mesh in zip(views, meshes, strict=True)
    ]
    areas = np.abs([samples.seen(view.state, depth) for view, depth in zip(views, depths, strict=True)])
    # Of each sample the share of what the best picture shows of it.
    shares = areas / np.maximum(areas.max(axis=0), 1e-300)
    chosen, shown, possible = [], shares[0], shares.max(axis=0).sum()
    while len(chosen) < min(MOST_FURTHER, len(views) - 1) and possible > 0.0:
        gains = np.maximum(shares - shown, 0.0).sum(axis=1) / possible
        best = int(gains.argmax())
        if gains[best] < LEAST_GAIN:
            break
        chosen.append(best - 1)
        shown = np.maximum(shown, shares[best])
    return chosen


def _agreed(
    estimator: Estimator, views: Sequence[PosedImage], pictures: Sequence[PosedImage], options: TrackerOptions
) -> list[PosedImage]:
    """The views, each with what other ``pictures`` agree with in ``seen``."""
    reference = ReferenceView(estimator, views, options)
    if reference.outline_alone:
        return [views[0]]
    agreed = np.zeros((len(pictures), len(reference.points)), dtype=bool)
    for row, picture in enumerate(pictures):
        agreed[row] = reference.measure(_as_frame(picture), picture.state, None).valid
    result = [views[0]]
    for view, part in zip(views[1:], reference.parts[1:], strict=True):
        rows = [row for row, picture in enumerate(pictures) if picture is not view]
        alone = ~agreed[rows][:, part.rows].any(axis=0)
        if alone.all():
            continue
        places = estimator.camera.project(reference.points.in_camera(view.state)[part.rows][alone])
        seen = reference.covered(view.state) & ~around(view.picture, places, KEEP_OFF_PX)
        result.append(replace(view, seen=seen if view.seen is None else view.seen & seen))
    return result


def _as_frame(view: PosedImage) -> Image:
    """A view's picture, to be measured in; points do not count where something is before the object."""
    if view.seen is None:
        return view.picture
    return replace(view.picture, occluder_depth=np.where(view.seen, np.float32(np.inf), np.float32(0.0)))


#: The views are compared in every so many frames: the surface turns by a few degrees meanwhile.
CHECK_EVERY = 3
#: After a frame that showed too few corners for a view, so many are not tried.
PAUSE = 15
#: In a made view points do not count where the surface is seen flatter than in the view, by this factor of
#: its area or a smaller one: patches are compared worst there, and another part, broad in both, tells enough.
MADE_BROADNESS = 0.3


@dataclass(frozen=True)
class ActiveView:
    """A reference view and what works with it.

    Attributes
    ----------
    number : 0 for the first, in the order in which they were made.
    error : root mean square standard deviation of the surface in its state, metres; 0 for the first, which
        all others are made from.
    """

    number: int
    reference: ReferenceView
    estimation: FrameEstimation
    recovery: Recovery
    systematic: SystematicErrors | None
    error: float = 0.0

    @classmethod
    def of(
        cls,
        reference: ReferenceView,
        estimator: Estimator,
        options: TrackerOptions,
        number: int = 0,
        error: float = 0.0,
        scale: CommonDepthScale | None = None,
        with_outline: Array | None = None,
    ) -> ActiveView:
        """A view that is to be followed from now on, with these numbers.

        ``scale`` is that of the depths, ``with_outline`` as of `SystematicErrors`.
        """
        estimation = FrameEstimation(estimator, reference, options)
        recovery = Recovery(estimator.model, estimator.camera, reference, estimation, options)
        systematic = None
        if not reference.outline_alone:
            still, parts = options.pose == "still" and not number, reference.parts
            systematic = SystematicErrors(estimator, reference.points, parts, PATCH_WINDOW, still, scale, with_outline)
        return cls(number, reference, estimation, recovery, systematic, error)


@dataclass(frozen=True)
class Change:
    """Another view to go on with.

    Attributes
    ----------
    supported : (p,) which of its points to follow from this frame on.
    pixels : (p, 2) where they are.
    is_new : whether it was followed never before.
    by_points : the frame's state by its points alone; None where nothing tells it, or it is the one that was found.
    """

    view: ActiveView
    supported: NDArray[np.bool_]
    pixels: Array
    is_new: bool = False
    by_points: State | None = None


@dataclass(frozen=True)
class _BegunView:
    """A view that the last frame became, not yet followed: together that would hold up one frame for long.

    Attributes
    ----------
    error : as in `ActiveView`.
    seen : of `SurfaceSamples` in it.
    scale : of the depths, with how far its state's error is theirs; None without them.
    with_outline : as of `SystematicErrors`; None where nothing tells of it.
    """

    reference: ReferenceView
    error: float
    seen: Array
    scale: CommonDepthScale | None
    with_outline: Array | None


class ViewSet:
    """Keeps the views and says which one to follow.

    A view serves as long as it shows most of the surface that is seen. When none does, a frame that is fit for
    it becomes a view in its estimated state. That state's covariance holds the error of the view that it was
    found by, and enters whatever is found by the new view, so errors add up from view to view and are stated.
    Views are kept; an earlier one is gone back to as soon as it serves again, and takes the later ones' errors
    away.

    Parameters
    ----------
    reference : the first view.
    scale : of the depths; None without them.

    Attributes
    ----------
    active : the view that frames are compared with; whoever follows the object changes it.
    """

    def __init__(
        self,
        estimator: Estimator,
        reference: ReferenceView,
        options: TrackerOptions,
        scale: CommonDepthScale | None = None,
    ) -> None:
        self._estimator, self._options, self._scale = estimator, options, scale
        self._size = float(np.linalg.norm(np.ptp(estimator.model.nodes, axis=0)))
        self._samples = SurfaceSamples(estimator, reference.surface)
        self.active = ActiveView.of(reference, estimator, options, scale=scale)
        self._kept, self._seen = [self.active], [reference.shown(self._samples)]
        self._n_made, self._n_frames, self._pause = 0, 0, 0
        self._followed = self.active
        self._begun: _BegunView | None = None
        if not reference.outline_alone:
            self.active.reference.take_features()

    def point_change(self, taken: ActiveView, besides: Array) -> PointChange:
        """What the filter must know when ``taken`` is gone over to; ``besides``: see `PointChange`."""
        left = self.active.reference
        kept = [view.number for view in self._kept]
        count = len(taken.reference.all_points)
        return PointChange(self.active.number, taken.number, left.correlation, count, kept, besides)

    def after_tracked(
        self, picture: Image, attempt: PoseHypothesis, stated: Estimate, unexplained_px: float
    ) -> Change | None:
        """What to go on with after a frame in which the object was followed; None if nothing changes.

        Parameters
        ----------
        attempt : made against the active view.
        stated : its estimate with all errors in its covariance.
        unexplained_px : see `new_view.is_known_well`.
        """
        self._n_frames, self._pause = self._n_frames + 1, max(self._pause - 1, 0)
        if not self._options.makes_views or self.active.reference.outline_alone:
            return None
        if self._begun is not None or self._n_frames % CHECK_EVERY:
            with stage("views"):
                return self._gone_on(stated.state)
        with stage("views"):
            assert attempt.measurement.drawing is not None
            now = self._samples.seen(stated.state, attempt.measurement.drawing.depth)
            shares = [covered_share(now, seen) for seen in self._seen]
        active, errors = self._kept.index(self.active), [view.error for view in self._kept]
        while (chosen := choose_view(shares, errors, active)) is not None:
            if chosen == active:
                return None
            change = self._tried(self._kept[chosen], picture, attempt)
            if change is not None:
                return change
            shares[chosen] = 0.0
        with stage("views"):
            self._begun = self._begin(picture, attempt, stated, unexplained_px, now)
        return None

    def after_recovered(self) -> None:
        """Leave a begun view: it would be gone over to unchecked, and the object may be anywhere since."""
        self._begun = None

    def after_lost(self, n_lost: int) -> Change | None:
        """The view to look for the object with next: that which was followed last and another in turn.

        ``n_lost`` : frames on end in which it was lost.
        """
        if n_lost == 1:
            self._followed = self.active
        others = [view for view in self._kept if view is not self._followed]
        looks_elsewhere = bool(others) and n_lost % 2 == 0
        view = others[(n_lost // 2 - 1) % len(others)] if looks_elsewhere else self._followed
        if view is self.active:
            return None
        count = len(view.reference.points)
        return Change(view, np.ones(count, dtype=bool), view.reference.pixels)

    def _tried(self, view: ActiveView, picture: Image, attempt: PoseHypothesis) -> Change | None:
        """A change to a view that is kept, if the frame agrees with it."""
        if picture.motion is not None:  # what other points were off by is none of its points'
            picture = replace(picture, motion=replace(picture.motion, by_points=()))
        found = view.estimation.correct(picture, attempt.estimate.state, None, attempt.prior)
        if reject(found, self._options) is not None:
            return None
        state = found.estimate.state
        places = view.reference.projected(state)
        pixels = np.where(found.inliers[:, None], found.measurement.recorded, places)
        return Change(view, found.inliers, pixels, by_points=state)

    def _begin(
        self, picture: Image, attempt: PoseHypothesis, stated: Estimate, unexplained_px: float, now: Array
    ) -> _BegunView | None:
        """A view made from the frame, if it is fit for one."""
        old = self.active.reference
        if self._pause:
            return None
        spread = surface_spread(self._samples, stated)
        estimator, options, surface = self._estimator, self._options, old.surface
        if not is_known_well(attempt, spread / self._size, unexplained_px, options):
            return None
        picture = self._of_one_instant(picture, stated.state)
        if not is_sharp(picture, attempt, old, PATCH_HALF):
            return None
        seen = seen_part(picture, attempt, old.rendered(stated.state), old)
        try:
            error_factors = error_factors_of(stated.covariance, estimator.scale)
            view = PosedImage(picture, stated.state, error_factors, seen, attempt.discrepancy)
            made = ReferenceView(estimator, [view], options, surface, MADE_BROADNESS)
        except RegistrationError:
            self._pause = PAUSE
            return None
        scale, systematic = self._scale, self.active.systematic
        if scale is not None and systematic is not None:
            scale = replace(scale, with_state=systematic.with_scale)
        return _BegunView(made, spread, now, scale, None if systematic is None else systematic.with_outline)

    def _of_one_instant(self, picture: Image, state: State) -> Image:
        """The picture as of the middle row's instant, around the object in ``state``."""
        if picture.motion is None:
            return picture
        grey = picture.motion.rectified(picture.grey, state, self.active.reference.points.in_camera(state))
        return replace(picture, grey=grey, normalized=normalize_contrast(grey))

    def _gone_on(self, state: State) -> Change | None:
        """A change to the view that was begun, the object being in ``state`` by now.

        The features, which only a lost object is looked for by, are taken in the frame after that.
        """
        begun, self._begun = self._begun, None
        if begun is None:
            self.active.reference.take_features()
            return None
        self._n_made += 1
        made_by = self._estimator, self._options, self._n_made
        view = ActiveView.of(begun.reference, *made_by, begun.error, begun.scale, begun.with_outline)
        self._kept.append(view)
        self._seen.append(begun.seen)
        if len(self._kept) > self._options.max_views:
            # The first view is what takes away the errors of all others.
            del self._kept[1], self._seen[1]
        places = begun.reference.projected(state)
        return Change(view, np.ones(len(places), dtype=bool), places, is_new=True)
