"""Other ways to find the object in a frame than landmarks: a board, a picture of its print, or a guess."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from morph_dslam.camera import Camera
from morph_dslam.errors import TrackingError
from morph_dslam.model import ReducedModel
from morph_dslam.registration.registration import Registration
from morph_dslam.tracking.option_values import FileOptions

Image = NDArray[np.uint8]
#: A coordinate or an angle. None is meant by what is larger: in millimetres it would be ten kilometres.
Number = Annotated[float, Field(ge=-1e7, le=1e7)]
Vector = tuple[Number, Number, Number]


class Initializer(Protocol):
    """Finds an object in one image."""

    def register(self, model: ReducedModel, camera: Camera, grey: Image) -> Registration:
        """The object in an undistorted image (h, w); raises RegistrationError if it is not found."""
        ...


@dataclass(frozen=True)
class InitializerFiles(FileOptions):
    """Files of which at most one is given (docs/registration-aids.md).

    Attributes
    ----------
    board : a board file.
    picture : a picture file.
    guess : a guess.
    """

    board: Path | None = None
    picture: Path | None = None
    guess: Path | None = None

    def load(self) -> Initializer | None:
        """The initializer, None if there is none; raises TrackingError, RegistrationError or SourceError."""
        from morph_dslam.registration.board import load_board
        from morph_dslam.registration.board_registration import BoardInitializer
        from morph_dslam.registration.guess import load_guess
        from morph_dslam.registration.picture import load_picture

        if sum(path is not None for path in (self.board, self.picture, self.guess)) > 1:
            raise TrackingError("say in one way where the object is: by a board, a picture, or a guess")
        if self.board is not None:
            return BoardInitializer(load_board(self.board))
        if self.picture is not None:
            return load_picture(self.picture)
        return None if self.guess is None else load_guess(self.guess)


def register_by_initializer(
    initializer: Initializer, model: ReducedModel, camera: Camera, image: Image
) -> Registration:
    """The object in a frame (h, w, 3) as recorded; raises RegistrationError if it is not found."""
    return initializer.register(model, camera, undistorted_grey(camera, image))


def undistorted_grey(camera: Camera, image: Image) -> Image:
    """The grey image (h, w) without distortion of a frame (h, w, 3) or (h, w) as recorded."""
    image = camera.checked_picture(image, "the image")
    grey = image if image.ndim == 2 else np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), dtype=np.uint8)
    maps = camera.undistortion_maps()
    return grey if maps is None else np.asarray(cv2.remap(grey, *maps, interpolation=cv2.INTER_LINEAR), dtype=np.uint8)
