"""Camera tracking and mapping, one frame after the other.

`Slam.process_frame` is the method: wait for a start, follow the map, keep a view where the map needs it, find
the camera again when it is lost. From one camera alone the map has no scale of its own: the median depth of
its first view is 1. With depth images, or a stereo pair, it is metric and begins with the first view.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from morph_dslam.camera import Camera, StereoCamera
from morph_dslam.errors import MapError
from morph_dslam.slam.frame_images import STAGES, FrameImages, FrameView, SlamFrame, corners_of, points_of
from morph_dslam.slam.initialization import MapInitializer, MapStart
from morph_dslam.slam.map_making import MapMaking
from morph_dslam.slam.mapping import pose_in_keyframe
from morph_dslam.slam.options import SlamOptions
from morph_dslam.slam.pose import refine_pose
from morph_dslam.slam.relocalization import Relocalizer
from morph_dslam.slam.rigid_map import CANDIDATE, NOWHERE, Followed, RigidMap
from morph_dslam.slam.tracking import Tracked, Tracker
from morph_dslam.timing import StageClock, WaitClock

Array = NDArray[np.float64]

#: Frames that a relocalised pose has to be tracked for before the map grows again.
HELD_FRAMES = 3


class Slam:
    """Tracks a moving camera in a rigid scene that it maps as it goes.

    Parameters
    ----------
    camera : of all frames; a stereo pair, whose rectified left camera is then what the map and the poses
        are of.
    with_depth : whether frames come with depth images that belong to them pixel by pixel.
    freeze_when_deforming : whether to freeze the map by itself when points begin to disagree with it.
    threaded : whether the map is made beside the frames, in a thread that they never wait for, instead of
        in step with them: for live cameras. What comes out then depends on how fast the machine is.

    Attributes
    ----------
    camera : the camera of the undistorted images. frame_images : makes these of the frames.
    map : what is known of the scene; replaced when a young map is given up (``n_restarts`` counts these).
    is_frozen : whether the map is kept as it is. frozen_at : frame from which on it froze by itself, or None.
    """

    def __init__(
        self,
        camera: Camera | StereoCamera,
        options: SlamOptions | None = None,
        with_depth: bool = False,
        freeze_when_deforming: bool = False,
        threaded: bool = False,
    ) -> None:
        self.options = options or SlamOptions()
        self.frame_images = FrameImages(camera, self.options, with_depth)
        self.camera = self.frame_images.camera
        self._freezes_by_itself = freeze_when_deforming
        self.is_frozen, self.frozen_at = False, None
        self.n_restarts, self._threaded = 0, threaded
        self._begin(RigidMap(self.frame_images.baseline_px))

    def use_map(self, rigid_map: RigidMap, extend: bool = False) -> None:
        """Go on in a map from an earlier run with the same camera, or from another program.

        Frames are lost until the camera is found in it. It is kept as it is, or grows with ``extend``.

        Raises
        ------
        MapError
            If the map is to grow, but its depth comes from another kind of camera.
        """
        if rigid_map.baseline_px != self.frame_images.baseline_px:
            if extend:
                raise MapError(
                    "a map can only be extended by the kind of camera that made it: its depth comes from "
                    f"{_origin_of(rigid_map.baseline_px)}, "
                    f"this camera's from {_origin_of(self.frame_images.baseline_px)}"
                )
            # The map's own depths are enough to find the camera in it.
            self.frame_images.baseline_px = 0.0
        self.is_frozen = not extend
        self._begin(rigid_map)

    def undistort(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """An image (h, w[, 3]) as ``camera`` would have seen it; stereo: the left one, rectified."""
        return self.frame_images.undistort(image)

    def reset(self) -> None:
        """Forget the map, frozen or not, and wait for a start."""
        self.is_frozen, self.frozen_at = False, None
        self._restart()

    def _restart(self) -> None:
        self.n_restarts += 1
        self._begin(RigidMap(self.frame_images.baseline_px))

    def _begin(self, rigid_map: RigidMap) -> None:
        self.map, k, options = rigid_map, self.camera.intrinsics, self.options
        self._initialiser = MapInitializer(k, options)
        self._tracker = Tracker(self.map, k, options)
        self._making = MapMaking(self.map, k, options, self._tracker, self._threaded)
        self._relocaliser = Relocalizer(self.map, k, options)
        # In a map from elsewhere the camera is lost until it is found.
        self._n_lost, self._n_held, self._n_deforming = int(bool(rigid_map.keyframes)), 0, 0
        if self.is_frozen:
            self._tracker.choose_templates()

    def process_frame(
        self,
        image: NDArray[np.uint8],
        index: int,
        timestamp: float,
        depth: NDArray[np.float32] | None = None,
        right: NDArray[np.uint8] | None = None,
    ) -> SlamFrame:
        """Take in the next frame, as recorded.

        Parameters
        ----------
        image : (h, w, 3) or (h, w). depth : (h, w) metres, NaN where not measured; right : (h, w[, 3]) the
            right image of a stereo pair. A frame may lack them.

        Raises
        ------
        CameraError
            If an image has not the camera's size.
        """
        clock, waits = StageClock(STAGES), WaitClock()
        is_beside = self._threaded and self.is_mapping
        with clock.stage("prepare"):
            view = self.frame_images.prepare(image, index, timestamp, depth, right)
        with clock.stage("map"):
            self._making.advance()
        if not self.map.keyframes:
            result = self._start(view, clock)
        elif self._n_lost:
            result = self._relocalise(view, clock)
        else:
            result = self._track(view, clock)
        if not self.is_frozen:
            self._making.end_frame()
        self._n_lost = self._n_lost + 1 if result["status"] == "lost" else 0
        is_young = len(self.map.keyframes) < self.options.window and not self.is_frozen
        if is_young and self._n_lost > self.options.restart_after:
            self._restart()
        is_beside |= self._threaded and self.is_mapping
        waited = waits.milliseconds + clock.milliseconds["map"] if is_beside else 0.0
        times = {"timings_ms": clock.milliseconds, "total_ms": clock.total, "waited_ms": waited}
        return SlamFrame(index, timestamp, **result, **times)

    def freeze(self) -> None:
        """Keep the map as it is from now on and only find the camera in it; before a start, do nothing.

        What the mapper has begun is brought to its end first, or given up where it is done beside the frames.
        """
        if self.map.keyframes:
            self._making.stop()
            self.is_frozen = True
            self._tracker.drop_candidates()
            self._tracker.choose_templates()

    def refine_map(self) -> None:
        """Adjust all keyframes and points together, once the sequence is over; a frozen map stays."""
        if not self.is_frozen:
            self._making.finish()

    @property
    def n_loops(self) -> int:
        """Loops closed in the map that there is now."""
        return self._making.n_loops

    @property
    def is_mapping(self) -> bool:
        """Whether the mapper has work under way that later frames go on with."""
        return not self._making.is_idle

    def is_placed(self, frame: SlamFrame) -> bool:
        """Whether a frame has a pose in the map that there is now."""
        return frame.from_keyframe is not None and frame.map_number == self.n_restarts

    def camera_from_world(self, frame: SlamFrame) -> Array | None:
        """The camera's pose (4, 4) by what the map knows now; None where the frame has none.

        The map may have been adjusted since: the pose is found again from what is left of the frame's points.
        """
        if frame.from_keyframe is None or not self.is_placed(frame):
            return None
        start = frame.from_keyframe @ self.map.pose_of(frame.keyframe)
        points = self.map.good_of(frame.points)
        if len(points.ids) < self.options.least_inliers:
            return start
        known = self.map.positions[points.ids]
        estimate = refine_pose(
            start,
            known,
            points.pixels,
            self.camera.intrinsics,
            inlier_px=self.options.inlier_px,
            right=points.right,
            baseline_px=self.map.baseline_px,
        )
        enough = estimate.inliers.sum() >= self.options.least_inliers
        return estimate.camera_from_world if enough else start

    def _start(self, view: FrameView, clock: StageClock) -> dict:
        with clock.stage("start"):
            points = self._start_metric(view) if self.map.is_metric else self._start_moving(view)
            if not isinstance(points, Followed):
                return {"status": "waiting", "reason": points} | corners_of(self._initialiser.followed)
            self._tracker.place(self.map.keyframes[-1].camera_from_world, points)
            tracked = self._tracker.track(view.normalized, view.depth)
        if not isinstance(tracked, Tracked):
            self._restart()
            return {"status": "waiting", "reason": f"the first map did not hold: {tracked}"}
        return self._result("tracked", tracked, is_keyframe=True)

    def _start_moving(self, view: FrameView) -> Followed | str:
        start = self._initialiser.process(view)
        if not isinstance(start, MapStart):
            return start
        self._making.begin(start)
        return self.map.keyframes[-1].seen

    def _start_metric(self, view: FrameView) -> Followed | str:
        if view.depth is None:
            return "this frame has no depth"
        n, least = self._making.begin_at(view, np.eye(4)), self.options.least_start_points
        if n < least:
            self._begin(RigidMap(self.frame_images.baseline_px))
            return f"only {n} corners with depth, {least} are needed"
        return self.map.keyframes[-1].seen

    def _track(self, view: FrameView, clock: StageClock) -> dict:
        with clock.stage("track"):
            tracked = self._tracker.track(view.normalized, view.depth)
        if not isinstance(tracked, Tracked):
            found = self._relocalise(view, clock)
            return found if found["status"] != "lost" else {"status": "lost", "reason": tracked}
        with clock.stage("map"):
            # A pose found again has to hold for some frames before the map is built on it.
            self._n_held += 1
            self._watch(tracked, view.index)
            keeps = (
                not self.is_frozen and self._n_held > HELD_FRAMES and self._making.wants_keyframe(tracked, view.index)
            )
            if keeps:
                self._making.keep(tracked, view)
        return self._result("tracked", tracked, keeps)

    def _watch(self, tracked: Tracked, index: int) -> None:
        """Freeze the map when the scene begins to deform, if that is wanted."""
        n = len(tracked.disagreeing.ids)
        deforms = n > self.options.deforming_share * (n + tracked.n_inliers)
        self._n_deforming = self._n_deforming + 1 if deforms else 0
        if (
            self._freezes_by_itself
            and not self.is_frozen
            and self._making.can_keep
            and self._n_deforming >= self.options.deforming_frames
        ):
            self.freeze()
            self.frozen_at = index

    def _relocalise(self, view: FrameView, clock: StageClock) -> dict:
        with clock.stage("relocalise"):
            found = self._relocaliser.find(view, self._tracker)
            if isinstance(found, str):
                return {"status": "lost", "reason": found}
            pose, points = found
            self._n_held = 0
            self._tracker.place(pose.camera_from_world, points)
        tracked = Tracked(pose, points, int(pose.inliers.sum()), NOWHERE)
        return self._result("relocalised", tracked, is_keyframe=False)

    def _result(self, status: str, tracked: Tracked, is_keyframe: bool) -> dict:
        number = len(self.map.keyframes) - 1
        camera_from_world = self._tracker.camera_from_world
        is_candidate = self.map.state[tracked.points.ids] == CANDIDATE
        return points_of(tracked, is_candidate) | {
            "status": status,
            "reason": "",
            "pose": tracked.pose,
            "keyframe": number,
            "from_keyframe": pose_in_keyframe(camera_from_world, self.map.keyframes[number]),
            "map_number": self.n_restarts,
            "is_keyframe": is_keyframe,
        }


def _origin_of(baseline_px: float) -> str:
    return f"a baseline of {baseline_px:.1f} px m" if baseline_px else "the motion of one camera alone"
