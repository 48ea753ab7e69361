"""Views of a board in pictures or a recording, and those that show it best."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from morph_dslam.calibration.board import CalibrationBoard
from morph_dslam.errors import CameraError
from morph_dslam.io.file_kinds import IMAGES, file_kind
from morph_dslam.sources import open_source
from morph_dslam.sources.frames import image_files, read_image, turned_deg

Array = NDArray[np.float64]
#: So many frames of a video are searched for the board, evenly spread over it.
MOST_SEARCHED = 120
#: So many of those where it is found are used: more add time and no accuracy.
MOST_FRAMES = 30
#: A part of a board counts from so many corners on, which spread across it by this share of their length.
FEWEST_CORNERS, LEAST_SPREAD = 8, 0.05


@dataclass(frozen=True)
class View:
    """The board in an image.

    Attributes
    ----------
    name : of the image.
    points : (n, 3) corners that were seen, board frame, metres.
    corners : (n, 2) their pixels.
    """

    name: str
    points: Array
    corners: Array

    @property
    def number(self) -> int | None:
        """Of the frame: the last number in its name, 12 of right_012.png."""
        digits = re.findall(r"\d+", Path(self.name).stem)
        return int(digits[-1]) if digits else None


@dataclass(frozen=True)
class Views:
    """What was found: the views, the size (width, height) of the images, and how many were searched."""

    views: tuple[View, ...]
    size: tuple[int, int]
    n_searched: int


def collect_views(sources: Sequence[Path], board: CalibrationBoard, ignored: Path | None = None) -> Views:
    """The views in images, in a folder of images, or in a video or another recording.

    Of a recording with many views, those are kept that cover positions, distances and tilts best. The image
    ``ignored`` is passed over: a picture that an earlier calibration left in the folder.

    Raises CameraError if the board is found nowhere, or the images differ in size. Raises SourceError if an image or a
    video cannot be read.
    """
    found = find_views(sources, board, ignored)
    return found if _image_files(sources) else best_views(found)


def find_views(
    sources: Sequence[Path], board: CalibrationBoard, ignored: Path | None = None, step: int | None = None
) -> Views:
    """All views in images, or in every ``step``-th frame of a recording; the rest as `collect_views`."""
    files = [path for path in _image_files(sources) if ignored is None or path.resolve() != ignored.resolve()]
    images, total = (_read(files), len(files)) if files else _sampled(sources[0], step)
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
        grey = np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), dtype=np.uint8)
        points, corners = board.find(grey, distorted=True)
        if _determine_a_plane(points):
            views.append(View(name, points, corners))
    if not views or size is None:
        raise CameraError(f"no {board.name} was found in {n_searched} images: {board.advice}")
    return Views(tuple(_in_their_order(views, board)), size, n_searched)


def best_views(found: Views) -> Views:
    """The views among many that `select_by_coverage` chooses."""
    return replace(found, views=tuple(found.views[i] for i in select_by_coverage(found.views, found.size)))


def _determine_a_plane(points: Array) -> bool:
    """Whether corners (n, 3) are enough, and not all on one line."""
    if len(points) < FEWEST_CORNERS:
        return False
    spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return bool(spread[1] > LEAST_SPREAD * spread[0])


def _in_their_order(views: list[View], board: CalibrationBoard) -> list[View]:
    """The views with their corners in the order that a plane's pictures agree with best, one for all of them."""
    orders = list(zip(*(board.orders(view.points) for view in views), strict=True))
    if len(orders) == 1:
        return views
    errors = [sum(_off_plane(points, view.corners) for points, view in zip(o, views, strict=True)) for o in orders]
    best = orders[int(np.argmin(errors))]
    return [replace(view, points=points) for view, points in zip(views, best, strict=True)]


def _off_plane(points: Array, corners: Array) -> float:
    """Mean distance of the corners from the picture of a plane, pixels."""
    plane, _ = cv2.findHomography(points[:, :2], corners)
    projected = cv2.perspectiveTransform(points[None, :, :2], plane)[0]
    return float(np.linalg.norm(projected - corners, axis=1).mean())


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
    """Images by name; CameraError if some are turned to be shown and others not: a camera has one principal point."""
    turns: dict[int, str] = {}
    for path in files:
        turns.setdefault(turned_deg(path, "calibration image"), path.name)
        if len(turns) > 1:
            (one, first), (other, second) = turns.items()
            raise CameraError(
                f"{first} is marked to be shown turned by {one} degrees and {second} by {other} (EXIF): give pictures "
                "for which the camera was held alike"
            )
        yield path.name, read_image(path, "calibration image")


def sampling_step(sources: Sequence[Path]) -> int:
    """Of a recording, every so many frames are searched; 1 of images."""
    return 1 if _image_files(sources) else -(-len(open_source(sources[0])) // MOST_SEARCHED)


def _sampled(recording: Path, step: int | None) -> tuple[Iterator[tuple[str, NDArray[np.uint8]]], int]:
    """Frames evenly spread over a recording, and how many."""
    source = open_source(recording)
    step = step or -(-len(source) // MOST_SEARCHED)
    frames = ((f"frame {frame.index}", frame.image) for count, frame in enumerate(source) if count % step == 0)
    return frames, -(-len(source) // step)


def select_by_coverage(views: Sequence[View], size: tuple[int, int], most: int = MOST_FRAMES) -> list[int]:
    """Which of many views to use: each one next that differs most from those chosen.

    Parameters
    ----------
    views : of the board.
    size : of the images.
    most : so many are chosen.

    Returns
    -------
    Indices, ascending; all where there are at most ``most``.
    """
    descriptors = np.array([_descriptor(view, size) for view in views])
    distances = np.linalg.norm(descriptors - descriptors.mean(axis=0), axis=1)
    chosen = [int(distances.argmax())]
    distances = np.full(len(descriptors), np.inf)
    while len(chosen) < min(most, len(descriptors)):
        newest = descriptors[chosen[-1]]
        distances = np.minimum(distances, np.linalg.norm(descriptors - newest, axis=1))
        distances[chosen] = -1.0
        chosen.append(int(distances.argmax()))
    return sorted(chosen)


def _descriptor(view: View, size: tuple[int, int]) -> Array:
    """Where the part seen is and how large, in image sizes; how it is tilted, by the ratios of opposite sides."""
    (left, top), (right, bottom) = view.points[:, :2].min(axis=0), view.points[:, :2].max(axis=0)
    plane, _ = cv2.findHomography(view.points[:, :2], view.corners)
    outline = np.array([[[left, top], [right, top], [right, bottom], [left, bottom]]])
    a, b, c, d = cv2.perspectiveTransform(outline, plane)[0]
    above, beside, below, before = (np.linalg.norm(p - q) for p, q in ((a, b), (b, c), (c, d), (d, a)))
    extent = np.sqrt((above + below) * (before + beside) / (4.0 * size[0] * size[1]))
    middle = view.corners.mean(axis=0) / np.array(size)
    return np.array([*middle, extent, np.log(above / below), np.log(before / beside)])
