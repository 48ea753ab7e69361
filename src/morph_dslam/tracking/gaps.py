"""Gaps between frames: after a long one the object may be anywhere, and is looked for as after a loss."""

from __future__ import annotations

from collections import deque

import numpy as np

#: A gap is longer than this, seconds, and than so many usual intervals: a recording may have one frame a minute.
GAP_S, GAP_INTERVALS = 0.5, 5.0
#: The usual interval is the median of so many.
INTERVALS = 31


class FrameGaps:
    """Watches the times of frames."""

    def __init__(self) -> None:
        self._last: float | None = None
        self._intervals: deque[float] = deque(maxlen=INTERVALS)

    def after_gap(self, timestamp: float) -> bool:
        """Whether a frame comes a long time after the one before; times that stand still or run back make no gap.

        Parameters
        ----------
        timestamp : of the next frame, seconds.
        """
        last, self._last = self._last, timestamp
        if last is None:
            return False
        interval = timestamp - last
        is_gap = bool(self._intervals) and interval > max(GAP_S, GAP_INTERVALS * float(np.median(self._intervals)))
        self._intervals.append(interval)
        return is_gap
