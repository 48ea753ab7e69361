"""Printed boards of square markers (ArUco, AprilTag), alone or in a chessboard: read, found in an image, printed.

A board's frame has its origin in the upper left corner of the print, x to the right and y down along the paper,
z into it.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator
from scipy.spatial.transform import Rotation

from morph_dslam.errors import RegistrationError
from morph_dslam.geometry import RigidTransform
from morph_dslam.io.sections import Section, read_sections
from morph_dslam.registration.initialization import Vector

Array = NDArray[np.float64]
#: Places on an edge, the part of it they spread over, and how far across it its brightness is looked at, as a
#: share of its length and pixels.
N_PLACES, INNER, REACH_SHARE, REACHES_PX = 15, (0.12, 0.88), 0.08, (1.5, 4.0)
ITERATIONS = 3


def refined_corners(grey: NDArray[np.uint8], markers: Array, curved: bool = False) -> Array:
    """Corners (m, 4, 2) of dark markers on white, in an image (h, w), from those of a detector.

    A corner-shaped window is drawn inwards by blur; the steepest places of edges are not. ``curved`` says that a lens
    bends straight edges: they are parabolas then.
    """
    smooth = grey.astype(np.float32)
    corners = markers.astype(np.float64)
    for _ in range(ITERATIONS):
        corners = _from_edges(smooth, corners, 2 if curved else 1)
    # A detector's corner is never further off than that: an edge that went elsewhere was not the marker's.
    kept = np.linalg.norm(corners - markers, axis=2, keepdims=True) < REACHES_PX[1]
    return np.where(kept, corners, markers)


def _from_edges(image: NDArray[np.float32], corners: Array, degree: int) -> Array:
    """The corners (m, 4, 2) where curves of a degree through the edges' steepest places meet."""
    following = np.roll(corners, -1, axis=1)
    along = following - corners
    lengths = np.linalg.norm(along, axis=2, keepdims=True)
    outwards = np.stack([along[..., 1], -along[..., 0]], axis=2) / np.maximum(lengths, 1e-9)
    centre = corners.mean(axis=1, keepdims=True)
    outwards *= np.sign(np.sum(outwards * (corners - centre), axis=2, keepdims=True))
    shares = np.linspace(*INNER, N_PLACES)
    places = corners[:, :, None] + shares[None, None, :, None] * along[:, :, None]
    reach = np.clip(REACH_SHARE * lengths, *REACHES_PX)  # (m, 4, 1)
    offsets = np.linspace(-1.0, 1.0, 17) * reach  # (m, 4, s)
    sampled = places[:, :, :, None] + offsets[:, :, None, :, None] * outwards[:, :, None, None]
    flat = sampled.reshape(len(corners) * 4, -1, 2).astype(np.float32)
    values = cv2.remap(image, flat[..., 0], flat[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    values = np.asarray(values, dtype=np.float64).reshape(sampled.shape[:-1])
    rise = np.maximum(np.diff(values, axis=3), 0.0) + 1e-6
    between = 0.5 * (offsets[:, :, 1:] + offsets[:, :, :-1])[:, :, None]
    shifts = np.sum(rise * between, axis=3) / rise.sum(axis=3)
    # How far outwards the edge is, as a polynomial of the share of its length: (m, 4, degree + 1), constant first.
    curve = shifts @ np.linalg.pinv(np.vander(shares, degree + 1, increasing=True)).T
    # The edge after a corner at its beginning, and the edge before it at its end: points and tangents.
    powers = np.arange(degree + 1)
    after = corners + curve[..., :1] * outwards, along + curve[..., 1:2] * outwards
    end = following + curve.sum(axis=2, keepdims=True) * outwards
    before = (np.roll(part, 1, axis=1) for part in (end, along + (curve @ powers)[..., None] * outwards))
    return _where_lines_meet(after, tuple(before), corners)


def _where_lines_meet(first: tuple[Array, Array], second: tuple[Array, Array], instead: Array) -> Array:
    """Where lines (m, 4, 2), each a point and a direction, meet; ``instead`` where they are nearly parallel."""
    points, directions = (np.stack(pair, axis=2) for pair in zip(first, second, strict=True))
    normals = np.stack([directions[..., 1], -directions[..., 0]], axis=-1)
    normals /= np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-9)
    right = np.sum(normals * points, axis=-1)
    cross = np.abs(np.linalg.det(normals)) > 0.05
    normals = np.where(cross[..., None, None], normals, np.eye(2))
    return np.linalg.solve(normals, np.where(cross[..., None], right, instead)[..., None])[..., 0]


Positive = Annotated[float, Field(gt=0.0, allow_inf_nan=False)]
#: Names of the dictionaries of markers, as in OpenCV without its prefix, in lower case.
DICTIONARIES = tuple(
    sorted({name[5:].lower() for name in dir(cv2.aruco) if name.startswith("DICT_")})  # type: ignore[attr-defined]
)
#: Fewer corners are not believed: one marker has four.
FEWEST_CORNERS = 4
#: A marker's side, pixels, from which on it is read well.
FEWEST_PIXELS = 20
DOTS_PER_INCH = 300
#: A side of a print is at most so long, metres: beyond it the unit was mistaken.
LARGEST_SIDE = 10.0
#: Smaller markers were meant in another unit.
LEAST_MARKER_MM = 1.0


class Place(Section):
    """Where the undeformed object's frame is on the board: origin, and turn about x, then y, then z."""

    position_mm: Vector
    rotation_deg: Vector = (0.0, 0.0, 0.0)


class BoardFile(Section):
    """A board file.

    A "grid" has ``columns`` x ``rows`` markers of ``marker_mm``, ``gap_mm`` apart; a "charuco" board has so
    many chessboard squares of ``square_mm`` with markers of ``marker_mm`` in the white ones. ``tag_corners`` says whose
    picture of a tag is upright on a grid of AprilTags: OpenCV's is turned by 180 degrees against AprilTag's and ViSP's;
    without it the poses decide.
    """

    kind: Literal["grid", "charuco"] = "grid"
    dictionary: str
    columns: int = Field(ge=1, le=50)
    rows: int = Field(ge=1, le=50)
    marker_mm: Positive
    gap_mm: Positive | None = None
    square_mm: Positive | None = None
    tag_corners: Literal["opencv", "apriltag"] | None = None
    object: Place | None = None

    @model_validator(mode="after")
    def _fits_together(self) -> BoardFile:
        if self.dictionary.lower() not in DICTIONARIES:
            raise ValueError(f"dictionary must be one of {', '.join(DICTIONARIES)}, not '{self.dictionary}'")
        if self.kind == "grid" and self.gap_mm is None:
            raise ValueError("a grid needs gap_mm, the white between its markers")
        if self.kind == "charuco" and (self.square_mm is None or self.square_mm <= self.marker_mm):
            raise ValueError("a charuco board needs square_mm, larger than marker_mm")
        if self.kind == "charuco" and min(self.columns, self.rows) < 3:
            raise ValueError("a charuco board needs 3 x 3 squares at least")
        if self.marker_mm < LEAST_MARKER_MM:
            raise ValueError(f"markers of {self.marker_mm:g} mm cannot be seen; sizes are in millimetres, not metres")
        other = "square_mm" if self.kind == "grid" else "gap_mm"
        if getattr(self, other) is not None:
            raise ValueError(f"{other} is for the other kind of board: leave it out of a {self.kind}")
        if self.tag_corners and not self.has_two_orders:
            raise ValueError("tag_corners is for grids of AprilTags: leave it out")
        pitch = self.marker_mm + (self.gap_mm or 0.0) if self.kind == "grid" else self.square_mm or 0.0
        if 1e-3 * pitch * max(self.columns, self.rows) > LARGEST_SIDE:
            raise ValueError(f"the board would be more than {LARGEST_SIDE:g} m long; sizes are in millimetres")
        return self

    @property
    def has_two_orders(self) -> bool:
        """Whether the board's tags come with their corners in one of two orders."""
        return self.kind == "grid" and self.dictionary.lower().startswith("apriltag")


@dataclass(frozen=True)
class FiducialBoard:
    """A board as its file describes it."""

    description: BoardFile

    @property
    def board_from_object(self) -> RigidTransform | None:
        """Where the undeformed object is on it, metres; None for a board that only gives the scale."""
        place = self.description.object
        if place is None:
            return None
        turn = Rotation.from_euler("xyz", place.rotation_deg, degrees=True).as_matrix()
        return RigidTransform(turn, 1e-3 * np.array(place.position_mm))

    @property
    def name(self) -> str:
        """What it is."""
        d, cells = self.description, "markers" if self.description.kind == "grid" else "squares"
        return f"board of {d.columns}x{d.rows} {cells} with markers of {d.dictionary.lower()}"

    @property
    def advice(self) -> str:
        """What to look at where it is found nowhere."""
        return (
            "compare the dictionary, columns and rows of the board file with the print, and show the board sharp, "
            f"with markers of at least {FEWEST_PIXELS} pixels"
        )

    @property
    def length(self) -> float:
        """Its longer side, metres."""
        return max(self.size)

    @property
    def held_corner(self) -> int:
        """-1: pictures show different parts of it."""
        return -1

    @property
    def has_one_orientation(self) -> bool:
        """Always: each marker differs."""
        return True

    @property
    def pitch(self) -> float:
        """From one marker or square to the next, metres."""
        d = self.description
        return 1e-3 * (d.marker_mm + (d.gap_mm or 0.0) if d.kind == "grid" else d.square_mm or 0.0)

    @property
    def size(self) -> tuple[float, float]:
        """Width and height of the print without its margin, metres."""
        d = self.description
        gap = 1e-3 * (d.gap_mm or 0.0) if d.kind == "grid" else 0.0
        return d.columns * self.pitch - gap, d.rows * self.pitch - gap

    @cached_property
    def _board(self) -> Any:
        d, aruco = self.description, cv2.aruco  # type: ignore[attr-defined]
        names = {name[5:].lower(): name for name in dir(aruco) if name.startswith("DICT_")}
        dictionary = aruco.getPredefinedDictionary(getattr(aruco, names[d.dictionary.lower()]))
        size, marker = (d.columns, d.rows), 1e-3 * d.marker_mm
        if d.kind == "grid":
            return aruco.GridBoard(size, marker, self.pitch - marker, dictionary)
        return aruco.CharucoBoard(size, self.pitch, marker, dictionary)

    def find(self, grey: NDArray[np.uint8], distorted: bool = False) -> tuple[Array, Array]:
        """Corners of the board (k, 3), board frame, metres, and their pixels (k, 2) in an image (h, w).

        ``distorted`` says that the image is as the lens made it.
        """
        aruco, board = cv2.aruco, self._board  # type: ignore[attr-defined]
        if self.description.kind == "charuco":
            corners, ids, _, _ = aruco.CharucoDetector(board).detectBoard(grey)
        else:
            detector = aruco.ArucoDetector(board.getDictionary(), aruco.DetectorParameters())
            corners, ids, _ = detector.detectMarkers(grey)
        if ids is None or not len(ids):
            return np.empty((0, 3)), np.empty((0, 2))
        if self.description.kind == "grid":
            found = np.array(corners, dtype=np.float64).reshape(-1, 4, 2)
            corners = [marker[None].astype(np.float32) for marker in refined_corners(grey, found, distorted)]
        points, pixels = board.matchImagePoints(corners, ids)
        if points is None or not len(points):
            return np.empty((0, 3)), np.empty((0, 2))
        return (
            np.asarray(points, dtype=np.float64).reshape(-1, 3),
            np.asarray(pixels, dtype=np.float64).reshape(-1, 2),
        )

    def orders(self, points: Array) -> list[Array]:
        """The corners (k, 3) that `find` gives, as OpenCV orders them, for each order that the tags may have."""
        if not self.description.has_two_orders:
            return [points]
        turned = np.roll(points.reshape(-1, 4, 3), 2, axis=1).reshape(-1, 3)
        return {"opencv": [points], "apriltag": [turned], None: [points, turned]}[self.description.tag_corners]

    def image(self, pixels_per_metre: float) -> NDArray[np.uint8]:
        """The print (h, w) without a margin, 0 black: each pixel shows what is at its centre."""
        d, board, aruco = self.description, self._board, cv2.aruco  # type: ignore[attr-defined]
        counts = [max(1, round(side * pixels_per_metre)) for side in self.size]
        x, y = ((np.arange(n) + 0.5) * side / n for n, side in zip(counts, self.size, strict=True))
        image = np.full((len(y), len(x)), 255, dtype=np.uint8)
        if d.kind == "charuco":
            across, down = ((at // self.pitch % 2).astype(np.uint8) for at in (x, y))
            image = 255 * (down[:, None] ^ across)
        # OpenCV's own picture has markers of whole pixels a cell, at rounded places, and none of some sizes.
        dictionary = board.getDictionary()
        cells = dictionary.markerSize + 2
        for corners, number in zip(board.getObjPoints(), np.ravel(board.getIds()).tolist(), strict=True):
            left, top = np.asarray(corners, dtype=float)[0, :2]
            scale = 1e3 * cells / d.marker_mm
            columns, rows = (np.floor(scale * (at - first)).astype(int) for at, first in ((x, left), (y, top)))
            across, down = ((k >= 0) & (k < cells) for k in (columns, rows))
            bits = aruco.generateImageMarker(dictionary, number, cells)
            image[np.ix_(down, across)] = bits[np.ix_(rows[down], columns[across])]
        return image


def load_board(path: str | Path) -> FiducialBoard:
    """Read a board file."""
    path = Path(path)
    description = read_sections(path, "board file", BoardFile, RegistrationError)
    board = FiducialBoard(description)
    try:
        _ = board._board
    except cv2.error as error:
        raise RegistrationError(
            f"{path}: the dictionary '{description.dictionary}' has too few markers for "
            f"{description.columns} x {description.rows}"
        ) from error
    return board


def print_board(board: FiducialBoard, path: str | Path) -> None:
    """Write the board in its true size as a PNG or PDF file, with a white margin and a line to measure."""
    path = Path(path)
    from matplotlib.figure import Figure

    inch, margin = 0.0254, 0.015
    width, height = board.size
    total = (width + 2 * margin, height + 2 * margin + 0.01)
    figure = Figure(figsize=(total[0] / inch, total[1] / inch))
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set_xlim(0.0, total[0])
    axes.set_ylim(total[1], 0.0)
    axes.axis("off")
    extent = (margin, margin + width, margin + height, margin)
    axes.imshow(board.image(2.0 * DOTS_PER_INCH / inch), cmap="gray", extent=extent, interpolation="nearest")
    axes.set_aspect("auto")
    length = 0.1 if width > 0.1 else 0.01 * max(1, int(width / 0.01))
    line = margin + height + 0.01
    axes.plot([margin, margin + length], [line, line], "k|-", linewidth=0.6, markersize=8)
    axes.text(margin + length + 0.003, line, f"{1e3 * length:.0f} mm", fontsize=8, va="center")
    if path.suffix.lower() not in (".png", ".pdf"):
        raise RegistrationError(f"cannot write the board to {path}: give it the ending .png or .pdf")
    try:
        figure.savefig(path, dpi=DOTS_PER_INCH)
    except (OSError, ValueError) as error:
        raise RegistrationError(f"cannot write the board to {path}: {error}") from error
