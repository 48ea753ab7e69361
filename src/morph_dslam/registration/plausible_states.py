"""How well one image tells parameters where its cost is no parabola about the minimum.

A sheet's shape and the pose of a free camera may make good each other's changes over a wide part of a range: the cost
has a flat valley, or two minima close together, and its curvature at the lowest point says nothing of how wide that is.
So each parameter is led through its range while all else follows (the profile likelihood: Pawitan, In All Likelihood,
2001, ch. 3.4), and states count by their likelihood.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from morph_dslam.registration.messages import ShapeAgainstPose
from morph_dslam.tracking.estimator import BoundPoints, Estimator, State
from morph_dslam.tracking.state import pose_increment

Array = NDArray[np.float64]
#: Values of a parameter: spread evenly over its range, and around its estimate, in standard deviations.
OVER_RANGE, AROUND = 24, (0.3, 0.6, 0.9, 1.2, 1.6, 2.0, 2.4, 2.8, 3.3, 3.8, 4.4)
#: Rise of twice the cost, in variances of a coordinate, that ends the plausible states on a side: a minimum beyond is
#: another one, of which `Ambiguous` tells.
RIDGE = 16.0
#: By so much a variance must grow to be believed: values are too few for less.
CLEARLY_WIDER = 1.2
#: A standard deviation that grows so many times, to this share of the range, is said.
SAID_WIDER, SAID_SHARE = 2.0, 0.05


@dataclass(frozen=True)
class MeasuredPoints:
    """What one image says of a state.

    Attributes
    ----------
    estimator : with the box of parameters; those of no range are known.
    points : p of them, bound to the model.
    pixels : (p, 2), undistorted.
    weights : (p,), and ``normals`` : (p, 2), as of `Estimator.estimate`.
    variance : of an image coordinate of weight one, squared pixels; NaN where it is not known.
    """

    estimator: Estimator
    points: BoundPoints
    pixels: Array
    weights: Array
    normals: Array
    variance: float

    def at(self, state: State) -> tuple[BoundPoints, Array, Array, State, Array]:
        """What `Estimator.estimate`, `minimum` and `evaluate` take, beside a state."""
        return self.points, self.pixels, self.weights, state, self.normals

    def spread_of_plausible(self, best: State, covariance: Array) -> Array:
        """The covariance of an estimate, wider where plausible states are spread wider than its linear theory says.

        Parameters
        ----------
        best : the estimate.
        covariance : (d + 6, d + 6) by the linear theory.

        Returns
        -------
        (d + 6, d + 6), about ``best``.
        """
        box = self.estimator.box
        if not (np.isfinite(self.variance) and np.isfinite(covariance).all()):
            return covariance
        for k in np.flatnonzero((box.upper > box.lower) & (np.diag(covariance)[: len(box.lower)] > 0.0)):
            moments = self._moments_along(best, int(k), float(np.sqrt(covariance[k, k])))
            if moments[k, k] > CLEARLY_WIDER * covariance[k, k]:
                # All else is spread along the path, and about it as where this parameter is known.
                known = covariance - np.outer(covariance[:, k], covariance[k]) / covariance[k, k]
                covariance = moments + known
        return covariance

    def _moments_along(self, best: State, k: int, deviation: float) -> Array:
        """Second moments (d + 6, d + 6) about the estimate of the likeliest states with each value of parameter k."""
        box, value = self.estimator.box, best.parameters[k]
        around = value + deviation * np.array([*(-step for step in AROUND), 0.0, *AROUND])
        values = np.concatenate([np.linspace(box.lower[k], box.upper[k], OVER_RANGE + 1), around])
        values = np.unique(values[(values >= box.lower[k]) & (values <= box.upper[k])])
        here = int(np.searchsorted(values, value))
        steps, costs = np.zeros((len(values), len(box.scale))), np.full(len(values), np.inf)
        for side in (range(here, len(values)), range(here, -1, -1)):
            for i, (step, cost) in zip(side, self._followed(best, values[list(side)], k), strict=True):
                steps[i], costs[i] = step, cost
                if 2.0 * (cost - costs.min()) > RIDGE * self.variance:
                    break
        widths = np.diff(values, prepend=values[:1]) + np.diff(values, append=values[-1:])
        weights = widths * np.exp((costs.min() - costs) / self.variance)
        return np.asarray((steps.T * (weights / weights.sum())) @ steps)

    def _followed(self, best: State, values: Array, k: int) -> Iterator[tuple[Array, float]]:
        """Steps (d + 6,) from the estimate to the likeliest state with each value of parameter k, and their costs."""
        box, state = self.estimator.box, best
        for value in values:
            lower, upper = box.lower.copy(), box.upper.copy()
            lower[k] = upper[k] = value
            found = self.estimator.within(replace(box, lower=lower, upper=upper)).minimum(*self.at(state))
            state = found.state
            increment = pose_increment(best.camera_from_object, state.camera_from_object)
            yield np.concatenate([state.parameters - best.parameters, increment]), found.cost

    def notes(self, best: State, linear: Array, covariance: Array, aids: str) -> tuple[ShapeAgainstPose, ...]:
        """What a reader must know where `spread_of_plausible` has made the ``linear`` covariance much wider.

        ``aids`` are those that were not used.
        """
        box, names = self.estimator.box, []
        for k, parameter in enumerate(self.estimator.model.study_parameters):
            deviation = float(np.sqrt(covariance[k, k]))
            wider = deviation > SAID_WIDER * float(np.sqrt(linear[k, k]))
            if wider and deviation > SAID_SHARE * float(box.upper[k] - box.lower[k]):
                value, stated = parameter.display(best.parameters[k]), parameter.display(deviation)
                names.append(f"{parameter.name} = {value:.3g} ± {stated:.2g} {parameter.unit}".removesuffix(" 1"))
        return (ShapeAgainstPose(", ".join(names), aids),) if names else ()
