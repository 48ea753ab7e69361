"""Whether a recording goes with a map that was known before: its focal length, its depths, and what stands where.

**Focal length.** What deforms in a map that is kept may look like another focal length. So two witnesses have to agree:
the recording by itself, whose points are adjusted too, and the map as it is, which is independent of what the recording
says of shapes.

**A part that was moved.** What hides a point, or another light on it, leaves nothing that looks like it elsewhere.
Points that look like those of the map, and are where one and the same motion puts them in many frames, were moved.
Which of both parts was moved, that which the camera follows or the other one, no picture tells.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from morph_dslam.camera import Camera
from morph_dslam.errors import MapError
from morph_dslam.even_rows import evenly
from morph_dslam.io.trajectory import Trajectory
from morph_dslam.notices import Notice
from morph_dslam.slam.camera_terms import CameraEstimate
from morph_dslam.slam.frame_images import FrameDepth
from morph_dslam.slam.options import LEAST_INLIERS
from morph_dslam.slam.pose import refine_pose
from morph_dslam.slam.rigid_map import Followed, Indices, RigidMap
from morph_dslam.sources.recorded import DEPTH_SCALE

Array = NDArray[np.float64]
#: Frames that are looked at, spread over the recording.
MOST_FRAMES = 60
#: Depth cameras are right to a few per cent; what differs by more is another scale.
MOST_RATIO = 1.1
#: A smaller part of the focal length may be what the map is bent by, or a focus that was set anew. So many deviations.
LEAST_DEPARTURE, CLEARLY = 0.05, 5.0
#: Points that count at the given focal length count at another one too, where they are off by more, pixels.
ZOOMED_PX = 20.0
#: Points that disagree in a frame: so many at least, and this part of all that were found again. A moved box is less.
LEAST_ASTRAY, LEAST_SHARE = 20, 0.12
#: The second pose puts this part of them to within so many pixels of where they are.
LEAST_AGREEING, AGREEING_PX = 0.6, 2.5
#: So many frames in which the motion is the same to this part of its size.
LEAST_FRAMES, ALIKE = 5, 0.5


def depth_ratio(depth: FrameDepth, pixels: Array, depths: Array) -> float | None:
    """Measured depths over those of a map: the median, if enough points have one and most agree on it.

    Parameters
    ----------
    depth : of the frame
    pixels, depths : (n, 2), (n,) map points in the frame, and how far the map has them, metres
    """
    measured = depth.at(pixels)
    known = (measured > 0.0) & (depths > 0.0)
    if known.sum() < LEAST_INLIERS:
        return None
    ratios = np.log(measured[known] / depths[known])
    middle = float(np.median(ratios))
    return float(np.exp(middle)) if np.median(np.abs(ratios - middle)) < np.log(MOST_RATIO) else None


def check_depth_ratio(ratio: float | None) -> None:
    """Raise MapError if measured depths are not those of the known map."""
    if ratio is not None and not 1.0 / MOST_RATIO < ratio < MOST_RATIO:
        raise MapError(
            f"depth and map contradict each other: measured depths are {ratio:.3g} times those of the map. Correct "
            f"--depth-per-metre here, or in the run that made the map and map again: {DEPTH_SCALE}. Without --extend, "
            "--no-depth finds the camera by the images alone"
        )


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
    rows = evenly(len(path), MOST_FRAMES)
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
            poses[row], rigid_map.positions[seen[row].ids], seen[row].pixels, intrinsics, inlier_px=ZOOMED_PX
        ).rms_px
        for row in rows.tolist()
    ]
    return float(np.nanmedian(misses)) if np.isfinite(misses).any() else np.inf


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
    rows = evenly(len(frames), MOST_FRAMES)
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
