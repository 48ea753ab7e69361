"""The method "pgd" on tiny linear solids, against direct solves of the same finite elements."""

from __future__ import annotations

import numpy as np
import pytest

from morph_dslam import make_study
from morph_dslam.errors import StudyError
from morph_dslam.mechanics.solid import SolidProblem
from morph_dslam.model import ReducedModel
from morph_dslam.reduction.pgd_method import reduce_by_pgd
from morph_dslam.reduction.task import ReductionTask
from morph_dslam.studies.solid_study import SolidStudy
from morph_dslam.studies.solid_sweep import support_reactions

BLOCK = {"generator": "block", "size": ["100 mm", "10 mm", "10 mm"], "divisions": [6, 1, 1]}
FIXED = {"kind": "fixed", "on": "x_min"}
MOVING = {
    "kind": "moving_patch",
    "on": "z_max",
    "force": ["0 N", "0 N", "-1 * push"],
    "centre": ["place", "5 mm", "10 mm"],
    "width": "8 mm",
}
BED = {"kind": "foundation", "on": "z_min", "stiffness": "bed"}
STEEL = {"law": "linear_elastic", "young": "1 GPa", "poisson": 0.3}
PLACE, PUSH = {"range": ["20 mm", "90 mm"]}, {"range": ["-1 N", "2 N"]}
STIFF_BED = {"range": ["0.01 MPa/mm", "0.1 MPa/mm"]}


def cantilever(**sections) -> SolidStudy:
    """100 mm long, clamped at one end, on an elastic bed, a force moving along it; six cells."""
    content = {
        "name": "cantilever",
        "mesh": BLOCK,
        "materials": {"steel": STEEL},
        "supports": [FIXED, BED],
        "loads": [MOVING],
        "parameters": {"place": PLACE, "push": PUSH, "bed": STIFF_BED},
        "solver": {"threads": 1},
        "reduction": {"method": "pgd", "max_modes": 30, "tolerance": 1e-3},
    }
    study = make_study(content | sections)
    assert isinstance(study, SolidStudy)
    return study


def reduce(study: SolidStudy) -> ReducedModel:
    parameters = study.model_parameters()
    task = ReductionTask(study.model_mesh(), parameters, [], study.reduction, "it", study.sweep_problem)
    return reduce_by_pgd(task)


def solve(problem: SolidProblem, mu: np.ndarray) -> np.ndarray:
    """One linear solve from the prescribed displacements."""
    start = problem.prescribed(mu)
    tangent = problem.linearise(start, mu)
    return start - tangent.solve(tangent.residual)


def anywhere(model: ReducedModel, count: int) -> np.ndarray:
    unit = np.random.default_rng(11).random((count, len(model.parameters)))
    return model.lower + unit * (model.upper - model.lower)


def relative(found: np.ndarray, truth: np.ndarray) -> float:
    return float(np.linalg.norm(found - truth) / np.linalg.norm(truth))


@pytest.fixture(scope="module")
def bedded() -> tuple[ReducedModel, SolidProblem]:
    study = cantilever()
    return reduce(study), study.problem()


def test_every_field_is_that_of_direct_solves(bedded) -> None:
    """The strains here are 1e-5, so the linear theory is exact to more than the tolerances."""
    model, problem = bedded
    truth, found = {}, {}
    for mu in anywhere(model, 12):
        dofs = solve(problem, mu)
        fields = problem.sample(dofs, mu)
        exact = {"displacement": fields["displacement"], "stress_solid": fields["stress"]}
        exact["strain"] = fields["strain"]
        exact |= {f"reaction_{name}": v[None] for name, v in support_reactions(problem, dofs, mu).items()}
        for name, field in model.fields.items():
            truth.setdefault(name, []).append(exact[name])
            found.setdefault(name, []).append(field.value(mu))
    errors = {name: relative(np.array(found[name]), np.array(truth[name])) for name in truth}
    assert set(errors) == {
        "displacement",
        "stress_solid",
        "strain",
        "reaction_force_x_min",
        "reaction_moment_x_min",
        *(name for name in errors if "z_min" in name),
    }
    assert errors.pop("displacement") < 1e-3
    assert max(errors.values()) < 1e-2


def test_the_sensitivities_are_those_of_the_direct_solutions(bedded) -> None:
    model, problem = bedded
    mu, spread = model.lower * 0.4 + model.upper * 0.6, model.upper - model.lower
    _, slopes = model.displacement.value_and_sensitivities(mu)
    for k in range(3):
        step = 1e-4 * spread[k] * np.eye(3)[k]
        up, down = (problem.nodal_displacement(solve(problem, mu + s)) for s in (step, -step))
        assert relative(slopes[k], (up - down) / (2e-4 * spread[k])) < 1e-2


def test_the_modes_are_nearly_the_optimal_ones() -> None:
    """Of a Young's modulus and a position: the singular values of all direct solves bound any modes."""
    young = {"steel": STEEL | {"young": "stiffness"}}
    study = cantilever(
        materials=young,
        parameters={"place": PLACE, "stiffness": {"range": ["1 GPa", "4 GPa"]}},
        supports=[FIXED, BED | {"stiffness": "0.05 MPa/mm"}],
        loads=[MOVING | {"force": ["0 N", "0 N", "-1 N"]}],
    )
    model, problem = reduce(study), study.problem()
    points, weights = np.polynomial.legendre.leggauss(9)
    centre, half = (model.lower + model.upper) / 2.0, (model.upper - model.lower) / 2.0
    grid = np.stack(np.meshgrid(points, points, indexing="ij"), axis=-1).reshape(-1, 2)
    root = np.sqrt(np.multiply.outer(weights, weights)).ravel()
    by_volume = np.sqrt(study.model_mesh().weights)[:, None]
    exact, found = [], []
    for mu, factor in zip(centre + half * grid, root, strict=True):
        exact.append((factor * by_volume * problem.nodal_displacement(solve(problem, mu))).ravel())
        found.append(factor * model.displacement.functions.evaluate(mu)[0])
    modes = (by_volume * model.displacement.modes).reshape(model.displacement.n_modes, -1)
    singular = np.linalg.svd(np.array(exact), compute_uv=False)
    for count in (1, 2, 3):
        error = np.linalg.norm(np.array(exact) - np.array(found)[:, :count] @ modes[:count])
        optimum = np.linalg.norm(singular[count:])
        assert optimum * (1.0 - 1e-9) <= error <= 1.02 * optimum


def test_prescribed_motions_may_depend_on_parameters() -> None:
    """A rotation enters by its sine and cosine, a shift linearly."""
    turned = {
        "kind": "rotation",
        "on": "x_max",
        "axis": [0, 1, 0],
        "angle": "tilt",
        "translation": ["0 mm", "0 mm", "shift"],
    }
    study = cantilever(
        supports=[FIXED, turned, BED],
        loads=[],
        parameters={"tilt": {"range": ["-20 deg", "30 deg"]}, "shift": {"range": ["0 mm", "3 mm"]}, "bed": STIFF_BED},
    )
    model, problem = reduce(study), study.problem()
    for mu in anywhere(model, 5):
        truth = problem.nodal_displacement(solve(problem, mu))
        assert relative(model.displacement.value(mu), truth) < 2e-3


@pytest.mark.parametrize("basis", ["hat", "chebyshev", "p_spline"])
def test_other_functions_of_the_parameters_may_be_chosen(basis: str) -> None:
    reduction = {"method": "pgd", "basis": basis, "max_modes": 12, "tolerance": 2e-2}
    study = cantilever(reduction=reduction, parameters={"place": PLACE, "push": PUSH}, supports=[FIXED])
    model, problem = reduce(study), study.problem()
    assert model.certificate["reduction"]["basis"] == basis
    for mu in anywhere(model, 4):
        assert relative(model.displacement.value(mu), problem.nodal_displacement(solve(problem, mu))) < 2e-2


@pytest.mark.parametrize(
    ("sections", "message"),
    [
        (
            {"materials": {"rubber": STEEL | {"law": "neo_hookean"}}},
            r"the material 'neo_hookean' is not: linear_elastic is: use method = \"galerkin\"",
        ),
        (
            {"loads": [{"kind": "pressure", "on": "z_max", "pressure": "0.1 kPa"}, MOVING]},
            r"the pressure on 'z_max' follows the deformation: a traction does not",
        ),
        ({"mesh": BLOCK | {"cells": "hex27"}}, r"takes hex20 or hex8 in place of hex27"),
        ({"loads": [], "parameters": {"bed": STIFF_BED}}, r"nothing moves this solid"),
        ({"solver": {"threads": 1, "formulation": "mixed"}}, r"has no pressures: leave out"),
        (
            {"loads": [MOVING | {"width": "0.1 mm"}]},
            r"the load does not depend smoothly enough on place: a moving load may be too narrow",
        ),
        (
            {
                "loads": [MOVING | {"centre": ["place + further", "5 mm", "10 mm"], "width": "1 mm"}],
                "parameters": {
                    "place": {"range": ["10 mm", "50 mm"]},
                    "further": {"range": ["0 mm", "40 mm"]},
                    "push": PUSH,
                    "bed": STIFF_BED,
                },
            },
            r"the load is no short sum of products of functions of place and further: use",
        ),
    ],
)
def test_what_pgd_cannot_solve_is_one_message(sections, message) -> None:
    with pytest.raises(StudyError, match=message):
        reduce(cantilever(**sections))
