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
from morph_dslam.model.discrepancy import Discrepancy
from morph_dslam.model.turned_model import turned_model
from morph_dslam.online.anchored.place_in_map import PlaceInMap, numbers_of
from morph_dslam.online.estimation.depth_residuals import DepthOptions
from morph_dslam.online.estimation.estimator import Estimator, State
from morph_dslam.online.reference.reference_depth import refine_by_depth
from morph_dslam.online.start.registration import RegistrationOptions, bind_landmarks, register

Array = NDArray[np.float64]

#: Standard deviation of landmarks' pixels where they are too few to tell, and the least that is believed.
LANDMARK_PX, LEAST_LANDMARK_PX = 2.0, 0.1


@dataclass(frozen=True)
class PlacedView:
    """The undeformed object in a keyframe of the map.

    Attributes
    ----------
    frame : number of the keyframe. causes : (6, c) how ``pose`` is off by c causes, the same for all
        keyframes, in their standard deviations.
    """

    frame: int
    pose: RigidTransform
    causes: Array


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
    place : in the map of the scene; None where there is none.
    discrepancy : what the object's shape has beyond the model's in the frame; None where it is not known.
    views : keyframes that show the object, that of ``frame`` first; none where their errors are not known.
    """

    model: ReducedModel
    frame: int | None
    state: State
    facts: dict[str, Any]
    flags: tuple[str, ...]
    per_sequence: tuple[str, ...] = ()
    covariance: Array | None = None
    place: PlaceInMap | None = None
    discrepancy: Discrepancy | None = None
    views: tuple[PlacedView, ...] = ()


def load_placement(path: Path, model: ReducedModel) -> Placement:
    """The object as `morph register` placed it, undeformed, in the last keyframe of the map.

    Raises
    ------
    RegistrationError
        If the file is missing, not one of `morph register`, or places another object.
    """
    try:
        content = json.loads(path.read_text())
        keyframe = max(content["keyframes"], key=lambda entry: entry["frame"])
        pose = RigidTransform.from_matrix(numbers_of(keyframe["camera_from_object"], (4, 4)))
        own = keyframe.get("covariance")  # of a keyframe whose pose was adjusted by itself
        own = None if own is None else numbers_of(own, (6, 6))
        views = _views(content["keyframes"])
        frame, axis = int(keyframe["frame"]), content["axis_of_revolution"]
        axis = None if axis is None else numbers_of(axis["direction"], (3,))
        facts = {key: content[key] for key in ("score", "runner_up_score", "rms_px", "map_units_per_metre")}
        ambiguous, outline_fits = bool(content["ambiguous"]), bool(content.get("outline_fits", True))
        place = PlaceInMap.from_content(content)
    except OSError as error:
        raise RegistrationError(f"cannot read the registration {path}: {error.strerror}") from error
    except (ValueError, KeyError, TypeError, IndexError) as error:
        raise RegistrationError(f"{path} is not a registration.json of `morph register` ({error})") from error
    place.check_model(model, path)
    open_angles: tuple[str, ...] = ()
    flags = []
    if not outline_fits:
        flags.append("registration doubtful: the keyframes show the object's outline elsewhere")
    elif ambiguous:
        flags.append("registration ambiguous: another place is nearly as good, or no image confirms this one")
    if axis is not None:
        model = turned_model(model, axis)
        open_angles = (model.parameters[-1].name,)
        flags.append(
            f"the angle about the object's axis cannot be seen before it deforms: it is the parameter "
            f"'{open_angles[0]}'"
        )
    state = State(model.default, pose)
    of_pose = place.pose_covariance(pose) if own is None else own
    covariance = None if of_pose is None else _of_state(of_pose, len(model.parameters))
    facts = {"from": "map", **facts}
    # Without an estimate of its own the pose of the reference frame has none of the others' causes.
    views = tuple(sorted(views, key=lambda view: view.frame != frame)) if own is not None else ()
    return Placement(model, frame, state, facts, tuple(flags), open_angles, covariance, place, views=views)


def _views(keyframes: list[dict[str, Any]]) -> list[PlacedView]:
    """The keyframes whose poses were adjusted together; raises ValueError as `numbers_of` does."""
    views = []
    for entry in keyframes:
        if entry.get("causes") is None:
            continue
        causes = np.array(entry["causes"], dtype=np.float64)
        causes = numbers_of(causes, (6, causes.size // 6))
        pose = RigidTransform.from_matrix(numbers_of(entry["camera_from_object"], (4, 4)))
        views.append(PlacedView(int(entry["frame"]), pose, causes))
    if len({view.causes.shape for view in views}) > 1:
        raise ValueError("the keyframes' errors have different numbers of causes")
    return views


def _of_state(of_pose: Array, n_parameters: int) -> Array:
    """The covariance of parameters that are known exactly, and of a pose."""
    covariance = np.zeros((n_parameters + 6, n_parameters + 6))
    covariance[n_parameters:, n_parameters:] = of_pose
    return covariance


def place_by_landmarks(
    model: ReducedModel,
    camera: PinholeCamera,
    landmarks: Landmarks,
    options: RegistrationOptions,
    depth: NDArray[np.float32] | None = None,
    sensor: DepthOptions | None = None,
) -> Placement:
    """The object in the frame of the landmarks; raises RegistrationError as `register` does.

    Parameters
    ----------
    depth : (h, w) of that frame, metres, NaN where unknown; None without a depth camera, ``sensor``.
    """
    registration = register(model, camera, landmarks.points, landmarks.pixels, options)
    facts = {
        "from": "landmarks",
        "residual_rms_px": registration.residual_rms_px,
        "sigma_px": registration.estimate.sigma_px,
        "n_landmarks": len(registration.estimate.residuals),
        "n_alternatives": len(registration.alternatives),
    }
    placed, covariance = registration.estimate, registration.covariance
    if depth is not None:
        bound = bind_landmarks(model, landmarks.points, options)
        # How well the landmarks fit tells how carefully they were set, where they are enough to tell.
        sigma = max(placed.sigma_px, LEAST_LANDMARK_PX) if np.isfinite(placed.sigma_px) else LANDMARK_PX
        placed = refine_by_depth(
            Estimator(model, camera),
            bound,
            camera.undistort_pixels(landmarks.pixels),
            placed.state,
            sigma,
            depth,
            sensor or DepthOptions(),
        )
        facts["along_the_sight_line"], covariance = "by depth", placed.covariance
    return Placement(model, None, placed.state, facts, registration.flags, covariance=covariance)
