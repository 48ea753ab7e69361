"""Rotations and rigid transforms against SciPy and homogeneous matrices."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from morph_dslam.geometry import RigidTransform, cross_matrix, rotation_exp, rotation_log


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
