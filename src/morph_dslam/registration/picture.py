"""Registration by a picture of the object's print: features of the picture are found in the frame."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import model_validator

from morph_dslam.camera import Camera
from morph_dslam.errors import RegistrationError, RegistrationFailure
from morph_dslam.io.landmarks import Landmarks
from morph_dslam.io.sections import Section, read_sections
from morph_dslam.model import ReducedModel
from morph_dslam.registration.initialization import Vector
from morph_dslam.registration.landmarks import register_landmarks
from morph_dslam.registration.messages import Ambiguity, Ambiguous
from morph_dslam.registration.registration import Registration
from morph_dslam.registration.starts import shape_starts
from morph_dslam.render.rasteriser import rasterise
from morph_dslam.sources.frames import read_image
from morph_dslam.tracking.binding import nearest_surface_points
from morph_dslam.tracking.estimator import Estimator
from morph_dslam.tracking.relocalization import state_from_matches
from morph_dslam.tracking.state import BoundPoints

Array = NDArray[np.float64]
Image = NDArray[np.uint8]
N_FEATURES, RATIO = 3000, 0.8
MATCH_PX, LEAST_MATCHES = 6.0, 15
#: Shapes tried for a first pose, landmarks made of the matches, and the standard deviation of one, pixels.
N_SHAPES, N_LANDMARKS, LANDMARK_PX = 9, 60, 0.3
#: A second place with so many of the matches of the first one is another object like it.
AMBIGUOUS = 0.5


class Rectangle(Section):
    """Where the picture is on the undeformed object: its upper left corner, and its whole edges."""

    corner_mm: Vector
    right_mm: Vector
    down_mm: Vector


class PictureFile(Section):
    """A picture file: an image, and a rectangle of the object, or ``coordinates``: an .npy array (n, 2) with
    the picture's pixel of each node of the model, NaN where it has none."""

    image: str
    rectangle: Rectangle | None = None
    coordinates: str | None = None

    @model_validator(mode="after")
    def _lies_somewhere(self) -> PictureFile:
        if (self.rectangle is None) == (self.coordinates is None):
            raise ValueError("say where the picture is on the object: either rectangle, or coordinates")
        return self


@dataclass(frozen=True)
class PictureInitializer:
    """Finds the object by its print.

    Attributes
    ----------
    image : (h, w) the picture.
    rectangle : (3, 3) its corner, and its edges to the right and down, metres, on the undeformed object; or
        None with ``coordinates``.
    coordinates : (n, 2) pixel of the picture at each of the model's nodes, NaN where there is none.
    """

    image: Image
    rectangle: Array | None
    coordinates: Array | None

    def register(self, model: ReducedModel, camera: Camera, grey: Image) -> Registration:
        """The object in an undistorted image (h, w).

        Raises
        ------
        RegistrationError
            If the print is not found there.
        """
        mine, theirs = _matches(self.image, grey)
        points, on_object = self._points(model, mine)
        points, pixels = points[on_object], theirs[on_object]
        agreeing = _agreeing(model, camera, points, pixels)
        if not agreeing.any():
            raise RegistrationError(
                f"the picture's print is not found in the reference frame: of {len(points)} matches too "
                "few agree on a pose; choose a frame that shows it larger and sharper, and check where the "
                "picture is on the object",
                RegistrationFailure.PICTURE_NOT_SEEN,
            )
        rest = ~agreeing
        second = _agreeing(model, camera, points[rest], pixels[rest]) if rest.any() else rest
        rows = np.flatnonzero(agreeing)
        chosen = rows[np.unique(np.linspace(0, len(rows) - 1, N_LANDMARKS).round().astype(int))]
        landmarks = Landmarks(points[chosen], camera.distort_pixels(pixels[chosen]))
        found = register_landmarks(model, camera, landmarks, LANDMARK_PX)
        warnings, share = found.warnings, float(second.sum() / agreeing.sum())
        if share >= AMBIGUOUS:
            warnings = (*warnings, Ambiguous(Ambiguity.TWO_PRINTS, share))
        facts = {**found.facts, "from": "picture", "n_matches": len(points), "n_agreeing": len(rows)}
        return replace(found, facts=facts, warnings=warnings)

    def _points(self, model: ReducedModel, pixels: Array) -> tuple[Array, NDArray[np.bool_]]:
        """Points (k, 3) of the undeformed object at pixels (k, 2) of the picture; and which are on it."""
        if self.rectangle is not None:
            height, width = self.image.shape
            corner, right, down = self.rectangle
            a, b = ((pixels + 0.5) / [width, height]).T
            return corner + a[:, None] * right + b[:, None] * down, np.ones(len(pixels), dtype=bool)
        coordinates = np.asarray(self.coordinates)
        height, width = self.image.shape
        drawn = rasterise(coordinates, np.ones(len(coordinates)), model.triangles, height, width)
        columns, rows = np.clip(np.rint(pixels).astype(int), 0, [width - 1, height - 1]).T
        triangles, weights = drawn.triangle_ids[rows, columns], drawn.weights[rows, columns]
        points = np.einsum("kc,kcx->kx", weights, model.nodes[model.triangles[triangles]])
        return points, triangles >= 0


def load_picture(path: Path) -> PictureInitializer:
    """Read a picture file and its image; raises RegistrationError or SourceError if one is wrong."""
    described = read_sections(path, "picture file", PictureFile, RegistrationError)
    image = read_image(path.parent / described.image, "picture of the print")
    grey = np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), dtype=np.uint8)
    if described.rectangle is not None:
        r = described.rectangle
        return PictureInitializer(grey, 1e-3 * np.array([r.corner_mm, r.right_mm, r.down_mm]), None)
    try:
        coordinates = np.load(path.parent / str(described.coordinates), allow_pickle=False)
    except (OSError, ValueError) as error:
        raise RegistrationError(f"{path}: cannot read the coordinates {described.coordinates}: {error}") from error
    if coordinates.ndim != 2 or coordinates.shape[1] != 2:
        raise RegistrationError(f"{path}: {described.coordinates} is no array of two columns")
    return PictureInitializer(grey, None, np.asarray(coordinates, dtype=np.float64))


def _matches(picture: Image, grey: Image) -> tuple[Array, Array]:
    """Pixels (k, 2) of similar features in the picture and in the frame (SIFT; Lowe 2004)."""
    detector = cv2.SIFT_create(nfeatures=N_FEATURES, enable_precise_upscale=True)  # type: ignore[attr-defined]
    ours, first = detector.detectAndCompute(picture, None)
    theirs, second = detector.detectAndCompute(grey, None)
    if first is None or second is None or len(first) < 2 or len(second) < 2:
        return np.empty((0, 2)), np.empty((0, 2))
    # From the frame to the picture: a second object like it finds the same features again.
    pairs = [
        (best.trainIdx, best.queryIdx)
        for best, runner_up in cv2.BFMatcher(cv2.NORM_L2).knnMatch(second, first, k=2)
        if best.distance < RATIO * runner_up.distance
    ]
    mine = np.array([ours[a].pt for a, _ in pairs], dtype=np.float64).reshape(-1, 2)
    return mine, np.array([theirs[b].pt for _, b in pairs], dtype=np.float64).reshape(-1, 2)


def _agreeing(model: ReducedModel, camera: Camera, points: Array, pixels: Array) -> NDArray[np.bool_]:
    """Which matches (k,) agree on one state of the object; none if they are too few."""
    none = np.zeros(len(points), dtype=bool)
    if len(points) < LEAST_MATCHES:
        return none
    surface, _ = nearest_surface_points(model.nodes, model.triangles, points)
    bound = BoundPoints.from_surface(model, surface)
    shapes = shape_starts(model)
    some = shapes[:: max(1, len(shapes) // N_SHAPES)]
    state, agreeing = state_from_matches(Estimator(model, camera), bound, pixels, some, MATCH_PX, LEAST_MATCHES)
    return none if state is None else agreeing
