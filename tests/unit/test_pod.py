"""POD and the modes kept of a field, against numpy's singular value decomposition."""

from __future__ import annotations

import numpy as np
import pytest

from morph_dslam.reduction.pod import compute_pod, truncate

N = 300


def decaying(n_snapshots: int, rate: float, seed: int = 0) -> np.ndarray:
    """Snapshots (n_snapshots, N) of singular values rate**i with random directions."""
    rng = np.random.default_rng(seed)
    k = min(n_snapshots, N)
    left = np.linalg.qr(rng.normal(size=(n_snapshots, k)))[0]
    right = np.linalg.qr(rng.normal(size=(N, k)))[0]
    return (left * rate ** np.arange(k)) @ right.T


@pytest.mark.parametrize("tolerance", [1e-4, 0.03, 0.3])
def test_modes_in_weights_are_those_of_numpy(tolerance: float) -> None:
    weights = np.random.default_rng(4).uniform(0.5, 2.0, N)
    snapshots = decaying(40, 0.6)
    pod = compute_pod(snapshots, weights, tolerance, 30)
    _, values, right = np.linalg.svd(snapshots * np.sqrt(weights), full_matrices=False)
    np.testing.assert_allclose(pod.singular_values, values, rtol=1e-10, atol=1e-14)
    overlap = np.abs(np.sum(pod.modes * np.sqrt(weights) * right[: len(pod.modes)], axis=1))
    np.testing.assert_allclose(overlap, 1.0, atol=1e-9)
    missed = np.linalg.norm((snapshots - pod.project(snapshots) @ pod.modes) * np.sqrt(weights))
    count = len(pod.modes)
    assert missed == pytest.approx(np.linalg.norm(values[count:]), rel=1e-8)
    assert missed <= tolerance * np.linalg.norm(values) < np.linalg.norm(values[count - 1 :])


def test_a_sum_of_three_fields_has_three_modes() -> None:
    rng = np.random.default_rng(6)
    snapshots = (rng.normal(size=(40, 3)) * [10.0, 1.0, 0.1]) @ rng.normal(size=(3, N))
    pod = compute_pod(snapshots, np.ones(N), 1e-10, 20)
    assert len(pod.modes) == 3
    assert pod.project(snapshots) @ pod.modes == pytest.approx(snapshots, abs=1e-9)


def test_fields_that_are_zero_everywhere_have_one_mode() -> None:
    pod = compute_pod(np.zeros((6, N)), np.ones(N), 1e-3, 5)
    assert len(pod.modes) == 1
    np.testing.assert_array_equal(pod.project(np.zeros((6, N))), 0.0)


def test_truncation_is_that_of_the_singular_value_decomposition() -> None:
    """The fields are modes of their own; Eckart and Young: what is left out are the last singular values."""
    rng = np.random.default_rng(4)
    weights = rng.random(15) / 15.0
    fields = rng.standard_normal((6, 15, 3)) * np.array([1.0, 0.1, 0.01])
    kept = truncate(fields, np.eye(6), weights, 1e-6, 3)
    truth = np.linalg.svd((fields * np.sqrt(weights)[:, None]).reshape(6, -1), compute_uv=False)
    assert kept.singular_values == pytest.approx(truth)
    missed = np.tensordot(kept.rotation.T, kept.modes, axes=1) - fields
    assert np.sqrt(np.sum(weights[:, None] * missed**2)) == pytest.approx(np.linalg.norm(truth[3:]))
