"""Mistakes in a study that would show after its solves, or never: each is one message before anything is solved."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from morph_dslam.cli import app as cli
from morph_dslam.errors import ParameterError, StudyError
from morph_dslam.mechanics.contact import RigidCylinder, RigidSphere
from morph_dslam.mechanics.supports import ElasticFoundation
from morph_dslam.reduction.regression import fit_functions
from morph_dslam.studies.defaults import resolve_defaults
from morph_dslam.studies.provenance import study_warnings
from morph_dslam.studies.study import Study, make_study
from tests.support.small_models import block_model

RUBBER = {"law": "neo_hookean", "young": "1 MPa", "poisson": 0.3}
VISCOUS = {"m": RUBBER | {"prony": {"relative_moduli": [0.6], "times": ["1 s"]}}}
SOLID: dict[str, Any] = {
    "name": "block",
    "mesh": {"generator": "block", "size": ["20 mm"] * 3, "divisions": [4, 4, 2], "cells": "hex8"},
    "materials": {"m": RUBBER},
    "supports": [{"kind": "fixed", "on": "z_min"}],
    "loads": [{"kind": "traction", "on": "z_max", "traction": ["0 Pa", "0 Pa", "1 kPa * p / 1 mm"]}],
    "parameters": {"p": {"range": ["-15 mm", "10 mm"]}},
}
SHELL: dict[str, Any] = {
    "name": "plate",
    "mesh": {"generator": "plate", "size": ["100 mm", "20 mm"], "divisions": [4, 2]},
    "shell": {"thickness": "1 mm"},
    "material": {"young": "1 GPa", "poisson": 0.3},
    "supports": [{"kind": "clamped", "on": "x_min"}],
    "loads": [{"kind": "edge", "on": "x_max", "force": ["0 N/m", "0 N/m", "0.1 N/m * p / 1 mm"]}],
    "parameters": {"p": {"range": ["0 mm", "1 mm"]}},
}
CLAMPED = SHELL["supports"]
SPHERE = {"kind": "sphere", "on": "z_max", "centre": ["10 mm", "10 mm", "45 mm"]}
CYLINDER = {"kind": "cylinder", "on": "z_max", "point": ["10 mm", "10 mm", "45 mm"], "axis": [1, 0, 0]}
PATCH = {"kind": "moving_patch", "on": "z_max", "force": ["0 N", "0 N", "-1 N"], "centre": ["p", "10 mm", "20 mm"]}
LIFTED = {"kind": "displacement", "on": "z_max", "z": "p"}
LINE = PATCH | {"kind": "moving_line", "direction": [0, 1, 0], "force": ["0 N/m", "0 N/m", "-1 N/m"]}


HALVES = {
    "near": {"of": "z_max", "box": [["0 mm", "0 mm", "0 mm"], ["10 mm", "20 mm", "20 mm"]]},
    "far": {"of": "z_max", "box": [["10 mm", "0 mm", "0 mm"], ["20 mm", "20 mm", "20 mm"]]},
}
HELD_HALVES = [{"kind": "displacement", "on": name, "z": "0 mm"} for name in HALVES]


def clock(*ends: str, step: str = "1 s", **more: str) -> dict[str, Any]:
    parameters = SOLID["parameters"] | {"t": {"range": list(ends), **more}}
    return {"materials": VISCOUS, "time": {"parameter": "t", "step": step}, "parameters": parameters}


def stiff(young: str, *ends: str, **more: Any) -> dict[str, Any]:
    return {"materials": {"m": RUBBER | {"young": young} | more}, "parameters": {"p": {"range": list(ends)}}}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"contacts": [SPHERE | {"radius": "-15 mm"}]}, "contact 1: radius = -15 mm must be positive"),
        ({"contacts": [CYLINDER | {"radius": "0 mm"}]}, "contact 1: radius = 0 mm must be positive"),
        (
            {"contacts": [SPHERE | {"radius": "5 mm + p"}]},
            "contact 1: radius = -10 mm must be positive where p = -15 mm: change its range",
        ),
        (
            {
                "contacts": [SPHERE | {"radius": "5 mm - p - q"}],
                "parameters": {"p": {"range": ["0 mm", "4 mm"]}, "q": {"range": ["0 mm", "4 mm"]}},
            },
            "contact 1: radius = -3 mm must be positive where p = 4 mm, q = 4 mm: change their ranges",
        ),
        (
            {"supports": [*SOLID["supports"], {"kind": "foundation", "on": "x_min", "stiffness": "-1 MPa/mm"}]},
            "support 2: stiffness = -1 MPa/mm must not be negative",
        ),
        (clock("-5 s", "10 s"), "parameters.t: time starts at the lower end of its range, which cannot be below 0 s"),
        (clock("0 s", "10 s", default="5 s"), "parameters.t: time starts at the lower end; leave out the default"),
        (
            clock("0 s", "10 s", step="1e-9 s"),
            "time.step: 1e-09 s makes 1e+10 increments over the range of t, and 100000 are the most: take a longer",
        ),
        (clock("0 s", "10 s") | {"unknown_loads": {"on": "z_max"}}, "[unknown_loads] is for elastic solids"),
        (
            stiff("p", "-1 MPa", "1 MPa"),
            "materials.m: neo_hookean: young = 0 must be positive where p = 0 MPa: change its range",
        ),
        (
            stiff("p", "-2 MPa", "-1 MPa"),
            "materials.m: neo_hookean: young = -1e+06 must be positive where p = -1 MPa: change its range",
        ),
        (
            {"shape": [{"kind": "radius", "amplitude": "p", "axis": [0, 0, 0]}]},
            "shape 1: the axis of the radius has no direction: (0.0, 0.0, 0.0)",
        ),
    ],
)
def test_solids_that_cannot_be(change, message):
    with pytest.raises(StudyError) as caught:
        make_study(SOLID | change)
    assert str(caught.value).startswith(f"the study: {message}")


def test_a_constant_that_no_parameter_makes_wrong_accuses_none():
    with pytest.raises(StudyError) as caught:
        make_study(SOLID | stiff("p", "1 MPa", "2 MPa", poisson=0.6))
    assert "poisson = 0.6" in str(caught.value)
    assert "change its range" not in str(caught.value)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"material": {"young": "1 GPa", "poisson": 0.6}}, "material: poisson = 0.6 must be above -1 and at most 0.5"),
        ({"material": {"young": "1 GPa", "poisson": -1}}, "material: poisson = -1 must be above -1"),
        ({"material": {"young": "-1 GPa", "poisson": 0.3}}, "material: young = -1000 MPa must be positive"),
        (
            {"material": {"young": "1 GPa * p / 1 mm", "poisson": 0.3}},
            "material: young = 0 MPa must be positive where p = 0 mm: change its range",
        ),
        ({"shell": {"thickness": "p"}}, "shell: thickness = 0 mm must be positive where p = 0 mm: change its range"),
    ],
)
def test_shells_that_cannot_be(change, message):
    with pytest.raises(StudyError) as caught:
        make_study(SHELL | change)
    assert str(caught.value).startswith(f"the study: {message}")


def prepared(study: Study) -> None:
    """What a build does before its first solve."""
    resolve_defaults(study).sweep_problem()  # type: ignore[union-attr]


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (
            SOLID | {"loads": [PATCH | {"width": "2.4 mm"}]},
            "load 1: width = 2.4 mm is less than half a cell of 'z_max', the smallest of which measures 5 mm, .* "
            "make it 2.5 mm at least",
        ),
        (SOLID | {"loads": [*SOLID["loads"], LINE | {"width": "1 mm"}]}, "load 2: width = 1 mm is less than half"),
        (
            SOLID | {"loads": [PATCH | {"width": "5 mm", "centre": ["p", "10 mm", "20 m"]}]},
            r"load 1: its centre stays 1.998e\+04 mm or more away from 'z_max', and the mesh is 34.64 mm long: check",
        ),
        (
            SHELL | {"loads": [PATCH | {"on": "all", "width": "5 mm"}]},
            "load 1: width = 5 mm is less than half a cell of 'all', the smallest of which measures 15.81 mm",
        ),
        (
            SOLID | {"unknown_loads": {"on": "z_min"}},
            "unknown_loads.on: supports hold all of 'z_min', so that a pressure there moves nothing: name another",
        ),
        (SOLID | {"unknown_loads": {"on": "z_min", "direction": "any"}}, "so that a force there moves nothing"),
        (
            SOLID
            | {
                "supports": [*SOLID["supports"], {"kind": "displacement", "on": "z_max", "z": "0 mm"}],
                "unknown_loads": {"on": "z_max"},
            },
            "hold all of 'z_max', so that a pressure",
        ),
        (SHELL | {"unknown_loads": {"on": "x_max"}}, "unknown_loads.on: the mesh has no cell set 'x_max'"),
        (
            SHELL | {"supports": [*CLAMPED, {"kind": "symmetry", "on": "y_min", "axis": "x"}]},
            "support 2: the set 'y_min' is in no plane across x: it extends 100 mm along x",
        ),
        (
            SHELL | {"sets": {"far": {"nearest": ["900 mm", "0 mm", "0 mm"]}}},
            "sets.far: nearest is 800 mm away from the mesh, which is 100 mm long: give a point near it",
        ),
        (
            SOLID | clock("0 s", "10 s") | {"sampling": {"scheme": "sobol", "training": 9}},
            "sampling.training: 9 samples are too few for 2 parameters: give 10 at least",
        ),
        (
            SOLID | {"shape": [{"kind": "thickness", "on": "z_max", "kept": "z_min", "amplitude": "2 * p"}]},
            "the shape at p = -15 mm: 32 of 32 hex8 cells are inverted or folded, .*: narrow the range of p$",
        ),
        (
            SOLID
            | {
                "shape": [{"kind": "radius", "amplitude": "1 m * p"}],
                "parameters": {"p": {"range": [0.0, 9.0]}},
                "loads": [],
            },
            r"the shape at p = 9: the body measures 9.02 x .* hardly meant: narrow the range of p$",
        ),
        (
            SOLID | {"shape": [{"kind": "thickness", "on": "z_max", "kept": "z_max", "amplitude": "p"}]},
            "shape 1: surfaces 'z_max' and 'z_max' share 25 nodes",
        ),
        (
            SOLID | {"supports": [*SOLID["supports"], LIFTED | {"z": "1 mm"}, LIFTED], "loads": []},
            r"support 3: its z does nothing, because support 2 \('z_max'\), listed before it, holds z at every",
        ),
        (SOLID | {"supports": [*SOLID["supports"], LIFTED, LIFTED | {"z": "0 mm"}]}, "support 3: its z does nothing"),
        (  # only y of the two is new
            SOLID | {"supports": [*SOLID["supports"], LIFTED, LIFTED | {"y": "p", "z": "2 * p"}]},
            "support 3: its z does nothing",
        ),
        (  # both halves of a top that is held
            SOLID | {"sets": HALVES, "supports": [*SOLID["supports"], *HELD_HALVES, LIFTED]},
            r"support 4: its z does nothing, because support 2 \('near'\) and support 3 \('far'\), listed before it,",
        ),
        (
            SHELL | {"supports": [*CLAMPED, {"kind": "displacement", "on": "x_min", "z": "p"}]},
            r"support 2: its z does nothing, because support 1 \('x_min'\)",
        ),
    ],
)
def test_what_a_mesh_does_not_allow(content, message):
    with pytest.raises(StudyError, match=message):
        prepared(make_study(content))


@pytest.mark.parametrize(
    "content",
    [
        SOLID | {"supports": [*SOLID["supports"], {"kind": "foundation", "on": "x_min", "stiffness": "0 MPa/mm"}]},
        SOLID | {"loads": [PATCH | {"width": "2.5 mm"}]},
        SOLID | {"unknown_loads": {"on": "x_max"}},
        SOLID
        | {
            "supports": [*SOLID["supports"], {"kind": "displacement", "on": "z_max", "z": "0 mm"}],
            "unknown_loads": {"on": "z_max", "direction": "any"},
        },
        SOLID | {"couplings": [{"on": "z_max", "held": ["x", "y", "z", "rx", "ry", "rz"]}]},
        SOLID | clock("0 s", "10 s", step="1e-4 s") | {"sampling": {"training": 10}},
        SHELL | {"material": {"young": "1 GPa", "poisson": 0.5}},
        SHELL | {"supports": [*CLAMPED, {"kind": "symmetry", "on": "y_min", "axis": "y"}]},
        SHELL | {"sets": {"near": {"nearest": ["170 mm", "10 mm", "0 mm"]}}},
        SHELL | {"unknown_loads": {"on": "all"}},
        # Edges that two supports share, the same motion twice, a fixed set one of whose components moves.
        SOLID | {"supports": [*SOLID["supports"], {"kind": "displacement", "on": "x_max", "x": "p", "z": "p"}]},
        SOLID | {"supports": [*SOLID["supports"], LIFTED, LIFTED | {"z": "0.5 * p + 0.5 * p"}]},
        SOLID | {"supports": [*SOLID["supports"], LIFTED, {"kind": "fixed", "on": "z_max"}]},
        SOLID | {"sets": HALVES, "supports": [*SOLID["supports"], HELD_HALVES[0], LIFTED]},
    ],
)
def test_right_studies_are_not_accused(content):
    prepared(make_study(content))


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (SOLID | {"contacts": [SPHERE | {"radius": "-15 mm"}]}, "contact 1: radius = -15 mm must be positive"),
        (SOLID | {"unknown_loads": {"on": "z_min"}}, "unknown_loads.on: supports hold all of 'z_min'"),
    ],
)
def test_a_build_ends_with_one_message(tmp_path, capsys, content, message):
    path = tmp_path / "study.toml"
    path.write_text("\n".join(f"{key} = {toml(value)}" for key, value in content.items()))
    assert cli.main(["build", str(path), "-o", str(tmp_path / "x.morph")]) == 2
    assert f"morph: {path}: {message}" in capsys.readouterr().err
    assert not list(tmp_path.glob("*.snapshots/*.npz"))


def toml(value: Any) -> str:
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{key} = {toml(entry)}" for key, entry in value.items()) + " }"
    if isinstance(value, (list, tuple)):
        return f"[{', '.join(map(toml, value))}]"
    return f'"{value}"' if isinstance(value, str) else str(value)


@pytest.mark.parametrize("slopes", [False, True])
@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("degree", [1, 2, 8])
def test_as_many_samples_are_asked_for_as_a_regression_needs(degree, d, slopes):
    """The fewest that a study may have are the fewest that polynomials can be fitted to."""
    names = [f"q{k}" for k in range(d - 1)]
    loads = [{"kind": "traction", "on": "z_max", "traction": [f"1 kPa * {name}", "0 Pa", "0 Pa"]} for name in names]
    more = {name: {"range": [0.0, 1.0]} for name in names}
    base = SOLID if slopes else SOLID | clock("0 s", "10 s")
    base = base | {"parameters": base["parameters"] | dict(list(more.items())[: d - len(base["parameters"])])}
    base = base | {
        "loads": [*base["loads"], *loads[: d - 1 - (not slopes)]],
        "reduction": {"method": "pod", "max_degree": degree},
    }

    def allowed(count: int) -> bool:
        try:
            resolve_defaults(make_study(base | {"sampling": {"training": count, "scheme": "sobol"}}))
        except StudyError:
            return False
        return True

    def fitted(count: int) -> bool:
        x = np.random.default_rng(0).random((count, d))
        gradients = np.ones((count, d, 1)) if slopes else None
        try:
            fit_functions(x, x[:, :1], gradients, np.zeros(d), np.ones(d), degree, np.arange(count))
        except StudyError:
            return False
        return True

    counts = range(8, 20)
    assert [allowed(count) for count in counts] == [fitted(count) for count in counts]


def normal(x: float) -> float:
    return 0.5 * (1.0 + math.erf(x / math.sqrt(2.0)))


@pytest.mark.parametrize(
    ("load", "ends", "state"),
    [
        (PATCH, ("-3 mm", "10 mm"), -1.0),
        (PATCH, ("0 mm", "10 mm"), 0.0),
        (PATCH, ("4 mm", "10 mm"), 4.0 / 3.0),
        (LINE, ("0 mm", "10 mm"), 0.0),
        (LINE, ("4 mm", "10 mm"), 4.0 / 3.0),
    ],
)
def test_force_that_falls_beside_a_surface_is_said(load, ends, state):
    """Of a normal distribution, that part lands which is on the surface's side of its rim, ``state`` widths away."""
    study = make_study(
        SOLID | {"loads": [load | {"width": "3 mm"}], "parameters": {"p": {"range": list(ends), "default": "10 mm"}}}
    )
    (said,) = study_warnings(study)
    assert said.startswith(
        f"load 1: only {100.0 * normal(state):.0f} % of the force lands on 'z_max' where p = {ends[0]}"
    )


def test_force_that_lands_is_not_warned_of():
    inside = {"p": {"range": ["6 mm", "14 mm"]}}
    assert not study_warnings(make_study(SOLID | {"loads": [PATCH | {"width": "3 mm"}], "parameters": inside}))
    assert not study_warnings(make_study(SOLID | {"loads": [LINE | {"width": "3 mm"}], "parameters": inside}))
    off = {"p": {"range": ["200 mm", "300 mm"]}}
    for load in (PATCH, LINE):
        study = make_study(SOLID | {"loads": [load | {"width": "3 mm"}], "parameters": off})
        with pytest.raises(StudyError, match="load 1: nothing of the force lands on 'z_max' anywhere in the ranges"):
            study_warnings(study)


def test_a_force_that_passes_over_its_surface_between_the_ends_of_the_range_is_not_refused():
    passing = {"p": {"range": ["-60 mm", "80 mm"], "default": "-60 mm"}}
    (said,) = study_warnings(make_study(SOLID | {"loads": [PATCH | {"width": "3 mm"}], "parameters": passing}))
    assert said.startswith("load 1: nothing of the force lands on 'z_max' where p = -60 mm")


TUBE = {
    "generator": "tube",
    "inner_radius": "5 mm",
    "outer_radius": "10 mm",
    "length": "60 mm",
    "divisions": [24, 1, 36],
}


@pytest.mark.parametrize(
    ("y", "z", "said"),
    [
        (7, 30, ", for its centre lies 3 mm off the surface: put it on it, at "),
        (10, 2, ", and the rest falls beside it: keep the centre about two widths away from the rim"),
        (7, 2, ", and the rest falls beside it: keep the centre about two widths away from the rim"),
    ],
)
def test_a_centre_off_a_curved_surface_is_told_from_one_at_its_rim(y, z, said):
    """A tube of 10 mm about the z axis, 60 mm long: its rims are its ends."""
    patch = PATCH | {"on": "outer", "centre": ["p", f"{y} mm", f"{z} mm"], "width": "2 mm"}
    content = SOLID | {"mesh": TUBE, "supports": [{"kind": "fixed", "on": "bottom"}], "loads": [patch]}
    content |= {"parameters": {"p": {"range": ["-1 um", "1 um"]}}}
    (warning,) = study_warnings(make_study(content))
    assert said in warning


def test_at_the_corner_of_a_closed_surface_a_quarter_of_a_patch_is_missing():
    """Three quarters of planes meet there."""
    skin = {"skin": {"box": [["-1 mm"] * 3, ["21 mm"] * 3]}}
    patch = PATCH | {"on": "skin", "centre": ["20 mm + p", "20 mm", "20 mm"], "width": "2.5 mm"}
    content = SOLID | {"sets": skin, "loads": [patch], "parameters": {"p": {"range": ["-1 um", "1 um"]}}}
    (warning,) = study_warnings(make_study(content))
    assert "only 75 % of the force lands on 'skin'" in warning
    assert warning.endswith("which bends away from the patch, as at a corner: move its centre, or take a smaller width")


def test_a_slanting_line_ends_at_the_rim_without_loss():
    slanting = LINE | {"direction": [1, 1, 0], "centre": ["10 mm", "10 mm", "20 mm"], "width": "2.5 mm"}
    assert not study_warnings(make_study(SOLID | {"loads": [*SOLID["loads"], slanting]}))


def test_a_load_on_a_wall_that_grows_is_looked_at_where_the_wall_is():
    grown = [{"kind": "thickness", "on": "z_max", "kept": "z_min", "amplitude": "p"}]
    follows = PATCH | {"centre": ["10 mm", "10 mm", "20 mm + p"], "width": "3 mm"}
    parameters = {"p": {"range": ["0 mm", "8 mm"]}}
    assert not study_warnings(make_study(SOLID | {"loads": [follows], "shape": grown, "parameters": parameters}))
    stays = follows | {"centre": ["10 mm", "10 mm", "20 mm"]}
    (said,) = study_warnings(make_study(SOLID | {"loads": [stays], "shape": grown, "parameters": parameters}))
    assert said.startswith("load 1: only 3 % of the force lands on 'z_max' where p = 8 mm")


@pytest.mark.parametrize(("thickness", "warned"), [("4.9 mm", False), ("5.1 mm", True), ("4 mm + 2 * p", True)])
def test_a_thick_shell_is_said_to_be_none(thickness, warned):
    said = study_warnings(make_study(SHELL | {"shell": {"thickness": thickness}}))
    assert len(said) == warned
    assert all("mm thick and 100 mm long: above a twentieth of the size" in text for text in said)


def test_obstacles_springs_and_planes_of_a_problem_are_checked_too():
    with pytest.raises(StudyError, match="radius = -1 mm must be positive"):
        RigidSphere("z_max", (0.0, 0.0, 0.0), -1e-3)
    with pytest.raises(StudyError, match="radius = 0 mm must be positive"):
        RigidCylinder("z_max", (0.0, 0.0, 0.0), (0.0, 0.0, 1.0), 0.0)
    with pytest.raises(StudyError, match="stiffness = -1 MPa/mm must not be negative"):
        ElasticFoundation("z_max", -1e9)


def test_positions_of_no_number_are_refused_and_others_taken_at_the_nearest_end():
    model = block_model("tucker")
    with pytest.raises(ParameterError, match="the parameter 'pressure' is not a number"):
        model.positions({"pressure": math.nan})
    beyond, end = model.default.copy(), model.default.copy()
    beyond[0], end[0] = 7.0, 1.0
    np.testing.assert_array_equal(model.positions(beyond), model.positions(end))
