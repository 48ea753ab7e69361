"""Points bound to a model, and the estimator of parameters and pose that `morph_dslam.Tracker` is built on."""

from morph_dslam.tracking.binding import (
    View as View,
    bind_pixels as bind_pixels,
    draw_view as draw_view,
    facing as facing,
    view_of as view_of,
)
from morph_dslam.tracking.depth import PointDepths as PointDepths
from morph_dslam.tracking.drawing import DrawOptions as DrawOptions, SectionPlane as SectionPlane
from morph_dslam.tracking.estimator import (
    BoundPoints as BoundPoints,
    Estimate as Estimate,
    EstimationOptions as EstimationOptions,
    Estimator as Estimator,
    Prior as Prior,
    State as State,
    moved as moved,
)
from morph_dslam.tracking.found_inputs import FoundInputs as FoundInputs, find_inputs as find_inputs
from morph_dslam.tracking.load_prior import LoadOptions as LoadOptions
from morph_dslam.tracking.multi_camera import RigTracker as RigTracker
from morph_dslam.tracking.reactions import (
    Reaction as Reaction,
    Reactions as Reactions,
    VectorEstimate as VectorEstimate,
)
from morph_dslam.tracking.run_options import ObjectOptions as ObjectOptions
