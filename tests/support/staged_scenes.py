"""Staged recordings of a sheet or a wedge: covered, absent, doubled, with exact truth, from either start.

A `Stage` renders instances of a textured model before a background or on a table, and hides them behind an
occluder. `SCENES` are five of them; each moves by its seed.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from morph_dslam.camera import Camera
from morph_dslam.geometry import RigidTransform, rotation_exp
from morph_dslam.model import Parameter, ReducedModel, SeparatedField
from morph_dslam.model.functions import ParameterFunctions
from morph_dslam.render.model_view import looking_at
from morph_dslam.render.rasteriser import rasterise
from morph_dslam.render.texture import render_textured
from morph_dslam.tracking.estimator import State
from morph_dslam.tracking.observability import position_std
from tests.support.bent_sheet import LENGTH, WIDTH, _separated, bent_sheet_model, deflection_terms
from tests.support.rendered_object import wedge
from tests.support.rendered_sequence import CAMERA, UPRIGHT, clutter, colours, mean_error, printed_texture

#: An estimate is off beyond what it states if by so many of its standard deviations and by this share of the
#: object's size: 5.1 mm of the sheets, 1.3 mm of the wedge.
CONFIDENT_SIGMAS, CONFIDENT_SHARE = 3.0, 0.01
#: Height of the wedge, metres, and how far its top is moved.
HEIGHT, REACH = 0.07, 0.02


def bending_wedge(turned: bool = False, power: float = 2.0) -> ReducedModel:
    """The wedge of `rendered_object`, its top pushed along x and y as z²; ``turned``: twisted and raised.

    Another ``power`` than 2 is that of another material: 1 shears, 4 is soft at the top.
    """
    nodes, triangles, _ = wedge()
    x, y, z = (nodes - [0.045, 0.03, 0.0]).T
    rise, zero = (z / HEIGHT) ** power, np.zeros_like(z)
    modes = np.array([[rise, zero, zero], [zero, rise, zero]])
    if turned:
        modes = np.array([[-y * rise, x * rise, zero], [zero, zero, rise]]) * [[[25.0]], [[1.0]]]
    names = ("twist", "raise") if turned else ("push_x", "push_y")
    parameters = tuple(Parameter(name, "length", "mm", -REACH, REACH, 0.0, "") for name in names)
    functions = ParameterFunctions(np.full(2, -REACH), np.full(2, REACH), np.eye(2, dtype=np.int64), REACH * np.eye(2))
    field = SeparatedField(np.ascontiguousarray(modes.transpose(0, 2, 1)), functions)
    return ReducedModel("wedge", nodes, triangles, parameters, field, {})


def crossed_sheet() -> ReducedModel:
    """The same sheet, loaded otherwise: bent across its other axis."""
    sheet = bent_sheet_model()
    turned = deflection_terms(sheet.nodes[:, 1] * LENGTH / WIDTH, sheet.nodes[:, 0] * WIDTH / LENGTH)
    terms = {powers: field[:, [1, 0, 2]] for powers, field in turned.items()}
    return replace(sheet, name="crossed sheet", displacement=_separated(terms, sheet.parameters))


def drawn_out(model: ReducedModel, factors: Sequence[float]) -> ReducedModel:
    """The model of an object that is longer or shorter along each axis, and moves as far."""
    return replace(model, name=f"drawn out {model.name}", nodes=model.nodes * np.asarray(factors))


@dataclass
class Stage:
    """Renders a model in any states.

    Attributes
    ----------
    coordinates : (n, 2) of the nodes in ``texture``.
    backdrop : (h, w) grey, behind all.
    """

    model: ReducedModel
    coordinates: np.ndarray
    texture: np.ndarray
    backdrop: np.ndarray
    camera: Camera
    rng: np.random.Generator

    def frame(
        self,
        states: Sequence[State],
        cover: float = 0.0,
        noise: float = 2.0,
        strangers: Sequence[State] = (),
        thing: tuple[float, float, float, float] | None = None,
    ) -> np.ndarray:
        """One image (h, w, 3) with an instance in every state; ``cover`` of it is hidden from the left.

        ``strangers`` are of the object's shape with another print; ``thing`` is a printed rectangle before
        all, its left, top, width and height as shares of the image.
        """
        image, depth = self.backdrop.astype(float), np.full(self.backdrop.shape, np.inf)
        for state, texture in [(s, self.texture) for s in states] + [(s, self._other) for s in strangers]:
            nodes = state.camera_from_object.apply(self.model.positions(state.parameters))
            height, width = self.backdrop.shape
            pixels = self.camera.project(nodes)
            buffers = rasterise(pixels, nodes[:, 2], self.model.triangles, height, width)
            drawn = render_textured(buffers, self.model.triangles, self.coordinates, texture)
            nearer = buffers.depth < depth
            image, depth = np.where(nearer, drawn, image), np.where(nearer, buffers.depth, depth)
        column = round(cover * image.shape[1])
        # An arm in a checked sleeve: texture that is not the object's.
        rows, columns = np.indices(image.shape)
        sleeve = np.where((rows // 9 + columns // 13) % 2 == 0, 95.0, 150.0)
        image[:, :column] = sleeve[:, :column]
        if thing is not None:
            self._lay(image, thing)
        image += noise * self.rng.standard_normal(image.shape)
        return colours(image)

    @cached_property
    def _other(self) -> np.ndarray:
        """Another print of the same kind and size."""
        return printed_texture(*self.texture.shape, seed=9001)

    def _lay(self, image: np.ndarray, thing: tuple[float, float, float, float]) -> None:
        """Draw a printed rectangle over an image (h, w); its print moves with it."""
        height, width = image.shape
        left, top = round(thing[0] * width), round(thing[1] * height)
        right, bottom = left + round(thing[2] * width), top + round(thing[3] * height)
        rows, columns = slice(max(top, 0), max(bottom, 0)), slice(max(left, 0), max(right, 0))
        seen = image[rows, columns]
        printed = np.tile(self._other, (4, 4))[rows.start - top :, columns.start - left :]
        seen[:] = printed[: seen.shape[0], : seen.shape[1]]


@dataclass(frozen=True)
class Scene:
    """One of `SCENES`, made for a seed.

    Attributes
    ----------
    stage : that renders it.
    state : of the object at a time from 0 to 1.
    others : wrong models by name.
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
    backdrop = clutter(rng)
    if cluttered:
        backdrop = printed_texture(CAMERA.height, CAMERA.width, seed + 50)

    def state(time: float) -> State:
        w = waves(time)
        turn = rotation_exp(w[3:6] * [0.2, 0.35, 0.25]) @ UPRIGHT
        position = np.array([-0.1, 0.0, distance]) + w[6:] * [0.04, 0.03, 0.05]
        return State(w[:3] * [0.045, 0.4, np.radians(12)], RigidTransform(turn, position))

    stage = Stage(model, coordinates, printed_texture(seed=seed), backdrop, CAMERA, rng)
    return Scene(stage, state, {"crossed": crossed_sheet()}, LENGTH + 0.02)


def _wedge(seed: int, around: bool) -> Scene:
    """In the hand, or standing still while the camera goes ``around`` it."""
    model, waves = bending_wedge(), _waves(seed, 8)
    coordinates = wedge()[2]
    rng = np.random.default_rng(seed)
    backdrop = clutter(rng)
    middle = np.array([0.045, 0.03, 0.03])

    def state(time: float) -> State:
        w = waves(time)
        angle = 0.7 + (0.6 * time if around else 0.15 * w[2])
        direction = np.array([np.cos(angle), np.sin(angle), -0.6])
        pose = looking_at(middle, direction, 0.22 + 0.01 * w[3])
        if not around:
            pose = RigidTransform(rotation_exp(0.1 * w[3:6]) @ pose.rotation, pose.translation + w[5:8] * 0.01)
        ramp = min(4.0 * time, 1.0)
        return State(ramp * 0.012 * w[:2], pose)

    stage = Stage(model, coordinates, printed_texture(400, 520, seed), backdrop, CAMERA, rng)
    others = {"twisting": bending_wedge(True), "shearing": bending_wedge(power=1.0)}
    return Scene(stage, state, others | {"soft at the top": bending_wedge(power=4.0)}, 0.12)


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


def is_beyond(model, result, truth_model, truth) -> bool:
    """Whether a frame is tracked, off by more than 1 % of the object, and by over three times what it states.

    The error is the mean over all nodes, what is stated the root mean square of their deviations.
    """
    if result.status != "tracked":
        return False
    error = mean_error(model, result.estimate.state, truth, truth_model)
    stated = float(np.sqrt(np.mean(position_std(model, result.estimate) ** 2)))
    size = np.linalg.norm(np.ptp(truth_model.nodes, axis=0))
    return bool(error > CONFIDENT_SHARE * size and error > CONFIDENT_SIGMAS * stated)


def is_doubted(result) -> bool:
    """Whether a frame's warnings say that it is not to be relied on."""
    return any(warning.doubts_result for warning in result.warnings)
