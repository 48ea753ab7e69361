"""What all depths of a depth camera are off by together: no residual of depths shows it, and no average removes it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from morph_dslam.tracking.depth import PointDepths
from morph_dslam.tracking.state import BoundPoints, State

Array = NDArray[np.float64]
#: Derivatives are differences over this share of the depths.
STEP = 1e-4
#: That far to either side.
LARGER, SMALLER = 1.0 + STEP, 1.0 - STEP


@dataclass(frozen=True)
class DepthScale:
    """What all depths of a depth camera have to be multiplied by.

    Attributes
    ----------
    factor : as far as it is known.
    std : its standard deviation, a share.
    """

    factor: float = 1.0
    std: float = 0.0

    def corrected(self, depth: NDArray[np.float32]) -> NDArray[np.float32]:
        """A depth image (h, w), metres, in this scale."""
        return depth if self.factor == 1.0 else depth * np.float32(self.factor)


class CommonDepthScale:
    """How the scale of all depths enters the estimates of a sequence's frames, alike in all of them.

    Parameters
    ----------
    std : standard deviation of the scale, a share; zero where it is in the error of the reference already.
    scale : (d + 6,) of the unknowns, which makes them comparable.
    """

    def __init__(self, std: float, scale: Array) -> None:
        self._std, self._size = std, len(scale)
        self.forget_frames()

    def forget_frames(self) -> None:
        """The next estimate does not rest on earlier ones."""
        self._pushed = np.zeros(self._size)

    def keep(self, pushed: Array) -> None:
        """Take in how an estimate moves (d + 6,) that later ones rest on."""
        self._pushed = pushed

    def push(self, points: BoundPoints, state: State, past: Array, depths: PointDepths | None) -> Array:
        """How one standard deviation of the scale enters a frame's gradient (d + 6,).

        Parameters
        ----------
        points : p of the reference view.
        state : estimated in the frame.
        past : (d + 6, d + 6) the information of earlier frames in it.
        depths : (p,) of the points; None where there are none.
        """
        push = past @ self._pushed
        if depths is None or not self._std:
            return push
        larger, smaller = (depths.scaled(factor).terms(points, state)[2] for factor in (LARGER, SMALLER))
        return push - self._std * (larger - smaller) / (2.0 * STEP)
