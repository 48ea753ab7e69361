"""Points of a stand or a camera that moved between states, and parameters that others' ends of ranges have moved."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from morph_dslam.identification.found import Identification, Misfit
from morph_dslam.identification.identify import identify
from morph_dslam.identification.measured_points import MeasuredPoints
from morph_dslam.identification.moved_states import moved_states
from morph_dslam.identification.report import identification_lines, summarise
from morph_dslam.identification.values import Values
from morph_dslam.model import Parameter, ReducedModel, SeparatedField
from morph_dslam.model.functions import ParameterFunctions

#: A plate of 1 m that is stretched by load times a along x, and by b along y.
CORNERS = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0], [0.0, 1.0, 0.0]])
LOADS, TRUTH, NOISE = np.array([0.0, 0.25, 0.5, 0.75, 1.0]), 0.3, 1e-3
TURN = Rotation.from_rotvec([0.2, -0.1, 0.3])


def plate() -> ReducedModel:
    parameters = tuple(Parameter(name, "ratio", "1", 0.0, 1.0, 0.0) for name in ("load", "a", "b"))
    # Chebyshev polynomials of x = 2 load - 1 and y = 2 a - 1: load a = (1 + x + y + x y) / 4; b = (1 + z) / 2.
    indices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0], [0, 0, 1]])
    weights = np.array([[0.25, 0.25, 0.25, 0.25, 0.0], [0.5, 0.0, 0.0, 0.0, 0.5]]).T
    functions = ParameterFunctions(np.zeros(3), np.ones(3), indices, weights)
    shape = np.zeros((2, 4, 3))
    shape[0, :, 0], shape[1, :, 1] = CORNERS[:, 0], CORNERS[:, 1]
    return ReducedModel(
        "plate", CORNERS, np.array([[0, 1, 2], [0, 2, 3]]), parameters, SeparatedField(shape, functions)
    )


def points(rng: np.random.Generator, loads: np.ndarray = LOADS, shifts: np.ndarray | None = None) -> MeasuredPoints:
    """The corners in states of `LOADS`, in another frame; these ``loads`` act, and ``shifts`` (s, 3) of the stand."""
    states = tuple(f"state {i}" for i in range(len(LOADS)) for _ in CORNERS)
    places, load = np.tile(CORNERS, (len(LOADS), 1)), np.repeat(loads, 4)
    moved = places + TRUTH * np.outer(load, [1.0, 0.0, 0.0]) * places + NOISE * rng.normal(size=places.shape)
    moved += 0.0 if shifts is None else np.repeat(shifts, 4, axis=0)
    known = {"load": np.repeat(LOADS, 4)}
    return MeasuredPoints(plate(), states, known, places, TURN.apply(moved) + np.array([0.1, 2.0, 0.3]), aligned=True)


def misfit(table: MeasuredPoints) -> Misfit:
    """With the true parameters, none of which is identified."""
    values = Values(table.model, table.model.parameters[1:2], np.array([TRUTH]))
    raw = table.predict(values)
    predicted = table.adjusted(raw)
    return Misfit(table, predicted, predicted - raw, np.zeros((len(raw), 0)), 0.0, 0.0, np.zeros(1), values)


@pytest.mark.parametrize("off", [0.0, 0.05])
def test_right_points_are_not_said_to_have_moved(off: float) -> None:
    """Nor where the load is off in each state."""
    for draw in range(60):
        rng = np.random.default_rng(draw)
        loads = LOADS * (1.0 + off * rng.normal(size=len(LOADS)))
        table = points(rng, loads)
        assert moved_states(misfit(table), table) is None


def test_states_that_moved_by_themselves_are_named() -> None:
    for draw in range(10):
        rng = np.random.default_rng(draw)
        table = points(rng, shifts=5.0 * NOISE * rng.normal(size=(len(LOADS), 3)))
        found = moved_states(misfit(table), table)
        assert found is not None
        # Of 60 values 30 motions and 5 loads are taken.
        assert found["rms"] < 1.2 * 1e3 * NOISE


def test_a_stand_that_gives_way_is_named_with_the_result() -> None:
    """By 5 mm at the whole load: it passes for a stretch."""
    rng = np.random.default_rng(1)
    table = points(rng, shifts=np.outer(LOADS, [5e-3, 0.0, 0.0]))
    found = moved_states(misfit(table), table)
    assert found is not None
    assert found["with_load"]
    text = said(identify(table.model, [table], ["a"]))
    assert "points fit better with motions that grow with the load" in text
    assert "give each state a file of its own" in text


def test_a_table_that_is_not_aligned_is_not_asked() -> None:
    table = points(np.random.default_rng(1))
    still = MeasuredPoints(table.model, table.states, table.known, table.places, table.measured)
    assert moved_states(misfit(still), still) is None


def said(found: Identification) -> str:
    return "\n".join(identification_lines(summarise(found)))


@pytest.mark.parametrize(("a", "held"), [(1.2, True), (0.4, False)])
def test_an_interval_beside_an_end_of_a_range_is_said_not_to_hold(a: float, held: bool) -> None:
    """Along x the plate is stretched by load a + load / 10 times b; a of 1.2 is beyond its range."""
    model, rng = plate(), np.random.default_rng(4)
    model.displacement.modes[1, :, 0] = 0.5 * CORNERS[:, 0]
    states, places = tuple(f"state {i}" for i in range(5) for _ in CORNERS), np.tile(CORNERS, (5, 1))
    load = np.repeat(LOADS, 4)
    measured = places * (1.0 + np.outer(load * a + 0.5 * 0.3, [1, 0, 0]) + np.outer(0.0 * load + 0.3, [0, 1, 0]))
    measured += NOISE * rng.normal(size=measured.shape)
    table = MeasuredPoints(model, states, {"load": load}, places, measured)
    text = said(identify(model, [table], ["a", "b"]))
    assert ("b compensated for a, which is at the end of its range: its interval does not hold" in text) is held
