"""What a mesh that differs from the surface it was made from adds to the error of a registration."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from morph_dslam.model import ReducedModel
from morph_dslam.registration.messages import MeshOffSurface
from morph_dslam.registration.registration import KeyframePose, MapRegistration

Array = NDArray[np.float64]


def mesh_off_surface(model: ReducedModel) -> MeshOffSurface | None:
    """How far a model's mesh is off the surface that it was made from, as its file says; None if it is not off."""
    found = model.certificate.get("mesh_deviation")
    return found and MeshOffSurface(float(found["volume"]), float(found["mean_m"]))


def mesh_error_factors(off: MeshOffSurface, nodes: Array, scale: float) -> Array:
    """Standard deviations (7,) of log scale, rotation vector (rad) and translation (map units).

    The object is taken for larger or nearer by the cube root of the volume, and the distance may be the same all over
    the side that is seen, which shifts it, or opposite at its ends, which tilts it.

    Parameters
    ----------
    off : how far the mesh is off.
    nodes : (n, 3) of the undeformed mesh, metres.
    scale : map units per metre.
    """
    radius = float(np.sqrt(np.mean(np.sum((nodes - nodes.mean(axis=0)) ** 2, axis=1))))
    return np.array([abs(off.volume) / 3.0, *3 * [off.mean / radius], *3 * [scale * off.mean]])


def with_mesh_error(
    in_map: MapRegistration, keyframes: Sequence[KeyframePose], factors: Array
) -> tuple[MapRegistration, list[KeyframePose]]:
    """A registration and its keyframes' poses with further error factors (7,), which all keyframes have in common."""
    if in_map.covariance is not None:
        in_map = replace(in_map, covariance=in_map.covariance + np.diag(factors**2))
    poses = []
    for view in keyframes:
        more = in_map.slopes(view.pose) * factors
        if view.covariance is not None and view.error_factors is not None:
            both = np.hstack([view.error_factors, more])
            view = replace(view, covariance=view.covariance + more @ more.T, error_factors=both)
        poses.append(view)
    return in_map, poses
