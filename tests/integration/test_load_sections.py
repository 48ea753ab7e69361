"""Every kind of load, support and parameter as a study states it: what it does to a stiff block is known."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from morph_dslam import make_study
from morph_dslam.errors import StudyError
from morph_dslam.meshing.generators import block
from morph_dslam.meshing.inp_writing import save_mesh
from morph_dslam.studies.problem import Snapshot
from morph_dslam.studies.solid_study import SolidStudy

STIFF = {"law": "neo_hookean", "young": "3 GPa", "poisson": 0.3, "density": "2 g/cm3"}
FIXED = {"kind": "fixed", "on": "z_min"}
PARAMETERS = {
    "pull": {"range": ["0 kPa", "20 kPa"]},
    "share": {"range": [0.0, 1.0]},
    "place": {"range": ["-10 mm", "10 mm"]},
    "tilt": {"range": ["0 deg", "90 deg"]},
    "young": {"range": ["1 MPa", "5 MPa"], "default": "3 MPa"},
}
#: Parameters of every test: 10 kPa, 0.5, 4 mm, 30 degrees, 2 MPa.
MU = np.array([1e4, 0.5, 0.004, np.pi / 6.0, 2e6])
AREA, HEIGHT = 0.04**2, 0.02


def study_of(**sections: Any) -> SolidStudy:
    """A block of 40 x 40 x 20 mm, fixed below."""
    content: dict[str, Any] = {
        "name": "block",
        "mesh": {"generator": "block", "size": ["40 mm", "40 mm", "20 mm"], "divisions": [4, 4, 1]},
        "materials": {"stiff": STIFF},
        "supports": [FIXED],
        "parameters": PARAMETERS,
        "solver": {"threads": 1},
    }
    study = make_study(content | sections)
    assert isinstance(study, SolidStudy)
    return study


def snapshot(mu: np.ndarray = MU, **sections: Any) -> Snapshot:
    """The solution of the block at ``mu``."""
    sweep = study_of(**sections).sweep_problem()
    return sweep.take_snapshot(sweep.advance(sweep.first_state(), mu))


PATCH = {"on": "z_max", "centre": ["20 mm + place", "20 mm", "20 mm"], "width": "5 mm"}
MIDDLE = np.array([0.02, 0.02, HEIGHT])
PULLED, HELD = 1e4 * AREA, np.array([0.02, 0.02, HEIGHT / 2])
#: A load, its resultant (N), a point on its line of action (m), and the tolerance.
LOADS: dict[str, tuple[dict[str, Any], tuple[float, float, float], np.ndarray, float]] = {
    "traction": ({"on": "z_max", "traction": ["pull", "0 Pa", "-pull"]}, (PULLED, 0.0, -PULLED), MIDDLE, 1e-4),
    "force": ({"on": ["z_max"], "force": ["6 N * share", "0 N", "-8 N"]}, (3.0, 0.0, -8.0), MIDDLE, 1e-6),
    "pressure": ({"on": "z_max", "pressure": "2 * pull"}, (0.0, 0.0, -2.0 * PULLED), MIDDLE, 1e-4),
    "body_force": (
        {"force": ["0 N/m3", "2000 N/m3 * share", "0 N/m3"]},
        (0.0, 1000.0 * AREA * HEIGHT, 0.0),
        HELD,
        1e-4,
    ),
    "gravity": ({}, (0.0, 0.0, -9.80665 * 2000.0 * AREA * HEIGHT), HELD, 1e-6),
    "point": ({"on": "z_max", "force": ["0 N", "5 N * pull / 20 kPa", "0 N"]}, (0.0, 2.5, 0.0), MIDDLE, 1e-3),
    "moving_patch": (
        {**PATCH, "force": ["0 N", "0 N", "-8 N * share"]},
        (0.0, 0.0, -4.0),
        MIDDLE + np.array([0.004, 0.0, 0.0]),
        5e-3,
    ),
    "moving_line": (
        {**PATCH, "direction": [0, 1, 0], "force": ["0 N/m", "0 N/m", "-0.1 N/mm"]},
        (0.0, 0.0, -4.0),
        MIDDLE + np.array([0.004, 0.0, 0.0]),
        5e-3,
    ),
}


@pytest.mark.parametrize("kind", sorted(LOADS))
def test_supports_answer_a_load(kind: str) -> None:
    keys, total, at, tolerance = LOADS[kind]
    force = np.array(total)
    outputs = snapshot(loads=[{"kind": kind, **keys}]).outputs
    size = float(np.linalg.norm(force))
    np.testing.assert_allclose(outputs["force_z_min"], -force, atol=tolerance * size)
    moment = np.cross(at, force)
    np.testing.assert_allclose(outputs["moment_z_min"], -moment, atol=tolerance * size * 0.04)


def test_a_force_on_several_surfaces_is_shared_by_area() -> None:
    """Of 8 N the top carries 4/6 and a side 2/6, each at its middle; a joint surface has the moment of both."""
    load = {"kind": "force", "on": ["z_max", "x_max"], "force": ["0 N", "8 N", "0 N"]}
    outputs = snapshot(loads=[load]).outputs
    np.testing.assert_allclose(outputs["force_z_min"], [0.0, -8.0, 0.0], atol=1e-6)
    at = (4.0 * MIDDLE + 2.0 * np.array([0.04, 0.02, HEIGHT / 2])) / 6.0
    np.testing.assert_allclose(outputs["moment_z_min"], -np.cross(at, [0.0, 8.0, 0.0]), atol=1e-6)


def test_a_force_bends_a_beam_as_timoshenko_says() -> None:
    size, (young, length, side, force) = ["100 mm", "5 mm", "5 mm"], (1e9, 0.1, 0.005, 0.01)
    tip = snapshot(
        mesh={"generator": "block", "size": size, "divisions": [10, 1, 1]},
        materials={"stiff": {"law": "linear_elastic", "young": "1 GPa", "poisson": 0.0}},
        supports=[{"kind": "fixed", "on": "x_min"}],
        loads=[{"kind": "force", "on": "x_max", "force": ["0 N", "0 N", "0.02 N * share"]}],
    ).fields["displacement"][:, 2]
    bending, shear = force * length**3 / (3.0 * young * side**4 / 12.0), force * length / (5 / 12 * young * side**2)
    assert tip.max() == pytest.approx(bending + shear, rel=2e-3)


def test_a_traction_on_a_node_set_acts_on_the_faces_that_it_holds(tmp_path: Path) -> None:
    drawn = block((0.04, 0.04, HEIGHT), (2, 2, 1), "hex8")
    sets = {"floor": drawn.set_nodes("z_min"), "lid": drawn.set_nodes("z_max"), "corner": np.array([0])}
    save_mesh(tmp_path / "block.inp", replace(drawn, surfaces={}, node_sets=sets), "mm")
    mesh = {"file": str(tmp_path / "block.inp"), "unit": "mm"}
    pull = {"kind": "traction", "on": "lid", "traction": ["0 Pa", "0 Pa", "pull"]}
    floor = [{"kind": "fixed", "on": "floor"}]
    outputs = snapshot(mesh=mesh, supports=floor, loads=[pull]).outputs
    np.testing.assert_allclose(outputs["force_floor"], [0.0, 0.0, -PULLED], atol=1e-6 * PULLED)
    with pytest.raises(StudyError, match="load 1: on: 'corner' is a node set that holds no whole face"):
        snapshot(mesh=mesh, supports=floor, loads=[pull | {"on": "corner"}])


def test_a_block_sinks_into_its_foundation() -> None:
    """Sinking = pressure over stiffness."""
    springs = {"kind": "foundation", "on": "z_min", "stiffness": "4 N/mm3 * share"}
    load = {"kind": "traction", "on": "z_max", "traction": ["0 Pa", "0 Pa", "-pull"]}
    parameters = PARAMETERS | {"share": {"range": [0.1, 1.0], "default": 1.0}}
    found = snapshot(supports=[springs], loads=[load], parameters=parameters)
    base = found.fields["displacement"][:, 2].max()
    assert base == pytest.approx(-1e4 / 2e9, rel=2e-2)


def test_a_set_moves_as_it_is_told() -> None:
    """Turned by the tilt about y through a given point and shifted by the place."""
    top = {
        "kind": "rotation",
        "on": "z_max",
        "axis": [0, 2, 0],
        "angle": "0.1 * tilt",
        "centre": ["0 mm", "0 mm", "20 mm"],
        "translation": ["place", "0 mm", "1 mm"],
    }
    displacement = snapshot(supports=[FIXED, top]).fields["displacement"]
    angle = 0.1 * np.pi / 6.0
    far = np.array([0.04 * np.cos(angle) - 0.04 + 0.004, 0.0, -0.04 * np.sin(angle) + 0.001])
    distance = np.linalg.norm(displacement - far, axis=1)
    assert distance.min() < 1e-12
    shifted = {"kind": "displacement", "on": "z_max", "x": "place", "z": "-0.5 * place"}
    displacement = snapshot(supports=[FIXED, shifted]).fields["displacement"]
    assert np.linalg.norm(displacement[:, [0, 2]] - [0.004, -0.002], axis=1).min() < 1e-12


@pytest.mark.parametrize("index", [2, 3, 4], ids=["load position", "fibre angle", "material constant"])
def test_derivatives_by_a_parameter_agree_with_differences(index: int) -> None:
    fibred = {
        "law": "transversely_isotropic",
        "young_fibre": "5 * young",
        "young_cross": "young",
        "poisson_fibre": 0.3,
        "poisson_cross": 0.3,
        "shear_fibre": "1 MPa",
        "fibre": {"angle": "tilt", "from": [1, 0, 0], "towards": [0, 1, 0]},
    }
    loads = [
        {"kind": "moving_patch", **PATCH, "force": ["3 N", "1 N", "-8 N"]},
        {"kind": "traction", "on": "x_max", "traction": ["pull", "0 Pa", "0 Pa"]},
    ]
    step = 1e-4 * np.array([1.0, 1.0, 0.01, 1.0, 1e6]) * np.eye(5)[index]
    at, before, after = (snapshot(mu, materials={"m": fibred}, loads=loads) for mu in (MU, MU - step, MU + step))
    for name in ("displacement", "stress_solid", "strain"):
        slope = (after.fields[name] - before.fields[name]) / (2.0 * step[index])
        assert np.abs(slope).max() > 0.0
        found = at.sensitivities[name][index]
        np.testing.assert_allclose(found, slope, atol=1e-4 * np.abs(slope).max())


def test_gravity_without_a_density_is_refused() -> None:
    """It would be a load that is silently not there; no weight must be said."""
    massless = {key: value for key, value in STIFF.items() if key != "density"}
    weight = {"loads": [{"kind": "gravity"}]}
    with pytest.raises(StudyError, match="gravity needs densities, and the material stiff has none"):
        snapshot(materials={"stiff": massless}, **weight)
    light = massless | {"density": "0 kg/m3"}
    np.testing.assert_allclose(snapshot(materials={"stiff": light}, **weight).outputs["force_z_min"], 0.0)


#: A contact at `MU`, and how far points (n, 3) of the top, or of the side, are from the obstacle there, m.
SOFT = {"law": "neo_hookean", "young": "young", "poisson": 0.3}
CONTACTS: dict[str, tuple[dict[str, Any], Callable[[np.ndarray], np.ndarray]]] = {
    "plane": (
        {"on": "z_max", "point": ["0 mm", "0 mm", "20 mm - 2 mm * share"], "normal": [0.0, 0.0, -1.0]},
        lambda x: 0.019 - x[:, 2],
    ),
    "sphere": (
        {"on": "z_max", "centre": ["20 mm + place", "20 mm", "35 mm - 4 mm * share"], "radius": "15 mm"},
        lambda x: np.linalg.norm(x - [0.024, 0.02, 0.033], axis=1) - 0.015,
    ),
    "cylinder": (
        {
            "on": "z_max",
            "point": ["0 mm", "20 mm", "35 mm - 4 mm * share"],
            "axis": [1, 0, 0],
            "radius": "place + 11 mm",
        },
        lambda x: np.linalg.norm(x[:, 1:] - [0.02, 0.033], axis=1) - 0.015,
    ),
}


@pytest.mark.parametrize("kind", CONTACTS)
def test_what_a_contact_keeps_out(kind: str) -> None:
    section, gap = CONTACTS[kind]
    mesh = {"generator": "block", "size": ["40 mm", "40 mm", "20 mm"], "divisions": [8, 8, 3], "cells": "hex8"}
    contacts, materials = [{"kind": kind} | section], {"rubber": SOFT}
    solved = snapshot(mesh=mesh, materials=materials, contacts=contacts)
    body = block((0.04, 0.04, HEIGHT), (8, 8, 3), "hex8")
    nodes = body.set_nodes(section["on"])
    rest = body.nodes[nodes]
    moved = gap(rest + solved.fields["displacement"][nodes])
    # The obstacle has come a millimetre and more into where the block was, which gives way by less than a tenth of that
    # and, with its flat faces, touches near nodes.
    assert gap(rest).min() < -0.9e-3
    assert -0.9e-4 < moved.min() < 3e-4


def test_a_mesh_file_is_an_obstacle(tmp_path: Path) -> None:
    """A ball as a file in millimetres keeps out what a sphere does; its content is part of the study's fingerprint."""
    file = tmp_path / "ball.stl"
    trimesh.creation.icosphere(5, radius=15.0).export(file)
    section, _ = CONTACTS["sphere"]
    place = {"on": "z_max", "place": section["centre"], "file": str(file), "unit": "mm", "spacing": "1 mm"}
    study = {"materials": {"rubber": SOFT}}
    sphere = snapshot(**study, contacts=[{"kind": "sphere"} | section]).fields["displacement"]
    found = snapshot(**study, contacts=[{"kind": "mesh"} | place]).fields["displacement"]
    np.testing.assert_allclose(found, sphere, atol=5e-3 * np.abs(sphere).max())
    before = study_of(**study, contacts=[{"kind": "mesh"} | place]).fingerprint()
    trimesh.creation.icosphere(4, radius=15.0).export(file)
    assert study_of(**study, contacts=[{"kind": "mesh"} | place]).fingerprint() != before
    with pytest.raises(StudyError, match=r"contact 1: cannot read the surface .*none\.stl"):
        study_of(**study, contacts=[{"kind": "mesh"} | place | {"file": str(tmp_path / "none.stl")}])


def test_surfaces_in_contact_are_sets_of_the_mesh() -> None:
    materials, touching = {"rubber": SOFT}, {"kind": "surface", "on": "z_max"}
    alone, with_itself = snapshot(materials=materials), snapshot(materials=materials, contacts=[touching])
    # A top that meets nothing is not changed.
    np.testing.assert_array_equal(alone.fields["displacement"], with_itself.fields["displacement"])
    with pytest.raises(StudyError, match="no surface 'lid'"):
        snapshot(materials=materials, contacts=[touching | {"against": "lid"}])
