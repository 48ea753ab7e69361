"""Tables of points in another unit, of other axes or another origin, and with a value that is far off."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from morph_dslam.identification.identify import identify
from morph_dslam.identification.measured_points import MeasuredPoints
from morph_dslam.identification.report import identification_lines, summarise
from morph_dslam.model import Parameter, ReducedModel, SeparatedField
from morph_dslam.model.functions import ParameterFunctions
from tests.support.edge_plate import CORNERS, edge_plate, plate_of_load

LOADS, TRUTH, NOISE = np.array([0.2, 0.4, 0.6, 0.8, 1.0]), 0.3, 2e-3
TURN = Rotation.from_rotvec([0.2, -0.1, 0.3])
DOUBTS = {"far_off": [], "read_otherwise": None, "moved_as_one": None}


def points(seed: int = 0, rows: tuple[int, ...] = (0, 1, 2, 3), beside: float = 0.0) -> MeasuredPoints:
    """Corners of a plate of 1 m, in a table right but for noise, and each put ``beside`` its place, m."""
    rng = np.random.default_rng(seed)
    states = tuple(f"state {i}" for i in range(len(LOADS)) for _ in rows)
    places, load = np.tile(CORNERS[list(rows)], (len(LOADS), 1)), np.repeat(LOADS, len(rows))
    measured = places * np.column_stack([1.0 + TRUTH * load, np.ones_like(load), np.ones_like(load)])
    measured += NOISE * rng.normal(size=places.shape) + np.tile(
        beside * rng.normal(size=(len(rows), 3)), (len(LOADS), 1)
    )
    return MeasuredPoints(plate_of_load(), states, {"load": load}, places, measured)


def figures(table: MeasuredPoints) -> tuple[dict[str, Any], str]:
    """Of the table, and the lines that are printed."""
    found = summarise(identify(table.model, [table], ["a"]))
    return found["measurements"][0], "\n".join(identification_lines(found))


def doubts(table: MeasuredPoints) -> dict[str, Any]:
    each, _ = figures(table)
    return {name: each[name] for name in DOUBTS}


@pytest.mark.parametrize("aligned", [False, True])
def test_right_points_are_not_doubted(aligned: bool) -> None:
    table = points()
    measured = TURN.apply(table.measured) + np.array([0.1, 2.0, 0.3]) if aligned else table.measured
    assert doubts(replace(table, measured=measured, aligned=aligned)) == DOUBTS


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_three_markers_whose_places_are_measured_in_each_state_tell_no_other_frame(seed: int) -> None:
    """They are 20 mm beside their places, which themselves err by 2 mm."""
    table = points(seed, (0, 1, 2), beside=0.02)
    jitter = 2e-3 * np.random.default_rng(100 + seed).normal(size=table.places.shape)
    assert doubts(replace(table, places=table.places + jitter))["moved_as_one"] is None


@pytest.mark.slow
def test_markers_beside_their_places_are_no_other_frame() -> None:
    """Three of them by 20 mm: one motion takes up most of that."""
    raised = [doubts(points(seed, (0, 1, 2), beside=0.02)) != DOUBTS for seed in range(15)]
    assert sum(raised) == 0


@pytest.mark.parametrize(
    ("wrong", "times", "axes", "says"),
    [
        (lambda x: 1e3 * x, 1e-3, ["x", "y", "z"], "with 0.001 times x, y and z: check the unit"),
        (lambda x: 0.1 * x, 10.0, ["x", "y", "z"], "with 10 times x, y and z: check the unit"),
        (lambda x: x[:, [1, 0, 2]], 1.0, ["y", "x", "z"], "with y, x, z as x, y, z: check the order"),
        (lambda x: x * [-1.0, 1.0, 1.0], 1.0, ["-x", "y", "z"], "with -x, y, z as x, y, z: check the order"),
    ],
)
def test_another_unit_and_other_axes_are_named(
    wrong: Callable[[np.ndarray], np.ndarray], times: float, axes: list[str], says: str
) -> None:
    table = points()
    each, text = figures(replace(table, measured=wrong(table.measured)))
    assert (each["read_otherwise"]["times"], each["read_otherwise"]["axes"]) == (times, axes)
    assert says in text


def test_a_value_that_is_far_off_is_named() -> None:
    """By 60 mm along z, of which the stretch takes up nothing."""
    table = points()
    table.measured[6, 2] += 0.06
    each, text = figures(table)
    ((far),) = each["far_off"]
    assert (far["state"], far["row"], far["coordinate"]) == ("state 1", 7, "z")
    assert far["missed"] == pytest.approx(-60.0, abs=4e3 * NOISE)
    assert "z of point 7 (state state 1)" in text


def test_another_origin_is_named_where_points_are_not_aligned() -> None:
    """What is left then is the noise: 60 values less the stretch, five loads and six of the motion."""
    table = points()
    shifted = replace(table, measured=table.measured + np.array([0.0, 0.05, 0.03]))
    each, text = figures(shifted)
    assert each["moved_as_one"]["rms"] == pytest.approx(1e3 * NOISE, rel=0.25)
    assert "give --align-points" in text
    assert doubts(replace(shifted, aligned=True)) == DOUBTS


def warped_plate() -> ReducedModel:
    """Stretched by a; a load from 0 to 1 moves its corners otherwise in each state, by up to 0.2 m."""
    load, a = Parameter("load", "ratio", "1", 0.0, 1.0, 0.0), Parameter("a", "ratio", "1", 0.0, 1.0, 0.5)
    degrees = np.array([[d, 0] for d in range(7)] + [[0, 1]])
    # The stretch is a = (1 + y) / 2, in the Chebyshev polynomial y = 2 a - 1.
    coefficients = np.zeros((8, 7))
    coefficients[[0, 7], 0], coefficients[1:7, 1:] = 0.5, np.eye(6)
    functions = ParameterFunctions(np.zeros(2), np.ones(2), degrees, coefficients)
    plate = edge_plate((load, a), functions)
    shape = 0.05 * np.random.default_rng(5).normal(size=(7, 4, 3))
    shape[0] = CORNERS * [1.0, 0.0, 0.0]
    return replace(plate, displacement=SeparatedField(shape, functions), reactions={})


def warped_points(n_states: int, shift: float, seed: int = 0, beside: float = 0.0, off: float = 0.0) -> MeasuredPoints:
    """Corners of that plate in states whose loads are ``off`` by this share, in a frame shifted along y and z, m."""
    model, rng = warped_plate(), np.random.default_rng(seed)
    loads = np.linspace(0.0, 1.0, n_states + 2)[1:-1]
    states, places = tuple(f"state {i}" for i in range(n_states) for _ in CORNERS), np.tile(CORNERS, (n_states, 1))
    acting = np.clip(loads * (1.0 + off * rng.normal(size=n_states)), 0.0, 1.0)
    measured = np.vstack([model.positions(np.array([load, TRUTH])) for load in acting])
    measured += np.tile(beside * rng.normal(size=CORNERS.shape), (n_states, 1))
    measured += NOISE * rng.normal(size=places.shape) + np.array([0.0, shift, shift])
    return MeasuredPoints(model, states, {"load": np.repeat(loads, 4)}, places, measured)


@pytest.mark.parametrize("n_states", [1, 3, 8])
def test_another_origin_is_named_with_however_many_states(n_states: int) -> None:
    """What the loads' errors may do differs between the states: eight of them, and twelve means of four markers."""
    each, _ = figures(warped_points(n_states, shift=0.05))
    assert each["moved_as_one"]["rms"] == pytest.approx(1e3 * NOISE, rel=0.6 if n_states == 1 else 0.25)


@pytest.mark.slow
def test_markers_beside_their_places_under_loads_that_are_off_are_no_other_frame() -> None:
    """By 20 mm and by a twentieth."""
    raised = [doubts(warped_points(5, 0.0, seed, beside=0.02, off=0.05))["moved_as_one"] for seed in range(20)]
    assert raised == [None] * 20


def test_another_origin_is_named_of_points_that_lie_near_each_other() -> None:
    """A grid of 25 mm on a plate of 1.4 m across, in two states."""
    table, along = points(), np.arange(0.0, 0.26, 0.025)
    grid = np.array([[x, y, 0.0] for x in along for y in along])
    states, load = tuple(f"state {i}" for i in range(2) for _ in grid), np.repeat([0.5, 1.0], len(grid))
    places, noise = np.tile(grid, (2, 1)), NOISE * np.random.default_rng(0).normal(size=(2 * len(grid), 3))
    measured = places * (1.0 + np.outer(TRUTH * load, [1.0, 0.0, 0.0])) + noise + [0.0, 0.05, 0.03]
    each, _ = figures(MeasuredPoints(table.model, states, {"load": load}, places, measured))
    assert each["moved_as_one"]["rms"] == pytest.approx(1e3 * NOISE, rel=0.1)


def test_a_marker_that_is_measured_many_times_in_a_state_is_one() -> None:
    """Three markers 20 mm beside their places, ten times each in one state."""
    table = points(2, (0, 1, 2), beside=0.02)
    first = np.tile(np.arange(3), 10)
    noise = NOISE * np.random.default_rng(1).normal(size=(30, 3))
    often = replace(
        table,
        states=tuple(table.states[row] for row in first),
        known={"load": table.known["load"][first]},
        places=table.places[first],
        measured=table.measured[first] + noise,
    )
    assert doubts(often)["moved_as_one"] is None
