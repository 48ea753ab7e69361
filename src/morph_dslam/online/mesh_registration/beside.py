"""A second object in a map: the points on those that are registered already are left to them."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from morph_dslam.errors import RegistrationError
from morph_dslam.model import load_model
from morph_dslam.online.anchored.anchor import points_on_object
from morph_dslam.online.anchored.place_in_map import PlaceInMap
from morph_dslam.online.mesh_registration.scene import MapPoints, View


def left_by_others(
    points: MapPoints, views: Sequence[View], others: Sequence[Path], map_path: Path
) -> tuple[MapPoints, list[View]]:
    """The points and views of a map without the points on objects that are registered in it.

    Parameters
    ----------
    others : files registration.json, of the same map.

    Raises
    ------
    RegistrationError
        If one is missing, of another map, or not one of `morph register`.
    ModelFileError
        If the model that one names cannot be read.
    """
    left = np.ones(len(points), dtype=bool)
    for path in others:
        place, model_path = _placed(path, map_path)
        left &= ~points_on_object(points.positions, place, load_model(model_path))[0]
    return points[left], [_with_points(view, left) for view in views]


def _with_points(view: View, left: NDArray[np.bool_]) -> View:
    """The view of the points that are left, by their new rows."""
    seen, rows = left[view.point_ids], np.cumsum(left) - 1
    return replace(view, point_ids=rows[view.point_ids[seen]], pixels=view.pixels[seen])


def _placed(path: Path, map_path: Path) -> tuple[PlaceInMap, Path]:
    """Where a registered object is, and its model."""
    try:
        content = json.loads(path.read_text())
        place, own_map = PlaceInMap.from_content(content), path.parent / content["map"]
        model = path.parent / content["model"]
    except OSError as error:
        raise RegistrationError(f"cannot read the registration {path}: {error.strerror}") from error
    except (ValueError, KeyError, TypeError, IndexError) as error:
        raise RegistrationError(
            f"{path} does not say which object is where in which map ({error}): register it with this version"
        ) from error
    if own_map.resolve() != map_path.resolve():
        raise RegistrationError(f"{path} is of another map, {own_map}: register both objects in one map")
    return place, model
