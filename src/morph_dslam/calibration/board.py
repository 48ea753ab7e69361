"""The checkerboard: its inner corners on the board and in pictures, and the pictures that show it best."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from morph_dslam.errors import CameraError
from morph_dslam.io.file_kinds import IMAGES, file_kind
from morph_dslam.sources import open_source
from morph_dslam.sources.frames import image_files, read_image
from morph_dslam.units import FACTORS

Array = NDArray[np.float64]
#: Half the side of the window in which a corner is refined, of the distance to the next corner in the image.
#: Larger ones reach the neighbour's edges, smaller ones use less of the corner's own.
REFINEMENT_WINDOW = 0.35
#: So many frames of a video are searched for the board, evenly spread over it.
MOST_SEARCHED = 120
#: So many of those where it is found are used: more add time and no accuracy.
MOST_FRAMES = 30


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


@dataclass(frozen=True)
class View:
    """The board's corners (n, 2) as pixels of the image ``name``."""

    name: str
    corners: Array


@dataclass(frozen=True)
class Views:
    """What was found: the views, the size (width, height) of the images, and how many were searched."""

    views: tuple[View, ...]
    size: tuple[int, int]
    n_searched: int


def collect_views(sources: Sequence[Path], board: Board, ignored: Path | None = None) -> Views:
    """The views in images, in a folder of images, or in a video or another recording.

    Of a recording with many views, those are kept that cover positions, distances and tilts best. The image
    ``ignored`` is passed over: a picture that an earlier calibration left in the folder.

    Raises CameraError if the board is found nowhere, or the images differ in size. Raises SourceError if an image or a
    video cannot be read.
    """
    files = [path for path in _image_files(sources) if ignored is None or path.resolve() != ignored.resolve()]
    images, total = (_read(files), len(files)) if files else _sampled(sources)
    views, size, n_searched = [], None, 0
    for name, image in tqdm(images, total=total, desc="searching the board", unit="image", disable=None):
        height, width = image.shape[:2]
        size = size or (width, height)
        if (width, height) != size:
            raise CameraError(
                f"{name} is {width}x{height} pixels, the images before it are {size[0]}x{size[1]}: "
                "calibrate with images of one size, that of the video to be tracked"
            )
        n_searched += 1
        corners = find_corners(np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), dtype=np.uint8), board)
        if corners is not None:
            views.append(View(name, corners))
    if not views or size is None:
        raise CameraError(
            f"no board of {board.columns}x{board.rows} inner corners was found in {n_searched} images: "
            "count the corners where four squares meet (a board of 10x7 squares has 9x6), and show the whole "
            "board with its white margin, sharp and evenly lit"
        )
    chosen = views if files else [views[i] for i in select_by_coverage([v.corners for v in views], board.columns, size)]
    return Views(tuple(chosen), size, n_searched)


def _image_files(sources: Sequence[Path]) -> list[Path]:
    """The image files named, or in the folder named; none if the source is a recording."""
    if len(sources) == 1 and sources[0].is_dir():
        return image_files(sources[0])
    if all(file_kind(path) in IMAGES for path in sources):
        return list(sources)
    if len(sources) > 1:
        raise CameraError(f"give images, or one folder, or one recording; {sources[0]} is not the only source")
    return []


def _read(files: Iterable[Path]) -> Iterator[tuple[str, NDArray[np.uint8]]]:
    for path in files:
        yield path.name, read_image(path, "calibration image")


def _sampled(sources: Sequence[Path]) -> tuple[Iterator[tuple[str, NDArray[np.uint8]]], int]:
    """Frames evenly spread over a recording, and how many."""
    source = open_source(sources[0])
    step = -(-len(source) // MOST_SEARCHED)
    frames = ((f"frame {frame.index}", frame.image) for count, frame in enumerate(source) if count % step == 0)
    return frames, -(-len(source) // step)


def select_by_coverage(
    corners: Sequence[Array], columns: int, size: tuple[int, int], most: int = MOST_FRAMES
) -> list[int]:
    """Which of many views to use: each one next that differs most from those chosen.

    Parameters
    ----------
    corners : (n, 2) pixels in each view, row by row.
    columns : corners in a row.
    size : of the images.

    Returns
    -------
    Indices, ascending; all where there are at most ``most``.
    """
    descriptors = np.array([_descriptor(view, columns, size) for view in corners])
    distances = np.linalg.norm(descriptors - descriptors.mean(axis=0), axis=1)
    chosen = [int(distances.argmax())]
    distances = np.full(len(descriptors), np.inf)
    while len(chosen) < min(most, len(descriptors)):
        newest = descriptors[chosen[-1]]
        distances = np.minimum(distances, np.linalg.norm(descriptors - newest, axis=1))
        distances[chosen] = -1.0
        chosen.append(int(distances.argmax()))
    return sorted(chosen)


def _descriptor(corners: Array, columns: int, size: tuple[int, int]) -> Array:
    """Where the board is and how large, in image sizes; how it is tilted, by the ratios of opposite sides."""
    a, b, c, d = corners[0], corners[columns - 1], corners[-1], corners[-columns]
    top, right, bottom, left = (np.linalg.norm(p - q) for p, q in ((a, b), (b, c), (c, d), (d, a)))
    extent = np.sqrt((top + bottom) * (left + right) / (4.0 * size[0] * size[1]))
    return np.array([*(corners.mean(axis=0) / np.array(size)), extent, np.log(top / bottom), np.log(left / right)])
