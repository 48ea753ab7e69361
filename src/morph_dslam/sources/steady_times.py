"""Times of a camera's frames without the jitter with which a computer receives them."""

from __future__ import annotations

from collections import deque

import numpy as np

#: Frames that tell the times of the newest one.
REMEMBERED = 30
#: A frame farther from where the others have it, in seconds or as a share of the interval, does not tell times with
#: them: it is late, or the rate has changed.
MOST_OFF_S, MOST_OFF = 6e-3, 0.4
#: So many of these in a row begin anew.
BEGIN_ANEW = 2
#: Times are apart by this share of the interval at least; by so many seconds where that is not known.
LEAST_STEP, LEAST_SECONDS = 0.1, 1e-6


class SteadyTimes:
    """Smooths the times at which frames come.

    A camera records in even intervals, but a frame is received some milliseconds late, now more and now less, and a
    velocity from two frames would have that as an error. The time of a frame is that of the line that fits the last
    `REMEMBERED` ones best, which counts on where frames are dropped. A frame that is not near the line has the time at
    which it was received, and so have those after it until a line holds again: no time is moved by more than
    `MOST_OFF_S`, but for what lets times increase where several frames come at once.
    """

    def __init__(self) -> None:
        # Pairs of a frame's number and when it was received: those of the line, and those in a row that are off it.
        self._on_line: deque[tuple[int, float]] = deque(maxlen=REMEMBERED)
        self._off_line: list[float] = []
        self._last = -np.inf

    def add(self, received: float) -> float:
        """The time of the next frame, by when it was received, seconds."""
        time, interval = self._smoothed(received)
        self._last = max(time, self._last + (LEAST_STEP * interval or LEAST_SECONDS))
        return self._last

    def _smoothed(self, received: float) -> tuple[float, float]:
        """The time of the next frame, and the interval; that is 0 where it is not known yet."""
        offset, interval = self._line()
        number = self._on_line[-1][0] if self._on_line else 0
        if interval <= 0.0:
            self._on_line.append((number + 1, received))
            return received, 0.0
        number += max(round((received - offset) / interval - number), 1)
        near = min(MOST_OFF_S, MOST_OFF * interval)
        if abs(received - offset - interval * number) > near:
            self._off_line.append(received)
            if len(self._off_line) >= BEGIN_ANEW:
                self._on_line, self._off_line = deque(enumerate(self._off_line), REMEMBERED), []
            return received, interval
        self._off_line.clear()
        self._on_line.append((number, received))
        offset, interval = self._line()
        return offset + interval * number, interval

    def _line(self) -> tuple[float, float]:
        """The time of number 0 on the line, and the interval; 0 where that is not known."""
        if len(self._on_line) < 2:
            return 0.0, 0.0
        numbers, received = np.array(self._on_line).T
        away = numbers - numbers.mean()
        interval = float(away @ (received - received.mean()) / (away @ away))
        return float(received.mean() - interval * numbers.mean()), interval
