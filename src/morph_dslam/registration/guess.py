"""Registration by a guess: refined until its outline parts the object from what is around it, or refused.

Brightness inside of the guessed outline and around it says how likely each pixel belongs to the object
(Prisacariu & Reid 2012), so that edges of a print do not count. The outline is laid where this falls, searched
along its normals, and at last, from nearby, where the brightness itself changes most. At the right pose it falls
everywhere; elsewhere only by chance, and how often that is the image itself says.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field, FiniteFloat
from scipy.spatial.transform import Rotation

from morph_dslam.camera import Camera
from morph_dslam.errors import RegistrationError, RegistrationFailure
from morph_dslam.geometry import RigidTransform
from morph_dslam.io.sections import Section, read_sections
from morph_dslam.model import ReducedModel, SurfacePoints
from morph_dslam.registration.initialization import Vector
from morph_dslam.registration.messages import OutlineOnly
from morph_dslam.registration.registration import Registration
from morph_dslam.tracking.binding import DrawnSurface, draw_view, view_of
from morph_dslam.tracking.estimator import Estimate, EstimationOptions, Estimator
from morph_dslam.tracking.state import BoundPoints, Prior, State

Array = NDArray[np.float64]
Image = NDArray[np.uint8]
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
#: How sure the guessed parameters are, over their range: an outline says little of the shape.
GUESS_SHARE = 0.05


class Pose(Section):
    """The object in the camera's frame (x right, y down, z ahead): origin; turn about x, then y, then z."""

    position_mm: Vector
    rotation_deg: Vector


class GuessFile(Section):
    """A guess: the pose, and values of any of the model's parameters in the units in which it shows them.

    In a map also the number of the frame.
    """

    pose: Pose
    parameters: dict[str, FiniteFloat] = Field(default_factory=dict)
    frame: Annotated[int, Field(ge=0)] | None = None


@dataclass(frozen=True)
class GuessInitializer:
    """Finds the object near a guess."""

    guess: GuessFile

    def state(self, model: ReducedModel) -> State:
        """The guess; raises RegistrationError if it has a parameter that the model has not."""
        values = model.default.copy()
        names = [parameter.name for parameter in model.parameters]
        for name, value in self.guess.parameters.items():
            if name not in names:
                raise RegistrationError(
                    f"the guess has '{name}', the model's parameters are {', '.join(names) or 'none'}"
                )
            k = names.index(name)
            shown = model.parameters[k].display(1.0)  # of one SI unit
            values[k] = np.clip(value / shown, model.lower[k], model.upper[k])
        return State(values, self.pose)

    @property
    def pose(self) -> RigidTransform:
        """The guessed camera_from_object, metres."""
        turn = Rotation.from_euler("xyz", self.guess.pose.rotation_deg, degrees=True).as_matrix()
        return RigidTransform(turn, 1e-3 * np.array(self.guess.pose.position_mm))

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
                f"{REACHES[0]} pixels), or landmarks",
                RegistrationFailure.GUESS_CONTRADICTED,
            )
        facts = {"from": "guess", "outline_on_edges": on_edges, "by_chance": by_chance}
        covariance = N_POINTS / N_INDEPENDENT * estimate.covariance
        return Registration(model, estimate.state, covariance, facts=facts, warnings=(OutlineOnly(),))


def load_guess(path: Path) -> GuessInitializer:
    """Read a guess; raises RegistrationError if the file is missing or malformed."""
    return GuessInitializer(read_sections(path, "guess", GuessFile, RegistrationError))


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
            raise RegistrationError(
                "the guess puts the object out of the image, or so far away that it is a dot",
                RegistrationFailure.GUESS_CONTRADICTED,
            )
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
