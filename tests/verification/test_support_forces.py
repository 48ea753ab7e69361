"""Which force each support has, where supports share nodes and where springs hold the body."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from morph_dslam.mechanics.loads import DeadTraction, FollowerPressure, SurfaceForce
from morph_dslam.mechanics.solid import SolidOptions, SolidProblem
from morph_dslam.mechanics.solvers.continuation import loaded_state
from morph_dslam.mechanics.supports import ElasticFoundation, PrescribedDisplacement, fixed
from morph_dslam.meshing.generators import block, tube
from morph_dslam.studies.study import make_study
from tests.support.shells import solved_shell
from tests.support.solids import ROLLERS, RUBBER, distorted, load_parameter, solved

#: Force on the unit cube of this rubber that is stretched by 50 %, N (`test_solid_closed_forms`).
PULL = 1.075843e6
ORIGIN = np.zeros(3)


@pytest.mark.parametrize("cell_type", ["hex8", "hex20", "tet10"])
def test_a_roller_has_the_component_that_it_holds_and_no_other(cell_type: str) -> None:
    """Uniaxial tension: all of the load is on the roller across it, and none on those beside it, which share edges."""
    symbols = load_parameter(share=0.0)
    mesh = block((1.0, 1.0, 1.0), (2, 1, 1), cell_type)
    load = DeadTraction("x_max", (PULL * symbols["share"], 0.0, 0.0))
    problem = SolidProblem(mesh, {"all": RUBBER}, ROLLERS, [load], symbols)
    state = solved(problem, 1.0)
    for name, expected in (("x_min", (-PULL, 0.0, 0.0)), ("y_min", ORIGIN), ("z_min", ORIGIN)):
        force, _ = problem.reactions(state.dofs, state.mu, name)
        np.testing.assert_allclose(force, expected, atol=1e-6 * PULL)


def test_an_edge_of_two_fixed_faces_is_shared_evenly() -> None:
    """On a cube loaded along a plane of symmetry the two faces have mirrored forces, which balance the load."""
    mesh = block((1.0, 1.0, 1.0), (2, 2, 2), "hex8")
    applied = np.array([2e5, 2e5, -1e5])
    supports = [fixed("x_min"), fixed("y_min")]
    problem = SolidProblem(mesh, {"all": RUBBER}, supports, [DeadTraction("z_max", tuple(applied))])
    state = solved(problem)
    (one, turning), (other, tilting) = (problem.reactions(state.dofs, state.mu, s.on, ORIGIN) for s in supports)
    np.testing.assert_allclose(one, other[[1, 0, 2]], rtol=1e-6)
    np.testing.assert_allclose(one + other, -applied, rtol=1e-8)
    top = mesh.nodes + problem.nodal_displacement(state.dofs)
    corners = top[mesh.face_nodes(mesh.surface("z_max"))].mean(axis=(0, 1))
    np.testing.assert_allclose(turning + tilting, -np.cross(corners, applied), rtol=1e-8, atol=1e-3)


def test_a_set_with_two_supports_has_the_forces_of_both() -> None:
    mesh = block((1.0, 1.0, 1.0), (1, 1, 1), "hex20")
    load = [DeadTraction("z_max", (1e4, 2e4, 3e4))]
    apart = [PrescribedDisplacement("z_min", z=0.0), PrescribedDisplacement("z_min", x=0.0, y=0.0)]
    problem = SolidProblem(mesh, {"all": RUBBER}, apart, load)
    state = solved(problem)
    force, _ = problem.reactions(state.dofs, state.mu, "z_min")
    np.testing.assert_allclose(force, [-1e4, -2e4, -3e4], rtol=1e-8)


@pytest.mark.parametrize("cell_type", ["hex8", "hex20"])
def test_a_foundation_has_the_force_of_its_springs(cell_type: str) -> None:
    """The cube is stretched by 50 % where its springs give way by as much as the force of that stretch asks for."""
    symbols = load_parameter(pull=0.0)
    springs = ElasticFoundation("x_min", 10.0 * PULL, normal_only=True)
    supports = [springs, *ROLLERS[1:], PrescribedDisplacement("x_max", x=symbols["pull"])]
    mesh = distorted(block((1.0, 1.0, 1.0), (2, 2, 2), cell_type), 0.05)
    problem = SolidProblem(mesh, {"all": RUBBER}, supports, parameters=symbols)
    state = solved(problem, 0.5 + 0.1)
    force, _ = problem.reactions(state.dofs, state.mu, "x_min")
    np.testing.assert_allclose(force, [-PULL, 0.0, 0.0], atol=1e-5 * PULL)


@pytest.mark.parametrize("normal_only", [False, True])
def test_foundations_and_supports_balance_the_load(normal_only: bool) -> None:
    """Forces and moments about the origin, with springs on nodes that are held too."""
    mesh = distorted(block((1.0, 0.5, 0.5), (3, 2, 2), "hex8"), 0.04)
    applied = 0.5 * np.array([1e4, 2e4, -5e3])
    supports = [fixed("x_min"), ElasticFoundation("z_min", 1e6, normal_only)]
    problem = SolidProblem(mesh, {"all": RUBBER}, supports, [DeadTraction("y_max", tuple(2.0 * applied))])
    state = solved(problem)
    forces, moments = np.transpose([problem.reactions(state.dofs, state.mu, s.on, ORIGIN) for s in supports], (1, 0, 2))
    assert np.abs(forces[1]).max() > 0.05 * np.linalg.norm(applied)
    np.testing.assert_allclose(forces.sum(axis=0), -applied, rtol=1e-8)
    faces = mesh.face_nodes(mesh.surface("y_max"))
    areas = np.linalg.norm(np.cross(*(mesh.nodes[faces[:, i]] - mesh.nodes[faces[:, 0]] for i in (1, 3))), axis=1)
    middles = (mesh.nodes + problem.nodal_displacement(state.dofs))[faces].mean(axis=1)
    np.testing.assert_allclose(moments.sum(axis=0), -np.cross(areas @ middles / 0.5, applied), rtol=1e-8)


def test_a_shell_on_springs_and_planes_of_symmetry() -> None:
    """A plate pulled between planes of symmetry, and pressed evenly onto springs that hold its whole weight."""
    shell = solved_shell("""
        mesh = { generator = "plate", size = ["40 mm", "20 mm"], divisions = [4, 2] }
        shell = { thickness = "1 mm" }
        material = { young = "10 MPa", poisson = 0.3 }
        supports = [
            { kind = "symmetry", on = "x_min", axis = "x" },
            { kind = "symmetry", on = "y_min", axis = "y" },
            { kind = "foundation", stiffness = "1 N/mm3", normal_only = true },
        ]
        loads = [
            { kind = "traction", traction = ["0 Pa", "0 Pa", "-1 kPa"] },
            { kind = "edge", on = "x_max", force = ["0.1 N/mm", "0 N/mm", "0 N/mm"] },
        ]
    """)
    forces = [shell.problem.reactions(shell.state.dofs, shell.state.mu, n)[0] for n in ("x_min", "y_min", "all")]
    np.testing.assert_allclose(forces, [[-2.0, 0.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.8]], atol=1e-6)


@pytest.mark.parametrize(("cell_type", "order"), [("tet10", 2), ("hex20", 2), ("hex20", 3)])
def test_a_force_on_a_curved_surface_of_few_cells_is_all_there(cell_type: str, order: int) -> None:
    force = np.array([1.0, 2.0, 3.0])
    mesh = tube(0.01, 0.02, 0.02, (1, 1, 6), cell_type)
    loads = [SurfaceForce("inner", tuple(force))]
    problem = SolidProblem(mesh, {"all": RUBBER}, [fixed("outer")], loads, options=SolidOptions(order=order))
    unloaded, mu = np.zeros(problem.n_dofs), np.zeros(0)
    response = problem.linearise(unloaded, mu).solve(-problem.residual(unloaded, mu))
    change = problem.linearise(unloaded, mu).apply(response) + problem.residual(unloaded, mu)
    held, _ = problem.response_reactions(unloaded, mu, response[None], change[None], "outer", np.zeros(3))
    np.testing.assert_allclose(held[0], -force, rtol=1e-9)


@pytest.mark.parametrize("order", [["left", "right"], ["right", "left"]])
@pytest.mark.parametrize("cell_type", ["hex20", "tet4"])
def test_a_pressure_inside_acts_on_the_part_whose_surface_names_the_face(cell_type: str, order: list[str]) -> None:
    """1 kPa on a section of 0.5 m2 that surfaces name from both sides: 500 N, to the left and to the right."""
    mesh = block((2.0, 1.0, 0.5), (2, 1, 1), cell_type)
    faces = mesh.all_faces()
    corners = mesh.face_nodes(faces, corners_only=True)
    at_section = np.where(corners < 0, True, np.isclose(mesh.nodes[corners, 0], 1.0)).all(axis=1)
    middles = np.concatenate([mesh.nodes[part.connectivity].mean(axis=1)[:, 0] for part in mesh.blocks])
    section = faces[at_section]
    is_left = middles[section[:, 0]] < 1.0
    sides = {"left": section[is_left], "right": section[~is_left]}
    mesh = replace(mesh, surfaces=mesh.surfaces | {name: sides[name] for name in order})
    for name, push in (("left", -500.0), ("right", 500.0)):
        problem = SolidProblem(mesh, {"all": RUBBER}, [fixed("x_min"), fixed("x_max")], [FollowerPressure(name, 1e3)])
        state = loaded_state(problem, np.zeros(0))
        forces = [problem.reactions(state.dofs, state.mu, end)[0] for end in ("x_min", "x_max")]
        np.testing.assert_allclose(sum(forces), [-push, 0.0, 0.0], atol=0.5)


@pytest.mark.parametrize(
    ("supports", "changes"),
    [
        ([{"kind": "fixed", "on": "x_min"}], False),
        ([{"kind": "fixed", "on": "x_min"}, {"kind": "displacement", "on": "x_max", "x": "0 mm"}], False),
        ([{"kind": "fixed", "on": "x_min"}, {"kind": "displacement", "on": "y_min", "y": "0 mm"}], True),
        ([{"kind": "fixed", "on": "x_min"}, {"kind": "foundation", "on": "x_max", "stiffness": "1 MPa/mm"}], True),
    ],
)
def test_kept_solutions_whose_forces_were_given_otherwise_are_solved_anew(
    supports: list[dict], changes: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    content = {
        "name": "block",
        "mesh": {"generator": "block", "size": ["20 mm", "10 mm", "10 mm"], "divisions": [2, 1, 1], "cells": "hex8"},
        "materials": {"m": {"law": "neo_hookean", "young": "1 MPa", "poisson": 0.3}},
        "supports": supports,
        "loads": [{"kind": "traction", "on": "z_max", "traction": ["0 Pa", "0 Pa", "pull"]}],
        "parameters": {"pull": {"range": ["0 kPa", "1 kPa"]}},
    }
    now = make_study(content).fingerprint()
    monkeypatch.setattr("morph_dslam.studies.solid_study.support_content", lambda supports, mesh: {})
    assert (make_study(content).fingerprint() != now) is changes


@pytest.mark.parametrize(
    ("changes", "anew"),
    [
        ({}, False),
        ({"couplings": [{"on": "x_max"}]}, True),
        ({"supports": [{"kind": "fixed", "on": "x_min"}, {"kind": "displacement", "on": "x_max", "x": "0 mm"}]}, False),
        (
            {
                "supports": [
                    {"kind": "fixed", "on": "x_min"},
                    {"kind": "rotation", "on": "x_max", "axis": [1, 0, 0], "angle": "9 deg"},
                ]
            },
            True,
        ),
        ({"solver": {"formulation": "mixed"}}, False),
        (
            {
                "solver": {"formulation": "mixed"},
                "materials": {"m": {"law": "neo_hookean", "young": "1 MPa", "poisson": -0.1}},
            },
            True,
        ),
    ],
)
def test_kept_solutions_with_wrong_derivatives_are_solved_anew(
    changes: dict, anew: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    content = {
        "name": "block",
        "mesh": {"generator": "block", "size": ["20 mm", "10 mm", "10 mm"], "divisions": [2, 1, 1], "cells": "hex8"},
        "materials": {"m": {"law": "neo_hookean", "young": "1 MPa", "poisson": 0.3}},
        "supports": [{"kind": "fixed", "on": "x_min"}],
        "contacts": [{"kind": "plane", "on": "x_max", "point": ["21 mm", "0 mm", "0 mm"], "normal": [-1, 0, 0]}],
        "parameters": {"pull": {"range": ["0 kPa", "1 kPa"]}},
        "loads": [{"kind": "pressure", "on": "z_max", "pressure": "pull"}],
    }
    now = make_study(content | changes).fingerprint()
    monkeypatch.setattr("morph_dslam.studies.solid_study.mended_content", lambda study, mesh: {})
    assert (make_study(content | changes).fingerprint() != now) is anew
