"""Whether the frames could have shown that an object has not got the model's dimensions.

The reference state takes most of a wrong length up: a sheet that is narrower than its model passes for a
turned one. Let a stretch s of the undeformed model along its axes move the points' pixels by S0 s in the
reference view and by S s in a frame. The reference state is then off by e = J0^+ S0 s, the points are bound
off by what that leaves, S0 s - J0 e, and the frame's residuals are (1 - J H^-1 J' W) (S s - M (S0 s - J0 e)),
with J, W and M as in `systematic_errors`. In the reference view that is zero, so it tells nothing; how much
it is in a frame says what could have been seen there. A change of size alone stays invisible to one camera,
and is left out: the stretches are those that keep the mean length.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from morph_dslam.online.estimation.state import BoundPoints, State
from morph_dslam.online.uncertainty.bound_part import BoundPart
from morph_dslam.online.uncertainty.reference_misfit import FLOOR_PX

Array = NDArray[np.float64]

#: A stretch that should have been seen.
STRETCH = 0.02
#: Axes along which the points extend less than this share of the largest extent have no length to be wrong.
FLAT = 0.01


class DimensionCheck:
    """Takes in how well each frame could have shown a stretch.

    Parameters
    ----------
    points : (p) bound in the reference view. parts : its pictures.
    jacobian : (p, 2, d + 6) of their pixels there. scale : (d + 6,) of the unknowns.
    """

    def __init__(
        self, points: BoundPoints, parts: Sequence[BoundPart], jacobian: Array, scale: Array
    ) -> None:
        self._rest = points.rest
        extent = np.ptp(points.rest, axis=0)
        axes = np.eye(3)[:, extent > FLAT * extent.max()]
        # Stretches (3, k) of the axes that keep the mean length.
        self._stretches = axes @ np.linalg.svd(np.ones((1, axes.shape[1])))[2][1:].T
        left = []
        for part in parts:
            moved = self._by_stretch(part.state, jacobian)[part.rows]
            rows, size = jacobian[part.rows].reshape(-1, len(scale)) * scale, moved.shape[2]
            taken = np.linalg.lstsq(rows, moved.reshape(-1, size), rcond=1e-9)[0]
            left.append(moved - (rows @ taken).reshape(moved.shape))
        self._bound_off = np.concatenate(left)
        self._seen = 0.0

    def _by_stretch(self, state: State, jacobian: Array) -> Array:
        """Motion (p, 2, k) of the pixels by each stretch."""
        turned = state.camera_from_object.rotation @ (self._rest[:, :, None] * self._stretches)
        return jacobian[:, :, -3:] @ turned

    def moved(self, state: State, jacobian: Array, warps: Array) -> Array:
        """By what each stretch moves the pixels (p, 2, k) in a frame away from where the points are bound.

        ``warps`` (p, 2, 2) between the images of the points' triangles there and in the reference view.
        """
        return self._by_stretch(state, jacobian) - warps @ self._bound_off

    def learn(self, in_common: Array) -> None:
        """Take in what neighbouring points' residuals would have in common by each two stretches (k, k)."""
        if len(in_common):
            least = float(np.linalg.eigvalsh(in_common)[0])
            self._seen = max(self._seen, STRETCH * float(np.sqrt(max(least, 0.0))))

    @property
    def is_done(self) -> bool:
        """Whether any stretch by `STRETCH` would have left more in some frame than windows leave anyway."""
        return self._stretches.shape[1] == 0 or self._seen > FLOOR_PX
