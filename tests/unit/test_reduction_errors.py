"""What the reduction error amounts to in the parameters, on a block that is stretched and sheared evenly."""

from dataclasses import replace

import numpy as np
import pytest

from morph_dslam.model import SeparatedField
from morph_dslam.model.basis_functions import fourier_basis
from morph_dslam.model.functions import ParameterFunctions
from morph_dslam.model.model_errors import ModelErrors
from morph_dslam.model.reduction_errors import ReductionErrors, errors_on_modes
from morph_dslam.model.tensor_functions import CPFunctions
from tests.support.stretched_block import SIZE, stretched_block_model

#: Held-out states, SI, and the parameters' changes that are the model's error there.
STATES = np.array([[0.05, 0.002], [-0.05, 0.004]])
CHANGES = np.array([[2e-3, 1e-4], [1e-3, -2e-4]])
#: As far from one as from the other.
MIDDLE = STATES.mean(axis=0)
NEITHER = np.zeros(2, dtype=bool)


def displacement(model, mu):
    """(n, 3) in closed form."""
    x, z = model.nodes[:, 0], model.nodes[:, 2]
    return np.column_stack([mu[0] * x + mu[1] * z / SIZE[2], np.zeros((len(x), 2))])


def errors_of(model):
    found = ReductionErrors.of(model)
    assert found is not None
    return found


def certified(model, errors, mean_mm=1e-6):
    held_out = {
        "coordinates": STATES.tolist(),
        "mean_mm": [mean_mm] * len(errors),
        "error_on_modes_m2": errors_on_modes(model, errors),
    }
    return replace(model, certificate={"held_out": held_out})


def without_rigid_motions(model):
    """What each parameter moves the surface by, less its nearest rigid motion, by least squares."""
    nodes = np.unique(model.triangles)
    arms = model.nodes[nodes] - model.nodes[nodes].mean(axis=0)
    rigid = [motion for axis in np.eye(3) for motion in (np.tile(axis, (len(nodes), 1)), np.cross(axis, arms))]
    columns = np.array([np.ravel(part) for part in rigid]).T
    by = [displacement(model, unit)[nodes].ravel() for unit in np.eye(2)]
    return [part - columns @ np.linalg.lstsq(columns, part, rcond=None)[0] for part in by]


@pytest.fixture(scope="module")
def model():
    return stretched_block_model()


def test_errors_that_parameters_explain_are_theirs_and_rigid_motions_are_the_pose_s(model):
    turned = np.cross([0.0, 2e-3, 0.0], model.nodes) + np.array([1e-4, -2e-4, 3e-4])
    errors = errors_of(certified(model, [displacement(model, change) + turned for change in CHANGES]))
    expected = CHANGES.T @ CHANGES / len(CHANGES)
    assert errors.covariance(MIDDLE, NEITHER) == pytest.approx(expected, rel=1e-5, abs=1e-14)


def test_at_a_held_out_state_its_error_counts_most(model):
    """Three quarters of the weight are its own here; errors of equal size weigh alike everywhere."""
    errors = errors_of(certified(model, [displacement(model, change) for change in CHANGES]))
    first, second = (np.outer(change, change) for change in CHANGES)
    for state, expected in zip(STATES, (0.75 * first + 0.25 * second, 0.25 * first + 0.75 * second), strict=True):
        assert errors.size_at(state) == pytest.approx(1e-9)
        assert errors.covariance(state, NEITHER) == pytest.approx(expected, rel=1e-4, abs=1e-12)


def test_what_a_constant_is_off_by_the_other_parameter_makes_good(model):
    """The slide is found from many states; the stretch makes up for its error as least squares say."""
    errors = errors_of(certified(model, [displacement(model, change) for change in CHANGES]))
    found = errors.covariance(MIDDLE, np.array([False, True]))
    variance = np.mean(CHANGES[:, 1] ** 2)
    assert found[1, 1] == pytest.approx(variance, rel=1e-5)
    stretch, slide = without_rigid_motions(model)
    taken = -(stretch @ slide) / (stretch @ stretch)
    assert found[0, 1] == pytest.approx(taken * variance, rel=1e-5, abs=1e-14)
    alone = np.mean([(stretch @ (a * stretch + b * slide) / (stretch @ stretch)) ** 2 for a, b in CHANGES])
    assert found[0, 0] == pytest.approx(alone + taken**2 * variance, rel=1e-5)


@pytest.mark.parametrize("constant", [NEITHER, np.array([False, True])])
def test_a_parameter_that_is_known_makes_no_error_good(model, constant):
    """The slide takes what the stretch would have taken, as least squares of one unknown say."""
    errors = errors_of(certified(model, [displacement(model, change) for change in CHANGES]))
    found = errors.covariance(MIDDLE, constant, np.array([True, False]))
    stretch, slide = without_rigid_motions(model)
    alone = np.mean([(slide @ (a * stretch + b * slide) / (slide @ slide)) ** 2 for a, b in CHANGES])
    assert found == pytest.approx(np.diag([0.0, alone]), rel=1e-5, abs=1e-16)


def anywhere(share):
    """Second moment about a place in a range, a share of it from its beginning, of values spread evenly over it."""
    return (share**3 + (1.0 - share) ** 3) / 3.0


@pytest.mark.parametrize("state", [[0.0, 0.001], [-0.2, 0.004]])
def test_a_parameter_that_moves_the_surface_by_less_than_the_error_is_anywhere_in_its_range(model, state):
    """Errors of a thousand ranges."""
    errors = [displacement(model, [0.0, 10.0]), displacement(model, [0.0, -10.0])]
    found = errors_of(certified(model, errors, mean_mm=1e6)).covariance(np.array(state), NEITHER)
    ranges = model.upper - model.lower
    expected = ranges * np.sqrt(anywhere((state - model.lower) / ranges))
    assert np.sqrt(np.diag(found)) == pytest.approx(expected, rel=0.1)


EPSILON = 1e-6


def with_a_valley(model):
    """Shapes by the sum of both parameters, scaled to -1 to 1, but for an error of EPSILON times a polynomial."""
    coefficients = np.array([[1e-3, 0.0], [1e-3, 0.0], [0.0, EPSILON]])
    functions = ParameterFunctions(model.lower, model.upper, np.array([[1, 0], [0, 1], [8, 0]]), coefficients)
    return replace(model, displacement=SeparatedField(model.displacement.modes, functions))


@pytest.mark.parametrize("share", [1.0, 0.98, 0.7, 0.5])
def test_a_sum_of_parameters_that_the_error_alone_splits_is_all_that_is_known(model, share):
    """The polynomial of degree 8 changes by 64 EPSILON at the end of the range, and by 2 EPSILON all along."""
    valley, z = with_a_valley(model), model.nodes[:, [2, 0, 0]] * [1.0 / SIZE[2], 0.0, 0.0]
    errors = errors_of(certified(valley, [EPSILON * z, -EPSILON * z], mean_mm=2e3 * EPSILON))
    ranges = model.upper - model.lower
    found = errors.covariance(model.lower + [share, 1.0 - share] * ranges, NEITHER) / np.outer(ranges, ranges)
    assert found == pytest.approx(anywhere(share) * np.array([[1.0, -1.0], [-1.0, 1.0]]), rel=0.25)
    # An error that is a thousand times smaller leaves the polynomial to tell both.
    sure = errors_of(certified(valley, [1e-3 * EPSILON * z] * 2, mean_mm=2.0 * EPSILON))
    if share > 0.9:
        found = sure.covariance(model.lower + [share, 1.0 - share] * ranges, NEITHER)
        assert np.sqrt(np.diag(found)) == pytest.approx(0.0, abs=1e-3 * ranges.max())


def test_many_states_show_no_more_of_a_value_of_the_sequence(model):
    """They hide the same share of its range wherever it is found: at its end the mean square is four times as large."""
    valley, z = with_a_valley(model), model.nodes[:, [2, 0, 0]] * [1.0 / SIZE[2], 0.0, 0.0]
    errors = errors_of(certified(valley, [EPSILON * z, -EPSILON * z], mean_mm=2e3 * EPSILON))
    middle, end = (errors.covariance(np.array([0.0, slide]), np.array([False, True])) for slide in (0.0, 0.01))
    assert end == pytest.approx(4.0 * middle, rel=0.05)
    ranges = model.upper - model.lower
    assert 0.3 < np.sqrt(end[1, 1]) / ranges[1] < np.sqrt(anywhere(1.0))
    assert end[0, 0] / ranges[0] ** 2 == pytest.approx(end[1, 1] / ranges[1] ** 2, rel=0.05)


def test_a_valley_ends_where_a_range_does(model):
    """The sum of the parameters is the most but a tenth of a range: only that is left of either one."""
    valley, z = with_a_valley(model), model.nodes[:, [2, 0, 0]] * [1.0 / SIZE[2], 0.0, 0.0]
    errors = errors_of(certified(valley, [EPSILON * z, -EPSILON * z], mean_mm=2e3 * EPSILON))
    ranges = model.upper - model.lower
    found = errors.covariance(model.upper - [0.0, 0.1] * ranges, NEITHER) / np.outer(ranges, ranges)
    assert np.sqrt(np.diag(found)) == pytest.approx(0.1 / np.sqrt(3.0), rel=0.15)


def test_the_displacement_is_off_by_the_certified_error(model):
    known = certified(model, [displacement(model, change) for change in CHANGES], mean_mm=0.25)
    errors = ModelErrors.of(known)
    assert errors is not None
    assert errors.at(np.array([0.02, 0.001])).displacement == pytest.approx(0.25e-3)
    assert ModelErrors.of(model) is None


def test_errors_of_other_modes_do_not_count(model):
    """A model whose displacement was changed after its certificate was made."""
    known = certified(model, [displacement(model, change) for change in CHANGES])
    field = model.displacement
    halves = replace(
        known, displacement=field.with_modes(np.concatenate([0.5 * field.modes, 0.5 * field.modes], axis=0))
    )
    assert ReductionErrors.of(halves) is None


def test_of_an_angle_that_begins_again_states_beyond_the_end_are_near():
    """At 350 degrees a state at 10 degrees is nearer than one at 180; half the weight goes by squared distances."""
    circle = 2.0 * np.pi
    functions = CPFunctions((fourier_basis(0.0, circle, 1),), (np.eye(3),), np.eye(3))
    states, sizes = np.radians([[10.0], [180.0]]), np.array([1e-3, 3e-3])
    errors = ReductionErrors(states, np.zeros((2, 3)), sizes, np.zeros(1), np.array([circle]), functions, np.eye(3))
    near = 170.0**2 / (20.0**2 + 170.0**2)
    expected = np.sqrt((0.5 * near + 0.25) * 1e-6 + (0.5 * (1.0 - near) + 0.25) * 9e-6)
    for degrees in (350.0, -10.0, 710.0):
        assert errors.size_at(np.radians([degrees])) == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("constant", [True, False])
@pytest.mark.parametrize("degrees", [0.0, 5.0, 90.0, 180.0, 359.0])
def test_what_is_hidden_of_an_angle_does_not_depend_on_where_its_zero_is(degrees, constant):
    """The surface moves on a circle of 1 mm, the error is 4 mm: all the angle is hidden, half a turn to each side.

    Half a turn moves the surface by 2 mm, where the derivatives say pi mm.
    """
    circle, error, amplitude = 2.0 * np.pi, 4e-3, 1e-3
    functions = CPFunctions((fourier_basis(0.0, circle, 1),), (np.eye(3),), np.eye(3))
    states, products = circle * (np.arange(12)[:, None] + 0.5) / 12.0, np.diag([0.0, 1.0, 1.0]) * amplitude**2
    ranges, none = np.array([circle]), np.zeros((12, 3))
    errors = ReductionErrors(states, none, np.full(12, error), np.zeros(1), ranges, functions, products)
    left = error**4 / ((circle * amplitude) ** 2 + error**2) ** 2
    share = 2.0 / np.pi
    expected = (1.0 - share**2 * (1.0 - left)) * circle**2 / 12.0
    assert errors.covariance(np.radians([degrees]), np.array([constant])) == pytest.approx(expected, rel=1e-6)
