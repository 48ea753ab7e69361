"""Deviations of displacement and stress against states drawn from the parameters' covariance."""

import numpy as np
import pytest

from morph_dslam.geometry import RigidTransform
from morph_dslam.model.reduced_model import von_mises
from morph_dslam.tracking.estimator import Estimate, State
from morph_dslam.tracking.observability import displacement_std, largest_displacement, largest_von_mises, von_mises_std
from tests.support.bent_sheet import bent_sheet_model

MODEL = bent_sheet_model(22, 16)
MU = np.array([0.03, 0.15, 0.1])


@pytest.fixture(scope="module")
def estimate():
    root = np.array([[2e-4, 0.0, 0.0], [1e-3, 2e-3, 0.0], [-5e-4, 1e-3, 1e-3]])
    covariance = np.zeros((9, 9))
    covariance[:3, :3] = root @ root.T
    state = State(MU, RigidTransform(np.eye(3), np.zeros(3)))
    return Estimate(state, 1.0, np.zeros((1, 2)), 0.3, covariance, np.zeros(3, dtype=bool), 1, True)


@pytest.fixture(scope="module")
def drawn(estimate):
    """Parameters (k, 3) with the covariance, in pairs about their mean."""
    half = np.random.default_rng(0).multivariate_normal(np.zeros(3), estimate.covariance[:3, :3], 1500)
    return MU + np.concatenate([half, -half])


def test_displacement_spreads_as_stated(estimate, drawn):
    moved = np.array([MODEL.displacement.value(mu) for mu in drawn])
    expected = np.sqrt(moved.var(axis=0).sum(axis=1))
    stated = displacement_std(MODEL, estimate)
    assert expected.max() > 1e-4
    np.testing.assert_allclose(stated, expected, rtol=0.06, atol=2e-3 * expected.max())


def test_largest_displacement_spreads_as_stated(estimate, drawn):
    value, deviation = largest_displacement(MODEL, estimate)
    node = np.linalg.norm(MODEL.displacement.value(MU), axis=1).argmax()
    lengths = [np.linalg.norm(MODEL.displacement.value(mu)[node]) for mu in drawn]
    assert value == pytest.approx(np.mean(lengths), rel=1e-3)
    assert deviation == pytest.approx(np.std(lengths), rel=0.06)


def test_largest_stress_spreads_as_stated(estimate, drawn):
    """At the node where it is largest on either face."""
    value, deviation = largest_von_mises(MODEL, estimate)
    by_face = {place: von_mises(MODEL.stresses[place].value(MU)) for place in MODEL.stresses}
    place = max(by_face, key=lambda name: by_face[name].max())
    node = by_face[place].argmax()
    assert value == pytest.approx(by_face[place][node])
    sizes = [von_mises(MODEL.stresses[place].value(mu)[node]) for mu in drawn]
    assert deviation == pytest.approx(np.std(sizes), rel=0.06)


def test_model_without_stresses_has_no_largest_one(estimate):
    assert np.isnan(largest_von_mises(type(MODEL)(**{**vars(MODEL), "stresses": {}}), estimate)).all()


@pytest.mark.parametrize("components", [3, 6])
def test_stress_spreads_as_stated(estimate, drawn, components):
    """The stresses of a sheet, and six components made of them."""
    top = MODEL.stresses["top"]
    rng = np.random.default_rng(1)
    modes = top.modes if components == 3 else top.modes @ rng.standard_normal((3, 6))
    field = top.with_modes(modes)
    model = type(MODEL)(**{**vars(MODEL), "stresses": {"top": field}})
    stresses = np.array([von_mises(field.value(mu)) for mu in drawn])
    seen = stresses.mean(axis=0) > 0.1 * stresses.max()
    stated = von_mises_std(model, estimate, "top")
    np.testing.assert_allclose(stated[seen], stresses.std(axis=0)[seen], rtol=0.1)
