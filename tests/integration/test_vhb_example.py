"""The example of a viscous elastomer: fits to tension tests find known constants, and the example runs."""

import importlib
import re
import subprocess
import sys
from functools import partial

import numpy as np
import pytest

from morph_dslam.errors import MorphError
from morph_dslam.mechanics.materials.isotropic import Gent, MooneyRivlin, Ogden, Yeoh
from morph_dslam.mechanics.materials.viscoelastic import Prony
from tests.support.real_data import ROOT, real_data
from tests.support.solids import PrescribedCells

EXAMPLE = ROOT / "examples" / "vhb_viscoelastic"
MPA = 1e6


@pytest.fixture
def tension_fit(monkeypatch):
    """The example's module of this name."""
    monkeypatch.syspath_prepend(str(EXAMPLE))
    monkeypatch.delitem(sys.modules, "tension_fit", raising=False)
    return importlib.import_module("tension_fit")


def test_the_recurrence_converges_to_the_convolution_at_second_order(tension_fit):
    def error(steps):
        time = np.linspace(0.0, 3.0, steps + 1)
        strain = np.column_stack([time, 2.0 * time])
        computed = tension_fit.relaxed_stress(strain, time, np.array([0.6]), np.array([0.7]))
        ramp = 0.4 * 3.0 + 0.6 * 0.7 * (1.0 - np.exp(-3.0 / 0.7))
        np.testing.assert_allclose(computed[-1, 1], 2.0 * computed[-1, 0], rtol=1e-14)
        return abs(computed[-1, 0] - ramp)

    assert error(40) < 1e-3
    assert np.log2(error(20) / error(40)) == pytest.approx(2.0, abs=0.02)


def test_a_tension_test_in_elements_and_at_a_point_agree(tension_fit):
    series = Prony((0.3, 0.2), (0.5, 4.0), (0.0, 0.0))
    law = Ogden(moduli=(0.4, 0.1), exponents=(0.8, 2.5), bulk=10.0, prony=series)
    time = np.array([0.0, 0.4, 0.9, 1.1, 2.0, 4.0])
    stretch = np.array([1.0, 1.3, 1.9, 2.5, 2.5, 1.4])
    nominal = tension_fit.TensionStress(law, stretch, time)()
    cell = PrescribedCells(law)
    for j in range(1, len(time)):
        lam = stretch[j]
        P = cell.step(np.diag([lam, lam**-0.5, lam**-0.5]), time[j] - time[j - 1])[0]
        # The pressure of the incompressible solid frees the sides.
        assert P[0, 0] - P[1, 1] * lam**-1.5 == pytest.approx(nominal[j], rel=1e-9)


def test_the_constants_of_a_closed_form_are_found(tension_fit):
    stretch = np.linspace(0.7, 3.0, 15)
    stress = 2.0 * (1.0 - stretch**-3) * (0.21 * stretch + 0.08) * MPA
    bounds = {"c10": (1e3, 1e7), "c01": (-1e6, 1e6)}
    fit = tension_fit.fit_law(
        partial(MooneyRivlin, bulk=1e9), bounds, [tension_fit.TensionTest("made", stretch, stress)], starts=2
    )
    assert fit.constants == pytest.approx({"c10": 0.21 * MPA, "c01": 0.08 * MPA}, rel=1e-6)
    assert fit.error < 1e-7


def test_a_series_is_found_from_ramps_and_relaxation(tension_fit):
    # Neo-Hookean: S = mu (1 - I1/3 C^-1), axial and lateral, then the convolution of S.
    tests = []
    for peak, rise in ((1.8, 2.0), (2.5, 8.0)):
        time = np.r_[np.linspace(0.0, rise, 25), rise + np.geomspace(0.1, 60.0, 25)]
        stretch = np.minimum(1.0 + (peak - 1.0) * time / rise, peak)
        i1 = stretch**2 + 2.0 / stretch
        instant = 1e5 * np.column_stack([1.0 - i1 / 3.0 / stretch**2, 1.0 - i1 / 3.0 * stretch])
        s = tension_fit.relaxed_stress(instant, time, np.array([0.4, 0.3]), np.array([0.8, 15.0]))
        tests.append(tension_fit.TensionTest(f"to {peak}", stretch, stretch * s[:, 0] - s[:, 1] / stretch**2, time))
    fit = tension_fit.fit_law(
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


def test_bounds_that_hold_no_solution_are_refused(tension_fit):
    test = tension_fit.TensionTest("made", np.array([1.0, 4.0]), np.array([0.0, 1e6]))
    with pytest.raises(MorphError, match="increasing"):
        tension_fit.fit_law(partial(MooneyRivlin, bulk=1e9), {"c10": (2.0, 1.0)}, [test])
    locked = {"shear": (1e5, 1e6), "limit": (0.1, 5.0)}
    with pytest.raises(MorphError, match="no constants within the bounds"):
        tension_fit.fit_law(partial(Gent, bulk=1e9), locked, [test], starts=1)


@pytest.fixture
def treloar(tension_fit):
    table = np.loadtxt(real_data("fem_reference") / "hyperelastics_jl" / "uniaxial.csv", delimiter=",", skiprows=1)
    return [tension_fit.TensionTest("Treloar", table[:, 0], table[:, 1] * MPA)]


def test_treloars_rubber_has_its_published_gent_constants(tension_fit, treloar):
    # Ogden, Saccomandi and Sgura, Comput. Mech. 34, 2004, fit J_m = 77.931 and mu = 2.4195 kgf/cm2 to it,
    # with relative weights; weights explain a few percent.
    bounds = {"shear": (1e4, 1e7), "limit": (60.0, 1000.0)}
    fit = tension_fit.fit_law(partial(Gent, bulk=1e9), bounds, treloar, starts=3)
    assert fit.constants["limit"] == pytest.approx(77.931, rel=0.04)
    assert fit.constants["shear"] == pytest.approx(2.4195 * 98066.5, rel=0.04)
    assert fit.error < 0.03


def test_treloars_rubber_needs_more_than_mooney_and_rivlin(tension_fit, treloar):
    mooney = {"c10": (1e3, 1e7), "c01": (-1e6, 1e6)}
    yeoh = {"c10": (1e3, 1e7), "c20": (-1e5, 1e5), "c30": (-1e3, 1e3)}
    assert tension_fit.fit_law(partial(MooneyRivlin, bulk=1e9), mooney, treloar, starts=2).error > 0.15
    assert tension_fit.fit_law(partial(Yeoh, bulk=1e9), yeoh, treloar, starts=2).error < 0.035


def run_example(data):
    return subprocess.run(
        [sys.executable, str(EXAMPLE / "run.py"), "--data", str(data)], capture_output=True, text=True
    )


@pytest.mark.slow
def test_half_of_the_measurements_predict_the_other_half():
    done = run_example(real_data("fem_reference") / "vhb4910")
    assert done.returncode == 0, done.stderr[-2000:]
    result = r"fit_error_percent=([\d.]+) predicted_error_percent=([\d.]+)"
    found = re.fullmatch(result, done.stdout.splitlines()[-1])
    assert found
    assert float(found[1]) <= 4.0
    assert float(found[2]) <= 5.5


def test_measurements_that_are_not_there_are_one_message(tmp_path):
    done = run_example(tmp_path / "absent")
    assert done.returncode == 2
    assert re.fullmatch(r"morph: there are no measurements in .*; --data names .*\n", done.stderr)
    assert done.stdout == ""
