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
from morph_dslam.online.binding import View, facing
from morph_dslam.online.flow import NEUTRAL
from morph_dslam.render.rasteriser import Buffers, image_region, rasterise
from morph_dslam.render.texture import render_textured

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
        self._triangles, self._closed = model.triangles, closed
        self._camera = camera
        self._texture = flat
        self._coordinates = view.pixels
        self.facing = facing(view, model.triangles)

    def render(self, view: View, margin: int = 12) -> Rendering:
        """The object alone, in another view of it."""
        height, width = self._camera.height, self._camera.width
        image = np.full((height, width), NEUTRAL, dtype=np.uint8)
        depth = np.full((height, width), np.inf, dtype=np.float32)
        region = image_region(view.pixels, height, width, margin)
        if region is None:
            return Rendering(image, depth)
        rows, columns = region
        buffers = self._rasterise(view, rows, columns)
        textured = render_textured(buffers, self._triangles, self._coordinates, self._texture)
        image[rows, columns] = np.where(buffers.triangle_ids >= 0, textured, NEUTRAL)
        depth[rows, columns] = buffers.depth
        return Rendering(image, depth)

    def _rasterise(self, view: View, rows: slice, columns: slice) -> Buffers:
        origin = np.array([columns.start, rows.start], dtype=float)
        size = (rows.stop - rows.start, columns.stop - columns.start)
        pixels = view.pixels - origin
        return rasterise(pixels, view.nodes[:, 2], self._triangles, *size, closed=self._closed)
