"""Which of several pictures gives each part of the surface its texture."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from morph_dslam.online.measuring.binding import View, signed_areas
from morph_dslam.online.measuring.measurement import DEPTH_TOLERANCE
from morph_dslam.render.rasteriser import visible_points

Array = NDArray[np.float64]

#: Another picture takes a triangle over from the first where it shows that much more area: seams are few, and
#: the first picture's place is known best.
PREFERENCE = 2.0


def shown_areas(view: View, triangles: NDArray[np.int64], depth: NDArray[np.float32], closed: bool) -> Array:
    """Area (m,) of triangles (m, 3) in a picture, squared pixels; 0 where they are not wholly seen.

    Parameters
    ----------
    depth : (h, w) of the object in ``view``, metres. closed : whether only outer sides can be seen.
    """
    areas = signed_areas(view.pixels[triangles])
    tolerance = DEPTH_TOLERANCE * float(np.nanmedian(view.nodes[:, 2]))
    seen = visible_points(view.pixels, view.nodes[:, 2], depth, tolerance)
    # A corner on the outline may be hidden by its own neighbour within a pixel; the middle may not.
    middles = view.nodes[triangles].mean(axis=1)
    pixels = view.pixels[triangles].mean(axis=1)
    shown = seen[triangles].all(axis=1) & visible_points(pixels, middles[:, 2], depth, tolerance)
    shown &= np.isfinite(areas) & ((areas < 0.0) | (not closed))
    return np.where(shown, np.abs(areas), 0.0)


def choose_sources(areas: Sequence[Array]) -> NDArray[np.int64]:
    """The picture (m,) that shows each triangle largest, by the areas (m,) of all; the first in doubt."""
    scores = np.stack(list(areas))
    scores[0] *= PREFERENCE
    return scores.argmax(axis=0)


def part_from(number: int, triangle_ids: NDArray[np.int32], sources: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Pixels (h, w) that see a triangle whose texture is from picture ``number``.

    ``triangle_ids`` (h, w) says which triangle each pixel sees, -1 for none.
    """
    return np.append(sources == number, False)[triangle_ids]
