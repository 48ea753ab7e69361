"""Rotations, rigid and similarity transforms against SciPy and homogeneous matrices."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from morph_dslam.geometry import (
    RigidTransform,
    SimilarityTransform,
    cross_matrix,
    fit_similarity,
    rotation_exp,
    rotation_log,
)


@pytest.mark.parametrize("angle", [0.0, 1e-12, 1e-8, 2e-7, 1e-3, 1.0, 3.0, np.pi, 7.0])
def test_rotation_exp_is_scipys(angle):
    rng = np.random.default_rng(0)
    for axis in rng.normal(size=(20, 3)):
        vector = angle * axis / np.linalg.norm(axis)
        expected = Rotation.from_rotvec(vector).as_matrix()
        np.testing.assert_allclose(rotation_exp(vector), expected, atol=1e-14)
        np.testing.assert_allclose(rotation_exp.py_func(vector), expected, atol=1e-14)


def test_rotation_log_inverts_exp():
    rng = np.random.default_rng(1)
    vectors = rng.uniform(-1.7, 1.7, (100, 3))
    for vector in vectors:
        np.testing.assert_allclose(rotation_log(rotation_exp(vector)), vector, atol=1e-12)


@pytest.mark.parametrize("angle", [0.0, 1e-12, 1e-8, 1e-3, 1.0, 2.5, 3.0, np.pi - 1e-6])
def test_rotation_log_is_scipys(angle):
    axes = np.concatenate([np.eye(3), -np.eye(3), np.random.default_rng(3).normal(size=(20, 3))])
    for axis in axes:
        matrix = Rotation.from_rotvec(angle * axis / np.linalg.norm(axis)).as_matrix()
        expected = Rotation.from_matrix(matrix).as_rotvec()
        np.testing.assert_allclose(rotation_log(matrix), expected, atol=1e-9)
        np.testing.assert_allclose(rotation_log.py_func(matrix), expected, atol=1e-9)


def random_transform(rng):
    return RigidTransform(Rotation.random(random_state=rng).as_matrix(), rng.normal(size=3))


def test_composition_inverse_and_application_follow_the_matrices():
    rng = np.random.default_rng(2)
    a_from_b, b_from_c = random_transform(rng), random_transform(rng)
    points = rng.normal(size=(5, 4, 3))
    a_from_c = a_from_b @ b_from_c
    np.testing.assert_allclose(a_from_c.matrix, a_from_b.matrix @ b_from_c.matrix, atol=1e-14)
    np.testing.assert_allclose(a_from_b.inverse.matrix, np.linalg.inv(a_from_b.matrix), atol=1e-14)
    homogeneous = np.concatenate([points, np.ones((5, 4, 1))], axis=2)
    expected = (homogeneous @ a_from_c.matrix.T)[..., :3]
    np.testing.assert_allclose(a_from_b.apply(b_from_c.apply(points)), expected, atol=1e-13)


def test_from_matrix_copies_and_takes_both_shapes():
    matrix = random_transform(np.random.default_rng(3)).matrix
    transform = RigidTransform.from_matrix(matrix[:3])
    np.testing.assert_array_equal(transform.matrix, matrix)
    kept = transform.matrix
    matrix[:] = 0.0
    np.testing.assert_array_equal(transform.matrix, kept)
    np.testing.assert_array_equal(RigidTransform.identity().matrix, np.eye(4))


def test_cross_matrix_times_a_vector_is_the_cross_product():
    rng = np.random.default_rng(4)
    one, other = rng.normal(size=(2, 5, 4, 3))
    found = np.einsum("...ij,...j->...i", cross_matrix(one), other)
    np.testing.assert_allclose(found, np.cross(one, other), atol=1e-15)
    np.testing.assert_array_equal(cross_matrix(one[2, 1]), cross_matrix(one)[2, 1])


KNOWN = SimilarityTransform(1.7, Rotation.from_rotvec([0.4, -1.1, 2.0]).as_matrix(), np.array([0.3, -2.0, 5.0]))


def points(n=40, seed=0):
    return np.random.default_rng(seed).normal(size=(n, 3)) * [1.0, 0.5, 0.2]


def test_a_known_similarity_is_found():
    found = fit_similarity(points(), KNOWN.apply(points()))
    assert found.scale == pytest.approx(1.7, rel=1e-12)
    np.testing.assert_allclose(found.rotation, KNOWN.rotation, atol=1e-12)
    np.testing.assert_allclose(found.translation, KNOWN.translation, atol=1e-12)


def test_rotation_of_noisy_points_is_scipys():
    rng = np.random.default_rng(1)
    target = KNOWN.apply(points()) + rng.normal(scale=0.2, size=(40, 3))
    expected, _ = Rotation.align_vectors(target - target.mean(axis=0), points() - points().mean(axis=0))
    for with_scale in (False, True):
        found = fit_similarity(points(), target, with_scale)
        np.testing.assert_allclose(found.rotation, expected.as_matrix(), atol=1e-7)
    # The scale is optimal: the sum of squares grows to both sides.
    sums = [
        (np.square(target - target.mean(axis=0) - scale * (points() - points().mean(axis=0)) @ found.rotation.T)).sum()
        for scale in (found.scale - 1e-4, found.scale, found.scale + 1e-4)
    ]
    assert sums[1] < min(sums[0], sums[2])


def test_points_in_a_plane_are_not_mirrored():
    flat = points() * [1.0, 1.0, 0.0]
    mirrored = flat * [-1.0, 1.0, 1.0]
    found = fit_similarity(flat, mirrored)
    assert np.linalg.det(found.rotation) == pytest.approx(1.0)
    # Turning by 180 degrees about y mirrors x in the plane.
    np.testing.assert_allclose(found.apply(flat), mirrored, atol=1e-12)


def test_composition_inverse_and_poses():
    other = SimilarityTransform(0.4, Rotation.from_euler("x", 1.0).as_matrix(), np.array([1.0, 2.0, 3.0]))
    np.testing.assert_allclose((KNOWN @ other).apply(points()), KNOWN.apply(other.apply(points())), atol=1e-12)
    np.testing.assert_allclose(KNOWN.inverse.apply(KNOWN.apply(points())), points(), atol=1e-12)
    np.testing.assert_array_equal(SimilarityTransform.identity().apply(points()), points())
    np.testing.assert_allclose((KNOWN @ other).matrix, KNOWN.matrix @ other.matrix, atol=1e-12)
    np.testing.assert_allclose(KNOWN.inverse.matrix, np.linalg.inv(KNOWN.matrix), atol=1e-12)


def test_points_that_fix_no_scale():
    with pytest.raises(ValueError, match="coincide"):
        fit_similarity(np.ones((5, 3)), points(5))
    with pytest.raises(ValueError, match="no points"):
        fit_similarity(np.zeros((0, 3)), np.zeros((0, 3)))
