"""Recordings of image files: folders of numbered images, and the layouts of TUM RGB-D, EuRoC and 7-Scenes."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from copy import copy
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from decimal import Decimal
from pathlib import Path

import numpy as np

from morph_dslam.errors import SourceError
from morph_dslam.io.file_kinds import IMAGES, named_kind
from morph_dslam.io.text import read_text
from morph_dslam.sources.frames import (
    ASSUMED_FPS,
    DepthScale,
    Frame,
    check_range,
    check_size,
    image_files,
    read_depth,
    read_image,
    turned_deg,
    usual_rate,
)

TUM_DEPTH = DepthScale(values_per_metre=5000.0)
#: What to correct where lengths that come from depth images are not metres.
DEPTH_SCALE = (
    f"the scale of the depth images ({TUM_DEPTH.values_per_metre:g} values a metre in folders of TUM RGB-D, elsewhere "
    "often 1000)"
)
#: Colour and depth are not taken at the same instant; these belong together, seconds.
MOST_TIME_DIFFERENCE = 0.02
SEVEN_SCENES_DEPTH = DepthScale(values_per_metre=1000.0, registered=False)
#: 7-Scenes carry no timestamps.
SEVEN_SCENES_FPS = 30.0
#: Names of images that are times: seconds with a fraction as of TUM RGB-D, or whole parts of a second, nanoseconds as
#: of EuRoC. Numbers of frames have fewer digits.
_SECONDS, _PARTS = re.compile(r"\d+\.\d+", re.ASCII), re.compile(r"\d{13,}", re.ASCII)
#: Parts a second that whole numbers may count: milliseconds, microseconds or nanoseconds.
_UNITS = (10**3, 10**6, 10**9)
#: Names that are dates, as 20240131123059800: year, month, day, hour, minute, second, and parts of a second, which some
#: programs leave out where they are zero.
_DATE, _DATE_FORMAT = re.compile(r"((?:19|20)\d{12})(?:\.?(\d{3}|\d{6}))?", re.ASCII), "%Y%m%d%H%M%S"
_COLOUR = re.compile(r"frame-(\d+)\.color\.(png|jpg)")


@dataclass(frozen=True)
class _ImageRecord:
    """Where one frame is: its number, its time in seconds, and the files of its images."""

    index: int
    timestamp: float
    image: Path
    depth: Path | None = None
    right: Path | None = None


def depth_on_another_clock(source: object, name: object) -> str | None:
    """What to mend where none of a source's depth images belongs to a frame by its time; None of all other sources.

    Parameters
    ----------
    source : of frames; ``depth_off_s`` says how far the nearest is, seconds.
    name : by which messages call it.
    """
    off = getattr(source, "depth_off_s", None)
    if off is None:
        return None
    return (
        f"no depth image of {name} was taken within {1e3 * MOST_TIME_DIFFERENCE:g} ms of a frame, the nearest "
        f"{off:.3g} s from one: put rgb.txt and depth.txt on one clock"
    )


class RecordedFrames:
    """Image files as a `FrameSource`.

    Parameters
    ----------
    folder : of the recording
    records : its frames, by ascending number
    first, last : range of frame numbers, both included; open ends by default
    depth_scale : how depth is stored
    fps : frames per second; from the timestamps where it is not given

    Attributes
    ----------
    has_assumed_times : whether nothing tells the times, which then go by numbers of frames and `ASSUMED_FPS`.
    depth_off_s : how far the nearest depth image is from any frame, seconds, where none belongs to one by its time.
    """

    has_assumed_times = False
    depth_off_s: float | None = None

    def __init__(
        self,
        folder: Path,
        records: Sequence[_ImageRecord],
        first: int | None = None,
        last: int | None = None,
        *,
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
        self.fps = fps or usual_rate([record.timestamp for record in records])
        self._records = [record for record in records if low <= record.index <= high]
        self._depth_scale = depth_scale

    @property
    def has_depth(self) -> bool:
        """Whether frames come with depth, though it may not belong to their pixels."""
        return self._depth_scale is not None and any(record.depth is not None for record in self._records)

    @property
    def has_registered_depth(self) -> bool:
        """Whether frames come with depth that belongs to their pixels."""
        return self._depth_scale is not None and self._depth_scale.registered and self.has_depth

    @property
    def turned_deg(self) -> int:
        """By how many degrees the first image is turned to be shown: 0, 90 to either side, or 180."""
        first = self._records[0]
        return turned_deg(first.image, f"frame {first.index}")

    def with_depth_per_metre(self, values: float) -> RecordedFrames:
        """The same frames, whose depth images have so many values a metre.

        Raises SourceError if they have none that belong to the colour pixels, or this is no number above zero.
        """
        if not values > 0.0 or not np.isfinite(values):
            raise SourceError(f"depth images cannot have {values:g} values a metre: give 1000 for millimetres")
        if doubt := depth_on_another_clock(self, self.name):
            raise SourceError(doubt)
        if self._depth_scale is None or not self.has_registered_depth:
            raise SourceError(
                f"{self.name} has no depth images that belong to the colour pixels: leave --depth-per-metre out"
            )
        other = copy(self)
        other._depth_scale = replace(self._depth_scale, values_per_metre=values)
        return other

    def with_rate(self, fps: float) -> RecordedFrames:
        """The same frames, so many a second. Raises SourceError if they have times of their own."""
        if not fps > 0.0 or not np.isfinite(fps):
            raise SourceError(f"fps is {fps}: give the number of frames a second")
        if not self.has_assumed_times:
            raise SourceError(f"{self.name} says the times of its frames itself: leave --fps out")
        other = copy(self)
        other.fps, other.has_assumed_times = fps, False
        other._records = [replace(record, timestamp=record.index / fps) for record in self._records]
        return other

    @property
    def numbers(self) -> list[int]:
        """Numbers of the frames, ascending; some may be missing."""
        return [record.index for record in self._records]

    def __len__(self) -> int:
        return len(self._records)

    def __iter__(self) -> Iterator[Frame]:
        size = None
        for record in self._records:
            what = f"frame {record.index}"
            image = read_image(record.image, what)
            size = check_size(image, size, f"{what}: {record.image}")
            depth, right = None, None
            if record.depth is not None and self._depth_scale is not None:
                depth = read_depth(record.depth, what, self._depth_scale)
                check_size(depth, size, f"{what}: {record.depth}")
            if record.right is not None:
                right = read_image(record.right, what)
                check_size(right, size, f"{what}: {record.right}")
            yield Frame(record.index, record.timestamp, image, depth, right)


def numbered_images(folder: Path) -> dict[int, Path]:
    """The images of a folder by the last number in their names, in its order.

    Raises SourceError if a name has no number, two have the same, or there is no image.
    """
    images: dict[int, Path] = {}
    for path in image_files(folder):
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
        raise SourceError(f"{folder} holds no images ({', '.join(IMAGES)}){_hint(folder)}")
    return dict(sorted(images.items()))


def _hint(folder: Path) -> str:
    """What to give instead of a folder without images, for the end of a sentence: one of its subfolders, if it has."""
    folders = sorted(path for path in folder.iterdir() if path.is_dir())
    counts = {path: sum(named_kind(file) in IMAGES for file in path.iterdir()) for path in folders}
    inner = [path for path in folders if counts[path]]
    if not inner:
        return ""
    found = ", ".join(f"{path.name} ({counts[path]} images)" for path in inner)
    colour = next((path for path in inner if "depth" not in path.name.lower()), inner[0])
    return (
        f"; there are some in {found}: give {colour}, or, to use depth images too, write the lists rgb.txt and "
        "depth.txt of TUM's layout (docs/sources.md)"
    )


def image_folder(folder: Path, first: int | None = None, last: int | None = None) -> RecordedFrames:
    """A folder of images whose names are times, numbered from 0; or of numbered ones, whose gaps are kept."""
    if timed := _timed_images(folder):
        in_turn = [_ImageRecord(index, timestamp, path) for index, (timestamp, path) in enumerate(timed)]
        return RecordedFrames(folder, in_turn, first, last)
    records = [_ImageRecord(number, number / ASSUMED_FPS, path) for number, path in numbered_images(folder).items()]
    source = RecordedFrames(folder, records, first, last, fps=ASSUMED_FPS)
    source.has_assumed_times = True
    return source


def _timed_images(folder: Path) -> list[tuple[float, Path]]:
    """The images of a folder with their times in seconds, in this order; empty if not all names are times.

    Raises SourceError if two have the same time.
    """
    # What is no ending of images is a part of the name.
    names = {path: path.stem if named_kind(path) in IMAGES else path.name for path in image_files(folder)}
    dates = [_seconds_of_date(name) for name in names.values()]
    numbers = [date for date in dates if date is not None]
    is_dated = len(numbers) == len(names)
    kind = next((kind for kind in (_SECONDS, _PARTS) if all(map(kind.fullmatch, names.values()))), None)
    if not is_dated:
        if kind is None:
            return []
        # Decimals are exact; float64 would round nanoseconds.
        numbers = [Decimal(name) for name in names.values()]
    images: dict[Decimal, Path] = {}
    for path, time in zip(names, numbers, strict=True):
        if time in images:
            raise SourceError(
                f"{folder} has two images of the same time, {images[time].name} and {path.name}: keep one of them, or, "
                "if their names are no times, number the images without a point"
            )
        images[time] = path
    times = sorted(images)
    unit = 1 if is_dated or kind is _SECONDS else _parts_a_second(times)
    return [(float(time / unit), images[time]) for time in times] if unit else []


def _seconds_of_date(name: str) -> Decimal | None:
    """Seconds since 1970 of a name that is a date, taken to be in UTC; None if it is none."""
    matched = _DATE.fullmatch(name)
    try:
        date = datetime.strptime(matched[1], _DATE_FORMAT) if matched else None
    except ValueError:  # no such month, day or hour
        date = None
    if matched is None or date is None:
        return None
    return Decimal(int(date.replace(tzinfo=UTC).timestamp())) + Decimal(f"0.{matched[2] or 0}")


def _parts_a_second(times: Sequence[Decimal]) -> int | None:
    """What whole numbers count: that by which there are 1 to 1000 frames a second; None where they are no times.

    Where this does not tell, those of 16 digits are nanoseconds, and others the numbers of frames.
    """
    gaps = np.diff(np.array([int(time - times[0]) for time in times], dtype=np.float64))
    gap = float(np.median(gaps)) if len(gaps) else 0.0
    if gap <= 1.0:
        return _UNITS[-1] if times[-1] >= 10**15 else None
    return next((unit for unit in _UNITS if gap <= unit), _UNITS[-1])


def is_tum(folder: Path) -> bool:
    """Whether a folder has the layout of the TUM RGB-D benchmark (Sturm et al. 2012)."""
    return (folder / "rgb.txt").is_file()


def tum_recording(folder: Path, first: int | None = None, last: int | None = None) -> RecordedFrames:
    """The images that `rgb.txt` lists with the depth of `depth.txt` taken closest to them; numbered from 0."""
    depths = _read_tum_list(folder / "depth.txt") if (folder / "depth.txt").is_file() else []
    depth_times = np.array([timestamp for timestamp, _ in depths])
    records, offs = [], []
    for index, (timestamp, path) in enumerate(_read_tum_list(folder / "rgb.txt")):
        depth = None
        if depths:
            nearest = int(np.abs(depth_times - timestamp).argmin())
            offs.append(float(abs(depth_times[nearest] - timestamp)))
            if offs[-1] <= MOST_TIME_DIFFERENCE:
                depth = depths[nearest][1]
        records.append(_ImageRecord(index, timestamp, path, depth=depth))
    frames = RecordedFrames(folder, records, first, last, depth_scale=TUM_DEPTH)
    if offs and min(offs) > MOST_TIME_DIFFERENCE:
        frames.depth_off_s = min(offs)
    return frames


def _read_tum_list(path: Path) -> list[tuple[float, Path]]:
    """Timestamps and files of a list "timestamp file", in the order of time."""
    entries = []
    for number, line in enumerate(read_text(path, "list of images", SourceError).splitlines(), start=1):
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


def _euroc_base(folder: Path) -> Path | None:
    """The folder that holds cam0, None if this is another layout."""
    candidates = (folder / "mav0", folder)
    return next((base for base in candidates if (base / "cam0" / "data.csv").is_file()), None)


def is_euroc(folder: Path) -> bool:
    """Whether a folder, or `mav0` in it, has the layout of the EuRoC benchmark (Burri et al. 2016)."""
    return _euroc_base(folder) is not None


def euroc_recording(folder: Path, first: int | None = None, last: int | None = None) -> RecordedFrames:
    """The images of cam0, with those of cam1 that have the same timestamp as right images; from 0."""
    base = _euroc_base(folder)
    assert base is not None
    left = _read_euroc_list(base / "cam0")
    right = _read_euroc_list(base / "cam1") if (base / "cam1" / "data.csv").is_file() else {}
    records = [
        _ImageRecord(index, nanoseconds / 1e9, path, right=right.get(nanoseconds))
        for index, (nanoseconds, path) in enumerate(sorted(left.items()))
    ]
    return RecordedFrames(folder, records, first, last)


def _read_euroc_list(camera: Path) -> dict[int, Path]:
    """The images of a camera by their timestamps in nanoseconds, which float64 seconds would round."""
    entries = {}
    path = camera / "data.csv"
    for number, line in enumerate(read_text(path, "list of images", SourceError).splitlines(), start=1):
        if not line.strip() or line.startswith("#"):
            continue
        words = [word.strip() for word in line.split(",")]
        if len(words) != 2 or not words[0].isdecimal():
            raise SourceError(f"{path}, line {number}: '{line}' is not a timestamp in nanoseconds and a file")
        entries[int(words[0])] = camera / "data" / words[1]
    return entries


def is_seven_scenes(folder: Path) -> bool:
    """Whether a folder has the layout of 7-Scenes (Shotton et al. 2013)."""
    return any(_COLOUR.fullmatch(path.name) for path in folder.glob("frame-*.color.*"))


def seven_scenes_recording(folder: Path, first: int | None = None, last: int | None = None) -> RecordedFrames:
    """The images `frame-000000.color.png` with `.depth.png` where it is there; depth is not registered to colour."""
    records = []
    for path in sorted(folder.glob("frame-*.color.*")):
        matched = _COLOUR.fullmatch(path.name)
        if matched:
            number, depth = int(matched[1]), folder / f"frame-{matched[1]}.depth.png"
            found = depth if depth.is_file() else None
            records.append(_ImageRecord(number, number / SEVEN_SCENES_FPS, path, depth=found))
    return RecordedFrames(folder, records, first, last, depth_scale=SEVEN_SCENES_DEPTH, fps=SEVEN_SCENES_FPS)
