"""Where the object's bound points are seen in a frame, and which of these measurements to believe."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from morph_dslam.model import SurfacePoints
from morph_dslam.online.measuring.appearance import ReferenceAppearance, Rendering
from morph_dslam.online.measuring.binding import View, facing
from morph_dslam.online.measuring.flow import FlowOptions, follow
from morph_dslam.online.measuring.patches import compare_patches
from morph_dslam.render.rasteriser import visible_points

Array = NDArray[np.float64]

#: Pyramid levels that reach as far as a correction may: a quarter of the size, with windows of 17 pixels.
CORRECTION_LEVELS = 2
#: A point this share of the object's depth behind the z-buffer counts as hidden.
DEPTH_TOLERANCE = 0.01


@dataclass(frozen=True)
class MeasurementOptions:
    """What a measurement must satisfy.

    Attributes
    ----------
    patch_half : patches compared are (2 patch_half + 1) pixels wide.
    least_correlation : patches of the rendering and of the frame that agree less are rejected.
    largest_correction_px : a point found farther from where the rendering shows it is rejected.
    """

    patch_half: int = 7
    least_correlation: float = 0.6
    largest_correction_px: float = 12.0

    @property
    def window(self) -> int:
        """Side of the patches that tell where a point is, pixels."""
        return 2 * self.patch_half + 1


@dataclass(frozen=True)
class Measurement:
    """Points found in a frame.

    Attributes
    ----------
    pixels : (p, 2) where they were found. valid : (p,) which to believe.
    visible : (p,) which no other part of the object hides.
    spread : (p,) how exactly by what the patches differ, pixels, up to a factor; see `compare_patches`.
    depth : (h, w) metres, of the object as it was drawn for the comparison; None where it was not.
    """

    pixels: Array
    valid: NDArray[np.bool_]
    visible: NDArray[np.bool_]
    spread: Array
    depth: NDArray[np.float32] | None = None


def visible_surface(
    points: SurfacePoints,
    positions: Array,
    pixels: Array,
    view: View,
    triangles: NDArray[np.int64],
    appearance: ReferenceAppearance,
    rendering: Rendering,
) -> NDArray[np.bool_]:
    """Which surface points show the side that the reference view shows, with nothing of the object before it.

    Parameters
    ----------
    positions : (p, 3) of the points in the camera frame. pixels : (p, 2) of them.
    """
    same_side = facing(view, triangles[points.triangles]) == appearance.facing[points.triangles]
    depths = positions[:, 2]
    tolerance = DEPTH_TOLERANCE * float(np.median(depths))
    return same_side & visible_points(pixels, depths, rendering.depth, tolerance)


def compare_with_rendering(
    frame: NDArray[np.uint8],
    rendering: Rendering,
    predicted: Array,
    guesses: Array,
    visible: NDArray[np.bool_],
    flow: FlowOptions,
    options: MeasurementOptions,
) -> Measurement:
    """Follow points from the rendered reference view to the frame.

    Parameters
    ----------
    frame : (h, w) the flattened frame. predicted : (p, 2) where the rendering shows the points.
    guesses : (p, 2) where to start looking for them in the frame.
    """
    rows = np.flatnonzero(visible)
    near = replace(flow, levels=min(flow.levels, CORRECTION_LEVELS))
    found, ok = follow(rendering.image, frame, predicted[rows], guesses[rows], near)
    found, correlation, exactness = compare_patches(
        rendering.image, frame, predicted[rows], found, options.patch_half
    )
    correction = np.linalg.norm(found - predicted[rows], axis=1)
    ok &= (correction < options.largest_correction_px) & np.isfinite(exactness)
    ok &= correlation > options.least_correlation
    pixels, valid = predicted.copy(), np.zeros(len(predicted), dtype=bool)
    spread = np.full(len(predicted), np.inf)
    pixels[rows], valid[rows], spread[rows] = found, ok, exactness
    return Measurement(pixels, valid, visible, spread, rendering.depth)
