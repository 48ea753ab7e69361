"""Fits to tension tests: known constants are found again, real rubbers to their published accuracy."""

from functools import partial

import numpy as np
import pytest

from morph_dslam.errors import StudyError
from morph_dslam.mechanics.materials.fit import TensionTest, fit_law, relative_error, relaxed_stress
from morph_dslam.mechanics.materials.isotropic import Gent, MooneyRivlin, Yeoh
from tests.support.real_data import real_data

MPA = 1e6


def test_the_constants_of_a_closed_form_are_found():
    stretch = np.linspace(0.7, 3.0, 15)
    stress = 2.0 * (1.0 - stretch**-3) * (0.21 * stretch + 0.08) * MPA
    bounds = {"c10": (1e3, 1e7), "c01": (-1e6, 1e6)}
    fit = fit_law(partial(MooneyRivlin, bulk=1e9), bounds, [TensionTest("made", stretch, stress)], starts=2)
    assert fit.constants == pytest.approx({"c10": 0.21 * MPA, "c01": 0.08 * MPA}, rel=1e-6)
    assert fit.error < 1e-7


def test_a_series_is_found_from_ramps_and_relaxation():
    # Neo-Hookean: S = mu (1 - I1/3 C^-1), axial and lateral, then the convolution of S.
    tests = []
    for peak, rise in ((1.8, 2.0), (2.5, 8.0)):
        time = np.r_[np.linspace(0.0, rise, 25), rise + np.geomspace(0.1, 60.0, 25)]
        stretch = np.minimum(1.0 + (peak - 1.0) * time / rise, peak)
        i1 = stretch**2 + 2.0 / stretch
        instant = 1e5 * np.column_stack([1.0 - i1 / 3.0 / stretch**2, 1.0 - i1 / 3.0 * stretch])
        s = relaxed_stress(instant, time, np.array([0.4, 0.3]), np.array([0.8, 15.0]))
        tests.append(TensionTest(f"to {peak}", stretch, stretch * s[:, 0] - s[:, 1] / stretch**2, time))
    fit = fit_law(
        partial(MooneyRivlin, bulk=1e9),
        {"c10": (1e3, 1e6)},
        tests,
        ([(0.0, 0.9)] * 2, [(0.1, 4.0), (4.0, 100.0)]),
        starts=2,
    )
    assert fit.constants["c10"] == pytest.approx(0.5e5, rel=1e-5)
    assert fit.material.prony.relative_moduli == pytest.approx((0.4, 0.3), rel=1e-4)
    assert fit.material.prony.times == pytest.approx((0.8, 15.0), rel=1e-4)
    assert max(fit.errors.values()) < 1e-6


def test_bounds_that_hold_no_solution_are_refused():
    test = TensionTest("made", np.array([1.0, 4.0]), np.array([0.0, 1e6]))
    with pytest.raises(StudyError, match="increasing"):
        fit_law(partial(MooneyRivlin, bulk=1e9), {"c10": (2.0, 1.0)}, [test])
    locked = {"shear": (1e5, 1e6), "limit": (0.1, 5.0)}
    with pytest.raises(StudyError, match="no constants within the bounds"):
        fit_law(partial(Gent, bulk=1e9), locked, [test], starts=1)


def test_relative_error_is_rms_over_rms():
    assert relative_error(np.array([3.0, 4.0]), np.array([3.0, 4.5])) == pytest.approx(0.1)


@pytest.fixture
def treloar():
    table = np.loadtxt(real_data("fem_reference") / "hyperelastics_jl" / "uniaxial.csv", delimiter=",", skiprows=1)
    return [TensionTest("Treloar", table[:, 0], table[:, 1] * MPA)]


def test_treloars_rubber_has_its_published_gent_constants(treloar):
    # Ogden, Saccomandi and Sgura, Comput. Mech. 34, 2004, fit J_m = 77.931 and mu = 2.4195 kgf/cm2 to it,
    # with relative weights; weights explain a few percent.
    bounds = {"shear": (1e4, 1e7), "limit": (60.0, 1000.0)}
    fit = fit_law(partial(Gent, bulk=1e9), bounds, treloar, starts=3)
    assert fit.constants["limit"] == pytest.approx(77.931, rel=0.04)
    assert fit.constants["shear"] == pytest.approx(2.4195 * 98066.5, rel=0.04)
    assert fit.error < 0.03


def test_treloars_rubber_needs_more_than_mooney_and_rivlin(treloar):
    mooney = {"c10": (1e3, 1e7), "c01": (-1e6, 1e6)}
    yeoh = {"c10": (1e3, 1e7), "c20": (-1e5, 1e5), "c30": (-1e3, 1e3)}
    assert fit_law(partial(MooneyRivlin, bulk=1e9), mooney, treloar, starts=2).error > 0.15
    assert fit_law(partial(Yeoh, bulk=1e9), yeoh, treloar, starts=2).error < 0.035
