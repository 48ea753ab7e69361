"""Displacements beyond the model's: against the process's formula, and sheets rolled to cylinders."""

import h5py
import numpy as np
import pytest
from scipy.special import gamma, kv

from morph_dslam.geometry import RigidTransform, rotation_exp
from morph_dslam.model.discrepancy import (
    Discrepancy,
    DiscrepancyBasis,
    DiscrepancyDeviation,
    farthest_points,
    largest_deformation,
    load_discrepancies,
    save_discrepancies,
)
from morph_dslam.tracking.discrepancy import DiscrepancyFit, DiscrepancyOptions, Reference, refine_discrepancy
from morph_dslam.tracking.estimator import Estimator, State
from morph_dslam.tracking.refinement import Keyframe
from tests.support.bent_sheet import bent_sheet_model
from tests.support.measured_points import bound_points, measured
from tests.support.rendered_sequence import CAMERA

MODEL = bent_sheet_model(22, 16, known=1)
POSE = RigidTransform(
    rotation_exp(np.array([0.15, -0.2, 0.05])) @ np.diag([1.0, -1.0, -1.0]), np.array([0.02, -0.01, 0.6])
)
NOISE_PX = 0.2


def rolled(points, radius, angle):
    """Points (n, 3) of the flat sheet rolled to a cylinder whose axis is at an angle (rad) to its length."""
    along = np.array([np.cos(angle), np.sin(angle), 0.0])
    across, arc = np.array([-along[1], along[0], 0.0]), points @ along
    height = radius * (1.0 - np.cos(arc / radius))
    return (
        np.outer(radius * np.sin(arc / radius), along)
        + np.outer(points @ across, across)
        + np.outer(height, [0.0, 0.0, 1.0])
    )


def seen(points, shape, rng):
    """Pixels of points whose shape is ``shape`` of their rest positions, with noise."""
    return CAMERA.project(POSE.apply(shape(points.rest))) + NOISE_PX * rng.standard_normal((len(points), 2))


def mean_distance(state, discrepancy, truth):
    """Of the nodes from ``truth`` (n, 3) in the object's frame at POSE, metres."""
    found = MODEL.positions(state.parameters)
    if discrepancy is not None:
        found = found + discrepancy.displacement(MODEL.nodes)
    return np.linalg.norm(state.camera_from_object.apply(found) - POSE.apply(truth), axis=1).mean()


def matern(distance, length):
    """Of order 5/2 by its general formula with the modified Bessel function."""
    x = np.sqrt(5.0) * np.maximum(distance, 1e-9) / length
    return 2.0**-1.5 / gamma(2.5) * x**2.5 * kv(2.5, x)


def test_between_its_centres_the_process_is_the_conditional_mean():
    rng = np.random.default_rng(0)
    nodes = rng.uniform(-0.2, 0.2, (400, 3))
    basis = DiscrepancyBasis.spread_over(nodes, 12, 0.15)
    values, places = rng.standard_normal((12, 3)), rng.uniform(-0.2, 0.2, (30, 3))
    apart = np.linalg.norm(basis.centres[:, None] - basis.centres, axis=2)
    to_places = np.linalg.norm(places[:, None] - basis.centres, axis=2)
    expected = matern(to_places, 0.15) @ np.linalg.solve(matern(apart, 0.15), values)
    np.testing.assert_allclose(Discrepancy(basis, values).displacement(places), expected, atol=1e-4)
    np.testing.assert_allclose(basis.influence(basis.centres), np.eye(12), atol=1e-9)


def test_deviations_inside_are_those_of_kriging():
    """On a sphere's surface the process is known: inside, the conditional variance; far away, the process's own."""
    rng, length, amplitude = np.random.default_rng(7), 0.15, 3e-3
    surface = 0.1 * rng.standard_normal((60, 3))
    surface *= 0.1 / np.linalg.norm(surface, axis=1, keepdims=True)
    basis = DiscrepancyBasis(surface, length)
    exact = DiscrepancyDeviation(np.zeros((180, 180)), amplitude, basis)
    found = Discrepancy(basis, np.zeros((60, 3)), exact)
    places = np.vstack([np.outer([0.1, 0.07, 0.04, 0.0], surface[5] / 0.1), [[9.0, 0.0, 0.0]]])
    apart = np.linalg.norm(surface[:, None] - surface, axis=2)
    to_places = matern(np.linalg.norm(places[:, None] - surface, axis=2), length)
    conditional = 1.0 - np.sum(to_places * np.linalg.solve(matern(apart, length), to_places.T).T, axis=1)
    variances = found.covariances(places)
    np.testing.assert_allclose(variances, amplitude**2 * conditional[:, None, None] * np.eye(3), atol=1e-3 * 9e-6)
    deeper = variances[:, 0, 0]
    assert np.all(np.diff(deeper[:4]) > 0.0)
    assert deeper[-1] == pytest.approx(amplitude**2, rel=1e-5)
    joint = found.joint_covariance(places).reshape(5, 3, 5, 3)
    np.testing.assert_allclose(joint[range(5), :, range(5)], variances, atol=1e-14)


def test_where_nothing_was_seen_the_prior_is_back_everywhere():
    """By the law of total variance: the centres vary as the process does, and so does every other place."""
    rng, length, amplitude = np.random.default_rng(8), 0.2, 2e-3
    basis = DiscrepancyBasis(rng.uniform(-0.1, 0.1, (20, 3)), length)
    apart = matern(np.linalg.norm(basis.centres[:, None] - basis.centres, axis=2), length)
    prior = DiscrepancyDeviation(amplitude**2 * np.kron(np.eye(3), apart), amplitude, basis)
    places = rng.uniform(-0.15, 0.15, (6, 3))
    nothing = Discrepancy(basis, np.zeros((20, 3)), prior)
    expected = np.kron(matern(np.linalg.norm(places[:, None] - places, axis=2), length), amplitude**2 * np.eye(3))
    np.testing.assert_allclose(nothing.joint_covariance(places), expected, atol=1e-3 * amplitude**2)


def test_centres_are_no_farther_from_any_node_than_from_each_other():
    nodes = np.random.default_rng(1).uniform(0.0, 1.0, (500, 3))
    centres = nodes[farthest_points(nodes, 25)]
    gaps = np.linalg.norm(nodes[:, None] - centres, axis=2).min(axis=1)
    apart = np.linalg.norm(centres[:, None] - centres, axis=2)[np.triu_indices(25, 1)]
    assert gaps.max() <= apart.min()
    assert len(farthest_points(nodes[:3], 25)) == 3


def test_a_rigid_motion_is_no_deformation():
    basis = DiscrepancyBasis.spread_over(MODEL.nodes, 40, 0.1)
    turned = basis.centres @ rotation_exp(np.array([0.0, 0.02, 0.0])).T + 0.003
    rigid = Discrepancy(basis, turned - basis.centres)
    bump = Discrepancy(basis, np.eye(40, 3) * 0.004)
    assert np.linalg.norm(rigid.displacement(MODEL.nodes), axis=1).max() > 4e-3
    assert largest_deformation(MODEL.nodes, rigid) < 5e-4
    assert largest_deformation(MODEL.nodes, bump) > 2e-3


@pytest.mark.parametrize(("radius", "angle"), [(0.45, 0.5), (-0.6, -0.4)])
def test_a_shape_that_the_model_does_not_have_is_found_from_one_image(radius, angle):
    """A sheet rolled about an axis that is oblique to it, with a model that only arches along its length."""
    rng, points = np.random.default_rng(2), bound_points(MODEL, 200)
    truth = rolled(MODEL.nodes, radius, angle)
    pixels, weights = seen(points, lambda rest: rolled(rest, radius, angle), rng), np.ones(200)
    pixels[::7], weights[::7] = np.nan, 0.0
    state = Estimator(MODEL, CAMERA).estimate(points, pixels, weights, State(np.array([0.01]), POSE)).state
    fit = DiscrepancyFit(MODEL, CAMERA, DiscrepancyOptions(steps=4))
    found = fit.fit(measured(points, pixels, weights), state)
    by_model = mean_distance(state, None, truth)
    assert by_model > 4e-3
    assert mean_distance(state, found, truth) < 0.4 * by_model
    shape = MODEL.positions(state.parameters) + found.displacement(MODEL.nodes)
    missed = state.camera_from_object.apply(shape) - POSE.apply(truth)
    stated = np.sqrt(found.covariances(MODEL.nodes).trace(axis1=1, axis2=2))
    assert 0.2 < np.sqrt(np.mean(np.sum(missed**2, axis=1) / stated**2)) < 2.0
    # From the discrepancy of the frame before one step leads to the same.
    again = fit.fit(measured(points, pixels, weights), state, found)
    np.testing.assert_allclose(again.values, found.values, atol=3e-4)


def test_where_the_model_is_right_nothing_is_added():
    rng, points = np.random.default_rng(3), bound_points(MODEL, 200)
    state = State(np.array([0.03]), POSE)
    pixels = CAMERA.project(points.in_camera(state)) + NOISE_PX * rng.standard_normal((200, 2))
    fit = DiscrepancyFit(MODEL, CAMERA, DiscrepancyOptions())
    found = fit.fit(measured(points, pixels), state)
    assert mean_distance(state, found, MODEL.positions(state.parameters)) < 0.7e-3


def test_other_frames_tell_the_shape_in_the_reference_view():
    """The reference is rolled too, so the points are bound beside their places by the model alone."""
    rng, points = np.random.default_rng(4), bound_points(MODEL, 250)
    turns = [(0.5, 0.5), (0.8, 0.2), (-0.7, 0.5), (1.5, 0.0), (-0.9, -0.3), (0.6, -0.2), (-1.2, 0.6)]
    truth = rolled(MODEL.nodes, 0.55, 0.4)
    estimator, start = Estimator(MODEL, CAMERA), State(np.array([0.01]), POSE)
    reference_pixels = seen(points, lambda rest: rolled(rest, 0.55, 0.4), rng)
    state = estimator.estimate(points, reference_pixels, np.ones(250), start).state
    keyframes = []
    for radius, angle in turns:
        pixels = seen(points, lambda rest, r=radius, a=angle: rolled(rest, r, a), rng)
        own = estimator.estimate(points, pixels, np.ones(250), start).state
        keyframes.append(Keyframe(pixels, np.ones(250), own, 0.5))
    corners = bound_points(MODEL, 12, seed=5)
    corner_pixels = seen(corners, lambda rest: rolled(rest, 0.55, 0.4), rng)
    known = Reference(state, reference_pixels, corners, corner_pixels, 0.5)
    fit = DiscrepancyFit(MODEL, CAMERA, DiscrepancyOptions())
    found = refine_discrepancy(fit, estimator, known, keyframes)
    by_model = mean_distance(state, None, truth)
    assert by_model > 3e-3
    assert mean_distance(state, found, truth) < 0.5 * by_model


def test_discrepancies_come_back_from_a_run(tmp_path):
    basis = DiscrepancyBasis.spread_over(MODEL.nodes, 9, 0.1)
    values = np.random.default_rng(6).standard_normal((2, 9, 3))
    with h5py.File(tmp_path / "run.h5", "w") as file:
        save_discrepancies(file, [None, Discrepancy(basis, values[0]), None, Discrepancy(basis, values[1])])
        found = load_discrepancies(file)
        assert list(found) == [1, 3]
        np.testing.assert_array_equal(found[3].values, values[1])
        np.testing.assert_array_equal(found[1].basis.centres, basis.centres)
        assert found[1].basis.length == 0.1
        del file["discrepancy/row"]
        file["discrepancy/row"] = np.array([1, 2, 3])
        with pytest.raises(ValueError, match="do not belong to their centres"):
            load_discrepancies(file)
    with h5py.File(tmp_path / "none.h5", "w") as file:
        save_discrepancies(file, [None, None])
        assert load_discrepancies(file) == {}
