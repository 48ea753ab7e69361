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


def rim(model, camera, state):
    """A flat sheet's rim as points of an outline, their places in the image, and the normals there (p, 2)."""
    half = np.abs(model.nodes[:, :2]).max(axis=0)
    on_rim = np.abs(model.nodes[:, :2]) > half - 1e-9
    nodes = np.flatnonzero(on_rim.any(axis=1))
    triangles, corners = np.array([np.argwhere(model.triangles == node)[0] for node in nodes]).T
    points = BoundPoints.from_surface(model, SurfacePoints(triangles, np.eye(3)[corners]))
    outwards = 1e-3 * np.where(on_rim[nodes], np.sign(model.nodes[nodes, :2]), 0.0)
    turned = np.column_stack([outwards, np.zeros(len(nodes))]) @ state.camera_from_object.rotation.T
    places, beside = (camera.project(points.in_camera(state) + step) for step in (0.0, turned))
    normals = (beside - places) / np.linalg.norm(beside - places, axis=1)[:, None]
    return points, places, normals
