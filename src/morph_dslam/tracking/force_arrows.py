"""Arrows over the video for what supports exert on the object."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from morph_dslam.camera import Camera
from morph_dslam.errors import TrackingError
from morph_dslam.model import ReducedModel
from morph_dslam.render.shading import text_patch
from morph_dslam.tracking.estimator import State
from morph_dslam.tracking.reactions import Reactions

#: Length of the arrow of the largest force, as a share of the object's size; shorter ones than this share are left out.
LONGEST, SHORTEST = 0.4, 0.01
#: States of the parameter box from which the largest force is taken (a power of two).
SAMPLES = 32
COLOUR, EDGE = (60, 200, 255), (20, 20, 20)


class ForceArrows:
    """Draws the forces of a model's supports, all with one scale.

    Raises
    ------
    TrackingError
        If the model holds no reactions.
    """

    def __init__(self, model: ReducedModel) -> None:
        self._reactions = Reactions(model)
        if not self._reactions.names:
            raise TrackingError(
                f"the model '{model.name}' holds no reactions of supports to draw: leave out --forces. Models "
                "do, unless they come from solutions of another program"
            )
        states = [self._reactions.forces(mu) for mu in model.spread_parameters(SAMPLES)]
        largest = max(float(np.linalg.norm(force)) for state in states for _, force in state.values())
        self._scale = LONGEST * float(np.linalg.norm(np.ptp(model.nodes, axis=0))) / max(largest, 1e-300)
        self._shortest = SHORTEST * largest

    def draw(self, image: NDArray[np.uint8], state: State, camera: Camera) -> NDArray[np.uint8]:
        """The picture (h, w, 3) with an arrow from the middle of each support along its force, and its size."""
        drawn = image.copy()
        thickness = max(2, round(image.shape[0] / 240))
        for point, force in self._reactions.forces(state.parameters).values():
            size = float(np.linalg.norm(force))
            ends = state.camera_from_object.apply(np.array([point, point + self._scale * force]))
            if size < self._shortest or ends[:, 2].min() <= 0.0:
                continue
            pixels = camera.project(ends)
            if not np.abs(pixels).max() < 1e5:
                continue
            start, tip = ((round(float(x)), round(float(y))) for x, y in pixels)
            for colour, width in ((EDGE, thickness + 2), (COLOUR, thickness)):
                cv2.arrowedLine(drawn, start, tip, colour, width, cv2.LINE_AA, tipLength=0.2)
            _write_beside(drawn, tip, f"{size:.3g} N")
        return drawn


def _write_beside(image: NDArray[np.uint8], place: tuple[int, int], text: str) -> None:
    """A label next to ``place`` (x, y), within the picture."""
    patch = text_patch(text, 0.42 * max(image.shape[0] / 480.0, 0.6))
    height, width = patch.shape[:2]
    if height > image.shape[0] or width > image.shape[1]:
        return
    x = int(np.clip(place[0] + 6, 0, image.shape[1] - width))
    y = int(np.clip(place[1] - height // 2, 0, image.shape[0] - height))
    image[y : y + height, x : x + width] = patch
