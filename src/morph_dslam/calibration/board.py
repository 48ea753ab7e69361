"""Boards that a camera is calibrated with, and the checkerboard: its inner corners on the board and in pictures."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from morph_dslam.errors import CameraError
from morph_dslam.units import FACTORS

Array = NDArray[np.float64]
#: Half the side of the window in which a corner is refined, of the distance to the next corner in the image.
#: Larger ones reach the neighbour's edges, smaller ones use less of the corner's own.
REFINEMENT_WINDOW = 0.35


class CalibrationBoard(Protocol):
    """A flat board with corners: a checkerboard, or one of markers, of which a part is enough."""

    @property
    def name(self) -> str:
        """What it is."""
        ...

    @property
    def advice(self) -> str:
        """What to look at where it is found nowhere."""
        ...

    @property
    def length(self) -> float:
        """From the first corner to the last along its longer side, metres."""
        ...

    @property
    def held_corner(self) -> int:
        """The corner that, with the first and the last one, holds place and scale where its shape is solved for.

        -1 where it cannot be: pictures may show different corners, or have them in another order.
        """
        ...

    @property
    def has_one_orientation(self) -> bool:
        """Whether it cannot be mistaken for itself turned by half a turn."""
        ...

    def find(self, grey: NDArray[np.uint8], distorted: bool = False) -> tuple[Array, Array]:
        """Corners of the board (k, 3), board frame, metres, and their pixels (k, 2) in an image (h, w); k may be 0.

        ``distorted`` says that the image is as the lens made it.
        """
        ...

    def orders(self, points: Array) -> list[Array]:
        """The corners (k, 3) that `find` gives, for each order in which they may be."""
        ...


@dataclass(frozen=True)
class Board:
    """A checkerboard of ``columns`` x ``rows`` inner corners and squares with sides of ``square`` metres."""

    columns: int
    rows: int
    square: float

    @classmethod
    def parse(cls, text: str, square: str) -> Board:
        """The board of "9x6" inner corners and squares of "25 mm".

        Raises CameraError if one of them is not of that form, or the board is too small to be recognised.
        """
        size = re.fullmatch(r"(\d+)\s*[xX×]\s*(\d+)", text.strip())
        if size is None:
            raise CameraError(f"'{text}' is no board: give its inner corners, 9x6 say")
        columns, rows = int(size[1]), int(size[2])
        if min(columns, rows) < 3:
            raise CameraError(f"a board of {columns}x{rows} inner corners is too small: it needs 3x3 at least")
        length = re.fullmatch(r"([0-9.eE+-]+)\s*([a-z]+)", square.strip())
        units = FACTORS["length"]
        try:
            side = float(length[1]) * units[length[2]]  # type: ignore[index]
        except (TypeError, ValueError, KeyError):
            raise CameraError(f"'{square}' is no length: give a number and one of {', '.join(units)}") from None
        if not 0.0 < side < np.inf:
            raise CameraError(f"a square of {square} is impossible: measure the side of one square")
        return cls(columns, rows, side)

    @property
    def points(self) -> Array:
        """The inner corners (columns * rows, 3) row by row in the plane z = 0, metres."""
        row, column = np.mgrid[: self.rows, : self.columns]
        return self.square * np.column_stack([column.ravel(), row.ravel(), np.zeros(row.size)])

    @property
    def name(self) -> str:
        """What it is."""
        return f"board of {self.columns}x{self.rows} inner corners"

    @property
    def advice(self) -> str:
        """What to look at where it is found nowhere."""
        return (
            "count the corners where four squares meet (a board of 10x7 squares has 9x6), and show the whole "
            "board with its white margin, sharp and evenly lit"
        )

    @property
    def length(self) -> float:
        """From the first corner to the last along its longer side, metres."""
        return self.square * (max(self.columns, self.rows) - 1)

    @property
    def held_corner(self) -> int:
        """The last corner of the first row; -1 for a board that may be turned by half a turn."""
        return self.columns - 1 if self.has_one_orientation else -1

    def find(self, grey: NDArray[np.uint8], distorted: bool = False) -> tuple[Array, Array]:
        """All corners (n, 3), metres, and their pixels (n, 2) in an image (h, w); none unless the whole board is seen.

        It makes no difference whether the image is ``distorted``.
        """
        corners = find_corners(grey, self)
        return (np.empty((0, 3)), np.empty((0, 2))) if corners is None else (self.points, corners)

    def orders(self, points: Array) -> list[Array]:
        """The corners as they are."""
        return [points]

    @property
    def has_one_orientation(self) -> bool:
        """Whether its colours tell the board from itself turned by half a turn."""
        return (self.columns + self.rows) % 2 == 1


def find_corners(grey: NDArray[np.uint8], board: Board) -> Array | None:
    """The pixels (n, 2) of the board's corners in an image (h, w), in the order of `Board.points`.

    None where the whole board is not seen. A board whose colours allow it (`Board.has_one_orientation`)
    has the same corner first in every picture.
    """
    flags = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_ACCURACY | cv2.CALIB_CB_EXHAUSTIVE
    found, corners = cv2.findChessboardCornersSB(grey, (board.columns, board.rows), flags=flags)
    if not found or corners is None:
        return None
    corners = np.asarray(corners, dtype=np.float32).reshape(-1, 2)
    if board.has_one_orientation and _first_square_is_bright(grey, corners, board):
        corners = corners[::-1]
    return _refined(grey, np.ascontiguousarray(corners), board)


def _first_square_is_bright(grey: NDArray[np.uint8], corners: NDArray, board: Board) -> bool:
    """Whether the square at the first corner is brighter than its neighbour."""
    grid = corners.reshape(board.rows, board.columns, 2)
    quads = [grid[:2, i : i + 2].reshape(4, 2) for i in (0, 1)]
    levels = []
    for quad in quads:
        centre = quad.mean(axis=0)
        # The middle of the square, away from its blurred edges.
        inner = (centre + 0.4 * (quad - centre))[[0, 1, 3, 2]]
        mask = np.zeros(grey.shape, dtype=np.uint8)
        cv2.fillConvexPoly(mask, np.rint(inner).astype(np.int32), 255)
        levels.append(cv2.mean(grey, mask)[0])
    return levels[0] > levels[1]


def _refined(grey: NDArray[np.uint8], corners: NDArray[np.float32], board: Board) -> Array:
    """Corners at the saddle points of the image (Foerstner and Guelch 1987)."""
    grid = corners.reshape(board.rows, board.columns, 2)
    spacing = min(np.linalg.norm(np.diff(grid, axis=axis), axis=2).min() for axis in (0, 1))
    half = max(2, int(REFINEMENT_WINDOW * spacing))
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-4)
    refined = cv2.cornerSubPix(grey, corners.reshape(-1, 1, 2).copy(), (half, half), (-1, -1), criteria)
    return np.asarray(refined, dtype=np.float64).reshape(-1, 2)
