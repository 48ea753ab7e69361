"""Views of the board: found in images or in the frames of a video, and chosen to cover the image."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from morph_dslam.calibration.board import Board, find_corners
from morph_dslam.errors import CameraError
from morph_dslam.sources import open_source
from morph_dslam.sources.images import SUFFIXES, read_image

Array = NDArray[np.float64]

#: So many frames of a video are searched for the board, evenly spread over it.
MOST_SEARCHED = 120

#: So many of those where it is found are used: more add time and no accuracy.
MOST_FRAMES = 30


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

    Raises
    ------
    CameraError
        If the board is found nowhere, or the images differ in size.
    SourceError
        If an image or a video cannot be read.
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
    chosen = (
        views
        if files
        else [views[i] for i in select_by_coverage([v.corners for v in views], board.columns, size)]
    )
    return Views(tuple(chosen), size, n_searched)


def _image_files(sources: Sequence[Path]) -> list[Path]:
    """The image files named, or in the folder named; none if the source is a recording."""
    if len(sources) == 1 and sources[0].is_dir():
        return sorted(path for path in sources[0].iterdir() if path.suffix.lower() in SUFFIXES)
    if all(path.suffix.lower() in SUFFIXES for path in sources):
        return list(sources)
    if len(sources) > 1:
        raise CameraError(
            f"give images, or one folder, or one recording; {sources[0]} is not the only source"
        )
    return []


def _read(files: Iterable[Path]) -> Iterator[tuple[str, NDArray[np.uint8]]]:
    for path in files:
        yield path.name, read_image(path, "calibration image")


def _sampled(sources: Sequence[Path]) -> tuple[Iterator[tuple[str, NDArray[np.uint8]]], int]:
    """Frames evenly spread over a recording, and how many."""
    source = open_source(sources[0])
    step = -(-len(source) // MOST_SEARCHED)
    frames = (
        (f"frame {frame.index}", frame.image) for count, frame in enumerate(source) if count % step == 0
    )
    return frames, -(-len(source) // step)


def select_by_coverage(
    corners: Sequence[Array], columns: int, size: tuple[int, int], most: int = MOST_FRAMES
) -> list[int]:
    """Which of many views to use: each one next that differs most from those chosen.

    Parameters
    ----------
    corners : (n, 2) pixels in each view, row by row. columns : corners in a row. size : of the images.

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
    return np.array(
        [*(corners.mean(axis=0) / np.array(size)), extent, np.log(top / bottom), np.log(left / right)]
    )
