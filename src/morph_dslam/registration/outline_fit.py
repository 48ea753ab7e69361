"""Whether the keyframes show an object's outline where a place says that it is.

Faces that coincide with those of another object explain its points and agree between images, in any size; the
outline of the wrong mesh then lies inside or outside of the one that is seen. Across an outline the image
changes: there is an edge, or texture of one strength gives way to that of another. Each stretch of the drawn
outline is therefore cut along its normal into an inner part, an edge and an outer part with a mean gradient
each, where that is most likely for gradients that are distributed exponentially.

That few stretches have their cut where they are drawn is no evidence yet: before a background that looks
like the object they have it anywhere. Where the outline is elsewhere, neighbours have it equally far off.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_erosion, gaussian_filter, map_coordinates

from morph_dslam.camera import Camera
from morph_dslam.geometry import SimilarityTransform
from morph_dslam.registration.scene import View
from morph_dslam.render.rasteriser import rasterise

Array = NDArray[np.float64]
#: Directions around the object's middle into which its outline in a view is cut; pixels of a stretch.
N_STRETCHES, FEWEST_PIXELS = 24, 8
#: How far, pixels, to look to either side, half the width of an edge, and the least length of either part.
REACH, EDGE, PART = 16, 1, 4
#: An outline that lies where it is drawn is found between these, pixels outwards: blur carries texture out.
FOUND = (-2, 3)
#: Gradients, grey levels a pixel, that are noise; log likelihood by which a cut must be better than none.
NOISE, CLEAR_CUT = 0.3, 2.0
#: Share of the clear stretches that is enough: a quarter is found by chance.
FITTING = 0.4
#: Neighbours agree on an outline elsewhere to so many pixels; this share of so many pairs is no chance.
ALIKE, AGREED, FEWEST_PAIRS = 2, 0.6, 40


@dataclass(frozen=True)
class OutlineFit:
    """What keyframes show of an outline.

    Attributes
    ----------
    share : of the ``count`` stretches with a clear cut, those that have it where the outline is drawn.
    agreed : of the ``n_pairs`` neighbours that have it elsewhere, those that agree on where.
    """

    share: float = 0.0
    count: int = 0
    agreed: float = 0.0
    n_pairs: int = 0

    @property
    def contradicts(self) -> bool:
        """Whether the keyframes show that the outline is elsewhere."""
        elsewhere = self.n_pairs >= FEWEST_PAIRS and self.agreed > AGREED
        return elsewhere and self.share < FITTING


def outline_fit(
    place: SimilarityTransform, nodes: Array, triangles: NDArray[np.int64], views: Sequence[View], camera: Camera
) -> OutlineFit:
    """Compare the outline of a mesh with images.

    Parameters
    ----------
    place : metres to the map's unit.
    nodes : (n, 3) metres.
    camera : of the views, without distortion.
    """
    world = place.apply(nodes)
    found, agreed = np.zeros(0, dtype=bool), np.zeros(0, dtype=bool)
    for view in views:
        local = view.camera_from_world.apply(world)
        if local[:, 2].min() <= 0.0:
            continue
        drawn = rasterise(camera.project(local), local[:, 2], triangles, camera.height, camera.width)
        pixels, normals, stretches = _outline(np.asarray(drawn.covered, dtype=bool))
        offsets = _offsets(_across(view.normalized, pixels, normals), stretches)
        there = (offsets >= FOUND[0]) & (offsets <= FOUND[1])
        elsewhere = np.isfinite(offsets) & ~there
        pairs = elsewhere & np.roll(elsewhere, 1)
        found = np.append(found, there[np.isfinite(offsets)])
        agreed = np.append(agreed, np.abs(offsets - np.roll(offsets, 1))[pairs] <= ALIKE)
    return OutlineFit(_share(found), len(found), _share(agreed), len(agreed))


def _share(chosen: NDArray[np.bool_]) -> float:
    return float(chosen.mean()) if len(chosen) else 0.0


def _offsets(gradients: Array, stretches: NDArray[np.int64]) -> Array:
    """Where each stretch (`N_STRETCHES`,) has its cut, pixels outwards; NaN without a clear one."""
    offsets = np.full(N_STRETCHES, np.nan)
    for number in np.unique(stretches):
        rows = stretches == number
        if rows.sum() >= FEWEST_PIXELS:
            offset, gain = clearest_cut(gradients[rows].mean(axis=0))
            offsets[number] = offset if gain > CLEAR_CUT else np.nan
    return offsets


def clearest_cut(gradients: Array) -> tuple[int, float]:
    """Where a profile (2 `REACH` + 1,) from inside to outside changes, and the log likelihood gained by it.

    Values of an exponential distribution of mean m have the log likelihood -log m - 1 each, on average.
    """
    values = gradients + NOISE
    places = np.arange(PART, len(values) - PART)
    gains = np.full(len(places), len(values) * np.log(values.mean()))
    for row, place in enumerate(places):
        for part in np.split(values, [place - EDGE, place + EDGE + 1]):
            gains[row] -= len(part) * np.log(part.mean())
    best = int(gains.argmax())
    return int(places[best]) - REACH, float(gains[best])


def _outline(covered: NDArray[np.bool_]) -> tuple[Array, Array, NDArray[np.int64]]:
    """Pixels (p, 2) just inside the outline, far from the image's border; outward normals; stretches (p,)."""
    inner = np.asarray(binary_erosion(covered, np.ones((3, 3))), dtype=bool)
    rows, columns = np.nonzero(covered & ~inner)
    slope = np.gradient(gaussian_filter(covered.astype(float), 2.0))
    normals = -np.column_stack([slope[1][rows, columns], slope[0][rows, columns]])
    length = np.linalg.norm(normals, axis=1)
    height, width = covered.shape
    margin = REACH + 2
    kept = (columns >= margin) & (rows >= margin) & (columns < width - margin) & (rows < height - margin)
    kept &= length > 0.05  # tips and thin parts have no side
    pixels = np.column_stack([columns, rows])[kept].astype(float)
    middle = np.argwhere(covered).mean(axis=0)[::-1] if covered.any() else np.zeros(2)
    angles = np.arctan2(*(pixels - middle).T[::-1])
    stretches = np.floor((angles / (2.0 * np.pi) + 0.5) * N_STRETCHES).astype(np.int64) % N_STRETCHES
    return pixels, normals[kept] / length[kept, None], stretches


def _across(image: NDArray[np.uint8], pixels: Array, normals: Array) -> Array:
    """Absolute gradients (p, 2 `REACH` + 1) along the normals, from inside to outside."""
    slope_y, slope_x = np.gradient(gaussian_filter(image.astype(float), 1.0))
    steps = np.arange(-REACH, REACH + 1) + 0.5  # the outline runs between two pixels
    x, y = (pixels[:, k, None] + steps * normals[:, k, None] for k in range(2))
    along_x, along_y = (map_coordinates(slope, [y, x], order=1) for slope in (slope_x, slope_y))
    return np.abs(along_x * normals[:, :1] + along_y * normals[:, 1:])
