"""The motion that a scene file prescribes: parameters, pose and occluder in every frame, checked."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from morph_dslam.errors import SceneError
from morph_dslam.geometry import RigidTransform
from morph_dslam.model import Parameter, ReducedModel
from morph_dslam.render.key_frames import interpolate_key_frames
from morph_dslam.render.model_view import looking_at
from morph_dslam.render.scene_file import (
    CameraKeyFrame,
    Occluder,
    ParameterKeyFrame,
    PoseKeyFrame,
    Scene,
    Vector,
)
from morph_dslam.units import to_si

Array = NDArray[np.float64]

_AT_ORIGIN = PoseKeyFrame(frame=0, position_mm=(0.0, 0.0, 0.0))


@dataclass(frozen=True)
class Motion:
    """What moves how.

    Attributes
    ----------
    parameters : (T, d) SI.
    camera_from_object : T poses of the object in the camera frame, metres.
    camera_from_world : T poses of the world, or None where only the object's pose is prescribed.
    occluder_centres : (T, 2) pixels, or None without an occluder.
    """

    parameters: Array
    camera_from_object: list[RigidTransform]
    camera_from_world: list[RigidTransform] | None
    occluder_centres: Array | None


def _in_range(parameter: Parameter, values: Array) -> NDArray[np.bool_]:
    """Which values (SI) the model covers; the slack is for the rounding of converted units."""
    slack = 1e-9 * (parameter.upper - parameter.lower)
    return (values >= parameter.lower - slack) & (values <= parameter.upper + slack)


def _check_parameter(parameter: Parameter, frames: NDArray, values: Array, remedy: str) -> None:
    wrong = np.flatnonzero(~_in_range(parameter, values))
    if wrong.size:
        first = wrong[0]
        value, low, high = (
            f"{parameter.display(float(x)):.6g}" for x in (values[first], parameter.lower, parameter.upper)
        )
        raise SceneError(
            f"parameter '{parameter.name}' is {value} {parameter.unit} in frame {frames[first]}, "
            f"outside the model's range {low} to {high}: {remedy}"
        )


def _parameter_track(parameter: Parameter, keys: list[ParameterKeyFrame], frames: NDArray) -> Array:
    """One parameter (T,) in SI; without key frames it keeps its default."""
    named = [
        (key.frame, key.__pydantic_extra__[parameter.name])
        for key in keys
        if parameter.name in key.__pydantic_extra__
    ]
    if not named:
        return np.full(len(frames), parameter.default)
    key_frames = np.array([frame for frame, _ in named])
    key_values = np.array([to_si(value, parameter.unit, parameter.quantity) for _, value in named])
    _check_parameter(parameter, key_frames, key_values, "change this key frame")
    track = interpolate_key_frames(key_frames, key_values, frames)
    _check_parameter(
        parameter, frames, track, "the curve swings beyond its key frames here; add one or move them"
    )
    return np.clip(track, parameter.lower, parameter.upper)


def _parameter_tracks(model: ReducedModel, keys: list[ParameterKeyFrame], frames: NDArray) -> Array:
    known = [parameter.name for parameter in model.parameters]
    for key in keys:
        for name in key.__pydantic_extra__:
            if name not in known:
                raise SceneError(
                    f"unknown parameter '{name}' in key frame {key.frame}; the model has {', '.join(known)}"
                )
    return np.column_stack([_parameter_track(parameter, keys, frames) for parameter in model.parameters])


def _pose_track(keys: list[PoseKeyFrame], frames: NDArray, upright: Vector) -> list[RigidTransform]:
    numbers = [key.frame for key in keys]
    position = interpolate_key_frames(numbers, np.array([key.position_mm for key in keys]) * 1e-3, frames)
    angles = interpolate_key_frames(numbers, np.array([key.rotation_deg or upright for key in keys]), frames)
    rotation = Rotation.from_euler("xyz", angles, degrees=True).as_matrix()
    return [RigidTransform(r, p) for r, p in zip(rotation, position, strict=True)]


def _camera_track(keys: list[CameraKeyFrame], frames: NDArray) -> list[RigidTransform]:
    """Poses camera_from_world of a camera that looks at its target with the world's z axis up.

    Raises
    ------
    SceneError
        If it looks straight up or down, or stands in its target.
    """
    numbers = [key.frame for key in keys]
    positions = interpolate_key_frames(numbers, np.array([key.position_mm for key in keys]) * 1e-3, frames)
    targets = interpolate_key_frames(numbers, np.array([key.target_mm for key in keys]) * 1e-3, frames)
    poses = []
    for frame, position, target in zip(frames, positions, targets, strict=True):
        ahead = target - position
        distance = float(np.linalg.norm(ahead))
        if np.hypot(*ahead[:2]) <= 1e-3 * distance:
            raise SceneError(
                f"camera_path: in frame {frame} the camera looks straight up or down, or stands in its "
                "target, so that nothing is upright: move it aside"
            )
        poses.append(looking_at(target, ahead, distance))
    return poses


def _occluder_track(occluder: Occluder | None, frames: NDArray) -> Array | None:
    if occluder is None:
        return None
    numbers = [key.frame for key in occluder.path]
    return interpolate_key_frames(numbers, np.array([key.centre_px for key in occluder.path]), frames)


def plan_motion(scene: Scene, model: ReducedModel) -> Motion:
    """The motion of every frame.

    Raises
    ------
    SceneError
        If a parameter is unknown to the model, or leaves its range at or between key frames.
    """
    frames = np.arange(scene.frames)
    if scene.camera_path:
        in_world = _pose_track(scene.pose or [_AT_ORIGIN], frames, (0.0, 0.0, 0.0))
        camera_from_world = _camera_track(scene.camera_path, frames)
        poses = [camera @ placed for camera, placed in zip(camera_from_world, in_world, strict=True)]
    else:
        camera_from_world, poses = None, _pose_track(scene.pose, frames, (180.0, 0.0, 0.0))
    return Motion(
        parameters=_parameter_tracks(model, scene.parameters, frames),
        camera_from_object=poses,
        camera_from_world=camera_from_world,
        occluder_centres=_occluder_track(scene.occluder, frames),
    )
