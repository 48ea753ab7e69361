"""TOML files that help to place an object: what they have in common, and what is said of a mistake in one."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, ValidationError, model_validator
from scipy.spatial.transform import Rotation

from morph_dslam.camera import Camera
from morph_dslam.errors import RegistrationError
from morph_dslam.geometry import RigidTransform
from morph_dslam.io.landmarks import Landmarks
from morph_dslam.io.text import read_toml
from morph_dslam.model import ReducedModel, SurfacePoints
from morph_dslam.registration.landmarks import shape_starts
from morph_dslam.registration.registration import Registration, register_by_landmarks
from morph_dslam.render.rasteriser import rasterise
from morph_dslam.sources.frames import read_image
from morph_dslam.tracking.binding import DrawnSurface, draw_view, nearest_surface_points, view_of
from morph_dslam.tracking.estimator import Estimate, EstimationOptions, Estimator
from morph_dslam.tracking.relocalization import state_from_matches
from morph_dslam.tracking.state import BoundPoints, Prior, State

#: A coordinate or an angle. None is meant by what is larger: in millimetres it would be ten kilometres.
Number = Annotated[float, Field(ge=-1e7, le=1e7)]

Vector = tuple[Number, Number, Number]


class Section(BaseModel):
    """A part of such a file; unknown keys are mistakes."""

    model_config = ConfigDict(extra="forbid")


AnySection = TypeVar("AnySection", bound=Section)


def read_aid(path: Path, what: str, kind: type[AnySection]) -> AnySection:
    """Read a file and check it.

    Parameters
    ----------
    what : the file is, for the message. kind : its content.

    Raises
    ------
    RegistrationError
        If it is missing, no TOML, or says something impossible.
    """
    content = read_toml(path, what, RegistrationError)
    try:
        return kind.model_validate(content)
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"])
        message = first["msg"].removeprefix("Value error, ")
        raise RegistrationError(f"{path}: {where}: {message}" if where else f"{path}: {message}") from error


# Placing an object by a picture of its print: features of the picture are found in the reference frame.


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
class PictureStart:
    """Places the object by the picture ``image`` (h, w) of its print.

    Attributes
    ----------
    rectangle : corner, right and down (3, 3), metres, on the undeformed object; or coordinates : (n, 2).
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
                "few agree on a place; choose a frame that shows it larger and sharper, and check where the "
                "picture is on the object"
            )
        rest = ~agreeing
        second = _agreeing(model, camera, points[rest], pixels[rest]) if rest.any() else rest
        rows = np.flatnonzero(agreeing)
        chosen = rows[np.unique(np.linspace(0, len(rows) - 1, N_LANDMARKS).round().astype(int))]
        landmarks = Landmarks(points[chosen], camera.distort_pixels(pixels[chosen]))
        placed = register_by_landmarks(model, camera, landmarks, LANDMARK_PX)
        flags = placed.flags
        if second.sum() >= AMBIGUOUS * agreeing.sum():
            counts = f"{int(agreeing.sum())} and {int(second.sum())} features agree"
            flags = (*flags, f"registration ambiguous: the print is in two places, where {counts}")
        facts = {**placed.facts, "from": "picture", "n_matches": len(points), "n_agreeing": len(rows)}
        return replace(placed, facts=facts, flags=flags)

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


def load_picture(path: Path) -> PictureStart:
    """Read a picture file and its image.

    Raises
    ------
    RegistrationError, SourceError
        If one of them is missing or malformed.
    """
    described = read_aid(path, "picture file", PictureFile)
    image = read_image(path.parent / described.image, "picture of the print")
    grey = np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), dtype=np.uint8)
    if described.rectangle is not None:
        r = described.rectangle
        return PictureStart(grey, 1e-3 * np.array([r.corner_mm, r.right_mm, r.down_mm]), None)
    try:
        coordinates = np.load(path.parent / str(described.coordinates), allow_pickle=False)
    except (OSError, ValueError) as error:
        raise RegistrationError(f"{path}: cannot read the coordinates {described.coordinates}: {error}") from error
    if coordinates.ndim != 2 or coordinates.shape[1] != 2:
        raise RegistrationError(f"{path}: {described.coordinates} is no array of two columns")
    return PictureStart(grey, None, np.asarray(coordinates, dtype=np.float64))


def _matches(picture: Image, grey: Image) -> tuple[Array, Array]:
    """Pixels (k, 2) of features that look alike, in the picture and in the frame (SIFT; Lowe 2004)."""
    detector = cv2.SIFT_create(nfeatures=N_FEATURES)  # type: ignore[attr-defined]
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


# Placing an object by a guess: refined until its outline parts it from what is around it, or refused.
# Brightness inside of the guessed outline and around it tells how likely each pixel belongs to the object
# (Prisacariu & Reid 2012), so that edges of a print do not count. The outline is laid where this falls,
# searched along its normals, and at last, from nearby, where the brightness itself changes most. In the right
# place it falls everywhere; elsewhere only by chance, and how often that is the image itself tells.


#: Points of the outline, and how far to either side of it edges are searched in turn, pixels.
N_POINTS, REACHES, LAST_REACHES = 160, (24, 16, 12, 8, 6, 4), (3, 2, 2)

#: Fall in a pixel that is an edge, of the likelihood and of brightness over its range, and how near to the
#: outline it must be in the end, pixels.
LEAST_EDGE, NEAR_PX = 0.04, 1.5

#: Side of the median filter that takes out the strokes of a print, grey levels in a bin of the histograms.
MEDIAN, BIN = 9, 8

#: Of what chance does not put on edges, so much must be.
LEAST_SHARE = 0.8

#: Errors are alike along each side of an outline: its points count as so many independent ones.
N_INDEPENDENT = 6

#: How sure the guessed parameters are, over their range: an outline tells little of the shape.
GUESS_SHARE = 0.05


class Pose(Section):
    """The object in the camera's frame (x right, y down, z ahead): origin; turn about x, then y, then z."""

    position_mm: Vector
    rotation_deg: Vector


class GuessFile(Section):
    """A guess: the pose, and values of any of the model's parameters in the units in which it shows them."""

    pose: Pose
    parameters: dict[str, FiniteFloat] = Field(default_factory=dict)


@dataclass(frozen=True)
class GuessStart:
    """Places the object near a guess."""

    guess: GuessFile

    def state(self, model: ReducedModel) -> State:
        """The guess; raises RegistrationError if it has a parameter that the model has not."""
        values = model.default.copy()
        names = [parameter.name for parameter in model.parameters]
        for name, value in self.guess.parameters.items():
            if name not in names:
                raise RegistrationError(f"the guess has '{name}', the model's parameters are {', '.join(names)}")
            k = names.index(name)
            shown = model.parameters[k].display(1.0)  # of one SI unit
            values[k] = np.clip(value / shown, model.lower[k], model.upper[k])
        turn = Rotation.from_euler("xyz", self.guess.pose.rotation_deg, degrees=True).as_matrix()
        return State(values, RigidTransform(turn, 1e-3 * np.array(self.guess.pose.position_mm)))

    def register(self, model: ReducedModel, camera: Camera, grey: Image) -> Registration:
        """The object in an undistorted image (h, w).

        Raises
        ------
        RegistrationError
            If the image contradicts the guess.
        """
        search = _OutlineSearch(model, camera, grey)
        estimate = search.refined(self.state(model))
        on_edges, by_chance = search.evidence(estimate.state)
        if on_edges - by_chance < LEAST_SHARE * (1.0 - by_chance):
            raise RegistrationError(
                f"the image contradicts the guess: {100 * on_edges:.0f} % of the outline lie on edges, by "
                f"chance it would be {100 * by_chance:.0f} %; give a closer guess (the outline within about "
                f"{REACHES[0]} pixels), or landmarks"
            )
        facts = {"from": "guess", "outline_on_edges": on_edges, "by_chance": by_chance}
        flags = ("placed by a guess: its outline agrees with the image, which tells little of the shape",)
        return Registration(
            model, None, estimate.state, facts, flags, covariance=N_POINTS / N_INDEPENDENT * estimate.covariance
        )


def load_guess(path: Path) -> GuessStart:
    """Read a guess; raises RegistrationError if the file is missing or malformed."""
    return GuessStart(read_aid(path, "guess", GuessFile))


class _OutlineSearch:
    """Lays the outline of an object on the edges of an image."""

    def __init__(self, model: ReducedModel, camera: Camera, grey: Image) -> None:
        self._model, self._camera = model, camera
        self._drawn = DrawnSurface.of(model).model
        self._grey = grey
        options = EstimationOptions(huber_px=2.0, max_iterations=8)
        self._estimator = Estimator(model, camera, options)

    def refined(self, start: State) -> Estimate:
        """The state whose outline lies on edges near that of ``start``."""
        spread = GUESS_SHARE * (self._model.upper - self._model.lower)
        prior = Prior(start.parameters, np.diag(1.0 / spread**2))
        estimate, state = None, start
        bright = (cv2.GaussianBlur(self._grey, (0, 0), 0.7) / np.float32(255.0)).astype(np.float32)
        for reach in (*REACHES, *LAST_REACHES):
            likely = self._likelihood(state, reach) if reach in REACHES else bright
            points, pixels, normals = self._outline(state)
            offsets, falls = _steepest(likely, pixels, normals, reach, signed=reach in REACHES)
            # The rim's pixels are covered at their middle: the outline is half a pixel further out.
            found = pixels + (offsets - 0.5)[:, None] * normals
            weights = (falls > LEAST_EDGE).astype(float)
            estimate = self._estimator.estimate(points, found, weights, state, normals, prior)
            state = estimate.state
        assert estimate is not None
        return estimate

    def evidence(self, state: State) -> tuple[float, float]:
        """The share of the outline that lies on edges, and what it is where the outline is not."""
        _, pixels, normals = self._outline(state)
        likely = self._likelihood(state, REACHES[-1])

        def share(shift: float) -> float:
            offsets, falls = _steepest(likely, pixels + shift * normals, normals, int(np.ceil(NEAR_PX)))
            return float(((falls > LEAST_EDGE) & (np.abs(offsets) <= NEAR_PX)).mean())

        return share(0.0), float(np.mean([share(shift) for shift in (-24.0, -16.0, 16.0, 24.0)]))

    def _likelihood(self, state: State, reach: int) -> NDArray[np.float32]:
        """How likely pixels (h, w) are of the object, by their brightness alone."""
        view = view_of(self._drawn, self._camera, state)
        covered = draw_view(view, self._drawn.triangles, self._camera).covered.astype(np.uint8)
        side = 2 * reach + 1
        wide = cv2.dilate(covered, np.ones((2 * side + 1, 2 * side + 1), np.uint8))
        around = (wide > 0) & (cv2.dilate(covered, np.ones((side, side), np.uint8)) == 0)
        inside = cv2.erode(covered, np.ones((min(side, 17), min(side, 17)), np.uint8)) > 0
        inside = inside if inside.any() else covered > 0
        bins = self._grey // BIN
        counts = [np.bincount(bins[part], minlength=256 // BIN) + 1.0 for part in (inside, around)]
        own, other = (count / count.sum() for count in counts)
        likely = np.rint(255.0 * (own / (own + other))[bins]).astype(np.uint8)
        smooth = cv2.GaussianBlur(cv2.medianBlur(likely, MEDIAN), (0, 0), 1.5)
        return (smooth / np.float32(255.0)).astype(np.float32)

    def _outline(self, state: State) -> tuple[BoundPoints, Array, Array]:
        """Points of the outline (k), their pixels (k, 2), and normals (k, 2) outwards."""
        buffers = draw_view(view_of(self._drawn, self._camera, state), self._drawn.triangles, self._camera)
        covered = buffers.covered.astype(np.uint8)
        inner = cv2.erode(covered, np.ones((3, 3), np.uint8))
        rim = (covered > 0) & (inner == 0)
        rim[[0, 1, -2, -1]], rim[:, [0, 1, -2, -1]] = False, False
        rows, columns = np.nonzero(rim)
        if len(rows) < 30:
            raise RegistrationError("the guess puts the object out of the image, or so far away that it is a dot")
        chosen = np.unique(np.linspace(0, len(rows) - 1, N_POINTS).round().astype(int))
        rows, columns = rows[chosen], columns[chosen]
        smooth = cv2.GaussianBlur(covered.astype(np.float32), (0, 0), 2.0)
        slope = np.stack([cv2.Sobel(smooth, cv2.CV_32F, 1, 0), cv2.Sobel(smooth, cv2.CV_32F, 0, 1)], axis=2)
        normals = -slope[rows, columns].astype(np.float64)
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
        surface = SurfacePoints(
            buffers.triangle_ids[rows, columns].astype(np.int64), buffers.weights[rows, columns].astype(np.float64)
        )
        points = BoundPoints.from_surface(self._model, surface)
        return points, self._camera.project(points.in_camera(state)), normals


def _steepest(
    values: NDArray[np.float32], pixels: Array, normals: Array, reach: int, signed: bool = True
) -> tuple[Array, Array]:
    """How far (k,) along the normals values (h, w) fall most, and by how much (k,), in a pixel.

    Without a sign, changes in both directions count.
    """
    steps = np.arange(-reach - 1.0, reach + 1.5, 0.5)
    places = (pixels[:, None] + steps[None, :, None] * normals[:, None]).astype(np.float32)
    profile = cv2.remap(values, places[..., 0], places[..., 1], cv2.INTER_LINEAR)
    fall = (profile[:, :-4] - profile[:, 4:]) / 2.0
    fall = fall if signed else np.abs(fall)
    inner = steps[2:-2]
    # Of two edges alike the nearer one is the object's.
    best = (fall * np.exp(-0.5 * (inner / max(reach, 1)) ** 2)).argmax(axis=1)
    return inner[best], np.asarray(fall[np.arange(len(best)), best], dtype=np.float64)
