"""The augmented view: the deformed object over a frame, coloured by a field, cut open or seen through."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.stats import qmc

from morph_dslam.camera import PinholeCamera
from morph_dslam.errors import TrackingError
from morph_dslam.model import ReducedModel, SeparatedField
from morph_dslam.model.discrepancy import Discrepancy
from morph_dslam.model.inner_structure import CarriedStructure
from morph_dslam.model.reduced_model import MaterialPoints, von_mises
from morph_dslam.online.drawing.section import SectionPlane, cut, surface_before
from morph_dslam.online.estimation.estimator import State
from morph_dslam.online.measuring.binding import DrawnSurface, View, facing
from morph_dslam.render.colour_maps import text_patch
from morph_dslam.render.overlay import draw_inner_surface, draw_overlay
from morph_dslam.render.shading import lambert, vertex_normals

Array = NDArray[np.float64]
Shown = Literal["stress", "strain", "displacement"]

#: Opacity of the object's surface, of one that shows what it has inside, and of one that is cut open.
OPACITY, SEE_THROUGH, CUT_OPEN = 0.65, 0.4, 0.9
#: Colours of inner structures in turn: violet, yellow, green, blue.
INNER_COLOURS = ((235, 60, 235), (60, 220, 255), (90, 235, 90), (255, 190, 60))
#: Direction to the light, camera frame, and what it leaves in the shade.
LIGHT, AMBIENT = np.array([0.3, -0.4, -1.0]), 0.55
#: Colours end at this percentile of the field: stress has narrow peaks.
PERCENTILE = 99.5
#: States of the parameter box from which the range of colours is taken (a power of two).
SAMPLES = 32


@dataclass(frozen=True)
class DrawOptions:
    """What is drawn.

    Attributes
    ----------
    show : "stress" (von Mises), "strain" (equivalent) or "displacement"; None for stress where the model has
        one, else the displacement. section : a plane that cuts the object open; None for none.
    """

    show: Shown | None = None
    section: SectionPlane | None = None


class AugmentedView:
    """Draws one object.

    Only the nodes that are drawn are moved, in single precision, which is as exact as the model file.

    Raises
    ------
    TrackingError
        If the model does not hold the field, or cannot be cut there.
    """

    def __init__(
        self,
        model: ReducedModel,
        camera: PinholeCamera,
        options: DrawOptions | None = None,
        inner: Sequence[CarriedStructure] = (),
    ) -> None:
        options = options or DrawOptions()
        self._camera, self._inner, self._model = camera, inner, model
        self.show = _chosen(model, options.show)
        self._points, self._triangles = _drawn_mesh(model, options.section)
        self._closed = options.section is None and DrawnSurface.of(model).closed
        self._alpha = SEE_THROUGH if inner else OPACITY if options.section is None else CUT_OPEN
        self._rest = model.rest_positions(self._points)
        self._displacement = self._restricted("displacement")
        self._fields = {name: self._restricted(name) for name in _fields_of(model, self.show)}

    def _restricted(self, name: str) -> SeparatedField:
        field = self._model.restrict(self._points, name)
        return field.with_modes(field.modes.astype(np.float32))  # type: ignore[arg-type]

    @property
    def label(self) -> str:
        """Name and unit of the field."""
        return {
            "stress": "von Mises stress [MPa]",
            "strain": "equivalent strain [%]",
            "displacement": "displacement [mm]",
        }[self.show]

    def view(self, state: State) -> View:
        """The drawn nodes in a state."""
        return self._view(state, self._displacement.value(state.parameters))

    def _view(self, state: State, displacement: Array) -> View:
        nodes = state.camera_from_object.apply(self._rest + displacement)
        return View(nodes, self._camera.project(nodes))

    def distance(self, state: State) -> float:
        """Depth of the middle of what is drawn, undeformed, metres."""
        return float(state.camera_from_object.apply(self._rest.mean(axis=0))[2])

    def values(self, state: State) -> Array:
        """The field (n,) at the drawn nodes, in the unit of `label`; for a sheet on the side that is seen."""
        return self._values(state.parameters, self._displacement.value(state.parameters), self.view(state))

    def _values(self, parameters: Array, displacement: Array, view: View | None) -> Array:
        if self.show == "displacement":
            return 1e3 * np.linalg.norm(displacement, axis=1)
        if self.show == "strain":
            return 100.0 * _equivalent_strain(self._fields["strain"].value(parameters))
        name = "stress_solid"
        if name not in self._fields:
            # Triangles run anticlockwise seen from their top face, that is clockwise in neither y-up nor
            # y-down images: on the image's y-down axes a top face seen from the front has a negative area.
            back = view is not None and facing(view, self._triangles).mean() > 0.5
            name = "stress_bottom" if back else "stress_top"
        return 1e-6 * von_mises(self._fields[name].value(parameters))

    def range_of(self, states: Sequence[State]) -> tuple[float, float]:
        """One range of colours for these states; from 0 to 1 where there are none."""
        if not states:
            return 0.0, 1.0
        return self._range([self.values(state) for state in states])

    def range_of_box(self) -> tuple[float, float]:
        """One range of colours for all states of the parameter box, known before any is seen."""
        model = self._model
        shares = qmc.Sobol(len(model.parameters), scramble=False).random(SAMPLES)
        shapes = [model.default, *(model.lower + shares * (model.upper - model.lower))]
        return self._range([self._values(mu, self._displacement.value(mu), None) for mu in shapes])

    def _range(self, fields: list[Array]) -> tuple[float, float]:
        return 0.0, max(float(np.percentile(np.stack(fields), PERCENTILE)), 1e-6)

    def draw(
        self,
        image: NDArray[np.uint8],
        state: State,
        limits: tuple[float, float],
        caption: str,
        discrepancy: Discrepancy | None = None,
    ) -> NDArray[np.uint8]:
        """An undistorted frame (h, w, 3) with the object over it, and in it its inner structures.

        The object is drawn where ``discrepancy`` has it beyond the model; stress and strain are the model's.
        """
        displacement = self._displacement.value(state.parameters)
        if discrepancy is not None:
            displacement = displacement + discrepancy.displacement(self._rest)
        view = self._view(state, displacement)
        drawn = draw_overlay(
            image,
            view.pixels,
            view.nodes[:, 2],
            self._triangles,
            self._values(state.parameters, displacement, view),
            limits,
            label=self.label,
            alpha=self._alpha,
            brightness=lambert(vertex_normals(view.nodes, self._triangles), LIGHT, AMBIENT),
            caption=caption,
            closed=self._closed,
        )
        for number, structure in enumerate(self._inner):
            nodes = structure.nodes(state.parameters)
            if discrepancy is not None:
                nodes = nodes + discrepancy.displacement(structure.rest)
            nodes = state.camera_from_object.apply(nodes)
            drawn = draw_inner_surface(
                drawn,
                self._camera.project(nodes),
                nodes[:, 2],
                structure.triangles,
                INNER_COLOURS[number % len(INNER_COLOURS)],
                label=structure.name,
                brightness=lambert(vertex_normals(nodes, structure.triangles), LIGHT, AMBIENT),
            )
        return drawn


def with_caption(image: NDArray[np.uint8], caption: str) -> NDArray[np.uint8]:
    """A frame (h, w, 3) without the object, and why."""
    result = image.copy()
    patch = text_patch(caption, 0.42 * max(image.shape[0] / 480.0, 0.6))[:, : image.shape[1]]
    result[-patch.shape[0] :, : patch.shape[1]] = patch
    return result


def _chosen(model: ReducedModel, show: Shown | None) -> Shown:
    has = {"stress": bool(model.stresses), "strain": model.strain is not None, "displacement": True}
    if show is None:
        return "stress" if has["stress"] else "displacement"
    if not has[show]:
        held = ", ".join(name for name, held in has.items() if held)
        raise TrackingError(f"the model '{model.name}' holds no {show} to show; it has: {held}")
    return show


def _fields_of(model: ReducedModel, show: Shown) -> list[str]:
    """Names of the fields that are shown, as in `ReducedModel.fields`."""
    if show == "stress":
        return [f"stress_{place}" for place in model.stresses]
    return ["strain"] if show == "strain" else []


def _equivalent_strain(strain: Array) -> Array:
    """sqrt(2/3 e : e) (n,) of the deviator e of strains (n, 6): xx, yy, zz, yz, xz, xy with tensor shears."""
    normal = strain[:, :3] - strain[:, :3].mean(axis=1, keepdims=True)
    squared = np.sum(normal**2, axis=1) + 2.0 * np.sum(strain[:, 3:] ** 2, axis=1)
    return np.sqrt(2.0 / 3.0 * squared)


def _drawn_mesh(
    model: ReducedModel, section: SectionPlane | None
) -> tuple[MaterialPoints, NDArray[np.int64]]:
    """The nodes that are drawn and their triangles: the surface, or what a section leaves of it, and that."""
    if section is None:
        used, corners = np.unique(model.triangles, return_inverse=True)
        pairs, weights = np.column_stack([used, used]), np.tile([1.0, 0.0], (len(used), 1))
        return MaterialPoints(pairs, weights), corners.reshape(-1, 3)
    inside, cut_open = cut(model, section)
    left, triangles = surface_before(model, section)
    points = MaterialPoints(
        np.concatenate([left.corners, inside.corners]), np.concatenate([left.weights, inside.weights])
    )
    return points, np.concatenate([triangles, cut_open + len(left)])
