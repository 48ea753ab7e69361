"""Whether another focal length would explain the map clearly better: then the calibration is suspect.

Keyframes and points are adjusted once more for each of some focal lengths. With the right one, errors are
those of following corners; with a wrong one, a camera that turns and moves leaves more. Where the camera
hardly turned, any focal length fits about as well, and then nothing is said.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from morph_dslam.slam.bundle_adjustment import Observations, adjust
from morph_dslam.slam.rigid_map import GOOD, RigidMap

Array = NDArray[np.float64]

#: Factors of the focal length that are tried; the ends mean that it may lie beyond.
FACTORS = np.exp(np.linspace(np.log(0.7), np.log(1.43), 9))

#: Keyframes that are adjusted, and the fewest that say anything.
MOST_KEYFRAMES, LEAST_KEYFRAMES = 12, 5
#: The cost with the best factor has to be this part of the given one's, and the factor this far from 1.
MOST_COST, LEAST_DEVIATION = 0.7, 0.04


def suspected_focal_factor(rigid_map: RigidMap, intrinsics: Array) -> float | None:
    """By what the focal length would have to be multiplied; None where the given one is as good as any.

    Parameters
    ----------
    intrinsics : (4,) fx, fy, cx, cy that the map was made with.
    """
    if len(rigid_map.keyframes) < LEAST_KEYFRAMES:
        return None
    costs = np.array([_cost(rigid_map, intrinsics, factor) for factor in (1.0, *FACTORS)])
    given, tried = costs[0], costs[1:]
    best = int(tried.argmin())
    if tried[best] > MOST_COST * given:
        return None
    factor = float(FACTORS[best])
    if 0 < best < len(FACTORS) - 1:
        # The factor at the bottom of the parabola through the three costs around the least, over equal steps.
        left, middle, right = tried[best - 1 : best + 2]
        shift = 0.5 * (left - right) / (left - 2.0 * middle + right)
        factor *= float((FACTORS[1] / FACTORS[0]) ** shift)
    return factor if abs(factor - 1.0) > LEAST_DEVIATION else None


def _cost(rigid_map: RigidMap, intrinsics: Array, factor: float) -> float:
    """Huber cost, px^2, of keyframes spread over the map after adjustment with another focal length."""
    kept = rigid_map.kept_keyframes
    chosen = np.unique(np.linspace(0, len(kept) - 1, min(len(kept), MOST_KEYFRAMES)).astype(int))
    keyframes = [rigid_map.keyframes[k] for k in kept[chosen]]
    counts = np.zeros(len(rigid_map.state), dtype=int)
    for keyframe in keyframes:
        counts[keyframe.point_ids] += 1
    wanted = (counts >= 2) & (rigid_map.state == GOOD)
    local = np.cumsum(wanted) - 1
    rows_of = [wanted[keyframe.point_ids] for keyframe in keyframes]
    seen = [(local[k.point_ids[rows]], k.pixels[rows]) for k, rows in zip(keyframes, rows_of, strict=True)]
    observations = Observations(
        np.repeat(np.arange(len(keyframes)), [len(ids) for ids, _ in seen]),
        np.concatenate([ids for ids, _ in seen]),
        np.concatenate([pixels for _, pixels in seen]),
    )
    poses = np.array([keyframe.camera_from_world for keyframe in keyframes])
    scaled = intrinsics * [factor, factor, 1.0, 1.0]
    held = np.arange(len(keyframes)) == 0
    points = rigid_map.positions[wanted]
    return adjust(poses, points, observations, scaled, held, huber_px=1.0, iterations=25, tolerance=1e-4).cost
