"""Thin sheets and shells as Koiter shells, and equilibrium paths by arc length past buckling."""

from morph_dslam.mechanics.sheet_equations import SheetEquations as SheetEquations
from morph_dslam.mechanics.shell import (
    KoiterSheet as KoiterSheet,
    OrthotropicSheet as OrthotropicSheet,
    rectangle_mesh as rectangle_mesh,
)
from morph_dslam.mechanics.shell_material import ShellMaterial as ShellMaterial
from morph_dslam.mechanics.shell_problem import ShellOptions as ShellOptions, ShellProblem as ShellProblem
from morph_dslam.mechanics.shell_supports import Clamp as Clamp, SymmetryPlane as SymmetryPlane, clamped as clamped
from morph_dslam.mechanics.solvers.arc_length import (
    ArcLength as ArcLength,
    ArcOptions as ArcOptions,
    PathPoint as PathPoint,
    missed_bifurcations as missed_bifurcations,
)
from morph_dslam.mechanics.solvers.buckling import buckling_modes as buckling_modes
from morph_dslam.meshing.surface_generators import (
    annulus as annulus,
    cylinder as cylinder,
    plate as plate,
    sphere as sphere,
)
from morph_dslam.studies.sheet_study import output_points as output_points
