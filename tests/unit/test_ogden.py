"""Ogden's law where principal stretches are equal or nearly so: energy, stress and tangent."""

import numpy as np
import pytest

from morph_dslam.mechanics.materials.isotropic import Ogden
from tests.support.closed_form_stress import from_invariants, volumetric
from tests.support.material_laws import energy, rotation, stress, tangent

#: Equal and nearly equal eigenvalues, on both sides of every switch between the formulas, and ordinary ones.
EIGENVALUES = [
    (1.0, 1.0, 1.0), (1.0, 1.0, 1.0 + 1e-9), (1.0, 1.001, 1.0011), (1.0, 1.0, 1.04), (1.0, 1.0, 1.05),
    (1.0, 1.05, 1.05), (1.0, 1.0, 1.2), (1.0, 1.07, 1.14), (9.0, 1 / 3, 1 / 3), (9.0, 1 / 3, 0.4),
    (9.0, 9.0, 1 / 81), (9.0, 9.0 + 1e-7, 1 / 81), (4.0, 1.0, 1.06), (4.0, 1.0, 1.07), (1.0, 2.0, 3.0),
    (100.0, 0.1, 0.1),
]  # fmt: skip
TURNED = rotation(0.5, 1.2, -0.4)


@pytest.mark.parametrize("eigenvalues", EIGENVALUES)
@pytest.mark.parametrize("exponent", [1.3, 5.0, -2.0, 7.4])
def test_the_energy_is_a_sum_of_powers_of_the_stretches(eigenvalues, exponent):
    stretches = np.sqrt(eigenvalues)
    J = np.prod(stretches)
    F = rotation(0.1, 0.2, 0.3) @ np.diag(stretches) @ TURNED
    sum_of_powers = np.sum((stretches * J ** (-1 / 3)) ** exponent)
    expected = 2.0 / exponent**2 * (sum_of_powers - 3.0) + 5.0 * (J - 1.0) ** 2
    size = 2.0 / exponent**2 * sum_of_powers
    assert energy(Ogden(moduli=(1.0,), exponents=(exponent,), bulk=10.0), F) == pytest.approx(
        expected, abs=1e-11 * size
    )


def polynomial_stress(F):
    """An Ogden solid of exponents 2, 4 and -2 in invariants: tr C, tr C^2 and tr C^-1 need no eigenvalues."""
    i1 = np.trace(F.T @ F) * np.linalg.det(F) ** (-2 / 3)
    # tr C^2 = I1^2 - 2 I2, tr C^-1 = I2 / I3.
    return from_invariants(F, 0.5 + 2 / 16 * 2 * i1, -2 / 16 * 2 + 0.5) + volumetric(F, 10.0)


@pytest.mark.parametrize("eigenvalues", EIGENVALUES)
def test_stress_and_tangent_are_exact_where_stretches_meet(eigenvalues):
    law = Ogden(moduli=(1.0, 1.0, 1.0), exponents=(2.0, 4.0, -2.0), bulk=10.0)
    F, h = rotation(0.1, 0.2, 0.3) @ np.diag(np.sqrt(eigenvalues)) @ TURNED, 1e-5
    differences = np.zeros((3, 3, 3, 3))
    for i, j in np.ndindex(3, 3):
        d = np.zeros((3, 3))
        d[i, j] = h
        differences[:, :, i, j] = (polynomial_stress(F + d) - polynomial_stress(F - d)) / (2.0 * h)
    size = abs(differences).max()
    np.testing.assert_allclose(stress(law, F), polynomial_stress(F), rtol=0, atol=1e-12 * size)
    np.testing.assert_allclose(tangent(law, F), differences, rtol=0, atol=1e-6 * size)
