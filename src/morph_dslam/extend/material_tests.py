"""Laws fitted to material tests: stress against stretch of specimens of simple shape."""

from morph_dslam.material_tests.candidates import (
    CANDIDATES as CANDIDATES,
    USUAL as USUAL,
    FittedLaw as FittedLaw,
    fit_candidate as fit_candidate,
    recommended as recommended,
)
from morph_dslam.material_tests.fit import Fit as Fit, fit_law as fit_law
from morph_dslam.material_tests.nominal_stress import (
    KINDS as KINDS,
    MaterialTest as MaterialTest,
    NominalStress as NominalStress,
    relative_error as relative_error,
)
from morph_dslam.material_tests.report import (
    check_no_fit as check_no_fit,
    fit_last_line as fit_last_line,
    fit_lines as fit_lines,
    write_fit as write_fit,
)
from morph_dslam.material_tests.tables import load_test as load_test
