"""What the object looks like: the reference pictures as its texture, rendered in any other state.

Measurements against this rendering always refer to the reference pictures, so their errors do not accumulate
from frame to frame, and points that were hidden come back by themselves.
"""

from __future__ import annotations

from collections.abc import Sequence
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
    """Reference pictures as a texture.

    Parameters
    ----------
    flats : (h, w) each, the flattened pictures. views : the mesh in each of them.
    sources : (m,) the picture that gives each triangle its texture; the first by default.
    closed : see `rasterise`.

    Attributes
    ----------
    facing : (m,) which side of each triangle its picture shows; see `binding.facing`.
    """

    def __init__(
        self,
        model: ReducedModel,
        camera: PinholeCamera,
        flats: Sequence[NDArray[np.uint8]],
        views: Sequence[View],
        sources: NDArray[np.int64] | None = None,
        closed: bool = False,
    ) -> None:
        self._triangles, self._closed = np.ascontiguousarray(model.triangles, dtype=np.int64), closed
        self._camera = camera
        sources = np.zeros(len(self._triangles), dtype=np.int64) if sources is None else sources
        # One picture below the other, so that a triangle's place says which one it is from.
        self._texture = np.ascontiguousarray(np.concatenate(flats))
        self._coordinates = np.empty((len(self._triangles), 3, 2))
        self.facing = np.empty(len(self._triangles), dtype=bool)
        for number, view in enumerate(views):
            rows = sources == number
            below = np.array([0.0, number * camera.height])
            self._coordinates[rows] = view.pixels[self._triangles[rows]] + below
            self.facing[rows] = facing(view, self._triangles[rows])

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
