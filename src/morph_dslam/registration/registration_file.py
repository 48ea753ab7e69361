"""Reading what says where an object is: the file ``registration.json``."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from morph_dslam.errors import RegistrationError
from morph_dslam.geometry import RigidTransform, SimilarityTransform
from morph_dslam.model import ReducedModel, load_model
from morph_dslam.registration.messages import read_warning
from morph_dslam.registration.registration import (
    Axis,
    KeyframePose,
    MapRegistration,
    Registration,
    Rival,
    in_scene,
    registration_in_map,
)
from morph_dslam.tracking.depth_scale import DepthScale
from morph_dslam.tracking.state import State

if TYPE_CHECKING:
    from morph_dslam.slam.scene import Scene

Array = NDArray[np.float64]
#: No number of a registration is meant to be larger.
LARGEST = 1e20
#: Mean nodes that are farther apart than this share of the size belong to different objects.
OTHER_OBJECT = 0.1
#: What is no figure for the summary in the file of a registration.
_NO_FACTS = {"ambiguous", "warnings", "parameters", "camera_from_object", "state_covariance", "world_from_object"}
_NO_FACTS |= {"mean_node_m", "covariance", "axis_of_revolution", "rivals", "keyframes", "map", "model", "alternatives"}
_NO_FACTS |= {"map_renumbered", "frame"}


def load_registration(path: str | Path, model: ReducedModel | None = None, scene: Scene | None = None) -> Registration:
    """Read what `Registration.save` or `morph register` wrote.

    Parameters
    ----------
    path : of the file, ``registration.json``.
    model : that was registered; the one that the file names by default.
    scene : that it was registered in (`load_scene`). Without it a tracker does not know what the object looks like.

    Raises
    ------
    RegistrationError
        If the file is missing, damaged, or of another object.
    MapError
        If it is of another scene.
    ModelFileError
        If the model that it names cannot be read.
    """
    path = Path(path)
    content = read_content(path)
    try:
        if model is None:
            model = load_model(path.parent / content["model"])
        registration = _from_content(content, model)
    except (ValueError, KeyError, TypeError, IndexError, OverflowError) as error:
        raise RegistrationError(f"{path} is not a registration.json of `morph register` ({error})") from error
    if registration.map_registration is not None:
        _check_model(registration.map_registration, model, path)
    return registration if scene is None else in_scene(registration, scene)


def read_content(path: Path) -> dict[str, Any]:
    """The content of a file of `Registration.save`; raises RegistrationError if it cannot be read."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise RegistrationError(f"cannot read the registration {path}: {error.strerror}") from error
    except ValueError as error:
        raise RegistrationError(f"{path} is not a registration.json of `morph register` ({error})") from error
    if not isinstance(content, dict):
        raise RegistrationError(f"{path} is not a registration.json of `morph register`")
    return content


def _from_content(content: dict[str, Any], model: ReducedModel) -> Registration:
    """From `Registration.content`; raises Key-, Type-, Value-, Index- or OverflowError if it is none."""
    facts = {key: value for key, value in content.items() if key not in _NO_FACTS}
    if facts.get("sigma_px", 0.0) is None:
        facts["sigma_px"] = np.inf
    warnings = tuple(read_warning(warning) for warning in content["warnings"])
    if "world_from_object" not in content:
        d = len(model.parameters)
        covariance = content["state_covariance"]
        if covariance is not None:
            # Without infinity in JSON it is None, here NaN; earlier files have it.
            covariance = np.array(covariance, dtype=np.float64).reshape(d + 6, d + 6)
            covariance = np.where(np.isnan(covariance), np.inf, covariance)
        # Earlier files have no alternatives.
        alternatives = tuple(_state(each, d) for each in content.get("alternatives", []))
        return Registration(
            model,
            _state(content, d),
            covariance,
            facts=facts,
            warnings=warnings,
            alternatives=alternatives,
            depth_scale=_depth_scale(content.get("depth_scale")),
        )
    placed = _placed(content)
    found = MapRegistration(placed, _numbers(content["mean_node_m"], (3,)), _optional(content["covariance"], (7, 7)))
    axis = content["axis_of_revolution"]
    axis = axis and Axis(_numbers(axis["point_m"], (3,)), _numbers(axis["direction"], (3,)))
    # Earlier files have none of these.
    frame = None if content.get("frame") is None else _whole(content["frame"])
    renumbered = tuple(_whole(more) for more in content.get("map_renumbered", []))
    rivals = [Rival(_placed(each), float(each["score"])) for each in content.get("rivals", [])]
    keyframes = _keyframes(content["keyframes"])
    registration = registration_in_map(model, found, keyframes, facts, warnings, axis, frame=frame)
    return replace(registration, rivals=tuple(rivals), renumbered=renumbered)


def _state(content: dict[str, Any], n_parameters: int) -> State:
    pose = RigidTransform.from_matrix(_numbers(content["camera_from_object"], (4, 4)))
    return State(_numbers(content["parameters"], (n_parameters,)), pose)


def _depth_scale(content: dict[str, Any] | None) -> DepthScale | None:
    if content is None:
        return None
    factor, std = _numbers([content["factor"], content["std"]], (2,)).tolist()
    if not (factor > 0.0 and std >= 0.0):
        raise ValueError("depth_scale has no positive factor with its std")
    return DepthScale(factor, std)


def _placed(content: dict[str, Any]) -> SimilarityTransform:
    matrix, scale = _numbers(content["world_from_object"], (4, 4)), float(content["map_units_per_metre"])
    if not scale > 0.0 or not np.allclose(matrix[:3, :3] @ matrix[:3, :3].T / scale**2, np.eye(3)):
        raise ValueError("world_from_object is no rotation scaled by map_units_per_metre")
    return SimilarityTransform(scale, matrix[:3, :3] / scale, matrix[:3, 3])


def _keyframes(entries: list[dict[str, Any]]) -> list[KeyframePose]:
    keyframes = []
    for entry in entries:
        factors = entry["error_factors"]
        keyframes.append(
            KeyframePose(
                _whole(entry["frame"]),
                RigidTransform.from_matrix(_numbers(entry["camera_from_object"], (4, 4))),
                _optional(entry["covariance"], (6, 6)),
                factors and _numbers(factors, (6, np.size(factors) // 6)),
            )
        )
    if len({k.error_factors.shape for k in keyframes if k.error_factors is not None}) > 1:
        raise ValueError("the keyframes' errors have different numbers of error_factors")
    return keyframes


def _check_model(found: MapRegistration, model: ReducedModel, path: Path) -> None:
    """Refuse a registration of another object; one of a finer mesh of the same object will do."""
    nodes = model.positions(model.default)
    apart = np.linalg.norm(nodes.mean(axis=0) - found.centre)
    if apart > OTHER_OBJECT * np.linalg.norm(np.ptp(nodes, axis=0)):
        raise RegistrationError(
            f"{path} is of another object than '{model.name}': their mean nodes are {1e3 * apart:.1f} mm apart; "
            "give the model that was registered, or register this one"
        )


def _numbers(values: Any, shape: tuple[int, ...]) -> Array:
    """An array of a registration's file; raises ValueError if its shape is another, or a number absurd."""
    array = np.array(values, dtype=np.float64)
    if array.shape != shape or not (np.abs(array) < LARGEST).all():
        raise ValueError(f"an array of shape {shape} was expected")
    return array


def _whole(value: Any) -> int:
    """A whole number of a registration's file; raises ValueError if it is none, so that no other frame is meant."""
    if type(value) is not int:  # true is an instance
        raise ValueError(f"{value!r} is no whole number")
    return value


def _optional(values: Any, shape: tuple[int, ...]) -> Array | None:
    return None if values is None else _numbers(values, shape)
