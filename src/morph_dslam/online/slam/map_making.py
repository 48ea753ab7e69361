"""The mapper's work and the search for loops, in step with the frames or beside them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from morph_dslam.online.slam.frame_images import FrameView
from morph_dslam.online.slam.loop_closing import LoopCloser
from morph_dslam.online.slam.mapping import Mapper
from morph_dslam.online.slam.mapping_work import MappingWork, Work, do_all
from morph_dslam.online.slam.options import SlamOptions
from morph_dslam.online.slam.rigid_map import RigidMap
from morph_dslam.online.slam.tracking import Tracked, Tracker

Array = NDArray[np.float64]


class MapMaking:
    """Makes one map while a tracker follows it.

    Keeping a view, and closing a loop, are work of which there is one piece at a time. Loops are looked for
    apart from it, so that the map can grow meanwhile.

    Attributes
    ----------
    mapper : for the map's beginning.
    """

    def __init__(
        self, rigid_map: RigidMap, intrinsics: Array, options: SlamOptions, tracker: Tracker, threaded: bool
    ) -> None:
        self._map, self._tracker = rigid_map, tracker
        self.mapper = Mapper(rigid_map, intrinsics, options)
        self._loops = LoopCloser(rigid_map, intrinsics, options, self.mapper)
        self._work, self._search = MappingWork(threaded), MappingWork(threaded)

    @property
    def can_keep(self) -> bool:
        """Whether the view before has been worked in."""
        return self._work.is_idle

    @property
    def is_idle(self) -> bool:
        """Whether nothing is under way that later frames go on with."""
        return self._work.is_idle and self._search.is_idle

    @property
    def n_loops(self) -> int:
        """Loops closed."""
        return self._loops.n_closed

    def keep(self, tracked: Tracked, view: FrameView) -> None:
        """Keep the view of the newest frame, and follow its points."""
        self._work.begin(self._keep(tracked, view))
        keyframe = self._map.keyframes[-1]
        self._tracker.points = keyframe.seen
        self._tracker.camera_from_world = keyframe.camera_from_world

    def advance(self) -> None:
        """Take the next step, and let the tracker follow what it changed."""
        self._search.advance()
        self._proceed(to_end=False)

    def finish(self, with_loops: bool) -> None:
        """Bring what has been begun to its end; a search for loops only if wanted."""
        if with_loops:
            self._search.finish()
        self._search.drop()
        self._proceed(to_end=True)

    def adjust_all(self) -> None:
        """Adjust all keyframes and points together."""
        do_all(self.mapper.adjust_all())

    def _keep(self, tracked: Tracked, view: FrameView) -> Work:
        yield from self.mapper.insert(tracked, view)
        yield None
        if self._search.is_idle:
            self._search.begin(self._loops.search(view))

    def _proceed(self, to_end: bool) -> None:
        if not self._map.keyframes:
            return
        keyframe = self._map.keyframes[-1]
        pose, ids = keyframe.camera_from_world, keyframe.point_ids
        proceed = self._work.finish if to_end else self._work.advance
        proceed()
        if self._loops.has_found and self._work.is_idle:
            self._work.begin(self._loops.close())
            proceed()
        if keyframe.camera_from_world is not pose:
            self._tracker.correct(pose, keyframe.camera_from_world)
        if keyframe.point_ids is not ids:
            self._tracker.take_up(np.setdiff1d(keyframe.point_ids, ids))
