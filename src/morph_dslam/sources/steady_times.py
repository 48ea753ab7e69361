"""Times of a camera's frames without the jitter with which a computer receives them."""

from __future__ import annotations

from collections import deque

import numpy as np

#: Frames that tell the times of the newest one.
REMEMBERED = 30
#: A frame farther from where the others have it, as a share of the interval, does not tell times with them.
MOST_OFF = 0.5
#: So many of these in a row begin anew: the rate has changed.
BEGIN_ANEW = 2
#: How much earlier than the others, as a share of the interval, a frame may come at least; and as a multiple of what
#: these had.
LEAST_EARLY, TIMES_EARLIER = 0.2, 1.5
#: Times are apart by this share of the interval at least; by so many seconds where that is not known.
LEAST_STEP, LEAST_SECONDS = 0.1, 1e-6


class SteadyTimes:
    """Smooths the times at which frames come.

    A camera records in even intervals, but a frame is received some milliseconds late, now more and now less, and a
    velocity from two frames would have that as an error. The time of a frame is that of the line that fits the last
    `REMEMBERED` ones best. Where frames are dropped it counts on by as many. A frame comes late, but never long before
    the others would have it: what would, had one been dropped, is itself late. One that is off by more than half of an
    interval has the time of the line, and does not count for it unless the next one is off too. Times increase.
    """

    def __init__(self) -> None:
        # Pairs of a frame's number and when it was received: those of the line, and those in a row that are off it.
        self._on_line: deque[tuple[int, float]] = deque(maxlen=REMEMBERED)
        self._off_line: list[tuple[int, float]] = []
        self._received: deque[float] = deque(maxlen=REMEMBERED)
        self._number = 0
        self._last = -np.inf

    def add(self, received: float) -> float:
        """The time of the next frame, by when it was received, seconds."""
        time, interval = self._smoothed(received)
        self._last = max(time, self._last + (LEAST_STEP * interval or LEAST_SECONDS))
        return self._last

    def _smoothed(self, received: float) -> tuple[float, float]:
        """The time of the next frame, and the interval; that is 0 where it is not known yet."""
        offset, slope, early = self._line()
        before = offset + slope * self._number if self._off_line else self._received[-1] if self._received else received
        self._received.append(received)
        interval = float(np.median(np.diff(self._received))) if len(self._received) > 1 else 0.0
        steps = max(round((received - before) / interval), 1) if interval > 0.0 else 1
        if steps > 1 and slope > 0.0 and offset + slope * (self._number + steps) - received > early * slope:
            steps -= 1  # no frame comes so early: it is late, and none was dropped
        if slope <= 0.0:
            self._number += steps
            self._on_line.append((self._number, received))
            return received, interval
        if received - offset - slope * (self._number + steps) < -MOST_OFF * slope and self._counted_too_far():
            self._on_line.pop()  # it was late by a whole interval, and no frame was dropped
            self._number -= 1
        self._number += steps
        if abs(received - offset - slope * self._number) <= MOST_OFF * slope:
            self._off_line.clear()
            self._on_line.append((self._number, received))
            offset, slope, _ = self._line()
            return offset + slope * self._number, interval
        self._off_line.append((self._number, received))
        if len(self._off_line) < BEGIN_ANEW:
            return offset + slope * self._number, interval
        self._on_line, self._off_line = deque(self._off_line, REMEMBERED), []
        return received, interval

    def _counted_too_far(self) -> bool:
        """Whether frames before the last one were taken to be dropped."""
        if len(self._on_line) <= BEGIN_ANEW or self._on_line[-1][0] != self._number:
            return False
        return self._number - self._on_line[-2][0] > 1

    def _line(self) -> tuple[float, float, float]:
        """The time of number 0 on the line, the interval, and how early frames may come, as a share of that.

        The interval is 0 where too few are known.
        """
        if len(self._on_line) < 3:
            return 0.0, 0.0, MOST_OFF
        numbers, received = np.array(self._on_line).T
        away = numbers - numbers.mean()
        interval = float(away @ (received - received.mean()) / (away @ away))
        offset = float(received.mean() - interval * numbers.mean())
        if interval <= 0.0:
            return offset, 0.0, MOST_OFF
        earliest = -float(np.min(received - offset - interval * numbers)) / interval
        return offset, interval, min(max(TIMES_EARLIER * earliest, LEAST_EARLY), MOST_OFF)
