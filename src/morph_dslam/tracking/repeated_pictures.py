"""Live frames that are the frame before once more: noise makes that all but impossible, so the camera is frozen."""

from __future__ import annotations

import logging

import numpy as np

from morph_dslam.sources import Frame
from morph_dslam.tracking.run_notices import RunNotice, RunWarning

_LOG = logging.getLogger("morph_dslam")
#: Repetitions are named if they last so long, seconds, and are so many.
LEAST_S, LEAST_FRAMES = 0.5, 5
#: Of the rows of a picture every so many-th is compared first.
ROWS = 16


class RepeatedPictures:
    """Watches live frames for pictures that are exactly those before.

    Parameters
    ----------
    tells : whether a line in the log says so as soon as it is known.
    """

    def __init__(self, tells: bool = False) -> None:
        self._tells = tells
        self._first: Frame | None = None
        self._repeating: list[int] = []
        self._seconds = 0.0
        self._before: list[tuple[int, int, float]] = []

    def add(self, frame: Frame) -> None:
        """Take in the next frame."""
        if self._first is None or not _equal(self._first, frame):
            if self._is_frozen:
                self._before.append(self._current())
            self._first, self._repeating, self._seconds = frame, [], 0.0
            return
        was_frozen = self._is_frozen
        self._repeating.append(frame.index)
        self._seconds = frame.timestamp - self._first.timestamp
        if self._tells and self._is_frozen and not was_frozen:
            _LOG.warning("since frame %d the camera delivers the same picture: it may be frozen", self._first.index)

    @property
    def _is_frozen(self) -> bool:
        return len(self._repeating) >= LEAST_FRAMES and self._seconds >= LEAST_S

    def _current(self) -> tuple[int, int, float]:
        """The first frame that repeats the picture before, how many do, and for how long, seconds."""
        return self._repeating[0], len(self._repeating), self._seconds

    def notices(self) -> list[RunNotice]:
        """What a reader of the run must know: one notice, or none."""
        found = [*self._before, *([self._current()] if self._is_frozen else [])]
        if not found:
            return []
        firsts, counts, seconds = zip(*found, strict=True)
        data = {"count": sum(counts), "first": firsts[0], "longest_s": max(seconds)}
        return [RunNotice.of(RunWarning.SAME_PICTURE, **data)]


def _equal(one: Frame, other: Frame) -> bool:
    return np.array_equal(one.image[::ROWS], other.image[::ROWS]) and np.array_equal(one.image, other.image)
