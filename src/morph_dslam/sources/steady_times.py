"""Times of a camera's frames without the jitter with which a computer receives them."""

from __future__ import annotations

from collections import deque

import numpy as np

#: Frames that tell the times of the newest one.
REMEMBERED = 30
#: A frame farther from where the others have it, as a share of the interval, begins anew: the rate has changed.
MOST_OFF = 0.5


class SteadyTimes:
    """Smooths the times at which frames come.

    A camera records in even intervals, but a frame is received some milliseconds late, now more and now less, and a
    velocity from two frames would have that as an error. The time of a frame is that of the line that fits the last
    `REMEMBERED` ones best. Where frames are dropped it counts on by as many. No time is moved by more than half of an
    interval.
    """

    def __init__(self) -> None:
        self._received: deque[float] = deque(maxlen=REMEMBERED)
        self._numbers: deque[int] = deque(maxlen=REMEMBERED)
        self._last = -np.inf

    def add(self, received: float) -> float:
        """The time of the next frame, by when it was received, seconds."""
        interval = float(np.median(np.diff(self._received))) if len(self._received) > 1 else 0.0
        steps = 1
        if interval > 0.0:
            steps = max(round((received - self._received[-1]) / interval), 1)
        self._numbers.append(self._numbers[-1] + steps if self._numbers else 0)
        self._received.append(received)
        time = self._fitted()
        if abs(time - received) > MOST_OFF * interval:
            time = received
            self._received, self._numbers = deque([received], REMEMBERED), deque([0], REMEMBERED)
        # Nothing comes before the frame before it.
        self._last = max(time, self._last)
        return self._last

    def _fitted(self) -> float:
        """The newest time on the line through all."""
        received, numbers = np.array(self._received), np.array(self._numbers, dtype=np.float64)
        if len(received) < 3:
            return float(received[-1])
        away = numbers - numbers.mean()
        slope = away @ (received - received.mean()) / (away @ away)
        return float(received.mean() + slope * away[-1])
