"""Whether a recording in a known map has the focal length that the map was made with.

What deforms in a map that is kept may look like another focal length. So two witnesses have to agree: the recording by
itself, whose points are adjusted too, and the map as it is, which is independent of what the recording says of shapes.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from morph_dslam.camera import Camera
from morph_dslam.io.trajectory import Trajectory
from morph_dslam.slam.camera_terms import CameraEstimate
from morph_dslam.slam.options import LEAST_INLIERS
from morph_dslam.slam.pose import refine_pose
from morph_dslam.slam.rigid_map import Followed, Indices, RigidMap

#: A smaller part of the focal length may be what the map is bent by, or a focus that was set anew. So many deviations.
LEAST_DEPARTURE, CLEARLY = 0.05, 5.0
#: Frames that are placed anew by the map, spread over the recording.
MOST_FRAMES = 60
#: Points that count at the given focal length count at another one too, where they are off by more, pixels.
INLIER_PX = 20.0


def focal_note(
    found: CameraEstimate, rigid_map: RigidMap, camera: Camera, path: Trajectory, seen: Sequence[Followed]
) -> str | None:
    """That a recording in a known map was filmed with another focal length; None if it does not say so.

    Parameters
    ----------
    found : focal length and lens by the recording alone
    rigid_map : as it was known
    camera : that the map was made with
    path : of n frames through the map
    seen : the map's points in each of them (n)
    """
    focal = found.terms["focal"]
    if not focal.departure > max(LEAST_DEPARTURE, CLEARLY * focal.departure_std):
        return None
    rows = np.unique(np.linspace(0, len(path) - 1, MOST_FRAMES).astype(int))
    rows = rows[[len(seen[row].ids) >= LEAST_INLIERS for row in rows]]
    ratio = focal.estimated[0] / focal.given[0]
    if not _miss(ratio, rows, rigid_map, camera, path, seen) < _miss(1.0, rows, rigid_map, camera, path, seen):
        return None
    return (
        f"the focal length of the camera file and of the map does not fit this recording: {focal.given[0]:.1f} px, by "
        f"the recording {focal.estimated[0]:.1f} ± {2.0 * focal.std[0]:.1f} px (95 %). Positions are wrong by more "
        "than they state. If the map was made with another zoom or crop, resample these pictures to the map's camera "
        "(docs/slam.md), or map this recording by itself with its own camera file; else calibrate the camera again"
    )


def _miss(
    ratio: float, rows: Indices, rigid_map: RigidMap, camera: Camera, path: Trajectory, seen: Sequence[Followed]
) -> float:
    """Median over frames (k,) of how far the map's points miss, pixels, with so many times the focal length."""
    intrinsics = np.asarray(camera.intrinsics) * [ratio, ratio, 1.0, 1.0]
    poses = path.camera_from_world
    misses = [
        refine_pose(
            poses[row], rigid_map.positions[seen[row].ids], seen[row].pixels, intrinsics, inlier_px=INLIER_PX
        ).rms_px
        for row in rows.tolist()
    ]
    return float(np.nanmedian(misses)) if np.isfinite(misses).any() else np.inf
