"""Whether landmarks are on the side of the object that faces the camera."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from morph_dslam.model import ReducedModel
from morph_dslam.model.reduced_model import triangle_normals
from morph_dslam.registration.messages import LandmarksTurnedAway
from morph_dslam.tracking.binding import DrawnSurface, nearest_surface_points
from morph_dslam.tracking.state import State

Array = NDArray[np.float64]
#: Cosine of the angle between a face and the line of sight from which on the face is seen, and not from its edge.
SEEN = 0.2
#: Planes of faces that are nearer to a landmark than this share of the object's size may be what it is on.
ON_FACE = 0.01
#: So large a share of the landmarks has to be on sides that are not seen; single ones may be a matter of rounding.
MOST = 0.8


def turned_away(model: ReducedModel, state: State, points: Array) -> Iterator[LandmarksTurnedAway]:
    """A warning if nearly all landmarks are on faces of a closed surface that are turned away from the camera.

    A landmark on an edge or a corner is on all faces that meet there.

    Parameters
    ----------
    model : of the object.
    state : as registered.
    points : (k, 3) of the landmarks on the undeformed object, metres.
    """
    if not DrawnSurface.of(model).closed:
        return
    normals = _unit(triangle_normals(model.nodes, model.triangles))
    nodes = state.camera_from_object.apply(model.positions(state.parameters))
    towards = -nodes[model.triangles].mean(axis=1)
    seen = np.sum(_unit(triangle_normals(nodes, model.triangles)) * _unit(towards), axis=1) > SEEN
    nearest, _ = nearest_surface_points(model.nodes, model.triangles, points)
    reach = ON_FACE * float(np.linalg.norm(np.ptp(model.nodes, axis=0)))
    count = 0
    for point, own in zip(points, nearest.triangles, strict=True):
        beside = np.isin(model.triangles, model.triangles[own]).any(axis=1)
        height = np.abs(np.sum((point - model.nodes[model.triangles[:, 0]]) * normals, axis=1))
        count += not (seen & beside & (height < reach)).any()
    if count >= MOST * len(points):
        yield LandmarksTurnedAway(count, len(points))


def _unit(vectors: Array) -> Array:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-300)
