"""The blocks of a report page, and the lines that sum up a run and its evaluation."""

from morph_dslam.evaluation.evaluate import evaluate_force as evaluate_force, evaluate_pixels as evaluate_pixels
from morph_dslam.evaluation.force import (
    force_line as force_line,
    force_remarks as force_remarks,
    reaction_in_direction as reaction_in_direction,
)
from morph_dslam.evaluation.force_curves import ForceCurve as ForceCurve, load_curve as load_curve
from morph_dslam.evaluation.model_summary import error_facts as error_facts, summarise_model as summarise_model
from morph_dslam.evaluation.pixels import (
    PixelError as PixelError,
    PixelTracks as PixelTracks,
    load_tracks as load_tracks,
    pixel_error as pixel_error,
    pixel_line as pixel_line,
    pixel_remarks as pixel_remarks,
)
from morph_dslam.evaluation.points import (
    PointTruth as PointTruth,
    load_truth as load_truth,
    material_error as material_error,
)
from morph_dslam.evaluation.report import (
    Block as Block,
    KeyFigures as KeyFigures,
    Link as Link,
    Picture as Picture,
    Section as Section,
    Table as Table,
    Text as Text,
    write_report as write_report,
)
from morph_dslam.evaluation.run_folder import (
    alignment_line as alignment_line,
    depth_line as depth_line,
    remarks as remarks,
    result_line as result_line,
)
from morph_dslam.evaluation.trajectory import (
    trajectory_evaluation_files as trajectory_evaluation_files,
    trajectory_line as trajectory_line,
)
from morph_dslam.surface_distances import distances_to_surface as distances_to_surface
from morph_dslam.tracking.observability import value_line as value_line
