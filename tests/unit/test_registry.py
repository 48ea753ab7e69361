"""A method of reduction and a law of one's own: registered in a few lines, and named in a study."""

import tomllib
from dataclasses import replace
from typing import ClassVar

import ngsolve as ngs
import numpy as np
import pytest

from morph_dslam import build, make_study
from morph_dslam.errors import ArgumentError, StudyError
from morph_dslam.extend import register_law, register_reduction
from morph_dslam.mechanics.materials import base
from morph_dslam.mechanics.materials.base import Constant
from morph_dslam.mechanics.materials.isotropic import Rubber, first_invariant
from morph_dslam.mechanics.materials.library import laws
from morph_dslam.mechanics.solvers.continuation import advance
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


def test_a_method_of_ones_own_builds_a_model(registered, tmp_path, monkeypatch):
    """Small loads move a block in proportion to them; nothing is written unless a file is named."""
    monkeypatch.chdir(tmp_path)
    content = tomllib.loads(STUDY) | {
        "parameters": {"pull": {"range": ["0 kPa", "20 kPa"]}, "push": {"range": ["-0.1 kPa", "0.1 kPa"]}},
        "materials": {"rubber": {"law": "neo_hookean", "young": "3 MPa", "poisson": 0.3}},
        "sampling": {"training": 8, "held_out": 4, "refined": 0},
        "reduction": {"method": "planes"},
    }
    model = build(make_study(content))
    assert list(tmp_path.iterdir()) == []
    assert model.certificate["reduction"]["method"] == "planes"
    assert model.certificate["displacement"]["relative_l2"] < 2e-2
    stretch = np.ptp(model.at({"pull": 2e4}).positions()[:, 2]) / 0.06 - 1.0
    assert stretch == pytest.approx(2e4 / 3e6, rel=0.05)


def test_a_name_that_nobody_registered_is_refused_with_those_known(registered):
    external = {"name": "runs", "external": {"table": "t.csv", "length_unit": "mm"}, "reduction": {"method": "krylov"}}
    with pytest.raises(StudyError, match=r"krylov.*galerkin, planes, pod, reduced_basis, sparse_pgd"):
        make_study(external)


@pytest.mark.parametrize("name", ["galerkin", "reduced_basis", "pod", "sparse_pgd"])
def test_built_in_methods_are_not_replaced(registered, name):
    before = registry.reduction_method(name)
    with pytest.raises(ArgumentError, match=f"'{name}' is a built-in method of reduction"):
        register_reduction(name, reduce_by_planes)
    assert registry.reduction_method(name) is before
    assert set(registry.reduction_methods()) == {*registry._BUILT_IN, "planes"}


def spoilt(change):
    """The method of planes with its displacement changed."""

    def reduce(task):
        model = reduce_by_planes(task)
        field = model.displacement
        return replace(model, displacement=SeparatedField(change(field.modes), field.functions))

    return reduce


@pytest.mark.slow
@pytest.mark.parametrize(
    ("reduce", "message"),
    [
        (lambda task: None, r"method of reduction 'mine' returned an object of type NoneType: return task\.model\("),
        (lambda task: task.model({}, {}), "the fields of a reduced model are none: give those of task.field_names"),
        (spoilt(lambda modes: modes[:, :5]), r"'displacement' of shape \(5, 3\), and that of a solution is \(44, 3\)"),
        (spoilt(lambda modes: np.nan * modes), "the field 'displacement' with values that are not finite"),
        (spoilt(lambda modes: np.where(modes == modes.max(), np.inf, modes)), "values that are not finite"),
    ],
)
def test_what_a_method_returns_is_checked(registered, reduce, message):
    register_reduction("mine", reduce)
    sampling = {"training": 8, "held_out": 4, "refined": 0}
    study = make_study(tomllib.loads(STUDY) | {"sampling": sampling, "reduction": {"method": "mine"}})
    with pytest.raises(StudyError, match=message):
        build(study)


@pytest.mark.parametrize("workers", ["2", 0, -1, 1.5])
def test_workers_are_counted(workers):
    with pytest.raises(ArgumentError, match=r"workers is .*: give a number of processes from 1 on"):
        build(make_study(tomllib.loads(STUDY)), workers=workers)


STRIP = {
    "name": "strip",
    "mesh": {"generator": "block", "size": ["1 m"] * 3, "divisions": [1, 1, 1], "cells": "hex20"},
    "materials": {"skin": {"law": "demiray", "mu": "20 kPa", "growth": 0.3, "bulk": "1 GPa"}},
    "supports": [
        {"kind": "displacement", "on": f"{axis}_min", axis: "0 m"} for axis in "xyz"
    ] + [{"kind": "displacement", "on": "x_max", "x": "pull"}],
    "parameters": {"pull": {"range": ["0 m", "1 m"]}},
    "solver": {"formulation": "mixed", "threads": 1},
}  # fmt: skip


@pytest.fixture
def own_laws(monkeypatch):
    """Laws that are registered meanwhile, forgotten afterwards."""
    monkeypatch.setattr(base, "_LAWS", dict(base._LAWS))


def test_a_law_that_cannot_be_one_is_refused_and_the_built_in_stays(own_laws):
    class Own(Rubber):
        mu: Constant

    class Whole(Own):
        def distortional(self, F, J):
            return 0.5 * self.mu * (first_invariant(F, J) - 3.0)

    class Measured(Whole):
        quantities: ClassVar = {"mu": "furlong"}

    before = laws()
    for name, law, message in (
        ("neo_hookean", Whole, "'neo_hookean' is a built-in law: register yours by another name"),
        ("own", Own, "the law 'own' has no method distortional: define it in the class Own"),
        ("own", Measured, r"the law 'own' has quantities = {'mu': 'furlong'}: give one of length, stress"),
    ):
        with pytest.raises(ArgumentError, match=message):
            register_law(name)(law)
        assert laws() == before
    register_law("own")(Whole)

    @register_law("own")
    class Again(Own):
        def distortional(self, F, J):
            return self.mu * (first_invariant(F, J) - 3.0)

    assert laws() == before | {"own": Again}


def test_a_law_of_ones_own_is_named_in_a_study_and_solved(own_laws):
    @register_law("demiray")
    class Demiray(Rubber):
        """W = mu / 2b (exp(b (I1~ - 3)) - 1) + kappa/2 (J - 1)^2: Demiray, J. Biomech. 5, 1972."""

        mu: Constant
        growth: Constant
        quantities: ClassVar = {"growth": "ratio"}

        def distortional(self, F, J):
            return 0.5 * self.mu / self.growth * (ngs.exp(self.growth * (first_invariant(F, J) - 3.0)) - 1.0)

    problem = make_study(STRIP).problem()
    state = advance(problem, problem.initial_state(), np.array([0.6]))[-1]
    force = problem.reactions(state.dofs, state.mu, "x_max")[0][0]
    # Uniaxial and incompressible: P = mu exp(b (I1 - 3)) (l - l^-2).
    stretch, first = 1.6, 1.6**2 + 2.0 / 1.6
    assert force == pytest.approx(2e4 * np.exp(0.3 * (first - 3.0)) * (stretch - stretch**-2), rel=1e-4)
