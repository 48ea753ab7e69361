"""Shading: vertex normals of a mesh and Lambert's law."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]


@njit(cache=True, nogil=True)
def _sum_normals(points, triangles, normals):
    """Add to ``normals`` (n, 3) the normals of all triangles, as long as these are large, and normalise."""
    for t in range(len(triangles)):
        i, j, k = triangles[t, 0], triangles[t, 1], triangles[t, 2]
        ux, uy, uz = points[j, 0] - points[i, 0], points[j, 1] - points[i, 1], points[j, 2] - points[i, 2]
        vx, vy, vz = points[k, 0] - points[i, 0], points[k, 1] - points[i, 1], points[k, 2] - points[i, 2]
        x, y, z = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
        for node in (i, j, k):
            normals[node, 0] += x
            normals[node, 1] += y
            normals[node, 2] += z
    for n in range(len(normals)):
        length = np.sqrt(normals[n, 0] ** 2 + normals[n, 1] ** 2 + normals[n, 2] ** 2)
        if length > 0.0:
            for c in range(3):
                normals[n, c] /= length


def vertex_normals(points: Array, triangles: NDArray) -> Array:
    """Unit normals (n, 3) of a surface at its nodes, the mean of the triangles around them by area.

    Parameters
    ----------
    points : (n, 3) node positions.
    triangles : (m, 3), whose order of nodes gives the normal its side.
    """
    normals = np.zeros((len(points), 3))
    _sum_normals(np.asarray(points, dtype=np.float64), np.asarray(triangles, dtype=np.int64), normals)
    return normals


def lambert(normals: Array, to_light: Array, ambient: float) -> Array:
    """Brightness (n,) from ``ambient`` to 1 of a matt surface that looks alike from both sides.

    Parameters
    ----------
    normals : (n, 3) unit normals turned towards the viewer or away, which makes no difference.
    to_light : (3,) direction from the surface to a distant light, of any length.
    ambient : brightness of a part that the light only grazes, 0 to 1.
    """
    cosine = np.abs(normals @ (to_light / np.linalg.norm(to_light)))
    return ambient + (1.0 - ambient) * cosine


FONT = cv2.FONT_HERSHEY_SIMPLEX
#: Grey level of the panels behind text, dark enough for white letters on any video.
BACKGROUND = 38


@lru_cache
def colour_table(name: str) -> NDArray[np.uint8]:
    """The 256 colours (256, 3) of a matplotlib colour map, as blue, green, red."""
    import matplotlib  # it takes long to load, and not all who import this draw

    colours = matplotlib.colormaps[name](np.arange(256), bytes=True)
    return np.ascontiguousarray(colours[:, 2::-1])


def text_patch(text: str, scale: float, widest: int | None = None) -> NDArray[np.uint8]:
    """A dark patch (height, width, 3) with text, in one line, or in as many as ``widest`` pixels ask for."""
    lines = [text] if widest is None else _wrapped(text, scale, widest - 4)
    sizes = [cv2.getTextSize(line, FONT, scale, 1) for line in lines]
    width, height = (max(size[axis] for size, _ in sizes) for axis in (0, 1))
    step = height + max(below for _, below in sizes) + 4
    patch = np.full((step * len(lines), width + 4, 3), BACKGROUND, dtype=np.uint8)
    for number, line in enumerate(lines):
        place = (2, number * step + height + 2)
        cv2.putText(patch, line, place, FONT, scale, (250, 250, 250), 1, cv2.LINE_AA)
    return patch


def _wrapped(text: str, scale: float, widest: int) -> list[str]:
    """Lines of whole words, each as long as fits into so many pixels."""
    lines: list[str] = []
    for word in text.split():
        longer = f"{lines[-1]} {word}" if lines else word
        if lines and cv2.getTextSize(longer, FONT, scale, 1)[0][0] <= widest:
            lines[-1] = longer
        else:
            lines.append(word)
    return lines or [text]


def _paste(panel: NDArray[np.uint8], patch: NDArray[np.uint8], top: int, left: int) -> None:
    height, width = min(patch.shape[0], panel.shape[0] - top), min(patch.shape[1], panel.shape[1] - left)
    panel[top : top + height, left : left + width] = patch[:height, :width]


@lru_cache
def colour_bar(
    height: int, low: float, high: float, label: str, colour_map: str, scale: float, above: bool = False
) -> NDArray[np.uint8]:
    """A panel (height, width, 3) with a vertical colour bar, its numbers, and its label along it.

    Parameters
    ----------
    height : of the panel, pixels.
    low, high : values at the bar's ends, in the unit that ``label`` names.
    scale : size of the text, as OpenCV's ``fontScale``.
    above : whether there are values above ``high``, which have its colour: the bar then ends in a point.
    """
    ticks, numbers = _ticks(low, high, scale)
    label_patch = np.rot90(text_patch(label, scale))
    margin, bar_width = round(14 * scale), round(34 * scale)
    bar_left = label_patch.shape[1] + 2 * margin
    number_left = bar_left + bar_width + 2 * margin
    width = number_left + max(number.shape[1] for number in numbers) + margin
    panel = np.full((height, width, 3), BACKGROUND, dtype=np.uint8)
    top, bottom = 2 * margin, height - 1 - 2 * margin
    ramp = np.linspace(255, 0, bottom - top + 1).round().astype(int)
    panel[top : bottom + 1, bar_left : bar_left + bar_width] = colour_table(colour_map)[ramp][:, None]
    if above:
        _point(panel, [(bar_left, top), (bar_left + bar_width - 1, top), (bar_left + bar_width // 2, margin // 2)])
    for tick, number in zip(ticks, numbers, strict=True):
        row = round(bottom - (tick - low) / (high - low) * (bottom - top))
        panel[row, bar_left + bar_width : number_left - margin // 2] = 250
        _paste(panel, number, max(row - number.shape[0] // 2, 0), number_left)
    _paste(panel, label_patch, max((height - label_patch.shape[0]) // 2, 0), margin)
    return panel


@lru_cache
def flat_colour_bar(
    width: int, low: float, high: float, label: str, colour_map: str, scale: float, above: bool = False
) -> NDArray[np.uint8]:
    """A panel (height, width, 3) with a horizontal colour bar, its label above and its numbers below it.

    Parameters are those of `colour_bar`, but for its least ``width`` in pixels.
    """
    ticks, numbers = _ticks(low, high, scale)
    label_patch, margin, bar_height = text_patch(label, scale), round(10 * scale), round(24 * scale)
    bar_top = label_patch.shape[0] + 2 * margin
    number_top = bar_top + bar_height + margin
    inset = max(margin + max(number.shape[1] for number in numbers) // 2, bar_height)
    width = max(width, label_patch.shape[1] + 2 * inset)
    panel = np.full((number_top + numbers[0].shape[0] + margin, width, 3), BACKGROUND, dtype=np.uint8)
    left, right = inset, width - 1 - inset
    ramp = np.linspace(0, 255, right - left + 1).round().astype(int)
    panel[bar_top : bar_top + bar_height, left : right + 1] = colour_table(colour_map)[ramp][None]
    if above:
        middle = bar_top + bar_height // 2
        _point(panel, [(right, bar_top), (right, bar_top + bar_height - 1), (right + inset - margin // 2, middle)])
    for tick, number in zip(ticks, numbers, strict=True):
        column = round(left + (tick - low) / (high - low) * (right - left))
        panel[bar_top + bar_height : number_top, column] = 250
        _paste(panel, number, number_top, max(column - number.shape[1] // 2, 0))
    _paste(panel, label_patch, margin, inset)
    return panel


def _point(panel: NDArray[np.uint8], corners: Sequence[tuple[int, int]]) -> None:
    """Fill a triangle with the colour that the bar has at its first corner (column, row)."""
    column, row = corners[0]
    colour = tuple(int(channel) for channel in panel[row, column])
    cv2.fillPoly(panel, [np.array(corners, dtype=np.int32)], colour, cv2.LINE_AA)


def _ticks(low: float, high: float, scale: float) -> tuple[list[float], list[NDArray[np.uint8]]]:
    """Round values from ``low`` to ``high``, and each as text."""
    from matplotlib.ticker import MaxNLocator

    ticks = [tick for tick in MaxNLocator(5, steps=[1, 2, 2.5, 5, 10]).tick_values(low, high) if low <= tick <= high]
    return ticks, [text_patch(f"{tick:.6g}", scale) for tick in ticks]
