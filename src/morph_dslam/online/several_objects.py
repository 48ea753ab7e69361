"""Several objects in view of one camera: each is tracked by itself, and hides what is behind it.

A point that another object's surface hides does not count: the objects are drawn, each in the state of this
frame where it is known already, the nearest one first, and otherwise in that of the frame before.
"""

from __future__ import annotations

from collections.abc import Mapping

import cv2
import numpy as np
from numpy.typing import NDArray

from morph_dslam.online.frame_result import FrameResult
from morph_dslam.online.pipeline import Tracker

#: How much wider than drawn an object hides, pixels: what is compared of a point reaches as far.
MARGIN_PX = 5


class ObjectTracker:
    """Follows several objects at once.

    Parameters
    ----------
    trackers : by name, each of one object, all of the same camera.
    """

    def __init__(self, trackers: Mapping[str, Tracker]) -> None:
        self.trackers = dict(trackers)
        self._lost: set[str] = set()

    def process_frame(
        self, image: NDArray[np.uint8], depth: NDArray[np.float32] | None = None
    ) -> dict[str, FrameResult]:
        """Find the objects in the next frame; see `Tracker.process_frame`. By name."""
        nearest_first = sorted(self.trackers, key=lambda name: self._distance(self.trackers[name]))
        drawn = {name: self._drawn(name) for name in nearest_first}
        found = {}
        for name in nearest_first:
            others = [depths for other, depths in drawn.items() if other != name and depths is not None]
            in_front = np.minimum.reduce(others) if others else None
            found[name] = self.trackers[name].process_frame(image, depth=depth, in_front=in_front)
            (self._lost.discard if found[name].estimate is not None else self._lost.add)(name)
            drawn[name] = self._drawn(name)
        return {name: found[name] for name in self.trackers}

    def _distance(self, tracker: Tracker) -> float:
        """Mean depth of an object's points where it was last."""
        return float(tracker.reference.points.in_camera(tracker.state)[:, 2].mean())

    def _drawn(self, name: str) -> NDArray[np.float32] | None:
        """Depth (h, w) of an object and its margin; None where nobody knows where it is."""
        if name in self._lost:
            return None
        tracker = self.trackers[name]
        square = np.ones((2 * MARGIN_PX + 1,) * 2, np.uint8)
        return np.asarray(cv2.erode(tracker.reference.depth(tracker.state), square), dtype=np.float32)
