"""What a solid refuses, and what it warns of."""

from __future__ import annotations

import re
import tomllib
from dataclasses import replace
from pathlib import Path

import ngsolve as ngs
import numpy as np
import pytest

from morph_dslam.errors import SolverError, StudyError
from morph_dslam.mechanics.contact import RigidPlane
from morph_dslam.mechanics.kinematics import ShapeField
from morph_dslam.mechanics.loads import DeadTraction, FollowerPressure, MovingPatch, PointLoad
from morph_dslam.mechanics.materials.anisotropic import Orthotropic
from morph_dslam.mechanics.materials.isotropic import NeoHookean
from morph_dslam.mechanics.materials.user import UserMaterial
from morph_dslam.mechanics.parameters import ParameterSymbols
from morph_dslam.mechanics.solid import SolidOptions, SolidProblem
from morph_dslam.mechanics.solid_materials import NearlyIncompressibleWarning
from morph_dslam.mechanics.solvers.continuation import PathError
from morph_dslam.mechanics.supports import ElasticFoundation, PrescribedDisplacement, RigidRotation, fixed
from morph_dslam.meshing.generators import block
from morph_dslam.model import Parameter
from morph_dslam.studies.build import build, build_warnings
from morph_dslam.studies.provenance import study_warnings
from morph_dslam.studies.study import load_study, make_study
from tests.support.block_study import write_study
from tests.support.meshes import SHEET
from tests.support.solids import RUBBER, load_parameter, solved

MESH = block((1.0, 1.0, 1.0), (2, 1, 1), "hex8")
HALVES = replace(MESH, cell_sets={"left": np.array([0]), "right": np.array([1])})
SOFT = NeoHookean(young=1e6, poisson=0.4999)
SOFT_WITHOUT_SPLIT = Orthotropic(
    young_1=1e6,
    young_2=1e6,
    young_3=1e6,
    poisson_12=0.4999,
    poisson_13=0.4999,
    poisson_23=0.4999,
    shear_12=1e6 / 2.9998,
    shear_13=1e6 / 2.9998,
    shear_23=1e6 / 2.9998,
)


def test_unknown_sets_are_named_with_the_known_ones() -> None:
    with pytest.raises(StudyError, match=r"no node set or surface 'lid'; it has: .*z_max"):
        SolidProblem(MESH, {"all": RUBBER}, [fixed("lid")])
    with pytest.raises(StudyError, match=r"no surface 'lid'"):
        SolidProblem(MESH, {"all": RUBBER}, [fixed("x_min")], [FollowerPressure("lid", 1.0)])
    with pytest.raises(StudyError, match=r"no node set or surface 'lid'"):
        SolidProblem(MESH, {"all": RUBBER}, [fixed("x_min")], [PointLoad("lid", (1.0, 0.0, 0.0))])
    with pytest.raises(StudyError, match=r"no cell set 'core'"):
        SolidProblem(MESH, {"core": RUBBER}, [fixed("x_min")])


def test_every_cell_has_one_material() -> None:
    with pytest.raises(StudyError, match="1 of 2 cells have no material"):
        SolidProblem(HALVES, {"left": RUBBER}, [fixed("x_min")])
    overlap = replace(HALVES, cell_sets={"left": np.array([0]), "both": np.array([0, 1])})
    with pytest.raises(StudyError, match="both 'left' and 'both'"):
        SolidProblem(overlap, {"left": RUBBER, "both": RUBBER}, [fixed("x_min")])


def test_two_materials_in_series_stretch_in_inverse_proportion_to_their_stiffness() -> None:
    symbols = load_parameter(load=0.0)
    stiff = NeoHookean(young=3e6, poisson=0.0)
    materials = {"all": NeoHookean(young=1e6, poisson=0.0), "right": stiff}
    load = DeadTraction("x_max", (symbols["load"], 0.0, 0.0))
    problem = SolidProblem(HALVES, materials, [fixed("x_min")], [load], symbols)
    state = solved(problem, 1.0)
    u = problem.nodal_displacement(state.dofs)
    middle, end = u[np.isclose(MESH.nodes[:, 0], 0.5), 0], u[MESH.set_nodes("x_max"), 0]
    np.testing.assert_allclose(middle, 0.5e-6, rtol=1e-5)
    np.testing.assert_allclose(end - middle, 0.5e-6 / 3.0, rtol=1e-5)


def test_an_unstable_material_is_refused_by_its_set() -> None:
    with pytest.raises(StudyError, match=r"material of 'all'.*young"):
        SolidProblem(MESH, {"all": NeoHookean(young=-1e6, poisson=0.3)}, [fixed("x_min")])
    with pytest.raises(StudyError, match=r"material of 'all'.*poisson"):
        SolidProblem(MESH, {"all": NeoHookean(young=1e6, poisson=0.6)}, [fixed("x_min")])


@pytest.mark.parametrize(
    ("supports", "words"),
    [
        ([], "move along x, y, z and to turn about x, y, z"),
        ([PrescribedDisplacement("z_min", z=0.0)], "move along x, y and to turn about z"),
        ([ElasticFoundation("x_min", 1e6, normal_only=True)], "move along y, z and to turn about x"),
        (
            [PrescribedDisplacement("z_min", z=0.0), ElasticFoundation("x_min", 0.0)],
            "move along x, y and to turn about z: .*whose stiffness is positive",
        ),
    ],
)
def test_missing_supports_are_described(supports: list, words: str) -> None:
    with pytest.raises(StudyError, match=f"free to {words}"):
        SolidProblem(MESH, {"all": RUBBER}, supports)


def test_an_obstacle_that_overlaps_at_rest_is_refused() -> None:
    above = RigidPlane("x_max", (0.9, 0.0, 0.0), (-1.0, 0.0, 0.0))
    with pytest.raises(StudyError, match=r"the plane reaches 100 mm into the undeformed surface 'x_max'"):
        SolidProblem(MESH, {"all": RUBBER}, [fixed("x_min")], contacts=[above])
    SolidProblem(MESH, {"all": RUBBER}, [fixed("x_min")], contacts=[replace(above, point=(1.0, 0.0, 0.0))])
    turned = replace(above, point=(1.1, 0.0, 0.0), normal=(1.0, 0.0, 0.0))
    with pytest.raises(StudyError, match="all of the solid lies behind it, so turn its normal round"):
        SolidProblem(MESH, {"all": RUBBER}, [fixed("x_min")], contacts=[turned])
    with pytest.raises(StudyError, match="the normal of the contact on 'x_max' has no direction"):
        replace(above, normal=(0.0, 0.0, 0.0))
    with pytest.raises(StudyError, match="no surface 'lid'"):
        SolidProblem(MESH, {"all": RUBBER}, [fixed("x_min")], contacts=[replace(above, on="lid")])


@pytest.mark.parametrize(("depth", "refused"), [("2 mm * wave", False), ("1 mm", True)])
def test_an_obstacle_that_overlaps_at_first_may_be_moved_by_an_amplitude_alone(depth: str, refused: bool) -> None:
    """Whose derivative by the time is zero at the defaults: 1 mm deep there, and deeper later on."""
    wave = {"times": ["0 s", "1 s", "5 s"], "values": [0.5, 0.5, 1.0]}
    content = {
        "name": "block",
        "mesh": {"generator": "block", "size": ["20 mm", "20 mm", "20 mm"], "divisions": [2, 2, 2], "cells": "hex8"},
        "materials": {
            "m": {
                "law": "neo_hookean",
                "young": "1 MPa",
                "poisson": 0.3,
                "prony": {"relative_moduli": [0.5], "times": ["1 s"]},
            }
        },
        "supports": [{"kind": "fixed", "on": "z_min"}],
        "contacts": [
            {"kind": "sphere", "on": "z_max", "centre": ["10 mm", "10 mm", f"30 mm - {depth}"], "radius": "10 mm"}
        ],
        "parameters": {"t": {"range": ["0 s", "5 s"], "default": "0 s"}},
        "time": {"parameter": "t", "step": "0.5 s", "amplitudes": {"wave": wave}},
    }
    if refused:
        content["loads"] = [{"kind": "pressure", "on": "x_max", "pressure": "1 kPa * wave"}]
        with pytest.raises(StudyError, match="the sphere reaches 1 mm into the undeformed surface 'z_max'"):
            make_study(content).sweep_problem()
    else:
        assert make_study(content).sweep_problem()


def test_a_cell_without_stiffness_is_a_failed_solve() -> None:
    """A law whose energy ends at twice the volume, in cells with enhanced strains."""

    def energy(F: ngs.CF) -> ngs.CF:
        volume = ngs.Det(F)
        sound = 0.5 * ngs.InnerProduct(F, F) - ngs.log(volume) + 0.5 * (volume - 1.0) ** 2
        return ngs.IfPos(2.0 - volume, sound, 0.0)

    problem = SolidProblem(MESH, {"all": UserMaterial(function=energy)}, [fixed("x_min")])
    grown = np.zeros(problem.n_dofs)
    grown[: 3 * problem.displacements.n_scalar] = problem.displacements.coordinates.T.ravel()
    with pytest.raises(SolverError, match="tangent of a cell is singular"):
        problem.linearise(grown, np.zeros(0))


def test_an_elastic_foundation_is_support_enough() -> None:
    """A stiff block on springs sinks by its load over their stiffness."""
    symbols = load_parameter(load=0.0)
    supports = [ElasticFoundation("z_min", 1e3)]
    load = DeadTraction("z_max", (0.0, 0.0, -symbols["load"]))
    problem = SolidProblem(MESH, {"all": NeoHookean(young=1e12, poisson=0.0)}, supports, [load], symbols)
    state = solved(problem, 1.0)
    np.testing.assert_allclose(problem.nodal_displacement(state.dofs)[:, 2], -1e-3, rtol=1e-6)


def test_locking_elements_are_flagged_and_mixed_ones_are_not() -> None:
    with pytest.warns(NearlyIncompressibleWarning, match=r"0\.4999.*use mixed elements"):
        problem = SolidProblem(MESH, {"all": SOFT}, [fixed("x_min")], options=SolidOptions(mixed=False))
    assert "nearly incompressible" in problem.flags[0]
    assert SolidProblem(MESH, {"all": SOFT}, [fixed("x_min")], options=SolidOptions(mixed=True)).flags == ()
    assert SolidProblem(MESH, {"all": SOFT}, [fixed("x_min")]).flags == ()
    assert SolidProblem(MESH, {"all": SOFT_WITHOUT_SPLIT}, [fixed("x_min")]).flags == ()
    linear = block((1.0, 1.0, 1.0), (1, 1, 1), "tet4")
    assert SolidProblem(linear, {"all": SOFT}, [fixed("x_min")]).flags == ()
    with pytest.warns(NearlyIncompressibleWarning, match="of order 2"):
        SolidProblem(linear, {"all": SOFT}, [fixed("x_min")], options=SolidOptions(order=1))


def test_cells_that_do_not_serve_are_refused() -> None:
    with pytest.raises(StudyError, match="quad4 are no solids"):
        SolidProblem(SHEET, {"all": RUBBER})
    tetrahedra = block((1.0, 1.0, 1.0), (1, 1, 1), "tet4")
    with pytest.raises(StudyError, match="use tet10"):
        SolidProblem(tetrahedra, {"all": SOFT}, [fixed("x_min")], options=SolidOptions(order=1, mixed=True))
    quadratic = block((1.0, 1.0, 1.0), (1, 1, 1), "hex20")
    with pytest.raises(StudyError, match="order 1 on cells of order 2"):
        SolidProblem(quadratic, {"all": RUBBER}, [fixed("x_min")], options=SolidOptions(order=1))


def test_parameters_shapes_and_directions_are_checked() -> None:
    symbols = load_parameter(a=0.0)
    with pytest.raises(StudyError, match="no parameter 'b'; there are: a"):
        symbols["b"]
    twice = Parameter("a", "ratio", "1", 0.0, 1.0, 0.0)
    with pytest.raises(StudyError, match="same name"):
        ParameterSymbols([twice, twice])
    with pytest.raises(StudyError, match=r"shape field 0 has shape \(4, 3\)"):
        SolidProblem(MESH, {"all": RUBBER}, [fixed("x_min")], shape=[ShapeField(1.0, np.zeros((4, 3)))])
    with pytest.raises(StudyError, match="'x_max' has no direction"):
        RigidRotation("x_max", (0.0, 0.0, 0.0), 0.1)
    with pytest.raises(StudyError, match="width 0 m"):
        MovingPatch("z_max", (0.0, 0.0, 1.0), (0.0, 0.0, 1.0), 0.0)


def test_a_load_that_cannot_be_carried_keeps_what_converged() -> None:
    """A column pushed far past its buckling load: the last converged load is said and its state kept."""
    symbols = load_parameter(load=0.0)
    mesh = block((1.0, 0.1, 0.1), (6, 1, 1), "hex20")
    load = DeadTraction("x_max", (-1e6 * symbols["load"], 0.0, 1e3 * symbols["load"]))
    problem = SolidProblem(mesh, {"all": RUBBER}, [fixed("x_min")], [load], symbols)
    with pytest.raises(PathError, match=r" at load = .*parameters that converged are load = \d") as caught:
        solved(problem, 200.0)
    kept = caught.value.states[-1]
    assert 0.0 < kept.mu[0] < 200.0
    residual = problem.residual(kept.dofs, kept.mu)
    assert np.abs(residual[problem.free]).max() < 1e-6 * np.abs(residual).max()


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ([], []),
        ([("poisson = 0.3", "poisson = 0.4995")], []),
        (
            [("poisson = 0.3", "poisson = 0.4995"), ("threads = 1", 'formulation = "displacement"')],
            ["'rubber' is nearly incompressible (Poisson's ratio 0.4995)"],
        ),
        ([("poisson = 0.3", "poisson = 0.4995"), ("threads = 1", 'formulation = "mixed"')], []),
    ],
)
def test_elements_that_lock_are_said_of_a_study(tmp_path, changes, expected):
    """Young's modulus is a parameter there; its default counts."""
    found = study_warnings(load_study(write_study(tmp_path, *changes)))
    assert len(found) == len(expected)
    for line, part in zip(found, expected, strict=True):
        assert part in line
        assert line.endswith('leave out solver.formulation = "displacement"')


def test_a_parameter_that_changes_nothing_is_refused_by_a_build(tmp_path):
    study = write_study(tmp_path, ('"pull"]', '"300 kPa"]'))
    with pytest.raises(StudyError, match=r"study\.toml: the parameter pull is used nowhere in the study"):
        build(study, tmp_path / "block.morph")


def test_build_warns_of_elements_method_and_stability():
    certificate = {"warnings": ["locks"], "reduction": {"warnings": ["too few samples"]}}
    assert build_warnings(certificate) == ["locks", "too few samples"]
    assert build_warnings({"reduction": {}}) == []


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (('"2 MPa"', '"1e300 MPa"'), "parameters.young: '1e300 MPa' cannot be meant"),
        (("poisson = 0.3", "poisson = nan"), "materials.rubber: poisson: 'nan' cannot be meant"),
        (('"20 mm", "20 mm", "60 mm"', '"20 mm", "20 mm", "1e300 mm"'), "mesh.size, entry 3: '1e300 mm' cannot"),
        (("divisions = [1, 1, 3]", "divisions = [500, 500, 500]"), "mesh.divisions: these make 125000000 cells"),
        (("training = 24", "training = 1000000000"), "sampling.training: "),
        (("training = 24", "training = 24\nseed = -1"), "sampling.seed: "),
    ],
)
def test_numbers_that_no_study_means_are_one_message(tmp_path, change, message):
    with pytest.raises(StudyError) as caught:
        load_study(write_study(tmp_path, change))
    assert str(caught.value).startswith(f"{tmp_path / 'study.toml'}: ")
    assert message in str(caught.value)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("bend = [0.5, 1.2]", "bend = [0.5, inf]"), "parameters.bend, entry 2: inf must be a finite number"),
        (('depth = "12 mm"', 'depth = "nan mm"'), "grips.depth: 'nan mm' cannot be meant"),
        (("divisions = [8, 6]", "divisions = [0, 6]"), "solver.divisions, entry 1: 0 must be at least 1"),
        (("grid = [48, 34]", "grid = [48, 100000]"), "reduction.grid, entry 2: 100000 must be at most 1000"),
    ],
)
def test_numbers_that_no_sheet_means_are_one_message(change, message):
    text = (Path(__file__).parents[2] / "examples/demo/study.toml").read_text()
    assert change[0] in text
    with pytest.raises(StudyError, match=re.escape(message)):
        make_study(tomllib.loads(text.replace(*change)))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (('"2 MPa", "4 MPa"', '"0 MPa", "4 MPa"'), "young = 0 must be positive"),
        (
            ('range = ["2 MPa", "4 MPa"]', 'range = ["-1 MPa", "4 MPa"]\ndefault = "3 MPa"'),
            "young = -1e+06 must be positive where young = -1 MPa: change its range",
        ),
        (("poisson = 0.3", 'poisson = 0.3\ndensity = "-1 g/cm3"'), "density = -1000 must not be negative"),
    ],
)
def test_constants_that_no_material_has_anywhere_in_the_box_are_refused(tmp_path, change, message):
    with pytest.raises(StudyError, match=r"materials\.rubber: ") as caught:
        load_study(write_study(tmp_path, change))
    assert message in str(caught.value)


def test_poissons_ratio_that_reaches_zero_is_refused_in_mixed_elements_before_anything_is_solved(tmp_path):
    changes = [
        ("poisson = 0.3", 'poisson = "nu"'),
        ("[solver]", '[parameters.nu]\nrange = [0.0, 0.4]\ndefault = 0.3\n[solver]\nformulation = "mixed"'),
    ]
    with pytest.raises(StudyError, match=r"mixed elements cannot take neo_hookean where .*nu = 0: .* range of nu"):
        load_study(write_study(tmp_path, *changes)).sweep_problem()
    changes[1] = (changes[1][0], changes[1][1].replace("0.0, 0.4", "0.1, 0.4"))
    assert load_study(write_study(tmp_path, *changes)).sweep_problem()
