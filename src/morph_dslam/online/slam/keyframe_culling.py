"""Taking out keyframes that show hardly anything that others do not show.

Where the camera comes back to places that are mapped, it adds keyframes there as it does elsewhere. Those
whose points are seen often enough without them go (Mur-Artal, Montiel and Tardós, ORB-SLAM, 2015), so that a
map grows with the scene and not with time. Small maps are left whole.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from morph_dslam.online.slam.rigid_map import CANDIDATE, GOOD, Indices, RigidMap

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
        newest = rigid_map.keyframes[-1].point_ids
        shared = rigid_map.shared_points(newest[rigid_map.state[newest] == GOOD])
        numbers = np.flatnonzero(shared[:-RECENT])
        # The first keyframe holds the world; candidates get their depth from where they were first seen.
        waited_for = rigid_map.first_keyframe[rigid_map.state == CANDIDATE]
        numbers = numbers[(numbers > 0) & ~np.isin(numbers, waited_for)]
        shares = redundancy(rigid_map, numbers)
        if not len(numbers) or shares.max() < REDUNDANT_SHARE:
            return
        gone = int(numbers[shares.argmax()])
        others = rigid_map.shared_points(_good(rigid_map, gone))
        others[gone] = 0
        rigid_map.remove_keyframe(gone, carrier=int(others.argmax()))


def redundancy(rigid_map: RigidMap, numbers: Indices) -> NDArray[np.float64]:
    """Share (n,) of each keyframe's map points that enough other keyframes see."""
    counts = np.zeros(len(rigid_map.state), dtype=np.int64)
    for keyframe in rigid_map.keyframes:
        counts[keyframe.point_ids] += 1
    known = [_good(rigid_map, k) for k in numbers]
    return np.array([float((counts[ids] > ENOUGH_OTHERS).mean()) if len(ids) else 1.0 for ids in known])


def _good(rigid_map: RigidMap, number: int) -> Indices:
    ids = rigid_map.keyframes[number].point_ids
    return ids[rigid_map.state[ids] == GOOD]
