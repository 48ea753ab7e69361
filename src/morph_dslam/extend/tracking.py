"""Points bound to a model, and the estimator of parameters and pose that `morph_dslam.Tracker` is built on."""

from morph_dslam.tracking.binding import bind_pixels, draw_view, facing, view_of
from morph_dslam.tracking.depth import PointDepths
from morph_dslam.tracking.drawing import DrawOptions, SectionPlane
from morph_dslam.tracking.estimator import BoundPoints, Estimate, EstimationOptions, Estimator, Prior, State, moved
from morph_dslam.tracking.run_options import ObjectOptions

__all__ = [
    "BoundPoints",
    "DrawOptions",
    "Estimate",
    "EstimationOptions",
    "Estimator",
    "ObjectOptions",
    "PointDepths",
    "Prior",
    "SectionPlane",
    "State",
    "bind_pixels",
    "draw_view",
    "facing",
    "moved",
    "view_of",
]
