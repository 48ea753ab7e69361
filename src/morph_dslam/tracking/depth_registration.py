"""An object's state by the depth image of the frame in which it is registered.

A fixed pixel's depth is compared with that of the surface that the pixel sees. Where the surface slopes, that changes
as the surface moves sideways too, so the derivatives are those with the pixel's point found anew in each state. With
those of one material point, as of points whose pixels are measured, a sheet turned by 40 degrees ends millimetres off.

Where in its pixel a depth was measured is not known. The steeper the surface is there, the more that matters: without
it, the few pixels that graze a round body or the side of a block decide on the distance, by the size in the image.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import approx_fprime

from morph_dslam.errors import RegistrationError
from morph_dslam.sources.recorded import DEPTH_SCALE
from morph_dslam.tracking.binding import bind_pixels, draw_view, view_of
from morph_dslam.tracking.depth import SCALE_STD, SIGMA_AT_1M, PointDepths
from morph_dslam.tracking.depth_scale import DepthScale
from morph_dslam.tracking.estimator import BoundPoints, Estimate, Estimator, State, moved
from morph_dslam.tracking.known_state import DepthTerm
from morph_dslam.tracking.levenberg_marquardt import Minimum
from morph_dslam.tracking.refinement import EFFECTIVE_POINTS, minimum

Array = NDArray[np.float64]
#: Points that are compared, how often they are chosen anew, and how many are needed.
POINTS, ROUNDS, LEAST = 600, 3, 30
#: Unknowns are searched for in steps of this share of their scale.
STEP = 1e-2
#: Depths farther from the surface than this share of the object's size are of something else.
LARGEST_DISTANCE = 0.05
#: Deviation of a place that is anywhere in its pixel, in either direction of the image, pixels.
IN_PIXEL = 12.0**-0.5
#: Derivatives are differences over this, in `STEP`: over more of it a pixel that grazes goes from facet to facet.
FINE = 1e-4
#: Beside that they may be off by what this many deviations of their scale make.
SCALE_SIGMAS = 3.0
#: Depth within this many pixels of the object's rim may belong to what is behind it.
RIM_PX = 4
#: Of an object so narrow that fewer pixels than this are farther inside, those nearer to the rim count.
ENOUGH = 100


@dataclass(frozen=True)
class FoundByDepth:
    """An object's state by depth.

    Attributes
    ----------
    estimate : its covariance contains how well the scale of the depths is known.
    scale : of all depths, as landmarks and what is known of the depth camera have it.
    deviations : by which that scale differs from one, in the deviations that were known before.
    cost : half of the sum of squares of all residuals, in deviations.
    share_near : of the depths measured where the object is seen, those near to it.
    """

    estimate: Estimate
    scale: DepthScale
    deviations: float
    cost: float
    share_near: float


def refine_by_depth(
    estimator: Estimator,
    landmarks: BoundPoints,
    pixels: Array,
    state: State,
    sigma_px: float,
    image: NDArray[np.float32],
    sigma_at_1m: float = SIGMA_AT_1M,
    scale_std: float = SCALE_STD,
    off: float = 0.0,
) -> FoundByDepth:
    """The state of an object from landmarks and a depth image of the same view.

    All depths may be off by one factor, which no residual of depths shows. It is one more unknown: where the landmarks
    know the distance better than the depth camera does, they decide.

    Parameters
    ----------
    landmarks : k of them, bound.
    pixels : (k, 2) of them in the undistorted image.
    state : as the landmarks have it.
    sigma_px : how exactly they were set.
    image : (h, w) as recorded, metres, NaN where unknown.
    sigma_at_1m : standard deviation of a pixel's depth at 1 m, metres.
    scale_std : of what all depths are off by together, a share.
    off : by how much more the landmarks may have it too near or too far, metres.

    Raises
    ------
    RegistrationError
        If there is hardly any depth where the landmarks have the object.
    """
    found, factor = None, 1.0
    for number in range(ROUNDS):
        # At first all of them may be off together, by what the scale of the depth camera may be.
        begin = (0.0, 0.0) if number else (SCALE_SIGMAS * scale_std, off)
        points, places, measured, near = _depths_in_view(estimator, state, image * factor, sigma_at_1m, *begin)
        depths = measured.only(near)
        if depths.count < LEAST:
            ratio = measured.ratio_to(points.in_camera(state)[:, 2])
            there = "none was measured on it" if ratio is None else f"the measured ones are {ratio:.3g} times those"
            raise RegistrationError(
                f"only {depths.count} of {len(points)} points on the object have a depth near the one that the "
                f"landmarks give; {there}. Is the depth registered to this camera? If not, do that first; else correct "
                f"--depth-per-metre, {DEPTH_SCALE}, or the landmarks"
            )
        term = _term(estimator, state, points, places, depths).scaled(1.0 / factor)
        fit = _DepthFit(estimator, landmarks, pixels, sigma_px, term, state, scale_std)
        found = fit.found(depths.count / measured.count)
        state, factor = found.estimate.state, found.scale.factor
    assert found is not None
    return found


class _DepthFit:
    """Residuals of landmarks and depth as a function of steps from a state, and of the scale of all depths.

    The last unknown is by how many of its deviations that scale, a factor, differs from one.
    """

    def __init__(
        self,
        estimator: Estimator,
        landmarks: BoundPoints,
        pixels: Array,
        sigma_px: float,
        term: DepthTerm,
        start: State,
        scale_std: float,
    ) -> None:
        self._estimator, self._landmarks, self._pixels = estimator, landmarks, pixels
        self._sigma_px, self._term, self._start = sigma_px, term, start
        self._scale, self._scale_std = STEP * estimator.box.scale, scale_std

    def found(self, share_near: float) -> FoundByDepth:
        """Where all fits best, parameters that are known held."""
        box, d = self._estimator.box, len(self._start.parameters)
        free = np.concatenate([box.upper > box.lower, np.ones(7, dtype=bool)])
        columns = np.eye(d + 7)[:, free]
        bounds = np.full((2, d + 7), np.inf) * [[-1.0], [1.0]]
        bounds[:, :d] = (np.array([box.lower, box.upper]) - self._start.parameters) / self._scale[:d]
        bounds += np.array([[-1e-6], [1e-6]])
        lower, upper = bounds[:, free]
        found = minimum(lambda step: self._residuals(columns @ step), np.zeros(columns.shape[1]), (lower, upper), 10)
        step = columns @ found.x
        inwards = np.where(step + FINE > bounds[1], -FINE, FINE)
        derivatives = np.asarray(approx_fprime(step, self._residuals, inwards))
        slopes, by_deviation, free = derivatives[:, :-1] / self._scale, derivatives[:, -1], free[:-1]
        variance, converged = self._sigma_px**2, found.status > 0
        hessian = variance * slopes.T @ slopes
        best = Minimum(self._at(step), variance * found.cost, hessian, self._away(step), found.nfev, converged)
        scaled = slopes[:, free] * self._scale[free]
        followed = -np.linalg.lstsq(scaled, by_deviation)[0]
        std = 1.0 / float(np.linalg.norm(by_deviation + scaled @ followed))  # at most 1: what was known is in it
        by_scale = np.zeros(d + 6)
        by_scale[free] = std * self._scale[free] * followed
        scale = DepthScale(1.0 + self._scale_std * float(step[-1]), std * self._scale_std)
        estimate = self._estimator.finished(best, np.ones(len(self._pixels)), np.full(len(self._pixels), 2))
        # To first order one standard deviation of the scale moves the state by this.
        estimate = replace(estimate, covariance=estimate.covariance + np.outer(by_scale, by_scale))
        return FoundByDepth(estimate, scale, float(step[-1]), best.cost / variance, share_near)

    def _at(self, step: Array) -> State:
        return self._estimator.box.nearest(moved(self._start, step[:-1] * self._scale))

    def _away(self, step: Array) -> Array:
        """How far the landmarks are from their pixels (k, 2)."""
        return self._estimator.camera.project(self._landmarks.in_camera(self._at(step))) - self._pixels

    def _residuals(self, step: Array) -> Array:
        """Of landmarks, depths and their scale, in standard deviations."""
        away, huber = self._away(step), self._estimator.options.huber_px
        length = np.linalg.norm(away, axis=1, keepdims=True)
        away = away * np.sqrt(np.minimum(1.0, huber / np.maximum(length, 1e-12))) / self._sigma_px
        term = self._term.scaled(1.0 + self._scale_std * step[-1])
        return np.concatenate([away.ravel(), term.residuals(self._estimator.camera, self._at(step)), step[-1:]])


def share_behind(
    estimator: Estimator, state: State, image: NDArray[np.float32], sigma_at_1m: float = SIGMA_AT_1M
) -> float:
    """Share of the depths measured where the object is seen that lie clearly behind it; 0 where there are too few.

    No depth that belongs to these pixels does: the object is in the way. What stands before it is not counted. Nor is
    the object's rim (`RIM_PX`), where depth and colour of aligned cameras may be some pixels apart.

    Parameters
    ----------
    state : of the object, as registered with this image.
    image : (h, w) as recorded, metres, NaN where unknown.
    """
    points, _, measured, near = _depths_in_view(estimator, state, image, sigma_at_1m)
    behind = (measured.weights > 0.0) & ~near & (measured.depths > points.in_camera(state)[:, 2])
    return float(behind.sum() / measured.count) if measured.count >= LEAST else 0.0


def depth_term(
    estimator: Estimator, state: State, image: NDArray[np.float32], sigma_at_1m: float = SIGMA_AT_1M
) -> DepthTerm:
    """What a depth image says of the object's state in its frame, as a term beside those of other frames.

    Parameters
    ----------
    state : near to which the object is, as registered with this image.
    image : (h, w) as recorded, metres, NaN where unknown.
    """
    points, places, measured, near = _depths_in_view(estimator, state, image, sigma_at_1m)
    return _term(estimator, state, points, places, measured.only(near))


def _term(estimator: Estimator, state: State, points: BoundPoints, places: Array, depths: PointDepths) -> DepthTerm:
    """Depths as a term that counts for as many points as a keyframe does.

    What a mesh is off by is alike over wide parts of it. Each counts with what depth shows there if that is more than
    noise.
    """
    variance = depths.variance_px(depths.terms(points, state)[3])
    share = np.sqrt(min(EFFECTIVE_POINTS / max(depths.count, 1), 1.0) / variance)
    return DepthTerm(estimator.model, estimator.camera.distort_pixels(places), depths, float(share))


def _depths_in_view(
    estimator: Estimator,
    state: State,
    image: NDArray[np.float32],
    sigma_at_1m: float,
    share_off: float = 0.0,
    off: float = 0.0,
) -> tuple[BoundPoints, Array, PointDepths, NDArray[np.bool_]]:
    """Points spread over what the camera sees of the surface, their pixels (p, 2), the depths, and which are near it.

    Depths have weights in standard deviations. Those are near it too that are off by ``share_off`` of the distance, and
    ``off``, metres, more.
    """
    points, places = _surface_in_view(estimator, state)
    seen = np.ones(len(points), dtype=bool)
    depths = PointDepths.sampled(image, places, seen, estimator.camera, 1.0, sigma_at_1m)
    depths = depths.off_by(IN_PIXEL * _steepness(estimator, state, points, places))
    size = float(np.linalg.norm(np.ptp(estimator.model.nodes, axis=0)))
    distances = points.in_camera(state)[:, 2]
    near = np.abs(depths.depths - distances) < LARGEST_DISTANCE * size + share_off * distances + off
    return points, places, depths, near


def _surface_in_view(estimator: Estimator, state: State) -> tuple[BoundPoints, Array]:
    """Points spread over what the camera sees of the surface, and their pixels (p, 2)."""
    model, camera = estimator.model, estimator.camera
    view = view_of(model, camera, state)
    covered = draw_view(view, model.triangles, camera).covered.astype(np.uint8)
    rows, columns = np.nonzero(covered)
    for rim in range(RIM_PX, 0, -1):
        disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * rim + 1,) * 2)
        inside = np.nonzero(cv2.erode(covered, disc))
        if len(inside[0]) >= ENOUGH:
            rows, columns = inside
            break
    chosen = np.random.default_rng(0).permutation(len(rows))[:POINTS]
    pixels = np.column_stack([columns[chosen], rows[chosen]]).astype(float)
    surface, met = bind_pixels(model, camera, view, pixels)
    return BoundPoints.from_surface(model, surface), pixels[met]


def _steepness(estimator: Estimator, state: State, points: BoundPoints, pixels: Array) -> Array:
    """By how much the depth of the surface at points changes over a pixel where it does most (p,), metres.

    In the plane with the normal n of a point's triangle the depth along the ray r = ((u - cx) / fx, (v - cy) / fy, 1)
    is proportional to 1 / (n . r).
    """
    camera, distances = estimator.camera, points.in_camera(state)[:, 2]
    corners = points.corners(estimator.model).in_camera(state).reshape(-1, 3, 3)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
    towards = np.abs(np.sum(normals * camera.rays(pixels), axis=1))
    return distances * np.hypot(normals[:, 0] / camera.fx, normals[:, 1] / camera.fy) / np.maximum(towards, 1e-9)
