"""An object's pose from a printed board that is fixed to it, or to the scene that it stands in."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from morph_dslam.camera import PinholeCamera
from morph_dslam.errors import RegistrationError
from morph_dslam.geometry import RigidTransform, cross_matrix
from morph_dslam.model import ReducedModel
from morph_dslam.online.aids.board import FEWEST_CORNERS, FiducialBoard
from morph_dslam.online.estimation.state import State, moved
from morph_dslam.online.start.placement import Placement
from morph_dslam.online.start.registration import solve_pnp

Array = NDArray[np.float64]

#: Standard deviation of a corner at the least, and residuals that speak against board or camera, pixels.
LEAST_CORNER_PX, LARGEST_RESIDUAL_PX = 0.1, 2.0
#: Another pose whose squared residuals are at most so many times as large cannot be told from the best.
AMBIGUOUS = 4.0
NO_PARAMETERS = np.empty(0)


@dataclass(frozen=True)
class BoardPose:
    """A board in an image.

    Attributes
    ----------
    camera_from_board : metres. covariance : (6, 6) of its increment, see `state.moved`.
    n_corners : found. rms_px : of their residuals' lengths. ambiguous : another tilt fits nearly as well.
    """

    camera_from_board: RigidTransform
    covariance: Array
    n_corners: int
    rms_px: float
    ambiguous: bool

    def of_object(self, board_from_object: RigidTransform) -> tuple[RigidTransform, Array]:
        """camera_from_object, and the covariance (6, 6) of its increment."""
        arm = self.camera_from_board.rotation @ board_from_object.translation
        slopes = np.eye(6)
        slopes[3:, :3] = -cross_matrix(arm)
        return self.camera_from_board @ board_from_object, slopes @ self.covariance @ slopes.T


def locate_board(board: FiducialBoard, camera: PinholeCamera, grey: NDArray[np.uint8]) -> BoardPose | None:
    """The board in an undistorted image (h, w); None where too little of it is seen.

    Raises
    ------
    RegistrationError
        If its corners do not lie as on this board.
    """
    points, pixels = board.find(grey)
    if len(points) < FEWEST_CORNERS:
        return None
    fits = sorted(
        (_refined(start, points, pixels, camera) for start in solve_pnp(points, pixels, camera)),
        key=lambda fit: fit[1],
    )
    if not fits:
        return None
    pose, cost, information = fits[0]
    freedom = max(2 * len(points) - 6, 1)
    rms = float(np.sqrt(cost / len(points)))
    if rms > LARGEST_RESIDUAL_PX:
        raise RegistrationError(
            f"the corners of the board do not lie as they should: they are {rms:.1f} px off; check the board "
            "file (sizes, columns and rows), that the print is flat, and the camera file"
        )
    variance = max(cost / freedom, LEAST_CORNER_PX**2)
    ambiguous = any(_turned(pose, other) > 0.05 and c < AMBIGUOUS * cost + 1.0 for other, c, _ in fits[1:])
    return BoardPose(
        pose,
        np.asarray(variance * np.linalg.pinv(information), dtype=np.float64),
        len(points),
        rms,
        ambiguous,
    )


def _refined(
    start: RigidTransform, points: Array, pixels: Array, camera: PinholeCamera
) -> tuple[RigidTransform, float, Array]:
    """The pose of least squared residuals near ``start``, their sum, and the information (6, 6)."""
    state = State(NO_PARAMETERS, start)
    for _ in range(10):
        residuals, jacobian = _linear(state.camera_from_object, points, pixels, camera)
        step, *_ = np.linalg.lstsq(jacobian, -residuals, rcond=None)
        state = moved(state, np.asarray(step, dtype=np.float64))
    residuals, jacobian = _linear(state.camera_from_object, points, pixels, camera)
    return state.camera_from_object, float(residuals @ residuals), jacobian.T @ jacobian


def _linear(pose: RigidTransform, points: Array, pixels: Array, camera: PinholeCamera) -> tuple[Array, Array]:
    local = pose.apply(points)
    of_pose = np.zeros((len(points), 3, 6))
    of_pose[:, :, :3] = -cross_matrix(local - pose.translation)
    of_pose[:, :, 3:] = np.eye(3)
    jacobian = camera.projection_jacobian(local) @ of_pose
    return (camera.project(local) - pixels).ravel(), jacobian.reshape(-1, 6)


def _turned(one: RigidTransform, other: RigidTransform) -> float:
    """Angle between two rotations, radians."""
    return float(np.arccos(np.clip(0.5 * (np.trace(one.rotation.T @ other.rotation) - 1.0), -1.0, 1.0)))


@dataclass(frozen=True)
class BoardStart:
    """Places the undeformed object by a board."""

    board: FiducialBoard

    def place(self, model: ReducedModel, camera: PinholeCamera, grey: NDArray[np.uint8]) -> Placement:
        """The object in an undistorted image (h, w).

        Raises
        ------
        RegistrationError
            If the board is not seen, or its file does not say where the object is on it.
        """
        on_board = self.board.board_from_object
        if on_board is None:
            raise RegistrationError(
                "the board file does not say where the object is: give it a section [object]"
            )
        found = locate_board(self.board, camera, grey)
        if found is None:
            raise RegistrationError(
                "the board is not seen in the reference frame: choose one that shows it sharp and with its "
                "white margin, and check its dictionary"
            )
        pose, of_pose = found.of_object(on_board)
        d = len(model.parameters)
        covariance = np.zeros((d + 6, d + 6))
        covariance[d:, d:] = of_pose
        flags = ["placed by a board: the object is taken to be undeformed in the reference frame"]
        if found.ambiguous:
            flags.append(
                "registration ambiguous: the board can be tilted the other way; show it larger or aslant"
            )
        facts = {"from": "board", "n_corners": found.n_corners, "residual_rms_px": found.rms_px}
        return Placement(model, None, State(model.default, pose), facts, tuple(flags), covariance=covariance)
