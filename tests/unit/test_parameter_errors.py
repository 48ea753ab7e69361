"""What the discretisation error amounts to in the parameters, on a block that is stretched and sheared evenly."""

from dataclasses import replace

import numpy as np
import pytest

from morph_dslam.model import Parameter
from morph_dslam.model.model_errors import ModelErrors
from morph_dslam.model.parameter_errors import equivalent_errors, parameter_errors
from morph_dslam.tracking.frame_results import with_model_errors
from morph_dslam.tracking.observability import covariance_of_parameters
from tests.support.streamed import tracked_result
from tests.support.stretched_block import SIZE, stretched_block_model

#: Parameters, SI, at which the block was solved again, and what they have to be for the finer displacement.
STATES = np.array([[0.1, 0.002], [-0.05, 0.006]])
MEANT = np.array([[0.104, 0.0017], [-0.052, 0.0063]])


def displacement(model, mu):
    """(n, 3) in closed form."""
    x, z = model.nodes[:, 0], model.nodes[:, 2]
    return np.column_stack([mu[0] * x + mu[1] * z / SIZE[2], np.zeros((len(x), 2))])


@pytest.fixture(scope="module")
def model():
    return stretched_block_model()


@pytest.fixture(scope="module")
def certified(model):
    states = [
        (mu, displacement(model, mu), displacement(model, meant)) for mu, meant in zip(STATES, MEANT, strict=True)
    ]
    return replace(model, certificate={"discretisation": {"parameters": parameter_errors(model, states)}})


def test_what_parameters_explain_of_an_error_is_found_and_the_rest_is_not(model):
    error = displacement(model, MEANT[0]) - displacement(model, STATES[0])
    # Motion along y is orthogonal to all that the parameters do.
    error[:, 1] += 1e-4
    found = equivalent_errors(model, STATES[0], error)
    assert found.changes == pytest.approx(MEANT[0] - STATES[0], rel=1e-9)
    assert (found.left, found.in_object) == pytest.approx((1e-4, 1e-4), rel=1e-9)


def test_a_free_pose_makes_good_what_is_rigid_and_the_displacement_is_off_by_it(model):
    """The finer block is also turned by a milliradian, and shifted: the slide alone would take a part of that."""
    mu, meant = STATES[0], MEANT[0]
    surface = np.unique(model.triangles)
    deformed = model.nodes + displacement(model, mu)
    turned = np.cross([0.0, 1e-3, 0.0], deformed - deformed[surface].mean(axis=0)) + np.array([2e-5, -1e-5, 3e-5])
    error = displacement(model, meant) - displacement(model, mu) + turned
    found = equivalent_errors(model, mu, error, free_pose=True)
    assert found.changes == pytest.approx(meant - mu, rel=1e-6)
    assert found.left < 1e-9
    assert found.in_object == pytest.approx(np.sqrt(np.mean(np.sum(turned[surface] ** 2, axis=1))), rel=1e-6)
    assert abs(equivalent_errors(model, mu, error).changes[1] - (meant - mu)[1]) > 5e-6

    entry = parameter_errors(model, [(mu, displacement(model, mu), displacement(model, mu) + error)])
    errors = ModelErrors.of(replace(model, certificate={"discretisation": {"parameters": entry}}))
    assert errors is not None
    none, plain = np.empty(0, dtype=int), tracked_result(model, *mu)
    by_pose = {free: with_model_errors(plain, errors.where_known(none, free)) for free in (False, True)}
    for free, result in by_pose.items():
        assert result.estimate is not None
        assert result.estimate.by_model is not None
        of_model = result.estimate.by_model
        size, finer = (
            np.sqrt(np.mean(np.sum(u[surface] ** 2, axis=1)))
            for u in (deformed - model.nodes, deformed - model.nodes + error)
        )
        expected = found.in_object * size / finer if free else of_model.displacement
        assert of_model.in_object == pytest.approx(expected, rel=1e-6)
    off = by_pose[True].displacement_std()
    assert off == pytest.approx(np.hypot(plain.displacement_std(), found.in_object * size / finer), rel=1e-5)


def test_the_certificate_has_them_by_name_with_the_size_of_the_displacement(model, certified):
    entry = certified.certificate["discretisation"]["parameters"]
    for k, name in enumerate(("stretch", "slide")):
        assert entry["errors"][name] == pytest.approx((MEANT - STATES)[:, k], rel=1e-9)
    sizes = [1e3 * np.sqrt(np.mean(np.sum(displacement(model, meant) ** 2, axis=1))) for meant in MEANT]
    assert entry["displacement_rms_mm"] == pytest.approx(sizes, rel=1e-12)


def test_deviations_hold_them_in_proportion_to_the_displacement(model, certified):
    stretch, slide = 0.06, 0.004
    plain = tracked_result(model, stretch, slide)
    assert ModelErrors.of(model) is None
    assert with_model_errors(plain, None) is plain
    found = with_model_errors(plain, ModelErrors.of(certified))

    def size(mu):
        return np.sqrt(np.mean(np.sum(displacement(model, mu) ** 2, axis=1)))

    errors = (MEANT - STATES) * (size([stretch, slide]) / np.array([size(meant) for meant in MEANT]))[:, None]
    expected = plain.covariance.copy()
    expected[:2, :2] += errors.T @ errors / 2.0
    assert found.covariance == pytest.approx(expected, rel=1e-9)
    # The images fix the shape: its deviation and what is observable stay as they were.
    assert found.displacement_std() == pytest.approx(plain.displacement_std(), rel=1e-6)
    assert found.estimate is not None
    assert covariance_of_parameters(found.estimate) == pytest.approx(plain.covariance[:2, :2], rel=1e-9)
    at_rest = with_model_errors(tracked_result(model, 0.0, 0.0), ModelErrors.of(certified))
    assert at_rest.covariance == pytest.approx(plain.covariance, rel=1e-9)


def test_what_parameters_cannot_make_good_is_a_deviation_of_the_displacement(model):
    """Finer elements that also bulge along y by a twentieth of the displacement's size."""
    finer = displacement(model, STATES[1])
    size = np.sqrt(np.mean(np.sum(finer[np.unique(model.triangles)] ** 2, axis=1)))
    finer[:, 1] += 0.05 * size
    entry = parameter_errors(model, [(STATES[1], displacement(model, STATES[1]), finer)])
    known = replace(model, certificate={"discretisation": {"parameters": entry}})
    plain = tracked_result(model, *STATES[1])
    found = with_model_errors(plain, ModelErrors.of(known))
    share = 0.05 / np.sqrt(1.0 + 0.05**2)
    assert found.displacement_std() == pytest.approx(np.hypot(plain.displacement_std(), share * size), rel=1e-6)
    assert found.covariance == pytest.approx(plain.covariance, rel=1e-9)


def test_a_known_parameter_gets_no_deviation(model, certified):
    plain = tracked_result(model, 0.06, 0.004)
    covariance = plain.covariance.copy()
    covariance[1, :] = covariance[:, 1] = 0.0
    assert plain.estimate is not None
    known = replace(plain, estimate=replace(plain.estimate, covariance=covariance))
    found = with_model_errors(known, ModelErrors.of(certified)).covariance
    assert found[0, 0] > covariance[0, 0]
    assert not found[1].any()


def test_others_make_good_what_a_sensor_keeps_a_parameter_from(model, certified):
    """Where the slide has a sensor's value, the stretch comes as near to the finer shapes as it alone can."""
    plain, held = tracked_result(model, 0.06, 0.004), np.zeros((8, 2))
    held[1, 1] = 1.0
    found = with_model_errors(plain, ModelErrors.of(certified), held)
    x, z = model.nodes[np.unique(model.triangles)].T[[0, 2]]
    alone = [(d[0] * x + d[1] * z / SIZE[2]) @ x / (x @ x) for d in MEANT - STATES]

    def size(mu):
        return np.sqrt(np.mean(np.sum(displacement(model, mu) ** 2, axis=1)))

    shares = np.array(alone) * size([0.06, 0.004]) / np.array([size(meant) for meant in MEANT])
    expected = plain.covariance.copy()
    expected[0, 0] += np.mean(shares**2)
    assert found.covariance == pytest.approx(expected, rel=1e-9)


def test_the_shape_errs_by_what_a_sensor_keeps_from_it(model, certified):
    """The images ask for ``errors``, the estimate moves by what the sensor leaves, and the shape lacks the rest."""
    stretch, slide = 0.06, 0.004
    plain, held = tracked_result(model, stretch, slide), np.zeros((8, 2))
    held[:2, 1] = [-0.4, 0.9]
    held[7, 1] = 0.2  # and a part of it is taken for a motion along the sight line
    found = with_model_errors(plain, ModelErrors.of(certified), held)

    def size(mu):
        return np.sqrt(np.mean(np.sum(displacement(model, mu) ** 2, axis=1)))

    errors = (MEANT - STATES) * (size([stretch, slide]) / np.array([size(meant) for meant in MEANT]))[:, None]
    lacks = [
        displacement(model, error) - displacement(model, [error[0] + 0.4 * error[1], 0.1 * error[1]])
        for error in errors
    ]
    lacking = np.sqrt(np.mean(np.sum(np.square(lacks), axis=2), axis=0))
    assert found.displacement_std() == pytest.approx(np.hypot(plain.displacement_std(), lacking), rel=1e-6)
    apart = found.image_covariance - plain.covariance
    along = np.mean((0.2 * errors[:, 1]) ** 2)
    assert apart[7, 7] == pytest.approx(along, rel=1e-9)
    assert found.covariance[7, 7] - plain.covariance[7, 7] == pytest.approx(along, rel=1e-9), (
        "of the pose that is stated"
    )
    assert np.linalg.eigvalsh(apart).min() > -1e-12 * np.trace(apart)


def test_what_something_else_tells_half_way_is_taken_half_way(model, certified):
    """Errors of a slide that is kept from half of its change lie half way between those of a known and a free one."""
    errors, one = ModelErrors.of(certified), np.array([1])
    assert errors is not None
    assert errors.mesh is not None
    free, half, full = (
        each.errors for each in (errors.mesh, errors.mesh.holding(one, np.array([[0.5]])), errors.mesh.holding(one))
    )
    assert free == pytest.approx(MEANT - STATES, rel=1e-9)
    assert half == pytest.approx((free + full) / 2.0, rel=1e-9)
    assert not full[:, 1].any()


def test_where_the_time_is_known_the_other_parameters_alone_make_the_error_good(model):
    """The slide is the time: the stretch that comes nearest to the finer shape is a projection."""
    slide = model.parameters[1]
    time = Parameter(slide.name, "time", "s", slide.lower, slide.upper, slide.default)
    timed = replace(model, parameters=(model.parameters[0], time))
    states = [
        (mu, displacement(model, mu), displacement(model, meant)) for mu, meant in zip(STATES, MEANT, strict=True)
    ]
    entry = parameter_errors(timed, states)
    timed = replace(timed, certificate={"discretisation": {"parameters": entry}})
    x = model.nodes[np.unique(model.triangles), 0]
    errors = [(finer - own)[np.unique(model.triangles), 0] for _, own, finer in states]
    stretches = np.array([x @ error / (x @ x) for error in errors])
    left = [np.sqrt(np.mean((error - s * x) ** 2)) for error, s in zip(errors, stretches, strict=True)]
    mu, found = np.array([0.06, 0.004]), ModelErrors.of(timed)
    assert found is not None
    sizes = [np.sqrt(np.mean(np.sum(displacement(model, each) ** 2, axis=1))) for each in (mu, *MEANT)]
    expected = np.mean((stretches * sizes[0] / sizes[1:]) ** 2)
    known = found.where_known(np.array([1])).at(mu)
    assert known.parameters == pytest.approx(np.diag([expected, 0.0]), rel=1e-9)
    share = np.sqrt(np.mean((np.array(left) / sizes[1:]) ** 2))
    assert known.displacement == pytest.approx(share * sizes[0], rel=1e-6)
    for others in ([], [0]):
        assert found.where_known(np.array(others, dtype=int)).at(mu).parameters[1, 1] > 0.0
