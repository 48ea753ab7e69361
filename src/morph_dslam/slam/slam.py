"""Camera tracking and mapping, one frame after the other.

`Slam.process_frame` is the method: wait for a start, follow the map, keep a view where the map needs it, find
the camera again when it is lost. From one camera alone the map has no scale of its own: the median depth of
its first view is 1. With depth images, or a stereo pair, it is metric and begins with the first view.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from morph_dslam.camera import Camera, StereoCamera
from morph_dslam.errors import MapError
from morph_dslam.slam.frame_images import FrameDepth, FrameImages, FrameView
from morph_dslam.slam.initialization import MapInitializer, MapStart
from morph_dslam.slam.known_map_checks import depth_ratio
from morph_dslam.slam.least_squares_matching import moved_along
from morph_dslam.slam.local_map import LEAST_DISPARITY_PX, WINDOW
from morph_dslam.slam.map_making import MapMaking
from morph_dslam.slam.mapping import pose_in_keyframe
from morph_dslam.slam.options import INLIER_PX, LEAST_INLIERS, LEAST_START_POINTS, SlamOptions
from morph_dslam.slam.pose import project, refine_pose
from morph_dslam.slam.relocalization import Relocalizer
from morph_dslam.slam.result import STAGES, NoPose, SlamFrame, SlamReason, SlamStatus
from morph_dslam.slam.rigid_map import CANDIDATE, NOWHERE, Followed, RigidMap
from morph_dslam.slam.tracking import Tracked, Tracker
from morph_dslam.threads import one_thread_for_algebra
from morph_dslam.timing import WaitClock, frame_clock, stage

Array = NDArray[np.float64]
#: Frames that a relocalised pose has to be tracked for before the map grows again.
HELD_FRAMES = 3
#: The scene deforms when more than this share of its points disagree with a rigid one in so many frames on end.
DEFORMING_SHARE, DEFORMING_FRAMES = 0.12, 5
#: Frames whose points are kept for the check of the lens in a known map: two minutes of video, in some 30 MB.
MOST_FRAMES_SEEN = 3600


class Slam:
    """Tracks a moving camera in a rigid scene that it maps as it goes.

    Parameters
    ----------
    camera : of all frames; a stereo pair, whose left camera is then what the map and the poses are of
    options : when to keep the map as it is, or to give it up
    with_depth : whether frames come with depth images that belong to them pixel by pixel
    threaded : whether the map is made beside the frames, in a thread that they never wait for, instead of in
        step with them: for live cameras. What comes out then depends on how fast the machine is.

    Attributes
    ----------
    camera : the camera of the undistorted images
    frame_images : makes these of the frames
    newest_view : the newest frame, made ready; None before the first
    map : what is known of the scene; replaced when a young map is given up
    n_restarts : how many young maps were given up
    is_frozen : whether the map is kept as it is
    frozen_at : frame from which on it froze because the scene deformed, or None
    n_known : keyframes of a map that was known before
    is_of_other_recording : whether these have the numbers of another recording's frames
    n_depths_aside : depth images that were not used because they do not belong to the colour pixels
    depth_ratio : measured depths over those of a map that was known before, once a frame told; None before
    seen_in_known_map : points of the first frames in a map that was known before and is kept, by the frames' numbers:
        records of such frames have none, and the lens is checked by them
    astray_in_known_map : the points of these frames that disagree with a rigid scene
    """

    def __init__(
        self,
        camera: Camera | StereoCamera,
        options: SlamOptions | None = None,
        with_depth: bool = False,
        threaded: bool = False,
    ) -> None:
        self.options = options or SlamOptions()
        self.frame_images = FrameImages(camera, with_depth)
        self.camera = self.frame_images.camera
        self.newest_view: FrameView | None = None
        self.is_frozen, self.frozen_at = False, None
        self.n_restarts, self.threaded = 0, threaded
        self.n_known, self.n_depths_aside, self.is_of_other_recording = 0, 0, False
        self.depth_ratio: float | None = None
        self.seen_in_known_map: dict[int, Followed] = {}
        self.astray_in_known_map: dict[int, Followed] = {}
        self._expects_depth = with_depth or self.frame_images.is_stereo or not self.options.use_depth
        self._begin(RigidMap(self.frame_images.baseline_px))

    def use_map(self, rigid_map: RigidMap) -> None:
        """Go on in a map from an earlier run with the same camera, or from another program.

        Frames are lost until the camera is found in it. It is kept as it is unless the options let it grow.

        Raises MapError if the map is to grow, but its depth comes from another kind of camera.
        """
        if rigid_map.baseline_px != self.frame_images.baseline_px:
            if self.options.extend:
                raise MapError(
                    "a map can only be extended by the kind of camera that made it: its depth comes from "
                    f"{_origin_of(rigid_map.baseline_px)}, "
                    f"this camera's from {_origin_of(self.frame_images.baseline_px)}"
                    f"{_remedy(rigid_map.baseline_px)}"
                )
            # The map's own depths are enough to find the camera in it.
            self.frame_images.baseline_px = 0.0
        self.is_frozen = not self.options.extend
        self.n_known = len(rigid_map.keyframes)
        self._begin(rigid_map)

    def undistort(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """An image (h, w[, 3]) as ``camera`` would have seen it; stereo: the left one."""
        return self.frame_images.undistort(image)

    def reset(self) -> None:
        """Forget the map, frozen or not, and wait for a start."""
        self.is_frozen, self.frozen_at = False, None
        self._restart()

    def _restart(self) -> None:
        self.n_restarts += 1
        self.n_known, self.is_of_other_recording = 0, False
        self._begin(RigidMap(self.frame_images.baseline_px))

    def finder(self) -> Slam:
        """One that finds the camera in the map there is now, and leaves the map as it is."""
        finder = copy(self)
        finder.is_frozen, finder.threaded = True, False
        # Its frames count in what a map knows of its points and its usual error.
        own = RigidMap(self.map.baseline_px)
        own.copy_of(self.map)
        finder._begin(own)
        return finder

    def _begin(self, rigid_map: RigidMap) -> None:
        self.map, k = rigid_map, self.camera.intrinsics
        self.seen_in_known_map, self.astray_in_known_map = {}, {}  # of another map, their points are others
        self._initializer = MapInitializer(k)
        self._tracker = Tracker(self.map, self.camera)
        self._making = MapMaking(self.map, self.camera, self._tracker, self.threaded)
        self._relocalizer = Relocalizer(self.map, k)
        # In a map from elsewhere the camera is lost until it is found.
        self._n_lost, self._n_held, self._n_deforming = int(bool(rigid_map.keyframes)), 0, 0
        if self.is_frozen:
            self._tracker.choose_views()

    @one_thread_for_algebra
    def process_frame(
        self,
        image: NDArray[np.uint8],
        index: int,
        timestamp: float,
        depth: NDArray[np.float32] | None = None,
        right: NDArray[np.uint8] | None = None,
    ) -> SlamFrame:
        """Take in the next frame, as recorded; it may lack depth or right image.

        Parameters
        ----------
        image : (h, w, 3) or (h, w)
        index, timestamp : number of the frame, and its time in seconds
        depth : (h, w) metres, NaN where not measured
        right : (h, w[, 3]) the right image of a stereo pair

        Raises CameraError if an image has not the camera's size.
        """
        if self.options.freeze_at is not None and index >= self.options.freeze_at and not self.is_frozen:
            self.freeze()
        self.n_depths_aside += depth is not None and not self._expects_depth
        waits, is_beside = WaitClock(), self.threaded and self.is_mapping
        with frame_clock(STAGES) as clock:
            with stage("prepare"):
                view = self.frame_images.prepare(image, index, timestamp, depth, right)
                self.newest_view = view
            with stage("map"):
                self._making.advance()
            frame = self._locate(view)
            if self.knows_map and self.depth_ratio is None:
                self.depth_ratio = self._compared_depth(view, frame)
            if self.knows_map and self.is_frozen and len(self.seen_in_known_map) < MOST_FRAMES_SEEN:
                self.seen_in_known_map[index] = frame.points.without_unmeasured()
                self.astray_in_known_map[index] = frame.disagreeing.without_unmeasured()
            if not self.is_frozen:
                self._making.end_frame()
            self._n_lost = self._n_lost + 1 if frame.status is SlamStatus.LOST else 0
            is_young = len(self.map.keyframes) < WINDOW and not (self.is_frozen or self.knows_map)
            if is_young and self._n_lost > self.options.restart_after:
                self._restart()
        is_beside |= self.threaded and self.is_mapping
        waited = waits.milliseconds + clock.milliseconds["map"] if is_beside else 0.0
        return replace(frame, timings_ms=clock.milliseconds, total_ms=clock.total, waited_ms=waited)

    def freeze(self) -> None:
        """Keep the map as it is from now on and only find the camera in it; before a start, do nothing.

        What the mapper has begun is brought to its end first, or given up where it is done beside the frames.
        """
        if self.map.keyframes:
            self._making.stop()
            self.is_frozen = True
            self._tracker.drop_candidates()
            self._tracker.choose_views()

    def refine_map(self, frames: Sequence[SlamFrame]) -> list[SlamFrame]:
        """Measure all points again and adjust them and all keyframes together, once the sequence is over.

        Returns the frames with their points as they are seen in the refined map; a frozen map and its frames stay.

        Parameters
        ----------
        frames : what each frame gave
        """
        if self.is_frozen:
            return list(frames)
        moves = self._making.finish()
        self._tracker.forget_patches()
        placed = [frame for frame in frames if self.is_placed(frame)]
        moved = iter(moved_along(placed, moves, len(self.map.state)))
        return [next(moved) if self.is_placed(frame) else frame for frame in frames]

    @property
    def knows_map(self) -> bool:
        """Whether the map was known before the first frame."""
        return self.n_known > 0

    @property
    def n_loops(self) -> int:
        """Loops closed in the map that there is now."""
        return self._making.n_loops

    @property
    def is_mapping(self) -> bool:
        """Whether the mapper has work under way that later frames go on with."""
        return not self._making.is_idle

    def wait(self) -> None:
        """Wait for what is being done beside the frames, where frames come faster than a camera's."""
        self._making.wait()

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
        if len(points.ids) < LEAST_INLIERS:
            return start
        estimate = refine_pose(
            start,
            self.map.positions[points.ids],
            points.pixels,
            self.camera.intrinsics,
            inlier_px=INLIER_PX,
            right=points.right,
            baseline_px=self.map.baseline_px,
        )
        return estimate.camera_from_world if estimate.inliers.sum() >= LEAST_INLIERS else start

    def _compared_depth(self, view: FrameView, frame: SlamFrame) -> float | None:
        """Measured depths of a frame over those of the map; None where they do not tell."""
        if view.depth is None or frame.pose is None:
            return None
        positions = self.map.positions[frame.points.ids]
        _, depths = project(frame.pose.camera_from_world, positions, self.camera.intrinsics)
        return depth_ratio(view.depth, frame.points.pixels, depths)

    def _locate(self, view: FrameView) -> SlamFrame:
        if not self.map.keyframes:
            return self._start(view)
        return self._relocalize(view) if self._n_lost else self._track(view)

    def _start(self, view: FrameView) -> SlamFrame:
        with stage("start"):
            points = self._start_metric(view) if self.map.is_metric else self._start_moving(view)
            if isinstance(points, NoPose):
                return self._without_pose(view, SlamStatus.WAITING, points)
            newest = self.map.keyframes[-1]
            self._tracker.place(newest.camera_from_world, points, newest.timestamp)
            tracked = self._tracker.track(view)
        if isinstance(tracked, NoPose):
            self._restart()
            return self._without_pose(view, SlamStatus.WAITING, NoPose(SlamReason.FIRST_MAP_FAILED, cause=tracked))
        return self._with_pose(view, SlamStatus.TRACKED, tracked, is_keyframe=True)

    def _start_moving(self, view: FrameView) -> Followed | NoPose:
        start = self._initializer.process(view)
        if not isinstance(start, MapStart):
            return start
        self._making.begin(start)
        return self.map.keyframes[-1].seen

    def _start_metric(self, view: FrameView) -> Followed | NoPose:
        if view.depth is None:
            return NoPose(SlamReason.NO_DEPTH)
        n = self._making.begin_at(view, np.eye(4))
        if n < LEAST_START_POINTS:
            self._begin(RigidMap(self.frame_images.baseline_px))
            return NoPose(SlamReason.FEW_DEPTHS, (n, LEAST_START_POINTS), self._out_of_reach(view.depth))
        return self.map.keyframes[-1].seen

    def _out_of_reach(self, depth: FrameDepth) -> NoPose | None:
        """That most depths of a frame are too large to place points by, if they are."""
        depths, most = depth.samples()[:, 2], self.frame_images.baseline_px / LEAST_DISPARITY_PX
        if not len(depths) or np.median(depths) < most:
            return None
        return NoPose(SlamReason.FAR_DEPTHS, (float(depths.min()), float(depths.max()), most))

    def _track(self, view: FrameView) -> SlamFrame:
        with stage("track"):
            tracked = self._tracker.track(view)
        if isinstance(tracked, NoPose):
            found = self._relocalize(view)
            return self._without_pose(view, SlamStatus.LOST, tracked) if found.pose is None else found
        with stage("map"):
            # A pose found again has to hold for some frames before the map is built on it.
            self._n_held += 1
            self._freeze_if_deforming(tracked, view.index)
            keeps = (
                not self.is_frozen and self._n_held > HELD_FRAMES and self._making.wants_keyframe(tracked, view.index)
            )
            if keeps:
                self._making.keep(tracked, view)
        return self._with_pose(view, SlamStatus.TRACKED, tracked, keeps)

    def _freeze_if_deforming(self, tracked: Tracked, index: int) -> None:
        n = len(tracked.disagreeing.ids)
        deforms = n > DEFORMING_SHARE * (n + tracked.n_inliers)
        self._n_deforming = self._n_deforming + 1 if deforms else 0
        is_due = self.options.freeze_when_deforming and self._n_deforming >= DEFORMING_FRAMES
        if is_due and not self.is_frozen and self._making.can_keep:
            self.freeze()
            self.frozen_at = index

    def _relocalize(self, view: FrameView) -> SlamFrame:
        with stage("relocalise"):
            found = self._relocalizer.find(view, self._tracker)
            if isinstance(found, NoPose):
                return self._without_pose(view, SlamStatus.LOST, found)
            pose, points = found
            self._n_held = 0
            self._tracker.place(pose.camera_from_world, points, view.timestamp)
        tracked = Tracked(pose, points, int(pose.inliers.sum()), NOWHERE)
        return self._with_pose(view, SlamStatus.RELOCALIZED, tracked, is_keyframe=False)

    def _without_pose(self, view: FrameView, status: SlamStatus, reason: NoPose) -> SlamFrame:
        corners = self._initializer.followed if status is SlamStatus.WAITING else NOWHERE.pixels
        return SlamFrame(view.index, view.timestamp, status, reason, candidates=corners, n_candidates=len(corners))

    def _with_pose(self, view: FrameView, status: SlamStatus, tracked: Tracked, is_keyframe: bool) -> SlamFrame:
        number = len(self.map.keyframes) - 1
        is_candidate = self.map.state[tracked.points.ids] == CANDIDATE
        points, candidates = tracked.points[~is_candidate], tracked.points.pixels[is_candidate]
        return SlamFrame(
            view.index,
            view.timestamp,
            status,
            pose=tracked.pose,
            points=points,
            candidates=candidates,
            disagreeing=tracked.disagreeing,
            keyframe=number,
            from_keyframe=pose_in_keyframe(self._tracker.camera_from_world, self.map.keyframes[number]),
            map_number=self.n_restarts,
            is_keyframe=is_keyframe,
            n_points=len(points.ids),
            n_candidates=len(candidates),
            n_disagreeing=len(tracked.disagreeing.ids),
        )


def _origin_of(baseline_px: float) -> str:
    return f"a baseline of {baseline_px:.1f} px m" if baseline_px else "the motion of one camera alone"


def _remedy(map_baseline_px: float) -> str:
    """What to do with a map of other depth, for the end of a sentence."""
    if map_baseline_px:
        return ": leave out --extend to find the camera in it, or map again"
    return ": leave depth images aside with --no-depth, or use the left camera of a pair alone"
