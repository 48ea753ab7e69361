"""What the object looks like: the reference image as its texture, rendered in any other state.

Measurements against this rendering always refer to the reference view, so their errors do not accumulate
from frame to frame, and points that were hidden come back by themselves.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from morph_dslam.camera import PinholeCamera
from morph_dslam.model import ReducedModel
from morph_dslam.online.measuring.binding import View, facing
from morph_dslam.online.measuring.flow import NEUTRAL
from morph_dslam.online.measuring.textured_view import draw_textured

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Rendering:
    """A rendered view.

    Attributes
    ----------
    image : (h, w) uint8, the flattened texture as it should appear; `NEUTRAL` off the object.
    depth : (h, w) float32 metres, infinity off the object.
    """

    image: NDArray[np.uint8]
    depth: NDArray[np.float32]


class ReferenceAppearance:
    """The reference view as a texture.

    Parameters
    ----------
    flat : (h, w) the flattened reference image. view : the mesh in it. closed : see `rasterise`.
    """

    def __init__(
        self,
        model: ReducedModel,
        camera: PinholeCamera,
        flat: NDArray[np.uint8],
        view: View,
        closed: bool = False,
    ) -> None:
        self._triangles, self._closed = np.ascontiguousarray(model.triangles, dtype=np.int64), closed
        self._camera = camera
        self._texture = np.ascontiguousarray(flat)
        self._coordinates = np.ascontiguousarray(view.pixels)
        self.facing = facing(view, model.triangles)

    def render(self, view: View) -> Rendering:
        """The object alone, in another view of it."""
        height, width = self._camera.height, self._camera.width
        image = np.full((height, width), NEUTRAL, dtype=np.uint8)
        depth = np.full((height, width), np.inf, dtype=np.float32)
        draw_textured(
            view.pixels,
            np.ascontiguousarray(view.nodes[:, 2]),
            self._triangles,
            self._coordinates,
            self._texture,
            self._closed,
            image,
            depth,
        )
        return Rendering(image, depth)
