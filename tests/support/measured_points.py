"""Points of a model's surface at random, and measurements of them."""

import numpy as np

from morph_dslam.model import SurfacePoints
from morph_dslam.tracking.estimator import BoundPoints
from morph_dslam.tracking.noise import Observations


def bound_points(model, count, seed=0):
    """So many points at random places; ``seed`` may be a generator."""
    rng = np.random.default_rng(seed)
    surface = SurfacePoints(rng.integers(0, len(model.triangles), count), rng.dirichlet(np.ones(3), count))
    return BoundPoints.from_surface(model, surface)


def measured(points, pixels, weights=None, correlation=None, depths=None):
    """Pixels (p, 2) of points that count alike and err independently, unless told otherwise."""
    count = len(points)
    weights = np.ones(count) if weights is None else weights
    correlation = np.eye(count) if correlation is None else correlation
    return Observations(points, pixels, weights, np.zeros((count, 2)), correlation, depths)
