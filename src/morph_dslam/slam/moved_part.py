"""Whether a part of a known map stands elsewhere now: the points that disagree, by a second rigid pose.

What hides a point, or another light on it, leaves nothing that looks like it elsewhere. Points that look like those of
the map, and are where one and the same motion puts them in many frames, were moved. Which of both parts was moved, that
which the camera follows or the other one, no picture tells.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from morph_dslam.camera import Camera
from morph_dslam.io.trajectory import Trajectory
from morph_dslam.notices import Notice
from morph_dslam.slam.rigid_map import Followed, RigidMap

Array = NDArray[np.float64]
#: Points that disagree in a frame: so many at least, and this part of all that were found again. A moved box is less.
LEAST_ASTRAY, LEAST_SHARE = 20, 0.12
#: The second pose puts this part of them to within so many pixels of where they are.
LEAST_AGREEING, AGREEING_PX = 0.6, 2.5
#: So many frames, of the `MOST_FRAMES` that are looked at, in which the motion is the same to this part of its size.
LEAST_FRAMES, MOST_FRAMES, ALIKE = 5, 60, 0.5


@dataclass(frozen=True)
class MapPartMoved(Notice):
    """A part of a known map stands elsewhere in the recording.

    Attributes
    ----------
    n_frames : in which points of this part were followed.
    share : of the points that were found again in these frames, at most.
    shift : by which the part's middle is moved against the rest, map units, or metres in a metric map.
    unit : of ``shift``.
    """

    template = (
        "a part of the map stands elsewhere: in {n_frames} frames up to {share:.0%} of the points that were found "
        "again are where one rigid motion puts them, {shift:.3g} {unit} from their places. Which part was moved no "
        "picture tells: positions hold for the part that the camera follows. Map the scene again"
    )

    n_frames: int
    share: float
    shift: float
    unit: str


def moved_part(
    rigid_map: RigidMap, camera: Camera, path: Trajectory, seen: Mapping[int, Followed], astray: Mapping[int, Followed]
) -> MapPartMoved | None:
    """That a part of a known map was moved, if the frames show it.

    Parameters
    ----------
    rigid_map : as it was known.
    camera : of the recording.
    path : of it through the map.
    seen, astray : by the frames' numbers, points that agree with the path and those that do not.
    """
    poses = dict(zip(path.indices.tolist(), path.camera_from_world, strict=True))
    shares = {
        index: len(points.ids) / (len(points.ids) + len(seen[index].ids))
        for index, points in astray.items()
        if index in poses and index in seen and len(points.ids) >= LEAST_ASTRAY
    }
    frames = [index for index, share in shares.items() if share >= LEAST_SHARE]
    rows = np.unique(np.linspace(0, len(frames) - 1, MOST_FRAMES).astype(int)) if frames else []
    shifts = {frames[row]: _shift(rigid_map, camera, poses[frames[row]], astray[frames[row]]) for row in rows}
    found = {index: shift for index, shift in shifts.items() if shift is not None}
    if len(found) < LEAST_FRAMES or 2 * len(found) < len(shifts):
        return None
    middle = np.median(list(found.values()), axis=0)
    size = float(np.linalg.norm(middle))
    alike = [index for index, shift in found.items() if np.linalg.norm(shift - middle) < ALIKE * size]
    if len(alike) < LEAST_FRAMES or 2 * len(alike) < len(found):
        return None
    return MapPartMoved(len(alike), max(shares[i] for i in alike), size, "m" if rigid_map.is_metric else "map units")


def _shift(rigid_map: RigidMap, camera: Camera, pose: Array, astray: Followed) -> Array | None:
    """By what (3,) the middle of points that disagree was moved in the map; None if they obey no rigid motion."""
    places = rigid_map.positions[astray.ids]
    ok, turn, shift, inliers = cv2.solvePnPRansac(
        places, astray.pixels, camera.matrix, None, reprojectionError=AGREEING_PX, iterationsCount=200
    )
    if not ok or len(inliers) < LEAST_AGREEING * len(places):
        return None
    kept = places[np.asarray(inliers, dtype=np.int64).ravel()]
    rotation, translation = np.asarray(cv2.Rodrigues(turn)[0], dtype=np.float64), np.asarray(shift, dtype=np.float64)
    in_camera = kept @ rotation.T + translation.ravel()
    moved = (in_camera - pose[:3, 3]) @ pose[:3, :3]  # rows times R are the inverse turn
    return np.asarray(np.median(moved - kept, axis=0), dtype=np.float64)
