"""Modes kept of a field: the best ones in each inner product, whole or by component."""

import numpy as np
import pytest

from morph_dslam.errors import StudyError
from morph_dslam.model import Parameter
from morph_dslam.reduction.task import ReductionTask
from morph_dslam.reduction.truncation import truncate
from morph_dslam.studies.problem import ModelMesh
from morph_dslam.studies.sections import ReductionSection
from morph_dslam.studies.solid_study import SolidStudy
from tests.unit.test_reduced_solver import BLOCK

RNG = np.random.default_rng(4)
WEIGHTS = RNG.random(15) / 15.0
FIELDS = RNG.standard_normal((6, 15, 3)) * np.array([1.0, 0.1, 0.01])
PARAMETERS = (Parameter("force", "force", "N", 0.0, 1.0, 0.0),)


def task(**options):
    mesh = ModelMesh(np.zeros((15, 3)), np.zeros((0, 3), dtype=np.int64), WEIGHTS)
    return ReductionTask(mesh, PARAMETERS, [], ReductionSection(**options))


def norm(fields):
    return np.sqrt(np.sum(WEIGHTS[:, None] * fields**2))


def test_truncation_is_that_of_the_singular_value_decomposition():
    """The fields are modes of their own; Eckart and Young: what is left out are the last singular values."""
    kept = truncate(task(tolerance=1e-6, max_modes=3), "displacement", FIELDS, np.eye(6))
    truth = np.linalg.svd((FIELDS * np.sqrt(WEIGHTS)[:, None]).reshape(6, -1), compute_uv=False)
    assert kept.singular_values == pytest.approx(truth)
    missed = np.tensordot(kept.rotation.T, kept.modes, axes=1) - FIELDS
    assert norm(missed) == pytest.approx(np.linalg.norm(truth[3:]))


def test_components_have_modes_of_their_own():
    kept = truncate(task(tolerance=1e-8, components="separate"), "displacement", FIELDS, np.eye(6))
    assert kept.components is not None
    assert np.bincount(kept.components).tolist() == [6, 6, 6]
    assert np.all(np.diff(kept.singular_values) <= 0.0)
    back = np.tensordot(kept.rotation.T, kept.modes, axes=1)
    assert back == pytest.approx(FIELDS, abs=1e-10)
    coarse = truncate(task(tolerance=0.05, components="separate"), "displacement", FIELDS, np.eye(6))
    assert set(coarse.components.tolist()) == {0, 1}, "the third component is 1 % of the first"


def test_energy_counts_by_the_stiffness_of_the_body():
    """Stretching by 1 % and translating by 1 m: only the first has energy, E A L strain^2 / 2 times two."""
    study = SolidStudy.model_validate(
        BLOCK | {"materials": {"r": {"law": "linear_elastic", "young": "3 MPa", "poisson": 0.0}}}
    )
    sweep, mesh = study.sweep_problem(), study.model_mesh()
    stretch, shift = np.zeros_like(mesh.nodes), np.ones_like(mesh.nodes)
    stretch[:, 2] = 0.01 * mesh.nodes[:, 2]
    options = ReductionSection(inner_product="energy", tolerance=1e-4)
    energy_task = ReductionTask(mesh, study.model_parameters(), [], options, problem=lambda: sweep)
    kept = truncate(energy_task, "displacement", np.array([shift, stretch]), np.eye(2))
    assert kept.singular_values[0] ** 2 == pytest.approx(3e6 * 0.02**2 * 0.04 * 0.01**2)
    assert len(kept.modes) == 1


def test_energy_needs_a_solid():
    with pytest.raises(StudyError, match="needs the stiffness of a solid"):
        truncate(task(inner_product="energy"), "displacement", FIELDS, np.eye(6))
