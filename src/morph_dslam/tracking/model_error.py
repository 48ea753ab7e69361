"""Estimating a state with a model that is off: what it leaves is alike in neighbours, and must not bend the estimate.

A model that lacks something leaves residuals of which neighbours have most in common. Taken for noise, they are
independent, and hundreds of points make parameters follow them along directions that the images hardly tell. As a
Gaussian process over the surface, with independent noise beside it, they count for no more than they say (Kennedy and
O'Hagan, J. Royal Statistical Society B 63, 2001): the state is that of generalised least squares.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from morph_dslam.tracking.covariance import gaussian_factor
from morph_dslam.tracking.estimator import Estimate, Estimator, LinearCost, Prior, State
from morph_dslam.tracking.levenberg_marquardt import minimise
from morph_dslam.tracking.noise import Observations

Array = NDArray[np.float64]
#: The errors are alike over this share of the object's size. Chosen on rendered sheets.
ALIKE_SHARE = 0.1
#: Their standard deviation is at most this many times that of the noise.
MOST_ALIKE = 20.0


@dataclass(frozen=True)
class _Covariance:
    """Of the residuals (2 p,) of a frame, W^-1 + F F' in units of the noise's: W and F' W, and the root of 1 + F' W F.

    Its inverse is W - W F (1 + F' W F)^-1 F' W, by Woodbury's identity.
    """

    weights: Array
    loads: Array
    root: Array

    @classmethod
    def of(cls, measured: Observations, alike: float, length: float) -> _Covariance:
        """With common errors of ``alike`` times the noise, over ``length``, metres; an outline errs across itself."""
        used = measured.weights > 0.0
        found = alike * gaussian_factor(measured.points.rest[used], length)
        factor = np.zeros((len(used), 2, 2, found.shape[1]))
        factor[used, 0, 0] = factor[used, 1, 1] = found
        directed = (measured.normals != 0.0).any(axis=1)
        normals = measured.normals[directed]
        factor[directed] = np.einsum("pi,pj,pjkr->pikr", normals, normals, factor[directed])
        flat, weights = factor.reshape(2 * len(used), -1), np.repeat(np.where(used, measured.weights, 0.0), 2)
        loads = np.ascontiguousarray((weights[:, None] * flat).T)
        return cls(weights, loads, np.linalg.cholesky(np.eye(len(loads)) + loads @ flat))

    def reduced(self, rows: Array) -> Array:
        """The part of F' W rows (2 p, n) by whose squares the products with W are too large."""
        return np.asarray(np.linalg.solve(self.root, self.loads @ rows), dtype=np.float64)


def with_model_error(
    estimator: Estimator, measured: Observations, estimate: Estimate, own_px: float, prior: Prior | None = None
) -> Estimate:
    """The estimate with another state, which allows for errors that neighbours have in common.

    Its covariance stays that of the estimate which takes these errors for noise.

    Parameters
    ----------
    measured : in the frame, p points.
    estimate : from it.
    own_px : standard deviation of a pixel coordinate without what neighbours have in common.
    prior : what is known of the pose.
    """
    alike = min(float(np.sqrt(max((estimate.sigma_px / own_px) ** 2 - 1.0, 0.0))), MOST_ALIKE)
    if not alike > 0.0 or not (measured.weights > 0.0).any():
        return estimate
    size = float(np.linalg.norm(np.ptp(estimator.model.nodes, axis=0)))
    covariance = _Covariance.of(measured, alike, ALIKE_SHARE * size)
    used, directed = measured.weights > 0.0, (measured.normals != 0.0).any(axis=1)
    normals, unit = measured.normals[directed], replace(measured, weights=used.astype(np.float64), depths=None)
    no_points, unbounded = np.zeros(len(used)), np.zeros((len(used), 2))

    def evaluate(state: State) -> tuple[float, Array, Array, Array]:
        # All that is known beside the points: priors and depths.
        cost, hessian, gradient, _ = estimator.evaluate(
            measured.points, measured.pixels, no_points, state, measured.normals, prior, measured.depths
        )
        residuals = estimator.camera.project(measured.points.in_camera(state)) - measured.pixels
        residuals[directed] = np.sum(normals * residuals[directed], axis=1, keepdims=True) * normals
        linear = LinearCost.about(unit, state, unbounded, estimator.camera, np.inf, estimator.scale)
        rows = linear.weighted_jacobian.reshape(2 * len(used), -1)
        rows = np.column_stack([rows, np.where(used[:, None], residuals, 0.0).ravel()])
        taken = covariance.reduced(rows)
        products = rows.T @ (covariance.weights[:, None] * rows) - taken.T @ taken
        cost += 0.5 * float(products[-1, -1])
        return cost, hessian + products[:-1, :-1], gradient + products[:-1, -1], residuals

    options = estimator.options
    found = minimise(evaluate, estimate.state, estimator.box, options.max_iterations, options.tolerance)
    return replace(estimate, state=found.state, residuals=found.residuals)
