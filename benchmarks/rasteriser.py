"""The rasteriser's speed against the painter's algorithm on the same mesh, in the same run, on one thread.

The mesh is a bent sheet of 5 000 triangles over a third of a 640x480 image. The painter's algorithm draws OpenCV's
polygons and gives neither depth nor weights. Run: python benchmarks/rasteriser.py
"""

from __future__ import annotations

import time
from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray

from morph_dslam import Camera
from morph_dslam.extend.rendering import draw_overlay, rasterise, render_textured

CAMERA = Camera(640, 480, 528.0, 528.0, 320.0, 240.0)
COLUMNS, ROWS = 59, 44


def bent_sheet() -> tuple[NDArray, NDArray, NDArray]:
    """Nodes in the camera frame (metres), triangles, and texture coordinates of an arched A3 sheet."""
    s, t = (axis.ravel() for axis in np.meshgrid(np.linspace(-1, 1, COLUMNS), np.linspace(-1, 1, ROWS)))
    nodes = np.column_stack([0.21 * s, 0.1485 * t, 0.60 - 0.05 * (1 - s**2) + 0.02 * s * t])
    index = np.arange(ROWS * COLUMNS).reshape(ROWS, COLUMNS)
    a, b, c, d = (part.ravel() for part in (index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]))
    triangles = np.concatenate([np.column_stack([a, b, c]), np.column_stack([a, c, d])])
    return nodes, triangles, np.column_stack([(s + 1) * 299.5, (t + 1) * 199.5])


def paint(pixels: NDArray, depths: NDArray, triangles: NDArray) -> NDArray:
    """The painter's algorithm: all triangles from far to near, each in its number as its colour."""
    image = np.full((CAMERA.height, CAMERA.width), -1, dtype=np.int32)
    corners = np.rint(pixels[triangles]).astype(np.int32)
    for triangle in np.argsort(-depths[triangles].mean(axis=1)):
        cv2.fillConvexPoly(image, corners[triangle], int(triangle))
    return image


def median_ms(function: Callable[[], object], repeats: int) -> float:
    """Median time of a call after one call that compiles and warms up, milliseconds."""
    function()
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        function()
        times.append(time.perf_counter() - start)
    return 1e3 * float(np.median(times))


def main() -> None:
    cv2.setNumThreads(1)
    nodes, triangles, coordinates = bent_sheet()
    pixels, depths = CAMERA.project(nodes), np.ascontiguousarray(nodes[:, 2])
    size = (CAMERA.height, CAMERA.width)
    texture = np.random.default_rng(0).integers(0, 256, (400, 600, 3), dtype=np.uint8)
    image = np.zeros((*size, 3), dtype=np.uint8)
    values = np.linspace(0.0, 1.0, len(nodes))

    buffers = rasterise(pixels, depths, triangles, *size)
    own = median_ms(lambda: rasterise(pixels, depths, triangles, *size), 50)
    textured = median_ms(lambda: render_textured(buffers, triangles, coordinates, texture), 50)
    overlay = median_ms(
        lambda: draw_overlay(image, pixels, depths, triangles, values, (0, 1), label="von Mises stress [MPa]"), 30
    )
    painter = median_ms(lambda: paint(pixels, depths, triangles), 5)
    agreement = (paint(pixels, depths, triangles) >= 0) == buffers.covered

    print(f"{len(triangles)} triangles over {buffers.covered.mean():.0%} of 640x480, median ms")
    print(f"rasterise                 {own:8.2f}")
    print(f"render_textured           {textured:8.2f}")
    print(f"draw_overlay (all of it)  {overlay:8.2f}")
    print(f"painter, fillConvexPoly   {painter:8.2f}   {painter / own:6.1f} x rasterise")
    print(f"the painter covers the same pixels but for {1 - agreement.mean():.2%}")


if __name__ == "__main__":
    main()
