"""A factor of all moduli beside loads of given size, against bodies whose answer to a load is known in closed form.

A bar of modulus E that is loaded by p answers with a shape, and with a force E g(p / E): here the model has E = 1, the
shape is p, and the force p - CURVE p^2. Of a body whose moduli are FACTOR times as large it is p - CURVE p^2 / FACTOR.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import morph_dslam as md
from morph_dslam.camera import Camera
from morph_dslam.errors import IdentificationError
from morph_dslam.evaluation.force import reaction_in_direction
from morph_dslam.evaluation.force_curves import ForceCurve
from morph_dslam.evaluation.run_folder import Run
from morph_dslam.identification.identify import identify
from morph_dslam.identification.measured_forces import MeasuredForces
from morph_dslam.identification.measured_points import MeasuredPoints
from morph_dslam.identification.prior import KnownValues
from morph_dslam.identification.report import identification_lines, summarise
from morph_dslam.identification.values import FACTOR
from morph_dslam.model import Parameter, ReducedModel, SeparatedField
from morph_dslam.model.functions import ParameterFunctions

CORNERS = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0], [0.0, 1.0, 0.0]])
TRUTH, CURVE = 0.6, 0.4
RNG = np.random.default_rng(8)

BODY = """
[materials.gel]
law = "neo_hookean"
young = "1 kPa"
density = "1000 kg/m3"
[[supports]]
kind = "fixed"
on = "x_min"
"""
FORCE = '[[loads]]\nkind = "force"\non = "x_max"\nforce = ["10 N * share", "0 N", "0 N"]\n'
STROKE = '[[supports]]\nkind = "displacement"\non = "x_max"\nx = "10 mm * share"\n'
WEIGHT = '[[loads]]\nkind = "gravity"\n'
SPRINGS = '[[supports]]\nkind = "foundation"\non = "x_max"\nstiffness = "{}"\n'
PATCH = """
[[loads]]
kind = "moving_patch"
on = "y_max"
force = ["1 N", "0 N", "0 N"]
centre = ["{}", "0 mm", "0 mm"]
width = "5 mm"
"""
TIME = (
    '[time]\nparameter = "time"\nstep = "1 s"\n[time.amplitudes]\nramp = { times = ["0 s", "1 s"], values = [0, 1] }\n'
)
DENSE = BODY.replace('"1000 kg/m3"', '"1000 kg/m3 * share"')


def bar(study: str | None, curve: float = CURVE) -> ReducedModel:
    """A plate that is shifted along x by ``share`` metres, with the force share - curve share^2 along z, newtons."""
    functions = ParameterFunctions(np.zeros(2), np.array([1.0, 1.0]), np.array([[0, 0], [1, 0], [2, 0]]), np.eye(3))
    shift, force = np.zeros((3, 4, 3)), np.zeros((3, 1, 3))
    shift[:2, :, 0] = 0.5
    # With s = 2 p - 1: p = (1 + s) / 2, and p^2 = 3/8 + s / 2 + T2(s) / 8.
    force[:, 0, 2] = np.array([0.5, 0.5, 0.0]) - curve * np.array([0.375, 0.5, 0.125])
    return ReducedModel(
        "bar",
        CORNERS,
        np.array([[0, 1, 2], [0, 2, 3]]),
        (Parameter("share", "ratio", "1", 0.0, 1.0, 0.5), Parameter("time", "time", "s", 0.0, 1.0, 0.0)),
        SeparatedField(shift, functions),
        reactions={"force_end": SeparatedField(force, functions)},
        provenance={} if study is None else {"study": study},
    )


def curve_of(model: ReducedModel, forces: Any, most: float = 0.55, **options: Any) -> MeasuredForces:
    """Forces, a function of share, where share / TRUTH is inside of the range."""
    places = np.linspace(0.0, most, 21)
    return MeasuredForces(
        model, ForceCurve("share", places, forces(places)), reaction_in_direction(model, "end:z"), **options
    )


def under_load(p: np.ndarray) -> np.ndarray:
    return p - CURVE * p**2 / TRUTH


def by_stroke(p: np.ndarray) -> np.ndarray:
    return TRUTH * (p - CURVE * p**2)


def factor_of(table: MeasuredForces) -> float:
    return identify(table.model, [table], moduli=True)[FACTOR].value


SCALED = {
    "force": BODY + FORCE,
    "pressure": BODY + '[[loads]]\nkind = "pressure"\non = "x_max"\npressure = "-2 kPa * share"\n',
    "several": BODY
    + FORCE
    + '[[loads]]\nkind = "traction"\non = "y_max"\ntraction = ["0 Pa", "1 kPa * share", "0 Pa"]\n',
    "coupling": BODY + '[[couplings]]\non = "x_max"\nmoment = ["0 N.m", "1 N.m * share", "0 N.m"]\n',
    "acceleration": BODY + WEIGHT + 'acceleration = ["9.8 m/s2 * share", "0 m/s2", "0 m/s2"]\n',
    "density": DENSE + WEIGHT,
    "springs": BODY + SPRINGS.format("1 N/m3 * share"),
    "in time": BODY + FORCE.replace("share", "share * ramp") + TIME,
    "weightless": BODY.replace("1000", "0") + FORCE + WEIGHT,
    "a place": BODY + PATCH.format("10 mm").replace("1 N", "1 N * share"),
    "a set of that name": BODY + FORCE.replace("x_max", "share"),
}


@pytest.mark.parametrize("study", SCALED.values(), ids=SCALED)
def test_forces_under_loads_give_the_factor_by_the_state_of_a_body_as_stiff(study: str) -> None:
    table = curve_of(bar(study), under_load, free_zero=False)
    found = identify(table.model, [table], moduli=True)
    assert found[FACTOR].value == pytest.approx(TRUTH, rel=1e-6)
    assert summarise(found)["loads"] == {"are_known": True, "divided_by_factor": ["share"], "not_scaled": []}


def test_a_study_that_was_made_in_python_says_the_same() -> None:
    study = md.make_study(
        {
            "name": "bar",
            "mesh": {"generator": "block", "size": ["4 mm", "1 mm", "1 mm"], "divisions": [1, 1, 1]},
            "materials": {"gel": {"law": "neo_hookean", "young": "1 kPa", "poisson": 0.3, "density": "1000 kg/m3"}},
            "supports": [{"kind": "fixed", "on": "x_min"}],
            "loads": [{"kind": "force", "on": "x_max", "force": ["10 N * share", "0 N", "0 N"]}],
            "parameters": {"share": {"range": [0, 1]}},
        }
    )
    assert factor_of(curve_of(bar(study.model_dump_json()), under_load, free_zero=False)) == pytest.approx(
        TRUTH, rel=1e-6
    )


@pytest.mark.parametrize("study", [BODY + STROKE, BODY + STROKE + FORCE.replace("10 N * share", "0 N")])
def test_forces_by_a_stroke_are_proportional_to_the_factor(study: str) -> None:
    table = curve_of(bar(study), by_stroke, most=1.0, free_zero=False)
    assert factor_of(table) == pytest.approx(TRUTH, rel=1e-6)


UNSCALED = {
    "a weight": (BODY + STROKE + WEIGHT, r"load 1 \(gravity\)"),
    "a weight beside a load": (BODY + FORCE + WEIGHT, r"load 2 \(gravity\)"),
    "part of a load": (BODY + FORCE.replace("10 N * share", "10 N * share + 1 N"), r"load 1 \(force\)"),
    "a product": (DENSE + WEIGHT + 'acceleration = ["9.8 m/s2 * share", "0 m/s2", "0 m/s2"]\n', r"load 1 \(gravity\)"),
    "a load with the stroke": (BODY + STROKE + FORCE, r"load 1 \(force\)"),
    "a load with the modulus": (BODY.replace('"1 kPa"', '"1 kPa * share"') + FORCE, r"load 1 \(force\)"),
    "springs": (BODY + STROKE + SPRINGS.format("1 N/m3"), r"support 3 \(foundation\)"),
    "a pressure": (
        BODY + STROKE + '[[loads]]\nkind = "pressure"\non = "y_max"\npressure = "1 kPa"\n',
        r"load 1 \(pressure\)",
    ),
    "a load that is moved": (BODY + PATCH.format("10 mm * share"), r"load 1 \(moving_patch\)"),
    "a push": (BODY + '[[couplings]]\non = "x_max"\nforce = ["1 N", "0 N", "0 N"]\n', "coupling 1"),
}


@pytest.mark.parametrize(("study", "load"), UNSCALED.values(), ids=UNSCALED)
def test_no_factor_is_found_where_a_load_keeps_its_size(study: str, load: str) -> None:
    with pytest.raises(
        IdentificationError, match=rf"^{load} of the study does not grow with the moduli, .*--parameter"
    ):
        factor_of(curve_of(bar(study), by_stroke, free_zero=False))


@pytest.mark.parametrize("study", [BODY + WEIGHT, BODY + STROKE + WEIGHT])
def test_points_of_a_body_under_its_weight_alone_are_refused_with_the_weight_as_the_reason(study: str) -> None:
    """They do depend on the moduli: a body twice as stiff sags half as far."""
    table = MeasuredPoints(bar(study), ("hangs",) * 4, {}, CORNERS, CORNERS + np.array([0.5 / TRUTH, 0.0, 0.0]))
    with pytest.raises(
        IdentificationError, match=r"^load 1 \(gravity\) of the study .* found\. Make a modulus a param"
    ):
        identify(table.model, [table], moduli=True)


def test_a_free_zero_takes_up_what_is_the_same_in_all_states() -> None:
    table = curve_of(bar(BODY + STROKE + WEIGHT), lambda p: by_stroke(p) + 3.0, most=1.0)
    found = identify(table.model, [table], moduli=True)
    assert found[FACTOR].value == pytest.approx(TRUTH, rel=1e-6)
    assert "note: load 1 (gravity) of the study does not grow with the moduli" in "\n".join(
        identification_lines(summarise(found))
    )
    for study in ("springs", "a pressure", "a load that is moved", "a load with the stroke", "part of a load"):
        with pytest.raises(IdentificationError, match="one factor of all moduli cannot be found"):
            factor_of(curve_of(bar(UNSCALED[study][0]), by_stroke))
    pushed = BODY + STROKE + FORCE.replace("10 N * share", "10 N * ramp") + TIME
    table = curve_of(bar(pushed), by_stroke)
    assert factor_of(table) == pytest.approx(TRUTH, rel=1e-6)  # at one time
    in_time = replace(table, curve=replace(table.curve, against="time"))
    with pytest.raises(IdentificationError, match=r"load 1 \(force\)"):
        factor_of(in_time)


def test_loads_that_pictures_showed_are_those_of_the_model() -> None:
    """A shape that the model has under p is one of a body FACTOR times as stiff under FACTOR p."""
    model, frames = bar(BODY + FORCE), np.arange(21)
    parameters = np.column_stack([np.linspace(0.0, 1.0, 21), np.zeros(21)])
    camera, poses = Camera(640, 480, 500.0, 500.0, 319.5, 239.5), np.tile(np.eye(4), (21, 1, 1))
    run = Run(model, camera, frames, ("tracked",) * 21, ("",) * 21, poses, parameters, {})
    curve = ForceCurve("frame", frames.astype(float), by_stroke(parameters[:, 0]))
    table = MeasuredForces(model, curve, reaction_in_direction(model, "end:z"), run, free_zero=False)
    assert factor_of(table) == pytest.approx(TRUTH, rel=1e-6)


def test_a_load_over_the_sequence_is_told_by_pictures_and_a_force() -> None:
    """Pictures show 0.5, the load over the factor, to 0.001; a force that equals the load tells 0.3."""
    model = bar(BODY + FORCE, curve=0.0)
    table = MeasuredForces(
        model,
        ForceCurve("time", np.linspace(0.0, 1.0, 9), 0.3 + 1e-6 * RNG.normal(size=9)),
        reaction_in_direction(model, "end:z"),
        free_zero=False,
    )
    found = identify(model, [table], ["share"], True, KnownValues.independent({"share": (0.5, 1e-3)}))
    assert found["share"].value == pytest.approx(0.3, abs=1e-5)
    assert found[FACTOR].value == pytest.approx(0.6, rel=1e-4)
    assert found[FACTOR].std == pytest.approx(0.6 * 1e-3 / 0.5, rel=1e-2)


def test_points_under_known_loads_give_the_factor() -> None:
    """The bar is shifted by share / FACTOR metres."""
    shares = np.repeat([0.1, 0.2, 0.3, 0.4], 4)
    measured = np.tile(CORNERS, (4, 1))
    measured[:, 0] += shares / TRUTH + 1e-5 * RNG.normal(size=16)
    states = tuple(f"{share}" for share in shares)
    model = bar(BODY + FORCE)
    table = MeasuredPoints(model, states, {"share": shares}, np.tile(CORNERS, (4, 1)), measured)
    assert identify(model, [table], moduli=True)[FACTOR].value == pytest.approx(TRUTH, rel=1e-3)
    with pytest.raises(IdentificationError, match=rf"depends on '{FACTOR}'"):
        identify(bar(BODY + STROKE), [replace(table, model=bar(BODY + STROKE))], moduli=True)


def test_loads_outside_of_the_models_range_are_refused() -> None:
    """With 0.6 a load of 0.9 is one of 1.5 for the model, which ends at 1; beyond, it goes on with a tangent."""
    with pytest.raises(
        IdentificationError,
        match=rf"with {FACTOR} = 0\.\d+ force .* share = 1\.0\d* to 1\.\d+, .*range, 0 to 1: build it with",
    ):
        factor_of(curve_of(bar(BODY + FORCE), under_load, most=0.9, free_zero=False))


@pytest.mark.parametrize("free_zero", [False, True])
def test_a_force_that_balances_the_load_tells_no_factor(free_zero: bool) -> None:
    table = curve_of(bar(BODY + FORCE, curve=0.0), lambda p: p + 1e-3 * RNG.normal(size=len(p)), free_zero=free_zero)
    figures = summarise(identify(table.model, [table], moduli=True))
    assert not figures["parameters"][0]["identified"]
    text = "\n".join(identification_lines(figures))
    assert f"note: {FACTOR} could not be identified" in text
    assert "times what the model's force changes by" not in text


@pytest.mark.parametrize("study", [None, "no study at all", '[external]\ntable = "states.csv"\n'])
def test_a_model_that_does_not_say_which_loads_act_is_noted(study: str | None) -> None:
    table = curve_of(bar(study), by_stroke, most=1.0)
    found = identify(table.model, [table], moduli=True)
    assert found[FACTOR].value == pytest.approx(TRUTH, rel=1e-6)
    assert "note: the model does not say which loads act" in "\n".join(identification_lines(summarise(found)))
