"""Sparse PGD on functions whose separation is known, and the method "sparse_pgd" on snapshots of known fields."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
from scipy.stats import qmc

from morph_dslam.errors import StudyError
from morph_dslam.model import Parameter
from morph_dslam.model.basis_functions import chebyshev_basis, hat_basis, kriging_basis, p_spline_basis
from morph_dslam.model.tensor_functions import CPFunctions
from morph_dslam.reduction.sparse_pgd import (
    SamplingWarning,
    SparsePgd,
    fit_sparse_pgd,
    reduce_by_sparse_pgd,
    smoothed_fit,
)
from morph_dslam.reduction.task import ReductionTask
from morph_dslam.studies.problem import ModelMesh, Snapshot
from morph_dslam.studies.sections import ReductionSection

SPACE = np.linspace(0.0, 1.0, 25)
MODES = np.stack([np.sin(np.pi * SPACE), SPACE**2])
NODES = np.linspace(-1.0, 1.0, 10)
BASES = {
    "chebyshev": chebyshev_basis(-1.0, 1.0, 9),
    "p-splines": p_spline_basis(-1.0, 1.0, 10),
    "kriging": kriging_basis(-1.0, 1.0, NODES, 1.0),
    "hats": hat_basis(NODES),
}


def ishigami(mu: np.ndarray) -> np.ndarray:
    """Ishigami's function on a shorter range, a sum of two products in space (n, 25).

    (sin a (1 + 0.1 c^4)) sin(pi X) + 7 sin^2 b X^2 with a, b, c = 2 mu.
    """
    a, b, c = (2.0 * mu).T
    return np.column_stack([np.sin(a) * (1.0 + 0.1 * c**4), 7.0 * np.sin(b) ** 2]) @ MODES


def ishigami_slope_of_c(mu: np.ndarray) -> np.ndarray:
    a, _, c = (2.0 * mu).T
    return np.outer(2.0 * np.sin(a) * 0.4 * c**3, MODES[0])


def samples(count: int, seed: int = 0) -> np.ndarray:
    """Scattered points, denser towards the faces of the box."""
    return -np.cos(np.pi * qmc.Halton(3, rng=seed).random(count))


def predicted(fit: SparsePgd, mu: np.ndarray) -> np.ndarray:
    return np.stack([fit.functions.evaluate(m)[0] for m in mu]) @ fit.pod.modes


def relative(error: np.ndarray, reference: np.ndarray) -> float:
    return float(np.linalg.norm(error) / np.linalg.norm(reference))


@pytest.mark.parametrize(
    ("name", "tolerance"), [("chebyshev", 4e-4), ("p-splines", 3e-3), ("kriging", 1e-2), ("hats", 3e-2)]
)
def test_ishigamis_function_is_found_from_scattered_samples(name: str, tolerance: float) -> None:
    mu, new = samples(150), np.random.default_rng(1).uniform(-0.95, 0.95, (100, 3))
    fit = fit_sparse_pgd(mu, ishigami(mu), (BASES[name],) * 3, max_modes=6)
    assert len(fit.pod.modes) == 2  # the field has two modes in space
    assert relative(predicted(fit, new) - ishigami(new), ishigami(new)) <= tolerance


def test_its_sensitivities_are_those_of_the_function() -> None:
    mu, new = samples(150), np.random.default_rng(1).uniform(-0.95, 0.95, (50, 3))
    fit = fit_sparse_pgd(mu, ishigami(mu), (BASES["chebyshev"],) * 3, max_modes=6)
    slopes = np.stack([fit.functions.evaluate(m)[1][2] for m in new]) @ fit.pod.modes
    assert relative(slopes - ishigami_slope_of_c(new), ishigami_slope_of_c(new)) <= 2e-3


def test_two_products_are_enough_for_a_sum_of_two() -> None:
    def field(mu: np.ndarray) -> np.ndarray:
        a, b, c = mu.T
        return np.column_stack([np.exp(a) * (1.0 + b) * c, (2.0 + a) * np.cos(b)]) @ MODES

    mu, new = samples(120), np.random.default_rng(2).uniform(-1.0, 1.0, (50, 3))
    fit = fit_sparse_pgd(mu, field(mu), (BASES["chebyshev"],) * 3, max_modes=2)
    assert len(fit.functions.mixing) == 2
    assert relative(predicted(fit, new) - field(new), field(new)) <= 1e-5


def test_noise_stops_the_enrichment_and_is_smoothed() -> None:
    """More products than the signal has would fit the noise: the samples kept aside must say so."""
    rng = np.random.default_rng(3)
    mu, new = samples(200), rng.uniform(-0.95, 0.95, (100, 3))
    scale = np.sqrt(np.mean(ishigami(mu) ** 2))
    noisy = ishigami(mu) + 0.05 * scale * rng.normal(size=(len(mu), len(SPACE)))
    fit = fit_sparse_pgd(mu, noisy, (BASES["p-splines"],) * 3, pod_tolerance=0.05)
    assert len(fit.functions.mixing) <= 9
    assert len(fit.functions.mixing) == min(fit.validation_errors, key=lambda n: fit.validation_errors[n])
    assert relative(predicted(fit, new) - ishigami(new), ishigami(new)) <= 0.03


def test_too_few_samples_are_warned_of() -> None:
    mu = samples(30)
    with pytest.warns(SamplingWarning, match="30 samples for . products of 10 functions"):
        fit_sparse_pgd(mu, ishigami(mu), (BASES["p-splines"],) * 3, max_modes=6)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        fit_sparse_pgd(samples(150), ishigami(samples(150)), (BASES["p-splines"],) * 3, max_modes=6)


def test_the_smoothing_weight_has_the_least_score_of_cross_validation() -> None:
    """Against GCV written out with the hat matrix on a fine grid of weights."""
    rng = np.random.default_rng(4)
    x = np.sort(rng.uniform(-1.0, 1.0, 80))
    y = np.sin(3.0 * x) + 0.1 * rng.normal(size=80)
    basis = p_spline_basis(-1.0, 1.0, 15)
    w, p = basis.evaluate(x), basis.penalty()
    scores, fits = [], []
    for weight in np.logspace(-8.0, 2.0, 400):
        hat = w @ np.linalg.solve(w.T @ w + weight * p, w.T)
        fits.append(hat @ y)
        scores.append(np.sum((y - hat @ y) ** 2) / (80.0 - np.trace(hat)) ** 2)
    found = w @ smoothed_fit(w.T @ w, w.T @ y, y @ y, 80, p)
    np.testing.assert_allclose(found, fits[int(np.argmin(scores))], atol=0.02)
    # and that is nearer the truth than the unsmoothed fit
    plain = w @ np.linalg.lstsq(w, y, rcond=None)[0]
    assert np.linalg.norm(found - np.sin(3.0 * x)) < np.linalg.norm(plain - np.sin(3.0 * x))


@pytest.mark.parametrize(("n_samples", "degree"), [(2, 20), (3, 8), (8, 8)])
def test_samples_that_are_met_exactly_end_the_enrichment(n_samples: int, degree: int) -> None:
    """Fewer samples than functions: after some products nothing is left, and no direction to enrich by."""
    mu = np.random.default_rng(5).random((n_samples, 2))
    values = np.cos(mu.sum(axis=1))[:, None] * MODES[0]
    bases = (chebyshev_basis(0.0, 1.0, degree),) * 2
    with pytest.warns(SamplingWarning):
        found = fit_sparse_pgd(mu, values, bases)
    fitted = np.stack([found.functions.evaluate(x)[0] for x in mu]) @ found.pod.modes
    np.testing.assert_allclose(fitted, values, atol=1e-4 * np.abs(values).max())


def test_one_parameter_is_allowed() -> None:
    x = np.linspace(-1.0, 1.0, 40)[:, None]
    field = np.column_stack([np.exp(x[:, 0]), np.cos(2.0 * x[:, 0])]) @ MODES
    fit = fit_sparse_pgd(x, field, (BASES["chebyshev"],), max_modes=3)
    assert predicted(fit, x) == pytest.approx(field, abs=1e-5)


PLACES = np.random.default_rng(1).uniform(0.0, 0.1, (12, 3))
MESH = ModelMesh(PLACES, np.array([[0, 1, 2]]), np.linspace(1.0, 2.0, 12) / 18.0)
FORCE = Parameter("force", "force", "N", 2.0, 10.0, 2.0)
TURN = Parameter("turn", "angle", "deg", 0.0, 2.0 * np.pi, 0.0)


def displacement(mu: np.ndarray) -> np.ndarray:
    """(12, 3), m: a sum of two products, periodic in the second parameter."""
    first = PLACES * mu[0] ** 2 * np.cos(mu[1])
    return 1e-3 * (first + PLACES[:, ::-1] / mu[0] * np.sin(2.0 * mu[1]))


def stress(mu: np.ndarray) -> np.ndarray:
    """(12, 6), Pa: one product."""
    return 1e5 * np.hstack([PLACES, PLACES**2]) * np.log(mu[0]) * (2.0 + np.sin(mu[1]))


def task(count: int, **options) -> ReductionTask:
    unit = qmc.Sobol(2, rng=0).random(count)
    samples = np.array([2.0, 0.0]) + unit * np.array([8.0, 2.0 * np.pi])
    snapshots = [Snapshot(mu, {"displacement": displacement(mu), "stress_solid": stress(mu)}) for mu in samples]
    return ReductionTask(
        MESH, (FORCE, TURN), [[s] for s in snapshots], ReductionSection(method="sparse_pgd", **options), "known"
    )


@pytest.mark.parametrize(
    ("basis", "size", "tolerance"),
    [
        ("chebyshev", 14, 1e-5),
        ("cubic_spline", 14, 1e-3),
        ("p_spline", 14, 1e-3),
        ("kriging", 14, 1e-3),
        ("hat", 20, 4e-2),
        ("fourier", 14, 1e-5),
    ],
)
def test_every_basis_recovers_the_fields_between_the_samples(basis: str, size: int, tolerance: float) -> None:
    model = reduce_by_sparse_pgd(task(256, basis=basis, max_degree=size - 1, max_modes=6))
    assert isinstance(model.displacement.functions, CPFunctions)
    assert model.displacement.n_modes >= 2
    rng = np.random.default_rng(5)
    for mu in np.column_stack([rng.uniform(2.5, 9.5, 20), rng.uniform(0.4, 5.9, 20)]):
        for field, truth in ((model.displacement, displacement), (model.stresses["solid"], stress)):
            scale = np.abs(truth(np.array([10.0, np.pi / 2.0 if truth is stress else 0.0]))).max()
            assert np.abs(field.value(mu) - truth(mu)).max() <= tolerance * scale
    assert model.certificate["reduction"]["basis"] == basis


def test_too_few_samples_are_a_note_of_the_certificate_and_no_warning_of_python() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        model = reduce_by_sparse_pgd(task(16, max_degree=10, max_modes=4))
    notes = model.certificate["reduction"]["warnings"]
    assert len(notes) == 2
    assert all("give at least" in note for note in notes)
    assert notes[1].startswith("stress_solid: 16 samples for")


def test_fourier_functions_without_a_full_turn_are_refused() -> None:
    without = task(16, basis="fourier")
    half = Parameter("turn", "angle", "deg", 0.0, np.pi, 0.0)
    with pytest.raises(StudyError, match=r"full turn.*chebyshev"):
        reduce_by_sparse_pgd(ReductionTask(MESH, (FORCE, half), without.groups, without.options, "known"))
