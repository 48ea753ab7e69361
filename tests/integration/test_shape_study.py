"""Shape parameters of a study: the same results as a mesh made with the other thickness or radius."""

from __future__ import annotations

from pathlib import Path

import meshio
import numpy as np
import pytest

from morph_dslam import build, make_study
from morph_dslam.errors import StudyError
from morph_dslam.studies.solid_study import SolidStudy

THICKNESS = {"kind": "thickness", "on": "outer", "kept": "inner", "amplitude": "growth"}
FIELD = {"kind": "field", "unit": "mm", "field": "growth", "amplitude": "growth / 1 mm"}
RADIUS = {"kind": "radius", "axis": [0, 0, 3], "amplitude": "-1 mm + 0.5 * growth"}


def write_field(path: Path, component: float = 1.0, skip: int = 0) -> dict:
    """A file in which all nodes of a tube move away from its axis by 1 mm, in any order; the shape that names it."""
    nodes = tube_study("20 mm", "30 mm", []).solid_mesh().nodes[skip:]
    nodes = np.random.default_rng(0).permutation(np.concatenate([nodes, [[0.0, 0.0, 0.5]]]))
    moves = component * nodes / np.maximum(np.linalg.norm(nodes[:, :2], axis=1, keepdims=True), 1e-9)
    moves[:, 2] = 0.0
    points = [("vertex", np.arange(len(nodes))[:, None])]
    meshio.Mesh(1e3 * nodes, points, point_data={"growth": moves, "age": nodes[:, 0]}).write(path)
    return FIELD | {"file": str(path)}


def tube_study(inner: str, outer: str, shape: list[dict]) -> SolidStudy:
    """A short tube, fixed below, turned at its upper end and blown up."""
    study = make_study(
        {
            "name": "tube",
            "mesh": {
                "generator": "tube",
                "inner_radius": inner,
                "outer_radius": outer,
                "length": "20 mm",
                "divisions": [3, 1, 12],
                "cells": "hex8",
            },
            "materials": {"rubber": {"law": "neo_hookean", "young": "3 MPa", "poisson": 0.4}},
            "supports": [
                {"kind": "fixed", "on": "bottom"},
                {"kind": "rotation", "on": "top", "axis": [0, 0, 1], "angle": "10 deg"},
            ],
            "loads": [{"kind": "pressure", "on": "inner", "pressure": "50 kPa"}],
            "shape": shape,
            "parameters": {"growth": {"range": ["-3 mm", "4 mm"]}},
            "solver": {"threads": 1},
            "sampling": {"scheme": "even", "training": 8, "held_out": 4, "refined": 0},
            "reduction": {"max_degree": 7, "tolerance": 1e-9},
        }
    )
    assert isinstance(study, SolidStudy)
    return study


@pytest.mark.parametrize(
    ("shape", "inner", "outer"),
    [([THICKNESS], "20 mm", "32 mm"), ([RADIUS], "20 mm", "30 mm"), ([THICKNESS, RADIUS], "20 mm", "32 mm")],
    ids=["thickness", "radius", "both"],
)
def test_a_snapshot_is_that_of_the_other_mesh(shape: list[dict], inner: str, outer: str) -> None:
    mu = np.array([0.002])
    morphed = tube_study("20 mm", "30 mm", shape)
    plain = tube_study(inner, outer, [])
    found, other = (study.sweep_problem() for study in (morphed, plain))
    one, expected = (s.take_snapshot(s.advance(s.first_state(), mu)) for s in (found, other))
    positions, wanted = (
        study.model_mesh().nodes + snapshot.fields["displacement"]
        for study, snapshot in ((morphed, one), (plain, expected))
    )
    np.testing.assert_allclose(positions, wanted, atol=1e-9)
    stress = expected.fields["stress_solid"]
    np.testing.assert_allclose(one.fields["stress_solid"], stress, atol=1e-6 * np.abs(stress).max())
    states = [found.take_snapshot(found.advance(found.first_state(), mu + h)) for h in (1e-6, -1e-6)]
    for name in ("displacement", "stress_solid"):
        slope = (states[0].fields[name] - states[1].fields[name]) / 2e-6
        np.testing.assert_allclose(one.sensitivities[name][0], slope, atol=1e-5 * np.abs(slope).max())


def test_a_displacement_field_moves_the_nodes(tmp_path: Path) -> None:
    mu = np.array([0.002])
    found = tube_study("20 mm", "30 mm", [write_field(tmp_path / "growth.vtu")]).sweep_problem()
    expected = tube_study("22 mm", "32 mm", []).sweep_problem()
    one, other = (s.take_snapshot(s.advance(s.first_state(), mu)) for s in (found, expected))
    scale = np.abs(other.fields["stress_solid"]).max()
    np.testing.assert_allclose(one.fields["stress_solid"], other.fields["stress_solid"], atol=1e-6 * scale)


def test_a_displacement_field_counts_by_its_content(tmp_path: Path) -> None:
    first, moved = write_field(tmp_path / "a.vtu"), write_field(tmp_path / "b.vtu")
    prints = [tube_study("20 mm", "30 mm", [shape]).fingerprint() for shape in (first, moved)]
    assert prints[0] == prints[1]
    write_field(tmp_path / "a.vtu", component=1.1)
    assert tube_study("20 mm", "30 mm", [first]).fingerprint() != prints[0]


def test_mistakes_in_a_displacement_field_are_named(tmp_path: Path) -> None:
    shape = write_field(tmp_path / "growth.vtu")
    with pytest.raises(StudyError, match=r"growth\.vtu has no point data 'swelling'; it has: .*growth"):
        tube_study("20 mm", "30 mm", [shape | {"field": "swelling"}]).problem()
    with pytest.raises(StudyError, match=r"'age' has 1 components in place of 3"):
        tube_study("20 mm", "30 mm", [shape | {"field": "age"}]).problem()
    with pytest.raises(StudyError, match=r"has no point at 96 of the mesh's 96 nodes, the first at .* cm"):
        tube_study("20 mm", "30 mm", [shape | {"unit": "cm"}]).problem()
    with pytest.raises(StudyError, match=r"cannot read the solution .*none\.vtu"):
        tube_study("20 mm", "30 mm", [shape | {"file": "none.vtu"}]).problem()
    with pytest.raises(StudyError, match=r"shape 1: unit: 'furlong' is not a unit of length"):
        tube_study("20 mm", "30 mm", [shape | {"unit": "furlong"}])
    with pytest.raises(StudyError, match=r"holds values that are not finite"):
        tube_study("20 mm", "30 mm", [write_field(tmp_path / "nan.vtu", component=np.nan)]).problem()
    with pytest.raises(StudyError, match=r"has no point at 3 of the mesh's 96 nodes, the first at \(20, 0, 0\) mm"):
        tube_study("20 mm", "30 mm", [write_field(tmp_path / "part.vtu", skip=3)]).problem()
    inwards = [shape | {"amplitude": "10 * growth / 1 mm"}]
    with pytest.raises(StudyError, match=r"the shape at growth = -3 mm: .*(inverted|folded)"):
        tube_study("20 mm", "30 mm", inwards).problem()


def test_a_model_has_the_shape_as_a_parameter(tmp_path) -> None:
    model = build(tube_study("20 mm", "30 mm", [THICKNESS]), tmp_path / "tube.morph")
    plain = tube_study("20 mm", "31.5 mm", [])
    sweep, mu = plain.sweep_problem(), np.array([0.0015])
    expected = plain.model_mesh().nodes + sweep.take_snapshot(sweep.first_state()).fields["displacement"]
    np.testing.assert_allclose(model.positions(mu), expected, atol=2e-6)
    assert model.certificate["stability"]["stable"] == 12


def test_mistakes_in_a_shape_are_named() -> None:
    inwards = THICKNESS | {"amplitude": "3.5 * growth"}
    with pytest.raises(StudyError, match=r"the shape at growth = -3 mm: .*(inverted|folded)"):
        tube_study("20 mm", "30 mm", [inwards]).problem()
    with pytest.raises(StudyError, match=r"no surface 'rim'"):
        tube_study("20 mm", "30 mm", [THICKNESS | {"kept": "rim"}]).problem()
    with pytest.raises(StudyError, match=r"the axis of the radius has no direction"):
        tube_study("20 mm", "30 mm", [RADIUS | {"axis": [0, 0, 0]}])
    with pytest.raises(StudyError, match=r"shape 1: 'growht' names 'growht', which is no parameter"):
        tube_study("20 mm", "30 mm", [THICKNESS | {"amplitude": "growht"}])
    with pytest.raises(StudyError, match=r"shape 1: unknown key width; known here: amplitude, kind"):
        tube_study("20 mm", "30 mm", [RADIUS | {"width": "1 mm"}])
