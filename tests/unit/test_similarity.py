"""Similarity transforms against known motions and SciPy's alignment."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from morph_dslam.geometry import RigidTransform, SimilarityTransform, fit_similarity

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
    # A camera's centre moves as a point; its axes turn.
    pose = RigidTransform(other.rotation, other.translation)
    moved = KNOWN.apply_to_pose(pose)
    np.testing.assert_allclose(moved.translation, KNOWN.apply(pose.translation))
    np.testing.assert_allclose(moved.rotation[:, 2], KNOWN.rotation @ pose.rotation[:, 2])


def test_points_that_fix_no_scale():
    with pytest.raises(ValueError, match="coincide"):
        fit_similarity(np.ones((5, 3)), points(5))
    with pytest.raises(ValueError, match="no points"):
        fit_similarity(np.zeros((0, 3)), np.zeros((0, 3)))
