"""Several objects in the same frames: each is tracked by itself, occludes what is behind it, and fills its place.

A point that another object's surface occludes does not count. In a frame the objects are drawn, each in the
state of this frame where it is known already, the nearest one first, and otherwise in that of the frame before,
moved to where the map has it in this frame if it is anchored.

Those that were followed come before those that were lost, which are not found where another one stands.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from morph_dslam.camera import Camera
from morph_dslam.model import ReducedModel
from morph_dslam.sources import Frame
from morph_dslam.tracking.anchoring import CameraLocalization
from morph_dslam.tracking.binding import draw_view, view_of
from morph_dslam.tracking.estimator import State
from morph_dslam.tracking.multi_camera import RigTracker
from morph_dslam.tracking.outcomes import PoseSource, SamePlace
from morph_dslam.tracking.overlap import Body
from morph_dslam.tracking.result import FrameResult
from morph_dslam.tracking.tracker import Tracker
from morph_dslam.tracking.tracker_inputs import widened


def drawn_depth(surface: ReducedModel, camera: Camera, state: State) -> NDArray[np.float32]:
    """Depth (h, w) of an object in a camera, metres, infinite where it is not."""
    return draw_view(view_of(surface, camera, state), surface.triangles, camera).depth


class MultiObjectTracker:
    """Follows several objects in the same frames.

    Parameters
    ----------
    trackers : by name, each of one object, all of the same camera, or of the same rig.
    """

    def __init__(self, trackers: Mapping[str, Tracker | RigTracker]) -> None:
        self.trackers = dict(trackers)
        # One object alone occludes nothing.
        several = self.trackers if len(self.trackers) > 1 else {}
        self._bodies = {name: Body.of(tracker.model) for name, tracker in several.items()}
        self._surfaces = {name: body.surface for name, body in self._bodies.items()}
        self._last: dict[str, FrameResult] = {}

    def track(
        self, frames: Sequence[Frame], localizations: Mapping[str, CameraLocalization] | None = None
    ) -> dict[str, FrameResult]:
        """Find the objects in the frames of one instant.

        Parameters
        ----------
        frames : by camera.
        localizations : by name, where the map has the anchored objects.
        """
        where = {name: (localizations or {}).get(name, CameraLocalization()) for name in self.trackers}
        if len(where) == 1:
            ((name, localization),) = where.items()
            return {name: self._track(name, frames, localization, None)}
        expected = {name: self._expected(name, where[name]) for name in where}
        nearest_first = sorted(expected, key=lambda name: self._distance(name, expected[name]))
        lost = {name for name, result in self._last.items() if not result.tracked}
        drawn = {name: self._drawn(name, expected[name]) for name in nearest_first}
        for name in sorted(nearest_first, key=lost.__contains__):
            self._tell_places(name, expected)
            others = [depths for other, depths in drawn.items() if other != name and depths]
            occluders = [np.minimum.reduce(views) for views in zip(*others, strict=True)] or None
            self._last[name] = self._track(name, frames, where[name], occluders)
            drawn[name] = self._drawn(name, self.trackers[name].state)
            expected[name] = self.trackers[name].state
        return {name: self._marked(name) for name in self.trackers}

    def _tell_places(self, name: str, expected: Mapping[str, State]) -> None:
        """Tell a tracker where the others stand: in this frame, or before, where they are tracked later."""
        tracker, body = self.trackers[name], self._bodies[name]
        others = [other for other, result in self._last.items() if other != name and result.tracked]

        def is_taken_in(place: Callable[[State], State]) -> Callable[[State], bool]:
            standing = [self._bodies[other].standing(place(expected[other])) for other in others]
            return lambda state: any(body.standing(state).is_where(other) for other in standing)

        if isinstance(tracker, RigTracker):
            for single, part in zip(tracker.trackers, tracker.cameras, strict=True):
                single.is_taken = is_taken_in(part.seen)
        else:
            tracker.is_taken = is_taken_in(lambda state: state)

    def _marked(self, name: str) -> FrameResult:
        """An object's result, with a warning of each other one that stands in the same place."""
        result = self._last[name]
        if result.estimate is None:
            return result
        standing = self._bodies[name].standing(result.estimate.state)
        others = [(other, its.estimate) for other, its in self._last.items() if other != name and its.estimate]
        same = [o for o, estimate in others if standing.is_where(self._bodies[o].standing(estimate.state))]
        return replace(result, warnings=(*result.warnings, *map(SamePlace, same)))

    def _track(
        self,
        name: str,
        frames: Sequence[Frame],
        localization: CameraLocalization,
        occluders: Sequence[NDArray[np.float32]] | None,
    ) -> FrameResult:
        tracker = self.trackers[name]
        if isinstance(tracker, RigTracker):
            return tracker.track(frames, localization, occluders)
        return tracker.track(frames[0], localization, None if occluders is None else occluders[0])

    def _expected(self, name: str, where: CameraLocalization) -> State:
        """Where an object may be in the next frame: where it was last, or where the map has it."""
        state, last = self.trackers[name].state, self._last.get(name)
        if where.pose_prior is None or (last is not None and last.pose_from in (PoseSource.POINTS, PoseSource.OUTLINE)):
            return state
        return replace(state, camera_from_object=where.pose_prior.pose)

    def _distance(self, name: str, state: State) -> float:
        """Mean depth of an object's surface."""
        return float(state.camera_from_object.apply(self._surfaces[name].positions(state.parameters))[:, 2].mean())

    def _drawn(self, name: str, state: State) -> list[NDArray[np.float32]]:
        """Depth (h, w) of an object and its margin, by camera; none if it is not known whether it is there."""
        if name in self._last and self._last[name].estimate is None:
            return []
        tracker, surface = self.trackers[name], self._surfaces[name]
        if isinstance(tracker, RigTracker):
            return [widened(drawn_depth(surface, part.camera, part.seen(state))) for part in tracker.cameras]
        return [widened(drawn_depth(surface, tracker.camera, state))]
