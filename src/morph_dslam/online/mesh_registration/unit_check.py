"""Whether an object that is not found in a metric map would be if its mesh were in another unit."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from morph_dslam.camera import PinholeCamera
from morph_dslam.errors import RegistrationError
from morph_dslam.online.mesh_registration.register import MeshRegistration, register_mesh
from morph_dslam.online.mesh_registration.scene import MapPoints, View

Array = NDArray[np.float64]


def register_in_unit(
    nodes: Array,
    triangles: NDArray[np.int64],
    points: MapPoints,
    views: Sequence[View],
    camera: PinholeCamera,
    metric: bool,
    progress: bool = False,
) -> MeshRegistration:
    """As `register_mesh`; an object that a metric map does not hold is looked for in other sizes.

    A monocular map has no unit: there an object of another size is found, with another map_units_per_metre,
    and nobody can tell.

    Raises
    ------
    RegistrationError
        If the object is not found; the message says in which size it would have been.
    """
    try:
        return register_mesh(nodes, triangles, points, views, camera, metric, progress)
    except RegistrationError as error:
        if not metric:
            raise
        try:
            found = register_mesh(nodes, triangles, points, views, camera, False, progress)
        except RegistrationError:
            raise error from None
        if found.ambiguous:
            raise
        raise RegistrationError(
            "the object was not found in its size, but one of its shape that is "
            f"{found.world_from_object.scale:.4g} times as large is there, and the map is metric: mend the "
            "unit of the study's mesh"
        ) from None
