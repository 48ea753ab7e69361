"""Sampling schemes and the greedy choice of samples against what they promise."""

from __future__ import annotations

import itertools
import tomllib
from typing import Any

import numpy as np
import pytest

from morph_dslam.errors import StudyError
from morph_dslam.reduction.adaptive_sampling import worst_candidates
from morph_dslam.studies.problem import bounds
from morph_dslam.studies.sampling import candidate_samples, held_out_samples, training_samples
from morph_dslam.studies.solid_study import SolidStudy
from morph_dslam.studies.study import make_study
from tests.support.block_study import STUDY


def study(sampling: dict[str, Any], parameters: int = 3) -> SolidStudy:
    names = ("pull", "push", "lift")[:parameters]
    ranges = (("0 kPa", "600 kPa"), ("-30 kPa", "30 kPa"), ("10 kPa", "20 kPa"))
    made = make_study(
        tomllib.loads(STUDY)
        | {
            "materials": {"rubber": {"law": "neo_hookean", "young": "3 MPa", "poisson": 0.3}},
            "loads": [],
            "parameters": {name: {"range": ends} for name, ends in zip(names, ranges, strict=False)},
            "sampling": sampling,
        }
    )
    assert isinstance(made, SolidStudy)
    return made


@pytest.mark.parametrize("fewer", [8, 11, 64, 100])
def test_more_sobol_samples_contain_the_fewer(fewer: int) -> None:
    few = training_samples(study({"scheme": "sobol", "training": fewer, "seed": 3}))
    many = training_samples(study({"scheme": "sobol", "training": 257, "seed": 3}))
    assert few.shape == (fewer, 3)
    np.testing.assert_array_equal(many[:fewer], few)
    np.testing.assert_array_equal(few[0], [0.0, 0.0, 1e4], "the defaults come first")
    assert len(np.unique(many, axis=0)) == 257


def test_more_held_out_samples_contain_the_fewer_and_are_uniform_and_independent() -> None:
    few, many = (held_out_samples(study({"held_out": count})) for count in (59, 4096))
    np.testing.assert_array_equal(many[:59], few)
    lower, upper = bounds(study({})).T
    unit = (many - lower) / (upper - lower)
    # 512 are expected in every eighth of an axis, with the binomial standard deviation of independent ones;
    # a Sobol net would hold them to the sample.
    for axis in unit.T:
        deviations = (np.histogram(axis, bins=8, range=(0.0, 1.0))[0] - 512) / np.sqrt(4096 * 7 / 64)
        assert np.abs(deviations).max() < 4.0
        assert np.abs(deviations).max() > 0.5


def test_adaptive_sampling_starts_with_the_first_and_chooses_among_those_that_follow() -> None:
    adaptive = study({"scheme": "adaptive", "training": 64, "first": 10})
    scattered = training_samples(study({"scheme": "sobol", "training": 65}))[1:]
    np.testing.assert_array_equal(training_samples(adaptive), scattered[:10])
    np.testing.assert_array_equal(candidate_samples(adaptive, 30), scattered[10:40])
    np.testing.assert_array_equal(candidate_samples(adaptive, 54), scattered[10:])


def test_a_grid_has_all_combinations_with_both_ends() -> None:
    samples = training_samples(study({"scheme": "grid", "points": [4, 3, 2]}))
    axes = [[0.0, 2e5, 4e5, 6e5], [-3e4, 0.0, 3e4], [1e4, 2e4]]
    np.testing.assert_allclose(samples, list(itertools.product(*axes)), rtol=1e-12, atol=1e-9)
    same = training_samples(study({"scheme": "grid", "points": 3}))
    assert same.shape == (27, 3)


def test_even_samples_are_evenly_spaced() -> None:
    samples = training_samples(study({"scheme": "even", "training": 13}, parameters=1))
    np.testing.assert_allclose(samples, 5e4 * np.arange(13.0)[:, None])


@pytest.mark.parametrize(
    ("sampling", "message"),
    [
        ({"scheme": "even"}, r"for one parameter, and this study has 3"),
        ({"scheme": "grid", "points": [4, 3]}, r"points has 2 numbers, .* 3 parameters \(pull, push, lift\)"),
        ({"scheme": "grid", "points": 50}, r"125000 points, more than 100000"),
        ({"scheme": "grid"}, r"sampling: scheme = \"grid\" needs points"),
        ({"scheme": "grid", "points": 1}, r"at least 2 points along each"),
        ({"scheme": "grid", "points": 3, "training": 9}, r"leave out training"),
        ({"scheme": "sobol", "points": 3}, r"points are those of scheme = \"grid\""),
        ({"scheme": "sobol", "first": 8}, r"first is for scheme = \"adaptive\""),
        ({"scheme": "adaptive", "first": 20, "training": 10}, r"first must be at most training"),
    ],
)
def test_schemes_that_do_not_fit_are_refused(sampling: dict[str, Any], message: str) -> None:
    with pytest.raises(StudyError, match=message):
        training_samples(study(sampling))


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
