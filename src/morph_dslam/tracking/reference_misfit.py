"""What residuals show of errors that neighbours have in common: the model's, and those of the reference state."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

#: More than this, pixels, and more than half of the residuals' variance, counts as the model's failure.
UNEXPLAINED_PX = 0.5
#: What comparing windows leaves in neighbours alike, pixels: an expectation well below says nothing.
FLOOR_PX = 0.05
#: Frames over which what was learnt of the reference fades, by a factor e.
MEMORY = 600.0
#: More than so many times the stated deviation of the reference is a warning.
CLEARLY_WORSE = 2.0
#: A measurement so many standard deviations from a stated value refutes it. A right one is off by more in one
#: frame of 15000 if errors are Gaussian; those of the registration are the same in all frames.
REFUTED = 4.0


@dataclass(frozen=True)
class Unexplained:
    """What the model leaves of the residuals.

    Attributes
    ----------
    px : standard deviation of a pixel coordinate that neighbours have in common
    total_px : standard deviation of a pixel coordinate, all of it
    """

    px: float
    total_px: float

    @property
    def is_failure(self) -> bool:
        """Whether the model, not noise, is what is left."""
        return self.px > UNEXPLAINED_PX and self.px**2 > 0.5 * self.total_px**2


@dataclass(frozen=True)
class BeyondReference:
    """What is left of the residuals that no error of the reference state leaves, however large.

    Attributes
    ----------
    common : variance of a pixel coordinate that neighbours have in common in it, px²; by chance negative too
    chance : its standard deviation where only noise is left, px²
    share : how much of a model's error is left in it
    noise : variance of a pixel coordinate that neighbours do not have in common, px²
    """

    common: float
    chance: float
    share: float
    noise: float

    @property
    def is_failure(self) -> bool:
        """Whether it is the model's doing, whose whole error is then large, and larger than noise.

        An estimate takes up most of a model's error by a wrong pose and shape: what is left may be small.
        """
        whole = self.common / self.share
        return self.common > REFUTED * self.chance and whole > max(UNEXPLAINED_PX**2, self.noise)


class ReferenceMisfit:
    """By how much the reference state is worse known than was stated, as the frames of a sequence show it.

    By the stated covariance of the reference state neighbours have e px² a coordinate in common in the
    residuals; the frame shows o px². One factor f of the variance holds for the whole sequence, o = f e: the
    least squares slope over the frames, in which those that expect much count most (a variance component by
    the method of moments; Rao 1971, J. Multivariate Analysis 1, 257). A frame in which the object is as in
    the reference view expects nothing. So the factor starts as one, as if a frame with `FLOOR_PX` of both had
    said so.
    """

    def __init__(self) -> None:
        self._fade = np.exp(-1.0 / MEMORY)
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
