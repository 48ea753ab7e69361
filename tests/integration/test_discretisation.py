"""The discretisation error in certificates: against beam theory, and what is said where there is no estimate."""

from __future__ import annotations

import json
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import morph_dslam as md
from morph_dslam.cli import app as cli
from morph_dslam.errors import SolverError
from morph_dslam.evaluation.model_summary import error_facts, summarise_model
from morph_dslam.mechanics.solid import SolidOptions, SolidProblem
from morph_dslam.mechanics.solvers.continuation import advance, loaded_state
from morph_dslam.studies import discretisation
from morph_dslam.studies.build import certified_model
from morph_dslam.studies.defaults import resolve_defaults
from morph_dslam.studies.discretisation import discretisation_errors
from morph_dslam.studies.higher_order import HigherOrder, OutOfTime
from morph_dslam.studies.solid_study import SolidStudy
from morph_dslam.studies.solutions import Snapshots, take_snapshots
from morph_dslam.studies.study import Study

YOUNG, SIDE, LENGTH, PUSH = 3e6, 0.01, 0.16, 10.0


def bar(**solver: Any) -> Study:
    """A slender bar of hexahedra, clamped at one end; its other end is pushed sideways, so little that it is linear."""
    content = {
        "name": "bar",
        "mesh": {"generator": "block", "size": ["10 mm", "10 mm", "160 mm"], "divisions": [1, 1, 16], "cells": "hex8"},
        "materials": {"rubber": {"law": "neo_hookean", "young": "3 MPa", "poisson": 0.0}},
        "supports": [{"kind": "fixed", "on": "z_min"}],
        "loads": [{"kind": "traction", "on": "z_max", "traction": ["push", "0 Pa", "0 Pa"]}],
        "parameters": {"push": {"range": ["0 Pa", f"{PUSH} Pa"]}},
        "sampling": {"scheme": "even", "training": 9, "held_out": 6},
        "reduction": {"method": "pod"},
        "solver": {"workers": 1, "threads": 1, "formulation": "displacement"} | solver,
    }
    return resolve_defaults(md.make_study(content))


@pytest.fixture(scope="module")
def solved(tmp_path_factory: pytest.TempPathFactory) -> tuple[Study, Snapshots, md.ReducedModel]:
    study = bar()
    snapshots = take_snapshots(study, tmp_path_factory.mktemp("bar"))
    return study, snapshots, certified_model(snapshots, study.reduction, study.name)


@pytest.fixture
def all_the_time(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(discretisation, "SHARE", 0.9999)


@pytest.mark.usefixtures("all_the_time")
@pytest.mark.parametrize("iterative", [False, True])
def test_the_estimate_is_how_far_beam_theory_is_from_locking_hexahedra(
    solved: tuple[Study, Snapshots, md.ReducedModel], monkeypatch: pytest.MonkeyPatch, iterative: bool
) -> None:
    """Cube-shaped hex8 carry shear where they should bend; Poisson's ratio is zero, so that beam theory is exact."""
    if iterative:
        monkeypatch.setattr(discretisation, "BYTES_OF_A_MILLION", 1e20)
    study, snapshots, model = solved
    entry = discretisation_errors(study, snapshots, model, 1e3)
    assert entry["method"] == "displacements of order 2 on the same cells"
    assert entry["unknowns"] == [3 * 4 * 17, 3 * (4 * 17 + 4 * 16 + 4 * 17)]
    z = model.nodes[:, 2]
    inertia, shear_stiffness = SIDE**4 / 12.0, 5.0 / 6.0 * YOUNG / 2.0 * SIDE**2
    unit = SIDE**2 * (z**2 * (3.0 * LENGTH - z) / (6.0 * YOUNG * inertia) + z / shear_stiffness)
    true, found = [], []
    for snapshot in snapshots.held_out:
        if any(np.allclose(snapshot.coordinates, state) for state in entry["coordinates"]):
            true.append(unit * snapshot.coordinates[0])
            found.append(snapshot.fields["displacement"][:, 0])
    assert len(true) == 3
    missing = np.abs(np.array(true) - found)
    assert missing.max() > 0.2 * np.abs(true).max()
    assert entry["errors"]["displacement"]["mean_mm"] == pytest.approx(1e3 * missing.mean(), rel=0.03)
    assert entry["errors"]["displacement"]["max_mm"] == pytest.approx(1e3 * missing.max(), rel=0.03)
    # A push of which the locked bar bends as far as the true one: all of its nodes are on the surface.
    locked, size = np.linalg.norm(found, axis=1), np.sqrt(np.mean(np.square(true), axis=1))
    more = np.einsum("sn,sn->s", found, np.array(true)) / locked**2 - 1.0
    pushes = [state[0] for state in entry["coordinates"]]
    assert entry["parameters"]["errors"]["push"] == pytest.approx(more * pushes, rel=0.04)
    assert entry["parameters"]["displacement_rms_mm"] == pytest.approx(1e3 * size, rel=0.03)
    # The reaction is the load, whatever the elements; its moment too.
    assert entry["errors"]["reaction_force_z_min"]["relative_l2"] < (0.01 if iterative else 1e-6)


def short_bar(divisions: list[int], cells: str) -> Study:
    """A bar of 20 x 20 x 60 mm, clamped at one end and pushed sideways at the other."""
    content = {
        "name": "bar",
        "mesh": {"generator": "block", "size": ["20 mm", "20 mm", "60 mm"], "divisions": divisions, "cells": cells},
        "materials": {"rubber": {"law": "neo_hookean", "young": "3 MPa", "poisson": 0.3}},
        "supports": [{"kind": "fixed", "on": "z_min"}],
        "loads": [{"kind": "traction", "on": "z_max", "traction": ["push", "0 Pa", "0 Pa"]}],
        "parameters": {"push": {"range": ["0 kPa", "20 kPa"]}},
        "sampling": {"scheme": "even", "training": 9, "held_out": 6, "refined": 1},
        "solver": {"workers": 1, "threads": 1},
    }
    return resolve_defaults(md.make_study(content))


def test_enhanced_hexahedra_are_compared_with_what_is_finer_than_they_are(tmp_path: Path) -> None:
    """One cell thick, they give way too little; second order does even less, and stated another sign. Truth: a mesh
    twice as fine of hex27."""
    study, fine = short_bar([1, 1, 3], "hex8"), short_bar([2, 2, 6], "hex27")
    snapshots = take_snapshots(study, tmp_path)
    entry = discretisation_errors(study, snapshots, certified_model(snapshots, study.reduction, study.name), 0.0)
    assert entry["method"] == "displacements of order 3 on the same cells"
    (mu,) = entry["coordinates"]
    (own,) = (s.fields["displacement"] for s in snapshots.held_out if np.allclose(s.coordinates, mu))
    assert isinstance(fine, SolidStudy)
    problem = fine.problem()
    found = problem.nodal_displacement(loaded_state(problem, np.array(mu)).dofs)
    same = np.linalg.norm(problem.mesh.nodes[None] - snapshots.mesh.nodes[:, None], axis=2).argmin(axis=1)
    truth = found[same]
    assert entry["errors"]["displacement"]["relative_l2"] == pytest.approx(
        np.linalg.norm(own - truth) / np.linalg.norm(truth), rel=0.2
    )
    push = np.sum(own * (truth - own)) / np.sum(own * own) * mu[0]  # nearly linear
    assert push > 500.0
    assert entry["parameters"]["errors"]["push"][0] == pytest.approx(push, rel=0.2)


def test_what_third_order_costs_too_much_for_is_compared_with_second(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    study = short_bar([1, 1, 3], "hex8")
    snapshots = take_snapshots(study, tmp_path)
    model = certified_model(snapshots, study.reduction, study.name)
    monkeypatch.setattr(discretisation, "MOST_BYTES", 5e5)
    entry = discretisation_errors(study, snapshots, model, 0.0)
    assert entry["method"] == "displacements of order 2 on the same cells"


@pytest.mark.parametrize("how", ["no solution", "no time", "another branch"])
def test_where_third_order_does_not_converge_second_order_is_compared_and_said(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, how: str
) -> None:
    """In the most strained of two states, against both orders solved from rest to the end."""
    study = asking_for(short_bar([1, 1, 3], "hex8"), 2)
    snapshots = take_snapshots(study, tmp_path)
    model, solve = certified_model(snapshots, study.reduction, study.name), HigherOrder.solve
    most, unstable, tangent = max(s.coordinates[0] for s in snapshots.held_out), list[Any](), SolidProblem.linearise

    def failing(self: HigherOrder, dofs: Any, mu: Any, in_time: Any) -> Any:
        found = solve(self, dofs, mu, in_time)
        if self.problem.displacements.order == 3 and mu[0] == most:
            if how == "no solution":
                raise SolverError("finer elements do not converge")
            if how == "no time":
                raise OutOfTime
            unstable.append(found.dofs)
            return replace(found, negative_pivots=1)
        return found

    def linearise(self: SolidProblem, x: Any, mu: Any, *others: Any) -> Any:
        is_unstable = any(x is each for each in unstable)
        return SimpleNamespace(negative_pivots=1) if is_unstable else tangent(self, x, mu, *others)

    monkeypatch.setattr(SolidProblem, "linearise", linearise)
    monkeypatch.setattr(HigherOrder, "solve", failing)
    entry = discretisation_errors(study, snapshots, model, 0.0)
    assert bool(unstable) == (how == "another branch")
    assert entry["method"].startswith("displacements of order 3 on the same cells, of order 2 in 1 of 2 states")
    assert "left_out" not in entry
    assert most in [state[0] for state in entry["coordinates"]]
    assert isinstance(study, SolidStudy)
    missing = []
    for (push,) in entry["coordinates"]:
        finer = study.problem(SolidOptions(order=2 if push == most else 3, serendipity=True))
        truth = finer.nodal_displacement(loaded_state(finer, np.array([push])).dofs)
        (own,) = (s.fields["displacement"] for s in snapshots.held_out if s.coordinates[0] == push)
        missing.append(np.linalg.norm(own - truth, axis=1))
    # Second order of so few cells is stiffer than the study's elements: the errors of both orders differ.
    assert entry["errors"]["displacement"]["mean_mm"] == pytest.approx(1e3 * np.mean(missing), rel=0.05)


def test_forces_that_statics_determine_have_no_mesh_error() -> None:
    """A soft bar bends far under a dead push at its end: whatever the elements, its support carries the push."""
    study = bar(order=2)
    assert isinstance(study, SolidStudy)
    coarse = study.problem(SolidOptions(threads=1))
    mu = np.array([400.0])
    finer = HigherOrder(coarse, study.problem(SolidOptions(order=3, serendipity=True, threads=1)))
    found = finer.solve(loaded_state(coarse, mu).dofs, mu)
    force = finer.reactions_in_balance(found)["force_z_min"]
    assert force == pytest.approx([-400.0 * SIDE**2, 0.0, 0.0], abs=1e-9)


@pytest.mark.usefixtures("all_the_time")
def test_second_order_elements_are_compared_with_third_order(tmp_path: Path) -> None:
    study = bar(order=2)
    snapshots = take_snapshots(study, tmp_path)
    model = certified_model(snapshots, study.reduction, study.name)
    entry = discretisation_errors(study, snapshots, model, 1e3)
    assert entry["method"] == "displacements of order 3 on the same cells"
    assert entry["errors"]["displacement"]["relative_l2"] < 0.005
    facts = error_facts(replace(model, certificate=model.certificate | {"discretisation": entry}))
    assert list(facts)[:3] == ["total error", "discretisation error", "reduction error"]
    mean = model.certificate["displacement"]["mean_mm"] + entry["errors"]["displacement"]["mean_mm"]
    assert facts["total error"].startswith(f"displacement {mean:.2g} mm mean")


@pytest.mark.parametrize(
    ("changes", "why"),
    [
        ({"MOST_BYTES": 1.0}, "GB of memory"),
        ({"FLOOR": 0.0, "SHARE": 0.01}, "solves, more than a quarter"),
        ({"FLOOR": 1e-9, "FINER_TANGENTS": 1e-12, "SWEEP_TANGENTS": 1e-9}, "states would take more than a quarter"),
    ],
)
def test_what_exceeds_its_share_is_not_estimated(
    solved: tuple[Study, Snapshots, md.ReducedModel],
    monkeypatch: pytest.MonkeyPatch,
    changes: dict[str, float],
    why: str,
) -> None:
    """By memory, by the number of solves, and, where that was foreseen wrongly, by the clock."""
    for name, value in changes.items():
        monkeypatch.setattr(discretisation, name, value)
    entry = discretisation_errors(*solved, 0.0)
    assert list(entry) == ["not_estimated", "estimable"]
    assert entry["estimable"]
    assert why in entry["not_estimated"]


def asking_for(study: Study, count: int) -> Study:
    """The same study with so many states to solve again."""
    return study.model_copy(update={"sampling": study.sampling.model_copy(update={"refined": count})})


def test_an_estimate_that_is_asked_for_takes_what_time_it_needs(
    solved: tuple[Study, Snapshots, md.ReducedModel], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(discretisation, "FLOOR", 0.0)
    study, snapshots, model = solved
    entry = discretisation_errors(asking_for(study, 2), snapshots, model, 0.0)
    assert len(entry["coordinates"]) == 2
    assert "left_out" not in entry


@pytest.mark.parametrize("waits", ["for other programs", "for its own share to end"])
def test_waiting_takes_no_time_and_a_state_that_does_not_converge_leaves_the_others_theirs(
    solved: tuple[Study, Snapshots, md.ReducedModel], monkeypatch: pytest.MonkeyPatch, waits: str
) -> None:
    """The first state waits for longer than all may take together, or uses its share up."""
    solve, calls = HigherOrder.solve, list[int]()

    def slowly(self: HigherOrder, dofs: Any, mu: Any, in_time: Any) -> Any:
        calls.append(len(calls))
        if len(calls) == 1 and waits == "for other programs":
            time.sleep(1.2)
        elif len(calls) == 1:
            while in_time():
                pass
            raise OutOfTime
        return solve(self, dofs, mu, in_time)

    monkeypatch.setattr(discretisation, "FLOOR", 1.2)
    monkeypatch.setattr(HigherOrder, "solve", slowly)
    entry = discretisation_errors(*solved, 0.0)
    assert len(entry["coordinates"]) == 3 - (waits != "for other programs")
    assert ("1 of 3 states would take more" in entry.get("left_out", "")) == (waits != "for other programs")


def test_a_short_build_is_estimated_by_what_the_finer_elements_say_when_solved_to_the_end(
    solved: tuple[Study, Snapshots, md.ReducedModel],
) -> None:
    """15 solves, a quarter of which is less than one finer state; their iteration ends early, the reference's not."""
    study, snapshots, model = solved
    entry = discretisation_errors(study, snapshots, model, 0.0)
    assert len(entry["coordinates"]) == 3
    assert isinstance(study, SolidStudy)
    finer = study.problem(SolidOptions(order=2, serendipity=True))
    missing = []
    for coordinates in entry["coordinates"]:
        (own,) = (s for s in snapshots.held_out if np.allclose(s.coordinates, coordinates))
        truth = finer.nodal_displacement(loaded_state(finer, np.array(coordinates)).dofs)
        missing.append(np.linalg.norm(own.fields["displacement"] - truth, axis=1))
    assert entry["errors"]["displacement"]["mean_mm"] == pytest.approx(1e3 * np.mean(missing), rel=0.05)


def test_no_estimate_is_the_first_thing_that_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    study = bar()
    model = md.build(asking_for(study, 0), tmp_path / "bar.morph")
    assert next(iter(summarise_model(model))) == "errors"
    assert error_facts(model)["discretisation error"] == "not estimated: switched off by sampling.refined = 0"
    assert cli.main(["info", str(tmp_path / "bar.morph")]) == 0
    _title, _, heading, first, *_ = capsys.readouterr().out.splitlines()
    assert [heading, *first.split()] == ["errors", "total", "error", "not", "estimated"]


def test_the_estimate_of_a_shell_is_how_far_plate_theory_is_from_few_elements(tmp_path: Path) -> None:
    """Linear moments in four triangles miss the square of a uniformly loaded strip; Poisson's ratio is zero."""
    length, width, thickness, push = 0.1, 0.02, 1e-3, 1e-3
    content = {
        "name": "strip",
        "mesh": {"generator": "plate", "size": ["100 mm", "20 mm"], "divisions": [2, 1], "cells": "tri6"},
        "shell": {"thickness": "1 mm"},
        "material": {"young": "1 GPa", "poisson": 0.0},
        "supports": [{"kind": "clamped", "on": "x_min"}],
        "loads": [{"kind": "force", "force": ["0 N", "0 N", "push"]}],
        "parameters": {"push": {"range": ["0 N", f"{push} N"]}},
        "sampling": {"scheme": "even", "training": 9, "held_out": 6},
        "solver": {"workers": 1},
    }
    study = resolve_defaults(md.make_study(content))
    snapshots = take_snapshots(study, tmp_path)
    model = certified_model(snapshots, study.reduction, study.name)
    entry = discretisation_errors(study, snapshots, model, 0.0)
    assert entry["method"] == "displacements of order 3 on the same cells"
    unit = np.zeros((len(model.nodes), 3))
    unit[:, 0] = -3.0 * (length - model.nodes[:, 0]) ** 2 / length / (width * thickness**2)
    missing = []
    for coordinates in entry["coordinates"]:
        (own,) = (s for s in snapshots.held_out if np.allclose(s.coordinates, coordinates))
        missing.append(np.linalg.norm(own.fields["stress_top"] - coordinates[0] * unit, axis=1))
    assert len(missing) == 3
    assert entry["errors"]["stress_top"]["mean_MPa"] == pytest.approx(1e-6 * np.mean(missing), rel=0.15)


def test_finer_elements_find_the_same_homogeneous_state() -> None:
    """A rubber cube on symmetry planes: its state is homogeneous, so that all elements have the same displacement."""
    symmetry = [{"kind": "displacement", "on": f"{axis}_min", axis: "0 mm"} for axis in "xyz"]
    content = {
        "name": "cube",
        "mesh": {"generator": "block", "size": ["10 mm", "10 mm", "10 mm"], "divisions": [1, 1, 1]},
        "materials": {
            "rubber": {
                "law": "ogden",
                "moduli": ["0.4095 MPa", "0.003 MPa", "0.01 MPa"],
                "exponents": [1.3, 5, -2],
                "bulk": "422 MPa",
            }
        },
        "supports": [*symmetry, {"kind": "displacement", "on": "z_max", "z": "stroke"}],
        "parameters": {"stroke": {"range": ["0 mm", "50 mm"]}},
    }
    study = md.make_study(content)
    assert isinstance(study, SolidStudy)
    coarse, finer = study.problem(), study.problem(SolidOptions(order=3, serendipity=True))
    again = HigherOrder(coarse, finer)
    strokes = np.linspace(0.005, 0.05, 10)[:, None]
    for state in advance(coarse, loaded_state(coarse, np.zeros(1)), strokes)[1:]:
        found = again.solve(state.dofs, state.mu)
        difference = finer.nodal_displacement(found.dofs) - coarse.nodal_displacement(state.dofs)
        assert np.abs(difference).max() < 1e-9


@pytest.mark.slow
@pytest.mark.parametrize(
    ("cells", "width", "divisions"), [("hex20", "20 mm", [6, 7, 1]), ("tet10", "40 mm", [4, 8, 1])]
)
def test_finer_elements_start_from_the_pressures_of_rubber(cells: str, width: str, divisions: list[int]) -> None:
    """Planar tension to 1.8 times the length: the solution is that of the path from the unloaded strip, soon found."""
    content = {
        "name": "planar tension",
        "mesh": {"generator": "block", "size": ["12 mm", width, "1 mm"], "divisions": divisions, "cells": cells},
        "materials": {
            "rubber": {"law": "yeoh", "c10": "0.2 MPa", "c20": "-0.0096 MPa", "c30": "0.00064 MPa", "bulk": "40 MPa"}
        },
        "supports": [
            {"kind": "fixed", "on": "x_max"},
            {"kind": "displacement", "on": "x_min", "x": "-1 * stroke", "y": "0 mm", "z": "0 mm"},
        ],
        "parameters": {"stroke": {"range": ["0 mm", "10 mm"]}},
    }
    study, mu, tangents = md.make_study(content), np.array([9.5e-3]), list[int]()
    assert isinstance(study, SolidStudy)
    coarse, finer = study.problem(), study.problem(SolidOptions(order=3, serendipity=True))
    given = advance(coarse, loaded_state(coarse, np.zeros(1)), mu)[-1].dofs

    def in_time() -> bool:
        tangents.append(1)
        return True

    found = HigherOrder(coarse, finer).solve(given, mu, in_time).dofs
    assert len(tangents) <= 10
    own, again, truth = (
        problem.nodal_displacement(dofs)
        for problem, dofs in ((coarse, given), (finer, found), (finer, loaded_state(finer, mu).dofs))
    )
    assert np.abs(again - truth).max() < 0.05 * np.abs(own - truth).max()


def pressed_and_sheared() -> SolidStudy:
    """A soft block whose cells are sheared so much that finer displacements invert them at the nodes."""
    content = {
        "name": "sheared",
        "mesh": {"generator": "block", "size": ["20 mm"] * 3, "divisions": [3, 3, 2], "cells": "hex8"},
        "materials": {"soft": {"law": "neo_hookean", "young": "60 kPa", "poisson": 0.45}},
        "supports": [
            {"kind": "fixed", "on": "z_min"},
            {"kind": "displacement", "on": "z_max", "x": "push", "y": "0 mm", "z": "-1 * push"},
        ],
        "parameters": {"push": {"range": ["0 mm", "12 mm"]}},
    }
    study = md.make_study(content)
    assert isinstance(study, SolidStudy)
    return study


def test_finer_elements_that_the_study_s_solution_inverts_are_loaded_from_rest() -> None:
    """Against the finer solution in small increments."""
    study, mu = pressed_and_sheared(), np.array([12e-3])
    coarse, finer = study.problem(), study.problem(SolidOptions(order=2, serendipity=True, at_nodes=True))
    given = loaded_state(coarse, mu).dofs
    found = finer.nodal_displacement(HigherOrder(coarse, finer).solve(given, mu).dofs)
    small_steps = np.linspace(0.0, mu, 13)[1:]
    truth = finer.nodal_displacement(advance(finer, loaded_state(finer, np.zeros(1)), small_steps)[-1].dofs)
    assert np.abs(found - truth).max() < 0.05 * np.abs(coarse.nodal_displacement(given) - truth).max()


def test_a_state_that_loads_from_rest_do_not_lead_to_has_no_finer_one_from_rest() -> None:
    """It may be another branch, whose distance would pass for an error of the elements."""
    study, mu = pressed_and_sheared(), np.array([12e-3])
    coarse, finer = study.problem(), study.problem(SolidOptions(order=2, serendipity=True, at_nodes=True))
    given = loaded_state(coarse, mu).dofs
    elsewhere = given + np.where(coarse.free, 4e-3, 0.0)
    with pytest.raises(SolverError, match=r"at push = 12 mm.* lead to another equilibrium"):
        HigherOrder(coarse, finer).solve(elsewhere, mu)


def test_a_finer_solution_on_another_branch_is_left_out(
    solved: tuple[Study, Snapshots, md.ReducedModel], monkeypatch: pytest.MonkeyPatch
) -> None:
    """States said to have a negative eigenvalue, which the finer ones of this bar have not."""
    load = discretisation.load_state
    monkeypatch.setattr(discretisation, "load_state", lambda file: load(file) | {"pivots": np.array(1)})
    entry = discretisation_errors(*solved, 0.0)
    assert list(entry) == ["not_estimated", "estimable"]
    assert "another stability" in entry["not_estimated"]


def test_nodes_where_the_finer_solution_has_no_stress_are_left_out_and_counted() -> None:
    """One node is pressed into a soft block, so that cells of third order beside it are turned inside out."""
    content = {
        "name": "pressed",
        "mesh": {"generator": "block", "size": ["20 mm"] * 3, "divisions": [2, 2, 2], "cells": "tet4"},
        "sets": {"tip": {"nearest": ["10 mm", "10 mm", "20 mm"]}},
        "materials": {"soft": {"law": "neo_hookean", "young": "60 kPa", "poisson": 0.45}},
        "supports": [
            {"kind": "fixed", "on": "z_min"},
            {"kind": "displacement", "on": "tip", "x": "0 mm", "y": "0 mm", "z": "-1 * press"},
        ],
        "parameters": {"press": {"range": ["0 mm", "6 mm"]}},
        "sampling": {"scheme": "even", "training": 8, "held_out": 4, "refined": 1},
        "reduction": {"method": "pod"},
        "solver": {"workers": 1, "threads": 1},
    }
    model = md.build(md.make_study(content))
    entry = model.certificate["discretisation"]
    json.dumps(entry, allow_nan=False)
    assert 0 < entry["singular_nodes"] < len(model.nodes) / 2
    facts = error_facts(model)
    assert f"up to {entry['singular_nodes']} nodes" in facts["nodes left out"]
    assert "von Mises stress" in facts["total error"]
    # As files of earlier versions have it.
    for errors in (entry["errors"]["stress_solid"]["von_mises"], entry["errors"]["strain"]):
        errors["relative_l2"] = float("nan")
    assert not any("nan" in text for text in error_facts(model).values())
