"""The catalogue's materials pull as hard as the tests that they were fitted to."""

import numpy as np
import pytest

from morph_dslam import make_study
from morph_dslam.extend.mechanics import material_catalogue
from tests.support.documents import PAGES

#: Nominal stress, kPa, of the published tests at these nominal strains.
STRAINS = np.array([0.5, 1.0, 1.5, 2.0])
TESTS = {
    "ecoflex_00_30": [16.89, 29.72, 40.08, 52.39],
    "ecoflex_00_50": [22.775, 40.95, 59.51, 79.005],
    "dragon_skin_10": [52.997, 112.963, 190.583, 272.79],
    "mold_star_16": [94.69, 185.5, 299.51, 433.0],
}
ENTRIES = {entry.name: entry for entry in material_catalogue()}


def number(text):
    value, unit = text.split()
    return float(value) * {"kPa": 1e3, "MPa": 1e6, "GPa": 1e9}[unit]


@pytest.mark.parametrize("name", TESTS)
def test_silicones_pull_as_they_were_measured(name):
    """Yeoh, incompressible, in tension: P = 2 (l - l^-2) (c10 + 2 c20 (I1 - 3)), I1 = l^2 + 2 / l."""
    section = ENTRIES[name].section
    stretch = 1 + STRAINS
    excess = stretch**2 + 2 / stretch - 3
    stress = 2 * (stretch - stretch**-2) * (number(section["c10"]) + 2 * number(section["c20"]) * excess)
    np.testing.assert_allclose(1e-3 * stress, TESTS[name], rtol=0.08)


def test_natural_rubber_has_the_shear_modulus_of_treloar_s():
    """Ogden's constants 0.63, 0.0012, -0.01 MPa and 1.3, 5, -2: half the sum of their products is 0.4225 MPa."""
    section = ENTRIES["natural_rubber"].section
    ogden = [0.63e6, 0.0012e6, -0.01e6]
    assert [number(m) for m in section["moduli"]] == pytest.approx(
        [0.5 * mu * alpha for mu, alpha in zip(ogden, section["exponents"], strict=True)]
    )
    assert sum(number(m) for m in section["moduli"]) == pytest.approx(0.4225e6)


def test_sylgard_has_its_young_s_modulus():
    assert 6 * number(ENTRIES["sylgard_184"].section["c10"]) == pytest.approx(1.32e6)


def test_tango_plus_has_its_author_s_shear_modulus():
    """About 0.2 MPa by the author of the recordings; of a Mooney-Rivlin rubber it is 2 (c10 + c01)."""
    section = ENTRIES["tango_plus"].section
    assert 2 * (number(section["c10"]) + number(section["c01"])) == pytest.approx(0.2e6, rel=0.15)


def test_the_mold_stars_of_shore_15_and_16_are_about_as_stiff():
    """Two data sets, two laws, two makes of nearly one hardness: initial shear moduli 2 c10 within a fifth."""
    fifteen, sixteen = (number(ENTRIES[f"mold_star_{shore}"].section["c10"]) for shore in (15, 16))
    assert fifteen == pytest.approx(sixteen, rel=0.2)


def test_paper_has_the_young_s_modulus_of_its_tensile_tests():
    assert number(ENTRIES["paper"].section["young"]) == pytest.approx(5.32e9)


def test_foam_is_within_the_range_of_its_density():
    """Gibson and Ashby, Cellular Solids: E / Es = (rho / rhos)^2; polyurethane has 1200 kg/m3, 45 to 1600 MPa."""
    section = ENTRIES["soft_foam"].section
    relative = float(section["density"].split()[0]) / 1200
    assert 45e6 * relative**2 < number(section["young"]) < 1600e6 * relative**2


def test_liver_has_its_shear_modulus():
    assert 2 * number(ENTRIES["liver"].section["c10"]) == pytest.approx(1.8e3)


@pytest.mark.parametrize("name", ENTRIES)
def test_every_entry_makes_a_study_and_is_documented(name):
    entry = ENTRIES[name]
    mesh = {"generator": "block", "size": ["1 cm"] * 3, "divisions": [1, 1, 1], "cells": "hex8"}
    move = {"kind": "displacement", "on": "z_max", "z": "pull"}
    content = {"name": "block", "mesh": mesh, "materials": {entry.name: dict(entry.section)}}
    content["supports"] = [{"kind": "fixed", "on": "z_min"}, move]
    content["parameters"] = {"pull": {"range": ["0 mm", "1 mm"]}}
    material = make_study(content).materials[entry.name]
    assert material.law == entry.section["law"]
    assert entry.source
    assert entry.note
    assert entry.title in PAGES["materials"]
