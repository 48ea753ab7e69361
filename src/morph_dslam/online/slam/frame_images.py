"""From a frame as recorded to what tracking and mapping work on: undistorted, flattened, and depth."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from morph_dslam.camera import PinholeCamera
from morph_dslam.errors import CameraError
from morph_dslam.online.measuring.flow import flatten
from morph_dslam.online.slam.depth import DepthImage, FrameDepth, StereoImages
from morph_dslam.online.slam.options import SlamOptions
from morph_dslam.stereo import StereoCamera

Image = NDArray[np.uint8]

#: Baseline, metres, that depth images are taken to have: structured light's noise is then half a pixel.
VIRTUAL_BASELINE = 0.08


@dataclass(frozen=True)
class FrameView:
    """A frame.

    Attributes
    ----------
    grey : (h, w) undistorted. flat : (h, w) the same flattened. depth : None where nothing measured it.
    """

    index: int
    timestamp: float
    grey: Image
    flat: Image
    depth: FrameDepth | None = None


class FrameImages:
    """Prepares the frames of one camera, alone, with depth images, or in a stereo pair.

    Attributes
    ----------
    camera : of the undistorted images. baseline_px : of the depth (`RigidMap`), 0 without depth.

    Raises
    ------
    CameraError
        If a stereo pair is to have depth images too, or cannot be rectified.
    """

    def __init__(
        self, camera: PinholeCamera | StereoCamera, options: SlamOptions, with_depth: bool = False
    ) -> None:
        self._options = options
        if isinstance(camera, StereoCamera):
            if with_depth:
                raise CameraError("a stereo pair measures depth itself: give one camera for depth images")
            pair = camera.rectify()
            self.camera, self._maps, self._right_maps = pair.camera, pair.left_maps, pair.right_maps
            self.baseline_px = pair.camera.fx * pair.baseline
        else:
            self.camera, self._maps, self._right_maps = camera, camera.undistortion_maps(), None
            self.baseline_px = camera.fx * VIRTUAL_BASELINE if with_depth else 0.0

    def undistort(self, image: Image) -> Image:
        """The image (h, w[, 3]) as ``camera`` would have seen it."""
        return self._remapped(image, self._maps)

    def prepare(
        self,
        image: Image,
        index: int,
        timestamp: float,
        depth: NDArray[np.float32] | None = None,
        right: Image | None = None,
    ) -> FrameView:
        """The view of a frame; depth or right images that the camera does not use are left aside.

        Raises
        ------
        CameraError
            If an image has not the camera's size.
        """
        grey = self._grey(image, f"frame {index}", self._maps)
        flat = self._flat(grey)
        return FrameView(index, timestamp, grey, flat, self._depth(index, flat, depth, right))

    def _depth(
        self, index: int, flat: Image, depth: NDArray[np.float32] | None, right: Image | None
    ) -> FrameDepth | None:
        if not self.baseline_px:
            return None
        if self._right_maps is not None:
            if right is None:
                return None
            right = self._grey(right, f"the right image of frame {index}", self._right_maps)
            return StereoImages(flat, self._flat(right), self._options)
        if depth is None:
            return None
        self.camera.check_image(depth, f"the depth image of frame {index}")
        if self._maps is not None:
            # Depths on both sides of an edge must not be blended.
            depth = cv2.remap(depth, *self._maps, cv2.INTER_NEAREST, borderValue=np.nan)  # type: ignore[assignment]
        return DepthImage(np.asarray(depth, dtype=np.float32), self.baseline_px)

    def _grey(self, image: Image, where: str, maps: tuple[NDArray, NDArray] | None) -> Image:
        self.camera.check_image(image, where)
        grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
        return self._remapped(np.asarray(grey, dtype=np.uint8), maps)

    def _flat(self, grey: Image) -> Image:
        return flatten(grey, self._options.flow.flatten_window)

    @staticmethod
    def _remapped(image: Image, maps: tuple[NDArray, NDArray] | None) -> Image:
        if maps is None:
            return image
        return np.asarray(cv2.remap(image, *maps, cv2.INTER_LINEAR), dtype=np.uint8)
