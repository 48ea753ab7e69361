"""The bar's softness and pose from one picture, by the tracker's estimator."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pictures import Picture
from recording import CLAMP_X
from silhouette import FINER, Matches, match
from silicone import PUBLISHED_SHEAR

import morph_dslam as md
from morph_dslam.extend.tracking import (
    BoundPoints,
    EstimationOptions,
    Estimator,
    PointDepths,
    Prior,
    State,
    bind_pixels,
    draw_view,
    view_of,
)

Array = NDArray[np.float64]

#: What the marker's two solutions for the camera, which stood still, differ by about each axis (root mean
#: square), radians.
MARKER_STD = np.radians(1.2)
#: The clamp's rim hides what is nearer to it, metres.
RIM = 0.01
#: How far from the model the outline is looked for, pixels, and how often in all; the last one until the end.
REACHES, ROUNDS = (60, 40, 25, 15, 12, 10), 30
#: Depths are taken at every so many pixels along rows and columns: what they are off by is alike all over.
DEPTH_STEP = 32
#: Half the width of a 95 % interval in standard deviations.
INTERVAL_95 = 1.96
#: An outline is read no better than so, however well it fits: to the spacing of its points, pixels.
LEAST_PX = 1.0 / FINER
#: Softness to start from; the bar's end is far from the outline's where it is wrong.
STARTS = (0.5, 1.0, 1.6)


@dataclass(frozen=True)
class Fit:
    """The bar as one picture shows it.

    Attributes
    ----------
    state : softness and pose.
    softness_std : its standard deviation.
    outline_rms : px, at least `LEAST_PX`.
    alike : neighbouring points of the outline that have one error together, on average.
    turn : by which the pose differs from the marker's, radians.
    """

    state: State
    softness_std: float
    outline_rms: float
    alike: float
    turn: float

    @property
    def shear(self) -> float:
        """Shear modulus, Pa."""
        return PUBLISHED_SHEAR / float(self.state.parameters[0])

    @property
    def interval(self) -> tuple[float, float]:
        """Its 95 % interval, Pa."""
        softness, off = float(self.state.parameters[0]), INTERVAL_95 * self.softness_std
        return PUBLISHED_SHEAR / (softness + off), PUBLISHED_SHEAR / max(softness - off, 1e-9)


def fit(model: md.ReducedModel, picture: Picture, turn_std: float = MARKER_STD) -> Fit:
    """Estimate softness and pose, from several starts; the one that leaves the least of the outline.

    Parameters
    ----------
    turn_std : standard deviation of the bar's turn in its clamp against the marker, about each axis, radians.
    """
    fits = [_fit_from(model, picture, turn_std, softness) for softness in STARTS]
    return min(fits, key=lambda fit: fit.outline_rms)


def _fit_from(model: md.ReducedModel, picture: Picture, turn_std: float, softness: float) -> Fit:
    estimator = Estimator(model, picture.camera, EstimationOptions(max_iterations=60))
    state = State(np.array([softness]), picture.camera_from_object)
    free = model.nodes[:, 0] < CLAMP_X - RIM
    variance, alike = 1.0, 1.0
    for reach in REACHES + REACHES[-1:] * (ROUNDS - len(REACHES)):
        matches = match(model, picture.camera, state, free, picture.outline, reach)
        prior = _pose_prior(picture, turn_std, variance)
        points, pixels, depths = _with_depths(model, picture, state, matches, variance)
        normals = np.zeros_like(pixels)
        count = len(matches.points)
        normals[:count] = matches.normals
        weights = np.where(np.arange(len(points)) < count, 1.0 / alike, 0.0)
        state = estimator.estimate(points, pixels, weights, state, normals, prior, depths).state
        _, hessian, _, residuals = estimator.evaluate(points, pixels, weights, state, normals, prior, depths)
        off = np.einsum("px,px->p", residuals[:count], matches.normals)
        variance = max(float(np.mean(off**2)), LEAST_PX**2)
        alike = points_alike(off[np.argsort(matches.places)])
    turned = state.camera_from_object.rotation @ picture.camera_from_object.rotation.T
    turn = float(np.arccos(np.clip(0.5 * (np.trace(turned) - 1.0), -1.0, 1.0)))
    softness_std = float(np.sqrt(variance * np.linalg.inv(hessian)[0, 0]))
    return Fit(state, softness_std, float(np.sqrt(variance)), alike, turn)


def points_alike(errors: Array) -> float:
    """How many neighbours in a sequence of errors (n,) have one error together: 1 + 2 sum of correlations.

    The sum ends where the correlation is first not positive (Geyer, Statistical Science 7, 1992).
    """
    errors = errors - errors.mean()
    count = len(errors)
    correlation = np.correlate(errors, errors, "full")[count - 1 :] / float(errors @ errors)
    end = int(np.argmax(correlation <= 0.0)) or count
    return 1.0 + 2.0 * float(correlation[1:end].sum())


def _pose_prior(picture: Picture, turn_std: float, variance: float) -> Prior:
    """What the marker says of the pose, in squared pixels where an outline point has this variance."""
    deviations = np.repeat([turn_std, picture.place_std], 3)
    information = np.diag(variance / deviations**2)
    return Prior(np.zeros(1), np.zeros((1, 1)), picture.camera_from_object, information)


def _with_depths(
    model: md.ReducedModel, picture: Picture, state: State, matches: Matches, variance: float
) -> tuple[BoundPoints, Array, PointDepths | None]:
    """The outline's points and, where there is a depth image, points inside of it with their depths."""
    if picture.depth is None:
        return matches.points, matches.pixels, None
    view = view_of(model, picture.camera, state)
    rows, columns = np.nonzero(draw_view(view, model.triangles, picture.camera).covered)
    chosen = (rows % DEPTH_STEP == 0) & (columns % DEPTH_STEP == 0)
    pixels = np.column_stack([columns[chosen], rows[chosen]]).astype(np.float64)
    surface, met = bind_pixels(model, picture.camera, view, pixels)
    shown = model.rest_positions(surface)[:, 0] < CLAMP_X - RIM
    inner = BoundPoints.from_surface(model, surface.take(shown))
    points = matches.points.joined(inner)
    pixels = np.concatenate([matches.pixels, pixels[met][shown]])
    used = np.arange(len(points)) >= len(matches.points)
    return (points, pixels, PointDepths.sampled(picture.depth, pixels, used, picture.camera, variance))
