"""Where tracking starts: from landmarks in a reference frame, or from a registration in a map."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from morph_dslam.camera import PinholeCamera
from morph_dslam.errors import RegistrationError
from morph_dslam.geometry import RigidTransform
from morph_dslam.io.landmarks import Landmarks
from morph_dslam.model import ReducedModel
from morph_dslam.model.turned_model import turned_model
from morph_dslam.online.estimation import State
from morph_dslam.online.registration import RegistrationOptions, register

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Placement:
    """An object in a reference frame.

    Attributes
    ----------
    model : the model to track with; with the angle about its axis as a parameter where that is not known.
    frame : number of the reference frame; None for the first one tracked.
    state : of the object there. facts : for the summary. flags : what a reader must know.
    per_sequence : names of the parameters that the placement leaves open and that do not change: the angle
        about an axis.
    covariance : (d + 6, d + 6) of ``state``; None where it is not known.
    """

    model: ReducedModel
    frame: int | None
    state: State
    facts: dict[str, Any]
    flags: tuple[str, ...]
    per_sequence: tuple[str, ...] = ()
    covariance: Array | None = None


def load_placement(path: Path, model: ReducedModel) -> Placement:
    """The object as `morph register` placed it, undeformed, in the last keyframe of the map.

    Raises
    ------
    RegistrationError
        If the file is missing or not one of `morph register`.
    """
    try:
        content = json.loads(path.read_text())
        keyframe = max(content["keyframes"], key=lambda entry: entry["frame"])
        pose = RigidTransform.from_matrix(np.array(keyframe["camera_from_object"], dtype=np.float64))
        frame, axis = int(keyframe["frame"]), content["axis_of_revolution"]
        facts = {key: content[key] for key in ("score", "runner_up_score", "rms_px", "map_units_per_metre")}
        ambiguous = bool(content["ambiguous"])
        of_pose = _pose_covariance(content, pose)
    except OSError as error:
        raise RegistrationError(f"cannot read the registration {path}: {error.strerror}") from error
    except (ValueError, KeyError, TypeError, IndexError) as error:
        raise RegistrationError(f"{path} is not a registration.json of `morph register` ({error})") from error
    open_angles: tuple[str, ...] = ()
    flags = ["registration ambiguous: another place in the map is nearly as good"] if ambiguous else []
    if axis is not None:
        model = turned_model(model, np.array(axis["direction"]))
        open_angles = (model.parameters[-1].name,)
        flags.append(
            f"the angle about the object's axis cannot be seen before it deforms: it is the parameter "
            f"'{open_angles[0]}'"
        )
    state = State(model.default, pose)
    covariance = None if of_pose is None else _of_state(of_pose, len(model.parameters))
    return Placement(model, frame, state, {"from": "map", **facts}, tuple(flags), open_angles, covariance)


def _pose_covariance(content: dict[str, Any], pose: RigidTransform) -> Array | None:
    """Covariance (6, 6) of the rotation vector and the translation of ``pose``, camera_from_object, metres.

    From that of log scale, rotation vector and mean node in the map, whose unit the scale leaves uncertain:
    an object that is larger in the map is nearer to the camera.
    """
    if content["covariance"] is None:
        return None
    scale = float(content["map_units_per_metre"])
    world_from_object = np.array(content["world_from_object"], dtype=np.float64)[:3, :3] / scale
    camera_from_world = pose.rotation @ world_from_object.T
    centre = pose.apply(np.array(content["mean_node_m"], dtype=np.float64))
    arm = centre - pose.translation
    across = np.cross(np.eye(3), arm).T  # (a x arm) = across @ a
    slopes = np.zeros((6, 7))
    slopes[:3, 1:4] = camera_from_world
    slopes[3:, 0] = -centre
    slopes[3:, 1:4] = -across @ camera_from_world
    slopes[3:, 4:] = camera_from_world / scale
    return slopes @ np.array(content["covariance"], dtype=np.float64) @ slopes.T


def _of_state(of_pose: Array, n_parameters: int) -> Array:
    """The covariance of parameters that are known exactly, and of a pose."""
    covariance = np.zeros((n_parameters + 6, n_parameters + 6))
    covariance[n_parameters:, n_parameters:] = of_pose
    return covariance


def place_by_landmarks(
    model: ReducedModel, camera: PinholeCamera, landmarks: Landmarks, options: RegistrationOptions
) -> Placement:
    """The object in the frame of the landmarks; raises RegistrationError as `register` does."""
    registration = register(model, camera, landmarks.points, landmarks.pixels, options)
    facts = {
        "from": "landmarks",
        "residual_rms_px": registration.residual_rms_px,
        "sigma_px": registration.estimate.sigma_px,
        "n_landmarks": len(registration.estimate.residuals),
        "n_alternatives": len(registration.alternatives),
    }
    return Placement(
        model,
        None,
        registration.state,
        facts,
        registration.flags,
        covariance=registration.estimate.covariance,
    )
