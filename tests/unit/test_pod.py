"""POD against numpy's singular value decomposition, generalised eigenvalues and the errors it promises."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.linalg
import scipy.sparse

from morph_dslam.reduction.pod import compute_pod, hierarchical_pod
from morph_dslam.reduction.task import FieldRows
from morph_dslam.studies.problem import Snapshot
from morph_dslam.studies.snapshots import load_snapshot, save_snapshot

N = 300


def decaying(n_snapshots: int, rate: float, seed: int = 0) -> np.ndarray:
    """Snapshots (n_snapshots, N) of singular values rate**i with random directions."""
    rng = np.random.default_rng(seed)
    k = min(n_snapshots, N)
    left = np.linalg.qr(rng.normal(size=(n_snapshots, k)))[0]
    right = np.linalg.qr(rng.normal(size=(N, k)))[0]
    return (left * rate ** np.arange(k)) @ right.T


def stiffness() -> scipy.sparse.csr_array:
    """Springs in a row, held at one end, their stiffnesses over three decades: positive definite."""
    springs = 10.0 ** np.random.default_rng(1).uniform(0.0, 3.0, N)
    diagonal = springs + np.append(springs[1:], 0.0)
    return scipy.sparse.diags_array([-springs[1:], diagonal, -springs[1:]], offsets=[-1, 0, 1]).tocsr()


def norm(fields: np.ndarray, matrix) -> float:
    return float(np.sqrt(np.sum(fields * (fields @ matrix))))


def test_modes_in_weights_are_those_of_numpy() -> None:
    weights = np.random.default_rng(4).uniform(0.5, 2.0, N)
    snapshots = decaying(40, 0.6)
    pod = compute_pod(snapshots, weights, 1e-4, 30)
    _, values, right = np.linalg.svd(snapshots * np.sqrt(weights), full_matrices=False)
    np.testing.assert_allclose(pod.singular_values, values, rtol=1e-10, atol=1e-14)
    overlap = np.abs(np.sum(pod.modes * np.sqrt(weights) * right[: len(pod.modes)], axis=1))
    np.testing.assert_allclose(overlap, 1.0, atol=1e-9)


def test_modes_in_the_energy_are_generalised_eigenvectors() -> None:
    """Singular values against scipy's eigenvalues of S K S', error against the sum of those left out."""
    snapshots, matrix = decaying(25, 0.7), stiffness()
    pod = compute_pod(snapshots, matrix, 1e-3, 30)
    np.testing.assert_allclose(pod.modes @ matrix @ pod.modes.T, np.eye(len(pod.modes)), atol=1e-11)
    eigenvalues = scipy.linalg.eigvalsh(snapshots @ matrix @ snapshots.T)[::-1]
    large = eigenvalues > 1e-10 * eigenvalues[0]
    np.testing.assert_allclose(pod.singular_values[large] ** 2, eigenvalues[large], rtol=1e-5)
    missed = norm(snapshots - pod.project(snapshots) @ pod.modes, matrix)
    assert missed == pytest.approx(np.sqrt(np.sum(pod.singular_values[len(pod.modes) :] ** 2)), rel=1e-8)
    assert missed <= 1e-3 * norm(snapshots, matrix)
    # No basis of as many vectors does better, and the one for equal weights does worse in this norm.
    plain = compute_pod(snapshots, np.ones(N), 0.0, len(pod.modes)).modes
    factor = np.linalg.cholesky(plain @ matrix @ plain.T)
    orthonormal = np.linalg.solve(factor, plain)
    worse = snapshots - (snapshots @ matrix @ orthonormal.T) @ orthonormal
    assert norm(worse, matrix) > missed


def test_a_matrix_that_is_not_positive_definite_is_refused() -> None:
    with pytest.raises(ValueError, match="not positive definite"):
        compute_pod(decaying(5, 0.5), scipy.sparse.diags_array(np.linspace(-1.0, -2.0, N)).tocsr(), 1e-3, 5)


@pytest.mark.parametrize("energy", [False, True])
@pytest.mark.parametrize("rate", [0.7, 0.9])
def test_blocks_give_the_modes_of_all_at_once(energy: bool, rate: float) -> None:
    """To the tolerance: equal leading singular values and spaces, and never a larger error than promised."""
    snapshots, tolerance = decaying(230, rate), 1e-3
    inner = stiffness() if energy else np.random.default_rng(4).uniform(0.5, 2.0, N)
    matrix = inner if energy else scipy.sparse.diags_array(inner)
    direct = compute_pod(snapshots, inner, tolerance, 300)
    memory = 3 * 8 * snapshots.size / 5.5
    blocked = compute_pod(snapshots, inner, tolerance, 300, memory)
    assert 0.0 < blocked.error_bound < 0.1 * tolerance
    assert len(direct.modes) <= len(blocked.modes) <= len(direct.modes) + 2
    total = norm(snapshots, matrix)
    missed = norm(snapshots - blocked.project(snapshots) @ blocked.modes, matrix)
    assert missed <= tolerance * total
    # Truncation can lower a singular value by at most what it leaves out (Weyl).
    count = len(direct.modes)
    lowered = direct.singular_values[:count] - blocked.singular_values[:count]
    assert np.all(lowered > -1e-12 * total)
    assert lowered.max() <= blocked.error_bound * total
    missed_modes = direct.modes[:5] - blocked.project(direct.modes[:5]) @ blocked.modes
    assert norm(missed_modes, matrix) < 1e-3


def test_the_error_bound_holds_for_a_crude_tolerance() -> None:
    snapshots = decaying(200, 0.9, seed=2)
    for tolerance in (0.3, 0.03):
        blocks = np.array_split(snapshots, 13)
        pod = hierarchical_pod(iter(blocks), 13, np.ones(N), tolerance, 300)
        missed = np.linalg.norm(snapshots - pod.project(snapshots) @ pod.modes)
        kept = np.sqrt(np.sum(pod.singular_values[len(pod.modes) :] ** 2))
        bound = np.hypot(kept, pod.error_bound * np.linalg.norm(snapshots))
        assert missed <= bound * (1.0 + 1e-12)
        assert bound <= tolerance * np.linalg.norm(snapshots)


def test_blocks_are_read_one_at_a_time(tmp_path) -> None:
    """An array on disk in single precision: no more than a few blocks of it are in memory together."""
    snapshots = decaying(256, 0.8).astype(np.float32)
    file = tmp_path / "snapshots.f32"
    snapshots.tofile(file)
    on_disk = np.memmap(file, dtype=np.float32, mode="r", shape=snapshots.shape)
    pod = compute_pod(on_disk, np.ones(N), 1e-4, 300, memory=3 * 8 * snapshots.size / 8)
    assert pod.error_bound > 0.0
    missed = np.linalg.norm(snapshots - pod.project(snapshots) @ pod.modes)
    assert missed <= 1e-4 * np.linalg.norm(snapshots)


def test_a_field_of_snapshots_on_disk_is_gathered_in_blocks(tmp_path) -> None:
    """As few rows at a time as the memory allows, and the modes of numpy's decomposition of all."""
    fields = decaying(96, 0.5).astype(np.float32)
    for number, field in enumerate(fields):
        snapshot = Snapshot(np.array([float(number)]), {"displacement": field.reshape(-1, 3)})
        save_snapshot(tmp_path / f"{number}.npz", snapshot, {})
    kept = [load_snapshot(tmp_path / f"{number}.npz") for number in range(len(fields))]
    gathered: list[int] = []

    class Counting(FieldRows):
        def __getitem__(self, rows: slice) -> np.ndarray:
            gathered.append(len(range(*rows.indices(self.shape[0]))))
            return super().__getitem__(rows)

    pod = compute_pod(Counting(kept, "displacement"), np.ones(N), 1e-3, 50, memory=3 * 8 * fields.size / 3)
    assert max(gathered) <= 8
    assert sum(gathered) == 96
    _, values, right = np.linalg.svd(fields.astype(float), full_matrices=False)
    np.testing.assert_allclose(pod.singular_values[:5], values[:5], rtol=1e-6)
    np.testing.assert_allclose(np.abs(np.sum(pod.modes[:5] * right[:5], axis=1)), 1.0, atol=1e-6)


def test_fields_that_are_zero_everywhere_have_one_mode() -> None:
    for memory in (1e9, 1e4):
        pod = compute_pod(np.zeros((6, N)), np.ones(N), 1e-3, 5, memory)
        assert len(pod.modes) == 1
        np.testing.assert_array_equal(pod.project(np.zeros((6, N))), 0.0)
