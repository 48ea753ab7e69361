"""Whether the scene of a map stayed rigid: what neighbouring points miss by that no camera explains.

Residuals of a rigid scene are errors of matching, of which neighbours in the picture share nothing. Where a part of the
scene moves and the map follows it, the keyframes are a compromise, and neighbours miss to the same side. A wrong camera
bends a map in this way too. So keyframes, points and camera are adjusted together first, and what is left of lens and
rolling shutter then, a smooth field over the picture, does not count.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from morph_dslam.camera import Camera
from morph_dslam.errors import CameraError
from morph_dslam.io.trajectory import Trajectory
from morph_dslam.notices import Notice
from morph_dslam.slam.rigid_map import Followed, Indices, RigidMap
from morph_dslam.slam.self_calibration import LEAST_SEEN, KeyframeFit, fit_keyframes
from morph_dslam.threads import one_thread_for_algebra

Array = NDArray[np.float64]
#: Fewer keyframes say nothing of a scene.
LEAST_KEYFRAMES = 5
#: Neighbours of a point, and the multiple of the median miss that longer ones count as.
N_NEIGHBOURS, LONG_MISS = 6, 3.0
#: The part of the keyframes that may be better than what is stated: what moves through a few of them only is outvoted
#: in the others.
BETTER_PART = 0.25
#: Rigid scenes, rendered and real, with right and wrong cameras, reach 0.06; maps that follow what moves, 0.2 to 0.5.
MOST_CORRELATION = 0.16
#: Misses that neighbours share are no compromise below this, pixels: patches that overlap share errors of matching.
LEAST_SHARED_PX = 0.01


@dataclass(frozen=True)
class SceneNotRigid(Notice):
    """The scene did not stay rigid while it was mapped.

    Attributes
    ----------
    correlation : of the misses of neighbouring points; three quarters of the keyframes have a larger one. It is near
        0 in a rigid scene.
    shared_px : root mean square of what neighbours miss by together, beside a smooth field, in the median keyframe,
        pixels
    n_keyframes : that were compared
    """

    template = (
        "the scene did not stay rigid: in most of {n_keyframes} keyframes neighbouring points miss to the same side "
        "(correlation {correlation:.2f}, in a rigid scene near 0), which no error of the camera explains. A part of "
        "the picture moves or deforms, and the map follows it: path, map and camera terms may be wrong by far more "
        "than they state. Film the scene without what moves, or use frames in which it stands still (--range)"
    )

    correlation: float
    shared_px: float
    n_keyframes: int


@one_thread_for_algebra
def motion_in_scene(
    rigid_map: RigidMap, camera: Camera, estimated: Camera, path: Trajectory, seen: Sequence[Followed]
) -> SceneNotRigid | None:
    """That the scene did not stay rigid, if the keyframes show it.

    Parameters
    ----------
    rigid_map : made with ``camera``
    camera : that the map was made with
    estimated : by the recording; the adjustment begins with it
    path : of the camera
    seen : the map points in each of its frames
    """
    try:
        fit = fit_keyframes(rigid_map, camera, estimated, path, seen)
    except (np.linalg.LinAlgError, CameraError):
        return None  # the keyframes have too little in common
    return None if fit is None else _judged(fit)


def _judged(fit: KeyframeFit) -> SceneNotRigid | None:
    misses = without_smooth_field(fit.pixels, fit.misses, fit.frame_idx)
    shared, total = neighbours_share(fit.pixels, misses, fit.frame_idx)
    if len(total) < LEAST_KEYFRAMES:
        return None
    correlation = float(np.quantile(shared / total, BETTER_PART))
    shared_px = float(np.sqrt(max(np.median(shared), 0.0)))
    if correlation < MOST_CORRELATION or shared_px < LEAST_SHARED_PX:
        return None
    return SceneNotRigid(correlation, shared_px, len(total))


def without_smooth_field(pixels: Array, misses: Array, frame_idx: Indices) -> Array:
    """Misses (o, 2) without the part that is a polynomial of second degree over the picture, frame by frame.

    Parameters
    ----------
    pixels : (o, 2) where points were seen
    misses : (o, 2) by how much, pixels
    frame_idx : (o,) in which frame
    """
    rest = shortened(misses)
    scaled = (pixels - pixels.mean(axis=0)) / max(float(pixels.std()), 1e-9)
    x, y = scaled.T
    terms = np.column_stack([np.ones_like(x), x, y, x * x, x * y, y * y])
    for frame in np.unique(frame_idx):
        rows = frame_idx == frame
        rest[rows] -= terms[rows] @ np.linalg.lstsq(terms[rows], rest[rows], rcond=None)[0]
    return rest


def shortened(misses: Array) -> Array:
    """Misses (o, 2) of which the longest are as long as `LONG_MISS` medians: few must not decide."""
    lengths = np.linalg.norm(misses, axis=1)
    most = LONG_MISS * max(float(np.median(lengths)), 1e-9)
    return misses * np.minimum(1.0, most / np.maximum(lengths, 1e-12))[:, None]


def neighbours_share(pixels: Array, misses: Array, frame_idx: Indices) -> tuple[Array, Array]:
    """What neighbours in each frame miss by together, and what they miss by, (f,) mean squares in px^2.

    The ratio of both is Moran's coefficient of spatial correlation (Biometrika 37, 1950). Frames with few points are
    left out.

    Parameters
    ----------
    pixels : (o, 2) where points were seen
    misses : (o, 2) by how much, pixels
    frame_idx : (o,) in which frame
    """
    products, squares = list[float](), list[float]()
    for frame in np.unique(frame_idx):
        rows = np.flatnonzero(frame_idx == frame)
        if len(rows) < LEAST_SEEN:
            continue
        # The nearest one to each point is the point itself.
        near = np.asarray(KDTree(pixels[rows]).query(pixels[rows], N_NEIGHBOURS + 1)[1], dtype=np.int64)
        around = misses[rows][near[:, 1:]].mean(axis=1)
        products.append(float((misses[rows] * around).sum(axis=1).mean()))
        squares.append(float((misses[rows] ** 2).sum(axis=1).mean()))
    return np.array(products), np.maximum(squares, 1e-18)
