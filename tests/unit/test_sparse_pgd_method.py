"""The method "sparse_pgd" on snapshots of fields that are known in closed form."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
from scipy.stats import qmc

from morph_dslam.errors import StudyError
from morph_dslam.model import Parameter
from morph_dslam.model.tensor_functions import CPFunctions
from morph_dslam.reduction.sparse_pgd import reduce_by_sparse_pgd
from morph_dslam.reduction.task import ReductionTask
from morph_dslam.studies.problem import ModelMesh, Snapshot
from morph_dslam.studies.sections import ReductionSection

NODES = np.random.default_rng(1).uniform(0.0, 0.1, (12, 3))
MESH = ModelMesh(NODES, np.array([[0, 1, 2]]), np.linspace(1.0, 2.0, 12) / 18.0)
FORCE = Parameter("force", "force", "N", 2.0, 10.0, 2.0)
TURN = Parameter("turn", "angle", "deg", 0.0, 2.0 * np.pi, 0.0)


def displacement(mu: np.ndarray) -> np.ndarray:
    """(12, 3), m: a sum of two products, periodic in the second parameter."""
    first = NODES * mu[0] ** 2 * np.cos(mu[1])
    return 1e-3 * (first + NODES[:, ::-1] / mu[0] * np.sin(2.0 * mu[1]))


def stress(mu: np.ndarray) -> np.ndarray:
    """(12, 6), Pa: one product."""
    return 1e5 * np.hstack([NODES, NODES**2]) * np.log(mu[0]) * (2.0 + np.sin(mu[1]))


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
