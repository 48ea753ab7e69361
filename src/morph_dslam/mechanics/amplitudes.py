"""What loads and motions are multiplied by as time runs: straight lines between values at stated times."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Amplitude:
    """A function of time, constant before the first time and after the last.

    Attributes
    ----------
    times : (n,) rising, s.
    values : (n,) at these times.
    """

    times: tuple[float, ...]
    values: tuple[float, ...]

    def __call__(self, time: ArrayLike) -> Array:
        """Values at times of any shape, s."""
        return np.asarray(np.interp(np.asarray(time, dtype=np.float64), self.times, self.values), dtype=np.float64)

    def is_constant(self, begin: float, end: float) -> bool:
        """Whether it has one value from ``begin`` to ``end``, s."""
        return not np.ptp(self([begin, *(time for time in self.times if begin < time < end), end]))

    def relaxed(self, time: ArrayLike, start: float, relaxation_time: float) -> Array:
        """The convolution of exp(-t / relaxation_time) with what the amplitude grows by, at times (m,), s.

        It is the stress of a Maxwell element of unit modulus that is strained by the amplitude at ``start``, s, in an
        instant, and then as the amplitude goes on.
        """
        time = np.atleast_1d(np.asarray(time, dtype=np.float64))
        knots = np.array([start, *(t for t in self.times if t > start)])
        rates = np.diff(self(knots)) / np.diff(knots)
        begun, ended = np.minimum(time[:, None], knots[:-1]), np.minimum(time[:, None], knots[1:])
        # Of each line, what its end left less what its begin did, both faded since.
        faded = np.exp((ended - time[:, None]) / relaxation_time) - np.exp((begun - time[:, None]) / relaxation_time)
        at_start = float(self(start)) * np.exp((start - time) / relaxation_time)
        return at_start + relaxation_time * (faded @ rates)
