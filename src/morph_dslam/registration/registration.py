"""Where an object is: in a reference frame, and in the map of a scene."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from morph_dslam.errors import MapError, RegistrationError
from morph_dslam.geometry import RigidTransform, SimilarityTransform, cross_matrix, rotation_exp, rotation_log
from morph_dslam.model import ReducedModel
from morph_dslam.model.discrepancy import Discrepancy
from morph_dslam.model.revolution import with_revolution_angle
from morph_dslam.notices import Notice
from morph_dslam.registration.messages import Ambiguous, AngleOpen, OtherValues, OutlineElsewhere, TurnArbitrary
from morph_dslam.slam.pose import PoseEstimate
from morph_dslam.tracking.depth_scale import DepthScale
from morph_dslam.tracking.state import Prior, State, pose_increment

if TYPE_CHECKING:
    from morph_dslam.slam.scene import Scene

Array = NDArray[np.float64]
#: Keyframes are placed anew by the registration, but never by so much: rad, and share of the distance.
OTHER_MAP_TURN, OTHER_MAP_SHIFT = 0.1, 0.1
#: Of many keyframes so many may be placed wrongly.
OTHER_MAP_SHARE = 0.1


@dataclass(frozen=True)
class PosePrior:
    """An object's pose in one frame, as the map gives it.

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
        """As a term of the estimator's cost, which says nothing of the ``d`` parameters.

        Parameters
        ----------
        d : number of parameters.
        squared_px : variance of an image coordinate: it makes a covariance a weight in that cost.
        firmness : multiplies the weight, but makes the pose no better known: its errors stay in what is
            stated of the estimate.
        """
        squared_px = firmness * squared_px
        information = np.asarray(squared_px * np.linalg.inv(self.covariance), dtype=np.float64)
        nothing = np.zeros((d, d))
        return Prior(np.zeros(d), nothing, self.pose, information, self.lasting, squared_px)

    def away(self, pose: RigidTransform) -> Array:
        """The increment (6,) from this pose to another."""
        return pose_increment(self.pose, pose)


@dataclass(frozen=True)
class MapRegistration:
    """Where an undeformed object is in a map.

    Attributes
    ----------
    world_from_object : metres to the map's unit.
    centre : (3,) the mean node, object frame, metres.
    covariance : (7, 7) of log scale, rotation vector and translation about ``centre``, in the map; None where
        it is not known.
    """

    world_from_object: SimilarityTransform
    centre: Array
    covariance: Array | None

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
        """(6, 6) of the object's ``pose`` in an exactly known camera; None where it is not known."""
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
            raise ValueError("the registration has no covariance")
        pose = self.pose_in(camera.camera_from_world)
        # The camera's twist turns everything about the camera, and shifts it in the map's unit.
        by_camera = np.eye(6)
        by_camera[3:, :3] = -cross_matrix(pose.translation)
        by_camera[3:, 3:] = np.eye(3) / self.world_from_object.scale
        values, vectors = np.linalg.eigh(self.covariance)
        root = vectors * np.sqrt(np.maximum(values, 0.0))
        return PosePrior(pose, by_camera @ camera.covariance @ by_camera.T, self.slopes(pose) @ root)


@dataclass(frozen=True)
class KeyframePose:
    """The undeformed object in a keyframe of the map.

    Attributes
    ----------
    frame : number of the keyframe.
    pose : camera_from_object, metres.
    covariance : (6, 6) of ``pose``; None unless the keyframe was adjusted by itself.
    error_factors : (6, c) how ``pose`` is off by c error factors, the same for all keyframes, in their
        standard deviations; None as ``covariance``.
    """

    frame: int
    pose: RigidTransform
    covariance: Array | None = None
    error_factors: Array | None = None


@dataclass(frozen=True)
class Rival:
    """Another place in the map, which was not chosen.

    Attributes
    ----------
    world_from_object : metres to the map's unit.
    score : what speaks for it, as ``score`` of the place that was chosen.
    """

    world_from_object: SimilarityTransform
    score: float


@dataclass(frozen=True)
class Axis:
    """An axis of revolution, object frame, metres.

    Attributes
    ----------
    point : (3,) on it.
    direction : (3,) of unit length.
    """

    point: Array
    direction: Array

    def turned(self, points: Array, angle: float) -> Array:
        """Points (..., 3) turned about the axis by ``angle`` (rad)."""
        return (points - self.point) @ rotation_exp(angle * self.direction).T + self.point


@dataclass(frozen=True)
class Registration:
    """An object in a reference frame.

    Attributes
    ----------
    model : to track with; it has the angle about the object's axis as a parameter where that is open.
    state : parameters and pose of the object in the reference frame.
    covariance : (d + 6, d + 6) of ``state``; None where it is not known.
    frame : number of the reference frame, a keyframe of the map; None for the first frame that is tracked.
    facts : figures for the summary; ``from`` says what the object was registered by.
    warnings : what a reader must know.
    per_sequence : names of the parameters that the registration leaves open and that do not change.
    map_registration : where the object is in the map of the scene; None where there is none.
    keyframes : of the map, with the object's pose in each.
    axis : of revolution; None if the object has none.
    discrepancy : what the object's shape has beyond the model's in the frame; None where it is not known.
    scene : whose map it is registered in; None where there is none, or only its file is known.
    alternatives : other states that what it was registered by does not exclude, where they are known.
    rivals : other places in the map, the best first.
    depth_scale : of the depth images that say how far away it is, with its error in the covariance; None where none do.
    renumbered : of its map (`RigidMap`) when the keyframes' numbers here were those of the map.
    """

    model: ReducedModel
    state: State
    covariance: Array | None = None
    frame: int | None = None
    facts: dict[str, Any] = field(default_factory=dict)
    warnings: tuple[Notice, ...] = ()
    per_sequence: tuple[str, ...] = ()
    map_registration: MapRegistration | None = None
    keyframes: tuple[KeyframePose, ...] = ()
    axis: Axis | None = None
    discrepancy: Discrepancy | None = None
    scene: Scene | None = field(default=None, repr=False, compare=False)
    alternatives: tuple[State, ...] = ()
    rivals: tuple[Rival, ...] = ()
    depth_scale: DepthScale | None = None
    renumbered: tuple[int, ...] = ()

    def __repr__(self) -> str:
        """One line: what was registered by what, the parameters, and how many warnings there are."""
        shown = [
            f"{p.name}={p.display(value):.4g} {p.unit}"
            for p, value in zip(self.model.parameters, self.state.parameters.tolist(), strict=False)
        ]
        facts = [self.model.name, f"by {self.facts.get('from', 'a known state')}", *shown]
        if self.frame is not None:
            facts.append(f"in frame {self.frame}")
        return f"Registration({', '.join(facts)}, {len(self.warnings)} warnings)"

    @property
    def ambiguous(self) -> bool:
        """Whether another registration is nearly as good, or the images do not confirm this one."""
        return any(isinstance(warning, Ambiguous | OtherValues | OutlineElsewhere) for warning in self.warnings)

    def pose_deviations(self) -> tuple[float, float] | None:
        """Standard deviations of the mean node's place, metres, and of the attitude, rad, in the reference frame.

        Each is that of the direction that is known worst. The turn about an axis of revolution does not count. None
        where they are not known.
        """
        pose = self.state.camera_from_object
        covariance = None if self.covariance is None else self.covariance[-6:, -6:]
        if self.map_registration is not None:
            own = [view for view in self.keyframes if view.frame == self.frame and view.covariance is not None]
            covariance = own[0].covariance if own else self.map_registration.pose_covariance(pose)
        if covariance is None:
            return None
        arm = pose.rotation @ self.model.positions(self.state.parameters).mean(axis=0)
        of_centre = np.hstack([-cross_matrix(arm), np.eye(3)])
        turn = np.eye(3)
        if self.axis is not None:
            along = pose.rotation @ self.axis.direction
            turn -= np.outer(along, along)
        parts = of_centre @ covariance @ of_centre.T, turn @ covariance[:3, :3] @ turn
        worst = (np.linalg.eigvalsh(part)[-1] for part in parts)
        place, angle = (float(np.sqrt(max(value, 0.0))) for value in worst)
        return place, angle

    @property
    def views(self) -> tuple[KeyframePose, ...]:
        """Keyframes with error factors, that of ``frame`` first.

        None if that one has no covariance of its own: then its error has none of these factors.
        """
        if not any(view.frame == self.frame and view.covariance is not None for view in self.keyframes):
            return ()
        known = [view for view in self.keyframes if view.error_factors is not None]
        return tuple(sorted(known, key=lambda view: view.frame != self.frame))

    def content(self) -> dict[str, Any]:
        """All but model, discrepancy and scene as plain JSON: what `save` writes.

        JSON has no infinity: what is unknown, as the deviations that too few landmarks give, is None.
        """
        content = {**_known(self.facts), "ambiguous": self.ambiguous}
        content["warnings"] = [_known(warning.content()) for warning in self.warnings]
        if self.depth_scale is not None:
            content["depth_scale"] = asdict(self.depth_scale)
        if self.map_registration is None:
            return content | {
                **_state_content(self.state),
                "state_covariance": _list(self.covariance),
                "alternatives": [_state_content(other) for other in self.alternatives],
            }
        placed, axis = self.map_registration.world_from_object, self.axis
        return content | {
            "frame": self.frame,
            "world_from_object": placed.matrix.tolist(),
            "map_units_per_metre": placed.scale,
            "mean_node_m": self.map_registration.centre.tolist(),
            "covariance": _list(self.map_registration.covariance),
            "axis_of_revolution": axis and {"point_m": axis.point.tolist(), "direction": axis.direction.tolist()},
            "map_renumbered": list(self.renumbered),
            "rivals": [
                {
                    "world_from_object": rival.world_from_object.matrix.tolist(),
                    "map_units_per_metre": rival.world_from_object.scale,
                    "score": rival.score,
                }
                for rival in self.rivals
            ],
            "keyframes": [
                {
                    "frame": view.frame,
                    "camera_from_object": view.pose.matrix.tolist(),
                    "covariance": _list(view.covariance),
                    "error_factors": _list(view.error_factors),
                }
                for view in self.keyframes
            ],
        }

    def save(self, path: str | Path, map_path: str | Path | None = None, model_path: str | Path | None = None) -> None:
        """Write a file that `load_registration` reads.

        Parameters
        ----------
        path : of the file, ``registration.json``.
        map_path : of the map, which the file names relative to itself.
        model_path : of the model, likewise.

        Raises
        ------
        RegistrationError
            If it cannot be written.
        """
        path = Path(path)
        named = {"map": map_path, "model": model_path}
        files = {key: None if file is None else os.path.relpath(file, path.parent) for key, file in named.items()}
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(json.dumps(self.content() | files, indent=2) + "\n", encoding="utf-8")
        except OSError as error:
            raise RegistrationError(f"cannot write the registration to {path}: {error.strerror}") from error


def registration_in_map(
    model: ReducedModel,
    map_registration: MapRegistration,
    keyframes: Sequence[KeyframePose],
    facts: dict[str, Any],
    warnings: Sequence[Notice] = (),
    axis: Axis | None = None,
    scene: Scene | None = None,
    frame: int | None = None,
) -> Registration:
    """The undeformed object in keyframe ``frame`` of the map, the last by default; of the arguments see `Registration`.

    Raises KeyError if the object's pose in that keyframe is not among ``keyframes``.
    """
    by_frame = {view.frame: view for view in keyframes}
    chosen = by_frame[max(by_frame) if frame is None else frame]
    open_angles: tuple[str, ...] = ()
    if axis is not None:
        warnings = [w for w in warnings if not isinstance(w, AngleOpen | TurnArbitrary)]
        if model.parameters:
            model = with_revolution_angle(model, axis.direction, precision=np.float32)
            open_angles = (model.parameters[-1].name,)
            warnings.append(AngleOpen(*open_angles))
        else:  # nothing deforms it that could come from a side
            warnings.append(TurnArbitrary())
    return Registration(
        model,
        *_undeformed_in(chosen, model, map_registration),
        chosen.frame,
        facts,
        tuple(warnings),
        open_angles,
        map_registration,
        tuple(keyframes),
        axis,
        scene=scene,
        renumbered=() if scene is None else scene.map.renumbered,
    )


def _undeformed_in(view: KeyframePose, model: ReducedModel, in_map: MapRegistration) -> tuple[State, Array | None]:
    """The state of an undeformed object in a keyframe, and its covariance; None where that is not known."""
    of_pose = in_map.pose_covariance(view.pose) if view.covariance is None else view.covariance
    covariance = None if of_pose is None else state_covariance(of_pose, len(model.parameters))
    return State(model.default, view.pose), covariance


def state_covariance(of_pose: Array, n_parameters: int) -> Array:
    """The covariance of a state whose parameters are known exactly, from that of its pose (6, 6)."""
    covariance = np.zeros((n_parameters + 6, n_parameters + 6))
    covariance[n_parameters:, n_parameters:] = of_pose
    return covariance


def in_scene(registration: Registration, scene: Scene) -> Registration:
    """The registration with its scene; raises MapError if it was made in another one.

    Where the map has grown by other recordings since, the registration takes over the numbers that its keyframes have
    now, without those that the map has no more. If its own one is among these, the last one left takes its place.
    """
    name, in_map = scene.path or "the scene", registration.map_registration
    if in_map is None or registration.frame is None:
        raise MapError(f"{name} is not the map of the registration: it was made without one")
    poses = {each.index: each.camera_from_world for each in scene.keyframes}
    since = scene.map.renumbered[len(registration.renumbered) :]
    more = sum(since)
    views = [replace(view, frame=view.frame + more) for view in registration.keyframes]
    gone = [view.frame - more for view in views if view.frame not in poses]
    # Only a map that grows takes keyframes out.
    if len(gone) == len(views) or (gone and not since):
        missing = max(gone, default=registration.frame)
        raise MapError(f"{name} is not the map of the registration: it has no keyframe {missing} of it")
    views = [view for view in views if view.frame in poses]
    frame = registration.frame + more
    # One without a covariance of its own is of no use beside others that have one: see `Registration.views`.
    last = max(views, key=lambda view: (view.frame == frame, view.covariance is not None, view.frame))
    off = {view.frame: _away(in_map, poses[view.frame], view.pose) for view in views}
    far = [view.frame for view in views if _is_elsewhere(in_map.centre, view.pose, *off[view.frame])]
    if last.frame in far or len(far) > OTHER_MAP_SHARE * len(views):
        turn, shift = off[far[-1]]
        raise MapError(
            f"{name} is not the map of the registration: by the map the object is {1e3 * shift:.0f} mm and "
            f"{np.degrees(turn):.0f} deg from where the registration has it in keyframe {far[-1] - more}"
        )
    found = replace(
        registration, scene=scene, frame=last.frame, keyframes=tuple(views), renumbered=scene.map.renumbered
    )
    if last.frame == frame:
        return found
    state, covariance = _undeformed_in(last, registration.model, in_map)
    return replace(found, state=state, covariance=covariance)


def _is_elsewhere(centre: Array, pose: RigidTransform, turn: float, shift: float) -> bool:
    """Whether an object whose ``pose`` in a keyframe is off by so much (rad, metres) is that of another map."""
    return turn > OTHER_MAP_TURN or shift > OTHER_MAP_SHIFT * float(np.linalg.norm(pose.apply(centre)))


def _away(in_map: MapRegistration, camera_from_world: Array, pose: RigidTransform) -> tuple[float, float]:
    """By what (rad, metres) an object is off where a map's keyframe has it: the origin of its frame may be anywhere."""
    by_map, centre = in_map.pose_in(camera_from_world), in_map.centre
    turn = float(np.linalg.norm(rotation_log(by_map.rotation @ pose.rotation.T)))
    return turn, float(np.linalg.norm(by_map.apply(centre) - pose.apply(centre)))


def _state_content(state: State) -> dict[str, list]:
    """A state for JSON."""
    return {"parameters": state.parameters.tolist(), "camera_from_object": state.camera_from_object.matrix.tolist()}


def _list(array: Array | None) -> list | None:
    """For JSON: what is not finite is None."""
    if array is None:
        return None
    values = array.astype(object)
    values[~np.isfinite(array)] = None
    return values.tolist()


def _known(content: dict[str, Any]) -> dict[str, Any]:
    """Figures for JSON: those that are not finite are None."""
    return {k: None if isinstance(v, float) and not np.isfinite(v) else v for k, v in content.items()}
