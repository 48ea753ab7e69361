"""The methods that reduce solutions, the certificate of what they make, and separated solutions found a priori."""

from morph_dslam.reduction.certificate import certify as certify, compression_percent as compression_percent
from morph_dslam.reduction.pgd import PgdSolution as PgdSolution, solve_pgd as solve_pgd
from morph_dslam.reduction.registry import reduction_method as reduction_method
from morph_dslam.reduction.report import report_path as report_path
from morph_dslam.reduction.report_pictures import read_reference_curve as read_reference_curve
from morph_dslam.reduction.self_penetration import (
    obstacle_report as obstacle_report,
    penetration_report as penetration_report,
)
from morph_dslam.reduction.separable_problem import (
    SeparableProblem as SeparableProblem,
    collocation_axis as collocation_axis,
    factorise as factorise,
    galerkin_axis as galerkin_axis,
)
from morph_dslam.reduction.task import ReductionTask as ReductionTask
from morph_dslam.reduction.tensor_formats import cp as cp, cp_functions as cp_functions, khatri_rao as khatri_rao
from morph_dslam.studies.sections import ReductionSection as ReductionSection
