"""The overlay: the deformed mesh over the video, coloured by a node field, with a colour bar."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from morph_dslam.render.rasteriser import image_region, rasterise
from morph_dslam.render.shading import colour_bar, colour_table, flat_colour_bar, text_patch

Array = NDArray[np.float64]
#: The colour bar goes elsewhere where more than this share of it would lie on the object.
MOST_UNDER_BAR = 0.02
#: Grey level of a surface where the field has no value.
NO_VALUE = 130.0
#: Of values scaled to colours 0 to 255; what is above has the last one.
LAST_LEVEL = 255.5


@njit(cache=True, nogil=True)
def blend_surface(image, triangle_ids, weights, triangles, levels, brightness, table, alpha):
    """Blend the surface into ``image``.

    Parameters
    ----------
    image : (h, w, 3) uint8.
    triangle_ids, weights : from `rasterise`, of ``triangles`` (m, 3).
    levels : (n,) node values scaled to 0-255; grey around a node where it is NaN.
    brightness : (n,) factor on the colour.
    table : (256, 3) colours.
    alpha : opacity.
    """
    height, width = triangle_ids.shape
    for row in range(height):
        for column in range(width):
            t = triangle_ids[row, column]
            if t < 0:
                continue
            level, light = 0.0, 0.0
            for corner in range(3):
                node = triangles[t, corner]
                level += weights[row, column, corner] * levels[node]
                light += weights[row, column, corner] * brightness[node]
            known = not np.isnan(level)
            entry = int(min(max(level, 0.0), 255.0) + 0.5) if known else 0
            for channel in range(3):
                colour = min(light * (table[entry, channel] if known else NO_VALUE), 255.0)
                mixed = (1.0 - alpha) * image[row, column, channel] + alpha * colour
                image[row, column, channel] = np.uint8(mixed + 0.5)


@dataclass(frozen=True)
class _Painted:
    """Where a surface was painted: ``covered`` (h, w) of the part of the image that begins at ``corner``.

    ``corner`` is (column, row), pixels.
    """

    covered: NDArray[np.bool_]
    corner: tuple[int, int]

    def share(self, top: int, left: int, panel: NDArray[np.uint8]) -> float:
        """The share of a panel at (top, left) of the image that lies on the surface."""
        column, row = max(left - self.corner[0], 0), max(top - self.corner[1], 0)
        last = (top + panel.shape[0] - self.corner[1], left + panel.shape[1] - self.corner[0])
        below = self.covered[row : max(last[0], 0), column : max(last[1], 0)]
        return np.count_nonzero(below) / (panel.shape[0] * panel.shape[1])

    def box(self) -> tuple[int, int, int, int] | None:
        """First and last row, first and last column that are covered, in the image; None if none is."""
        column, row, width, height = cv2.boundingRect(self.covered.view(np.uint8))
        left, top = column + self.corner[0], row + self.corner[1]
        return (top, top + height - 1, left, left + width - 1) if width else None


def _draw_outline(image: NDArray[np.uint8], painted: _Painted, colour: tuple[int, int, int] = (245, 245, 245)) -> None:
    contours, _ = cv2.findContours(
        painted.covered.view(np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE, offset=painted.corner
    )
    cv2.drawContours(image, contours, -1, colour, 1, cv2.LINE_AA)


def _blend_panel(image: NDArray[np.uint8], panel: NDArray[np.uint8], top: int, left: int) -> None:
    """Blend a panel into ``image``, cut where it would leave it."""
    place = image[max(top, 0) : top + panel.shape[0], max(left, 0) : left + panel.shape[1]]
    place[:] = cv2.addWeighted(place, 0.12, panel[: place.shape[0], : place.shape[1]], 0.88, 0.0)


def _widened(value_range: tuple[float, float]) -> tuple[float, float]:
    """The range, or a little more where it is a single value."""
    low, high = value_range
    return low, high if high > low else low + 1e-9 + abs(low) * 1e-6


def colour_levels(node_values: Array, value_range: tuple[float, float]) -> Array:
    """Node values scaled so that 0 and 255 are the ends of the range."""
    low, high = _widened(value_range)
    return (np.asarray(node_values, dtype=np.float64) - low) * (255.0 / (high - low))


def paint_surface(
    image: NDArray[np.uint8],
    pixels: Array,
    depths: Array,
    triangles: NDArray,
    levels: Array,
    table: NDArray,
    alpha: float = 1.0,
    brightness: Array | None = None,
    closed: bool = False,
) -> _Painted:
    """Paint a surface into ``image``, which changes; only the part of it that the surface may cover is looked at.

    Other parameters are those of `blend_surface` and `draw_overlay`.
    """
    region = image_region(pixels, *image.shape[:2], margin=1)
    if region is None:
        return _Painted(np.zeros((1, 1), dtype=bool), (0, 0))
    rows, columns = region
    corner = (columns.start, rows.start)
    size = (rows.stop - rows.start, columns.stop - columns.start)
    corners = np.ascontiguousarray(triangles, dtype=np.int64)
    buffers = rasterise(pixels - np.array(corner, dtype=float), depths, corners, *size, closed=closed)
    light = np.ones(len(pixels)) if brightness is None else np.asarray(brightness, dtype=np.float64)
    part = image[rows, columns]
    blend_surface(part, buffers.triangle_ids, buffers.weights, corners, levels, light, table, float(alpha))
    return _Painted(buffers.covered, corner)


@dataclass(frozen=True)
class Panel:
    """A panel (h, w, 3) uint8 and where it would stand in an image."""

    image: NDArray[np.uint8]
    top: int
    left: int


class BarPlace:
    """Where the colour bar stands: on the right, until the object is there and elsewhere is more room for it.

    One of them serves a whole video, so that the bar does not jump to and fro.
    """

    def __init__(self) -> None:
        self._chosen = 0

    def choose(self, painted: _Painted, panels: Sequence[Panel]) -> Panel:
        """The panel to draw, of the same places in each image."""
        shares = [painted.share(panel.top, panel.left, panel.image) for panel in panels]
        best = next((k for k, share in enumerate(shares) if share <= MOST_UNDER_BAR), int(np.argmin(shares)))
        if shares[self._chosen] > MOST_UNDER_BAR and shares[best] < 0.5 * shares[self._chosen]:
            self._chosen = best
        return panels[self._chosen]


def _bar_panels(size: tuple[int, int], margin: int, upright: NDArray[np.uint8], flat: NDArray[np.uint8]) -> list[Panel]:
    """A colour bar at the right and left edge of an image of a size (h, w), and at its upper and lower one."""
    height, width = size
    right, low = width - margin - upright.shape[1], height - margin - flat.shape[0]
    across = max(width - margin - flat.shape[1], 0)
    return [
        Panel(upright, margin, right),
        Panel(upright, margin, margin),
        Panel(flat, margin, across),
        Panel(flat, low, across),
    ]


def draw_overlay(
    image: NDArray[np.uint8],
    pixels: Array,
    depths: Array,
    triangles: NDArray,
    node_values: Array,
    value_range: tuple[float, float],
    *,
    label: str,
    colour_map: str = "turbo",
    alpha: float = 0.65,
    brightness: Array | None = None,
    caption: str = "",
    closed: bool = False,
    bar: BarPlace | None = None,
) -> NDArray[np.uint8]:
    """Draw a surface coloured by a field over an image.

    Parameters
    ----------
    image : (h, w, 3) uint8, blue, green, red; not changed.
    pixels, depths : (n, 2) and (n,) projected nodes, NaN where not in front of the camera.
    triangles : (m, 3) node indices.
    node_values : (n,) the field in the unit that ``label`` names, for example von Mises stress in MPa; NaN where it
        has no value, which is drawn grey.
    value_range : values at the ends of the colour map; values beyond them take its end colours.
    label : name and unit of the field, for example "von Mises stress [MPa]"; no colour bar if empty. The bar ends in a
        point where there are values above the range.
    colour_map : a matplotlib colour map.
    alpha : opacity of the surface, 0 to 1.
    brightness : (n,) factor on the colour at each node, for example from `shading.lambert`; 1 by default.
    caption : text for the lower left corner.
    closed : see `rasterise`.
    bar : place of the colour bar, kept from frame to frame; chosen by this image alone if None.

    Returns
    -------
    (h, w, 3) uint8, a new image.
    """
    result = image.copy()
    height, width = image.shape[:2]
    scale = 0.42 * max(height / 480.0, 0.6)
    low, high = _widened(value_range)
    levels, table = colour_levels(node_values, value_range), colour_table(colour_map)
    painted = paint_surface(result, pixels, depths, triangles, levels, table, alpha, brightness, closed)
    _draw_outline(result, painted)
    margin = round(0.02 * height)
    if label:
        above = bool((levels[np.isfinite(levels)] > LAST_LEVEL).any())
        upright = colour_bar(round(0.6 * height), float(low), float(high), label, colour_map, scale, above)
        flat = flat_colour_bar(round(0.5 * width), float(low), float(high), label, colour_map, scale, above)
        panel = (bar or BarPlace()).choose(painted, _bar_panels((height, width), margin, upright, flat))
        _blend_panel(result, panel.image, panel.top, panel.left)
    if caption:
        lines = text_patch(caption, scale, width - 2 * margin)
        _blend_panel(result, lines, height - margin - lines.shape[0], margin)
    return result


def draw_inner_surface(
    image: NDArray[np.uint8],
    pixels: Array,
    depths: Array,
    triangles: NDArray,
    colour: tuple[int, int, int],
    *,
    label: str = "",
    alpha: float = 0.6,
    brightness: Array | None = None,
) -> NDArray[np.uint8]:
    """Draw a surface of one colour through all that hides it: what lies inside of the object.

    Parameters
    ----------
    image : (h, w, 3) uint8, blue, green, red, with the object drawn in it already; not changed.
    pixels, depths, triangles, brightness : of the inner surface, as of `draw_overlay`.
    colour : blue, green, red.
    label : written beside it.
    alpha : opacity, 0 to 1.

    Returns
    -------
    (h, w, 3) uint8, a new image.
    """
    result = image.copy()
    table = np.tile(np.array(colour, dtype=np.float64), (256, 1))
    painted = paint_surface(result, pixels, depths, triangles, np.zeros(len(pixels)), table, alpha, brightness)
    _draw_outline(result, painted, colour)
    box = painted.box()
    if label and box is not None:
        top, _, _, right = box
        patch = text_patch(label, 0.42 * max(image.shape[0] / 480.0, 0.6))
        left = min(right + 6, image.shape[1] - patch.shape[1])
        _blend_panel(result, patch, max(top - patch.shape[0], 0), max(left, 0))
    return result
