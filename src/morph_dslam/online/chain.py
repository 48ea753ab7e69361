"""From a frame to the object in it: the camera in the map of the scene, then the object.

The two steps can run one after the other or, for different frames, in two threads.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from morph_dslam.camera import PinholeCamera
from morph_dslam.online.anchored.anchor import Anchor
from morph_dslam.online.anchored.known_pose import KnownPose
from morph_dslam.online.frame_result import FrameResult
from morph_dslam.online.pipeline import Tracker
from morph_dslam.sources import Frame


@dataclass(frozen=True)
class Located:
    """What the map told of a frame.

    Attributes
    ----------
    known : the object's pose by the map, None where the camera is lost. why_lost : the camera; empty if not.
    milliseconds : that it took.
    """

    known: KnownPose | None = None
    why_lost: str = ""
    milliseconds: float = 0.0

    def told_of(self, result: FrameResult) -> FrameResult:
        """The result of an anchored object, with the time that finding the camera took, or why it failed."""
        reason = result.reason
        if self.known is None:
            reason = f"{reason}; the camera is lost in the map: {self.why_lost}"
        return replace(
            result,
            reason=reason,
            timings_ms=result.timings_ms | {"locate": self.milliseconds},
            total_ms=result.total_ms + self.milliseconds,
        )


class Chain:
    """Both steps; without an anchor the object is free and the first one does nothing.

    ``anchor`` is of this object alone.
    """

    def __init__(self, camera: PinholeCamera, tracker: Tracker, anchor: Anchor | None = None) -> None:
        self._camera, self.tracker, self.anchor = camera, tracker, anchor

    def with_tracker(self, tracker: Tracker) -> Chain:
        """The same with another tracker; the camera stays where it was found."""
        return Chain(self._camera, tracker, self.anchor)

    def process(self, frame: Frame) -> FrameResult:
        """Both steps for the next frame; raises CameraError if it has not the camera's size."""
        return self.track(frame, self.locate(frame))

    def locate(self, frame: Frame) -> Located:
        """Find the camera of the next frame in the map."""
        self._camera.check_image(frame.image, f"frame {frame.index}")
        if self.anchor is None:
            return Located()
        known, camera = self.anchor.locate(frame.image, frame.index, frame.timestamp)
        return Located(next(iter(known.values()), None), camera.reason, camera.total_ms)

    def track(self, frame: Frame, located: Located) -> FrameResult:
        """Find the object in a frame that `locate` has seen."""
        depth = frame.depth if self.tracker.options.use_depth else None
        result = self.tracker.process_frame(frame.image, located.known, depth)
        return result if self.anchor is None else located.told_of(result)
