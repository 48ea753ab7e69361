"""Rendered frames of a textured, bending sheet with known states, and what can spoil them."""

from __future__ import annotations

import cv2
import numpy as np

from morph_dslam.camera import Camera
from morph_dslam.geometry import RigidTransform, rotation_exp
from morph_dslam.io.camera_files import save_camera
from morph_dslam.io.landmarks import Landmarks, save_landmarks
from morph_dslam.model import save_model
from morph_dslam.render.rasteriser import rasterise
from morph_dslam.render.texture import render_textured
from morph_dslam.tracking.estimator import State
from morph_dslam.tracking.rig import RigCamera

CAMERA = Camera(640, 480, 528.0, 528.0, 320.0, 240.0)
UPRIGHT = np.diag([1.0, -1.0, -1.0])
# Several cameras of wide lenses, so that one by itself tells little along its sight line; 0.3 m apart.
FRONT = RigCamera(Camera(480, 360, 330.0, 330.0, 240.0, 180.0), RigidTransform.identity())
TURN = rotation_exp(np.array([0.0, 0.5, 0.0]))
ASIDE = RigCamera(
    Camera(480, 360, 350.0, 350.0, 235.0, 182.0),
    RigidTransform(TURN, np.array([0.0, 0.0, 0.62]) - TURN @ np.array([0.0, 0.0, 0.62])),
)
RIG = (FRONT, ASIDE)


def printed_texture(height=594, width=840, seed=0):
    """White paper with dark strokes and blots, grey (h, w) uint8; 2 pixels a millimetre for A3."""
    rng = np.random.default_rng(seed)
    image = np.full((height, width), 225, dtype=np.uint8)
    for _ in range(700):
        centre = rng.integers([0, 0], [width, height])
        end = centre + rng.integers(-25, 26, 2)
        grey = int(rng.integers(20, 160))
        if rng.random() < 0.5:
            cv2.line(image, centre.tolist(), end.tolist(), grey, int(rng.integers(2, 5)), cv2.LINE_AA)
        else:
            cv2.circle(image, centre.tolist(), int(rng.integers(2, 9)), grey, -1, cv2.LINE_AA)
    return cv2.GaussianBlur(image, (0, 0), 1.0)


def sheet_state(time):
    """A sheet that moves, turns and bends both ways; ``time`` from 0 to 1."""
    parameters = np.array(
        [0.045 * np.sin(5.0 * time + 0.3), 0.4 * np.sin(3.0 * time), np.radians(12) * np.sin(4.0 * time)]
    )
    turn = rotation_exp(np.array([0.15 * np.sin(3.0 * time) + 0.1, 0.35 * np.sin(2.5 * time), 0.3 * time]))
    position = np.array([0.05 * np.sin(4.0 * time), 0.03 * time, 0.62 + 0.08 * np.sin(3.0 * time)])
    return State(parameters, RigidTransform(turn @ UPRIGHT, position))


def clutter(rng, camera=CAMERA):
    """A grey background (h, w) uint8."""
    cells = rng.integers(60, 190, (24, 32)).astype(np.uint8)
    return cv2.resize(cells, (camera.width, camera.height), interpolation=cv2.INTER_CUBIC)


def colours(image):
    """A grey image (h, w) as a camera gives it, (h, w, 3) uint8."""
    return np.repeat(np.clip(image, 0, 255).astype(np.uint8)[:, :, None], 3, axis=2)


class SheetFilm:
    """Renders a model of an A3 sheet before a cluttered background."""

    def __init__(self, model, camera=CAMERA, seed=0):
        self.model, self.camera = model, camera
        self.rng = np.random.default_rng(seed)
        self.texture = printed_texture(seed=seed)
        x, y = model.nodes[:, 0], model.nodes[:, 1]
        self.coordinates = np.column_stack([(x / 0.420 + 0.5) * 839.0, (0.5 - y / 0.297) * 593.0])
        self.background = clutter(self.rng, camera)

    def frame(self, state, noise=2.0, light=1.0, occluder=None):
        """One image (h, w, 3) uint8; ``light`` scales the sheet only, ``occluder`` is (x, y, w, h)."""
        nodes = state.camera_from_object.apply(self.model.positions(state.parameters))
        camera = self.camera
        buffers = rasterise(camera.project(nodes), nodes[:, 2], self.model.triangles, camera.height, camera.width)
        sheet = render_textured(buffers, self.model.triangles, self.coordinates, self.texture)
        image = np.where(buffers.covered, light * sheet, self.background)
        if occluder is not None:
            x, y, width, height = occluder
            image[max(y, 0) : y + height, max(x, 0) : x + width] = self.background[:height, :width][
                max(-y, 0) : camera.height - y, max(-x, 0) : camera.width - x
            ]
        return colours(image + noise * self.rng.standard_normal(image.shape))

    def blank(self, noise=2.0):
        """A frame that shows nothing."""
        return colours(120.0 + noise * self.rng.standard_normal((self.camera.height, self.camera.width)))


def sheet_depth(model, state, rng, noise_at_1m=1.4e-3, background=1.5, camera=CAMERA):
    """What a depth camera measures (h, w), metres: noise grows with the distance squared."""
    nodes = state.camera_from_object.apply(model.positions(state.parameters))
    exact = rasterise(camera.project(nodes), nodes[:, 2], model.triangles, camera.height, camera.width).depth
    exact = np.where(np.isfinite(exact), exact, background)
    return (exact + noise_at_1m * exact**2 * rng.standard_normal(exact.shape)).astype(np.float32)


def mean_error(model, found, truth, true_model=None):
    """Mean distance of the mesh nodes of two states in the camera frame, metres."""
    a = found.camera_from_object.apply(model.positions(found.parameters))
    b = truth.camera_from_object.apply((true_model or model).positions(truth.parameters))
    return float(np.linalg.norm(a - b, axis=1).mean())


def write_landmarks(path, model, state, camera=CAMERA, count=16, seed=0):
    """Points of the object and the pixels in which the camera sees them."""
    nodes = np.random.default_rng(seed).choice(len(model.nodes), count, replace=False)
    pixels = camera.project(state.camera_from_object.apply(model.positions(state.parameters)))[nodes]
    inside = ((pixels > 5.0) & (pixels < [camera.width - 5.0, camera.height - 5.0])).all(axis=1)
    save_landmarks(path, Landmarks(model.nodes[nodes[inside]], pixels[inside]))


def write_recording(folder, images, model, camera=CAMERA, name="frames"):
    """`sheet.morph`, `camera.yaml`, and a folder of images by number."""
    (folder / name).mkdir()
    for number, image in images.items():
        cv2.imwrite(str(folder / name / f"{number:06d}.png"), image)
    save_model(folder / "sheet.morph", model)
    save_camera(folder / "camera.yaml", camera)
