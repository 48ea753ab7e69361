"""The blocks of a report page, and the lines that sum up a run and its evaluation."""

from morph_dslam.evaluation.depth import distances_to_surface
from morph_dslam.evaluation.points import load_truth
from morph_dslam.evaluation.report import KeyFigures, Link, Picture, Section, Table, Text, write_report
from morph_dslam.evaluation.run_folder import alignment_line, depth_line, remarks, result_line

__all__ = [
    "KeyFigures",
    "Link",
    "Picture",
    "Section",
    "Table",
    "Text",
    "alignment_line",
    "depth_line",
    "distances_to_surface",
    "load_truth",
    "remarks",
    "result_line",
    "write_report",
]
