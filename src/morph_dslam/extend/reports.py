"""The blocks of a report page, and the lines that sum up a run and its evaluation."""

from morph_dslam.evaluation.depth import distances_to_surface
from morph_dslam.evaluation.model_summary import summarise_model
from morph_dslam.evaluation.points import PointTruth, load_truth
from morph_dslam.evaluation.report import KeyFigures, Link, Picture, Section, Table, Text, write_report
from morph_dslam.evaluation.run_folder import alignment_line, depth_line, remarks, result_line
from morph_dslam.evaluation.trajectory import trajectory_line
from morph_dslam.tracking.observability import value_line

__all__ = [
    "KeyFigures",
    "Link",
    "Picture",
    "PointTruth",
    "Section",
    "Table",
    "Text",
    "alignment_line",
    "depth_line",
    "distances_to_surface",
    "load_truth",
    "remarks",
    "result_line",
    "summarise_model",
    "trajectory_line",
    "value_line",
    "write_report",
]
