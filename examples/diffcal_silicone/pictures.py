"""The pictures of a hanging bar that its stiffness is estimated from: a depth image and colour views."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from recording import MESH_UNIT, HangingBar
from silhouette import outline_of

import morph_dslam as md
from morph_dslam.extend.geometry import RigidTransform

Array = NDArray[np.float64]

#: The colour camera's intrinsics are not published; these overlay the bar within about 10 pixels.
COLOUR_FOCAL, COLOUR_CENTRE = 905.0, (640.0, 360.0)
#: Depths within so much of the bar's are of the bar, of its clamp, or of nothing, metres.
AROUND = 0.03
#: Standard deviations of the bar's place, metres: the marker's two solutions differ by 2 mm, and the depth
#: image from them by 6 mm; a focal length that is off looks like a distance.
PLACE_STD, PLACE_STD_COLOUR = 6e-3, 25e-3


@dataclass(frozen=True)
class Picture:
    """What one camera shows.

    Attributes
    ----------
    image : (h, w, 3) uint8 to draw on.
    camera_from_object : by the recording's marker.
    place_std : of the bar's place by it, m.
    outline : (k, 2) of the bar, pixels.
    depth : (h, w) metres, NaN where unknown; None of a colour camera.
    """

    name: str
    image: NDArray[np.uint8]
    camera: md.Camera
    camera_from_object: RigidTransform
    place_std: float
    outline: Array
    depth: NDArray[np.float32] | None = None


def depth_picture(bar: HangingBar) -> Picture:
    """The depth image: the bar's outline, where depths jump, and its depths."""
    height, width = bar.depth.shape
    matrix = bar.intrinsics
    camera = md.Camera(width, height, matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2])
    pose = _rigid(bar.camera_from_object)
    seen = pose.apply(bar.points)
    low, high = np.percentile(seen[:, 2], (1, 99))
    level = ((bar.depth > low - AROUND) & (bar.depth < high + AROUND)).astype(np.float32)
    outline = outline_of(level, camera.project(seen))
    grey = np.clip((bar.depth - 0.35) / 0.35 * 255.0, 0, 255).astype(np.uint8)
    depth = np.where(bar.depth > 0.0, bar.depth, np.nan).astype(np.float32)
    shown = np.asarray(cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR), dtype=np.uint8)
    return Picture("depth image", shown, camera, pose, PLACE_STD, outline, depth)


def colour_picture(data: Path, bar: HangingBar, recording: str = "h_m_c") -> Picture:
    """The mean of the colour views, whose camera stood still: the outline of what is as blue as the bar.

    Raises
    ------
    MorphError
        If there are no views.
    """
    folder = data / recording
    read = [cv2.imread(str(path)) for path in sorted((folder / "rgb").glob("*.jpg"))]
    images = [image for image in read if image is not None]
    if not images:
        raise md.MorphError(f"{folder / 'rgb'} does not hold the recording's colour views NN.jpg")
    mean = np.mean(np.array(images, dtype=np.float32), axis=0)
    height, width = mean.shape[:2]
    camera = md.Camera(width, height, COLOUR_FOCAL, COLOUR_FOCAL, *COLOUR_CENTRE)
    with np.load(folder / "views.npz") as views:
        world_from_object = views["object_transform"].copy()
        world_from_object[:3, 3] *= MESH_UNIT
        view = int(sorted(folder.glob("depth_view*.png"))[0].stem.removeprefix("depth_view"))
        pose = _rigid(views["world_to_rgbcam"][view].astype(np.float64) @ world_from_object)
    # Blue over brightness is the same on the lit face and on the dim sides; the constant quietens black.
    blue = np.clip(mean[:, :, 0] - mean[:, :, 2], 0.0, None) / (mean.sum(axis=2) + 10.0)
    outline = outline_of(blue.astype(np.float32), camera.project(pose.apply(bar.points)))
    return Picture("colour views", mean.astype(np.uint8), camera, pose, PLACE_STD_COLOUR, outline)


def _rigid(matrix: Array) -> RigidTransform:
    """The transform of a matrix (4, 4) whose rotation is rounded."""
    left, _, right = np.linalg.svd(matrix[:3, :3])
    return RigidTransform(left @ right, matrix[:3, 3].copy())
