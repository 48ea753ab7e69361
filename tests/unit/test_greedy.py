"""The greedy choice of samples against the exact one on a space whose best approximations are known."""

from __future__ import annotations

import numpy as np

from morph_dslam.reduction.adaptive_sampling import worst_candidates

NOTHING_KNOWN = np.full(5, np.inf)


def test_the_largest_are_chosen_in_their_order() -> None:
    values = [0.3, 0.9, 0.1, 0.8, np.inf]
    chosen, estimates = worst_candidates(values.__getitem__, NOTHING_KNOWN, 3)
    assert chosen.tolist() == [4, 1, 3]
    assert estimates.tolist() == values


def test_candidates_that_cannot_be_largest_keep_their_old_estimate() -> None:
    asked: list[int] = []

    def estimate(index: int) -> float:
        asked.append(index)
        return [0.1, 0.5, 0.2, 0.2, 0.0][index]

    chosen, estimates = worst_candidates(estimate, np.array([0.9, 0.6, 0.55, 0.3, -np.inf]), 1)
    assert chosen.tolist() == [1]
    assert asked == [0, 1, 2], "0.3 and what is out of the choice cannot exceed 0.5"
    assert estimates.tolist() == [0.1, 0.5, 0.2, 0.3, -np.inf]


def test_no_more_are_chosen_than_there_are() -> None:
    chosen, _ = worst_candidates(lambda index: 1.0, np.array([np.inf, -np.inf, np.inf]), 4)
    assert chosen.tolist() == [0, 2]


def test_the_lazy_choice_is_the_full_one_for_orthogonal_projection() -> None:
    """Projection errors never grow, so that the assumption holds: Gram-Schmidt with pivoting."""
    rng = np.random.default_rng(0)
    vectors = rng.standard_normal((40, 12)) * 0.5 ** np.arange(12)
    basis = np.zeros((0, 12))
    known, calls = np.full(40, np.inf), 0
    for _ in range(8):
        errors = np.linalg.norm(vectors - vectors @ basis.T @ basis, axis=1)

        def estimate(index: int, errors: np.ndarray = errors) -> float:
            nonlocal calls
            calls += 1
            return float(errors[index])

        chosen, known = worst_candidates(estimate, known, 1)
        assert chosen[0] == np.argmax(errors)
        new = vectors[chosen[0]] - basis.T @ (basis @ vectors[chosen[0]])
        basis = np.vstack([basis, new / np.linalg.norm(new)])
    assert calls < 0.75 * 8 * 40
