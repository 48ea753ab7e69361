"""Identification of constant parameters from measured points and forces."""

from morph_dslam.identification.found import Estimate as Estimate, Identification as Identification, Misfit as Misfit
from morph_dslam.identification.identify import identify as identify
from morph_dslam.identification.measured_forces import FEWEST_FORCES as FEWEST_FORCES, MeasuredForces as MeasuredForces
from morph_dslam.identification.measured_points import MeasuredPoints as MeasuredPoints, load_points as load_points
from morph_dslam.identification.measurements import Measurement as Measurement
from morph_dslam.identification.prior import KnownValues as KnownValues
from morph_dslam.identification.report import (
    check_no_identification as check_no_identification,
    identification_lines as identification_lines,
    last_line as last_line,
    write_identification as write_identification,
)
from morph_dslam.identification.run_values import values_of_run as values_of_run
