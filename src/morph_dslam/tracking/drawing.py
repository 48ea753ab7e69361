"""Drawing an object over its video: coloured by a field, whole or cut open by a plane, with what is inside of it."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import starmap
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from morph_dslam.camera import Camera
from morph_dslam.errors import TrackingError
from morph_dslam.geometry import RigidTransform
from morph_dslam.io.video import VideoWriter
from morph_dslam.model import ReducedModel
from morph_dslam.model.discrepancy import Discrepancy
from morph_dslam.model.inner_structure import SEE_THROUGH, CarriedStructure, colour_of
from morph_dslam.model.reduced_model import MaterialPoints
from morph_dslam.model.shown_field import Shown, ShownField, shown_field, surface_points
from morph_dslam.registration.mesh_edges import SPACING, MeshEdges
from morph_dslam.render.overlay import BarPlace, draw_inner_surface, draw_overlay
from morph_dslam.render.shading import lambert, text_patch, vertex_normals
from morph_dslam.sources import Frame, FrameSource
from morph_dslam.threads import ahead, threads_side_by_side
from morph_dslam.tracking.binding import DrawnSurface, View, facing
from morph_dslam.tracking.compilation import compile_drawing
from morph_dslam.tracking.displacement_jumps import DisplacementJump, near_jumps
from morph_dslam.tracking.estimator import State
from morph_dslam.tracking.force_arrows import ForceArrows
from morph_dslam.tracking.outcomes import may_be_mistaken
from morph_dslam.tracking.result import FrameResult
from morph_dslam.tracking.run_results import RunResults

Array = NDArray[np.float64]
#: A hexahedron as six tetrahedra around its diagonal 0-6, corners in VTK's order.
_HEX = np.array([[0, 1, 2, 6], [0, 2, 3, 6], [0, 3, 7, 6], [0, 7, 4, 6], [0, 4, 5, 6], [0, 5, 1, 6]])
#: A prism as three tetrahedra.
_PRISM = np.array([[0, 1, 2, 5], [0, 1, 5, 4], [0, 4, 5, 3]])
#: Of edges, blue first.
EDGE_COLOUR = (245, 245, 245)
_FORM = re.compile(r"([+-]?)([xyz])=(-?[0-9]*\.?[0-9]+)")


@dataclass(frozen=True)
class SectionPlane:
    """The points x of the undeformed object with normal @ x = offset; what lies beyond is taken away.

    Attributes
    ----------
    normal : (3,) unit vector, object frame
    offset : metres.
    """

    normal: Array
    offset: float

    @classmethod
    def parse(cls, text: str) -> SectionPlane:
        """From "x=12" or "-x=12", millimetres: x > 12 mm, or x < 12 mm, is taken away.

        Raises
        ------
        TrackingError
            If the text is none of these.
        """
        found = _FORM.fullmatch(text.replace(" ", ""))
        if found is None:
            raise TrackingError(
                f"'{text}' is no section: write x=12 to take away all beyond x = 12 mm, -x=12 for all before "
                "it; y and z likewise, in the object's frame"
            )
        sign = -1.0 if found[1] == "-" else 1.0
        normal = sign * np.eye(3)["xyz".index(found[2])]
        return cls(normal, sign * 1e-3 * float(found[3]))

    def beyond(self, points: Array) -> Array:
        """How far (n,) points (n, 3) lie beyond the plane, metres."""
        return points @ self.normal - self.offset


def cut(model: ReducedModel, plane: SectionPlane) -> tuple[MaterialPoints, NDArray[np.int64]]:
    """The section's nodes, as material points between two mesh nodes each, and its triangles (m, 3).

    Each cell is cut as tetrahedra with straight edges.

    Raises
    ------
    TrackingError
        If the model is a sheet's or a rigid object's, or the plane misses the object.
    """
    if not model.cells:
        raise TrackingError(f"'{model.name}' is the model of a surface: it has no inside to show in a section")
    tetrahedra, depth = _tetrahedra(model), _depth(model, plane)
    below = depth[tetrahedra] < 0.0
    count = below.sum(axis=1)
    # Corners below the plane first.
    ordered = np.take_along_axis(tetrahedra, np.argsort(~below, axis=1, kind="stable"), axis=1)
    edges = [
        _edges(ordered[count == 1], [(0, 1), (0, 2), (0, 3)]),
        _edges(ordered[count == 3], [(0, 3), (1, 3), (2, 3)]),
        _edges(ordered[count == 2], [(0, 2), (0, 3), (1, 3)]),
        _edges(ordered[count == 2], [(0, 2), (1, 3), (1, 2)]),
    ]
    triangles = np.concatenate(edges)
    if not len(triangles):
        low, high = 1e3 * depth.min() + 1e3 * plane.offset, 1e3 * depth.max() + 1e3 * plane.offset
        raise TrackingError(
            f"the section misses the object: along its normal '{model.name}' reaches from {low:.1f} to {high:.1f} mm"
        )
    return _on_edges(triangles, depth)


def surface_before(model: ReducedModel, plane: SectionPlane) -> tuple[MaterialPoints, NDArray[np.int64]]:
    """What the plane leaves of the surface: its nodes, between two mesh nodes each, and its triangles (m, 3).

    Triangles that the plane crosses are cut along it, and keep the direction in which they run.
    """
    depth = _depth(model, plane)
    below = depth[model.triangles] < 0.0
    count = below.sum(axis=1)
    # First the one corner that is on its side of the plane alone.
    alone = np.where(count == 1, below.argmax(axis=1), (~below).argmax(axis=1))
    turned = np.take_along_axis(model.triangles, (alone[:, None] + np.arange(3)) % 3, axis=1)
    one, two = turned[count == 1], turned[count == 2]
    parts = [
        _edges(model.triangles[count == 3], [(0, 0), (1, 1), (2, 2)]),
        _edges(one, [(0, 0), (0, 1), (0, 2)]),
        _edges(two, [(1, 0), (1, 1), (2, 2)]),
        _edges(two, [(1, 0), (2, 2), (2, 0)]),
    ]
    return _on_edges(np.concatenate(parts), depth)


def _depth(model: ReducedModel, plane: SectionPlane) -> Array:
    """How far the nodes (n,) lie beyond the plane; one that lies in it belongs to one side, by a hair."""
    depth = plane.beyond(model.nodes)
    return np.where(np.abs(depth) < 1e-12, 1e-12, depth)


def _on_edges(triangles: NDArray[np.int64], depth: Array) -> tuple[MaterialPoints, NDArray[np.int64]]:
    """Triangles (t, 3, 2), each corner where the plane cuts the edge between two nodes, or a node itself."""
    unique, corners = np.unique(triangles.reshape(-1, 2), axis=0, return_inverse=True)
    here, there = depth[unique[:, 0]], depth[unique[:, 1]]
    is_node = unique[:, 0] == unique[:, 1]
    share = np.where(is_node, 0.0, here / np.where(is_node, 1.0, here - there))
    return MaterialPoints(unique, np.column_stack([1.0 - share, share])), corners.reshape(-1, 3)


def _tetrahedra(model: ReducedModel) -> NDArray[np.int64]:
    """All cells by their corners as tetrahedra (k, 4)."""
    parts = []
    for cell_type, cells in model.cells.items():
        if cell_type.startswith("hex"):
            parts.append(cells[:, _HEX].reshape(-1, 4))
        elif cell_type.startswith("prism"):
            parts.append(cells[:, _PRISM].reshape(-1, 4))
        else:
            parts.append(cells[:, :4])
    return np.concatenate(parts)


def _edges(cells: NDArray[np.int64], pairs: list[tuple[int, int]]) -> NDArray[np.int64]:
    """Three edges (t, 3, 2) of each tetrahedron or triangle, by its corners; they make a triangle."""
    return np.stack([cells[:, list(pair)] for pair in pairs], axis=1)


#: Opacity of the object's surface, and of one that is cut open.
OPACITY, CUT_OPEN = 0.65, 0.9
#: Direction to the light, camera frame, and what it leaves in the shade.
LIGHT, AMBIENT = np.array([0.3, -0.4, -1.0]), 0.55


@dataclass(frozen=True)
class DrawOptions:
    """What is drawn.

    Attributes
    ----------
    show : "stress" (von Mises), "strain" (equivalent), "displacement" or the "traction" of unknown loads; None for
        stress where the model has one, else the displacement
    section : a plane that cuts the object open; None for none.
    forces : whether arrows show the forces of supports.
    """

    show: Shown | None = None
    section: SectionPlane | None = None
    forces: bool = False


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
        camera: Camera,
        options: DrawOptions | None = None,
        inner: Sequence[CarriedStructure] = (),
    ) -> None:
        options = options or DrawOptions()
        self._camera, self._inner, self._model, self._bar = camera, inner, model, BarPlace()
        self.show: Shown = shown_field(model, options.show)
        points, self._triangles = _drawn_mesh(model, options.section)
        self._whole = options.section is None
        self._closed = self._whole and DrawnSurface.of(model).closed
        self._alpha = SEE_THROUGH if inner else OPACITY if options.section is None else CUT_OPEN
        self._rest = model.rest_positions(points)
        self._field = ShownField(model, points, self.show)
        self._arrows = ForceArrows(model) if options.forces else None
        # A field's colours show how a surface lies; of one that is grey all over, its edges do.
        self._edges = MeshEdges(self._rest, self._triangles) if self._whole and not model.parameters else None

    @property
    def surface_field(self) -> ShownField | None:
        """What colours the whole surface; None where a plane cuts it open."""
        return self._field if self._whole else None

    @property
    def label(self) -> str:
        """Name and unit of the field; empty for a rigid object, which is drawn grey."""
        if not self._model.parameters:
            return ""
        kind = self._field.kind
        return f"{kind.name} [{kind.unit}]"

    def view(self, state: State) -> View:
        """The drawn nodes in a state."""
        return self._view(state, self._field.displacement(state.parameters))

    def _view(self, state: State, displacement: Array) -> View:
        nodes = state.camera_from_object.apply(self._rest + displacement)
        return View(nodes, self._camera.project(nodes))

    def distance(self, state: State) -> float:
        """Depth of the middle of what is drawn, undeformed, metres."""
        return float(state.camera_from_object.apply(self._rest.mean(axis=0))[2])

    def values(self, state: State) -> Array:
        """The field (n,) at the drawn nodes, in the unit of `label`; for a sheet on the side that is seen."""
        return self._values(state.parameters, self._field.displacement(state.parameters), self.view(state))

    def _values(self, parameters: Array, displacement: Array, view: View) -> Array:
        # Triangles run anticlockwise seen from their top face, that is clockwise in neither y-up nor
        # y-down images: on the image's y-down axes a top face seen from the front has a negative area.
        sides = self._field.has_sides
        back = sides and facing(view, self._triangles).mean() > 0.5
        return self._field.values(parameters, displacement, ("bottom" if back else "top") if sides else None)

    def range_of(self, states: Sequence[State]) -> tuple[float, float]:
        """One range of colours for these states; from 0 to 1 where there are none."""
        if not states:
            return 0.0, 1.0
        return self._field.range_of([self.values(state) for state in states])

    def range_of_box(self) -> tuple[float, float]:
        """One range of colours for all states of the parameter box, known before any is seen."""
        return self._field.range_of_box()

    def draw(
        self,
        image: NDArray[np.uint8],
        state: State,
        limits: tuple[float, float],
        caption: str,
        discrepancy: Discrepancy | None = None,
        jumps: Sequence[DisplacementJump] = (),
        mistaken: bool = False,
    ) -> NDArray[np.uint8]:
        """An undistorted frame (h, w, 3) with the object over it, and in it its inner structures.

        The object is drawn where ``discrepancy`` has it beyond the model; stress and strain are the model's, and
        grey near ``jumps``, and everywhere where the result may be ``mistaken``.
        """
        displacement = self._field.displacement(state.parameters)
        if discrepancy is not None:
            displacement = displacement + discrepancy.displacement(self._rest)
        view = self._view(state, displacement)
        values = self._values(state.parameters, displacement, view)
        if self.show != "displacement":
            values = np.where(mistaken | near_jumps(jumps, self._rest), np.nan, values)
        drawn = draw_overlay(
            image,
            view.pixels,
            view.nodes[:, 2],
            self._triangles,
            values,
            limits,
            label=self.label,
            alpha=self._alpha,
            brightness=lambert(vertex_normals(view.nodes, self._triangles), LIGHT, AMBIENT),
            caption=caption,
            closed=self._closed,
            bar=self._bar,
        )
        if self._edges is not None:
            _draw_edges(drawn, self._edges, state.camera_from_object, self._camera)
        for number, structure in enumerate(self._inner):
            nodes = state.camera_from_object.apply(structure.nodes(state.parameters, discrepancy))
            red, green, blue = colour_of(number)
            drawn = draw_inner_surface(
                drawn,
                self._camera.project(nodes),
                nodes[:, 2],
                structure.triangles,
                (blue, green, red),
                label=structure.name,
                brightness=lambert(vertex_normals(nodes, structure.triangles), LIGHT, AMBIENT),
            )
        return drawn if self._arrows is None else self._arrows.draw(drawn, state, self._camera)


def _draw_edges(image: NDArray[np.uint8], edges: MeshEdges, pose: RigidTransform, camera: Camera) -> None:
    """Draw the edges that are seen into ``image``, each point on them as a dash as long as they are apart."""
    seen = edges.visible(pose, camera)
    depths = pose.apply(seen.points)[:, 2:]
    along = seen.normals[:, ::-1] * [-1.0, 1.0] * (0.5 * edges.size / SPACING * camera.fx / depths)
    ends = np.stack([seen.pixels - along, seen.pixels + along], axis=1)
    cv2.polylines(image, list(np.round(ends).astype(np.int32)), False, EDGE_COLOUR, 1, cv2.LINE_AA)


def with_caption(image: NDArray[np.uint8], caption: str) -> NDArray[np.uint8]:
    """A frame (h, w, 3) without the object, and why."""
    result = image.copy()
    patch = text_patch(caption, 0.42 * max(image.shape[0] / 480.0, 0.6), image.shape[1])
    patch = patch[-image.shape[0] :, : image.shape[1]]
    result[-patch.shape[0] :, : patch.shape[1]] = patch
    return result


def _drawn_mesh(model: ReducedModel, section: SectionPlane | None) -> tuple[MaterialPoints, NDArray[np.int64]]:
    """The nodes that are drawn and their triangles: the surface, or what a section leaves of it, and that."""
    if section is None:
        return surface_points(model)
    inside, cut_open = cut(model, section)
    left, triangles = surface_before(model, section)
    points = MaterialPoints(
        np.concatenate([left.corners, inside.corners]), np.concatenate([left.weights, inside.weights])
    )
    return points, np.concatenate([triangles, cut_open + len(left)])


class AugmentedPicture:
    """Draws a tracked frame: undistorted, with the objects over it, or the reason why one is not there.

    Parameters
    ----------
    camera : whose frames are drawn.
    views : by object; all of the same field, with one range of colours.
    limits : of these colours; where absent, those of all states of the parameter boxes.
    """

    def __init__(
        self, camera: Camera, views: Mapping[str, AugmentedView], limits: tuple[float, float] | None = None
    ) -> None:
        compile_drawing()
        if limits is None:
            coloured = [view for view in views.values() if view.label] or list(views.values())
            ranges = np.array([view.range_of_box() for view in coloured])
            limits = float(ranges[:, 0].min()), float(ranges[:, 1].max())
        self._views, self._limits = dict(views), limits
        self._maps = camera.undistortion_maps()

    def draw(self, frame: Frame, results: Mapping[str, FrameResult]) -> NDArray[np.uint8]:
        """The picture, the nearest object over the others."""
        image, caption = frame.image, f"frame {frame.index}"
        if self._maps is not None:
            image = np.asarray(cv2.remap(image, *self._maps, interpolation=cv2.INTER_LINEAR), dtype=np.uint8)
        missing = {
            name: f"{result.status}: {result.reason}" for name, result in results.items() if result.estimate is None
        }
        if missing and len(results) == 1:
            caption = f"{caption}: {next(iter(missing.values()))}"
        elif missing:
            caption = "; ".join([caption, *(f"{name}: {why}" for name, why in missing.items())])
        if len(missing) == len(results):
            return with_caption(image, caption)
        found = [
            (self._views[name], result.shown_state, result)
            for name, result in results.items()
            if result.shown_state is not None
        ]
        for view, state, result in sorted(found, key=lambda one: -one[0].distance(one[1])):
            mistaken = may_be_mistaken(result.warnings)
            image = view.draw(image, state, self._limits, caption, result.discrepancy, result.jumps, mistaken)
        return image


#: At most so many states are looked at for the range of colours.
MOST_STATES = 60


def write_video(path: Path, source: FrameSource, camera: Camera, run: RunResults, view: AugmentedView) -> None:
    """Draw every frame of the run that the source has; hidden and lost ones are shown as they are, with the reason."""
    # What a mistaken shape would have is not drawn.
    mistaken, states = run.mistaken_frames, zip(run.frames, run.states(), strict=True)
    known = [state for frame, state in states if state is not None and frame not in mistaken]
    limits = view.range_of(known[:: max(1, len(known) // MOST_STATES)])
    picture = AugmentedPicture(camera, {run.model.name: view}, limits)
    results = dict(zip(run.frames, run.results, strict=True))

    def rows() -> Iterator[tuple[Frame, dict[str, FrameResult]]]:
        # Frames that may be missing after those of the run are read ahead, but never asked for.
        for frame in ahead(iter(source)):
            if frame.index in results:  # of a rig, either may lack some
                yield frame, {run.model.name: results[frame.index]}
            if frame.index >= run.frames[-1]:
                return

    with VideoWriter(path, source.fps, (camera.width, camera.height)) as video, threads_side_by_side():
        for image in tqdm(ahead(starmap(picture.draw, rows())), total=len(run), desc="drawing", unit="frame"):
            video.write(image)
