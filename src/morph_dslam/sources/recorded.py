"""Frames recorded as image files, one by one, in whatever layout of folders."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from morph_dslam.errors import SourceError
from morph_dslam.sources.frames import SUFFIXES, DepthScale, Frame, check_range, read_depth, read_image


@dataclass(frozen=True)
class ImageRecord:
    """Where one frame is: its number, its time in seconds, and the files of its images."""

    index: int
    timestamp: float
    image: Path
    depth: Path | None = None
    right: Path | None = None


class RecordedFrames:
    """Image files as a `FrameSource`.

    Parameters
    ----------
    folder : the recording. records : its frames, by ascending number.
    first, last : the range of frame numbers wanted, both included; open ends by default.
    depth_scale : how depth is stored. fps : frames a second; from the timestamps where it is not given.

    Raises
    ------
    SourceError
        If there are no records, or ``first`` or ``last`` is not among them.
    """

    def __init__(
        self,
        folder: Path,
        records: Sequence[ImageRecord],
        *,
        first: int | None = None,
        last: int | None = None,
        depth_scale: DepthScale | None = None,
        fps: float | None = None,
    ) -> None:
        if not records:
            raise SourceError(f"{folder} holds no frames")
        numbers = [record.index for record in records]
        low, high = check_range(folder, range(numbers[0], numbers[-1] + 1), first, last)
        for wanted in (low, high):
            if wanted not in numbers:
                raise SourceError(f"frame {wanted} is missing from {folder}")
        self.name = str(folder)
        self.fps = fps or _frame_rate([record.timestamp for record in records])
        self._records = [record for record in records if low <= record.index <= high]
        self._depth_scale = depth_scale

    @property
    def has_registered_depth(self) -> bool:
        """Whether frames come with depth that belongs to their pixels."""
        scale = self._depth_scale
        return scale is not None and scale.registered and any(r.depth is not None for r in self._records)

    def __len__(self) -> int:
        return len(self._records)

    def __iter__(self) -> Iterator[Frame]:
        size = None
        for record in self._records:
            what = f"frame {record.index}"
            image = read_image(record.image, what)
            size = size or image.shape[:2]
            _check_size(image, size, record.image, what)
            depth, right = None, None
            if record.depth is not None and self._depth_scale is not None:
                depth = read_depth(record.depth, what, self._depth_scale)
                _check_size(depth, size, record.depth, what)
            if record.right is not None:
                right = read_image(record.right, what)
                _check_size(right, size, record.right, what)
            yield Frame(record.index, record.timestamp, image, depth, right)


def _frame_rate(timestamps: list[float]) -> float:
    """Frames a second, from the usual time between two; one where there is nothing to tell it."""
    gaps = np.diff(timestamps)
    return float(1.0 / np.median(gaps)) if len(gaps) and np.median(gaps) > 0.0 else 1.0


def _check_size(image: NDArray, size: tuple[int, int], path: Path, what: str) -> None:
    if image.shape[:2] != size:
        raise SourceError(
            f"{what}: {path} is {image.shape[1]}x{image.shape[0]} pixels, the frames before it are {size[1]}x{size[0]}"
        )


# Recordings in the layout of the EuRoC benchmark (Burri et al. 2016).
# `mav0/cam0/data.csv` lists "timestamp [ns],file" of the images in `mav0/cam0/data`, `mav0/cam1` those of
# the right camera.


def _base(folder: Path) -> Path | None:
    """The folder that holds cam0, None if this is another layout."""
    candidates = (folder / "mav0", folder)
    return next((base for base in candidates if (base / "cam0" / "data.csv").is_file()), None)


def is_euroc(folder: Path) -> bool:
    """Whether a folder, or `mav0` in it, has this layout."""
    return _base(folder) is not None


def euroc_recording(folder: Path, first: int | None = None, last: int | None = None) -> RecordedFrames:
    """The images of cam0, with those of cam1 that have the same timestamp as right images; from 0.

    Raises
    ------
    SourceError
        If a list is malformed, or the range is not in it.
    """
    base = _base(folder)
    assert base is not None
    left = _read_euroc_list(base / "cam0")
    right = _read_euroc_list(base / "cam1") if (base / "cam1" / "data.csv").is_file() else {}
    records = [
        ImageRecord(index, nanoseconds / 1e9, path, right=right.get(nanoseconds))
        for index, (nanoseconds, path) in enumerate(sorted(left.items()))
    ]
    return RecordedFrames(folder, records, first=first, last=last)


def _read_euroc_list(camera: Path) -> dict[int, Path]:
    """The images of a camera by their timestamps in nanoseconds, which float64 seconds would round."""
    entries = {}
    path = camera / "data.csv"
    for number, line in enumerate(path.read_text().splitlines(), start=1):
        if not line.strip() or line.startswith("#"):
            continue
        words = [word.strip() for word in line.split(",")]
        if len(words) != 2 or not words[0].isdecimal():
            raise SourceError(f"{path}, line {number}: '{line}' is not a timestamp in nanoseconds and a file")
        entries[int(words[0])] = camera / "data" / words[1]
    return entries


# Recordings in the layout of 7-Scenes (Shotton et al. 2013): `frame-000000.color.png`, `.depth.png`.


SEVEN_SCENES_DEPTH = DepthScale(values_per_metre=1000.0, unknown=(0, 65535), registered=False)

#: The recordings carry no timestamps.
FPS = 30.0

_COLOUR = re.compile(r"frame-(\d+)\.color\.(png|jpg)")


def is_seven_scenes(folder: Path) -> bool:
    """Whether a folder has this layout."""
    return any(_COLOUR.fullmatch(path.name) for path in folder.glob("frame-*.color.*"))


def seven_scenes_recording(folder: Path, first: int | None = None, last: int | None = None) -> RecordedFrames:
    """The colour images with their depth where it is there, by the numbers in their names.

    The depth camera is not registered to the colour camera in these recordings.
    """
    records = []
    for path in sorted(folder.glob("frame-*.color.*")):
        matched = _COLOUR.fullmatch(path.name)
        if matched:
            number, depth = int(matched[1]), folder / f"frame-{matched[1]}.depth.png"
            records.append(ImageRecord(number, number / FPS, path, depth=depth if depth.is_file() else None))
    return RecordedFrames(folder, records, first=first, last=last, depth_scale=SEVEN_SCENES_DEPTH, fps=FPS)


# Recordings in the layout of the TUM RGB-D benchmark (Sturm et al. 2012).
# `rgb.txt` and `depth.txt` list "timestamp file" of the colour and the depth images.


TUM_DEPTH = DepthScale(values_per_metre=5000.0)

#: Colour and depth are not taken at the same instant; these belong together, seconds.
MOST_TIME_DIFFERENCE = 0.02


def is_tum(folder: Path) -> bool:
    """Whether a folder has this layout."""
    return (folder / "rgb.txt").is_file()


def tum_recording(folder: Path, first: int | None = None, last: int | None = None) -> RecordedFrames:
    """The colour images with the depth taken closest to them; numbered from 0.

    Raises
    ------
    SourceError
        If a list is malformed, or the range is not in it.
    """
    colour = _read_tum_list(folder / "rgb.txt")
    depths = _read_tum_list(folder / "depth.txt") if (folder / "depth.txt").is_file() else []
    depth_times = np.array([timestamp for timestamp, _ in depths])
    records = []
    for index, (timestamp, path) in enumerate(colour):
        depth = None
        if depths:
            nearest = int(np.abs(depth_times - timestamp).argmin())
            if abs(depth_times[nearest] - timestamp) <= MOST_TIME_DIFFERENCE:
                depth = depths[nearest][1]
        records.append(ImageRecord(index, timestamp, path, depth=depth))
    return RecordedFrames(folder, records, first=first, last=last, depth_scale=TUM_DEPTH)


def _read_tum_list(path: Path) -> list[tuple[float, Path]]:
    """Timestamps and files of a list, in the order of time."""
    entries = []
    for number, line in enumerate(path.read_text().splitlines(), start=1):
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        try:
            timestamp = float(words[0])
        except ValueError:
            timestamp = np.nan
        if len(words) != 2 or not np.isfinite(timestamp):
            raise SourceError(f"{path}, line {number}: '{line}' is not a timestamp and a file")
        entries.append((timestamp, path.parent / words[1]))
    return sorted(entries)


# A folder of numbered images.


#: A folder says nothing of its frame rate; timestamps assume the usual one.
ASSUMED_FPS = 30.0


def numbered_images(folder: Path) -> dict[int, Path]:
    """The images of a folder by the last number in their names, in its order.

    Raises
    ------
    SourceError
        If a name has no number, two have the same, or there is no image.
    """
    images: dict[int, Path] = {}
    for path in sorted(folder.iterdir()):
        if path.suffix.lower() not in SUFFIXES:
            continue
        numbers = re.findall(r"\d+", path.stem)
        if not numbers:
            raise SourceError(f"{path} has no number in its name, which gives the frames their order: rename it")
        number = int(numbers[-1])
        if number in images:
            raise SourceError(
                f"{folder} has two images for frame {number}, {images[number].name} and {path.name}: "
                "keep one sequence in a folder"
            )
        images[number] = path
    if not images:
        raise SourceError(f"{folder} holds no images ({', '.join(SUFFIXES)})")
    return dict(sorted(images.items()))


def image_folder(folder: Path, first: int | None = None, last: int | None = None) -> RecordedFrames:
    """A folder of images as a source; gaps in the numbering are kept as they are."""
    records = [ImageRecord(number, number / ASSUMED_FPS, path) for number, path in numbered_images(folder).items()]
    return RecordedFrames(folder, records, first=first, last=last, fps=ASSUMED_FPS)
