"""By how much the reference state is worse known than was stated, as the frames of a sequence show it.

An error of the reference state moves the points that were bound by it. A later frame takes up most of that by
a wrong estimate; the rest stays in its residuals, alike over wide parts of the object. The stated covariance
says how large this rest is to be expected, e px² a coordinate; the frame shows o px². Where frames show more,
the reference state is worse known than stated, or the object is not what the model says and the reference
state has taken that up: a sheet that is narrower than its model passes for a turned and bent one. Either way
its variance is too small by the factor f of o = f e, one factor for the whole sequence. It is the least
squares slope over the frames, in which those that tell much of it count most: a variance component by the
method of moments (Rao 1971, J. Multivariate Analysis 1, 257).

A frame in which the object is as in the reference view tells nothing: e is zero there, and o is what windows
that are compared leave. So the factor starts as one, as if a frame with `FLOOR_PX` of both had said so.
"""

from __future__ import annotations

import numpy as np

#: What comparing windows leaves in neighbours alike, pixels: an expectation well below tells nothing.
FLOOR_PX = 0.05

#: More than so many times the stated deviation is said of a frame and of the run.
CLEARLY_WORSE = 2.0


class ReferenceMisfit:
    """Learns the factor from frame to frame.

    Parameters
    ----------
    memory : frames over which earlier ones fade, by a factor e.
    """

    def __init__(self, memory: float = 600.0) -> None:
        self._fade = np.exp(-1.0 / memory)
        self._product = self._square = 0.0

    def learn(self, shown: float, expected: float) -> None:
        """Take in what a frame shows and what was expected of it, px²; noise makes the first negative too."""
        self._product = self._fade * self._product + shown * expected
        self._square = self._fade * self._square + expected**2

    @property
    def factor(self) -> float:
        """Of the variance; one where the frames show no more than was stated."""
        one = FLOOR_PX**4
        return max((self._product + one) / (self._square + one), 1.0)
