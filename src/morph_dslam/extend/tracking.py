"""Points bound to a model, and the estimator of parameters and pose that `morph_dslam.Tracker` is built on."""

from morph_dslam.tracking.binding import bind_pixels, draw_view, facing, view_of
from morph_dslam.tracking.depth import PointDepths
from morph_dslam.tracking.estimator import BoundPoints, Estimate, EstimationOptions, Estimator, Prior, State, moved

__all__ = [
    "BoundPoints",
    "Estimate",
    "EstimationOptions",
    "Estimator",
    "PointDepths",
    "Prior",
    "State",
    "bind_pixels",
    "draw_view",
    "facing",
    "moved",
    "view_of",
]
