"""What camera tracking hands over for each frame."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from morph_dslam.online.slam.pose import PoseEstimate
from morph_dslam.online.slam.rigid_map import NOWHERE, Followed

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
