"""The certificate against errors that are known by hand, and its confidence against the binomial law."""

import json

import numpy as np
import pytest
from scipy.stats import binom

from morph_dslam.model import Parameter, ReducedModel, SeparatedField
from morph_dslam.model.functions import ParameterFunctions
from morph_dslam.reduction.certificate import (
    certify,
    compression_percent,
    confidence_statement,
    covered_share,
    errors_by_modes,
    typical_sizes,
)
from morph_dslam.studies.problem import Snapshot

PULL = Parameter("pull", "length", "mm", -0.01, 0.01, 0.0)


def field_of(*modes, lower=-0.01, upper=0.01):
    """Modes times 1, xi, 2 xi^2 - 1 ... of the single parameter, xi in [-1, 1]."""
    indices = np.arange(len(modes))[:, None]
    functions = ParameterFunctions(np.array([lower]), np.array([upper]), indices, np.eye(len(modes)))
    return SeparatedField(np.array(modes, dtype=float), functions)


def two_node_model(**fields):
    """u = ((1, 0, 0) + xi (0, 1, 0)) mm at the first node, twice that at the second."""
    constant, slope = np.zeros((2, 2, 3))
    constant[:, 0], slope[:, 1] = [1e-3, 2e-3], [1e-3, 2e-3]
    return ReducedModel(
        name="two nodes",
        nodes=np.eye(3)[:2],
        triangles=np.array([[0, 1, 0]]),
        parameters=(PULL,),
        displacement=field_of(constant, slope),
        **fields,
    )


def displaced(model, mu, offsets, **others):
    """A solve whose displacement differs from the model's by ``offsets`` (n, 3)."""
    truth = model.displacement.value(np.array([mu])) + offsets
    return Snapshot(np.array([mu]), {"displacement": truth.astype(np.float32)} | others)


def test_displacement_errors_are_distances():
    """Distances 5 and 0 micrometres at the first solve, 10 and 3 at the second."""
    model = two_node_model()
    held_out = [
        displaced(model, 0.0, np.array([[3e-6, 4e-6, 0], [0, 0, 0]])),
        displaced(model, 0.01, np.array([[0, 0, -10e-6], [0, 3e-6, 0]])),
    ]
    certificate = certify(model, held_out)
    errors = certificate["displacement"]
    assert errors["mean_mm"] == pytest.approx((5 + 0 + 10 + 3) / 4 * 1e-3, rel=1e-4)
    assert errors["max_mm"] == pytest.approx(10e-3, rel=1e-4)
    assert errors["worst_sample_mean_mm"] == pytest.approx(6.5e-3, rel=1e-4)
    assert errors["worst_sample"] == [0.01]
    # The second node of the second solve moves by 2 mm along x and 2.003 mm along y.
    assert errors["largest_mm"] == pytest.approx(np.hypot(2.0, 2.003), rel=1e-6)
    assert errors["mean_relative_to_largest"] == pytest.approx(4.5e-3 / np.hypot(2.0, 2.003), rel=1e-4)
    norm = 1.003**2 + 0.004**2 + 4.0 + 1.0 + 1.0 + 0.01**2 + 4.0 + 2.003**2
    assert errors["relative_l2"] == pytest.approx(np.sqrt(134e-6 / norm), rel=1e-4)
    assert certificate["held_out"]["coordinates"] == [[0.0], [0.01]]
    assert certificate["held_out"]["mean_mm"] == pytest.approx([2.5e-3, 6.5e-3], rel=1e-4)
    assert certificate["held_out"]["max_mm"] == pytest.approx([5e-3, 10e-3], rel=1e-4)
    assert "sensitivity" not in certificate
    json.dumps(certificate)


def test_fewer_modes_leave_out_what_they_stood_for():
    """Without its second mode the model misses xi (1, 2) mm: at xi = 1 and -0.5, 0.75 times 1.5 mm."""
    model = two_node_model()
    held_out = [displaced(model, mu, np.zeros((2, 3))) for mu in (0.01, -0.005)]
    errors = errors_by_modes(model.displacement, "displacement", held_out)
    assert errors == pytest.approx([0.75 * 1.5e-3, 0.0], abs=1e-9)
    assert certify(model, held_out)["displacement"]["mean_mm_by_modes"] == pytest.approx(1e3 * errors)


def test_stress_errors_count_shears_twice_and_von_mises_by_itself():
    """Truth: s_xx = 2 MPa; predicted: 2 MPa and a shear of 0.3 MPa. |ds|^2 = 2 0.3^2, vM^2 = 4.27."""
    predicted = np.zeros((2, 6))
    predicted[0] = [2e6, 0, 0, 0, 0, 0.3e6]
    model = two_node_model(stresses={"solid": field_of(predicted)})
    truth = np.zeros((2, 6))
    truth[0, 0] = 2e6
    errors = certify(model, [displaced(model, 0.0, np.zeros((2, 3)), stress_solid=truth)])["stress_solid"]
    assert errors["max_MPa"] == pytest.approx(np.sqrt(2) * 0.3)
    assert errors["mean_MPa"] == pytest.approx(np.sqrt(2) * 0.15)
    assert errors["largest_MPa"] == pytest.approx(2.0)
    assert errors["relative_l2"] == pytest.approx(np.sqrt(2) * 0.15)
    missed = np.sqrt(4.27) - 2.0
    assert errors["von_mises"]["max_MPa"] == pytest.approx(missed)
    assert errors["von_mises"]["relative_l2"] == pytest.approx(missed / 2.0)


def test_errors_of_plane_stress_and_of_strain():
    """Plane shear 0.1 MPa off, von Mises exact where it was zero before: sqrt(3) 0.1. Strain has no unit."""
    face, strain = np.zeros((2, 3)), np.zeros((2, 6))
    face[:, 2], strain[:, 5] = 0.1e6, 0.01
    model = two_node_model(stresses={"top": field_of(face)}, strain=field_of(strain))
    zeros = {"stress_top": np.zeros((2, 3)), "strain": 2.0 * strain}
    certificate = certify(model, [displaced(model, 0.0, np.zeros((2, 3)), **zeros)])
    assert certificate["stress_top"]["mean_MPa"] == pytest.approx(np.sqrt(2) * 0.1)
    assert certificate["stress_top"]["von_mises"]["mean_MPa"] == pytest.approx(np.sqrt(3) * 0.1)
    assert certificate["stress_top"]["relative_l2"] is None, "the true stress is zero"
    assert certificate["strain"]["mean"] == pytest.approx(np.sqrt(2) * 0.01)
    assert certificate["strain"]["relative_l2"] == pytest.approx(0.5)


@pytest.mark.parametrize(("size", "stated"), [(1e-6, False), (1e-3, True)])
def test_errors_relative_to_rounding_are_not_stated(size, stated):
    """Stress of 2 MPa times xi: in the held-out solution, near xi = 0, it is a millionth, or a thousandth, of it."""
    stress = np.zeros((2, 6))
    stress[:, 0] = 2e6
    model = two_node_model(stresses={"solid": field_of(0.0 * stress, stress)})
    sizes = typical_sizes(model, [np.array([mu]) for mu in (-0.005, 0.01, 0.0)])
    assert sizes["stress_solid"] == pytest.approx(2e6)
    # At xi = 1 both nodes have (1, 1, 0) and (2, 2, 0) mm.
    assert sizes["displacement"] == pytest.approx(1e-3 * np.sqrt((2.0 + 8.0) / 2.0))
    held_out = [displaced(model, 0.01 * size, np.full((2, 3), 1e-5), stress_solid=2.0 * size * stress)]
    errors = certify(model, held_out, sizes=sizes)
    assert errors["stress_solid"]["max_MPa"] == pytest.approx(2.0 * size)
    found = errors["stress_solid"]["relative_l2"], errors["stress_solid"]["von_mises"]["mean_relative_to_largest"]
    assert found == (pytest.approx((0.5, 0.5)) if stated else (None, None))
    assert errors["displacement"]["relative_l2"] is not None


def test_both_measures_of_sensitivity_errors():
    """d u / d pull = (0, 0.1, 0) and (0, 0.2, 0); the true ones are off by 0.01 and by 0.02 along x."""
    model = two_node_model()
    truth = np.array([[[0.01, 0.1, 0.0], [0.02, 0.2, 0.0]]], dtype=np.float32)
    solve = displaced(model, 0.003, np.zeros((2, 3)))
    held_out = [Snapshot(solve.coordinates, solve.fields, {"displacement": truth})]
    errors = certify(model, held_out)["sensitivity"]
    assert set(errors) == {"pull"}
    assert errors["pull"]["relative_l2"] == pytest.approx(0.1 / np.sqrt(1.01), rel=1e-6)
    assert errors["pull"]["mean_relative_to_largest"] == pytest.approx(0.015 / (0.2 * np.sqrt(1.01)))


@pytest.mark.parametrize(("count", "share"), [(59, 0.95), (299, 0.99)])
def test_fifty_nine_solves_bound_95_percent_and_299_bound_99(count, share):
    """The chance that no error of ``count`` lies among the largest (1 - share) is at most 5 %, just."""
    assert binom.pmf(0, count, 1.0 - share) <= 0.05 < binom.pmf(0, count - 1, 1.0 - share)
    assert covered_share(count) >= share > covered_share(count - 1)


@pytest.mark.parametrize("count", [4, 8, 20, 59, 128, 299])
def test_the_share_that_is_stated_holds_with_95_percent_confidence(count):
    statement = confidence_statement(count)
    share = float(statement.split("at least ")[1].split(" %")[0]) / 100.0
    assert binom.pmf(0, count, 1.0 - share) <= 0.05, "rounded down, never up"
    assert binom.pmf(0, count, 1.0 - (share + 0.001)) > 0.05, "and by no more than its last digit"
    assert statement.endswith(f"the largest of these {count}")


def test_the_largest_error_covers_the_stated_share_as_often_as_it_says():
    """Uniform errors: the largest of 20 reaches the stated quantile in 95 % of 20 000 trials, to 4 sigma."""
    largest = np.random.default_rng(3).random((20_000, 20)).max(axis=1)
    assert np.mean(largest >= covered_share(20)) == pytest.approx(0.95, abs=4 * np.sqrt(0.05 * 0.95 / 20_000))


def test_compression_counts_modes_and_functions_in_one_precision():
    """Two modes of 6 numbers and the numbers of their functions, against 10 solutions of 6."""
    model = two_node_model()
    kept = 2 * 6 + model.displacement.functions.n_floats
    assert compression_percent(model, 10) == pytest.approx(100.0 * (1.0 - kept / 60.0))
