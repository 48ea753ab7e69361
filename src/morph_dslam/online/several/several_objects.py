"""Several objects in view of one camera: each is tracked by itself, and hides what is behind it.

A point that another object's surface hides does not count: the objects are drawn, each in the state of this
frame where it is known already, the nearest one first, and otherwise in that of the frame before, moved to
where the map has it in this frame if it is anchored.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from morph_dslam.camera import PinholeCamera
from morph_dslam.online.anchored.anchor import Anchor
from morph_dslam.online.anchored.known_pose import KnownPose
from morph_dslam.online.chain import Located
from morph_dslam.online.estimation.estimator import State
from morph_dslam.online.frame_result import FrameResult
from morph_dslam.online.pipeline import Tracker
from morph_dslam.sources import Frame

#: How much wider than drawn an object hides, pixels: what is compared of a point reaches as far.
MARGIN_PX = 5


def widened(depth: NDArray[np.float32]) -> NDArray[np.float32]:
    """What an object hides: its depth (h, w), infinite where it is not, and that of a margin around it."""
    square = np.ones((2 * MARGIN_PX + 1,) * 2, np.uint8)
    return np.asarray(cv2.erode(depth, square), dtype=np.float32)


class ObjectTracker:
    """Follows several objects at once.

    Parameters
    ----------
    trackers : by name, each of one object, all of the same camera.
    """

    def __init__(self, trackers: Mapping[str, Tracker]) -> None:
        self.trackers = dict(trackers)
        self._last: dict[str, FrameResult] = {}

    def process_frame(
        self,
        image: NDArray[np.uint8],
        depth: NDArray[np.float32] | None = None,
        known: Mapping[str, KnownPose] | None = None,
    ) -> dict[str, FrameResult]:
        """Find the objects in the next frame; see `Tracker.process_frame`. By name.

        ``known`` has the poses of anchored objects by the map; none where the camera is lost.
        """
        known = known or {}
        expected = {name: self._expected(name, known.get(name)) for name in self.trackers}
        nearest_first = sorted(expected, key=lambda name: self._distance(name, expected[name]))
        drawn = {name: self._drawn(name, expected[name]) for name in nearest_first}
        for name in nearest_first:
            others = [depths for other, depths in drawn.items() if other != name and depths is not None]
            in_front = np.minimum.reduce(others) if others else None
            tracker = self.trackers[name]
            seen = depth if tracker.options.use_depth else None
            self._last[name] = tracker.process_frame(image, known.get(name), seen, in_front)
            drawn[name] = self._drawn(name, tracker.state)
        return {name: self._last[name] for name in self.trackers}

    def _expected(self, name: str, known: KnownPose | None) -> State:
        """Where an object may be in the next frame: where it was last, or where the map has it."""
        state, last = self.trackers[name].state, self._last.get(name)
        if known is None or (last is not None and last.pose_from == "points"):
            return state
        return replace(state, camera_from_object=known.pose)

    def _distance(self, name: str, state: State) -> float:
        """Mean depth of an object's points."""
        return float(self.trackers[name].reference.points.in_camera(state)[:, 2].mean())

    def _drawn(self, name: str, state: State) -> NDArray[np.float32] | None:
        """Depth (h, w) of an object and its margin; None if nobody knows whether it is there."""
        if name in self._last and self._last[name].estimate is None:
            return None
        return widened(self.trackers[name].reference.depth(state))


class ObjectsChain:
    """From a frame to the objects in it, as `Chain` for one: the camera in the map once, then each object.

    Parameters
    ----------
    anchor : of the objects that are anchored, by name; None if all are free.
    """

    def __init__(
        self, camera: PinholeCamera, trackers: Mapping[str, Tracker], anchor: Anchor | None = None
    ) -> None:
        self._camera, self._objects, self._anchor = camera, ObjectTracker(trackers), anchor

    def process(self, frame: Frame) -> dict[str, FrameResult]:
        """Find the objects, by name; raises CameraError if the frame has not the camera's size."""
        return self.track(frame, self.locate(frame))

    def locate(self, frame: Frame) -> dict[str, Located]:
        """Find the camera of the next frame in the map: what that tells of each anchored object, by name."""
        self._camera.check_image(frame.image, f"frame {frame.index}")
        if self._anchor is None:
            return {}
        known, camera = self._anchor.locate(frame.image, frame.index, frame.timestamp)
        return {name: Located(known.get(name), camera.reason, camera.total_ms) for name in self._anchor.names}

    def track(self, frame: Frame, located: Mapping[str, Located]) -> dict[str, FrameResult]:
        """Find the objects in a frame that `locate` has seen."""
        known = {name: one.known for name, one in located.items() if one.known is not None}
        results = self._objects.process_frame(frame.image, frame.depth, known)
        for name, one in located.items():
            results[name] = one.told_of(results[name])
        return results
