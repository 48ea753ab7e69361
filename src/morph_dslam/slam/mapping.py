"""Building the map: which views it keeps, their points, culling, local bundle adjustment; in steps.

Work is a generator that pauses where what follows can wait for another frame. In step with the frames, one step a frame
changes the map itself, so that the same frames give the same map. Beside them, a thread does each step on a copy of the
map, which replaces the map when the step has ended: frames wait for none.
"""

from __future__ import annotations

import os
import sys
import threading
from collections.abc import Callable, Generator
from concurrent.futures import Future, ThreadPoolExecutor, wait

import numpy as np
from numpy.typing import NDArray

from morph_dslam.camera import Camera
from morph_dslam.slam.frame_images import FrameView
from morph_dslam.slam.initialization import MapStart
from morph_dslam.slam.least_squares_matching import Moves, measure_again
from morph_dslam.slam.local_map import PointMaker, free_corners, gather, local_window, put_back
from morph_dslam.slam.options import LEAST_INLIERS
from morph_dslam.slam.pose import camera_centre, inverse, project
from morph_dslam.slam.rigid_map import CANDIDATE, GOOD, NOWHERE, UNKNOWN_TWIST, Followed, Indices, Keyframe, RigidMap
from morph_dslam.slam.tracking import Tracked

Array = NDArray[np.float64]
#: A keyframe is due when fewer than this share of the last one's points are left, when points have moved this far
#: since it (median), or when the camera has moved this part of the median depth.
KEYFRAME_SHARE, KEYFRAME_MOTION_PX, KEYFRAME_BASELINE = 0.75, 30.0, 0.06
#: Where keyframes can wait, they wait for frames in which the image moves less than this, pixels: fast motion blurs,
#: and most cameras read their rows one after the other, which bends what they see.
QUIET_PX = 5.0
#: They cannot wait when fewer than this share of the last one's points are left.
URGENT_SHARE = 0.6
LEAST_FRAMES_BETWEEN = 3


def median_depth(rigid_map: RigidMap, pose: Array, ids: Indices, intrinsics: Array, unknown: float) -> float:
    """Median depth of the map points among some, seen from a pose (4, 4); ``unknown`` without any."""
    _, depths = project(pose, rigid_map.positions[rigid_map.good_among(ids)], intrinsics)
    return max(float(np.median(depths)), 1e-6) if len(depths) else unknown


class KeyframeChoice:
    """Tells when a view is worth keeping.

    Attributes
    ----------
    unknown_depth : depth of a scene of which nothing is known.
    """

    def __init__(self, rigid_map: RigidMap, intrinsics: Array, unknown_depth: float) -> None:
        self._map, self._intrinsics = rigid_map, intrinsics
        self.unknown_depth = unknown_depth
        self._n_points, self._frame_index = 0, -LEAST_FRAMES_BETWEEN

    def kept(self, number: int, frame_index: int) -> int:
        """Note a new keyframe; returns how many map points it sees."""
        self._n_points, self._frame_index = len(self._map.good_in(number)), frame_index
        return self._n_points

    def wants(self, tracked: Tracked, frame_index: int) -> bool:
        """Whether the map should keep this view."""
        if frame_index - self._frame_index < LEAST_FRAMES_BETWEEN:
            return False
        if tracked.n_inliers < max(URGENT_SHARE * self._n_points, 4 * LEAST_INLIERS):
            return True
        if tracked.image_motion_px > QUIET_PX:
            return False
        return tracked.n_inliers < KEYFRAME_SHARE * self._n_points or self._has_moved_on(tracked)

    def _has_moved_on(self, tracked: Tracked) -> bool:
        """Whether points, or the camera, have moved far since the last keyframe."""
        last, pose = self._map.keyframes[-1], tracked.pose.camera_from_world
        rows, seen = last.rows_of(tracked.points.ids)
        if not seen.any():
            return True
        motion = np.linalg.norm(tracked.points.pixels[seen] - last.pixels[rows[seen]], axis=1)
        baseline = np.linalg.norm(camera_centre(pose) - camera_centre(last.camera_from_world))
        depth = median_depth(self._map, pose, tracked.points.ids, self._intrinsics, self.unknown_depth)
        return bool(np.median(motion) > KEYFRAME_MOTION_PX or baseline / depth > KEYFRAME_BASELINE)


#: Maps of at most so many keyframes are left whole.
ENOUGH_KEYFRAMES = 40
#: A keyframe can go if at least this share of its points is seen by so many others.
REDUNDANT_SHARE, ENOUGH_OTHERS = 0.9, 3
#: The newest keyframes stay: what they show has not been seen often yet.
RECENT = 8
#: Keyframes that go at once: more than come, so that a map that has become too large shrinks again.
MOST_AT_ONCE = 2


def cull_keyframes(rigid_map: RigidMap) -> None:
    """Take out the keyframes around the newest one that can go, the most redundant ones first."""
    for _ in range(MOST_AT_ONCE):
        if len(rigid_map.kept_keyframes) <= ENOUGH_KEYFRAMES:
            return
        shared = rigid_map.shared_points(rigid_map.good_in(-1))
        numbers = np.flatnonzero(shared[:-RECENT])
        # The first keyframe holds the world; candidates get their depth from where they were first seen.
        waited_for = rigid_map.first_keyframe[rigid_map.state == CANDIDATE]
        numbers = numbers[(numbers > 0) & ~np.isin(numbers, waited_for)]
        shares = redundancy(rigid_map, numbers)
        if not len(numbers) or shares.max() < REDUNDANT_SHARE:
            return
        gone = int(numbers[shares.argmax()])
        others = rigid_map.shared_points(rigid_map.good_in(gone))
        others[gone] = 0
        rigid_map.remove_keyframe(gone, carrier=int(others.argmax()))


def redundancy(rigid_map: RigidMap, numbers: Indices) -> NDArray[np.float64]:
    """Share (n,) of each keyframe's map points that enough other keyframes see."""
    counts = np.zeros(len(rigid_map.state), dtype=np.int64)
    for keyframe in rigid_map.keyframes:
        counts[keyframe.point_ids] += 1
    known = [rigid_map.good_in(k) for k in numbers]
    return np.array([float((counts[ids] > ENOUGH_OTHERS).mean()) if len(ids) else 1.0 for ids in known])


#: Map points that are found in a smaller share of the frames that should show them are taken out.
LEAST_FOUND = 0.1
#: Iterations of local bundle adjustment, and after how many of them it pauses.
LOCAL_ITERATIONS, LOCAL_PAUSE = 10, 4


class Mapper:
    """Adds views to a map and keeps it right.

    Parameters
    ----------
    hold_poses : whether the keyframes' poses are given, and only points are adjusted.
    unknown_depth : at which corners are taken to be while nothing else is known.
    """

    def __init__(
        self, rigid_map: RigidMap, camera: Camera, hold_poses: bool = False, unknown_depth: float = 1.0
    ) -> None:
        self._map, self._camera, self._intrinsics = rigid_map, camera, camera.intrinsics
        self._hold_poses = hold_poses
        self._points = PointMaker(rigid_map, camera.intrinsics)
        self._choice = KeyframeChoice(rigid_map, camera.intrinsics, unknown_depth)

    def begin(self, start: MapStart) -> None:
        """Fill the empty map from three views, median depth 1 in the first."""
        scale = 1.0 / float(np.median(start.points[:, 2]))
        ids = self._map.add_points(scale * start.points, start.views[0].pixels, 0, GOOD)
        for view, pose, twist in zip(start.views, start.poses, start.twists, strict=True):
            scaled, velocity = pose.copy(), twist.copy()
            scaled[:3, 3] *= scale
            velocity[3:] *= scale
            self._map.add_keyframe(Keyframe.of_view(view.frame, scaled, Followed(ids.copy(), view.pixels), velocity))
        do_all(self._adjust_locally())
        self._add_corners(2, start.views[2].frame)
        for keyframe, view in zip(self._map.keyframes, start.views, strict=True):
            do_all(keyframe.describe(view.frame.grey))

    def begin_at(self, view: FrameView, camera_from_world: Array, twist: Array = UNKNOWN_TWIST) -> int:
        """Fill the empty map from one view at a pose (4, 4); returns how many points have a depth.

        ``twist`` : (6,) the camera's velocity, as of `Keyframe`.
        """
        number = self._map.add_keyframe(Keyframe.of_view(view, camera_from_world, NOWHERE, twist))
        self._add_corners(number, view)
        do_all(self._map.keyframes[number].describe(view.grey))
        return int((self._map.state == GOOD).sum())

    def wants_keyframe(self, tracked: Tracked, frame_index: int) -> bool:
        """Whether the map should keep this view."""
        return self._choice.wants(tracked, frame_index)

    def insert(self, tracked: Tracked, view: FrameView) -> Work:
        """Keep a view: its points, then the adjustment, then new corners, then its description.

        Points that have left the rigid scene are taken out: when an object comes back to where it was, its
        points must not hold the camera.
        """
        self._map.remove(tracked.moved)
        number = self._map.add_keyframe(
            Keyframe.of_view(view, tracked.pose.camera_from_world, tracked.points, tracked.twist)
        )
        self._points.place_by_depth(number, view.depth)
        self._points.triangulate(number)
        self._points.fuse(number)
        yield
        yield from self._adjust_locally()
        self._cull()
        yield
        cull_keyframes(self._map)
        self._add_corners(number, view)
        yield
        yield from self._map.keyframes[number].describe(view.grey)

    def adjust_all(self) -> None:
        """Bundle adjustment of the whole map."""
        none = np.empty(0, dtype=np.int64)
        problem = gather(self._map, self._camera, self._map.kept_keyframes, none, 20, self._hold_poses)
        put_back(self._map, problem, problem.solve())

    def complete(self) -> Moves:
        """Measure all points again, and adjust the whole map to that; by how much they moved in its keyframes."""
        self.adjust_all()
        moves = measure_again(self._map, self._intrinsics)
        self.adjust_all()
        return moves

    def _add_corners(self, number: int, view: FrameView) -> None:
        """New corners to follow."""
        keyframe = self._map.keyframes[number]
        corners = free_corners(keyframe.normalized, keyframe.pixels)
        if len(corners):
            depth = median_depth(
                self._map, keyframe.camera_from_world, keyframe.point_ids, self._intrinsics, self._choice.unknown_depth
            )
            self._points.add_candidates(number, corners, depth)
        self._points.place_by_depth(number, view.depth)
        self._choice.kept(number, view.index)

    def _adjust_locally(self) -> Work:
        """Bundle adjustment of the newest keyframes that see the same points, held by others that do."""
        window, holders = local_window(self._map)
        problem = gather(self._map, self._camera, window, holders, LOCAL_PAUSE, self._hold_poses)
        result = problem.solve()
        if result.iterations == LOCAL_PAUSE:
            yield
            result = problem.after(result, LOCAL_ITERATIONS - LOCAL_PAUSE).solve()
        put_back(self._map, problem, result)

    def _cull(self) -> None:
        """Take out map points that are hardly ever found where they should be."""
        rigid_map = self._map
        rare = rigid_map.n_found < LEAST_FOUND * rigid_map.n_expected
        rigid_map.remove(np.flatnonzero((rigid_map.state == GOOD) & rare & (rigid_map.n_expected >= 20)))


def pose_in_keyframe(camera_from_world: Array, keyframe: Keyframe) -> Array:
    """The camera in a keyframe's frame (4, 4), which later adjustments of the keyframe carry along."""
    return camera_from_world @ inverse(keyframe.camera_from_world)


Work = Generator[None, None, None]
#: By how much the thread's priority is lower, in steps of `nice`: with this it still gets a third of what
#: another program gets. With far less it would be stopped for long while it holds the interpreter.
STANDS_BACK = 5


def do_all(work: Work) -> None:
    """Do work from its beginning to its end."""
    for _ in work:
        pass


def one_step(do: Callable[[], None]) -> Work:
    """Work without a pause."""
    do()
    yield from ()


def _stand_back() -> None:
    """Let this thread run behind the one that tracks, where both want the same processor.

    Where other programs run too, frames would else wait for whole slices of the scheduler, some milliseconds
    each. On Linux each thread has a priority of its own.
    """
    if sys.platform == "linux":
        own = os.getpriority(os.PRIO_PROCESS, 0)
        os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), own + STANDS_BACK)


class MappingWork:
    """Work under way, at most one at a time.

    Parameters
    ----------
    threaded : whether steps are done in a thread beside the frames.
    before : done there before each step.
    after : done after each, by who goes on with the work.
    """

    def __init__(
        self, threaded: bool, before: Callable[[], None] = lambda: None, after: Callable[[], None] = lambda: None
    ) -> None:
        self._work: Work | None = None
        self._running: Future[bool] | None = None
        self._before, self._after = before, after
        self._thread = ThreadPoolExecutor(1, "mapper", _stand_back) if threaded else None

    @property
    def is_idle(self) -> bool:
        """Whether nothing is under way."""
        return self._work is None

    def wait(self) -> None:
        """Wait until no step is being done in the thread."""
        if self._running is not None:
            wait([self._running])

    def begin(self, work: Work) -> None:
        """Begin new work: do its first step, or have it done."""
        self._work = work
        self._next_step()

    def advance(self) -> None:
        """Go on with the next step; do nothing while one is running in the thread."""
        if self._running is None:
            self._next_step()
        elif self._running.done():
            self._end_step(self._running.result())
            self._next_step()

    def finish(self) -> None:
        """Do all that is left now."""
        while self._work is not None:
            if self._running is not None:
                self._end_step(self._running.result())
            self._next_step()

    def drop(self) -> None:
        """Leave what is under way; the map is as its last step left it."""
        self._work, self._running = None, None

    def _next_step(self) -> None:
        if self._work is None:
            return
        if self._thread is None:
            self._end_step(self._step(self._work))
        else:
            self._running = self._thread.submit(self._step, self._work)

    def _step(self, work: Work) -> bool:
        """Do work up to its next pause; whether that was its end."""
        self._before()
        return next(work, _END) is _END

    def _end_step(self, is_end: bool) -> None:
        self._running = None
        if is_end:
            self._work = None
        self._after()


_END = object()
