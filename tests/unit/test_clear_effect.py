"""What acts only while something else does: measurements of a tube that bends to an unknown side."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from morph_dslam.camera import Camera
from morph_dslam.geometry import RigidTransform, rotation_exp
from morph_dslam.model import Parameter, SeparatedField
from morph_dslam.model.functions import ParameterFunctions
from morph_dslam.model.revolution import with_revolution_angle
from morph_dslam.tracking.estimator import Estimator, State
from morph_dslam.tracking.sequence_filter import SequenceFilter, without_clear_effect
from morph_dslam.tracking.still import held as still_pose
from tests.support.bent_tube import AXIS, bent_tube
from tests.support.measured_points import bound_points, measured

CAMERA = Camera(640, 480, 560.0, 560.0, 320.0, 240.0)
POSE = RigidTransform(rotation_exp(np.array([2.2, 0.1, 0.0])), np.array([0.0, 0.04, 0.4]))
TURN, SIDE = 1, 2.1
COUNT, SIGMA = 80, 0.05
#: No load in ten frames, then more of it in each.
LOADS = 0.03 * np.maximum(np.arange(24) - 9, 0)


@cache  # not at import: each process of a run imports all tests, and would compile what the model is made with
def model():
    return with_revolution_angle(bent_tube(), AXIS)


@cache
def estimator():
    return Estimator(model(), CAMERA)


def seen_of(points, state, errors=0.0):
    return measured(points, CAMERA.project(points.in_camera(state)) + errors)


def followed(seed, loads=LOADS):
    """Errors and stated deviations (f,) of the side, half of the noise being the same in all frames."""
    points, rng, found = bound_points(model(), COUNT), np.random.default_rng(seed), []
    start = State(model().default, POSE)
    filtered, stays = SequenceFilter(estimator(), [TURN]), rng.standard_normal((COUNT, 2))
    for load in loads:
        errors = np.sqrt(0.5) * SIGMA * (stays + rng.standard_normal((COUNT, 2)))
        seen = seen_of(points, State(np.array([load, SIDE]), POSE), errors)
        starts = [State(np.array([0.1, side]), POSE) for side in (-2.0, 0.0, 2.0)]
        alone = min((estimator().fit(seen, one) for one in (start, *starts)), key=lambda estimate: estimate.cost)
        estimate = filtered.fuse(seen, alone)
        start = estimate.state
        off = (start.parameters[TURN] - SIDE + np.pi) % (2.0 * np.pi) - np.pi
        found.append((abs(off), estimate.parameter_std[TURN]))
    return np.array(found).T


def test_the_side_of_what_is_not_bent_is_not_said_to_be_known():
    """Without regard to whether there is an effect it is 4 to 7 stated deviations off in these frames."""
    found = np.array([followed(seed) for seed in range(20)])
    off, bent = found[:, 0] / found[:, 1], LOADS > 0.0
    spread_of_any = np.ptp([model().lower[TURN], model().upper[TURN]]) / np.sqrt(12.0)
    assert (found[:, 1][:, ~bent] > 0.95 * spread_of_any).all()
    # As soon as it bends the side is told, and as well as stated.
    assert (found[:, 1][:, bent] < 0.2).all()
    assert 0.7 < np.sqrt(np.mean(off[:, bent] ** 2)) < 1.4


def test_the_side_stays_known_when_what_was_bent_comes_back():
    """Frames that tell nothing of the side were once taken for some that contradict it."""
    there_and_back = np.concatenate([LOADS[9:], LOADS[:9:-1], np.zeros(20)])
    found = np.array([followed(seed, there_and_back) for seed in range(12)])
    errors, stated = found[:, 0], found[:, 1]
    at_rest = there_and_back == 0.0
    at_rest[0] = False
    last_bent = np.flatnonzero(there_and_back)[-1]
    assert (stated[:, at_rest] < 1.01 * stated[:, [last_bent]]).all()
    assert 0.6 < np.sqrt(np.mean((errors[:, -1] / stated[:, -1]) ** 2)) < 1.4


@pytest.mark.parametrize(("lengths", "absent"), [(3.5, True), (4.5, False)])
def test_an_effect_is_clear_from_four_standard_deviations_on(lengths, absent):
    """The side acts in proportion to the load."""
    points, load = bound_points(model(), COUNT), 0.2
    state = State(np.array([load, SIDE]), POSE)
    seen = seen_of(points, state)
    alone = estimator().fit(seen, state)

    def linear_at(there):
        return estimator().linear(seen, replace(alone, state=there))

    others, turn = np.array([[load / lengths, 0.0]]), np.array([[0.0, 1.0]])
    found = without_clear_effect(model(), linear_at(state), linear_at, state, others, turn, np.array([0.1]))
    assert found.tolist() == [absent]


def test_what_is_held_leaves_the_others_as_if_it_were_known():
    seen = seen_of(bound_points(model(), COUNT), State(np.array([0.3, SIDE]), POSE))
    linear = estimator().linear(seen, estimator().fit(seen, State(np.array([0.3, SIDE]), POSE)))
    others = np.delete(np.arange(8), TURN)
    expected = np.linalg.inv(np.delete(np.delete(linear.hessian, TURN, 0), TURN, 1))
    held = linear.holding(np.array([TURN]))
    np.testing.assert_allclose(held.inverse[np.ix_(others, others)], expected, rtol=1e-6)
    assert not held.weighted_jacobian[:, :, TURN].any()


def share_of(a, b):
    return a / (a + b)


def pulled_model():
    """u = pull (z² e_x + share z² e_y) of two moduli, whose share is fitted by polynomials of second order."""
    lower, upper = np.array([0.0, 1.0, 1.0]), np.array([1.0, 3.0, 3.0])
    degrees = np.array([(p, i, j) for p in (0, 1) for i in range(3) for j in range(3)])
    x = np.random.default_rng(0).uniform(-1.0, 1.0, (4000, 3))
    pull, a, b = (lower + 0.5 * (x + 1.0) * (upper - lower)).T
    terms = np.prod(np.cos(degrees[None] * np.arccos(x)[:, None]), axis=2)
    coefficients = np.linalg.lstsq(terms, np.column_stack([pull, pull * share_of(a, b)]), rcond=None)[0]
    functions, tube = ParameterFunctions(lower, upper, degrees, coefficients), bent_tube()
    zero, squared = np.zeros(len(tube.nodes)), tube.nodes[:, 2] ** 2
    modes = np.stack([np.column_stack([squared, zero, zero]), np.column_stack([zero, squared, zero])])
    values = np.array([functions.rows(np.array(mu))[2:, 1] for mu in zip(pull[:300], a[:300], b[:300], strict=True)])
    total = (a + b)[:300] ** 2
    true = np.column_stack([(pull * b)[:300] / total, -(pull * a)[:300] / total])
    relative = np.linalg.norm(values - true, axis=0) / np.linalg.norm(true, axis=0)
    return replace(
        tube,
        parameters=(
            Parameter("pull", "ratio", "1", 0.0, 1.0, 0.0),
            Parameter("a", "ratio", "1", 1.0, 3.0, 2.0),
            Parameter("b", "ratio", "1", 1.0, 3.0, 2.0),
        ),
        displacement=SeparatedField(modes, functions),
        stresses={},
        certificate={"sensitivity": {name: {"relative_l2": float(e)} for name, e in zip("ab", relative, strict=True)}},
    )


def test_a_common_factor_shows_only_by_the_errors_of_the_sensitivities():
    """Of two moduli displacements tell the share alone."""
    model, mu = pulled_model(), np.array([1.0, 2.4, 1.6])
    estimator, state = Estimator(model, CAMERA), State(mu, POSE)
    seen = seen_of(bound_points(model, COUNT), state)
    alone = estimator.fit(seen, state)

    def linear_at(there):
        return estimator.linear(seen, replace(alone, state=there))

    directions = np.array([[0.0, 1.6, -2.4], [0.0, 2.4, 1.6]]) / np.hypot(2.4, 1.6)
    args = linear_at(state), linear_at, state, np.zeros((0, 3)), directions, np.full(2, 1e-6)
    assert without_clear_effect(model, *args).tolist() == [False, True]
    assert without_clear_effect(replace(model, certificate={}), *args).tolist() == [False, False]


def test_a_pose_that_is_held_does_not_make_known_what_nothing_shows():
    """Without pull neither modulus moves anything."""
    model = pulled_model()
    estimator, start = Estimator(model, CAMERA), State(model.default, POSE)
    seen = seen_of(bound_points(model, COUNT), start, SIGMA * np.random.default_rng(0).standard_normal((COUNT, 2)))
    free, held = (
        SequenceFilter(estimator, [1, 2]).fuse(seen, estimator.fit(seen, start, known), known).parameter_std
        for known in (None, still_pose(start, estimator))
    )
    assert (held[1:] > 0.9 * free[1:]).all()
    assert held[0] < free[0]
