"""The methods that reduce solutions, the certificate of what they make, and separated solutions found a priori."""

from morph_dslam.reduction.certificate import certify, compression_percent
from morph_dslam.reduction.pgd import PgdSolution, solve_pgd
from morph_dslam.reduction.registry import reduction_method
from morph_dslam.reduction.report import report_path
from morph_dslam.reduction.report_pictures import read_reference_curve
from morph_dslam.reduction.separable_problem import SeparableProblem, collocation_axis, factorise, galerkin_axis
from morph_dslam.reduction.task import ReductionTask
from morph_dslam.reduction.tensor_formats import cp, cp_functions, khatri_rao
from morph_dslam.studies.sections import ReductionSection

__all__ = [
    "PgdSolution",
    "ReductionSection",
    "ReductionTask",
    "SeparableProblem",
    "certify",
    "collocation_axis",
    "compression_percent",
    "cp",
    "cp_functions",
    "factorise",
    "galerkin_axis",
    "khatri_rao",
    "read_reference_curve",
    "reduction_method",
    "report_path",
    "solve_pgd",
]
