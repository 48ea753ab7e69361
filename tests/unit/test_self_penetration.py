"""Surfaces that pass through themselves, on shapes whose overlap is known in closed form."""

from dataclasses import replace

import numpy as np
import pytest

from morph_dslam.mechanics.contact import RigidCylinder, RigidPlane
from morph_dslam.mechanics.parameters import ParameterSymbols
from morph_dslam.meshing.generators import block
from morph_dslam.meshing.meshes import model_mesh_of
from morph_dslam.model import Parameter
from morph_dslam.reduction.self_penetration import SurfaceContact, obstacle_report, penetration_report
from morph_dslam.studies.problem import Snapshot
from morph_dslam.studies.solid_study import SolidStudy
from morph_dslam.studies.study import make_study

THICK, LENGTH, RADIUS = 1.0, 40.0, 6.0


def coiled(mesh, pitch, rise):
    """The bar coiled along x: its axis is a spiral that shrinks by ``pitch`` and rises by ``rise`` a turn."""
    along, across, aside = mesh.nodes.T
    angle = -along / RADIUS
    turns = along / RADIUS / (2.0 * np.pi)
    radius = RADIUS - pitch * turns + across
    return np.column_stack([radius * np.cos(angle), radius * np.sin(angle), aside + rise * turns])


def inside_another_turn(mesh, pitch, rise):
    """Whether a node is inside the bar a turn before or after, and how far from its nearest face (n,)."""
    along, across, aside = mesh.nodes.T
    depth = np.full(len(along), -np.inf)
    for turn in (-1.0, 1.0):
        there = along + turn * 2.0 * np.pi * RADIUS
        r, z = across + turn * pitch, aside - turn * rise
        faces = np.array([there, LENGTH - there, r, THICK - r, z, THICK - z])
        depth = np.maximum(depth, faces.min(axis=0))
    return depth


@pytest.mark.slow
def test_the_overlap_of_a_coiled_bar_is_found_node_by_node():
    mesh = block((LENGTH, THICK, THICK), (160, 4, 4), "hex8")
    pitch, rise = 0.7, 0.13
    found, depths = SurfaceContact(mesh.nodes, mesh.surface_triangles()).find(coiled(mesh, pitch, rise))
    expected = inside_another_turn(mesh, pitch, rise)
    on_surface = np.unique(mesh.surface_triangles())
    surely = on_surface[expected[on_surface] > 0.02]
    surely_not = on_surface[expected[on_surface] < -0.02]
    assert len(surely) > 20
    assert np.isin(surely, found).all()
    assert not np.isin(found, surely_not).any()
    # The turns overlap by what the pitch leaves of the bar's thickness.
    assert depths.max() == pytest.approx(THICK - pitch, rel=0.05)


def test_turns_that_pass_each_other_are_not_accused():
    mesh = block((LENGTH, THICK, THICK), (160, 4, 4), "hex8")
    surface = SurfaceContact(mesh.nodes, mesh.surface_triangles())
    assert len(surface.find(coiled(mesh, 1.02, 0.0))[0]) == 0
    assert len(surface.find(coiled(mesh, 0.0, 1.02))[0]) == 0
    assert len(surface.find(mesh.nodes)[0]) == 0
    # Strongly squeezed and sheared, but nowhere through itself.
    sheared = mesh.nodes @ np.array([[0.3, 0.0, 0.0], [0.9, 1.0, 0.0], [0.0, 0.0, 1.0]])
    assert len(surface.find(sheared)[0]) == 0


def test_the_certificate_names_the_states_and_the_depth():
    mesh, parameters = (
        block((LENGTH, THICK, THICK), (160, 4, 4), "hex8"),
        (Parameter("pitch", "length", "m", 0.0, 2.0, 0.0),),
    )
    states = [
        Snapshot(np.array([pitch]), {"displacement": coiled(mesh, pitch, 0.13) - mesh.nodes})
        for pitch in (1.1, 0.9, 0.7)
    ]
    report = penetration_report(model_mesh_of(mesh), parameters, states)
    assert report["checked"] == 3
    assert [state["coordinates"] for state in report["states"]] == [[0.7], [0.9]]
    assert [state["depth_mm"] for state in report["states"]] == pytest.approx([300.0, 100.0], rel=0.08)


def test_an_open_surface_is_not_checked():
    mesh = model_mesh_of(block((1.0, 1.0, 1.0), (2, 2, 2), "hex8"))
    opened = replace(mesh, triangles=mesh.triangles[1:])
    assert penetration_report(opened, (), []) is None


def test_nodes_in_an_obstacle_are_named_with_the_state_and_the_depth():
    """The plane comes down on a top that one contact names; another lies behind the block's side from the start."""
    mesh, down = block((1.0, 1.0, 1.0), (2, 2, 2), "hex8"), Parameter("down", "length", "m", 0.0, 0.5, 0.0)
    symbols = ParameterSymbols([down])
    lid = RigidPlane("z_max", (0.0, 0.0, 1.0 - symbols["down"]), (0.0, 0.0, -1.0))
    beside = RigidPlane("x_max", (0.5, 0.0, 0.0), (1.0, 0.0, 0.0))
    named = [(lid, mesh.set_nodes("z_max")), (beside, mesh.set_nodes("x_max"))]
    squeezed = [mesh.nodes * [0.0, 0.0, -share] for share in (0.0, 0.1, 0.25)]
    states = [Snapshot(np.array([0.25]), {"displacement": displacement}) for displacement in squeezed]
    report = obstacle_report(model_mesh_of(mesh), states, symbols, named)
    assert [(state["nodes"], state["depth_mm"]) for state in report["states"]] == [
        (9, pytest.approx(250.0)),
        (9, pytest.approx(150.0)),
    ]
    assert "in 2 of 3 solutions the surface enters an obstacle, by 2.5e+02 mm at down = 0.25 m" in report["statement"]
    report = obstacle_report(model_mesh_of(mesh), [replace(states[2], coordinates=np.array([0.2]))], symbols, named)
    assert report["states"] == []
    # What no contact keeps out is named too, unless it was inside at rest.
    moved = Snapshot(np.array([0.0]), {"displacement": np.tile([-0.6, 0.0, 0.2], (len(mesh.nodes), 1))})
    report = obstacle_report(model_mesh_of(mesh), [moved], symbols, [(lid, mesh.set_nodes("x_max"))])
    assert report["states"][0]["depth_mm"] == pytest.approx(200.0)
    report = obstacle_report(model_mesh_of(mesh), [moved], symbols, [(beside, mesh.set_nodes("x_max"))])
    assert report["states"][0]["depth_mm"] == pytest.approx(600.0)


def test_an_obstacle_in_the_solid_comes_first_and_the_remedy_is_the_one_that_helps():
    """A rod of 0.1 m radius moves up through a block of 1 m, whose faces meet nothing while it is in the middle."""
    mesh, up = block((1.0, 1.0, 1.0), (2, 2, 2), "hex8"), Parameter("up", "length", "m", 0.0, 2.0, 0.0)
    symbols = ParameterSymbols([up])
    rod = RigidCylinder("z_min", (0.3, 0.5, symbols["up"] - 0.2), (0.0, 1.0, 0.0), 0.1)
    named = [(rod, mesh.set_nodes("z_min"))]

    def state(up, lifted=0.0):
        return Snapshot(np.array([up]), {"displacement": np.full((len(mesh.nodes), 3), [0.0, 0.0, lifted])})

    beside = [state(0.0), state(1.5), state(0.5, lifted=0.6)]
    clear = obstacle_report(model_mesh_of(mesh), beside, symbols, named)
    assert clear["statement"] == "in none of 3 solutions the surface enters an obstacle"
    report = obstacle_report(model_mesh_of(mesh), [*beside, state(0.45), state(0.7)], symbols, named)
    assert sorted(found["coordinates"] for found in report["states"]) == [[0.45], [0.7]]
    assert all(found["inside"] == ["the cylinder of the contact on 'z_min'"] for found in report["states"])
    assert "in 2 of 5 solutions the cylinder of the contact on 'z_min' lies inside the solid" in report["statement"]
    # At 1.25 m the rod is above the top but for its rim, and touches no node; a thicker one holds nodes of the top.
    thick = RigidCylinder("z_min", (0.5, 0.5, symbols["up"] - 0.2), (0.0, 1.0, 0.0), 0.25)
    report = obstacle_report(model_mesh_of(mesh), [state(1.25)], symbols, [(thick, mesh.set_nodes("z_min"))])
    assert "the surface enters an obstacle, by 2e+02 mm" in report["statement"]
    assert "name all surfaces" in report["statement"]
    report = obstacle_report(model_mesh_of(mesh), [state(1.25)], symbols, [(thick, mesh.set_nodes("z_max"))])
    assert report["statement"].endswith("make cells finer there")


def test_a_support_that_moves_nodes_into_an_obstacle_is_named():
    """The top of a block is lifted by up to 0.4 m, under a lid 0.2 m above it; a roller on its side holds x alone."""
    mesh, lift = block((1.0, 1.0, 1.0), (2, 2, 2), "hex8"), Parameter("lift", "length", "m", 0.0, 0.4, 0.0)
    symbols = ParameterSymbols([lift])
    lid = RigidPlane("z_max", (0.0, 0.0, 1.2), (0.0, 0.0, -1.0))
    named = [(lid, mesh.set_nodes("z_max"))]
    roller, lifted = np.zeros((2, len(mesh.nodes), 3), dtype=bool)
    roller[mesh.set_nodes("x_min"), 0] = True
    lifted[mesh.set_nodes("z_max"), 2] = True
    up = Snapshot(np.array([0.4]), {"displacement": mesh.nodes * [0.0, 0.0, 0.4]})
    for held, blamed in (({"x_min": roller}, None), ({"x_min": roller, "z_max": lifted}, "z_max")):
        report = obstacle_report(model_mesh_of(mesh), [up], symbols, named, held)
        assert report["states"][0]["depth_mm"] == pytest.approx(200.0)
        assert report["states"][0].get("held_by") == blamed
    assert "the support of 'z_max' holds nodes there" in report["statement"]


@pytest.mark.parametrize(("depth", "counts"), [(2e-3, False), (20e-3, True)])
def test_what_contact_gives_way_by_is_no_warning(depth, counts):
    """On faces of 0.5 m a pressure as large as Young's modulus lets a node in by 5 mm; other nodes are kept out."""
    mesh, idle = block((1.0, 1.0, 1.0), (2, 2, 2), "hex8"), Parameter("idle", "length", "m", 0.0, 1.0, 0.0)
    lid = RigidPlane("z_max", (0.0, 0.0, 1.0), (0.0, 0.0, -1.0))
    up = Snapshot(np.array([0.0]), {"displacement": np.full((len(mesh.nodes), 3), [0.0, 0.0, depth])})
    for own, expected in (("z_max", counts), ("z_min", True)):
        report = obstacle_report(model_mesh_of(mesh), [up], ParameterSymbols([idle]), [(lid, mesh.set_nodes(own))])
        assert bool(report["states"]) is expected


def test_a_study_says_which_components_its_supports_hold():
    """Springs hold no node, and two supports of one set hold what either does."""
    springs = {"kind": "foundation", "on": "y_min", "stiffness": "1 MPa/mm"}
    rollers = [{"kind": "displacement", "on": "z_max", axis: "lift"} for axis in "xz"]
    study = make_study(
        {
            "name": "block",
            "mesh": {"generator": "block", "size": ["1 mm"] * 3, "divisions": [1, 1, 1], "cells": "hex8"},
            "materials": {"m": {"law": "neo_hookean", "young": "1 MPa", "poisson": 0.3}},
            "supports": [{"kind": "fixed", "on": "z_min"}, *rollers, springs],
            "parameters": {"lift": {"range": ["0 mm", "0.1 mm"]}},
        }
    )
    assert isinstance(study, SolidStudy)
    held = study.held_components()
    assert held.keys() == {"z_min", "z_max"}
    low = study.solid_mesh().nodes[:, 2] < 0.5e-3
    assert (held["z_min"] == np.outer(low, [True, True, True])).all()
    assert (held["z_max"] == np.outer(~low, [True, False, True])).all()
