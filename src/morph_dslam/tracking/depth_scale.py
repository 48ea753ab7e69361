"""What all depths of a depth camera are off by together: no residual of depths shows it, and no average removes it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

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


@dataclass(frozen=True)
class CommonDepthScale:
    """How well the scale of all depths of a sequence is known, which is alike in all of its frames.

    Attributes
    ----------
    std : its standard deviation, a share.
    in_reference : whether the reference state was found by depths of the same scale, which is then off with it.
    with_state : (d + 6,) covariance of the reference state's error with by what share all depths are too large, where
        frames with such depths have found that state; None where they have not.
    """

    std: float = 0.0
    in_reference: bool = False
    with_state: NDArray[np.float64] | None = None

    @classmethod
    def of(cls, found: DepthScale | None, std: float) -> CommonDepthScale:
        """As the registration has found it; with this deviation where it has not."""
        return cls(std) if found is None else cls(found.std, True)
