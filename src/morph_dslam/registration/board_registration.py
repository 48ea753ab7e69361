"""Registration by a printed board that is fixed to the object, in one image, or to the scene, in its map."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from morph_dslam.camera import Camera
from morph_dslam.errors import RegistrationError, RegistrationFailure
from morph_dslam.geometry import RigidTransform, SimilarityTransform, cross_matrix
from morph_dslam.model import ReducedModel
from morph_dslam.registration.board import FEWEST_CORNERS, FiducialBoard, load_board
from morph_dslam.registration.messages import Ambiguity, Ambiguous, AssumedUndeformed, RegistrationWarning
from morph_dslam.registration.registration import (
    KeyframePose,
    MapRegistration,
    Registration,
    registration_in_map,
    state_covariance,
)
from morph_dslam.registration.scene import View, camera_from_object, map_warnings, points_and_views
from morph_dslam.registration.starts import solve_pnp
from morph_dslam.registration.texture import moved_similarity, pose_jacobian
from morph_dslam.slam.scene import Scene
from morph_dslam.tracking.state import State, moved

Array = NDArray[np.float64]
#: Standard deviation of a corner at the least, and residuals that speak against board or camera, pixels.
LEAST_CORNER_PX, LARGEST_RESIDUAL_PX = 0.1, 2.0
#: Another pose whose squared residuals are at most so many times as large is ambiguous with the best.
AMBIGUOUS = 4.0
#: By how much a board's size may differ from that in a metric map.
METRIC_SHARE = 0.03


@dataclass(frozen=True)
class BoardPose:
    """A board in an image.

    Attributes
    ----------
    camera_from_board : metres.
    covariance : (6, 6) of its increment, see `state.moved`.
    n_corners : number of corners found.
    cost : sum of their squared residuals, squared pixels.
    ambiguity : what else fits nearly as well, another tilt or the other order of the tags' corners; None if nothing.
    """

    camera_from_board: RigidTransform
    covariance: Array
    n_corners: int
    cost: float
    ambiguity: Ambiguity | None

    @property
    def rms_px(self) -> float:
        """Root mean square of the residuals' lengths, pixels."""
        return float(np.sqrt(self.cost / self.n_corners))

    def of_object(self, board_from_object: RigidTransform) -> tuple[RigidTransform, Array]:
        """camera_from_object, and the covariance (6, 6) of its increment."""
        arm = self.camera_from_board.rotation @ board_from_object.translation
        slopes = np.eye(6)
        slopes[3:, :3] = -cross_matrix(arm)
        return self.camera_from_board @ board_from_object, slopes @ self.covariance @ slopes.T


def locate_board(board: FiducialBoard, camera: Camera, grey: NDArray[np.uint8]) -> BoardPose | None:
    """The board in an undistorted image (h, w); None where too little of it is seen.

    Raises
    ------
    RegistrationError
        If the corners do not lie as the board file says, in neither order of its tags' corners.
    """
    points, pixels = board.find(grey)
    if len(points) < FEWEST_CORNERS:
        return None
    orders = [found for order in board.orders(points) if (found := _locate(order, pixels, camera))]
    if not orders:
        return None
    best, *others = sorted(orders, key=lambda found: found.rms_px)
    if best.rms_px > LARGEST_RESIDUAL_PX:
        raise RegistrationError(
            f"the corners of the board do not lie as they should: they are {best.rms_px:.1f} px off; check the board "
            "file (sizes, columns and rows), that the print is flat, and the camera file",
            RegistrationFailure.BOARD_DOES_NOT_FIT,
        )
    if any(_fits_as_well(found.cost, best.cost) for found in others):
        return replace(best, ambiguity=Ambiguity.BOARD_TAGS)
    return best


def _fits_as_well(cost: float, best: float) -> bool:
    """Whether a pose with squared residuals ``cost`` is ambiguous with the best."""
    return cost < AMBIGUOUS * best + 1.0


def _locate(points: Array, pixels: Array, camera: Camera) -> BoardPose | None:
    """The best pose of corners (k, 3) seen at pixels (k, 2); None where there is none."""
    found = (_refined(start, points, pixels, camera) for start in solve_pnp(points, pixels, camera))
    fits = sorted((fit for fit in found if np.isfinite(fit[1])), key=lambda fit: fit[1])
    if not fits:
        return None
    pose, cost, information = fits[0]
    variance = max(cost / max(2 * len(points) - 6, 1), LEAST_CORNER_PX**2)
    tilted = any(_angle(pose, other) > 0.05 and _fits_as_well(c, cost) for other, c, _ in fits[1:])
    covariance = np.asarray(variance * np.linalg.pinv(information), dtype=np.float64)
    return BoardPose(pose, covariance, len(points), cost, Ambiguity.BOARD_TILT if tilted else None)


def _refined(
    start: RigidTransform, points: Array, pixels: Array, camera: Camera
) -> tuple[RigidTransform, float, Array]:
    """The pose of least squared residuals near ``start``, their sum, and the information (6, 6)."""
    state = State(np.empty(0), start)
    for _ in range(10):
        residuals, jacobian = _linear(state.camera_from_object, points, pixels, camera)
        step, *_ = np.linalg.lstsq(jacobian, -residuals, rcond=None)
        state = moved(state, np.asarray(step, dtype=np.float64))
    residuals, jacobian = _linear(state.camera_from_object, points, pixels, camera)
    return state.camera_from_object, float(residuals @ residuals), jacobian.T @ jacobian


def _linear(pose: RigidTransform, points: Array, pixels: Array, camera: Camera) -> tuple[Array, Array]:
    """Residuals (2 k,) and their derivatives (2 k, 6) by the pose's increment."""
    local = pose.apply(points)
    jacobian = camera.projection_jacobian(local) @ pose_jacobian(local, pose)
    return (camera.project(local) - pixels).ravel(), jacobian.reshape(-1, 6)


def _angle(one: RigidTransform, other: RigidTransform) -> float:
    """Between two rotations, radians."""
    return float(np.arccos(np.clip(0.5 * (np.trace(one.rotation.T @ other.rotation) - 1.0), -1.0, 1.0)))


def _on_board(board: FiducialBoard) -> RigidTransform:
    if board.board_from_object is None:
        raise RegistrationError("the board file does not say where the object is: give it a section [object]")
    return board.board_from_object


@dataclass(frozen=True)
class BoardInitializer:
    """Finds the undeformed object by the board that it is fixed to.

    Attributes
    ----------
    board : with the object's place on it.
    """

    board: FiducialBoard

    def register(self, model: ReducedModel, camera: Camera, grey: NDArray[np.uint8]) -> Registration:
        """The object in an undistorted image (h, w).

        Raises
        ------
        RegistrationError
            If the board is not seen, or its file does not say where the object is on it.
        """
        on_board = _on_board(self.board)
        found = locate_board(self.board, camera, grey)
        if found is None:
            raise RegistrationError(
                "the board is not seen in the reference frame: choose one that shows it sharp and with its "
                "white margin, and check its dictionary",
                RegistrationFailure.BOARD_NOT_SEEN,
            )
        pose, of_pose = found.of_object(on_board)
        covariance = state_covariance(of_pose, len(model.parameters))
        warnings: list[RegistrationWarning] = [AssumedUndeformed()]
        if found.ambiguity:
            warnings.append(Ambiguous(found.ambiguity))
        facts = {"from": "board", "n_corners": found.n_corners, "residual_rms_px": found.rms_px}
        return Registration(model, State(model.default, pose), covariance, facts=facts, warnings=tuple(warnings))


@dataclass(frozen=True)
class _BoardInMap:
    """A board found in a map.

    Attributes
    ----------
    world_from_board : metres to the map's unit.
    covariance : (7, 7) of log scale, rotation vector and translation about ``centre``, world.
    centre : (3,) of the board, metres.
    n_views : number of keyframes that show it.
    rms_px : root mean square of its corners' residuals, pixels.
    open_order : whether the other order of its tags' corners fits nearly as well.
    """

    world_from_board: SimilarityTransform
    covariance: Array
    centre: Array
    n_views: int
    rms_px: float
    open_order: bool


def register_board(scene: Scene, model: ReducedModel, board: FiducialBoard | str | Path) -> Registration:
    """The undeformed object in a map, and the map's unit, by a board that stands in the scene.

    Parameters
    ----------
    scene : with the map.
    model : of the object.
    board : with the object's place on it, or the file that describes it.

    Raises
    ------
    RegistrationError
        If fewer than two keyframes show the board, from too near to one another, or they do not agree; or if
        the board does not say where the object is.
    """
    board = board if isinstance(board, FiducialBoard) else load_board(Path(board))
    on_board = _on_board(board)
    views = points_and_views(scene)[1]
    found = _find_in_map(board, views, scene.camera)
    if scene.is_metric and abs(found.world_from_board.scale - 1.0) > METRIC_SHARE:
        raise RegistrationError(
            f"the map is metric, but a metre of the board is {found.world_from_board.scale:.3g} m in it: "
            "measure the print, and correct the board file or the depth camera's calibration",
            RegistrationFailure.WRONG_SIZE,
        )
    placed = found.world_from_board @ SimilarityTransform(1.0, on_board.rotation, on_board.translation)
    mean_node = model.positions(model.default).mean(axis=0)
    arm = placed.apply(mean_node) - found.world_from_board.apply(found.centre)
    facts = {
        "from": "board",
        "score": float(found.n_views),
        "runner_up_score": 0.0,
        "n_explained": found.n_views,
        "rms_px": found.rms_px,
        "map_units_per_metre": placed.scale,
        "outline_share": None,
    }
    keyframes = [KeyframePose(view.frame, camera_from_object(view, placed)) for view in views]
    in_map = MapRegistration(placed, mean_node, _about(found.covariance, arm))
    warnings: list[RegistrationWarning] = [AssumedUndeformed(), *map_warnings(scene)]
    if found.open_order:
        warnings.append(Ambiguous(Ambiguity.BOARD_TAGS))
    return registration_in_map(model, in_map, keyframes, facts, warnings, scene=scene)


def _find_in_map(board: FiducialBoard, views: Sequence[View], camera: Camera) -> _BoardInMap:
    """The similarity with which all keyframes see the board's corners where they are."""
    best, *others = _seen_in_orders(board, views, camera)
    seen = [(view, points, pixels) for view, points, pixels, _ in best]
    poses = [pose.camera_from_board for *_, pose in best]
    if len(seen) < 2:
        raise RegistrationError(
            f"the board is seen in {len(seen)} keyframes of the map, two at least are needed: film it from "
            "several sides, sharp and with its white margin",
            RegistrationFailure.BOARD_NOT_SEEN,
        )
    centre = np.array([*board.size, 0.0]) / 2.0
    start = _start([view for view, _, _ in seen], poses, centre)
    units = np.array([1.0] * 4 + [start.scale] * 3)

    def residuals(step: Array) -> Array:
        world = moved_similarity(start, step * units, centre)
        parts = [
            camera.project(view.camera_from_world.apply(world.apply(points))) - pixels for view, points, pixels in seen
        ]
        return np.nan_to_num(np.concatenate(parts), nan=1e3).ravel()

    found = least_squares(residuals, np.zeros(7), loss="huber", f_scale=1.0)
    misfit = residuals(found.x)
    rms = float(np.sqrt(np.mean(misfit.reshape(-1, 2) ** 2) * 2.0))
    if rms > LARGEST_RESIDUAL_PX:
        raise RegistrationError(
            f"the board does not stand still in the map, or its file is wrong: corners are {rms:.1f} px off",
            RegistrationFailure.BOARD_DOES_NOT_FIT,
        )
    # An order that has no pose in some of the keyframes does not fit there.
    as_many = [other for other in others if len(other) == len(best)]
    open_order = any(_fits_as_well(_total_cost(other), _total_cost(best)) for other in as_many)
    world = moved_similarity(start, found.x * units, centre)
    return _BoardInMap(world, _covariance(world, centre, seen, camera), centre, len(seen), rms, open_order)


def _covariance(
    world: SimilarityTransform, centre: Array, seen: Sequence[tuple[View, Array, Array]], camera: Camera
) -> Array:
    """(7, 7) of log scale, rotation vector and translation about ``centre``, world.

    Most of the residuals are errors of the keyframes' poses, which all corners of one keyframe share: of each keyframe
    they count as one pose that is off. Its covariance is that of all keyframes together, whose 6 numbers each leave 7
    less. Errors of single corners are added, so that two keyframes do not seem exact where they happen to agree.
    """
    in_map = MapRegistration(world, centre, None)
    information, by_poses, away, single = np.zeros((7, 7)), [], [], 0.0
    for view, points, pixels in seen:
        pose = camera_from_object(view, world)
        residuals, jacobian = _linear(pose, points, pixels, camera)
        weight, slopes = jacobian.T @ jacobian, in_map.slopes(pose)
        off = np.linalg.lstsq(jacobian, -residuals, rcond=None)[0]
        away.append(off)
        single += float(np.sum((residuals + jacobian @ off) ** 2))
        information += slopes.T @ weight @ slopes
        by_poses.append(slopes.T @ weight)
    of_pose = 6.0 * np.array(away).T @ np.array(away) / (6.0 * len(seen) - 7.0)
    variance = max(single / sum(2 * len(points) - 6 for _, points, _ in seen), LEAST_CORNER_PX**2)
    inverse = np.linalg.pinv(information)
    gradients = sum(part @ of_pose @ part.T for part in by_poses)
    return np.asarray(inverse @ (gradients + variance * information) @ inverse, dtype=np.float64)


#: The views that show the board, its corners, their pixels, and its pose.
_Seen = list[tuple[View, Array, Array, BoardPose]]


def _seen_in_orders(board: FiducialBoard, views: Sequence[View], camera: Camera) -> list[_Seen]:
    """The views in each order of the tags' corners, that which all of them together suit best first."""
    orders: list[_Seen] = [[] for _ in board.orders(np.empty((0, 3)))]
    for view in views:
        points, pixels = board.find(view.normalized)
        for seen, order in zip(orders, board.orders(points), strict=True):
            pose = _locate(order, pixels, camera) if len(points) >= FEWEST_CORNERS else None
            seen += [] if pose is None else [(view, order, pixels, pose)]
    return sorted(orders, key=lambda seen: (-len(seen), _total_cost(seen)))


def _total_cost(seen: _Seen) -> float:
    return sum(pose.cost for *_, pose in seen)


def _start(views: Sequence[View], poses: Sequence[RigidTransform], centre: Array) -> SimilarityTransform:
    """Mean rotation; then, by linear least squares, the scale and place that suit all keyframes."""
    turns = [v.camera_from_world.rotation.T @ p.rotation for v, p in zip(views, poses, strict=True)]
    rotation = Rotation.from_matrix(np.array(turns)).mean().as_matrix()
    rows, right = [], []
    for view, pose in zip(views, poses, strict=True):
        # R_cw X + t_cw = s (centre in the camera, metres)
        rows.append(np.column_stack([view.camera_from_world.rotation, -pose.apply(centre)]))
        right.append(-view.camera_from_world.translation)
    solution, *_ = np.linalg.lstsq(np.vstack(rows), np.concatenate(right), rcond=None)
    scale = float(solution[3])
    if not scale > 0.0:
        raise RegistrationError("the keyframes that show the board are too near to one another to give its size")
    return SimilarityTransform(scale, rotation, solution[:3] - scale * rotation @ centre)


def _about(covariance: Array, arm: Array) -> Array:
    """The covariance (7, 7) about another point, ``arm`` (3,) from the first one, world."""
    slopes = np.eye(7)
    slopes[4:, 0] = arm
    slopes[4:, 1:4] = -cross_matrix(arm)
    return slopes @ covariance @ slopes.T
