"""What a study applies `first`: where the path to the defaults decides, and the same result where it does not."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from morph_dslam import make_study
from morph_dslam.errors import StudyError
from morph_dslam.studies.solid_study import SolidStudy

SHORTER = {"kind": "displacement", "on": "x_max", "x": "-1 mm", "y": "0 mm", "z": "0 mm"}
UP = {"kind": "traction", "on": "z_min", "traction": ["0 Pa", "0 Pa", "10 Pa"]}
DOWN = {"kind": "traction", "on": "z_max", "traction": ["0 Pa", "0 Pa", "-1 * weight"]}


def strip_study(first: bool, **changes: Any) -> SolidStudy:
    """A strip that is pushed together until it buckles upwards, with a weight on it."""
    content = {
        "name": "strip",
        "mesh": {"generator": "block", "size": ["100 mm", "10 mm", "2 mm"], "divisions": [10, 1, 1], "cells": "hex8"},
        "materials": {"rubber": {"law": "neo_hookean", "young": "3 MPa", "poisson": 0.3}},
        "supports": [{"kind": "fixed", "on": "x_min"}, SHORTER | {"first": first}],
        "loads": [UP | {"first": first}, DOWN],
        "parameters": {"weight": {"range": ["0 Pa", "400 Pa"], "default": "20 Pa"}},
        "solver": {"threads": 1},
    }
    study = make_study(content | changes)
    assert isinstance(study, SolidStudy)
    return study


def rise(study: SolidStudy, weight: float | None = None) -> float:
    """How far the middle of the strip has risen, m; at the default without a weight."""
    sweep = study.sweep_problem()
    state = sweep.first_state()
    if weight is not None:
        state = sweep.advance(state, np.array([weight]))
    middle = np.argmin(np.abs(study.solid_mesh().nodes[:, 0] - 0.05))
    return float(sweep.take_snapshot(state).fields["displacement"][middle, 2])


def test_a_strip_that_was_assembled_first_stays_on_its_side() -> None:
    """Its arc is about 2 / pi sqrt(shortening length) high; a larger weight snaps it through."""
    height = 2.0 / np.pi * np.sqrt(1e-3 * 0.1)
    together, assembled = strip_study(False), strip_study(True)
    assert rise(together) == pytest.approx(-height, rel=0.1)
    assert rise(assembled) == pytest.approx(height, rel=0.1)
    heavy = {"weight": {"range": ["0 Pa", "400 Pa"], "default": "320 Pa"}}
    both = [rise(strip_study(first, parameters=heavy)) for first in (False, True)]
    assert both[0] < 0.0
    assert both[1] == pytest.approx(both[0], rel=1e-5)


def test_other_supports_hold_still_meanwhile() -> None:
    """An end that is pushed after the strip was bent by its load: the order makes no difference before it buckles."""
    pushed, loads = SHORTER | {"x": "0.05 mm"}, [UP | {"first": True}, DOWN]
    held = [{"kind": "fixed", "on": "x_min"}, pushed]
    ordered = strip_study(True, supports=held, loads=loads)
    first = ordered.problem().applied_first
    assert first is not None
    np.testing.assert_array_equal(first().prescribed(ordered.root()), 0.0)
    assert rise(ordered) == pytest.approx(rise(strip_study(False, supports=held)), rel=1e-5)


def test_the_order_enters_the_fingerprint_where_there_is_one() -> None:
    plain = strip_study(False, supports=[{"kind": "fixed", "on": "x_min"}, SHORTER], loads=[UP, DOWN])
    assert strip_study(False).fingerprint() == plain.fingerprint() != strip_study(True).fingerprint()
    with pytest.raises(StudyError, match=r"support 1: unknown key first; known here: kind, on"):
        strip_study(True, supports=[{"kind": "fixed", "on": "x_min", "first": True}])


def held_bar(
    rest: str | None, stretch: str = "0.2 mm", first: bool = True, part: float | str = 0.6, **of_time: Any
) -> SolidStudy:
    """A viscoelastic bar, stretched first, whose end then moves sideways; ``part`` of its stiffness relaxes."""
    stretched = {"kind": "displacement", "on": "x_max", "x": stretch, "first": first}
    begin = of_time.pop("begin", "0 s")
    time = {"parameter": "age", "step": "0.5 s"} | of_time | ({"rest": rest} if rest else {})
    prony = {"relative_moduli": [part], "times": ["2 s"]}
    return strip_study(
        False,
        mesh={"generator": "block", "size": ["20 mm", "4 mm", "4 mm"], "divisions": [2, 1, 1], "cells": "hex8"},
        materials={"rubber": {"law": "neo_hookean", "young": "3 MPa", "poisson": 0.0, "prony": prony}},
        supports=[
            {"kind": "fixed", "on": "x_min"},
            stretched,
            {"kind": "displacement", "on": "x_max", "y": "side", "z": "0 mm"},
        ],
        loads=[],
        parameters={
            "side": {"range": ["0 mm", "0.5 mm"]},
            "age": {"range": [begin, "4 s"]},
            "pull": {"range": ["0.2 mm", "4 mm"]},
            "g": {"range": [0.1, 0.8]},
        },
        time=time,
    )


def test_what_is_applied_first_relaxes_while_it_rests() -> None:
    """The force of a strain that is held falls by g_inf + g exp(-t / tau)."""

    fresh = None
    for rest, seconds in ((None, 0.0), ("3 s", 3.0), ("1000 h", np.inf)):
        sweep = held_bar(rest).sweep_problem()
        for age in (0.0, 4.0):
            state = sweep.advance(sweep.first_state(), np.array([0.0, age, 0.0, 0.0]))
            force = float(sweep.take_snapshot(state).outputs["force_x_max"][0])
            fresh = fresh or force
            expected = 0.4 + 0.6 * np.exp(-(seconds + age) / 2.0)
            assert force / fresh == pytest.approx(expected, rel=1e-6)


def test_what_rests_does_so_at_the_parameters_of_the_sample() -> None:
    """Without contraction P = E / 2 (s - 1 / s) at once, and the part 1 - g (1 - exp(-t / tau)) of it is left."""
    sweep = held_bar("3 s", stretch="pull", part="g").sweep_problem()
    for g, pull, age in ((0.8, 4e-3, 0.0), (0.1, 2e-3, 4.0), (0.5, 0.2e-3, 4.0)):
        state = sweep.advance(sweep.first_state(), np.array([0.0, age, pull, g]))
        force, stretch = sweep.take_snapshot(state).outputs["force_x_max"][0], 1.0 + pull / 0.02
        left = 1.0 - g * (1.0 - np.exp(-(3.0 + age) / 2.0))
        assert force == pytest.approx(16e-6 * 1.5e6 * (stretch - 1.0 / stretch) * left, rel=1e-8)


def test_what_has_rested_moves_on_with_an_amplitude() -> None:
    """One support stretches a bar, rests and moves: S = P / s is the convolution of E / 2 (1 - 1 / s^2)."""
    wave = {"wave": {"times": ["0 s", "1 s", "4 s"], "values": [0.0, 1.0, 0.25]}}
    study = held_bar("3 s", stretch="0.2 mm + pull * wave", step="0.025 s", amplitudes=wave)
    sweep, pull = study.sweep_problem(), 3e-3
    # The bar has been held for three seconds when the time begins.
    time = np.linspace(-3.0, 4.0, 70001)
    stretch = 1.0 + (0.2e-3 + pull * np.interp(time, [0.0, 1.0, 4.0], [0.0, 1.0, 0.25])) / 0.02
    at_once = 1.5e6 * (1.0 - stretch**-2)
    for age in (0.0, 1.0, 4.0):
        until = time <= age + 1e-9
        faded = np.exp((time[until] - age) / 2.0)
        grown = at_once[0] * faded[0] + np.sum(np.diff(at_once[until]) * 0.5 * (faded[1:] + faded[:-1]))
        expected = 16e-6 * stretch[until][-1] * (0.4 * at_once[until][-1] + 0.6 * grown)
        state = sweep.advance(sweep.first_state(), np.array([0.0, age, pull, 0.6]))
        assert sweep.take_snapshot(state).outputs["force_x_max"][0] == pytest.approx(expected, rel=2e-4)


def test_mistakes_in_a_rest_are_named() -> None:
    early = {"wave": {"times": ["0 s", "2 s"], "values": [0.0, 1.0]}}
    with pytest.raises(StudyError, match=r"'0.2 mm \* wave' rests .*: let its times begin at 1 s or later"):
        held_bar("3 s", stretch="0.2 mm * wave", amplitudes=early, begin="1 s")
    with pytest.raises(StudyError, match=r"'0.2 mm \* age / 1 s' names the time, but rests before the time begins"):
        held_bar("3 s", stretch="0.2 mm * age / 1 s")
    with pytest.raises(StudyError, match=r"time\.rest: nothing rests"):
        held_bar("3 s", first=False)
