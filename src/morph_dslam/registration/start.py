"""The aid that a run starts from, beside landmarks and registrations: a board, a picture, or a guess."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from morph_dslam.camera import Camera
from morph_dslam.errors import TrackingError
from morph_dslam.model import ReducedModel
from morph_dslam.registration.board import BoardStart, load_board
from morph_dslam.registration.guess import load_guess, load_picture
from morph_dslam.registration.registration import Registration

Image = NDArray[np.uint8]


class Initializer(Protocol):
    """Places an object in one image."""

    def register(self, model: ReducedModel, camera: Camera, grey: Image) -> Registration:
        """The object in an undistorted image (h, w); raises RegistrationError if it cannot be placed."""
        ...


@dataclass(frozen=True)
class InitializerFiles:
    """Files of aids, of which at most one is given (docs/registration-aids.md)."""

    board: Path | None = None
    picture: Path | None = None
    guess: Path | None = None

    def load(self) -> Initializer | None:
        """The aid, None if there is none; raises TrackingError, RegistrationError or SourceError."""
        if sum(path is not None for path in (self.board, self.picture, self.guess)) > 1:
            raise TrackingError("give one aid to place the object: a board, a picture, or a guess")
        if self.board is not None:
            return BoardStart(load_board(self.board))
        if self.picture is not None:
            return load_picture(self.picture)
        return None if self.guess is None else load_guess(self.guess)


def register_by_initializer(
    initializer: Initializer, model: ReducedModel, camera: Camera, image: Image
) -> Registration:
    """The object in a frame (h, w, 3) as recorded; raises RegistrationError as `Initializer.register` does."""
    grey = np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), dtype=np.uint8)
    maps = camera.undistortion_maps()
    if maps is not None:
        grey = np.asarray(cv2.remap(grey, *maps, interpolation=cv2.INTER_LINEAR), dtype=np.uint8)
    return initializer.register(model, camera, grey)
