"""Where several objects hide each other in the pictures that they are known by.

An object's texture must not be taken where another one is before it: not in the frame that it starts from,
and not in any keyframe of the scan. All are drawn where they are there, and the nearest is what is seen.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from morph_dslam.online.estimation.estimator import State
from morph_dslam.online.measuring.binding import DrawnSurface, draw_view, view_of
from morph_dslam.online.several.several_objects import widened
from morph_dslam.online.start.placement import Placement
from morph_dslam.online.start.scan_pictures import ScanPicture
from morph_dslam.online.tracking_setup import Setup


@dataclass(frozen=True)
class Known:
    """An object, where it is, and the ``frame`` that it starts from."""

    setup: Setup
    placement: Placement
    frame: int

    @cached_property
    def _surface(self) -> DrawnSurface:
        return DrawnSurface.of(self.placement.model)

    def state_in(self, frame: int, keyframe: ScanPicture | None) -> State | None:
        """The object in a frame, a keyframe of the map or not; None where nobody knows where it is."""
        placement = self.placement
        if frame == self.frame:
            return placement.state
        pose = next((view.pose for view in placement.views if view.frame == frame), None)
        is_in_map = self.setup.map_path is not None and placement.place is not None
        if pose is None and is_in_map and keyframe is not None:
            assert placement.place is not None
            pose = placement.place.pose_in(keyframe.camera_from_world)
        return None if pose is None else State(placement.model.default, pose)

    def depth(self, state: State) -> NDArray[np.float32]:
        """Depth (h, w) of the object in a state, metres, infinite where it is not."""
        camera, drawn = self.setup.camera, self._surface.model
        return draw_view(view_of(drawn, camera, state), drawn.triangles, camera).depth


def seen_parts(objects: Sequence[Known]) -> list[dict[int, NDArray[np.bool_]]]:
    """By object and frame where (h, w) a picture shows the object, if another one hides some of it there."""
    return [_seen_part(known, [other for other in objects if other is not known]) for known in objects]


def _seen_part(known: Known, others: Sequence[Known]) -> dict[int, NDArray[np.bool_]]:
    keyframes, seen = known.setup.keyframes, {}
    for frame in {known.frame, *keyframes}:
        keyframe = keyframes.get(frame)
        state = known.state_in(frame, keyframe)
        there = [(other, other.state_in(frame, keyframe)) for other in others]
        before = [widened(other.depth(placed)) for other, placed in there if placed is not None]
        if state is None or not before:
            continue
        own = known.depth(state)
        covered = np.isfinite(own)
        shown = covered & (own <= np.minimum.reduce(before))
        if not np.array_equal(shown, covered):
            seen[frame] = shown
    return seen
