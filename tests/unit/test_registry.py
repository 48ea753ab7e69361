"""A method of reduction of one's own: registered in a few lines, and named in a study."""

import tomllib

import numpy as np
import pytest

from morph_dslam import build, make_study
from morph_dslam.errors import StudyError
from morph_dslam.extend import register_reduction
from morph_dslam.model import SeparatedField
from morph_dslam.model.functions import ParameterFunctions, total_degree_indices
from morph_dslam.reduction import registry
from tests.support.block_study import STUDY


def reduce_by_planes(task):
    """Each field as a linear function of the parameters: the snapshots' least-squares planes."""
    lower, upper = task.box.T
    indices = total_degree_indices(len(lower), 1)
    functions = ParameterFunctions(lower, upper, indices, np.eye(len(indices)))
    rows = np.array([functions.evaluate(mu)[0] for mu in task.samples])
    fields = {
        name: SeparatedField(np.tensordot(np.linalg.pinv(rows), task.values(name), axes=1), functions)
        for name in task.field_names
    }
    return task.model(fields, {"method": "planes"})


@pytest.fixture
def registered(monkeypatch):
    monkeypatch.setattr(registry, "_methods", dict(registry.reduction_methods()))
    register_reduction("planes", reduce_by_planes)


def test_a_method_of_ones_own_builds_a_model(registered, tmp_path):
    """Small loads move a block in proportion to them."""
    content = tomllib.loads(STUDY) | {
        "parameters": {"pull": {"range": ["0 kPa", "20 kPa"]}, "push": {"range": ["-0.1 kPa", "0.1 kPa"]}},
        "materials": {"rubber": {"law": "neo_hookean", "young": "3 MPa", "poisson": 0.3}},
        "sampling": {"training": 8, "held_out": 4},
        "reduction": {"method": "planes"},
    }
    model = build(make_study(content), tmp_path / "block.morph")
    assert model.certificate["reduction"]["method"] == "planes"
    assert model.certificate["displacement"]["relative_l2"] < 2e-2
    stretch = np.ptp(model.at({"pull": 2e4}).positions()[:, 2]) / 0.06 - 1.0
    assert stretch == pytest.approx(2e4 / 3e6, rel=0.05)


def test_a_name_that_nobody_registered_is_refused_with_those_known(registered):
    external = {"name": "runs", "external": {"table": "t.csv", "length_unit": "mm"}, "reduction": {"method": "krylov"}}
    with pytest.raises(StudyError, match=r"krylov.*galerkin, planes, pod, reduced_basis, sparse_pgd"):
        make_study(external)
