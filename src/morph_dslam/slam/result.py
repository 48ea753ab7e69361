"""What one frame gave: the camera's pose, or why there is none."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from enum import Enum, StrEnum

import numpy as np
from numpy.typing import NDArray

from morph_dslam.slam.pose import PoseEstimate
from morph_dslam.slam.rigid_map import NOWHERE, Followed

Array = NDArray[np.float64]
STAGES = ("prepare", "start", "track", "map", "relocalise")


class SlamStatus(StrEnum):
    """State of the camera in a frame: waiting for a map, tracked, found again after a loss, or lost.

    `FOUND_LATER`: the frame had no pose when it came, and has one in the finished map (`second_pass`).
    """

    WAITING = "waiting"
    TRACKED = "tracked"
    RELOCALIZED = "relocalised"
    LOST = "lost"
    FOUND_LATER = "found later"


class SlamReason(Enum):
    """Why a frame has no pose; each value is the message, with places for its numbers."""

    LITTLE_TEXTURE = "too little texture: {} corners"
    NO_MOTION = "waiting for the camera to move"
    FIRST_VIEW_LOST = "the first view was lost from sight"
    ONLY_TURNED = "not enough parallax: the camera has to move sideways, not only turn"
    LITTLE_PARALLAX = "not enough parallax: {:.1f} degrees"
    NO_TWO_VIEW_MOTION = "two views do not agree on a motion yet"
    THIRD_VIEW_NEEDED = "waiting for a third view to choose between {} possible motions"
    THIRD_VIEW_TOO_NEAR = "waiting for a third view from another place"
    THIRD_VIEW_UNEXPLAINED = "no motion of two views explains the third"
    FEW_RIGID_POINTS = "only {} of {} points fit a rigid scene in three views"
    LARGE_RIGID_ERROR = "three views fit a rigid scene to {:.1f} px only"
    AMBIGUOUS_MOTION = "two motions explain the views about equally well"
    FIRST_MAP_FAILED = "the first map did not hold"
    NO_DEPTH = "this frame has no depth"
    FEW_DEPTHS = "only {} corners with depth, {} are needed"
    FAR_DEPTHS = "it has depths of {:.3g} to {:.3g} m, of which those up to {:.2g} m count"
    FEW_POINTS = "only {} map points were found in this frame"
    FEW_INLIERS = "only {} of {} map points agree on a pose"
    RIVAL_MOTIONS = "two parts of the scene move apart, and which of them stands still is ambiguous"
    NO_SIMILAR_KEYFRAME = "the view resembles no keyframe"
    TWO_PLACES = "two places of the map look alike: one has {} points in this frame, the other {}"


@dataclass(frozen=True)
class NoPose:
    """Why a frame has no pose; as text it is a message.

    Attributes
    ----------
    reason : the kind of reason
    numbers : what its message counts or measures, in its order
    cause : the reason behind it, if there is one
    """

    reason: SlamReason
    numbers: tuple[float, ...] = ()
    cause: NoPose | None = None

    def __str__(self) -> str:
        text = self.reason.value.format(*self.numbers)
        return f"{text}: {self.cause}" if self.cause else text


@dataclass(frozen=True)
class SlamFrame:
    """What one frame gave.

    Attributes
    ----------
    index : number of the frame
    timestamp : seconds
    status : whether the camera was found
    reason : why there is no pose; None where there is one
    pose : from the map points, None without one
    points : map points that agree with it, and their pixels
    candidates : (c, 2) pixels of corners without depth
    disagreeing : points that look like their map point but do not obey the rigid scene
    keyframe : number of the keyframe in whose frame ``from_keyframe`` has the camera
    from_keyframe : (4, 4) the camera in the keyframe's frame
    map_number : how many maps had been given up before the one that the pose is in
    is_keyframe : whether the map kept this view
    n_points, n_candidates, n_disagreeing : how many there were
    timings_ms : by stage
    total_ms : the whole frame
    waited_ms : where the map is made beside the frames, the most that this one can have waited for it: the
        time of stage "map", and all the time in which the frame's thread did not run while the mapper did
    """

    index: int
    timestamp: float
    status: SlamStatus
    reason: NoPose | None = None
    pose: PoseEstimate | None = None
    points: Followed = NOWHERE
    candidates: Array = field(default_factory=lambda: np.empty((0, 2)))
    disagreeing: Followed = NOWHERE
    keyframe: int = -1
    from_keyframe: Array | None = None
    map_number: int = 0
    is_keyframe: bool = False
    n_points: int = 0
    n_candidates: int = 0
    n_disagreeing: int = 0
    timings_ms: dict[str, float] = field(default_factory=dict)
    total_ms: float = 0.0
    waited_ms: float = 0.0

    def record(self, is_final: bool) -> SlamFrame:
        """What is worth keeping of a frame of a long recording; no points where its pose is final."""
        pose = self.pose if self.pose is None else replace(self.pose, inliers=np.empty(0, dtype=bool))
        points = NOWHERE if is_final else self.points.without_unmeasured()
        return replace(self, pose=pose, points=points, candidates=NOWHERE.pixels, disagreeing=NOWHERE)
