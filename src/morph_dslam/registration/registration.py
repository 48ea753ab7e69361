"""The object's pose as it is known beforehand in a frame, from a camera that was found in the scene's map."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from morph_dslam.camera import Camera
from morph_dslam.errors import RegistrationError
from morph_dslam.geometry import RigidTransform, SimilarityTransform, cross_matrix, rotation_log
from morph_dslam.io.landmarks import Landmarks
from morph_dslam.model import ReducedModel
from morph_dslam.model.discrepancy import Discrepancy
from morph_dslam.model.revolution import with_revolution_angle
from morph_dslam.registration.landmarks import CLICK_PX, bind_landmarks, register
from morph_dslam.slam.pose import PoseEstimate
from morph_dslam.tracking.depth import SIGMA_AT_1M
from morph_dslam.tracking.estimator import Estimator, State
from morph_dslam.tracking.refinement import refine_by_depth
from morph_dslam.tracking.state import Prior

Array = NDArray[np.float64]


@dataclass(frozen=True)
class PosePrior:
    """An object's pose in one frame.

    Attributes
    ----------
    pose : camera_from_object, metres.
    from_camera : (6, 6) covariance of the increment (rotation vector rad, translation m) that `state.moved`
        applies, from the camera's error, which is new in every frame.
    lasting : (6, k) the same increment by the k error factors of the registration's error in their standard
        deviations: that error is the same in all frames.
    """

    pose: RigidTransform
    from_camera: Array
    lasting: Array

    @property
    def covariance(self) -> Array:
        """(6, 6) of the increment, from both."""
        return self.from_camera + self.lasting @ self.lasting.T

    def prior(self, d: int, squared_px: float, firmness: float = 1.0) -> Prior:
        """As a term of the estimator's cost, which knows nothing of the ``d`` parameters.

        ``squared_px`` is the variance of an image coordinate: it makes a covariance a weight in that cost.
        ``firmness`` multiplies the weight, but makes the pose no better known: its errors stay in what is
        stated of the estimate.
        """
        squared_px = firmness * squared_px
        information = np.asarray(squared_px * np.linalg.inv(self.covariance), dtype=np.float64)
        nothing = np.zeros((d, d))
        return Prior(np.zeros(d), nothing, self.pose, information, self.lasting, squared_px)

    def away(self, pose: RigidTransform) -> Array:
        """The increment (6,) from this pose to another."""
        turn = rotation_log(pose.rotation @ self.pose.rotation.T)
        return np.concatenate([turn, pose.translation - self.pose.translation])


# Where a registered object is in a map, and from there in a camera that was found in the map.


#: No number of a registration is meant to be larger.
LARGEST = 1e20

#: Mean nodes that are farther apart than this share of the size belong to different objects.
OTHER_OBJECT = 0.1


@dataclass(frozen=True)
class MapRegistration:
    """Where an undeformed object is in a map.

    Attributes
    ----------
    world_from_object : metres to the map's unit. centre : (3,) the mean node, object frame, metres.
    covariance : (7, 7) of log scale, rotation vector and translation about ``centre``, in the map; None where
        nobody knows.
    """

    world_from_object: SimilarityTransform
    centre: Array
    covariance: Array | None

    @classmethod
    def from_content(cls, content: dict[str, Any]) -> MapRegistration:
        """From the content of a registration.json; raises KeyError, TypeError or ValueError if it is none."""
        matrix = numbers_of(content["world_from_object"], (4, 4))
        scale, covariance = float(content["map_units_per_metre"]), content["covariance"]
        if not scale > 0.0 or not np.allclose(matrix[:3, :3] @ matrix[:3, :3].T / scale**2, np.eye(3)):
            raise ValueError("world_from_object is no rotation scaled by map_units_per_metre")
        return cls(
            SimilarityTransform(scale, matrix[:3, :3] / scale, matrix[:3, 3]),
            numbers_of(content["mean_node_m"], (3,)),
            None if covariance is None else numbers_of(covariance, (7, 7)),
        )

    def check_model(self, model: ReducedModel, path: Path) -> None:
        """Refuse a registration of another object; one of a finer mesh of the same object will do.

        Raises
        ------
        RegistrationError
            If the mean nodes of the two are farther apart than `OTHER_OBJECT` of the object's size.
        """
        nodes = model.positions(model.default)
        apart = np.linalg.norm(nodes.mean(axis=0) - self.centre)
        if apart > OTHER_OBJECT * np.linalg.norm(np.ptp(nodes, axis=0)):
            raise RegistrationError(
                f"{path} places another object than '{model.name}': their mean nodes are {1e3 * apart:.1f} "
                "mm apart; give the model that was registered, or register this one"
            )

    def slopes(self, pose: RigidTransform) -> Array:
        """How the increment (6,) of the object's ``pose`` in a camera depends on the registration: (6, 7).

        The registration's turn is about the mean node. An object that is larger in the map is nearer to the
        camera, since its true size is known.
        """
        placed = self.world_from_object
        camera_from_world = pose.rotation @ placed.rotation.T
        arm = pose.rotation @ self.centre
        result = np.zeros((6, 7))
        result[:3, 1:4] = camera_from_world
        result[3:, 0] = -(pose.translation + arm)
        result[3:, 1:4] = cross_matrix(arm) @ camera_from_world
        result[3:, 4:] = camera_from_world / placed.scale
        return result

    def pose_covariance(self, pose: RigidTransform) -> Array | None:
        """(6, 6) of the object's ``pose`` in an exactly known camera; None where nobody knows."""
        if self.covariance is None:
            return None
        slopes = self.slopes(pose)
        return slopes @ self.covariance @ slopes.T

    def pose_in(self, camera_from_world: Array) -> RigidTransform:
        """The object's pose in a camera of pose (4, 4) in the map, metres."""
        placed = self.world_from_object
        turn, shift = camera_from_world[:3, :3], camera_from_world[:3, 3]
        return RigidTransform(turn @ placed.rotation, (turn @ placed.translation + shift) / placed.scale)

    def pose_prior(self, camera: PoseEstimate) -> PosePrior:
        """The object's pose in a camera found in the map, metres; ValueError without a covariance."""
        if self.covariance is None:
            raise ValueError("the place has no covariance")
        pose = self.pose_in(camera.camera_from_world)
        # The camera's twist turns everything about the camera, and shifts it in the map's unit.
        by_camera = np.eye(6)
        by_camera[3:, :3] = -cross_matrix(pose.translation)
        by_camera[3:, 3:] = np.eye(3) / self.world_from_object.scale
        values, vectors = np.linalg.eigh(self.covariance)
        root = vectors * np.sqrt(np.maximum(values, 0.0))
        return PosePrior(pose, by_camera @ camera.covariance @ by_camera.T, self.slopes(pose) @ root)


def numbers_of(values: Any, shape: tuple[int, ...]) -> Array:
    """An array of a registration.json; raises ValueError if its shape is another, or a number absurd."""
    array = np.array(values, dtype=np.float64)
    if array.shape != shape or not (np.abs(array) < LARGEST).all():
        raise ValueError(f"an array of shape {shape} was expected")
    return array


# Where tracking starts: from landmarks in a reference frame, or from a registration in a map.


#: Standard deviation of landmarks' pixels where they are too few to tell, and the least that is believed.
LANDMARK_PX, LEAST_LANDMARK_PX = 2.0, 0.1


@dataclass(frozen=True)
class KeyframePose:
    """The undeformed object in a keyframe of the map.

    Attributes
    ----------
    frame : number of the keyframe. error_factors : (6, c) how ``pose`` is off by c error factors, the same
        for all keyframes, in their standard deviations.
    """

    frame: int
    pose: RigidTransform
    error_factors: Array


@dataclass(frozen=True)
class Registration:
    """An object in a reference frame.

    Attributes
    ----------
    model : the model to track with; with the angle about its axis as a parameter where that is not known.
    frame : number of the reference frame; None for the first one tracked.
    state : of the object there. facts : for the summary. flags : what a reader must know.
    per_sequence : names of the parameters that the registration leaves open and that do not change: the angle
        about an axis.
    covariance : (d + 6, d + 6) of ``state``; None where it is not known.
    map_registration : where the object is in the map of the scene; None where there is none.
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
    map_registration: MapRegistration | None = None
    discrepancy: Discrepancy | None = None
    views: tuple[KeyframePose, ...] = ()

    @classmethod
    def at(cls, model: ReducedModel, state: State, covariance: Array | None = None) -> Registration:
        """An object whose state in the reference frame is known from elsewhere, with this covariance."""
        return cls(model, None, state, {}, (), covariance=covariance)


def load_registration(path: str | Path, model: ReducedModel) -> Registration:
    """The object as `morph register` placed it, undeformed, in the last keyframe of the map.

    Raises
    ------
    RegistrationError
        If the file is missing, not one of `morph register`, or places another object.
    """
    path = Path(path)
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
        place = MapRegistration.from_content(content)
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
        model = with_revolution_angle(model, axis)
        open_angles = (model.parameters[-1].name,)
        flags.append(
            f"the angle about the object's axis cannot be seen before it deforms: it is the parameter "
            f"'{open_angles[0]}'"
        )
    state = State(model.default, pose)
    of_pose = place.pose_covariance(pose) if own is None else own
    covariance = None if of_pose is None else _of_state(of_pose, len(model.parameters))
    facts = {"from": "map", **facts}
    # Without an estimate of its own the pose of the reference frame has none of the others' error factors.
    views = tuple(sorted(views, key=lambda view: view.frame != frame)) if own is not None else ()
    return Registration(model, frame, state, facts, tuple(flags), open_angles, covariance, place, views=views)


def _views(keyframes: list[dict[str, Any]]) -> list[KeyframePose]:
    """The keyframes whose poses were adjusted together; raises ValueError as `numbers_of` does."""
    views = []
    for entry in keyframes:
        if entry.get("error_factors") is None:
            continue
        error_factors = np.array(entry["error_factors"], dtype=np.float64)
        error_factors = numbers_of(error_factors, (6, error_factors.size // 6))
        pose = RigidTransform.from_matrix(numbers_of(entry["camera_from_object"], (4, 4)))
        views.append(KeyframePose(int(entry["frame"]), pose, error_factors))
    if len({view.error_factors.shape for view in views}) > 1:
        raise ValueError("the keyframes' errors have different numbers of error_factors")
    return views


def _of_state(of_pose: Array, n_parameters: int) -> Array:
    """The covariance of parameters that are known exactly, and of a pose."""
    covariance = np.zeros((n_parameters + 6, n_parameters + 6))
    covariance[n_parameters:, n_parameters:] = of_pose
    return covariance


def register_by_landmarks(
    model: ReducedModel,
    camera: Camera,
    landmarks: Landmarks,
    click_px: float = CLICK_PX,
    depth: NDArray[np.float32] | None = None,
    depth_sigma: float = SIGMA_AT_1M,
) -> Registration:
    """The object in the frame of the landmarks; raises RegistrationError as `register` does.

    Parameters
    ----------
    depth : (h, w) of that frame, metres, NaN where unknown; None without a depth camera.
    depth_sigma : standard deviation of a pixel's depth at 1 m, metres.
    """
    registration = register(model, camera, landmarks.points, landmarks.pixels, click_px)
    facts = {
        "from": "landmarks",
        "residual_rms_px": registration.residual_rms_px,
        "sigma_px": registration.estimate.sigma_px,
        "n_landmarks": len(registration.estimate.residuals),
        "n_alternatives": len(registration.alternatives),
    }
    placed, covariance = registration.estimate, registration.covariance
    if depth is not None:
        bound = bind_landmarks(model, landmarks.points)
        # How well the landmarks fit tells how carefully they were set, where they are enough to tell.
        sigma = max(placed.sigma_px, LEAST_LANDMARK_PX) if np.isfinite(placed.sigma_px) else LANDMARK_PX
        placed = refine_by_depth(
            Estimator(model, camera),
            bound,
            camera.undistort_pixels(landmarks.pixels),
            placed.state,
            sigma,
            depth,
            depth_sigma,
        )
        facts["along_the_sight_line"], covariance = "by depth", placed.covariance
    return Registration(model, None, placed.state, facts, registration.flags, covariance=covariance)
