"""Whether landmarks would fit an object if its mesh had been read in another unit."""

from __future__ import annotations

from itertools import permutations

import numpy as np
from numpy.typing import NDArray

from morph_dslam.model import ReducedModel
from morph_dslam.online.measuring.binding import nearest_surface_points

Array = NDArray[np.float64]

#: Units that meshes come in, metres.
UNITS = {"metres": 1.0, "centimetres": 0.01, "millimetres": 1e-3, "inches": 0.0254}
#: Landmarks in another unit must be spread over this share of the object: on a point they lie anywhere.
LEAST_SPREAD = 0.2
#: On a sheet landmarks lie in any smaller unit: those spread over less than the first share of it, which
#: would be spread over more than the second in another one, are flagged.
PART_OF_IT, MOST_OF_IT = 0.5, 0.6


def unit_hint(model: ReducedModel, points: Array, surface_share: float, least: float = LEAST_SPREAD) -> str:
    """What to say where the landmarks (k, 3) would lie on the object if its mesh were in another unit.

    Parameters
    ----------
    surface_share : how far they may lie off it, and ``least`` : how far they must be spread, as shares of the
        object's size.
    """
    size, hint = extent(model.nodes), ""
    best = least * size
    for (meant, a), (taken, b) in permutations(UNITS.items(), 2):
        scaled = points * (b / a)
        _, distances = nearest_surface_points(model.nodes, model.triangles, scaled)
        if distances.max() <= surface_share * size and extent(scaled) > best:
            best = extent(scaled)
            hint = (
                f"; they fit if its mesh is multiplied by {a / b:.4g}: one in {meant} was taken for one in "
                f"{taken}, perhaps, so mend its unit in the study"
            )
    return hint


def flag_of_unit(model: ReducedModel, points: Array, surface_share: float) -> tuple[str, ...]:
    """A flag where landmarks (k, 3) lie on a part of the object, and all over it in another unit."""
    size, spread = extent(model.nodes), extent(points)
    hint = unit_hint(model, points, surface_share, MOST_OF_IT) if spread < PART_OF_IT * size else ""
    if not hint:
        return ()
    apart = f"{1e3 * spread:.4g} mm apart on an object of {1e3 * size:.4g} mm"
    return (f"registration doubtful: the landmarks are {apart}{hint}",)


def extent(points: Array) -> float:
    """Length of the diagonal of the box around points (n, 3)."""
    return float(np.linalg.norm(np.ptp(points, axis=0)))
