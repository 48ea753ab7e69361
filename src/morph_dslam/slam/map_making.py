"""The mapper's work and the search for loops, in step with the frames or beside them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from morph_dslam.camera import Camera
from morph_dslam.slam.frame_images import FrameView
from morph_dslam.slam.initialization import MapStart
from morph_dslam.slam.least_squares_matching import Moves
from morph_dslam.slam.loop_closing import LoopCloser
from morph_dslam.slam.mapping import Mapper, MappingWork, Work, do_all, one_step
from morph_dslam.slam.rigid_map import Indices, RigidMap
from morph_dslam.slam.tracking import Tracked, Tracker

Array = NDArray[np.float64]


class MapMaking:
    """Makes one map while a tracker follows it.

    Keeping a view, and closing a loop, are work of which there is one piece at a time. Loops are looked for
    apart from it, so that the map can grow meanwhile.

    Parameters
    ----------
    threaded : whether that is done beside the frames: on a draft, a copy of the map, which is taken over
        after each step. Tracking then changes nothing of the map but its counts.
    """

    def __init__(self, rigid_map: RigidMap, camera: Camera, tracker: Tracker, threaded: bool) -> None:
        self._map, self._tracker, self._threaded = rigid_map, tracker, threaded
        self._draft = RigidMap(rigid_map.baseline_px) if threaded else rigid_map
        self._renew()
        self._mapper = Mapper(self._draft, camera)
        self._loops = LoopCloser(self._draft, camera, self._mapper)
        self._work, self._search = MappingWork(threaded, self._renew, self._publish), MappingWork(threaded)
        self._kept: tuple[FrameView, Tracked] | None = None
        self._is_waited_for = False

    @property
    def can_keep(self) -> bool:
        """Whether the view before has been worked in."""
        return self._work.is_idle

    @property
    def is_idle(self) -> bool:
        """Whether nothing is under way that later frames go on with."""
        return self._work.is_idle and self._search.is_idle

    def wait(self) -> None:
        """Wait until nothing is being done beside the frames."""
        self._work.wait()
        self._search.wait()

    @property
    def n_loops(self) -> int:
        """Loops closed."""
        return self._loops.n_closed

    def begin(self, start: MapStart) -> None:
        """Fill the empty map from three views."""
        self._mapper.begin(start)
        self._publish()

    def begin_at(self, view: FrameView, camera_from_world: Array) -> int:
        """Fill the empty map from one view at a pose (4, 4); returns how many points have a depth."""
        n = self._mapper.begin_at(view, camera_from_world)
        self._publish()
        return n

    def wants_keyframe(self, tracked: Tracked, frame_index: int) -> bool:
        """Whether the map should keep a view, and can."""
        if self._threaded and not self.can_keep:
            return False  # the draft, which this looks at, is being changed beside the frames
        wants = self._mapper.wants_keyframe(tracked, frame_index)
        self._is_waited_for = wants and not self.can_keep
        return wants and self.can_keep

    def keep(self, tracked: Tracked, view: FrameView) -> None:
        """Keep the view of the newest frame, and follow its points."""
        self._kept = view, tracked
        self._work.begin(self._insert(tracked, view))
        if not self._threaded:
            keyframe = self._map.keyframes[-1]
            self._tracker.points = keyframe.seen
            self._tracker.camera_from_world = keyframe.camera_from_world

    def advance(self) -> None:
        """Take the next step, or all where a view waits to be kept, and let the tracker follow what changed."""
        self._search.advance()
        self._proceed(to_end=self._is_waited_for and not self._threaded)

    def end_frame(self) -> None:
        """Beside the frames, begin to close a loop that was found, unless this frame is being kept.

        No view can be kept until the loop is closed, and a frame with few points left must not wait so long.
        """
        if self._threaded:
            self._close_loop()

    def stop(self) -> None:
        """Leave the map as it is from now on.

        A step of work that is being done beside the frames does not count any more: they wait for nothing.
        """
        self._search.drop()
        if self._threaded:
            self._work.drop()
        else:
            self._proceed(to_end=True)

    def finish(self) -> Moves:
        """Bring what has been begun to its end, measure all points again, and adjust them and the keyframes together.

        Returns by how much the points moved in the keyframes.
        """
        self._search.finish()
        self._proceed(to_end=True)
        if len(self._map.keyframes) <= 2:
            return {}
        self._renew()
        moves = self._mapper.complete()
        self._publish()
        return moves

    def _insert(self, tracked: Tracked, view: FrameView) -> Work:
        steps = self._mapper.insert(tracked, view)
        if self._threaded:
            # Beside the frames nothing is put off: new corners would only be followed later.
            do_all(steps)
        else:
            yield from steps
        # A search for loops may follow, in another frame.
        yield

    def _renew(self) -> None:
        if self._threaded:
            self._draft.copy_of(self._map)

    def _publish(self) -> None:
        if self._threaded:
            self._map.take_over(self._draft)

    def _proceed(self, to_end: bool) -> None:
        if not self._map.keyframes:
            return
        newest, n_keyframes = self._map.keyframes[-1], len(self._map.keyframes)
        pose, ids = newest.camera_from_world, newest.point_ids
        proceed = self._work.finish if to_end else self._work.advance
        proceed()
        if self._kept is not None and len(self._map.keyframes) > n_keyframes:
            # The view kept came with the draft: tracking went on from what it was as a frame.
            _, tracked = self._kept
            pose, ids = tracked.pose.camera_from_world, tracked.points.ids
        if self._kept is not None and self._work.is_idle:
            view, self._kept = self._kept[0], None
            if self._search.is_idle and not self._loops.has_found:
                self._search.begin(self._loops.search(view))
        if (to_end or not self._threaded) and self._close_loop():
            proceed()
        self._follow(pose, ids)

    def _close_loop(self) -> bool:
        """Begin to close a loop that was found, if nothing else is under way; whether it was begun."""
        begins = self._loops.has_found and self._work.is_idle
        if begins:
            self._work.begin(one_step(self._loops.close))
        return begins

    def _follow(self, pose: Array, ids: Indices) -> None:
        """Let the tracker follow what changed for the newest keyframe, whose pose and points these were."""
        newest = self._map.keyframes[-1]
        if newest.camera_from_world is not pose:
            self._tracker.correct(pose, newest.camera_from_world)
        if newest.point_ids is not ids:
            self._tracker.take_up(np.setdiff1d(newest.point_ids, ids))
