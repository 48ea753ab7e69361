"""Registrations by points that were clicked, some of whose pixels off."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from morph_dslam.model import SurfacePoints
from morph_dslam.registration.registration import Registration
from morph_dslam.tracking.depth_registration import refine_by_depth
from morph_dslam.tracking.estimator import BoundPoints, Estimator


def clicked(model, camera, there, rng, px=1.0, count=14, depth=None):
    """The object in the state that clicks on its nodes give, with the covariance that their deviation gives it.

    Parameters
    ----------
    there : the state that it is in.
    px : deviation of a click.
    depth : (h, w) of the same picture, metres, which counts too; None for clicks alone.
    """
    chosen = rng.choice(len(model.triangles), count, replace=False)
    points = BoundPoints.from_surface(model, SurfacePoints(chosen, np.tile([1.0, 0.0, 0.0], (count, 1))))
    pixels = camera.project(points.in_camera(there)) + px * rng.standard_normal((count, 2))
    estimator, weights = Estimator(model, camera), np.ones(count)
    found = estimator.estimate(points, pixels, weights, there)
    hessian = estimator.evaluate(points, pixels, weights, found.state)[1]
    registration = Registration(model, found.state, px**2 * np.linalg.inv(hessian))
    if depth is None:
        return registration
    by_depth = refine_by_depth(estimator, points, pixels, found.state, px, depth)
    estimate = by_depth.estimate
    return replace(registration, state=estimate.state, covariance=estimate.covariance, depth_scale=by_depth.scale)
