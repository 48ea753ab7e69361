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
                "do, unless they come from solutions of another program without [external.reactions], or all forces on "
                "their supports are rounding"
            )
        states = [self._reactions.forces(mu) for mu in model.spread_parameters(SAMPLES)]
        largest = max(float(np.linalg.norm(force)) for state in states for _, force in state.values())
        self._scale = LONGEST * float(np.linalg.norm(np.ptp(model.nodes, axis=0))) / max(largest, 1e-300)
        self._shortest = SHORTEST * largest

    def draw(self, image: NDArray[np.uint8], state: State, camera: Camera) -> NDArray[np.uint8]:
        """The picture (h, w, 3) with an arrow along the force on each support that is in it, and its size beside it.

        The arrow begins in the middle of the support, or ends there if it would leave the picture.
        """
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
            is_in = _are_in(pixels, image.shape)
            if not is_in[0]:
                continue
            if not is_in[1]:
                before = 2.0 * pixels[0] - pixels[1]
                pixels = np.array([before, pixels[0]]) if _are_in(before[None], image.shape)[0] else pixels
            start, tip = ((round(float(x)), round(float(y))) for x, y in pixels)
            for colour, width in ((EDGE, thickness + 2), (COLOUR, thickness)):
                cv2.arrowedLine(drawn, start, tip, colour, width, cv2.LINE_AA, tipLength=0.2)
            _write_beside(drawn, pixels, f"{size:.3g} N", 2 * thickness)
        return drawn


def _are_in(pixels: NDArray[np.float64], shape: tuple[int, ...]) -> NDArray[np.bool_]:
    """Which pixels (n, 2) are in a picture."""
    return np.asarray(((pixels >= 0.0) & (pixels < [shape[1], shape[0]])).all(axis=1))


def _write_beside(image: NDArray[np.uint8], arrow: NDArray[np.float64], text: str, gap: int) -> None:
    """A label beside the middle of an arrow (2, 2) and so many pixels from it, within the picture."""
    patch = text_patch(text, 0.42 * max(image.shape[0] / 480.0, 0.6))
    size = np.array(patch.shape[1::-1])
    if (size > image.shape[1::-1]).any():
        return
    along = arrow[1] - arrow[0]
    across = np.array([-along[1], along[0]]) / max(float(np.linalg.norm(along)), 1e-9)
    across *= np.where(across[1] < 0.0, -1.0, 1.0)  # below, where there is a below
    middle = arrow.mean(axis=0) + across * (gap + 0.5 * np.abs(across) @ size)
    x, y = np.clip(np.round(middle - 0.5 * size), 0, image.shape[1::-1] - size).astype(int)
    image[y : y + size[1], x : x + size[0]] = patch
