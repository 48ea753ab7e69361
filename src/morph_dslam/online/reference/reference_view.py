"""The reference view: the object's texture, the points bound in it, and features to find it again by."""

from __future__ import annotations

from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from morph_dslam.errors import RegistrationError
from morph_dslam.model.discrepancy import Discrepancy
from morph_dslam.online.attempt import Picture
from morph_dslam.online.estimation.estimator import BoundPoints, Estimator, State
from morph_dslam.online.measuring.appearance import ReferenceAppearance, Rendering
from morph_dslam.online.measuring.binding import (
    DrawnSurface,
    View,
    bind_pixels,
    broadness,
    draw_view,
    view_of,
)
from morph_dslam.online.measuring.features import interior, spread_corners
from morph_dslam.online.measuring.measurement import (
    DEPTH_TOLERANCE,
    Measurement,
    compare_with_rendering,
    visible_surface,
)
from morph_dslam.online.measuring.outline import Outline
from morph_dslam.online.recovering.relocalisation import Relocaliser
from morph_dslam.online.timing import StageClock
from morph_dslam.online.tracker_options import TrackerOptions
from morph_dslam.online.uncertainty.measurement_noise import Measured, window_correlation
from morph_dslam.render.rasteriser import visible_points

Array = NDArray[np.float64]


class ReferenceView:
    """A registered view of the object.

    Parameters
    ----------
    picture : the view. state : the object in it.
    seen : (h, w) where the object is seen; None where it is all that it covers. Nothing is bound elsewhere.
    surface : what of the model is drawn, if another view knows it already.
    discrepancy : what the object's shape has beyond the model's in this view, where that is known.
    least_broadness : points do not count where the surface is seen flatter than in this view, by this factor
        of its area or a smaller one.

    Attributes
    ----------
    surface : what of the model is drawn. points : p of them, bound in the view. pixels : (p, 2) there.
    outline : the object's rim, None where it is not used. all_points : with those of the outline.
    correlation : of the errors of all points' measurements.

    Raises
    ------
    RegistrationError
        If the object shows too few corners.
    """

    def __init__(
        self,
        estimator: Estimator,
        picture: Picture,
        state: State,
        options: TrackerOptions,
        seen: NDArray[np.bool_] | None = None,
        surface: DrawnSurface | None = None,
        least_broadness: float = 0.0,
        discrepancy: Discrepancy | None = None,
    ) -> None:
        self._estimator, self._options, self.state = estimator, options, state
        model, camera = estimator.model, estimator.camera
        self.surface = surface or DrawnSurface.of(model)
        drawn = self.surface.model
        view = view_of(drawn, camera, state, discrepancy)
        self.appearance = ReferenceAppearance(drawn, camera, picture.flat, view, self.surface.closed)
        if seen is None:
            seen = draw_view(view, drawn.triangles, camera).covered
        mask = interior(seen, options.measurement.patch_half + 2)
        self.points = self._choose_points(picture, mask, view)
        beyond = np.zeros((1, 3)) if discrepancy is None else discrepancy.displacement(self.points.rest)
        turned = beyond @ state.camera_from_object.rotation.T
        self.pixels = camera.project(self.points.in_camera(state) + turned)
        self._least_broadness = least_broadness * broadness(
            view, drawn.triangles[self.points.surface.triangles]
        )
        self._grey, self._mask, self._view = picture.grey, mask, view
        self.outline, self.all_points = None, self.points
        if options.use_outline:
            self.outline = Outline(model, camera, picture.grey, state, options.outline)
            self.all_points = self.points.joined(self.outline.points)
        places = camera.project(self.all_points.in_camera(state))
        self.correlation = window_correlation(places, options.flow.window)

    def take_features(self) -> None:
        """Take the features that a lost object is looked for by, unless that was done already."""
        _ = self.relocaliser

    @cached_property
    def relocaliser(self) -> Relocaliser:
        """Finds the object by the view's features; these are taken when it is first asked for."""
        return Relocaliser(self._estimator, self.surface.model, self._grey, self._mask, self._view)

    @property
    def redundancy(self) -> float:
        """How many of the points count as one, because their windows overlap."""
        return float(self.correlation.sum() / len(self.correlation))

    @property
    def nothing_measured(self) -> Measured:
        """What a frame tells that does not show the object."""
        count = len(self.all_points)
        none = np.zeros((count, 2))
        return Measured(self.all_points, none, np.zeros(count), none, self.correlation)

    def covered(self, state: State) -> NDArray[np.bool_]:
        """Pixels (h, w) that the object covers in a state."""
        camera, drawn = self._estimator.camera, self.surface.model
        return draw_view(view_of(drawn, camera, state), drawn.triangles, camera).covered

    def depth(self, state: State) -> NDArray[np.float32]:
        """Depth (h, w) of the object in a state, metres, infinite where it is not."""
        camera, drawn = self._estimator.camera, self.surface.model
        return draw_view(view_of(drawn, camera, state), drawn.triangles, camera).depth

    def projected(self, state: State) -> Array:
        """Where the points (p, 2) are in the image in a state, pixels; NaN behind the camera."""
        return self._estimator.camera.project(self.points.in_camera(state))

    def rendered(self, state: State) -> Rendering:
        """This view as it should appear in a state, flattened."""
        return self.appearance.render(view_of(self.surface.model, self._estimator.camera, state))

    def measure(
        self, picture: Picture, state: State, followed: Measurement | None, clock: StageClock
    ) -> Measurement:
        """Where a frame shows the points, compared with this view rendered in ``state``.

        ``followed`` says where to look first; None where nothing is known but the state.
        """
        drawn, camera = self.surface.model, self._estimator.camera
        with clock.stage("render"):
            view = view_of(drawn, camera, state)
            rendering = self.appearance.render(view)
        with clock.stage("correct"):
            positions = self.points.in_camera(state)
            predicted = camera.project(positions)
            visible = visible_surface(
                self.points.surface, positions, predicted, view, drawn.triangles, self.appearance, rendering
            )
            if picture.in_front is not None:
                tolerance = DEPTH_TOLERANCE * float(np.median(positions[:, 2]))
                visible &= visible_points(predicted, positions[:, 2], picture.in_front, tolerance)
            if self._least_broadness.any():
                seen = broadness(view, drawn.triangles[self.points.surface.triangles])
                visible &= seen >= self._least_broadness
            guesses = predicted
            if followed is not None:
                guesses = np.where(followed.valid[:, None], followed.pixels, predicted)
            return compare_with_rendering(
                picture.flat,
                rendering,
                predicted,
                guesses,
                visible,
                self._options.flow,
                self._options.measurement,
            )

    def _choose_points(self, picture: Picture, mask: NDArray[np.uint8], view: View) -> BoundPoints:
        model, camera = self._estimator.model, self._estimator.camera
        corners = spread_corners(picture.flat, mask, self._options.n_points)
        surface, _ = bind_pixels(self.surface.model, camera, view, corners)
        if len(surface) < 2 * (len(model.parameters) + 6):
            raise RegistrationError(
                f"the object shows only {len(surface)} corners in the reference frame, too few to follow it: "
                "take a sharper reference frame, or give the object a printed texture"
            )
        return BoundPoints.from_surface(model, surface)
