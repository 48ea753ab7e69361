"""Anchored objects: the camera is found in the frozen map of the scene, and with it the objects' poses.

This is the paper's main case: camera_from_object = camera_from_world world_from_object, in metres by the
scale of the registration. What of an object can move under its model is taken out of the map, so that a
deformation does not draw the camera along; what cannot stays with the scene.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from morph_dslam.camera import Camera
from morph_dslam.errors import RegistrationError
from morph_dslam.geometry import RigidTransform
from morph_dslam.model import ReducedModel
from morph_dslam.model.reduced_model import spread_over
from morph_dslam.registration.registration import MapRegistration, PosePrior, Registration
from morph_dslam.registration.starts import shape_starts
from morph_dslam.slam.result import SlamFrame
from morph_dslam.slam.rigid_map import RigidMap
from morph_dslam.slam.rolling_shutter import MiddleRowPoses
from morph_dslam.slam.slam import Slam
from morph_dslam.sources import Frame
from morph_dslam.tracking.covariance import EIGENVALUE_FLOOR
from morph_dslam.tracking.estimator import Estimator, Prior, State, moved
from morph_dslam.tracking.hypothesis import Image, PoseHypothesis
from morph_dslam.tracking.options import TrackerOptions
from morph_dslam.tracking.reference import ReferenceView
from morph_dslam.tracking.tracker_inputs import Picture

Array = NDArray[np.float64]
#: A map point this near to the surface, over the object's size, lies on it: that is what maps are good for.
ON_SURFACE = 0.03
#: Points that stand for the surface, much closer together than `ON_SURFACE`.
N_SAMPLES = 10_000
#: What moves by more than this part of the object's size over the parameter box is no part of the scene.
MOVES = 0.005
#: Two objects that share more than this part of one's movable points are in the same place.
SHARED = 0.5


def points_on_object(
    positions: Array, place: MapRegistration, model: ReducedModel
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Which map points (n, 3) lie on the object, and which of them (n,) where it can move under the model."""
    samples = spread_over(model.nodes, model.triangles, N_SAMPLES)
    size = float(np.linalg.norm(np.ptp(model.nodes, axis=0)))
    field = model.restrict(samples)
    reach, undeformed = np.zeros(len(samples)), field.value(model.default)
    # Each unknown load may move points too, though searches for a shape leave all of them out.
    loaded = [model.default + row for row in np.diag(model.upper - model.default)[len(model.study_parameters) :]]
    for shape in (*shape_starts(model), *loaded):
        reach = np.maximum(reach, np.linalg.norm(field.value(shape) - undeformed, axis=1))
    in_object = place.world_from_object.inverse.apply(positions)
    distances, nearest = KDTree(model.rest_positions(samples)).query(in_object)
    on_object = distances < ON_SURFACE * size
    return on_object, on_object & (reach[nearest] > MOVES * size)


@dataclass(frozen=True)
class CameraLocalization:
    """Where the map has the object in a frame.

    Attributes
    ----------
    pose_prior : of the object; None for a free one, or where the camera is lost.
    why_lost : why the camera is; empty if it is not.
    milliseconds : that it took.
    image : the frame made ready, where it was needed for that by the same camera.
    """

    pose_prior: PosePrior | None = None
    why_lost: str = ""
    milliseconds: float = 0.0
    image: Image | None = None


class Anchor:
    """Finds the poses of anchored objects by finding the camera in the map, once a frame for all of them.

    Parameters
    ----------
    rigid_map : of the scene with the undeformed objects; what can move is taken out of a copy of it.
    camera : that looks for itself in the map.
    objects : by name, the place in the map and the model.

    Attributes
    ----------
    n_scene, n_movable : map points that stay, on an object or not, and those on one that were taken out.

    Raises
    ------
    RegistrationError
        If nobody knows how far a place is to be trusted, or two objects are in the same place.
    """

    def __init__(
        self, rigid_map: RigidMap, camera: Camera, objects: Mapping[str, tuple[MapRegistration, ReducedModel]]
    ) -> None:
        if any(place.covariance is None for place, _ in objects.values()):
            raise RegistrationError(
                "the registration does not say how well the object's place is known, because the keyframes "
                "show too little texture on it: track it as a free object (--pose free)"
            )
        self._places, good = {name: place for name, (place, _) in objects.items()}, rigid_map.good
        positions = rigid_map.positions[good]
        movable = {name: points_on_object(positions, *placed)[1] for name, placed in objects.items()}
        _check_places(movable)
        taken = np.logical_or.reduce(list(movable.values()))
        self.n_movable, self.n_scene = int(taken.sum()), int((~taken).sum())
        still = RigidMap(rigid_map.baseline_px)
        still.copy_of(rigid_map)
        still.remove(good[taken])
        self.slam = Slam(camera)
        self.slam.use_map(still)
        self._rows = MiddleRowPoses(still, camera) if camera.readout_s else None

    @classmethod
    def of(cls, registrations: Mapping[str, Registration], camera: Camera) -> Anchor:
        """The scene that objects, by name, are registered in; raises RegistrationError as well if there is none."""
        found = {name: known.map_registration for name, known in registrations.items()}
        first = next(iter(registrations.values()))
        placed = {name: (place, registrations[name].model) for name, place in found.items() if place is not None}
        if first.scene is None or len(placed) < len(found):
            raise RegistrationError("the registration has no scene to find the camera in: register in a mapped scene")
        return cls(first.scene.map, camera, placed)

    def locate(self, image: NDArray[np.uint8], index: int, timestamp: float) -> tuple[dict[str, PosePrior], SlamFrame]:
        """The objects by name in a frame (h, w, 3), none where the camera is lost in the map; the camera."""
        frame = self.slam.process_frame(image, index, timestamp)
        if frame.pose is None:
            return {}, frame
        pose = frame.pose
        if self._rows is not None:
            pose = replace(pose, camera_from_world=self._rows.add(timestamp, pose.camera_from_world, frame.points))
        return {name: place.pose_prior(pose) for name, place in self._places.items()}, frame

    def localized(self, frame: Frame, camera: Camera) -> dict[str, CameraLocalization]:
        """Each object by name in a frame of a tracker's camera."""
        poses, found = self.locate(Picture.of(frame, camera).image, frame.index, frame.timestamp)
        view = self.slam.newest_view if self.slam.frame_images.camera == camera else None
        image, why = None if view is None else Image(view.grey, view.normalized), str(found.reason or "")
        return {name: CameraLocalization(poses.get(name), why, found.total_ms, image) for name in self._places}


def _check_places(movable: Mapping[str, NDArray[np.bool_]]) -> None:
    """Raise RegistrationError if two objects have taken the same points (n,) of the map."""
    for (one, points), (other, others) in combinations(movable.items(), 2):
        fewest = min(int(points.sum()), int(others.sum()))
        if fewest and (points & others).sum() > SHARED * fewest:
            raise RegistrationError(
                f"'{one}' and '{other}' are registered in the same place of the map: register the second "
                "one beside the first (morph register --beside)"
            )


#: Spread of residuals, pixels, before any frame has shown one, and the least that is believed.
FIRST_SIGMA_PX, LEAST_SIGMA_PX = 0.5, 0.1
#: Variance of an outline's point without texture, squared pixels, times how many of them count as one, likewise.
FIRST_OUTLINE_PX2 = 5.0
#: How much more a pose counts that is to be held.
HELD = 1e6


class Anchoring:
    """Decides frame by frame whether an object is still where the map has it, and how much its pose there counts.

    Its pose comes from the camera's, and its points have to agree with it. Where they do not, in several frames
    on end, the object has moved: then its points alone say where it is, until they agree with the map again.

    Attributes
    ----------
    has_moved : whether the object is away from its place in the map.
    reference : the view that frames are compared with.
    """

    def __init__(self, estimator: Estimator, reference: ReferenceView, options: TrackerOptions) -> None:
        self._estimator, self.reference, self._options = estimator, reference, options
        self._d = len(estimator.model.parameters)
        self._size = float(np.linalg.norm(np.ptp(estimator.model.nodes, axis=0)))
        self._squared_px = reference.redundancy * FIRST_SIGMA_PX**2
        if reference.outline_alone:
            self._squared_px = FIRST_OUTLINE_PX2
        self.has_moved, self._n_other = False, 0
        #: What the points of a frame's state said last: outline and filter mostly leave that as it is.
        self._judged: tuple[PosePrior, State, bool] | None = None

    def prior(self, known: PosePrior | None) -> Prior | None:
        """What the map tells of the pose; None if the camera is lost or the object has moved."""
        if known is None or self.has_moved:
            return None
        return known.prior(self._d, self._squared_px, HELD if self._options.pose == "fixed" else 1.0)

    def contradicts(self, known: PosePrior, attempt: PoseHypothesis) -> bool:
        """Whether the points of a believable attempt show the object elsewhere than in the map.

        Both must hold: it is farther off than the registration's usual error, and than the standard
        deviations of both poses explain.
        """
        state = attempt.estimate.state
        if self._judged is not None and self._judged[0] is known and self._judged[1] is state:
            return self._judged[2]
        contradicts = self._is_elsewhere(known, attempt)
        self._judged = known, state, contradicts
        return contradicts

    def _is_elsewhere(self, known: PosePrior, attempt: PoseHypothesis) -> bool:
        pose, covariance = self._by_points_alone(attempt)
        points = self.reference.points.rest[attempt.inliers]
        apart = np.sqrt(np.mean(np.sum((pose.apply(points) - known.pose.apply(points)) ** 2, axis=1)))
        if not apart > self._options.moved_share * self._size:
            return False
        away, spread = known.away(pose), known.covariance + covariance
        return float(np.sqrt(away @ np.linalg.solve(spread, away))) > self._options.moved_sigmas

    def _by_points_alone(self, attempt: PoseHypothesis) -> tuple[RigidTransform, Array]:
        """The pose by an attempt's points and its covariance (6, 6), to first order from where it is.

        What the points do not tell at all stays as the attempt has it, with a very large variance.
        """
        estimate, points = attempt.estimate, self.reference.points
        weights = attempt.weights
        _, hessian, gradient, _ = self._estimator.evaluate(points, attempt.measurement.pixels, weights, estimate.state)
        scale = self._estimator.scale
        values, vectors = np.linalg.eigh(hessian * np.outer(scale, scale))
        vectors, floor = scale[:, None] * vectors, max(values[-1], 1e-30) * EIGENVALUE_FLOOR
        along = np.where(values > floor, vectors.T @ gradient / np.maximum(values, floor), 0.0)
        rows = vectors[self._d :]
        covariance = (rows / np.maximum(values, floor)) @ rows.T
        covariance *= self.reference.redundancy * max(estimate.sigma_px, LEAST_SIGMA_PX) ** 2
        return moved(estimate.state, -vectors @ along).camera_from_object, covariance

    def note(self, elsewhere: bool) -> None:
        """Take in whether a frame showed the object elsewhere; several on end change the opinion."""
        self._n_other = self._n_other + 1 if elsewhere != self.has_moved else 0
        if self._n_other >= self._options.moved_patience:
            self.has_moved, self._n_other = elsewhere, 0

    def learn(self, sigma_px: float, redundancy: float) -> None:
        """Take in how well the points of an accepted frame agree, and how many count as one."""
        if np.isfinite(sigma_px):
            self._squared_px = redundancy * max(sigma_px, LEAST_SIGMA_PX) ** 2
