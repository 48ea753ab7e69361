"""Shading: vertex normals of a mesh and Lambert's law."""

from __future__ import annotations

from functools import lru_cache

import cv2
import matplotlib
import numpy as np
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from morph_dslam.model.reduced_model import triangle_normals

Array = NDArray[np.float64]


def vertex_normals(points: Array, triangles: NDArray) -> Array:
    """Unit normals (n, 3) of a surface at its nodes, the mean of the triangles around them by area.

    Parameters
    ----------
    points : (n, 3) node positions.
    triangles : (m, 3), whose order of nodes gives the normal its side.
    """
    nodes, normals = triangles.T.ravel(), triangle_normals(points, triangles)
    sums = np.column_stack([np.bincount(nodes, np.tile(component, 3), len(points)) for component in normals.T])
    lengths = np.linalg.norm(sums, axis=1, keepdims=True)
    return np.divide(sums, lengths, out=np.zeros_like(sums), where=lengths > 0.0)


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
    colours = matplotlib.colormaps[name](np.arange(256), bytes=True)
    return np.ascontiguousarray(colours[:, 2::-1])


def text_patch(text: str, scale: float) -> NDArray[np.uint8]:
    """A dark patch (height, width, 3) with one line of text."""
    (width, height), below = cv2.getTextSize(text, FONT, scale, 1)
    patch = np.full((height + below + 4, width + 4, 3), BACKGROUND, dtype=np.uint8)
    cv2.putText(patch, text, (2, height + 2), FONT, scale, (250, 250, 250), 1, cv2.LINE_AA)
    return patch


def _paste(panel: NDArray[np.uint8], patch: NDArray[np.uint8], top: int, left: int) -> None:
    height, width = min(patch.shape[0], panel.shape[0] - top), min(patch.shape[1], panel.shape[1] - left)
    panel[top : top + height, left : left + width] = patch[:height, :width]


@lru_cache
def colour_bar(height: int, low: float, high: float, label: str, colour_map: str, scale: float) -> NDArray[np.uint8]:
    """A panel (height, width, 3) with a vertical colour bar, its numbers, and its label along it.

    Parameters
    ----------
    height : of the panel, pixels.
    low, high : values at the bar's ends, in the unit that ``label`` names.
    scale : size of the text, as OpenCV's ``fontScale``.
    """
    ticks = [tick for tick in MaxNLocator(5, steps=[1, 2, 2.5, 5, 10]).tick_values(low, high) if low <= tick <= high]
    numbers = [text_patch(f"{tick:.6g}", scale) for tick in ticks]
    label_patch = np.rot90(text_patch(label, scale))
    margin, bar_width = round(14 * scale), round(34 * scale)
    bar_left = label_patch.shape[1] + 2 * margin
    number_left = bar_left + bar_width + 2 * margin
    width = number_left + max(number.shape[1] for number in numbers) + margin
    panel = np.full((height, width, 3), BACKGROUND, dtype=np.uint8)
    top, bottom = 2 * margin, height - 1 - 2 * margin
    ramp = np.linspace(255, 0, bottom - top + 1).round().astype(int)
    panel[top : bottom + 1, bar_left : bar_left + bar_width] = colour_table(colour_map)[ramp][:, None]
    for tick, number in zip(ticks, numbers, strict=True):
        row = round(bottom - (tick - low) / (high - low) * (bottom - top))
        panel[row, bar_left + bar_width : number_left - margin // 2] = 250
        _paste(panel, number, max(row - number.shape[0] // 2, 0), number_left)
    _paste(panel, label_patch, max((height - label_patch.shape[0]) // 2, 0), margin)
    return panel
