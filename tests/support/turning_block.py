"""A printed block that bends, twists and turns about its long axis before a camera, with known states."""

from __future__ import annotations

from math import radians

import numpy as np

from morph_dslam.geometry import RigidTransform, rotation_exp
from morph_dslam.model import Parameter, ReducedModel
from morph_dslam.render.rasteriser import rasterise
from morph_dslam.render.texture import render_textured
from morph_dslam.tracking.estimator import State
from tests.support.bent_sheet import _separated, grid_triangles
from tests.support.rendered_sequence import CAMERA, UPRIGHT, clutter, colours, printed_texture

#: Edges along x, y and z, metres; it turns about y.
SIZE = np.array([0.10, 0.13, 0.08])
PARAMETERS = (
    Parameter("bend", "length", "mm", -0.015, 0.015, 0.0, "shift of both ends along z"),
    Parameter("twist", "angle", "deg", -radians(15), radians(15), 0.0, "of each end about y"),
)
#: Corners of each face in shares of the size, anticlockwise seen from outside.
_FACES = (
    ((-1, -1, 1), (1, -1, 1), (1, 1, 1), (-1, 1, 1)),
    ((1, -1, 1), (1, -1, -1), (1, 1, -1), (1, 1, 1)),
    ((1, -1, -1), (-1, -1, -1), (-1, 1, -1), (1, 1, -1)),
    ((-1, -1, -1), (-1, -1, 1), (-1, 1, 1), (-1, 1, -1)),
    ((-1, 1, 1), (1, 1, 1), (1, 1, -1), (-1, 1, -1)),
    ((-1, -1, -1), (1, -1, -1), (1, -1, 1), (-1, -1, 1)),
)
#: Pixels of the print along each edge of a face.
_PRINT = 300


def _faces(cells):
    """Nodes (n, 3) of all faces, each with its own, triangles (m, 3) and places on the print (n, 2)."""
    a, b = (part.ravel() for part in np.meshgrid(np.linspace(0, 1, cells + 1), np.linspace(0, 1, cells + 1)))
    weights = np.column_stack([(1 - a) * (1 - b), a * (1 - b), a * b, (1 - a) * b])
    nodes = [weights @ (0.5 * SIZE * np.array(face)) for face in _FACES]
    squares = grid_triangles(cells + 1, cells + 1)
    triangles = [squares + k * len(a) for k in range(len(_FACES))]
    places = [np.column_stack([a + k % 3, b + k // 3]) * (_PRINT - 1.0) + [k % 3, k // 3] for k in range(len(_FACES))]
    return np.concatenate(nodes), np.concatenate(triangles), np.concatenate(places)


def turning_block(cells=12):
    """The reduced model, of a closed surface, and the rows of its nodes for those of `_faces`."""
    corners, triangles, _ = _faces(cells)
    nodes, rows = np.unique(corners.round(9), axis=0, return_inverse=True)
    rows = rows.ravel()
    x, y, z = nodes.T
    along, none = 2.0 * y / SIZE[1], np.zeros(len(nodes))
    terms = {(1, 0): np.column_stack([none, none, along**2]), (0, 1): np.column_stack([along * z, none, -along * x])}
    model = ReducedModel("turning block", nodes, rows[triangles], PARAMETERS, _separated(terms, PARAMETERS), {})
    return model, rows


def block_state(turn, time):
    """Turned about y by ``turn``, radians, and deformed; both deformations are zero at ``time`` 0 and 1."""
    parameters = np.array([0.008 * np.sin(np.pi * time), radians(8) * np.sin(2 * np.pi * time)])
    tilt = rotation_exp(np.array([0.25, 0.0, 0.0]))
    pose = RigidTransform(tilt @ UPRIGHT @ rotation_exp(np.array([0.0, turn, 0.0])), np.array([0.0, 0.0, 0.33]))
    return State(parameters, pose)


class BlockFilm:
    """Renders the block, each face with a print of its own, before a cluttered background."""

    def __init__(self, cells=12, seed=0):
        self.model, self._rows = turning_block(cells)
        _, self._triangles, self._places = _faces(cells)
        self.rng = np.random.default_rng(seed)
        self._print = printed_texture(2 * _PRINT, 3 * _PRINT, seed)
        self._background = clutter(self.rng)

    def frame(self, state, noise=2.0):
        """One image (h, w, 3) uint8."""
        nodes = state.camera_from_object.apply(self.model.positions(state.parameters))[self._rows]
        buffers = rasterise(
            CAMERA.project(nodes), nodes[:, 2], self._triangles, CAMERA.height, CAMERA.width, closed=True
        )
        block = render_textured(buffers, self._triangles, self._places, self._print)
        image = np.where(buffers.covered, block, self._background)
        return colours(image + noise * self.rng.standard_normal(image.shape))
