"""Pictures of a reduced model by itself: states side by side on a plain background, coloured by stress."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from morph_dslam.camera import PinholeCamera
from morph_dslam.geometry import RigidTransform
from morph_dslam.model import ReducedModel
from morph_dslam.render.overlay import draw_overlay
from morph_dslam.render.shading import lambert, vertex_normals

Array = NDArray[np.float64]

BACKGROUND = 245
#: Size of the object over that of the picture, and its distance from the camera over its size.
FILLING, DISTANCE = 0.8, 4.0


def looking_at(centre: Array, direction: Array, distance: float) -> RigidTransform:
    """camera_from_object of a camera that looks along ``direction`` (3,) at ``centre``, with z upright."""
    ahead = np.asarray(direction, dtype=float) / np.linalg.norm(direction)
    right = np.cross(ahead, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(ahead, right), ahead])
    return RigidTransform(rotation, np.array([0.0, 0.0, distance]) - rotation @ centre)


def draw_states(
    model: ReducedModel,
    states: Sequence[Array],
    captions: Sequence[str],
    direction: Array,
    place: str = "solid",
    size: tuple[int, int] = (600, 520),
) -> NDArray[np.uint8]:
    """States of a model side by side, coloured by von Mises stress in one range of colours.

    Parameters
    ----------
    states : parameters (d,) of each, SI. captions : a line for each.
    direction : (3,) in which the camera looks, object frame, not along z. place : a key of `model.stresses`.
    size : width and height of each picture, pixels.

    Returns
    -------
    (h, w, 3) uint8, blue, green, red.
    """
    width, height = size
    shapes = [model.positions(mu) for mu in states]
    stresses = [1e-6 * model.von_mises(mu, place) for mu in states]
    seen = np.unique(model.triangles)
    top = max(float(np.percentile(np.concatenate([stress[seen] for stress in stresses]), 99.5)), 1e-9)
    corners = np.concatenate([shape[seen] for shape in shapes])
    centre, extent = (corners.min(axis=0) + corners.max(axis=0)) / 2.0, np.ptp(corners, axis=0).max()
    pose = looking_at(centre, direction, DISTANCE * extent)
    focal = FILLING * DISTANCE * min(size)
    camera = PinholeCamera(width, height, focal, focal, 0.43 * width, 0.5 * height)
    pictures = []
    for shape, stress, caption in zip(shapes, stresses, captions, strict=True):
        nodes = pose.apply(shape)
        brightness = lambert(vertex_normals(nodes, model.triangles), np.array([-0.4, -0.6, -1.0]), 0.4)
        pictures.append(
            draw_overlay(
                np.full((height, width, 3), BACKGROUND, dtype=np.uint8),
                camera.project(nodes),
                nodes[:, 2],
                model.triangles,
                stress,
                (0.0, top),
                label="von Mises stress [MPa]",
                alpha=1.0,
                brightness=brightness,
                caption=caption,
            )
        )
    return np.concatenate(pictures, axis=1)
