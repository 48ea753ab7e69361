"""What normal equations say of stretches: against numbers worked out by hand."""

import numpy as np
import pytest

from morph_dslam.diagnostics.dimensions import CLEAR, LIKELY, NOTED, StretchEvidence

FLAT, SOLID = np.array([True, True, False]), np.ones(3, dtype=bool)
#: What takes the mean of the axes away.
SHAPE = {2: np.diag([1.0, 1.0, 0.0]) - np.array([[0.5, 0.5, 0], [0.5, 0.5, 0], [0, 0, 0]]), 3: np.eye(3) - 1 / 3}


def evidence(axes, longer, deviation):
    """Of a model ``longer`` (3,) than the object along each axis; known to ``deviation`` whichever way."""
    # One is the information of what is thought of stretches beforehand.
    shape = SHAPE[int(axes.sum())]
    return StretchEvidence(axes, (1.0 / deviation**2 - 1.0) * shape, shape @ longer / deviation**2)


def test_a_flat_object_is_off_along_one_axis_against_the_other():
    """A model 3 % longer along x: 1.5 % on average, and 1.5 % more along x and less along y."""
    told = evidence(FLAT, [0.03, 0.0, 0.0], 0.004)
    np.testing.assert_allclose(told.by_axis, [0.03, -0.03, 0.0])
    np.testing.assert_allclose(told.deviations, [0.004 * np.sqrt(2.0)] * 2 + [0.0])
    assert told.off_by == pytest.approx(0.03)
    assert told.sigmas == pytest.approx(0.03 / (0.004 * np.sqrt(2.0)))
    assert told.is_shown
    assert not told.is_excluded
    assert told.in_words == "by about 3 % along x against y"


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_solid_is_off_along_the_axis_that_is_longer_than_both_others(axis):
    off = np.zeros(3)
    off[axis] = -0.04
    told = evidence(SOLID, off, 0.002)
    assert told.axis == axis
    assert told.by_axis[axis] == pytest.approx(-0.04)
    assert told.in_words == f"by about 4 % along {'xyz'[axis]} against the others"
    np.testing.assert_allclose(np.delete(told.by_axis, axis), 0.02)
    assert told.deviations[axis] == pytest.approx(0.002 * np.sqrt(1.5))


def test_little_or_unsure_stretches_are_not_said_to_be_there():
    narrow = 0.02 / LIKELY
    for off, deviation, shown, excluded in (
        (0.03, 1.1 * 0.03 / CLEAR, False, False),
        (0.03, 0.9 * 0.03 / CLEAR, True, False),
        (0.009, 0.0001, False, True),  # ever so sure, but of no account
        (0.0, 0.9 * narrow, False, True),
        (0.0, 1.1 * narrow, False, False),
        (0.01, 1.1 * 0.01 / LIKELY, False, False),
    ):
        # Against the other axis a stretch is the root of two times as long, and so is its deviation.
        told = evidence(FLAT, [off, 0.0, 0.0], deviation / np.sqrt(2.0))
        assert (told.is_shown, told.is_excluded) == (shown, excluded), off


def test_nothing_known_excludes_nothing_and_widens_nothing():
    told = StretchEvidence.none(FLAT)
    assert not told.is_shown
    assert not told.is_excluded
    assert not told.excess.any()


def test_an_object_with_one_length_cannot_be_out_of_proportion():
    told = StretchEvidence.none(np.array([False, True, False]))
    assert told.is_excluded
    assert not told.is_shown
    assert not told.excess.any()


def test_what_is_shown_is_stated_as_deviation_less_what_chance_shows():
    deviation = 0.005
    for sigmas in (0.99 * NOTED, 4.0):
        # A stretch of x by a, and of y by -a, is one by a times the root of two.
        a = sigmas * deviation / np.sqrt(2.0)
        found = evidence(FLAT, [a, -a, 0.0], deviation).excess
        if sigmas < NOTED:
            assert not found.any()
            continue
        against, together = (np.array([1.0, -1.0, 0.0]) / np.sqrt(2.0), np.array([1.0, 1.0, 0.0]) / np.sqrt(2.0))
        # One camera cannot tell which axis is off: if it is x alone, all axes together are off by as much.
        for direction in (against, together):
            assert direction @ found @ direction == pytest.approx(15.0 * deviation**2)
        assert against @ found @ together == pytest.approx(0.0, abs=1e-12)


def test_a_model_that_is_longer_along_one_axis_is_within_what_is_stated():
    """Whichever axis it is, the stretch of each axis is of the size of its stated deviation."""
    for axis in range(3):
        off = np.zeros(3)
        off[axis] = 0.05
        stated = np.sqrt(np.diag(evidence(SOLID, off, 1e-4).excess))
        assert 1.0 < off[axis] / stated[axis] < 1.5


def test_views_are_joined_as_independent_ones():
    one, other = evidence(SOLID, [0.01, 0.02, 0.0], 0.01), evidence(SOLID, [0.03, 0.0, 0.0], 0.005)
    both = one.joined([other])
    weights = np.array([1.0, 4.0]) / 5.0
    np.testing.assert_allclose(both.by_axis, weights @ [one.by_axis, other.by_axis], rtol=1e-3)
    np.testing.assert_allclose(both.covariance, np.eye(2) * 0.01**2 / 5.0, rtol=1e-3, atol=1e-12)


def test_a_view_of_one_face_tells_of_its_two_axes_only():
    face, whole = evidence(FLAT, [0.02, -0.02, 0.0], 0.001), StretchEvidence.none(SOLID)
    both = whole.joined([face])
    assert both.by_axis[0] - both.by_axis[1] == pytest.approx(1.5 * 0.04, rel=1e-3)
    assert not both.is_excluded
    both = evidence(SOLID, [0.0, 0.0, 0.0], 0.004).joined([evidence(FLAT, [0.0, 0.0, 0.0], 0.001)])
    assert both.is_excluded
    assert both.deviations[0] < both.deviations[2]
