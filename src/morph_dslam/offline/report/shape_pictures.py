"""Rendered pictures of a model: a few states coloured by stress, and its modes in space."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from numpy.typing import NDArray

from morph_dslam.evaluation.report import Picture
from morph_dslam.model import ReducedModel
from morph_dslam.offline.report.chosen_states import HALF_WAY_OUT, states_to_show
from morph_dslam.offline.report.plotting import panels, photograph
from morph_dslam.render.model_view import draw_shapes

Array = NDArray[np.float64]

#: Pixels of a picture, and how many modes are drawn.
SIZE = (480, 400)
MOST_MODES = 6
#: A mode is drawn with its largest displacement this part of the body's size.
AMPLITUDE = 0.15
#: Bodies whose height is below this part of their width are looked down upon.
FLAT = 0.3


def viewing_direction(model: ReducedModel) -> Array:
    """Direction (3,) in which the camera looks, object frame."""
    extent = np.ptp(model.nodes[np.unique(model.triangles)], axis=0)
    return np.array([0.35, 1.0, -1.0 if extent[2] < FLAT * extent[:2].max() else -0.4])


def draw_model_states(model: ReducedModel) -> Picture:
    """A few states of the box, coloured by von Mises stress if the model has one, or else by displacement."""
    states, captions = states_to_show(model)
    shapes = [model.positions(mu) for mu in states]
    if model.stresses:
        place = "top" if "top" in model.stresses else next(iter(model.stresses))
        values = [1e-6 * model.von_mises(mu, place) for mu in states]
        label = "von Mises stress" + ("" if place == "solid" else f", {place} face") + " [MPa]"
    else:
        values = [1e3 * np.linalg.norm(model.displacement.value(mu), axis=1) for mu in states]
        label = "displacement [mm]"
    seen = np.unique(model.triangles)
    # Single nodes in corners would take the colours from all others.
    top = max(float(np.percentile([value[seen] for value in values], 99.5)), 1e-12)
    note = "States of the model, to scale" + (f"; {HALF_WAY_OUT}." if len(model.parameters) > 1 else ".")
    return _grid(model, shapes, values, (0.0, top), captions, label, note, "turbo")


def draw_modes(model: ReducedModel) -> Picture:
    """The first modes in space, each added to the undeformed body with one largest displacement."""
    modes = model.displacement.modes[:MOST_MODES]
    size = float(np.ptp(model.nodes, axis=0).max())
    lengths = np.linalg.norm(modes, axis=2)
    relative = [length / max(float(length.max()), 1e-300) for length in lengths]
    shapes = [
        model.nodes + AMPLITUDE * size * mode / max(float(length.max()), 1e-300)
        for mode, length in zip(modes, lengths, strict=True)
    ]
    captions = [f"mode {i}" for i in range(1, len(modes) + 1)]
    note = (
        f"The first {len(modes)} of {model.displacement.n_modes} modes in space, added to the undeformed "
        f"body; each is enlarged to {AMPLITUDE:.0%} of the body's size."
    )
    return _grid(model, shapes, relative, (0.0, 1.0), captions, "displacement / largest", note, "viridis")


def _grid(
    model: ReducedModel,
    shapes: Sequence[Array],
    values: Sequence[Array],
    value_range: tuple[float, float],
    captions: Sequence[str],
    label: str,
    note: str,
    colour_map: str,
) -> Picture:
    """Rendered shapes, three in a row, with one colour bar."""
    images = draw_shapes(
        model.triangles, shapes, values, value_range, viewing_direction(model), SIZE, colour_map
    )
    figure, axes = panels(len(images), 2.7, of_four=4)
    for image, caption, panel in zip(images, captions, axes, strict=True):
        panel.imshow(cv2.cvtColor(image, cv2.COLOR_BGR2RGB))
        panel.set_title(caption)
        panel.set_axis_off()
    figure.colorbar(
        ScalarMappable(Normalize(*value_range), colour_map), ax=axes, label=label, shrink=0.7, pad=0.01
    )
    return photograph(figure, note)
