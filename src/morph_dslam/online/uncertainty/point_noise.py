"""How exactly each point is measured in a frame, and what it counts by that.

What patches of the rendered view and of the frame differ by, tells how exactly a point was found: something
else may be in a part of its window, or the surface may be seen much broader than in the reference view. Apart
from that, a model that is a little off leaves residuals that all points have alike. A residual's variance is
so taken to be f s² + t, with s what the patches tell; f and t are learnt from the residuals of the frames.
Where the model leaves nothing, points whose patches differ more err by more than in proportion, because a
part of a window that is covered moves what is found as a whole. The variance is then taken to be f s^2p, and
the power p >= 1 is learnt.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

#: Nothing is known better than by this, pixels, whatever the patches say.
LEAST_SPREAD_PX = 0.01
#: With differences that are independent from pixel to pixel f is 1; blur makes neighbours alike, so that they
#: count as fewer. A larger f is no noise of the patches but what the model leaves, where it moves them most.
LARGEST_FACTOR = 4.0
#: Larger powers of what the patches tell would leave few points to decide.
LARGEST_POWER = 1.5
#: Share of the latest frame in what is learnt, and points that it must have to tell.
LEARNING_RATE, LEAST_POINTS = 0.05, 20
#: The length of a Gaussian pair has this median, in standard deviations of a coordinate (Rayleigh).
MEDIAN_OF_PAIR = 1.1774


class PointNoise:
    """Weights of points; all the same until frames were learnt from."""

    def __init__(self) -> None:
        self._moments: Array | None = None

    @property
    def common(self) -> float:
        """t / f in squared pixels; infinite where the patches do not tell how exact a point is."""
        if self._moments is None:
            return np.inf
        told, squared = self._moments.T
        factor = min((squared[1] - squared[0]) / max(told[1] - told[0], 1e-300), LARGEST_FACTOR)
        if factor <= 0.0:
            return np.inf
        return max(float(squared.mean() / factor - told.mean()), LEAST_SPREAD_PX**2)

    @property
    def power(self) -> float:
        """p; 1 where the patches tell too little, or the model leaves something."""
        if self._moments is None or self.common > LEAST_SPREAD_PX**2:
            return 1.0
        told, squared = np.log(np.maximum(self._moments.T, 1e-300))
        return float(np.clip((squared[1] - squared[0]) / (told[1] - told[0]), 1.0, LARGEST_POWER))

    def weights(self, spread: Array, used: NDArray[np.bool_]) -> Array:
        """Inverse variances (p,), in that of a typical point; zero for points that are not ``used`` (p,).

        ``spread`` (p,) is what the patches tell, see `compare_patches`.
        """
        common = self.common
        if np.isinf(common) or not used.any():
            return used.astype(float)
        variance = (spread**2 + common) ** self.power
        return np.where(used, _middle(variance[used]) / variance, 0.0)

    def learn(self, spread: Array, residuals: Array, used: NDArray[np.bool_]) -> None:
        """Take in the residuals (p, 2) of a frame: of the better half of the points and of the other."""
        used = used & np.isfinite(spread) & np.isfinite(residuals).all(axis=1)
        if used.sum() < LEAST_POINTS:
            return
        spread, length = spread[used], np.linalg.norm(residuals[used], axis=1)
        better = spread <= _middle(spread)
        if better.all():
            return
        moments = np.array(
            [
                [_middle(spread[half]) ** 2, (_middle(length[half]) / MEDIAN_OF_PAIR) ** 2]
                for half in (better, ~better)
            ]
        )
        before = moments if self._moments is None else self._moments
        self._moments = before + LEARNING_RATE * (moments - before)


def _middle(values: Array) -> float:
    """The upper median of numbers (n,); numpy's own takes five times as long for some hundred."""
    half = len(values) // 2
    return float(np.partition(values, half)[half])
