"""Pictures of a scene: a printed, lit object before a background, as a camera with noise would take them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from morph_dslam.camera import Camera
from morph_dslam.errors import SceneError
from morph_dslam.geometry import RigidTransform
from morph_dslam.model import ReducedModel
from morph_dslam.model.reduced_model import triangle_normals
from morph_dslam.render.environment import StaticScene
from morph_dslam.render.rasteriser import Buffers, rasterise
from morph_dslam.render.scene_file import Background, Scene, Sensor, Surface
from morph_dslam.render.shading import lambert, vertex_normals
from morph_dslam.render.texture import (
    TexturedSurface,
    box_projection,
    crop_to_aspect,
    interpolate,
    is_sheet,
    load_photograph,
    render_textured,
    resize_to_fill,
    sheet_bounds,
    surface_size,
    texture_coordinates,
)

Array = NDArray[np.float64]
Image = NDArray[np.uint8]
#: An object's print has at most so many pixels along its longer side.
LARGEST_PRINT = 8000
#: Rows of a rolling shutter that are drawn as of one instant.
BAND_ROWS = 24


def supersampled(camera: Camera, factor: int) -> Camera:
    """The camera whose image, averaged over ``factor`` x ``factor`` pixels, is this camera's image."""
    return replace(
        camera,
        width=camera.width * factor,
        height=camera.height * factor,
        fx=camera.fx * factor,
        fy=camera.fy * factor,
        cx=(camera.cx + 0.5) * factor - 0.5,
        cy=(camera.cy + 0.5) * factor - 0.5,
    )


def print_texture(surface: Surface, folder: str | Path, size: Array, pixels_per_metre: float) -> Image:
    """The sheet's print, with its border, at the resolution at which the camera sees it.

    Parameters
    ----------
    size : (2,) of the sheet, metres.
    pixels_per_metre : of the image, where the sheet is seen face on; less is taken where the longer side would have
        more than `LARGEST_PRINT` pixels.
    """
    folder = Path(folder)
    photograph = load_photograph(surface.texture, folder)
    pixels_per_metre = min(pixels_per_metre, LARGEST_PRINT / float(size.max()))
    width, height = np.maximum(np.rint(size * pixels_per_metre).astype(int), 2)
    border = min(round(surface.border_mm * 1e-3 * pixels_per_metre), (min(width, height) - 1) // 2)
    inner = (int(width - 2 * border), int(height - 2 * border))
    texture = np.full((height, width, 3), 244, dtype=np.uint8)
    texture[border : border + inner[1], border : border + inner[0]] = resize_to_fill(photograph, *inner)
    return texture


def prepare_background(background: Background, folder: Path, camera: Camera) -> Image:
    """The background (h, w, 3) filling the camera's image."""
    if background.image is None:
        return np.full((camera.height, camera.width, 3), background.colour[::-1], dtype=np.uint8)
    cropped = crop_to_aspect(load_photograph(background.image, folder), camera.width / camera.height)
    image = cv2.resize(cropped, (camera.width, camera.height), interpolation=cv2.INTER_CUBIC)
    return blur(image, background.blur_px)


def blur(image: NDArray, sigma: float) -> Image:
    """Gaussian blur of an image (h, w, ...) with this standard deviation in pixels."""
    return np.asarray(cv2.GaussianBlur(image, (0, 0), sigma), dtype=np.uint8) if sigma > 0.0 else image


def in_disc(columns: NDArray, rows: NDArray, centre: Array, radius: float) -> NDArray[np.bool_]:
    """Which pixels lie in a disc about ``centre`` (2,); columns and rows broadcast to (h, w)."""
    return (columns - centre[0]) ** 2 + (rows - centre[1]) ** 2 <= radius**2


def pixel_axes(height: int, width: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Columns (1, w) and rows (h, 1) of an image, which broadcast to all its pixels."""
    return np.arange(width)[None, :], np.arange(height)[:, None]


def expose(image: Image, sensor: Sensor, gain: float, seed: tuple[int, int]) -> Image:
    """Blur, exposure and noise, the same for the same ``seed`` (scene, frame); what is too bright saturates."""
    image = blur(image, sensor.blur_px)
    if sensor.noise == 0.0 and gain == 1.0:
        return image
    noise = np.random.default_rng(seed).standard_normal(image.shape, dtype=np.float32)
    return np.clip(np.rint(np.float32(gain) * image + np.float32(sensor.noise) * noise), 0, 255).astype(np.uint8)


def _print(surface: Surface, model: ReducedModel, folder: Path, density: float) -> tuple[Image, TexturedSurface]:
    """The texture of a sheet's rectangle, or of a solid's box, and how it lies on the surface."""
    if is_sheet(model):
        low, high = sheet_bounds(model)
        texture = print_texture(surface, folder, high - low, density)
        height, width = texture.shape[:2]
        coordinates = texture_coordinates(model, surface.printed_face, width, height)
        return texture, TexturedSurface(np.arange(len(model.nodes)), model.triangles, coordinates)
    texture = print_texture(surface, folder, np.full(2, surface_size(model)), density)
    return texture, box_projection(model, len(texture))


def _printed_sides(model: ReducedModel, printed_face: str) -> Array:
    """+1 for each triangle (m,) whose nodes, by their order, make its normal leave the printed face.

    A solid is printed all over, and its triangles turn outwards.
    """
    if not is_sheet(model):
        return np.ones(len(model.triangles))
    return np.sign(triangle_normals(model.nodes, model.triangles)[:, 2]) * (1.0 if printed_face == "top" else -1.0)


@dataclass(frozen=True)
class Instant:
    """What there is to see at one instant.

    Attributes
    ----------
    points : (n, 3) nodes in the camera frame, metres.
    occluder_centre : (2,) pixels, or None without an occluder.
    camera_from_world : where the camera is, in a scene that has a world.
    """

    points: Array
    occluder_centre: Array | None = None
    camera_from_world: RigidTransform | None = None


def bands(camera: Camera) -> list[tuple[int, int]]:
    """First row and the one after the last of each part of an image that is recorded at one instant."""
    if not camera.readout_s:
        return [(0, camera.height)]
    edges = np.linspace(0, camera.height, max(round(camera.height / BAND_ROWS), 2) + 1).astype(int)
    return list(zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True))


def band_seconds(camera: Camera) -> Array:
    """Instants (b,) of the middles of `bands`, seconds after the middle row's."""
    middles = np.mean(np.array(bands(camera)) - np.array([0, 1]), axis=1)
    return camera.readout_s * (middles - 0.5 * (camera.height - 1)) / camera.height


class _Window:
    """The part of an ideal image that a camera's lens makes a band of rows of.

    Parameters
    ----------
    camera : with its lens.
    rows : first row of the band, and the one after its last.

    Attributes
    ----------
    camera : the ideal pinhole of the part.
    first_row : of the band.
    """

    def __init__(self, camera: Camera, rows: tuple[int, int]) -> None:
        first, stop = rows
        self.first_row, self._maps = first, None
        low, high = np.array([0, first]), np.array([camera.width, stop])
        if camera.distortion:
            v, u = np.mgrid[first:stop, : camera.width]
            sought = camera.undistort_pixels(np.column_stack([u.ravel(), v.ravel()]))
            if not np.isfinite(sought).all():
                raise SceneError("camera: the lens shows nothing in parts of the image: give a weaker distortion")
            low, high = np.floor(sought.min(axis=0)).astype(int) - 1, np.ceil(sought.max(axis=0)).astype(int) + 2
            self._maps = (sought - low).astype(np.float32).reshape(*u.shape, 2)
        (width, height), (cx, cy) = (high - low).tolist(), np.array([camera.cx, camera.cy]) - low
        self.camera = Camera(width, height, camera.fx, camera.fy, float(cx), float(cy))
        self._recording = camera

    def of(self, picture: Image) -> Image:
        """The part as cut out of a recorded picture (h, w, 3), whose rim goes on outside."""
        place = self._recording.project_recorded(self.camera.pixel_rays).astype(np.float32)
        place, rim = place.reshape(self.camera.height, self.camera.width, 2), cv2.BORDER_REPLICATE
        return np.asarray(cv2.remap(picture, place, None, cv2.INTER_LINEAR, borderMode=rim))  # type: ignore[call-overload]

    def recorded(self, part: Image) -> Image:
        """The band as the lens makes it of the part."""
        if self._maps is None:
            return part
        return np.asarray(cv2.remap(part, self._maps, None, cv2.INTER_LINEAR))  # type: ignore[call-overload]


class SceneRenderer:
    """Takes the pictures of one scene.

    Parameters
    ----------
    scene : its description.
    model : the object.
    camera : with its lens and shutter.
    folder : what paths in the scene are relative to.
    nearest_depth : metres; the print is made as fine as it can be seen from there.
    surroundings : what stands around the object, for `supersampled` pictures, or None.
    """

    def __init__(
        self,
        scene: Scene,
        model: ReducedModel,
        camera: Camera,
        folder: Path,
        nearest_depth: float,
        surroundings: StaticScene | None = None,
    ) -> None:
        self._scene, self._surroundings = scene, surroundings
        self._triangles = model.triangles
        self._factor = scene.supersampling
        self._camera = supersampled(camera, self._factor)
        density = max(self._camera.fx, self._camera.fy) / nearest_depth
        self._texture, self._surface = _print(scene.surface, model, folder, density)
        background = cv2.resize(
            prepare_background(scene.background, folder, camera),
            (self._camera.width, self._camera.height),
            interpolation=cv2.INTER_CUBIC if scene.background.image else cv2.INTER_NEAREST,
        )
        rows = [(self._factor * first, self._factor * stop) for first, stop in bands(camera)]
        self._windows = [_Window(self._camera, band) for band in rows]
        self._backgrounds = [window.of(np.asarray(background, dtype=np.uint8)) for window in self._windows]
        self._sides = _printed_sides(model, scene.surface.printed_face)

    def _shows_print(self, points: Array) -> NDArray[np.bool_]:
        """Which triangles (m,) turn their printed face to the camera."""
        normals, corners = triangle_normals(points, self._triangles), points[self._triangles[:, 0]]
        return self._sides * np.einsum("mx,mx->m", normals, corners) < 0.0

    def _paint_surface(
        self, image: Image, buffers: Buffers, points: Array, camera_from_world: RigidTransform | None
    ) -> None:
        light, back = self._scene.light, self._scene.surface.back_colour[::-1]
        to_light = np.array(light.direction)
        if camera_from_world is not None:
            to_light = camera_from_world.rotation @ to_light
        brightness = lambert(vertex_normals(points, self._triangles), to_light, light.ambient)
        covered = buffers.covered
        surface = self._surface
        printed = render_textured(buffers, surface.triangles, surface.coordinates, self._texture)[covered]
        shows_print = self._shows_print(points)[buffers.triangle_ids[covered]]
        colour = np.where(shows_print[:, None], printed, np.array(back, dtype=np.float32))
        lit = colour * interpolate(buffers, self._triangles, brightness.astype(np.float32))[:, None]
        image[covered] = (lit + np.float32(0.5)).astype(np.uint8)

    def _band(self, window: _Window, background: Image, seen: Instant) -> Image:
        """The rows of a window as they are recorded, `supersampled`."""
        camera, image = window.camera, background.copy()
        pixels = camera.project(seen.points)
        buffers = rasterise(pixels, seen.points[:, 2], self._triangles, camera.height, camera.width)
        if self._surroundings is not None and seen.camera_from_world is not None:
            behind = self._surroundings.buffers(seen.camera_from_world, camera)
            self._surroundings.paint(image, behind)
            hidden = behind.depth < buffers.depth
            buffers = replace(buffers, triangle_ids=np.where(hidden, np.int32(-1), buffers.triangle_ids))
        self._paint_surface(image, buffers, seen.points, seen.camera_from_world)
        image = window.recorded(image)
        occluder, factor = self._scene.occluder, self._factor
        if occluder is not None and seen.occluder_centre is not None:
            centre = (seen.occluder_centre + 0.5) * factor - 0.5 - [0, window.first_row]
            disc = in_disc(*pixel_axes(*image.shape[:2]), centre, occluder.radius_px * factor)
            image[disc] = occluder.colour[::-1]
        return image

    def render(self, seen: Sequence[Instant], frame: int, gain: float = 1.0) -> Image:
        """The picture (h, w, 3) uint8, blue, green, red.

        Parameters
        ----------
        seen : at the instants `band_seconds` of a rolling shutter, or at one.
        frame : its number, which seeds the noise.
        gain : of the exposure.
        """
        parts = zip(self._windows, self._backgrounds, seen, strict=True)
        image = np.vstack([self._band(*part) for part in parts])
        size = (self._camera.width // self._factor, self._camera.height // self._factor)
        averaged = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
        return expose(np.asarray(averaged, dtype=np.uint8), self._scene.sensor, gain, (self._scene.seed, frame))
