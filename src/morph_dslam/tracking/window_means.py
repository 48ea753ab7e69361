"""What comparing windows leaves of a change of shape: a window shows the mean of what moves in it.

Over a square of w pixels the mean of a smooth motion u is off from that at its middle by w² (u,xx + u,yy) / 24, to
second order. The mean over points at a distance r about it, without what is linear, is off by r² (u,xx + u,yy) / 4.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from morph_dslam.tracking.patches import FLOW_WINDOW, zero_where_unknown

Array = NDArray[np.float64]
#: Points about each one.
NEIGHBOURS = 8


class WindowMeans:
    """By how much windows about points miss a motion of them.

    Parameters
    ----------
    points : (p, 3) where they are on the undeformed object, metres.
    """

    def __init__(self, points: Array) -> None:
        count = min(NEIGHBOURS, len(points) - 1)
        nearest = KDTree(points).query(points, count + 1)
        distances, found = np.asarray(nearest[0]), np.asarray(nearest[1])
        self._rows = found[:, 1:]
        beside = points[self._rows] - points[:, None]
        affine = np.concatenate([np.ones((*beside.shape[:2], 1)), beside / distances[:, -1:, None]], axis=2)
        # The value at a point of the affine function nearest to those about it.
        self._weights = np.linalg.pinv(affine)[:, 0]
        self._squared = np.mean(distances[:, 1:] ** 2, axis=1)

    def missed(self, motions: Array, pixels_per_metre: float) -> Array:
        """Of motions (p, 2), pixels, what windows miss (p, 2), roughly; 0 where it is not known.

        ``pixels_per_metre`` : about how large the object is in the image in which the points move.
        """
        about = np.einsum("pk,pkc->pc", self._weights, motions[self._rows])
        shares = np.minimum(FLOW_WINDOW**2 / (6.0 * pixels_per_metre**2 * self._squared), 1.0)
        return zero_where_unknown(shares[:, None] * (about - motions))
