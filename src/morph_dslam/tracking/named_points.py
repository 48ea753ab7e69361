"""Places of an object that a run follows by name, as a fingertip."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from morph_dslam.errors import ParameterError, TrackingError
from morph_dslam.io.text import PLAIN_NAME, PLAIN_NAME_RULE
from morph_dslam.model import MaterialPoints, ReducedModel
from morph_dslam.registration.landmark_binding import SURFACE_SHARE
from morph_dslam.tracking.binding import nearest_surface_points

Array = NDArray[np.float64]
#: A name, and coordinates in metres.
Place = tuple[str, tuple[float, float, float]]


@dataclass(frozen=True)
class NamedPoints:
    """Places in or on the undeformed object.

    Attributes
    ----------
    names : p of them.
    points : where they lie in the mesh.
    rest : (p, 3) of the undeformed object, object frame, metres.
    """

    names: tuple[str, ...]
    points: MaterialPoints
    rest: Array

    @classmethod
    def of(cls, model: ReducedModel, places: Sequence[Place]) -> NamedPoints | None:
        """The named places in a model, or the nearest ones of its surface; None if there are none.

        Raises
        ------
        TrackingError
            If names cannot be used, the model does not deform, or a place is no place of the object.
        """
        if not places:
            return None
        names = [name for name, _ in places]
        _check_names(names)
        if not model.parameters:
            raise TrackingError(
                f"the model '{model.name}' is rigid, so that no point of it is displaced: leave out --point"
            )
        found = [_found(model, name, np.array(place, dtype=np.float64)) for name, place in places]
        width = max(points.corners.shape[1] for points in found)
        corners = np.zeros((len(found), width), dtype=np.int64)
        weights = np.zeros((len(found), width))
        for row, points in enumerate(found):
            size = points.corners.shape[1]
            corners[row, :size], weights[row, :size] = points.corners[0], points.weights[0]
        rest = model.rest_positions(MaterialPoints(corners, weights))
        return cls(tuple(names), MaterialPoints(corners, weights, rest), rest)


def _check_names(names: Sequence[str]) -> None:
    for name in names:
        if not PLAIN_NAME.fullmatch(name):
            raise TrackingError(f"'{name}' is no name of a point: {PLAIN_NAME_RULE}")
        if names.count(name) > 1:
            raise TrackingError(f"two points are called '{name}': give each another name")


def _found(model: ReducedModel, name: str, place: Array) -> MaterialPoints:
    """The place in the object, or the nearest one of its surface."""
    if not np.isfinite(place).all():
        raise TrackingError(f"the point '{name}' has no finite coordinates: give three numbers")
    try:
        return model.points(place)
    except ParameterError:  # it is not inside
        surface, (distance,) = nearest_surface_points(model.nodes, model.triangles, place[None])
    limit = SURFACE_SHARE * float(np.linalg.norm(np.ptp(model.nodes, axis=0)))
    if distance > limit:
        nearest = model.rest_positions(surface)[0]
        raise TrackingError(
            f"the point '{name}' at {_text(place)} mm is {1e3 * distance:.1f} mm off the undeformed object, at most "
            f"{1e3 * limit:.1f} mm are allowed: the nearest place is {_text(nearest)} mm"
        )
    return MaterialPoints(model.triangles[surface.triangles], surface.weights)


def _text(place: Array) -> str:
    """Coordinates in millimetres, "(98, 10, 8.5)"."""
    return f"({', '.join(f'{round(1e3 * value, 2):g}' for value in place)})"
