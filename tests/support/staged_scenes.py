"""Staged recordings of a sheet or a wedge: covered, absent, doubled, with exact truth, from either start.

A `Stage` renders instances of a textured model before a background or on a table, and hides them behind an
occluder. `SCENES` are five of them; each moves by its seed.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from morph_dslam.camera import PinholeCamera
from morph_dslam.geometry import RigidTransform, rotation_exp
from morph_dslam.model import Parameter, ReducedModel, SeparatedField
from morph_dslam.model.functions import ParameterFunctions
from morph_dslam.online.confidence import position_std
from morph_dslam.online.estimation import State
from morph_dslam.render.model_view import looking_at
from morph_dslam.render.rasteriser import rasterise
from morph_dslam.render.texture import render_textured
from tests.support.bent_sheet import LENGTH, WIDTH, _separated, bent_sheet_model, deflection_terms
from tests.support.rendered_object import wedge
from tests.support.rendered_sequence import CAMERA, UPRIGHT, printed_texture

#: An estimate is confidently wrong if it is off by so many of its standard deviations and by so much, metres.
CONFIDENT_SIGMAS, CONFIDENT_ERROR = 5.0, 5e-3
#: Height of the wedge, metres, and how far its top is moved.
HEIGHT, REACH = 0.07, 0.02


def bending_wedge(turned: bool = False) -> ReducedModel:
    """The wedge of `rendered_object`, its top pushed along x and y as z²; ``turned``: twisted and raised."""
    nodes, triangles, _ = wedge()
    x, y, z = (nodes - [0.045, 0.03, 0.0]).T
    rise, zero = (z / HEIGHT) ** 2, np.zeros_like(z)
    modes = np.array([[rise, zero, zero], [zero, rise, zero]])
    if turned:
        modes = np.array([[-y * rise, x * rise, zero], [zero, zero, rise]]) * [[[25.0]], [[1.0]]]
    names = ("twist", "raise") if turned else ("push_x", "push_y")
    parameters = tuple(Parameter(name, "length", "mm", -REACH, REACH, 0.0, "") for name in names)
    functions = ParameterFunctions(
        np.full(2, -REACH), np.full(2, REACH), np.eye(2, dtype=np.int64), REACH * np.eye(2)
    )
    field = SeparatedField(np.ascontiguousarray(modes.transpose(0, 2, 1)), functions)
    return ReducedModel("wedge", nodes, triangles, parameters, field, {})


def crossed_sheet() -> ReducedModel:
    """The same sheet, loaded otherwise: bent across its other axis."""
    sheet = bent_sheet_model()
    turned = deflection_terms(sheet.nodes[:, 1] * LENGTH / WIDTH, sheet.nodes[:, 0] * WIDTH / LENGTH)
    terms = {powers: field[:, [1, 0, 2]] for powers, field in turned.items()}
    return replace(sheet, name="crossed sheet", displacement=_separated(terms, sheet.parameters))


def narrow_sheet(share: float = 0.96) -> ReducedModel:
    """A sheet of another format: narrower, but as high."""
    sheet = bent_sheet_model()
    return replace(sheet, name="narrow sheet", nodes=sheet.nodes * [share, 1.0, 1.0])


@dataclass
class Stage:
    """Renders a model in any states.

    Attributes
    ----------
    coordinates : (n, 2) of the nodes in ``texture``. backdrop : (h, w) grey, behind all.
    """

    model: ReducedModel
    coordinates: np.ndarray
    texture: np.ndarray
    backdrop: np.ndarray
    camera: PinholeCamera
    rng: np.random.Generator

    def frame(self, states: Sequence[State], cover: float = 0.0, noise: float = 2.0) -> np.ndarray:
        """One image (h, w, 3) with an instance in every state; ``cover`` of it is hidden from the left."""
        image, depth = self.backdrop.astype(float), np.full(self.backdrop.shape, np.inf)
        for state in states:
            nodes = state.camera_from_object.apply(self.model.positions(state.parameters))
            height, width = self.backdrop.shape
            pixels = self.camera.project(nodes)
            buffers = rasterise(pixels, nodes[:, 2], self.model.triangles, height, width)
            drawn = render_textured(buffers, self.model.triangles, self.coordinates, self.texture)
            nearer = buffers.depth < depth
            image, depth = np.where(nearer, drawn, image), np.where(nearer, buffers.depth, depth)
        column = round(cover * image.shape[1])
        # An arm in a checked sleeve: texture that is not the object's.
        rows, columns = np.indices(image.shape)
        sleeve = np.where((rows // 9 + columns // 13) % 2 == 0, 95.0, 150.0)
        image[:, :column] = sleeve[:, :column]
        image += noise * self.rng.standard_normal(image.shape)
        return np.repeat(np.clip(image, 0, 255).astype(np.uint8)[:, :, None], 3, axis=2)


@dataclass(frozen=True)
class Scene:
    """One of `SCENES`, made for a seed.

    Attributes
    ----------
    stage : that renders it. state : of the object at a time from 0 to 1. others : wrong models by name.
    beside : a step to the side, metres, that puts a second object just next to the first.
    """

    stage: Stage
    state: Callable[[float], State]
    others: dict[str, ReducedModel]
    beside: float

    @property
    def model(self) -> ReducedModel:
        return self.stage.model


def _waves(seed: int, count: int) -> Callable[[float], np.ndarray]:
    rng = np.random.default_rng(seed)
    phases, rates = rng.uniform(0.0, 2.0 * np.pi, count), rng.uniform(2.0, 4.5, count)
    return lambda time: np.sin(rates * time + phases)


def _sheet(seed: int, distance: float, cluttered: bool) -> Scene:
    model, waves = bent_sheet_model(), _waves(seed, 9)
    x, y = model.nodes[:, 0], model.nodes[:, 1]
    coordinates = np.column_stack([(x / LENGTH + 0.5) * 839.0, (0.5 - y / WIDTH) * 593.0])
    rng = np.random.default_rng(seed)
    size = (CAMERA.width, CAMERA.height)
    cells = rng.integers(60, 190, (24, 32)).astype(np.uint8)
    backdrop = cv2.resize(cells, size, interpolation=cv2.INTER_CUBIC)
    if cluttered:
        backdrop = printed_texture(CAMERA.height, CAMERA.width, seed + 50)

    def state(time: float) -> State:
        w = waves(time)
        turn = rotation_exp(w[3:6] * [0.2, 0.35, 0.25]) @ UPRIGHT
        position = np.array([-0.1, 0.0, distance]) + w[6:] * [0.04, 0.03, 0.05]
        return State(w[:3] * [0.045, 0.4, np.radians(12)], RigidTransform(turn, position))

    stage = Stage(model, coordinates, printed_texture(seed=seed), backdrop, CAMERA, rng)
    return Scene(stage, state, {"crossed": crossed_sheet(), "narrow": narrow_sheet()}, LENGTH + 0.02)


def _wedge(seed: int, around: bool) -> Scene:
    """In the hand, or standing still while the camera goes ``around`` it."""
    model, waves = bending_wedge(), _waves(seed, 8)
    coordinates = wedge()[2]
    rng = np.random.default_rng(seed)
    cells = rng.integers(60, 190, (24, 32)).astype(np.uint8)
    backdrop = cv2.resize(cells, (CAMERA.width, CAMERA.height), interpolation=cv2.INTER_CUBIC)
    middle = np.array([0.045, 0.03, 0.03])

    def state(time: float) -> State:
        w = waves(time)
        angle = 0.7 + (0.6 * time if around else 0.15 * w[2])
        direction = np.array([np.cos(angle), np.sin(angle), -0.6])
        pose = looking_at(middle, direction, 0.22 + 0.01 * w[3])
        if not around:
            pose = RigidTransform(
                rotation_exp(0.1 * w[3:6]) @ pose.rotation, pose.translation + w[5:8] * 0.01
            )
        ramp = min(4.0 * time, 1.0)
        return State(ramp * 0.012 * w[:2], pose)

    stage = Stage(model, coordinates, printed_texture(400, 520, seed), backdrop, CAMERA, rng)
    return Scene(stage, state, {"twisting": bending_wedge(turned=True)}, 0.12)


SCENES: dict[str, Callable[[int], Scene]] = {
    "sheet": lambda seed: _sheet(seed, 0.85, cluttered=False),
    "far sheet": lambda seed: _sheet(seed + 100, 1.3, cluttered=False),
    "sheet before prints": lambda seed: _sheet(seed + 200, 0.95, cluttered=True),
    "wedge in the hand": lambda seed: _wedge(seed + 300, around=False),
    "wedge on a table": lambda seed: _wedge(seed + 400, around=True),
}


def aside(state: State, step: Sequence[float]) -> State:
    """The same shape, moved in the camera frame by a step (3,), metres."""
    pose = state.camera_from_object
    return State(state.parameters, RigidTransform(pose.rotation, pose.translation + np.asarray(step)))


def mean_error(model, estimate, truth_model, truth) -> float:
    """Mean distance of corresponding nodes in the camera frame, metres."""
    found = estimate.state.camera_from_object.apply(model.positions(estimate.state.parameters))
    true = truth.camera_from_object.apply(truth_model.positions(truth.parameters))
    return float(np.linalg.norm(found - true, axis=1).mean())


def confidently_wrong(model, result, truth_model, truth) -> bool:
    """Whether a frame is tracked, off by more than 5 mm, and by more than five times what it states.

    The error is the mean over all nodes, what is stated the root mean square of their deviations.
    """
    if result.status != "tracked":
        return False
    error = mean_error(model, result.estimate, truth_model, truth)
    stated = float(np.sqrt(np.mean(position_std(model, result.estimate) ** 2)))
    return error > CONFIDENT_ERROR and error > CONFIDENT_SIGMAS * stated
