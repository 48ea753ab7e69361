"""What is said where loads are far too large: how far the body could be followed, and that the unit may be wrong."""

import re

import numpy as np
import pytest

from morph_dslam.errors import SolverError
from morph_dslam.studies.study import make_study

#: Half a kilopascal of c10 is a shear modulus of 1 kPa; the stiffer of two materials counts.
BLOCK = {
    "name": "block",
    "mesh": {"generator": "block", "size": ["20 mm", "20 mm", "40 mm"], "divisions": [1, 1, 4]},
    "sets": {"upper": {"box": [["0 mm", "0 mm", "20 mm"], ["20 mm", "20 mm", "40 mm"]]}},
    "materials": {
        "soft": {"law": "yeoh", "c10": "0.5 kPa", "bulk": "1 MPa"},
        "stiff": {"law": "neo_hookean", "young": "120 kPa", "poisson": "0.2", "on": "upper"},
    },
    "supports": [{"kind": "fixed", "on": "z_min"}],
}


TRACTION = {"kind": "traction", "on": "z_max", "traction": ["0 Pa", "-1 * t", "0 Pa"]}


FORCE = {"on": "z_max", "force": ["0 N", "0 N", "f"]}
LINE = {"kind": "moving_line", "direction": [0, 1, 0], "force": ["0 N/mm", "0 N/mm", "f"]}
MOVING = {"centre": ["10 mm", "10 mm", "40 mm"], "width": "4 mm"}


def advice(load, **ranges):
    parameters = {name: {"range": list(ends)} for name, ends in ranges.items()}
    return make_study(BLOCK | {"loads": [load], "parameters": parameters}).advice


def pressure(value):
    return {"kind": "pressure", "on": "z_max", "pressure": value}


@pytest.mark.parametrize(
    ("load", "ranges", "said"),
    [
        # The stiff material's G = E / (2 (1 + nu)) = 50 kPa.
        (pressure("p"), {"p": ("0 kPa", "12 MPa")}, "Load 1 reaches 12 MPa, 240 times"),
        (pressure("p - 2 MPa"), {"p": ("0 kPa", "10 kPa")}, "Load 1 reaches 2 MPa, 40 times"),
        (pressure("p + 0.5 * q"), {"p": ("0 kPa", "1 MPa"), "q": ("0 MPa", "1 MPa")}, "reaches 1.5 MPa, 30 times"),
        (TRACTION, {"t": ("0 MPa", "5 MPa")}, "100 times"),
        (pressure("p"), {"p": ("0 kPa", "990 kPa")}, None),
        # Over 4 cm2; and at their centres F / (2 pi w^2) and F / (sqrt(2 pi) w), with w = 4 mm.
        (FORCE | {"kind": "force"}, {"f": ("0 N", "1 kN")}, "Load 1 reaches 2.5 MPa, 50 times"),
        (FORCE | {"kind": "force"}, {"f": ("0 N", "390 N")}, None),
        (FORCE | MOVING | {"kind": "moving_patch"}, {"f": ("0 N", "1 kN")}, "Load 1 reaches 9.95 MPa, 199 times"),
        (FORCE | MOVING | LINE, {"f": ("0 N/mm", "50 N/mm")},
         "Load 1 reaches 4.99 MPa, 100 times"),
    ],
)  # fmt: skip
def test_stresses_that_no_such_material_bears(load, ranges, said):
    found = advice(load, **ranges)
    assert ("are its unit and that of the modulus right" in found) == (said is not None)
    assert (said or "Narrow the ranges") in found
    assert said is None or "the stiffest material (50 kPa)" in found


@pytest.mark.parametrize(
    ("coupling", "ranges", "said"),
    [
        ({"force": ["f", "0 N", "0 N"]}, {"f": ("0 N", "1 kN")}, "Coupling 1 reaches 2.5 MPa, 50 times"),
        ({"force": ["f", "0 N", "0 N"]}, {"f": ("0 N", "390 N")}, None),
        # 6 M / h^3 at the edges of a square, h = 20 mm.
        ({"moment": ["0 N.m", "m", "0 N.m"]}, {"m": ("0 N.m", "5 N.m")}, "Coupling 1 reaches 3.75 MPa, 75 times"),
        ({"moment": ["0 N.m", "m", "0 N.m"]}, {"m": ("0 N.m", "1.3 N.m")}, None),
        # The mesh is 49 mm long; the set begins 40 mm above the origin. A lever of nine lengths is not asked about.
        (
            {"force": ["f", "0 N", "0 N"], "point": ["10 mm", "10 mm", "40 m"]},
            {"f": ("0 N", "1 N")},
            "Coupling 1 has its point 3.996e+04 mm from its set, where the mesh is 48.99 mm long: is its unit right",
        ),
        ({"force": ["f", "0 N", "0 N"], "point": ["10 mm", "10 mm", "480 mm"]}, {"f": ("0 N", "1 N")}, None),
    ],
)
def test_couplings_that_no_such_body_bears(coupling, ranges, said):
    parameters = {name: {"range": list(ends)} for name, ends in ranges.items()}
    found = make_study(BLOCK | {"couplings": [{"on": "z_max"} | coupling], "parameters": parameters}).advice
    assert ("right?" in found) == (said is not None)
    assert (said or "Narrow the ranges") in found


def test_a_range_a_thousand_times_too_large_names_how_far_the_body_could_be_followed():
    """A long tube under inner pressure: with a thin wall p = (wall / radius) G (1 - stretch^-4) at most."""
    sides = (("bottom", "z"), ("top", "z"), ("start", "y"), ("end", "x"))
    study = make_study(
        {
            "name": "tube",
            "mesh": {
                "generator": "tube", "inner_radius": "19 mm", "outer_radius": "21 mm", "length": "5 mm",
                "divisions": [1, 1, 6], "cells": "hex20", "angles": ["0 deg", "90 deg"],
            },
            "materials": {"rubber": {"law": "neo_hookean", "young": "3 MPa", "poisson": 0.45}},
            "supports": [{"kind": "displacement", "on": side, axis: "0 mm"} for side, axis in sides],
            "loads": [{"kind": "pressure", "on": "inner", "pressure": "inside"}],
            "parameters": {"inside": {"range": ["0 kPa", "10000 kPa"]}},
            "solver": {"threads": 1},
        }
    )  # fmt: skip
    sweep = study.sweep_problem()
    start = sweep.first_state()
    limit = 0.1 * 3e3 / 2.9  # kPa
    for attempt in range(2):  # the second is told what the first has found
        with pytest.raises(SolverError) as failed:
            sweep.advance(start, np.array([10e6]))
        reached = float(re.search(r"no equilibrium found beyond inside = ([\d.]+) kPa", str(failed.value))[1])
        assert 0.9 * limit < reached < 1.05 * limit, attempt
