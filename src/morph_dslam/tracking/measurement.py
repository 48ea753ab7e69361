"""What the object looks like: the reference pictures as its texture, rendered in any other state.

Measurements against this rendering always refer to the reference pictures, so their errors do not accumulate
from frame to frame, and points that were hidden come back by themselves.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from morph_dslam.camera import Camera
from morph_dslam.model import ReducedModel
from morph_dslam.render.packed_texture import PARTS, grey_at, pack_texture
from morph_dslam.render.rasteriser import corner_weights, covered_steps, pack_nodes, pixel_window, visible_points
from morph_dslam.tracking.binding import Drawing, View, signed_areas
from morph_dslam.tracking.patches import NEUTRAL, compare_patches, follow

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Rendering:
    """A rendered view.

    Attributes
    ----------
    grey : (h, w) float32, the contrast-normalized texture as it should appear; `NEUTRAL` off the object.
    image : (h, w) uint8, the same in whole grey levels.
    depth : (h, w) float32 metres, infinity off the object.
    triangle_ids : (h, w) int32, the triangle that a pixel sees, -1 off the object.
    """

    grey: NDArray[np.float32]
    image: NDArray[np.uint8]
    depth: NDArray[np.float32]
    triangle_ids: NDArray[np.int32]


#: Reference pictures are enlarged so many times, by Lanczos' kernel. Bilinear interpolation between pixels of the
#: picture itself shifts texture by up to some hundredths of a pixel, as far as it is from whole and half ones.
FINER = 2


class ReferenceAppearance:
    """Reference pictures as a texture.

    Parameters
    ----------
    normalized_images : (h, w) each, the contrast-normalized pictures
    views : the mesh in each of them.
    sources : (m,) the picture that gives each triangle its texture; the first by default.
    closed : see `rasterise`.
    """

    def __init__(
        self,
        model: ReducedModel,
        camera: Camera,
        normalized_images: Sequence[NDArray[np.uint8]],
        views: Sequence[View],
        sources: NDArray[np.int64] | None = None,
        closed: bool = False,
    ) -> None:
        self._triangles, self._closed = np.ascontiguousarray(model.triangles, dtype=np.int64), closed
        self._camera = camera
        sources = np.zeros(len(self._triangles), dtype=np.int64) if sources is None else sources
        # One picture below the other, so that a triangle's place says which one it is from.
        parts, below = [], 0
        self._coordinates = np.empty((len(self._triangles), 3, 3))
        for number, (image, view) in enumerate(zip(normalized_images, views, strict=True)):
            rows = sources == number
            corners = self._triangles[rows]
            part, corner = _finer_part(image, view.pixels[corners])
            places = FINER * (view.pixels - corner) + 0.5 * (FINER - 1) + [0.0, below]
            depths = view.nodes[:, 2:]
            self._coordinates[rows] = np.hstack([places * depths, depths])[corners]
            parts.append(part)
            below += len(part)
        width = max(part.shape[1] for part in parts)
        of_one_width = [np.pad(part, ((0, 0), (0, width - part.shape[1])), mode="edge") for part in parts]
        self._texture = pack_texture(np.concatenate(of_one_width))

    def render(self, view: View) -> Rendering:
        """The object alone, in another view of it."""
        height, width = self._camera.height, self._camera.width
        grey = np.full((height, width), NEUTRAL, dtype=np.float32)
        depth = np.full((height, width), np.inf, dtype=np.float32)
        triangle_ids = np.full((height, width), -1, dtype=np.int32)
        draw_textured(
            view.pixels,
            np.ascontiguousarray(view.nodes[:, 2]),
            self._triangles,
            self._coordinates,
            self._texture,
            self._closed,
            grey,
            depth,
            triangle_ids,
        )
        return Rendering(grey, cv2.convertScaleAbs(grey), depth, triangle_ids)  # type: ignore[arg-type]


def _finer_part(image: NDArray[np.uint8], pixels: Array) -> tuple[NDArray[np.uint8], Array]:
    """The part of a picture (h, w) about pixels (..., 2), enlarged, and the pixel (2,) where it begins."""
    inside = pixels[np.isfinite(pixels).all(axis=-1)]
    height, width = image.shape
    if not len(inside):
        inside = np.zeros((1, 2))
    margin = 8  # more than the kernel reaches
    least = np.clip(np.floor(inside.min(axis=0)) - margin, 0, [width - 1, height - 1]).astype(np.int64)
    most = np.clip(np.ceil(inside.max(axis=0)) + margin + 1, least + 1, [width, height]).astype(np.int64)
    part = image[least[1] : most[1], least[0] : most[0]]
    finer = cv2.resize(part, None, fx=FINER, fy=FINER, interpolation=cv2.INTER_LANCZOS4)
    return finer, least.astype(np.float64)  # type: ignore[return-value]


@njit(cache=True, nogil=True, error_model="numpy")
def draw_textured(pixels, depths, triangles, coordinates, texture, closed, grey, depth, triangle_ids):
    """Draw a textured surface over what is in ``grey``, ``depth`` and ``triangle_ids`` already.

    Parameters
    ----------
    pixels, depths, triangles, closed : see `rasterise`.
    coordinates : (m, 3, 3) column and row of each triangle's corners in the texture, texture pixels, times their depth
        in the camera that took it, and that depth; outside, and where they are NaN, it is its border
    texture : (H, W) of `pack_texture`.
    grey, depth, triangle_ids : (h, w) float32, float32, the unit of ``depths``, and int32; changed where the surface is
        nearest.
    """
    nodes, terms = pack_nodes(pixels, depths), np.empty((3, 4))
    for t in range(triangles.shape[0]):
        triangle, corners = triangles[t], coordinates[t]
        left, right, top, bottom = pixel_window(nodes, triangle, closed, *depth.shape)
        if bottom < top:
            continue
        # Pixels of the picture are projective on a triangle, not linear: linear are these, of which they are ratios.
        for i in range(3):
            q = nodes[triangle[i], 2]
            terms[i, 0], terms[i, 1] = q, q * corners[i, 2]
            terms[i, 2], terms[i, 3] = PARTS * q * corners[i, 0], PARTS * q * corners[i, 1]
        b0_first, b1_first, b0_right, b1_right, b0_down, b1_down = corner_weights(nodes, triangle, left, top)
        b2_right = -b0_right - b1_right
        steps = 1.0 / b0_right, 1.0 / b1_right, 1.0 / b2_right
        q_right, w_right = _at(terms, 0, b0_right, b1_right, b2_right), _at(terms, 1, b0_right, b1_right, b2_right)
        x_right, y_right = _at(terms, 2, b0_right, b1_right, b2_right), _at(terms, 3, b0_right, b1_right, b2_right)
        for row in range(top, bottom + 1):
            b0, b1 = b0_first + (row - top) * b0_down, b1_first + (row - top) * b1_down
            b2 = 1.0 - b0 - b1
            first, last = covered_steps(b0, b0_right, steps[0], 0.0, float(right - left))
            first, last = covered_steps(b1, b1_right, steps[1], first, last)
            first, last = covered_steps(b2, b2_right, steps[2], first, last)
            q, w = _at(terms, 0, b0, b1, b2), _at(terms, 1, b0, b1, b2)
            x, y = _at(terms, 2, b0, b1, b2), _at(terms, 3, b0, b1, b2)
            for k in range(int(np.ceil(first)), int(np.floor(last)) + 1):
                z, column = np.float32(1.0 / (q + k * q_right)), left + k
                if z < depth[row, column]:
                    depth[row, column], triangle_ids[row, column] = z, t
                    scale = 1.0 / (w + k * w_right)
                    grey[row, column] = grey_at(texture, (x + k * x_right) * scale, (y + k * y_right) * scale)


@njit(cache=True, nogil=True, error_model="numpy")
def _at(terms, number, b0, b1, b2):
    """A quantity of the corners (3, 4) of a triangle where they have these weights."""
    return b0 * terms[0, number] + b1 * terms[1, number] + b2 * terms[2, number]


#: Pyramid levels that reach as far as a correction may: a quarter of the size, with windows of 17 pixels.
CORRECTION_LEVELS = 2
#: Points that are followed from frame to frame for each unknown, for a state from which all of them are within reach;
#: at least and at most so many.
FOLLOWED_A_UNKNOWN, LEAST_FOLLOWED, MOST_FOLLOWED = 8, 64, 200
#: Patches compared are (2 PATCH_HALF + 1) pixels wide.
PATCH_HALF = 7
PATCH_WINDOW = 2 * PATCH_HALF + 1
#: Patches of the rendering and of the frame that agree less are rejected.
LEAST_CORRELATION = 0.6
#: A point found farther from where the rendering shows it, pixels, is rejected.
LARGEST_CORRECTION_PX = 12.0
#: A point this share of the object's depth behind the z-buffer counts as hidden.
DEPTH_TOLERANCE = 0.01


@dataclass(frozen=True)
class Followed:
    """Points followed from the last frame to the next one.

    Attributes
    ----------
    pixels : (p, 2) where they were found, or are expected.
    valid : (p,) which were found.
    offsets : (p, 2) pixels, how far from where the state has them they were in the last frame.
    """

    pixels: Array
    valid: NDArray[np.bool_]
    offsets: Array


@dataclass(frozen=True)
class Measurement:
    """Points found in a frame.

    Attributes
    ----------
    pixels : (p, 2) where they were found, at the middle row's instant.
    recorded : (p, 2) where the image shows that; with a global shutter the same.
    valid : (p,) which to believe.
    visible : (p,) which the picture shows whole, windows included, and no other part of the object hides.
    spread : (p,) how exactly by what the patches differ, pixels, up to a factor; see `compare_patches`.
    drawing : of the object, made for the comparison; None where there was none.
    rendered : (h, w), the reference view in the drawing's state, contrast-normalized; None where there was none.
    """

    pixels: Array
    recorded: Array
    valid: NDArray[np.bool_]
    visible: NDArray[np.bool_]
    spread: Array
    drawing: Drawing | None = None
    rendered: NDArray[np.uint8] | None = None


@njit(cache=True, nogil=True)
def visible_surface(corners, corner_pixels, is_front, broadness, positions, pixels, depth, tolerance):
    """Which surface points show the side that the reference view shows, broadly enough, with nothing before them.

    Their windows must be in the picture: a point at its rim cannot be compared, whether it is there or not.

    Parameters
    ----------
    corners, corner_pixels : (3 p, 3) in the camera frame, metres, and (3 p, 2) of each point's triangle.
    is_front : (p,) whether the corners ran clockwise in the reference view's image; see `binding.facing`.
    broadness : (p,) the least `binding.foreshortening` of the triangles.
    positions, pixels : (p, 3) and (p, 2) of the points.
    depth : (h, w) of the object, metres, infinite where it is not.
    tolerance : metres by which a point may be behind that.
    """
    seen, (height, width), margin = np.zeros(len(positions), np.bool_), depth.shape, PATCH_HALF + 1
    for j in range(len(positions)):
        a, b, c = corner_pixels[3 * j], corner_pixels[3 * j + 1], corner_pixels[3 * j + 2]
        area = 0.5 * ((b[0] - a[0]) * (c[1] - a[1]) - (c[0] - a[0]) * (b[1] - a[1]))
        far = (corners[3 * j, 2] + corners[3 * j + 1, 2] + corners[3 * j + 2, 2]) / 3.0
        x, y = pixels[j, 0], pixels[j, 1]
        if (area > 0.0) != is_front[j] or not abs(area) * far**2 >= broadness[j]:
            continue
        if margin <= x < width - 1 - margin and margin <= y < height - 1 - margin:  # as `compare_patches` has it
            seen[j] = positions[j, 2] <= depth[int(np.rint(y)), int(np.rint(x))] + tolerance
    return seen


def compare_with_rendering(
    frame: NDArray[np.uint8],
    rendering: Rendering,
    predicted: Array,
    visible: NDArray[np.bool_],
    offsets: Array | None = None,
    drift: Array | None = None,
) -> Measurement:
    """Follow points from the rendered reference view to the frame.

    Where it is known about where they are, they are looked for right there first.

    Parameters
    ----------
    frame : (h, w) the contrast-normalized frame
    predicted : (p, 2) where the rendering shows the points.
    visible : (p,) which of them can be seen; their windows are in the picture there.
    offsets : (p, 2) how far from there they are about to be in the frame; None where that is not known.
    drift : (p, 2) how far from there a rolling shutter shows them; None of a global one.
    """
    shown = predicted if drift is None else predicted + drift
    if drift is not None:  # the window is compared there, too
        visible = visible & _windows_inside(shown, frame.shape)
    pixels, valid = shown.copy(), np.zeros(len(predicted), dtype=bool)
    spread = np.full(len(predicted), np.inf)

    def look_for(rows: NDArray[np.int64], guesses: Array, levels: int) -> None:
        places = predicted[rows]
        found, ok = follow(rendering.image, frame, places, guesses, levels)
        # Whole levels do not show shifts that change them by less than half of one: the state would stay there.
        found, correlation, exactness = compare_patches(rendering.grey, frame, places, found, PATCH_HALF)
        near = np.linalg.norm(found - shown[rows], axis=1) < LARGEST_CORRECTION_PX
        ok &= near & np.isfinite(exactness) & (correlation > LEAST_CORRELATION)
        pixels[rows], valid[rows], spread[rows] = found, ok, exactness

    if offsets is not None:
        rows = np.flatnonzero(visible)
        look_for(rows, predicted[rows] + offsets[rows], 0)
    rows = np.flatnonzero(visible & ~valid)
    look_for(rows, shown[rows], CORRECTION_LEVELS)
    return Measurement(pixels, pixels, valid, visible, spread)


def _windows_inside(pixels: Array, shape: Sequence[int]) -> NDArray[np.bool_]:
    """Which points (p, 2) have their window in a picture of this shape, as `compare_patches` has it."""
    least = PATCH_HALF + 1
    with np.errstate(invalid="ignore"):
        inside = (pixels >= least) & (pixels < [shape[1] - 1 - least, shape[0] - 1 - least])
    return np.asarray(inside.all(axis=1))


#: Another picture takes a triangle over from the first where it shows that much more area: seams are few, and
#: the first picture's place is known best.
PREFERENCE = 2.0


def shown_areas(view: View, triangles: NDArray[np.int64], depth: NDArray[np.float32], closed: bool) -> Array:
    """Area (m,) of triangles (m, 3) in a picture, squared pixels; 0 where they are not wholly seen.

    Parameters
    ----------
    depth : (h, w) of the object in ``view``, metres
    closed : whether only outer sides can be seen.
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
