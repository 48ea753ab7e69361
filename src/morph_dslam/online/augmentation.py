"""The augmented video: the deformed mesh over every frame, coloured by the stress of the side seen."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from morph_dslam.camera import PinholeCamera
from morph_dslam.io.video import VideoWriter
from morph_dslam.model import ReducedModel
from morph_dslam.model.inner_structure import CarriedStructure
from morph_dslam.online.binding import View, facing, view_of
from morph_dslam.online.estimation import State
from morph_dslam.online.results import RunResults
from morph_dslam.render.colour_maps import text_patch
from morph_dslam.render.overlay import draw_inner_surface, draw_overlay
from morph_dslam.render.shading import lambert, vertex_normals
from morph_dslam.sources import FrameSource

Array = NDArray[np.float64]

#: Opacity of the object's surface, and of one that shows what it has inside.
OPACITY, SEE_THROUGH = 0.65, 0.4
#: Colours of inner structures in turn: blue, green, red.
INNER_COLOURS = ((235, 60, 235), (60, 220, 255), (90, 235, 90), (255, 190, 60))
#: Direction to the light, camera frame, and what it leaves in the shade.
LIGHT, AMBIENT = np.array([0.3, -0.4, -1.0]), 0.55


def seen_field(model: ReducedModel, state: State, view: View) -> tuple[Array, str]:
    """The node field (n,) to show and its label.

    Von Mises stress in MPa, for a sheet that of the face turned to the camera; where the model carries no
    stress, the length of the displacement in mm.
    """
    # Triangles run anticlockwise seen from their top face, that is clockwise in neither y-up nor y-down
    # images: on the image's y-down axes a top face seen from the front has a negative area.
    face = "bottom" if facing(view, model.triangles).mean() > 0.5 else "top"
    place = "solid" if "solid" in model.stresses else face
    if place in model.stresses:
        return 1e-6 * model.von_mises(state.parameters, place), "von Mises stress [MPa]"
    displacement = model.displacement.value(state.parameters)
    return 1e3 * np.linalg.norm(displacement, axis=1), "displacement [mm]"


def value_range(
    model: ReducedModel, camera: PinholeCamera, states: Sequence[State | None]
) -> tuple[float, float]:
    """One range for the whole video: from zero to the 99.5th percentile over the nodes of up to 60 frames."""
    known = [state for state in states if state is not None]
    if not known:
        return 0.0, 1.0
    chosen = known[:: max(1, len(known) // 60)]
    fields = [seen_field(model, state, view_of(model, camera, state))[0] for state in chosen]
    return 0.0, max(float(np.percentile(np.stack(fields), 99.5)), 1e-6)


def draw_frame(
    model: ReducedModel,
    camera: PinholeCamera,
    image: NDArray[np.uint8],
    state: State,
    limits: tuple[float, float],
    caption: str,
    inner: Sequence[CarriedStructure] = (),
) -> NDArray[np.uint8]:
    """One undistorted frame (h, w, 3) with the object drawn over it, and in it its inner structures."""
    view = view_of(model, camera, state)
    values, label = seen_field(model, state, view)
    normals = vertex_normals(view.nodes, model.triangles)
    drawn = draw_overlay(
        image,
        view.pixels,
        view.nodes[:, 2],
        model.triangles,
        values,
        limits,
        label=label,
        alpha=SEE_THROUGH if inner else OPACITY,
        brightness=lambert(normals, LIGHT, AMBIENT),
        caption=caption,
    )
    for number, structure in enumerate(inner):
        nodes = state.camera_from_object.apply(structure.nodes(state.parameters))
        drawn = draw_inner_surface(
            drawn,
            camera.project(nodes),
            nodes[:, 2],
            structure.triangles,
            INNER_COLOURS[number % len(INNER_COLOURS)],
            label=structure.name,
            brightness=lambert(vertex_normals(nodes, structure.triangles), LIGHT, AMBIENT),
        )
    return drawn


def write_video(
    path: Path,
    source: FrameSource,
    camera: PinholeCamera,
    run: RunResults,
    inner: Sequence[CarriedStructure] = (),
) -> None:
    """Draw every frame of the run; lost frames are shown as they are, with the reason."""
    states = run.states()
    limits = value_range(run.model, camera, states)
    maps = camera.undistortion_maps()
    size = (camera.width, camera.height)
    # The source comes last: zip then stops before it asks for a frame that may be missing.
    rows = zip(states, run.results, source, strict=False)
    with VideoWriter(path, source.fps, size) as video:
        for state, result, frame in tqdm(rows, total=len(run), desc="drawing", unit="frame"):
            image = frame.image
            if maps is not None:
                image = np.asarray(cv2.remap(image, *maps, interpolation=cv2.INTER_LINEAR), dtype=np.uint8)
            if state is None:
                video.write(_with_caption(image, f"frame {frame.index}: {result.reason}"))
            else:
                caption = f"frame {frame.index}"
                video.write(draw_frame(run.model, camera, image, state, limits, caption, inner))


def _with_caption(image: NDArray[np.uint8], caption: str) -> NDArray[np.uint8]:
    """A frame without the object, (h, w, 3)."""
    result = image.copy()
    patch = text_patch(caption, 0.42 * max(image.shape[0] / 480.0, 0.6))[:, : image.shape[1]]
    result[-patch.shape[0] :, : patch.shape[1]] = patch
    return result
