"""One pose over a sequence, for a camera and a support that stand still, estimated from all frames together.

The pose places the reference view's points on the mesh and is that of every other frame too. In the reference view
any pose explains these points; in a deformed one only the right pose does. So the pose, what else is one over the
sequence and, on request, terms of the camera are found as the minimum of the landmarks' residuals and those of
keyframes, each keyframe at its own best parameters (variable projection; Golub and Pereyra 1973). Depths count in the
keyframes as they do in single frames, by the same noise model.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import OptimizeResult

from morph_dslam.camera import Camera
from morph_dslam.model import ReducedModel
from morph_dslam.tracking.binding import bind_pixels, view_of
from morph_dslam.tracking.depth import SCALE_STD
from morph_dslam.tracking.depth_scale import LARGER, SMALLER
from morph_dslam.tracking.estimator import BoundPoints, EstimationOptions, Estimator, State, moved
from morph_dslam.tracking.known_state import LandmarkTerm, StateTerm
from morph_dslam.tracking.levenberg_marquardt import bounded_step
from morph_dslam.tracking.noise import Observations
from morph_dslam.tracking.refinement import (
    DIFFERENCE,
    EFFECTIVE_POINTS,
    SHARE_OF_RANGE,
    Keyframe,
    differences,
    minimum,
    reference_scale,
)
from morph_dslam.tracking.reprojection import huber_weights
from morph_dslam.tracking.state import Prior, pose_increment

Array = NDArray[np.float64]
#: Terms of the camera that can be estimated with the pose.
CameraTerm = Literal["focal", "radial"]
#: Standard deviations of the terms before anything is measured: of the focal length's logarithm, and of the shift
#: by the radial term in the image's corner, as a share of the radius there.
TERM_STD: dict[CameraTerm, float] = {"focal": 0.3, "radial": 0.05}
#: Residuals smaller than this, pixels, say no more.
LEAST_SIGMA_PX = 0.3
#: Rounds with weights by the residuals of the round before; steps of a keyframe's own parameters.
ROUNDS, STEPS = 2, 6
#: The least information of a keyframe's own parameter that counts, as a share of that of all.
LEAST_SEEN = 1e-9
#: Unknowns closer than this, scaled, are the same minimum; twice the log-likelihood ratio that excludes another one.
SAME, EXCLUDED = 1.0, 9.0
#: How much more than by a frame's own points a pose counts that is one over the sequence.
HELD = 1e4


@dataclass(frozen=True)
class StillFit:
    """What is one over the sequence.

    Attributes
    ----------
    state : parameters in the reference frame, and the pose.
    covariance : (d + 6, d + 6) of ``state``.
    camera : with its terms as estimated.
    terms : of the camera, each value with its standard deviation: the focal length in pixels, the radial
        coefficient.
    decided : whether other starts were excluded.
    """

    state: State
    covariance: Array
    camera: Camera
    terms: dict[str, tuple[float, float]]
    decided: bool = True


def held(state: State, estimator: Estimator) -> Prior:
    """The pose of ``state`` as a term of a frame's cost by which the frame cannot move it.

    It is no measurement, and has no variance of its own: how far the pose is off counts with the reference view.
    """
    d, size = len(state.parameters), estimator.scale[-1]
    px_per_metre = estimator.camera.fx / max(float(state.camera_from_object.translation[2]), 1e-6)
    information = HELD * px_per_metre**2 * np.diag([size**2] * 3 + [1.0] * 3)
    return Prior(np.zeros(d), np.zeros((d, d)), state.camera_from_object, information, squared_px=0.0)


class StillProblem:
    """The residuals of a sequence as a function of what is one over it.

    Parameters
    ----------
    model : the object.
    camera : as given; its terms are changed.
    start : the registered state in the reference frame.
    reference_pixels : (p, 2) of the followed points in the reference view, undistorted by ``camera``.
    keyframes : where these points were seen in other frames.
    known : what the registration rests on.
    constant : indices of the parameters that are one over the sequence.
    known_at_first : indices of the parameters that are known in the reference frame, which shows the object at rest.
    terms : of the camera that are estimated.
    depth_scale_std : standard deviation of what all depths are off by together, a share.
    """

    def __init__(
        self,
        model: ReducedModel,
        camera: Camera,
        start: State,
        reference_pixels: Array,
        keyframes: Sequence[Keyframe],
        known: LandmarkTerm | StateTerm,
        constant: Sequence[int] = (),
        known_at_first: Sequence[int] = (),
        terms: Sequence[CameraTerm] = (),
        depth_scale_std: float = SCALE_STD,
    ) -> None:
        self._model, self._camera, self._start, self._known = model, camera, start, known
        self._constant, self._terms, d = list(constant), tuple(terms), len(model.parameters)
        self._depth_scale_std = depth_scale_std
        self._free = np.setdiff1d(np.arange(d), self._constant)
        self._scale = reference_scale(model)
        self._columns = np.setdiff1d(np.arange(d + 6), known_at_first)
        # As recorded, so that another lens can undistort them.
        self._reference = camera.distort_pixels(reference_pixels)
        self._recorded = [_with_pixels(frame, camera.distort_pixels) for frame in keyframes]
        self._own = [frame.state.parameters for frame in keyframes]
        # Of pixels, and of depths in pixels, by which these count against pixels.
        noise = [1.0 if frame.depths is None else np.sqrt(frame.depths.squared_px) for frame in keyframes]
        self._floors = np.column_stack([np.full(len(keyframes), LEAST_SIGMA_PX), noise])
        self._sigmas = np.column_stack([np.ones(len(keyframes)), noise])

    @property
    def size(self) -> int:
        """Number of unknowns."""
        return len(self._columns) + len(self._terms)

    def bounds(self) -> tuple[Array, Array]:
        """Of the unknowns: the parameters stay in their ranges."""
        d, model = len(self._model.parameters), self._model
        lower, upper = np.full(d + 6, -np.inf), np.full(d + 6, np.inf)
        lower[:d] = (model.lower - self._start.parameters) / self._scale[:d] - 1e-6
        upper[:d] = (model.upper - self._start.parameters) / self._scale[:d] + 1e-6
        free = np.full(len(self._terms), np.inf)
        return np.concatenate([lower[self._columns], -free]), np.concatenate([upper[self._columns], free])

    def state(self, unknowns: Array) -> State:
        """The reference state; as far away in focal lengths as without the camera's terms.

        A focal length and a distance that grow together change an image by little. With the distance in metres, steps
        along that valley would have to follow its bend.
        """
        step = np.zeros(len(self._scale))
        step[self._columns] = unknowns[: len(self._columns)]
        state = moved(self._start, step * self._scale)
        pose = state.camera_from_object
        pose = replace(pose, translation=pose.translation * np.array([1.0, 1.0, self._magnified(unknowns)]))
        return State(np.clip(state.parameters, self._model.lower, self._model.upper), pose)

    def _magnified(self, unknowns: Array) -> float:
        """The focal length in focal lengths of the camera as given."""
        if "focal" not in self._terms:
            return 1.0
        return float(np.exp(TERM_STD["focal"] * unknowns[len(self._columns) + self._terms.index("focal")]))

    def unknowns(self, state: State) -> Array:
        """Those of another reference state, with the camera as given."""
        turned = pose_increment(self._start.camera_from_object, state.camera_from_object)
        step = np.concatenate([state.parameters - self._start.parameters, turned]) / self._scale
        return np.concatenate([step[self._columns], np.zeros(len(self._terms))])

    def camera(self, unknowns: Array) -> Camera:
        """The camera with its terms, which are zero in ``unknowns`` where it is as given."""
        camera = self._camera
        by_name = dict(zip(self._terms, unknowns[len(self._columns) :], strict=True))
        factor = self._magnified(unknowns)
        camera = replace(camera, fx=factor * camera.fx, fy=factor * camera.fy)
        if "radial" in by_name:
            first, *others = camera.distortion or (0.0,) * 4
            change = float(TERM_STD["radial"] * by_name["radial"]) / corner_radius(camera) ** 2
            camera = replace(camera, distortion=(first + change, *others))
        return camera

    def residuals(self, unknowns: Array, refit: bool = True) -> Array:
        """Of landmarks, camera terms and keyframes, each in its standard deviations.

        Parameters
        ----------
        refit : whether the keyframes' own parameters follow; they are as they were otherwise.
        """
        state, camera = self.state(unknowns), self.camera(unknowns)
        estimator = Estimator(self._model, camera, EstimationOptions())
        surface, met = bind_pixels(
            self._model, camera, view_of(self._model, camera, state), camera.undistort_pixels(self._reference)
        )
        points = BoundPoints.from_surface(self._model, surface)
        parts = [self._known.residuals(camera, state), unknowns[len(self._columns) :]]
        return np.concatenate([*parts, *self._of_keyframes(estimator, points, met, state, STEPS if refit else 0)])

    def jacobian(self, unknowns: Array) -> Array:
        """Derivatives (r, n) of the residuals, as if the keyframes' own parameters had no bounds.

        One that is held at a bound cannot follow on that side: the residuals that this leaves rise at once, and would
        pass for information about the other side too. So these are derivatives at given own parameters, less what a
        change of those makes good (Kaufman 1975).
        """
        here = self.residuals(unknowns)
        found = differences(lambda at: self.residuals(at, refit=False), unknowns, self.bounds())
        kept, by_own, upper = self._own, np.empty((len(here), len(self._free))), self._model.upper
        for column, k in enumerate(self._free):
            step = DIFFERENCE * np.diag(self._scale[: len(upper)])[k]
            self._own = [own - step if own[k] + step[k] > upper[k] else own + step for own in kept]
            by_own[:, column] = self.residuals(unknowns, refit=False) - here
        self._own = kept
        for rows in self._rows(len(here)):
            made_good = np.linalg.lstsq(by_own[rows], found[rows], rcond=np.sqrt(LEAST_SEEN))[0]
            found[rows] -= by_own[rows] @ made_good
        return found

    def _scale_slopes(self, unknowns: Array) -> Array:
        """Derivatives (r,) of the residuals by all depths together, as a share of each, at given own parameters."""
        known, recorded, found = self._known, self._recorded, []
        for factor in (LARGER, SMALLER):
            self._known = known.scaled(factor)
            self._recorded = [
                frame if frame.depths is None else replace(frame, depths=frame.depths.scaled(factor))
                for frame in recorded
            ]
            found.append(self.residuals(unknowns, refit=False))
        self._known, self._recorded = known, recorded
        return np.asarray((found[0] - found[1]) / (LARGER - SMALLER))

    def _rows(self, count: int) -> list[slice]:
        """Of each keyframe's among so many residuals."""
        found: list[slice] = []
        for frame in reversed(self._recorded):
            begin = count - self._n_pixels(frame) - self._n_depths(frame)
            found.append(slice(begin, count))
            count = begin
        return found[::-1]

    @staticmethod
    def _n_pixels(frame: Keyframe) -> int:
        """How many residuals a keyframe has of pixels, the points' first."""
        return 2 * (len(frame.pixels) + (0 if frame.outline is None else len(frame.outline.pixels)))

    @staticmethod
    def _n_depths(frame: Keyframe) -> int:
        """How many it has of depths, the last ones."""
        return 0 if frame.depths is None else len(frame.pixels)

    def _of_keyframes(
        self, estimator: Estimator, points: BoundPoints, met: NDArray[np.bool_], state: State, steps: int
    ) -> Iterator[Array]:
        """The scaled residuals of each keyframe; 0 for points of the reference view that met nothing."""
        n_met = int(met.sum())
        for number, recorded in enumerate(self._recorded):
            frame = _with_pixels(recorded, estimator.camera.undistort_pixels)
            of_pixels, of_depths = self._sigmas[number]
            measured, depths = frame.measured(points, met), None
            if frame.depths is not None:
                depths = frame.depths.take(met)
                measured = replace(measured, depths=depths.padded(len(measured.points)))
            self._own[number], left, far = self._fitted(estimator, measured, state, self._own[number], steps)
            weights = measured.weights
            huber = huber_weights(np.linalg.norm(left, axis=1), estimator.options.huber_px)
            left *= np.sqrt(weights * huber * EFFECTIVE_POINTS / max(weights.sum(), 1.0))[:, None] / of_pixels
            scaled = np.zeros((len(met) + len(left) - n_met, 2))
            scaled[: len(met)][met], scaled[len(met) :] = left[:n_met], left[n_met:]
            yield scaled.ravel()
            if depths is not None:
                scaled = np.zeros(len(met))
                scaled[met] = depths.bounded(far[:n_met]) * np.sqrt(EFFECTIVE_POINTS / max(depths.count, 1)) / of_depths
                yield scaled

    def weigh(self, residuals: Array) -> None:
        """Take the keyframes' standard deviations from what ``residuals`` left of them."""
        for number, rows in enumerate(self._rows(len(residuals))):
            pixels, depths = np.split(residuals[rows], [self._n_pixels(self._recorded[number])])
            rms = np.sqrt([np.sum(pixels**2) / (2.0 * EFFECTIVE_POINTS), np.sum(depths**2) / EFFECTIVE_POINTS])
            self._sigmas[number] = np.maximum(self._sigmas[number] * rms, self._floors[number])

    def _fitted(
        self, estimator: Estimator, measured: Observations, state: State, own: Array, steps: int
    ) -> tuple[Array, Array, Array]:
        """A keyframe at its best in the pose of ``state``, by so many steps at most.

        Returns
        -------
        Its parameters (d,), and what they leave (p, 2) and of depths (p,), in pixels.
        """
        points, pixels, weights = measured.points, measured.pixels, measured.weights
        normals, depths = measured.normals, measured.depths
        own = own.copy()
        own[self._constant] = state.parameters[self._constant]
        model, free, left = self._model, self._free, np.zeros_like(pixels)
        ranges = (model.upper - model.lower)[free]
        for step in range(steps + 1):
            at = replace(state, parameters=own)
            _, hessian, gradient, left = estimator.evaluate(points, pixels, weights, at, normals, depths=depths)
            if step == steps or not len(free):
                break
            # In shares of the ranges: in pascals and metres, what is added would hold the pascals.
            block = hessian[np.ix_(free, free)] * np.outer(ranges, ranges)
            block = block + LEAST_SEEN * max(float(np.trace(block)), 1e-30) * np.eye(len(free))
            lower, upper = (model.lower - own)[free] / ranges, (model.upper - own)[free] / ranges
            change = bounded_step(block, gradient[free] * ranges, lower, upper)
            own[free] += change * ranges
            if np.abs(change).max() < 1e-6:
                break
        far = np.zeros(len(points)) if depths is None else depths.terms(points, replace(state, parameters=own))[3]
        return own, np.nan_to_num(left), far

    def fitted(self, unknowns: Array) -> StillFit:
        """The result at the minimum."""
        n, state, camera = len(self._columns), self.state(unknowns), self.camera(unknowns)
        jacobian = self.jacobian(unknowns)
        # Before anything is measured, a parameter is known to half its range.
        is_parameter = np.append(self._columns < len(self._model.parameters), np.zeros(len(self._terms)))
        values, vectors = np.linalg.eigh(jacobian.T @ jacobian + np.diag(SHARE_OF_RANGE**2 * is_parameter))
        inverse = (vectors / np.maximum(values, 1e-9 * max(values[-1], 1e-30))) @ vectors.T
        to_state = np.zeros((len(self._scale), self.size))
        to_state[self._columns, np.arange(n)] = self._scale[self._columns]
        if "focal" in self._terms:
            to_state[-1, n - 1] *= self._magnified(unknowns)
            by_focal = TERM_STD["focal"] * state.camera_from_object.translation[2]
            to_state[-1, n + self._terms.index("focal")] = by_focal
        # All depths may be off by one factor, in the reference frame and in the keyframes alike.
        by_scale = self._depth_scale_std * (inverse @ (jacobian.T @ self._scale_slopes(unknowns)))
        inverse = inverse + np.outer(by_scale, by_scale)
        covariance = to_state @ inverse @ to_state.T
        by_unknown = np.sqrt(np.diag(inverse)[n:])
        terms: dict[str, tuple[float, float]] = {}
        for term, std in zip(self._terms, by_unknown, strict=True):
            if term == "focal":
                terms[term] = (camera.fx, camera.fx * TERM_STD[term] * float(std))
            else:
                terms[term] = (camera.distortion[0], TERM_STD[term] * float(std) / corner_radius(camera) ** 2)
        return StillFit(state, covariance, camera, terms)


def _with_pixels(frame: Keyframe, change: Callable[[Array], Array]) -> Keyframe:
    """A keyframe with all its pixels changed."""
    outline = None if frame.outline is None else replace(frame.outline, pixels=change(frame.outline.pixels))
    return replace(frame, pixels=change(frame.pixels), outline=outline)


def corner_radius(camera: Camera) -> float:
    """Radius of the image's farthest corner from the principal point, at unit focal length."""
    x = max(camera.cx, camera.width - camera.cx) / camera.fx
    y = max(camera.cy, camera.height - camera.cy) / camera.fy
    return float(np.hypot(x, y))


def fit_still(problem: StillProblem, alternatives: Sequence[State] = ()) -> StillFit:
    """What is one over the sequence, as landmarks and keyframes have it together.

    Parameters
    ----------
    alternatives : reference states to start from too, such as a plane tilted the other way.
    """
    found = _minimum(problem, np.zeros(problem.size))
    for _ in range(ROUNDS):
        problem.weigh(problem.residuals(found.x))
        found = _minimum(problem, found.x)
    minima = [found, *(_minimum(problem, problem.unknowns(state)) for state in alternatives)]
    best = min(minima, key=lambda one: one.cost)
    if best is not found:  # its own residuals say what they weigh
        problem.weigh(problem.residuals(best.x))
        minima = [_minimum(problem, one.x) for one in minima]
        best = min(minima, key=lambda one: one.cost)
    apart = [one for one in minima if np.abs(one.x - best.x).max() > SAME]
    decided = all(2.0 * (one.cost - best.cost) > EXCLUDED for one in apart)
    return replace(problem.fitted(best.x), decided=decided)


def _minimum(problem: StillProblem, start: Array) -> OptimizeResult:
    return minimum(problem.residuals, start, problem.bounds(), 12)
