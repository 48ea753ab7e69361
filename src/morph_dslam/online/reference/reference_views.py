"""The reference views of a tracked object: the first one, and those made while tracking.

A view serves as long as it shows most of the surface that is seen. When none does, a frame that is fit for it
becomes a view in its estimated state. That state's covariance holds the error of the view that it was found
by, and enters whatever is found by the new view, so errors add up from view to view and are stated. Views are
kept; an earlier one is gone back to as soon as it serves again, and takes the later ones' errors away.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from morph_dslam.errors import RegistrationError
from morph_dslam.online.attempt import Attempt, Picture, refusal
from morph_dslam.online.estimation.estimator import Estimate, Estimator, State
from morph_dslam.online.estimation.filter_memory import PointChange
from morph_dslam.online.frame_estimation import FrameEstimation
from morph_dslam.online.recovering.recovery import Recovery
from morph_dslam.online.reference.new_view import is_known_well, is_sharp, seen_part, surface_spread
from morph_dslam.online.reference.reference_view import KnownView, ReferenceView
from morph_dslam.online.reference.surface_coverage import SurfaceSamples, choose_view, covered_share
from morph_dslam.online.timing import StageClock
from morph_dslam.online.tracker_options import TrackerOptions
from morph_dslam.online.uncertainty.bound_part import causes_of
from morph_dslam.online.uncertainty.systematic_errors import SystematicErrors

Array = NDArray[np.float64]

#: The views are compared in every so many frames: the surface turns by a few degrees meanwhile.
CHECK_EVERY = 3
#: After a frame that showed too few corners for a view, so many are not tried.
PAUSE = 15
#: In a made view points do not count where the surface is seen flatter than in the view, by this factor of
#: its area or a smaller one: patches are compared worst there, and another part, broad in both, tells enough.
LEAST_BROADNESS = 0.3


@dataclass(frozen=True)
class FollowedView:
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
    systematic: SystematicErrors
    error: float = 0.0

    @classmethod
    def of(
        cls,
        reference: ReferenceView,
        estimator: Estimator,
        options: TrackerOptions,
        number: int = 0,
        error: float = 0.0,
    ) -> FollowedView:
        """A view that is to be followed from now on, with these numbers."""
        estimation = FrameEstimation(estimator, reference, options)
        recovery = Recovery(estimator.model, estimator.camera, reference, estimation, options)
        window = options.measurement.window
        systematic = SystematicErrors(estimator, reference.points, reference.parts, window)
        return cls(number, reference, estimation, recovery, systematic, error)


@dataclass(frozen=True)
class Change:
    """Another view to go on with.

    Attributes
    ----------
    supported : (p,) which of its points to follow from this frame on. pixels : (p, 2) where they are.
    is_new : whether it was followed never before.
    """

    view: FollowedView
    supported: NDArray[np.bool_]
    pixels: Array
    is_new: bool = False


@dataclass(frozen=True)
class _BegunView:
    """A view that the last frame became, not yet followed: together that would hold up one frame for long.

    Attributes
    ----------
    error : as in `FollowedView`. seen : of `SurfaceSamples` in it.
    """

    reference: ReferenceView
    error: float
    seen: Array


class ReferenceViews:
    """Keeps the views and says which one to follow.

    Parameters
    ----------
    reference : the first view.

    Attributes
    ----------
    active : the view that frames are compared with; whoever follows the object changes it.
    """

    def __init__(
        self,
        estimator: Estimator,
        reference: ReferenceView,
        options: TrackerOptions,
    ) -> None:
        self._estimator, self._options = estimator, options
        self._size = float(np.linalg.norm(np.ptp(estimator.model.nodes, axis=0)))
        self._samples = SurfaceSamples(estimator, reference.surface)
        self.active = FollowedView.of(reference, estimator, options)
        self._kept, self._seen = [self.active], [reference.shown(self._samples)]
        self._n_made, self._n_frames, self._pause = 0, 0, 0
        self._followed = self.active
        self._begun: _BegunView | None = None
        self.active.reference.take_features()

    def point_change(self, taken: FollowedView, besides: Array) -> PointChange:
        """What the filter must know when ``taken`` is gone over to; ``besides``: see `PointChange`."""
        left = self.active.reference
        kept = [view.number for view in self._kept]
        count = len(taken.reference.all_points)
        return PointChange(self.active.number, taken.number, left.correlation, count, kept, besides)

    def after_tracked(
        self,
        picture: Picture,
        attempt: Attempt,
        stated: Estimate,
        unexplained_px: float,
        clock: StageClock,
    ) -> Change | None:
        """What to go on with after a frame in which the object was followed; None if nothing changes.

        Parameters
        ----------
        attempt : made against the active view. stated : its estimate with all errors in its
            covariance. unexplained_px : see `new_view.is_known_well`.
        """
        self._n_frames, self._pause = self._n_frames + 1, max(self._pause - 1, 0)
        if not self._options.new_views:
            return None
        if self._begun is not None or self._n_frames % CHECK_EVERY:
            with clock.stage("views"):
                return self._gone_on(stated.state)
        with clock.stage("views"):
            assert attempt.measurement.depth is not None
            now = self._samples.seen(stated.state, attempt.measurement.depth)
            shares = [covered_share(now, seen) for seen in self._seen]
        active, errors = self._kept.index(self.active), [view.error for view in self._kept]
        while (chosen := choose_view(shares, errors, active)) is not None:
            if chosen == active:
                return None
            change = self._tried(self._kept[chosen], picture, attempt, clock)
            if change is not None:
                return change
            shares[chosen] = 0.0
        with clock.stage("views"):
            self._begun = self._begin(picture, attempt, stated, unexplained_px, now)
        return None

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

    def _tried(
        self, view: FollowedView, picture: Picture, attempt: Attempt, clock: StageClock
    ) -> Change | None:
        """A change to a view that is kept, if the frame agrees with it."""
        found = view.estimation.correct(picture, attempt.estimate.state, None, attempt.prior, clock)
        if refusal(found, self._options):
            return None
        places = view.reference.projected(found.estimate.state)
        return Change(view, found.inliers, np.where(found.inliers[:, None], found.measurement.pixels, places))

    def _begin(
        self, picture: Picture, attempt: Attempt, stated: Estimate, unexplained_px: float, now: Array
    ) -> _BegunView | None:
        """A view made from the frame, if it is fit for one."""
        old = self.active.reference
        if self._pause:
            return None
        spread = surface_spread(self._samples, stated)
        estimator, options, surface = self._estimator, self._options, old.surface
        if not is_known_well(attempt, spread / self._size, unexplained_px, options):
            return None
        should_be = old.rendered(stated.state)
        if not is_sharp(picture, attempt, should_be, options.measurement.patch_half):
            return None
        seen = seen_part(picture, attempt, should_be, old)
        try:
            causes = causes_of(stated.covariance, estimator.scale)
            view = KnownView(picture, stated.state, causes, seen, attempt.discrepancy)
            made = ReferenceView(estimator, [view], options, surface, LEAST_BROADNESS)
        except RegistrationError:
            self._pause = PAUSE
            return None
        return _BegunView(made, spread, now)

    def _gone_on(self, state: State) -> Change | None:
        """A change to the view that was begun, the object being in ``state`` by now.

        The features, which only a lost object is looked for by, are taken in the frame after that.
        """
        begun, self._begun = self._begun, None
        if begun is None:
            self.active.reference.take_features()
            return None
        self._n_made += 1
        view = FollowedView.of(begun.reference, self._estimator, self._options, self._n_made, begun.error)
        self._kept.append(view)
        self._seen.append(begun.seen)
        if len(self._kept) > self._options.max_views:
            # The first view is what takes away the errors of all others.
            del self._kept[1], self._seen[1]
        places = begun.reference.projected(state)
        return Change(view, np.ones(len(places), dtype=bool), places, is_new=True)
