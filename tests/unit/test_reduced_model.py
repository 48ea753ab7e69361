"""Separated fields and the reduced model against direct sums and closed forms."""

from math import radians

import numpy as np
import pytest

from morph_dslam.model import SurfacePoints
from tests.support.bent_sheet import LENGTH, bending_stress_terms, bent_sheet_model, deflection_terms

MU = np.array([0.03, -0.25, radians(12)])


@pytest.fixture(scope="module")
def model():
    return bent_sheet_model(15, 11)


def monomial_sum(terms, mu):
    return sum(np.prod(mu ** np.array(powers)) * values for powers, values in terms.items())


def test_positions_and_stress_are_the_sums_they_were_made_from(model):
    x, y = model.nodes[:, 0], model.nodes[:, 1]
    displacement = monomial_sum(deflection_terms(x, y), MU)
    np.testing.assert_allclose(model.positions(MU), model.nodes + displacement, atol=1e-15)
    s11, s22, s12 = monomial_sum(bending_stress_terms(x, y), MU).T
    # Von Mises' definition in three dimensions, with the stresses out of the plane zero.
    expected = np.sqrt(((s11 - s22) ** 2 + s22**2 + s11**2) / 2 + 3 * s12**2)
    np.testing.assert_allclose(model.von_mises(MU, "top"), expected, rtol=1e-10)
    np.testing.assert_allclose(model.von_mises(MU, "bottom"), expected, rtol=1e-10)


def test_sensitivities_by_central_differences(model):
    value, sensitivities = model.displacement.value_and_sensitivities(MU)
    np.testing.assert_array_equal(value, model.displacement.value(MU))
    for k in range(3):
        offset = 1e-6 * np.eye(3)[k]
        difference = (model.displacement.value(MU + offset) - model.displacement.value(MU - offset)) / 2e-6
        np.testing.assert_allclose(sensitivities[k], difference, atol=1e-8)


def test_restriction_interpolates_the_full_field(model):
    rng = np.random.default_rng(0)
    points = SurfacePoints(rng.integers(len(model.triangles), size=30), rng.dirichlet(np.ones(3), 30))
    corners = model.triangles[points.triangles]
    restricted = model.restrict(points)
    full_value, full_sensitivities = model.displacement.value_and_sensitivities(MU)
    value, sensitivities = restricted.value_and_sensitivities(MU)
    np.testing.assert_allclose(value, np.einsum("pc,pcx->px", points.weights, full_value[corners]), atol=1e-14)
    expected = np.einsum("pc,dpcx->dpx", points.weights, full_sensitivities[:, corners])
    np.testing.assert_allclose(sensitivities, expected, atol=1e-12)
    rest = model.rest_positions(points)
    assert np.abs(rest[:, 0]).max() <= LENGTH / 2
    np.testing.assert_allclose(rest, np.einsum("pc,pcx->px", points.weights, model.nodes[corners]), atol=1e-16)


def test_points_can_be_chosen_by_index_and_by_mask():
    points = SurfacePoints(np.array([5, 6, 7]), np.eye(3))
    assert len(points) == 3
    assert points.take(np.array([2, 0])).triangles.tolist() == [7, 5]
    np.testing.assert_array_equal(points.take(np.array([False, True, False])).weights, [[0, 1, 0]])


def test_parameters_are_shown_in_their_unit(model):
    assert model.parameters[2].display(model.parameters[2].upper) == pytest.approx(20.0)
    assert model.parameters[0].display(model.lower[0]) == pytest.approx(-60.0)
    np.testing.assert_array_equal(model.default, [0, 0, 0])
