"""How much of the surface that a frame shows a reference view shows too, and which view is to be followed.

Samples of the surface are drawn into the view; the rasteriser says which of them are hidden. What the view
shows of a sample is the area of its triangle in the image over its undeformed area. A reference view serves
a frame where it shows the same side of the surface, and not much smaller.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from morph_dslam.model import SurfacePoints
from morph_dslam.model.surface_sampling import spread_over, triangle_normals
from morph_dslam.online.estimation.estimator import BoundPoints, Estimator, State
from morph_dslam.online.measuring.binding import DrawnSurface, signed_areas
from morph_dslam.online.measuring.measurement import DEPTH_TOLERANCE
from morph_dslam.render.rasteriser import visible_points

Array = NDArray[np.float64]

#: Samples of the surface: a share is then known to about three per cent.
N_SAMPLES = 600
#: Of the area in a frame that a reference view must show something with: a half in each direction.
LEAST_AREA = 0.25
#: The active view is kept as long as it covers this share of the surface that is seen.
KEEP_SHARE = 0.6
#: An earlier view, whose error is smaller, is gone back to when it covers this share: more, so that two views
#: do not take turns.
BACK_SHARE = 0.75


class SurfaceSamples:
    """Triangles spread over the undeformed surface, as many as their area asks for.

    Attributes
    ----------
    model : at a point of each of them alone, without triangles.
    """

    def __init__(self, estimator: Estimator, surface: DrawnSurface) -> None:
        model, self._camera, self._closed = estimator.model, estimator.camera, surface.closed
        points = spread_over(model.nodes, model.triangles, N_SAMPLES)
        self.model = replace(
            model,
            nodes=model.rest_positions(points),
            triangles=np.empty((0, 3), dtype=np.int64),
            displacement=model.restrict(points),
            stresses={},
            cells={},
            strain=None,
            reactions={},
        )
        chosen = points.triangles
        corners = SurfacePoints(np.repeat(chosen, 3), np.tile(np.eye(3), (N_SAMPLES, 1)))
        self._corners = BoundPoints.from_surface(model, corners)
        normals = triangle_normals(model.nodes, model.triangles[chosen])
        self._areas = 0.5 * np.linalg.norm(normals, axis=1)

    def seen(self, state: State, depth: NDArray[np.float32]) -> Array:
        """What a view shows of each sample (k,), squared pixels a squared metre; 0 where it is hidden.

        Parameters
        ----------
        depth : (h, w) of the object in ``state``, metres, infinite where it is not.

        Returns
        -------
        Negative where the corners of the triangle run anticlockwise in the image: the other side is seen.
        """
        positions = self._corners.in_camera(state)
        centres = positions.reshape(-1, 3, 3).mean(axis=1)
        areas = signed_areas(self._camera.project(positions).reshape(-1, 3, 2))
        tolerance = DEPTH_TOLERANCE * float(np.median(centres[:, 2]))
        shown = visible_points(self._camera.project(centres), centres[:, 2], depth, tolerance)
        shown &= np.isfinite(areas) & ((areas < 0.0) | (not self._closed))
        return np.where(shown, np.nan_to_num(areas) / self._areas, 0.0)


def covered_share(now: Array, reference: Array) -> float:
    """The share, by area in the image, of what is seen ``now`` (k,) that a reference view (k,) shows well."""
    served = (np.sign(now) == np.sign(reference)) & (np.abs(reference) >= LEAST_AREA * np.abs(now))
    total = np.abs(now).sum()
    return float(np.abs(now[served]).sum() / total) if total > 0.0 else 0.0


def choose_view(shares: Sequence[float], errors: Sequence[float], active: int) -> int | None:
    """Which reference view is to be followed; None where none serves and a new one is wanted.

    Parameters
    ----------
    shares : of the surface seen now that each view covers. errors : of each view's own state, metres.
    active : the view followed so far.
    """
    better = [k for k, share in enumerate(shares) if share >= BACK_SHARE and errors[k] < errors[active]]
    if better:
        return min(better, key=lambda k: errors[k])
    if shares[active] >= KEEP_SHARE:
        return active
    serving = [k for k, share in enumerate(shares) if share >= KEEP_SHARE]
    return max(serving, key=lambda k: shares[k]) if serving else None
