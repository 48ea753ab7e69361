"""Thin sheets as Koiter shells, and equilibrium paths by arc length past buckling."""

from morph_dslam.mechanics.sheet_equations import SheetEquations
from morph_dslam.mechanics.shell import KoiterSheet, OrthotropicSheet, rectangle_mesh
from morph_dslam.mechanics.solvers.arc_length import ArcLength, ArcOptions, PathPoint, missed_bifurcations
from morph_dslam.mechanics.solvers.buckling import buckling_modes
from morph_dslam.studies.sheet_study import output_points

__all__ = [
    "ArcLength",
    "ArcOptions",
    "KoiterSheet",
    "OrthotropicSheet",
    "PathPoint",
    "SheetEquations",
    "buckling_modes",
    "missed_bifurcations",
    "output_points",
    "rectangle_mesh",
]
