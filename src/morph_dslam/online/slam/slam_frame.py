"""What camera tracking hands over for each frame."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from morph_dslam.online.slam.pose import PoseEstimate
from morph_dslam.online.slam.rigid_map import NOWHERE, Followed
from morph_dslam.online.slam.tracking import Tracked

Array = NDArray[np.float64]

STAGES = ("prepare", "start", "track", "map", "relocalise")


@dataclass(frozen=True)
class SlamFrame:
    """What one frame gave.

    Attributes
    ----------
    status : "waiting" for a start, "tracked", "relocalised", or "lost". reason : why there is no pose.
    pose : from the map points, None without one.
    points : map points that agree with it, and their pixels.
    candidates : (c, 2) pixels of corners without depth.
    disagreeing : points that look like their map point but do not obey the rigid scene.
    keyframe : number of the keyframe in whose frame ``from_keyframe`` (4, 4) has the camera.
    map_number : how many maps had been given up before the one that the pose is in.
    is_keyframe : whether the map kept this view. timings_ms : by stage. total_ms : the whole frame.
    waited_ms : where the map is made beside the frames, the most that this one can have waited for it: the
        time of stage "map", and all the time in which the frame's thread did not run while the mapper did.
    n_points, n_candidates, n_disagreeing : how many there were.
    """

    index: int
    timestamp: float
    status: str
    reason: str
    pose: PoseEstimate | None = None
    points: Followed = NOWHERE
    candidates: Array = field(default_factory=lambda: np.empty((0, 2)))
    disagreeing: Followed = NOWHERE
    keyframe: int = -1
    from_keyframe: Array | None = None
    map_number: int = 0
    is_keyframe: bool = False
    timings_ms: dict[str, float] = field(default_factory=dict)
    total_ms: float = 0.0
    waited_ms: float = 0.0
    n_points: int = 0
    n_candidates: int = 0
    n_disagreeing: int = 0

    def record(self, is_final: bool) -> SlamFrame:
        """What is worth keeping of a frame of a long recording; no points where its pose is final."""
        pose = self.pose if self.pose is None else replace(self.pose, inliers=np.empty(0, dtype=bool))
        points = NOWHERE if is_final else self.points.without_unmeasured()
        return replace(self, pose=pose, points=points, candidates=NOWHERE.pixels, disagreeing=NOWHERE)


def corners_of(pixels: Array) -> dict[str, Any]:
    """Fields of a frame of which only corners (c, 2) without depth are known."""
    return {"candidates": pixels, "n_candidates": len(pixels)}


def points_of(tracked: Tracked, is_candidate: NDArray[np.bool_]) -> dict[str, Any]:
    """Fields of what was followed, some of it without its depth being known (n,)."""
    known = tracked.points[~is_candidate]
    counts = {"n_points": len(known.ids), "n_disagreeing": len(tracked.disagreeing.ids)}
    points = {"points": known, "disagreeing": tracked.disagreeing}
    return points | counts | corners_of(tracked.points.pixels[is_candidate])
