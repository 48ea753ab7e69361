"""A board that stands in a mapped scene: it tells the size of the map's unit, and where the object is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from morph_dslam.camera import Camera
from morph_dslam.errors import RegistrationError
from morph_dslam.geometry import RigidTransform, SimilarityTransform, cross_matrix, rotation_exp
from morph_dslam.io.camera_files import load_camera
from morph_dslam.model import load_model
from morph_dslam.registration.board import FEWEST_CORNERS, LEAST_CORNER_PX, FiducialBoard, load_board, locate_board
from morph_dslam.registration.scene import View, camera_from_object, scene_of_map
from morph_dslam.slam.map_files import load_map
from morph_dslam.tracking.run_folder import make_folder, write_registration

Array = NDArray[np.float64]

#: Residuals that speak against it, pixels.
LARGEST_RESIDUAL_PX = 2.0

#: By how much a board's size may differ from that in a metric map.
METRIC_SHARE = 0.03


@dataclass(frozen=True)
class BoardInMap:
    """A board found in a map.

    Attributes
    ----------
    world_from_board : metres to the map's unit. covariance : (7, 7) of log scale, rotation vector and
        translation about ``centre`` (3,) of the board, world. n_views : keyframes that show it. rms_px : of
        its corners' residuals.
    """

    world_from_board: SimilarityTransform
    covariance: Array
    centre: Array
    n_views: int
    rms_px: float


def find_board_in_map(board: FiducialBoard, views: Sequence[View], camera: Camera) -> BoardInMap:
    """The similarity with which all keyframes see the board's corners where they are.

    Raises
    ------
    RegistrationError
        If fewer than two keyframes show the board, from too near to one another, or they do not agree.
    """
    seen, poses = [], []
    for view in views:
        points, pixels = board.find(view.normalized)
        pose = locate_board(board, camera, view.normalized) if len(points) >= FEWEST_CORNERS else None
        if pose is not None:
            seen.append((view, points, pixels))
            poses.append(pose.camera_from_board)
    if len(seen) < 2:
        raise RegistrationError(
            f"the board is seen in {len(seen)} keyframes of the map, two at least are needed: film it from "
            "several sides, sharp and with its white margin"
        )
    centre = np.array([*board.size, 0.0]) / 2.0
    start = _start([view for view, _, _ in seen], poses, centre)

    def placed(step: Array) -> SimilarityTransform:
        scale, rotation = start.scale * float(np.exp(step[0])), rotation_exp(step[1:4]) @ start.rotation
        middle = start.apply(centre) + start.scale * step[4:]
        return SimilarityTransform(scale, rotation, middle - scale * rotation @ centre)

    def residuals(step: Array) -> Array:
        world = placed(step)
        parts = [
            camera.project(view.camera_from_world.apply(world.apply(points))) - pixels for view, points, pixels in seen
        ]
        return np.nan_to_num(np.concatenate(parts), nan=1e3).ravel()

    found = least_squares(residuals, np.zeros(7), loss="huber", f_scale=1.0)
    misfit = residuals(found.x)
    rms = float(np.sqrt(np.mean(misfit.reshape(-1, 2) ** 2) * 2.0))
    if rms > LARGEST_RESIDUAL_PX:
        raise RegistrationError(
            f"the board does not stand still in the map, or its file is wrong: corners are {rms:.1f} px off"
        )
    variance = max(float(misfit @ misfit) / max(len(misfit) - 7, 1), LEAST_CORNER_PX**2)
    units = np.array([1.0] * 4 + [start.scale] * 3)
    covariance = variance * np.linalg.pinv(found.jac.T @ found.jac) * np.outer(units, units)
    return BoardInMap(placed(found.x), covariance, centre, len(seen), rms)


def _start(views: Sequence[View], poses: Sequence, centre: Array) -> SimilarityTransform:
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
        raise RegistrationError("the keyframes that show the board are too near to one another to tell its size")
    return SimilarityTransform(scale, rotation, solution[:3] - scale * rotation @ centre)


def register_by_board(
    map_path: Path, model_path: Path, camera_path: Path, board_path: Path, output: Path
) -> dict[str, Any]:
    """Place an object in a map by a board; writes ``registration.json`` as `morph register` does.

    Returns
    -------
    The content of ``registration.json``.

    Raises
    ------
    RegistrationError
        If the board is not found, or its file does not say where the object is.
    MapError, ModelFileError, CameraError
        If an input cannot be read.
    """
    camera, model, board = load_camera(camera_path), load_model(model_path), load_board(board_path)
    on_board = board.board_from_object
    if on_board is None:
        raise RegistrationError(f"{board_path} does not say where the object is: give it a section [object]")
    rigid_map = load_map(map_path, camera)
    views = scene_of_map(rigid_map)[1]
    found = find_board_in_map(board, views, camera)
    if rigid_map.is_metric and abs(found.world_from_board.scale - 1.0) > METRIC_SHARE:
        raise RegistrationError(
            f"the map is metric, but a metre of the board is {found.world_from_board.scale:.3g} m in it: "
            "measure the print, and mend the board file or the depth camera's calibration"
        )
    mean_node = model.positions(model.default).mean(axis=0)
    make_folder(output, "the registration", RegistrationError)
    return write_registration(output, _content(found, on_board, mean_node, views), map_path, model_path)


def _content(found: BoardInMap, on_board: RigidTransform, mean_node: Array, views: Sequence[View]) -> dict[str, Any]:
    """What a registration says of an object at ``on_board``, board from object, with this mean node (3,)."""
    placed = found.world_from_board @ SimilarityTransform(1.0, on_board.rotation, on_board.translation)
    arm = placed.apply(mean_node) - found.world_from_board.apply(found.centre)
    return {
        "from": "board",
        "world_from_object": placed.matrix.tolist(),
        "map_units_per_metre": placed.scale,
        "mean_node_m": mean_node.tolist(),
        "score": float(found.n_views),
        "runner_up_score": 0.0,
        "ambiguous": False,
        "n_explained": found.n_views,
        "rms_px": found.rms_px,
        "covariance": _moved(found.covariance, arm).tolist(),
        "axis_of_revolution": None,
        "keyframes": [
            {"frame": view.frame, "camera_from_object": camera_from_object(view, placed).matrix.tolist()}
            for view in views
        ],
    }


def _moved(covariance: Array, arm: Array) -> Array:
    """The covariance (7, 7) about another point, ``arm`` (3,) from the first one, world."""
    slopes = np.eye(7)
    slopes[4:, 0] = arm
    slopes[4:, 1:4] = -cross_matrix(arm)
    return slopes @ covariance @ slopes.T
