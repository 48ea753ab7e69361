"""The reference view: the object's texture, the points bound in it, and features to find it again by.

Of an object in a map there are many images, from all sides from which it was scanned. What the first one does
not show, or shows very flat, takes its texture and its points from another.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, reduce

import numpy as np
import scipy.sparse
from numpy.typing import NDArray

from morph_dslam.errors import RegistrationError, RegistrationFailure
from morph_dslam.model import ReducedModel, SurfacePoints
from morph_dslam.model.discrepancy import Discrepancy
from morph_dslam.model.reduced_model import spread_over, triangle_normals
from morph_dslam.render.rasteriser import Buffers, visible_points
from morph_dslam.timing import stage
from morph_dslam.tracking.binding import (
    Drawing,
    DrawnSurface,
    View,
    bind_pixels,
    draw_view,
    facing,
    foreshortening,
    signed_areas,
    view_of,
)
from morph_dslam.tracking.covariance import BoundPart
from morph_dslam.tracking.estimator import BoundPoints, Estimator, State
from morph_dslam.tracking.hypothesis import Image
from morph_dslam.tracking.measurement import (
    DEPTH_TOLERANCE,
    PATCH_HALF,
    PATCH_WINDOW,
    Measurement,
    ReferenceAppearance,
    Rendering,
    choose_sources,
    compare_with_rendering,
    part_from,
    shown_areas,
    visible_surface,
)
from morph_dslam.tracking.noise import Correlation, Observations, middle, window_correlation
from morph_dslam.tracking.options import TrackerOptions
from morph_dslam.tracking.outline import Outline
from morph_dslam.tracking.patches import interior, spread_corners, weaker_slope
from morph_dslam.tracking.relocalization import Relocalizer
from morph_dslam.tracking.window_means import WindowMeans

Array = NDArray[np.float64]
#: Slope of the image, grey levels a pixel, that tells texture from noise and shading; see `weaker_slope`.
LEAST_SLOPE = 1.0
#: Samples of the surface: a share is then known to about three per cent.
N_SAMPLES = 600
#: Of the area in a frame that a reference view must show something with: a half in each direction.
LEAST_AREA = 0.25
#: The active view is kept as long as it covers this share of the surface that is seen.
KEEP_SHARE = 0.6
#: An earlier view, whose error is smaller, is gone back to when it covers this share: more, so that two views
#: do not take turns.
BACK_SHARE = 0.75


class SurfaceSamples:
    """Triangles spread over the undeformed surface, as many as their area asks for.

    What a view shows of one is its area in the image over its undeformed area. A reference view serves a frame
    where it shows the same side of the surface, and not much smaller.

    Attributes
    ----------
    model : at a point of each of them alone, without triangles.
    """

    def __init__(self, estimator: Estimator, surface: DrawnSurface) -> None:
        model, self._camera, self._closed = estimator.model, estimator.camera, surface.closed
        points = spread_over(model.nodes, model.triangles, N_SAMPLES)
        self.model = replace(
            model,
            nodes=model.rest_positions(points),
            triangles=np.empty((0, 3), dtype=np.int64),
            displacement=model.restrict(points),
            stresses={},
            cells={},
            strain=None,
            reactions={},
        )
        chosen = points.triangles
        self._corners = BoundPoints.from_surface(model, points).corners(model)
        normals = triangle_normals(model.nodes, model.triangles[chosen])
        self._areas = 0.5 * np.linalg.norm(normals, axis=1)

    def seen(self, state: State, depth: NDArray[np.float32]) -> Array:
        """What a view shows of each sample (k,), squared pixels a squared metre; 0 where it is hidden.

        Parameters
        ----------
        depth : (h, w) of the object in ``state``, metres, infinite where it is not.

        Returns
        -------
        Negative where the corners of the triangle run anticlockwise in the image: the other side is seen.
        """
        positions = self._corners.in_camera(state)
        centres = positions.reshape(-1, 3, 3).mean(axis=1)
        areas = signed_areas(self._camera.project(positions).reshape(-1, 3, 2))
        tolerance = DEPTH_TOLERANCE * middle(centres[:, 2])
        shown = visible_points(self._camera.project(centres), centres[:, 2], depth, tolerance)
        shown &= np.isfinite(areas) & ((areas < 0.0) | (not self._closed))
        return np.where(shown, np.nan_to_num(areas) / self._areas, 0.0)


def covered_share(now: Array, reference: Array) -> float:
    """The share, by area in the image, of what is seen ``now`` (k,) that a reference view (k,) shows well."""
    served = (np.sign(now) == np.sign(reference)) & (np.abs(reference) >= LEAST_AREA * np.abs(now))
    total = np.abs(now).sum()
    return float(np.abs(now[served]).sum() / total) if total > 0.0 else 0.0


def choose_view(shares: Sequence[float], errors: Sequence[float], active: int) -> int | None:
    """Which reference view is to be followed; None where none serves and a new one is wanted.

    Parameters
    ----------
    shares : of the surface seen now that each view covers.
    errors : of each view's own state, metres.
    active : the view followed so far.
    """
    better = [k for k, share in enumerate(shares) if share >= BACK_SHARE and errors[k] < errors[active]]
    if better:
        return min(better, key=lambda k: errors[k])
    if shares[active] >= KEEP_SHARE:
        return active
    serving = [k for k, share in enumerate(shares) if share >= KEEP_SHARE]
    return max(serving, key=lambda k: shares[k]) if serving else None


#: With several pictures there are at most so many times the points of one.
MOST_TIMES = 2.0


@dataclass(frozen=True)
class PosedImage:
    """A picture of the object in a known state.

    Attributes
    ----------
    error_factors : (d + 6, c) how ``state`` is off by c error factors, the same for all views of an object,
        in their standard deviations; None where nobody knows.
    seen : (h, w) where the picture shows the object; None where it is all that it covers.
    discrepancy : what the object's shape has beyond the model's in it, where that is known.
    frame : its number in the recording, if it is known.
    """

    picture: Image
    state: State
    error_factors: Array | None = None
    seen: NDArray[np.bool_] | None = None
    discrepancy: Discrepancy | None = None
    frame: int | None = None

    def shown(self, drawn: Buffers) -> tuple[NDArray[np.bool_], NDArray[np.float32]]:
        """Where (h, w) the picture shows the object as ``drawn``, and its depth (h, w), metres.

        Where something else is before the object nothing of it is shown, as if that were at depth 0.
        """
        shown = drawn.covered if self.seen is None else self.seen & drawn.covered
        return shown, np.where(drawn.covered & ~shown, np.float32(0.0), drawn.depth)


#: Points do not count where the surface is seen this much flatter than in their picture: next to nothing is left of
#: their patches, and what is beside the surface fills the rest.
LEAST_BROADNESS = 0.1
#: An object of which other ones hide more than this share, and which shows too few corners, is not blurred.
MOSTLY_HIDDEN = 0.5


def _on_texture(picture: Image, places: Array) -> NDArray[np.bool_]:
    """Which places (p,) in a picture show texture: noise and shading make corners too."""
    return weaker_slope(picture.normalized, places, PATCH_WINDOW) > LEAST_SLOPE


def fewest_points(model: ReducedModel) -> int:
    """How many points there must be: two for each unknown of pose and parameters."""
    return 2 * (len(model.parameters) + 6)


class ReferenceView:
    """A registered view of the object, or several of the same undeformed one.

    Parameters
    ----------
    views : the view, and others that show what it does not. Nothing is bound but where they show the object.
    surface : what of the model is drawn, if another view knows it already.
    least_broadness : points do not count where the surface is seen flatter than in their view, by this factor
        of its area or a smaller one.

    Attributes
    ----------
    state : in the first view.
    surface : what of the model is drawn.
    points : p of them, bound in the views.
    parts : which of them in which view, in order.
    pixels : (p, 2) where they are in the first view, hidden or not.
    outline : the object's contour, None where it is not used.
    outline_alone : whether the object shows too few corners to count, so that its outline is all there is.
    few_corners : how many it shows on texture, and how many are needed, where these are too few to count; else None.
    all_points : with those of the outline.
    correlation : of the errors of all points' measurements.

    Raises
    ------
    RegistrationError
        If the object shows too few corners, and its outline is not used.
    """

    def __init__(
        self,
        estimator: Estimator,
        views: Sequence[PosedImage],
        options: TrackerOptions,
        surface: DrawnSurface | None = None,
        least_broadness: float = LEAST_BROADNESS,
    ) -> None:
        self._estimator, self._options, self._views = estimator, options, views
        # Of the states of the last frames, which are asked for several times.
        self._projected: deque[tuple[State, Array]] = deque(maxlen=4)
        model, camera, first = estimator.model, estimator.camera, views[0]
        self.state = first.state
        self.surface = surface or DrawnSurface.of(model)
        drawn = self.surface.model
        meshes = [view_of(drawn, camera, view.state, view.discrepancy) for view in views]
        masks, per_pixel = self._draw(meshes)
        self.few_corners: tuple[int, int] | None = None
        bound = self._bind(meshes, masks, per_pixel)
        self.points = reduce(BoundPoints.joined, bound)
        ends = np.cumsum([len(points) for points in bound])
        self.parts = [
            BoundPart(slice(end - len(points), end), view.state, view.error_factors)
            for end, points, view in zip(ends.tolist(), bound, views, strict=True)
        ]
        beyond = np.zeros((1, 3))
        if first.discrepancy is not None:
            beyond = first.discrepancy.displacement(self.points.rest)
        turned = beyond @ self.state.camera_from_object.rotation.T
        self.pixels = camera.project(self.points.in_camera(self.state) + turned)
        self._least_broadness = least_broadness * np.concatenate(
            [
                foreshortening(mesh, drawn.triangles[points.surface.triangles])
                for mesh, points in zip(meshes, bound, strict=True)
            ]
        )
        self._corners = drawn.triangles[self.points.surface.triangles].ravel()
        self._is_front = np.concatenate(
            [facing(mesh, drawn.triangles[p.surface.triangles]) for mesh, p in zip(meshes, bound, strict=True)]
        )
        self._mask, self._mesh = masks[0], meshes[0]
        self.outline: Outline | None = None
        self.outline_alone = not len(self.points)
        if options.use_outline:
            self.outline = Outline(model, camera, self.surface)
            if first.picture.has_grey:
                self.outline.take_brightness(first.picture.grey, self.state, first.seen)
        self.all_points = self.points if self.outline is None else self.points.joined(self.outline.points)
        self.correlation = self._correlation()

    def take_features(self) -> None:
        """Take the features that a lost object is looked for by, unless that was done already."""
        _ = self.relocaliser

    @cached_property
    def relocaliser(self) -> Relocalizer:
        """Finds the object by the view's features; these are taken when it is first asked for."""
        grey = self._views[0].picture.grey
        return Relocalizer(self._estimator, self.surface.model, grey, self._mask, self._mesh)

    @cached_property
    def window_means(self) -> WindowMeans:
        """By how much windows miss motions of the points."""
        return WindowMeans(self.points.rest)

    @property
    def n_textured(self) -> int:
        """How many of the points are on texture."""
        camera, found = self._estimator.camera, 0
        for view, part in zip(self._views, self.parts, strict=True):
            places = camera.project(self.points.in_camera(part.state)[part.rows])
            found += int(_on_texture(view.picture, places).sum())
        return found

    @cached_property
    def redundancy(self) -> float:
        """How many of the texture's points count as one, because their windows overlap; of an outline alone 1."""
        count = len(self.points)
        return float(scipy.sparse.csr_array(self.correlation)[:count, :count].sum() / count) if count else 1.0

    @property
    def nothing_measured(self) -> Observations:
        """What a frame tells that does not show the object."""
        count = len(self.all_points)
        none = np.zeros((count, 2))
        return Observations(self.all_points, none, np.zeros(count), none, self.correlation)

    def covered(self, state: State) -> NDArray[np.bool_]:
        """Pixels (h, w) that the object covers in a state."""
        return self._drawn(state).covered

    def depth(self, state: State) -> NDArray[np.float32]:
        """Depth (h, w) of the object in a state, metres, infinite where it is not."""
        return self._drawn(state).depth

    def _drawn(self, state: State) -> Buffers:
        camera, drawn = self._estimator.camera, self.surface.model
        return draw_view(view_of(drawn, camera, state), drawn.triangles, camera)

    def shown(self, samples: SurfaceSamples) -> Array:
        """What the pictures show of each sample (k,), as `SurfaceSamples.seen` has it, the most of all."""
        depths = [view.shown(self._drawn(view.state))[1] for view in self._views]
        seen = np.stack([samples.seen(v.state, depth) for v, depth in zip(self._views, depths, strict=True)])
        return seen[np.abs(seen).argmax(axis=0), np.arange(seen.shape[1])]

    def projected(self, state: State) -> Array:
        """Where the points (p, 2) are in the image in a state, pixels; NaN behind the camera."""
        for known, pixels in self._projected:
            if known is state:
                return pixels.copy()
        pixels = self._estimator.camera.project(self.points.in_camera(state))
        self._projected.append((state, pixels))
        return pixels.copy()

    def rendered(self, state: State) -> Rendering:
        """This view as it should appear in a state, contrast-normalized."""
        return self.appearance.render(view_of(self.surface.model, self._estimator.camera, state))

    def measure(self, picture: Image, state: State, offsets: Array | None) -> Measurement:
        """Where a frame shows the points, compared with this view rendered in ``state``.

        ``offsets`` (p, 2) says how far from there, pixels, the points are about to be; None where nothing is known but
        the state.
        """
        camera = self._estimator.camera
        with stage("render"):
            view = view_of(self.surface.model, camera, state)
            rendering = self.appearance.render(view)
        with stage("correct"):
            positions = self.points.in_camera(state)
            predicted = camera.project(positions)
            tolerance = DEPTH_TOLERANCE * middle(positions[:, 2])
            visible = visible_surface(
                view.nodes[self._corners], view.pixels[self._corners], self._is_front, self._least_broadness,
                positions, predicted, rendering.depth, tolerance,
            )  # fmt: skip
            if picture.occluder_depth is not None:
                visible &= visible_points(predicted, positions[:, 2], picture.occluder_depth, tolerance)
            drift = None if picture.motion is None else picture.motion.of_points.drift(self.projected, state)
            found = compare_with_rendering(picture.normalized, rendering, predicted, visible, offsets, drift)
        drawing = Drawing(state, view, rendering.triangle_ids, rendering.depth)
        return replace(found, drawing=drawing, rendered=rendering.image)

    def _draw(self, meshes: Sequence[View]) -> tuple[list[NDArray[np.uint8]], float]:
        """Make the texture.

        Returns
        -------
        masks : (h, w) each, 255 where points may be bound in the picture.
        per_pixel : how many a pixel.
        """
        drawn, closed, camera = self.surface.model, self.surface.closed, self._estimator.camera
        buffers = [draw_view(mesh, drawn.triangles, camera) for mesh in meshes]
        shown = [view.shown(buffer) for view, buffer in zip(self._views, buffers, strict=True)]
        sources = np.zeros(len(drawn.triangles), dtype=np.int64)
        if len(meshes) > 1:
            sources = choose_sources(
                [
                    shown_areas(mesh, drawn.triangles, depth, closed)
                    for mesh, (_, depth) in zip(meshes, shown, strict=True)
                ]
            )
        normalized_images = [view.picture.normalized for view in self._views]
        self.appearance = ReferenceAppearance(drawn, camera, normalized_images, meshes, sources, closed)
        masks = [interior(seen, PATCH_HALF + 2) for seen, _ in shown]
        per_pixel = self._options.n_points / max(np.count_nonzero(masks[0]), 1)
        for number, (mask, buffer) in enumerate(zip(masks, buffers, strict=True)):
            mask[~part_from(number, buffer.triangle_ids, sources)] = 0
        return masks, per_pixel

    def _bind(self, meshes: Sequence[View], masks: Sequence[NDArray[np.uint8]], per_pixel: float) -> list[BoundPoints]:
        """Corners of every picture bound to the mesh, as dense in the others as in the first."""
        model, camera = self._estimator.model, self._estimator.camera
        counts = per_pixel * np.array([np.count_nonzero(mask) for mask in masks])
        counts *= min(1.0, MOST_TIMES * self._options.n_points / max(counts.sum(), 1.0))
        bound = []
        for view, mesh, mask, count in zip(self._views, meshes, masks, counts, strict=True):
            corners = spread_corners(view.picture.normalized, mask, max(round(count), 1))
            if self._options.use_outline:
                corners = corners[_on_texture(view.picture, corners)]
            surface, _ = bind_pixels(self.surface.model, camera, mesh, corners)
            bound.append(BoundPoints.from_surface(model, surface))
        found = sum(len(points) for points in bound)
        fewest = fewest_points(model)
        needed = max(fewest, self._options.least_inliers)
        if self._options.use_outline and (found < needed or not self._options.use_texture):
            self.few_corners = (found, needed) if self._options.use_texture else None
            none = SurfacePoints(np.zeros(0, dtype=np.int64), np.zeros((0, 3)))
            return [BoundPoints.from_surface(model, none) for _ in bound]
        if found < fewest:
            hidden = self._hidden_share()
            if hidden > MOSTLY_HIDDEN:
                raise RegistrationError(
                    f"other objects hide {hidden:.0%} of the object in the reference frame, too much to follow it: "
                    "give each object its own place, or take a reference frame that shows it",
                    RegistrationFailure.FEW_CORNERS,
                )
            raise RegistrationError(
                f"the object shows only {found} corners in the reference frame, too few to follow it: "
                "take a sharper reference frame, give the object a printed texture, or use its outline (--outline)",
                RegistrationFailure.FEW_CORNERS,
            )
        return bound

    def _hidden_share(self) -> float:
        """Which part of what the object covers in the pictures shows something else."""
        drawn = [self._drawn(view.state) for view in self._views]
        shown = sum(np.count_nonzero(view.shown(one)[0]) for view, one in zip(self._views, drawn, strict=True))
        return 1.0 - shown / max(sum(np.count_nonzero(one.covered) for one in drawn), 1)

    def _correlation(self) -> Correlation:
        """Of the points' errors (p, p): those of one picture share what their windows do."""
        camera, blocks = self._estimator.camera, []
        for part in self.parts:
            places = camera.project(self.points.in_camera(part.state)[part.rows])
            blocks.append(window_correlation(places, PATCH_WINDOW))
        if self.outline is not None:
            blocks.append(scipy.sparse.eye_array(len(self.outline.points)))
        return scipy.sparse.csr_array(scipy.sparse.block_diag(blocks))


def first_view(
    estimator: Estimator, images: Sequence[PosedImage], options: TrackerOptions, outline_too: bool
) -> tuple[ReferenceView, TrackerOptions]:
    """The reference view that tracking begins with, and the options with which it was made.

    Parameters
    ----------
    outline_too : whether to use the outline, unasked, of an object that shows too little texture.

    Raises
    ------
    RegistrationError
        If the object shows too few corners, and its outline is not to be used.
    """
    try:
        view = ReferenceView(estimator, images, options)
        if options.use_outline or not outline_too or view.n_textured >= fewest_points(estimator.model):
            return view, options
    except RegistrationError as error:
        if not outline_too or error.reason is not RegistrationFailure.FEW_CORNERS:
            raise
    options = replace(options, use_outline=True)
    return ReferenceView(estimator, images, options), options
