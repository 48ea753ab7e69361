"""The frames of several cameras, those of one instant together."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields
from itertools import islice
from typing import Any

import numpy as np

from morph_dslam.errors import SourceError
from morph_dslam.sources import Frame
from morph_dslam.sources.frames import FrameSource, MissingFrame
from morph_dslam.tracking.run_notices import RunNotice, RunWarning

#: Clocks that are less apart than this, seconds, go together: an instant has one time by all of them.
ONE_CLOCK = 1.0


@dataclass(frozen=True)
class RenumberedFrame(Frame):
    """A frame of a rig that has the number of its instant.

    Attributes
    ----------
    own_index : its number in the recording of its camera
    """

    own_index: int = 0


def own_number(frame: Frame) -> int:
    """The number of a frame in the recording of its camera."""
    return frame.own_index if isinstance(frame, RenumberedFrame) else frame.index


class SynchronizedFrames:
    """What several cameras recorded, the frames of one instant after the other.

    Where some of them lack the frame of an instant, a `MissingFrame` stands for it. It ends with the longest recording.
    Where all sources say that they have times of their own (``has_assumed_times = False``), frames go together by
    these, else by their numbers, of which all begin with the same one. Times are by one clock; but if the first ones
    are a second apart or more, the first frames are of one instant. An instant that the first camera lacks has the
    number after the last one, or is left out if that camera has a frame of this number.

    By their times, recordings are given from their beginnings, and a range is cut here: a camera that lost frames has
    other numbers, and one that is cut by its own shows other instants.

    Parameters
    ----------
    sources : by camera.
    first, last : range of instants, by numbers of the first camera's frames, both included; open ends by default.

    Attributes
    ----------
    sources : by camera.
    n_instants : number of instants in the last pass so far.
    n_missing : by camera, how many of these it has no frame of.
    n_left_out : how many of these are left out.
    """

    def __init__(self, sources: Sequence[FrameSource], first: int | None = None, last: int | None = None) -> None:
        self.sources, self._first, self._last = tuple(sources), first, last
        self.n_instants, self.n_missing, self.n_left_out = 0, [0] * len(sources), 0

    @property
    def goes_by_time(self) -> bool:
        """Whether frames go together by their times."""
        return all(getattr(source, "has_assumed_times", True) is False for source in self.sources)

    def at(self, number: int | None) -> tuple[Frame, ...]:
        """The frames of the instant of this number, the first one by default.

        Raises SourceError if there is none, or a camera lacks it.
        """
        name = self.sources[0].name
        for frames in self:
            if number is None or frames[0].index == number:
                lacking = [str(k) for k, frame in enumerate(frames) if isinstance(frame, MissingFrame)]
                if lacking:
                    raise SourceError(
                        f"camera {lacking[0]} has no frame of the instant of frame {frames[0].index} of {name}: take a "
                        "reference frame that all cameras have, or give --range from where they have"
                    )
                return frames
        raise SourceError(f"{name} holds no frame {number} to take as the reference")

    def notices(self) -> list[RunNotice]:
        """What a reader must know if not all recordings have the same frames."""
        lacking = {number: count for number, count in enumerate(self.n_missing) if count}
        if not lacking:
            return []
        told = ", ".join(
            f"camera {number} lacks {count}" + f" ({self.n_left_out} left out)" * bool(self.n_left_out and not number)
            for number, count in lacking.items()
        )
        return [RunNotice.of(RunWarning.UNEQUAL_RECORDINGS, instants=self.n_instants, missing=told)]

    @property
    def turned_deg(self) -> int:
        """By how many degrees the first camera's frames are turned to be shown."""
        return getattr(self.sources[0], "turned_deg", 0)

    @property
    def has_assumed_times(self) -> bool:
        """Whether nothing tells the times of the first camera's frames, which count."""
        return getattr(self.sources[0], "has_assumed_times", False)

    @property
    def has_registered_depth(self) -> bool:
        """Whether the first camera's frames come with depth that belongs to their pixels."""
        return getattr(self.sources[0], "has_registered_depth", False)

    @property
    def depth_off_s(self) -> float | None:
        """How far the nearest depth image of the first camera is from a frame, seconds, where none belongs to one."""
        return getattr(self.sources[0], "depth_off_s", None)

    def __len__(self) -> int:
        """Number of instants; there are more where no camera has all, and a range counts from frame 0."""
        end = None if self._last is None else self._last + 1
        return len(range(max(len(source) for source in self.sources))[self._first : end])

    def __iter__(self) -> Iterator[tuple[Frame, ...]]:
        self.n_instants, self.n_missing, self.n_left_out = 0, [0] * len(self.sources), 0
        has_begun = self._first is None
        for frames, is_left_out in self._instants():
            number = frames[0].index
            if self._last is not None and number > self._last:
                return
            has_begun = has_begun or (number >= (self._first or 0) and not is_left_out)
            if not has_begun:
                continue
            self.n_instants += 1
            self.n_left_out += is_left_out
            for k, frame in enumerate(frames):
                self.n_missing[k] += isinstance(frame, MissingFrame)
            if not is_left_out:
                yield frames

    def of_camera(self, camera: int) -> Iterator[Frame]:
        """What one camera recorded, in the whole recording, with the numbers of the instants."""
        if not self.goes_by_time:
            yield from self.sources[camera]
            return
        for frames, is_left_out in self._instants():
            if not is_left_out and not isinstance(frames[camera], MissingFrame):
                yield frames[camera]

    def _instants(self) -> Iterator[tuple[tuple[Frame, ...], bool]]:
        """The frames of each instant of the whole recordings, and whether it is to be left out."""
        readers = [iter(source) for source in self.sources]
        come = [frame for reader in readers for frame in islice(reader, 1)]
        if len(come) < len(readers):
            return
        by_time = self.goes_by_time
        if not by_time:
            _check_begin(come)
        clocks = _Clocks(come, 0.5 / max(source.fps for source in self.sources) if by_time else None)
        blank, last = [np.zeros_like(frame.image) for frame in come], come[0].index - 1
        waiting: list[Frame | None] = [*come]
        while any(frame is not None for frame in waiting):
            now = clocks.together(waiting)
            numbers = [frame.index for frame in now if frame is not None]
            number = last + 1 if by_time and now[0] is None else numbers[0]
            is_left_out = now[0] is None and waiting[0] is not None and waiting[0].index <= number
            last = last if is_left_out else number
            frames = tuple(
                MissingFrame(number, time, image) if frame is None else _renumbered(frame, number)
                for frame, time, image in zip(now, clocks.times(now), blank, strict=True)
            )
            yield frames, is_left_out
            waiting = [
                old if new is None else next(reader, None)
                for old, new, reader in zip(waiting, now, readers, strict=True)
            ]


def _renumbered(frame: Frame, number: int) -> Frame:
    """A frame with the number of its instant."""
    if frame.index == number:
        return frame
    own: dict[str, Any] = {each.name: getattr(frame, each.name) for each in fields(Frame)}
    return RenumberedFrame(**{**own, "index": number, "own_index": frame.index})


class _Clocks:
    """Which frames are of one instant, and its time by the clock of each camera, also where it has no frame of it.

    Parameters
    ----------
    frames : by camera, the first ones.
    apart : frames are of one instant whose times are nearer than this, seconds; None if those of one number are.
    """

    def __init__(self, frames: Sequence[Frame], apart: float | None) -> None:
        self._apart, behind = apart, [frame.timestamp - frames[0].timestamp for frame in frames]
        self._behind = [0.0 if apart is not None and abs(each) < ONE_CLOCK else each for each in behind]

    def together(self, waiting: Sequence[Frame | None]) -> list[Frame | None]:
        """Of the next frames by camera, those of the next instant."""
        if self._apart is None:
            number = min(frame.index for frame in waiting if frame is not None)
            return [frame if frame is not None and frame.index == number else None for frame in waiting]
        times = [
            np.inf if frame is None else frame.timestamp - behind
            for frame, behind in zip(waiting, self._behind, strict=True)
        ]
        first = min(times)
        return [frame if time - first < self._apart else None for frame, time in zip(waiting, times, strict=True)]

    def times(self, frames: Sequence[Frame | None]) -> list[float]:
        """Seconds, by camera, of an instant of which at least one has a frame."""
        seen = ((k, frame.timestamp) for k, frame in enumerate(frames) if frame is not None)
        which, time = next(seen)
        first = time - self._behind[which]
        if which == 0:
            self._behind = [
                old if frame is None else frame.timestamp - first
                for old, frame in zip(self._behind, frames, strict=True)
            ]
        return [first + behind for behind in self._behind]


def _check_begin(frames: Sequence[Frame]) -> None:
    """Raise SourceError if the first frames of cameras have not one number."""
    if len({frame.index for frame in frames}) > 1:
        numbers = ", ".join(str(frame.index) for frame in frames)
        raise SourceError(
            f"the cameras' recordings do not go together: they begin with frames {numbers}; number "
            "what was taken at one instant alike, or if one begins later, give --range from where all begin"
        )
