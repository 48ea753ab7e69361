"""Pictures of a reduced model by itself: states side by side on a plain background, coloured by stress."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from morph_dslam.camera import Camera
from morph_dslam.geometry import RigidTransform
from morph_dslam.model import ReducedModel
from morph_dslam.model.shown_field import shown_kind
from morph_dslam.render.overlay import colour_levels, draw_overlay, paint_surface
from morph_dslam.render.shading import colour_table, lambert, vertex_normals

Array = NDArray[np.float64]
VIEW_BACKGROUND = 245
#: Width and height of the picture of one state, pixels.
STATE_SIZE = (600, 520)
#: Size of the object over that of the picture, and its distance from the camera over its size.
FILLING, DISTANCE = 0.8, 4.0
#: Size of what is drawn without letters over that of the picture.
FILLED = 0.92
#: Direction to the light, camera frame.
LIGHT = np.array([-0.4, -0.6, -1.0])


def looking_at(centre: Array, direction: Array, distance: float) -> RigidTransform:
    """camera_from_object of a camera that looks along ``direction`` (3,) at ``centre``, with z upright."""
    ahead = np.asarray(direction, dtype=float) / np.linalg.norm(direction)
    right = np.cross(ahead, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(ahead, right), ahead])
    return RigidTransform(rotation, np.array([0.0, 0.0, distance]) - rotation @ centre)


def fitting_view(
    shapes: Sequence[Array], direction: Array, size: tuple[int, int], middle: float = 0.5
) -> tuple[RigidTransform, Camera]:
    """camera_from_object and the camera that sees all ``shapes`` [(n, 3)] when it looks along ``direction``.

    Parameters
    ----------
    size : width and height, pixels.
    middle : where the shapes' middle is across the picture, 0 to 1.
    """
    corners = np.concatenate(shapes)
    centre, extent = (corners.min(axis=0) + corners.max(axis=0)) / 2.0, np.ptp(corners, axis=0).max()
    focal = FILLING * DISTANCE * min(size)
    camera = Camera(*size, focal, focal, middle * size[0], 0.5 * size[1])
    return looking_at(centre, direction, DISTANCE * extent), camera


def _filled(camera: Camera, pixels: Array) -> Camera:
    """The camera zoomed and shifted so that what it sees at ``pixels`` (n, 2) fills its picture."""
    size = np.array([camera.width, camera.height])
    low, high = pixels.min(axis=0), pixels.max(axis=0)
    zoom = FILLED * float((size / (high - low)).min())
    cx, cy = size / 2.0 + zoom * (np.array([camera.cx, camera.cy]) - (low + high) / 2.0)
    return replace(camera, fx=zoom * camera.fx, fy=zoom * camera.fy, cx=float(cx), cy=float(cy))


def draw_shapes(
    triangles: NDArray[np.int64],
    shapes: Sequence[Array],
    node_values: Sequence[Array],
    value_range: tuple[float, float],
    direction: Array,
    size: tuple[int, int],
    colour_map: str = "turbo",
) -> list[NDArray[np.uint8]]:
    """A surface in several shapes seen from one place, on white, without letters or colour bar.

    Parameters
    ----------
    triangles : (m, 3) the surface.
    shapes : node positions (n, 3) of each picture.
    node_values : (n,) what colours each picture; ``value_range`` at the ends of ``colour_map``.
    direction : (3,) in which the camera looks, object frame, not along z.
    size : of each picture, pixels.

    Returns
    -------
    list of (h, w, 3) uint8, blue, green, red.
    """
    fine = (2 * size[0], 2 * size[1])
    seen = np.unique(triangles)
    pose, camera = fitting_view([shape[seen] for shape in shapes], direction, fine)
    camera = _filled(camera, np.concatenate([camera.project(pose.apply(shape[seen])) for shape in shapes]))
    pictures = []
    for shape, values in zip(shapes, node_values, strict=True):
        nodes = pose.apply(shape)
        image = np.full((fine[1], fine[0], 3), 255, dtype=np.uint8)
        paint_surface(
            image,
            camera.project(nodes),
            nodes[:, 2],
            triangles,
            colour_levels(values, value_range),
            colour_table(colour_map),
            brightness=lambert(vertex_normals(nodes, triangles), LIGHT, 0.4),
        )
        # Averaged down from twice the size, for smooth edges.
        pictures.append(np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), dtype=np.uint8))
    return pictures


def draw_states(
    model: ReducedModel, states: Sequence[Array], captions: Sequence[str], direction: Array
) -> NDArray[np.uint8]:
    """States of a solid side by side, coloured by von Mises stress in one range of colours.

    Parameters
    ----------
    states : parameters (d,) of each, SI.
    captions : a line for each.
    direction : (3,) in which the camera looks, object frame, not along z.

    Returns
    -------
    (h, w, 3) uint8, blue, green, red.
    """
    shapes = [model.positions(mu) for mu in states]
    kind = shown_kind(model, "stress")
    stresses = [model.von_mises(mu, "solid") / kind.si_factor for mu in states]
    seen = np.unique(model.triangles)
    top = max(float(np.percentile(np.concatenate([stress[seen] for stress in stresses]), 99.5)), 1e-9)
    # The colour bar takes the right.
    pose, camera = fitting_view([shape[seen] for shape in shapes], direction, STATE_SIZE, middle=0.43)
    pictures = []
    for shape, stress, caption in zip(shapes, stresses, captions, strict=True):
        nodes = pose.apply(shape)
        brightness = lambert(vertex_normals(nodes, model.triangles), LIGHT, 0.4)
        pictures.append(
            draw_overlay(
                np.full((*STATE_SIZE[::-1], 3), VIEW_BACKGROUND, dtype=np.uint8),
                camera.project(nodes),
                nodes[:, 2],
                model.triangles,
                stress,
                (0.0, top),
                label=f"{kind.name} [{kind.unit}]",
                alpha=1.0,
                brightness=brightness,
                caption=caption,
            )
        )
    return np.concatenate(pictures, axis=1)
