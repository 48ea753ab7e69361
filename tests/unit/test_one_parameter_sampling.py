"""Functions through samples of one parameter, and their choice by bisection, against closed forms."""

from __future__ import annotations

import tomllib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from morph_dslam.reduction.bisection import sample_by_bisection
from morph_dslam.reduction.line_functions import covers, interpolate_line
from morph_dslam.studies.defaults import resolve_defaults
from morph_dslam.studies.problem import Snapshot
from morph_dslam.studies.snapshots import encode_snapshot
from morph_dslam.studies.solid_study import SolidStudy
from morph_dslam.studies.study import make_study
from morph_dslam.studies.sweep import SweepResult
from tests.support.block_study import STUDY

Array = NDArray[np.float64]
BOX = np.array([[0.0, 4.0]])


def cubic(x: Array) -> Array:
    return np.column_stack([x**3 - x, 2.0 * x**2 + 1.0])


def cubic_slope(x: Array) -> Array:
    return np.column_stack([3.0 * x**2 - 1.0, 4.0 * x])


def test_cubics_pass_through_values_and_slopes_of_samples_in_any_order() -> None:
    points = np.array([4.0, 0.0, 0.3, 2.5])
    functions = interpolate_line(points, cubic(points), cubic_slope(points))
    for x in np.linspace(0.0, 4.0, 23):
        value, slope = functions.evaluate(np.array([x]))
        np.testing.assert_allclose(value, cubic(np.array([x]))[0], atol=1e-11)
        np.testing.assert_allclose(slope[0], cubic_slope(np.array([x]))[0], atol=1e-10)


@pytest.mark.parametrize("slopes", [True, False])
def test_errors_are_those_of_the_textbook(slopes: bool) -> None:
    """h^4 / 384 times the fourth derivative; without slopes far from the ends of even samples."""
    points, between = np.linspace(0.0, 4.0, 81), np.linspace(1.0, 3.0, 401)
    known = np.cos(points)[:, None] if slopes else None
    functions = interpolate_line(points, np.sin(points)[:, None], known)
    values = np.array([functions.evaluate(np.array([x]))[0][0] for x in between])
    assert np.abs(values - np.sin(between)).max() == pytest.approx(0.05**4 / 384.0, rel=0.03)


def test_hats_are_linear_between_samples() -> None:
    functions = interpolate_line(np.array([0.0, 1.0, 4.0, 2.0]), np.array([[0.0], [3.0], [1.0], [5.0]]), None, "hat")
    assert [functions.evaluate(np.array([x]))[0][0] for x in (0.5, 1.5, 3.0)] == pytest.approx([1.5, 4.0, 3.0])


def test_only_samples_from_end_to_end_are_interpolated() -> None:
    assert covers(np.array([[4.0], [0.0], [1.0], [3.9]]), BOX)
    assert not covers(np.array([[3.9], [0.0], [1.0], [2.0]]), BOX), "the upper end is missing"
    assert not covers(np.array([[0.0], [4.0], [2.0]]), BOX), "three are too few for cubics"
    assert not covers(np.zeros((4, 2)), np.array([[0.0, 4.0], [0.0, 1.0]]))


def study(**sampling: int) -> SolidStudy:
    """A block of one parameter from 0 to 600 kPa, never solved here."""
    content = tomllib.loads(STUDY) | {"sampling": sampling, "reduction": {"tolerance": 1e-4}}
    content["materials"]["rubber"]["young"] = "3 MPa"
    content["loads"][0]["traction"] = ["0 Pa", "0 Pa", "pull"]
    content["parameters"] = {"pull": content["parameters"]["pull"]}
    resolved = resolve_defaults(make_study(content))
    assert isinstance(resolved, SolidStudy)
    return resolved


def sweep_of(
    function: Callable[[float], tuple[float, float]], solved: SolidStudy, folder: Path, failing: float = -1.0
) -> Callable[[Array], SweepResult]:
    """A sweep that displaces all nodes by a function of the parameter over its range, given with its slope."""
    n_nodes = len(solved.model_mesh().nodes)

    def sweep(samples: Array) -> SweepResult:
        result = SweepResult()
        for index, x in enumerate(samples[:, 0]):
            value, slope = function(x / 6e5)
            if x == failing:
                result.failed[index] = "no equilibrium"
                continue
            snapshot = Snapshot(
                samples[index],
                {"displacement": np.full((n_nodes, 3), value)},
                {"displacement": np.full((1, n_nodes, 3), slope / 6e5)},
            )
            result.solved[index] = folder / f"{index}.npz"
            result.solved[index].write_bytes(encode_snapshot(snapshot, {}))
        return result

    return sweep


def bend(t: float) -> tuple[float, float]:
    """Zero up to 0.3, then a parabola: its second derivative jumps."""
    return (t - 0.3) ** 2 * (t > 0.3), 2.0 * (t - 0.3) * (t > 0.3)


def test_a_straight_line_needs_the_first_samples_and_their_middles(tmp_path: Path) -> None:
    chosen = study()
    samples, rounds = sample_by_bisection(chosen, sweep_of(lambda t: (t, 1.0), chosen, tmp_path))
    np.testing.assert_allclose(np.sort(samples[:, 0]), np.linspace(0.0, 6e5, 9))
    assert [entry["solves"] for entry in rounds] == [9]
    assert rounds[0]["largest_estimate"] < 1e-6
    assert chosen.sampling.held_out == 16


def test_samples_gather_where_the_function_bends(tmp_path: Path) -> None:
    """The first interval across the bend misses by 0.0037; each halving divides that by four, down to 1e-4."""
    chosen = study()
    samples, rounds = sample_by_bisection(chosen, sweep_of(bend, chosen, tmp_path))
    unit = np.sort(samples[:, 0]) / 6e5
    gaps = np.diff(unit)
    assert gaps[np.searchsorted(unit, 0.3) - 1] <= 1.0 / 64.0
    assert gaps[unit[1:] > 0.5].min() == pytest.approx(1.0 / 8.0)
    assert rounds[-1]["largest_estimate"] <= 1e-4 < rounds[-2]["largest_estimate"]
    assert len(samples) == rounds[-1]["solves"] < 20


@pytest.mark.parametrize(("basis", "counts"), [(None, 9), ("hat", 33)])
def test_middles_are_predicted_by_the_functions_of_the_model(tmp_path: Path, basis: str | None, counts: int) -> None:
    """A parabola: cubics meet it, hats miss middles of intervals h by h²/4, which the last round has below 1e-3."""
    chosen = study()
    chosen = chosen.model_copy(
        update={"reduction": chosen.reduction.model_copy(update={"basis": basis, "tolerance": 1e-3})}
    )
    samples, rounds = sample_by_bisection(chosen, sweep_of(lambda t: (t**2, 2.0 * t), chosen, tmp_path))
    assert len(samples) == counts
    assert rounds[-1]["largest_estimate"] == pytest.approx(0.0 if basis is None else 1.0 / 16.0**2 / 4.0, abs=1e-6)


def test_few_samples_that_a_spline_would_go_through_predict_a_parabola(tmp_path: Path) -> None:
    """Of the first five the ends and the middle are solved: a parabola through them meets the middles between."""
    chosen = study()
    chosen = chosen.model_copy(update={"reduction": chosen.reduction.model_copy(update={"basis": "cubic_spline"})})
    everywhere = sweep_of(lambda t: (t**2, 2.0 * t), chosen, tmp_path)

    def sweep(samples: Array) -> SweepResult:
        result = everywhere(samples)
        for index in np.flatnonzero(np.isin(samples[:, 0], (0.25 * 6e5, 0.75 * 6e5))).tolist():
            result.failed[index] = "no equilibrium"
            del result.solved[index]
        return result

    samples, rounds = sample_by_bisection(chosen, sweep)
    assert [entry["largest_estimate"] for entry in rounds] == pytest.approx([0.0], abs=1e-6)
    assert len(samples) == 9


def test_sampling_ends_at_the_most_samples_and_leaves_what_cannot_be_solved(tmp_path: Path) -> None:
    chosen = study(training=11)
    samples, _ = sample_by_bisection(
        chosen, sweep_of(lambda t: (np.sin(40.0 * t), 40.0 * np.cos(40.0 * t)), chosen, tmp_path)
    )
    assert len(samples) == 11
    missing = study()
    failing = float(0.125 * 6e5)
    samples, _ = sample_by_bisection(missing, sweep_of(bend, missing, tmp_path, failing))
    assert not np.any((samples > 0.0) & (samples < 0.125 * 6e5)), "nothing is looked for beside a failure"


def step(t: float) -> tuple[float, float]:
    """A gentle slope that jumps by one at 0.37."""
    return 0.1 * t + (t > 0.37), 0.1


@pytest.mark.parametrize(("sampling", "widest"), [({}, 1e-3), ({"training": 20}, 0.0625)])
def test_a_jump_is_named_and_not_halved_for_ever(tmp_path: Path, sampling: dict[str, int], widest: float) -> None:
    """Interpolation misses by half of the jump in any interval that holds it: by 0.45 of the largest displacement."""
    chosen = study(**sampling)
    samples, rounds = sample_by_bisection(chosen, sweep_of(step, chosen, tmp_path))
    (place,) = rounds[-1]["unresolved"]
    low, high = np.array(place["between"]) / 6e5
    assert place["why"] == "jump"
    assert low < 0.37 < high
    assert high - low <= widest
    assert place["estimate"] == pytest.approx(0.5 / 1.1, rel=0.1)
    assert len(samples) < 35


def test_what_was_not_reached_is_said_and_no_jump_is_made_of_it(tmp_path: Path) -> None:
    """Waves shorter than the samples are apart, and bends wherever they lie; a line is all right."""
    waves = study(training=21)
    _, rounds = sample_by_bisection(
        waves, sweep_of(lambda t: (np.sin(60.0 * t), 60.0 * np.cos(60.0 * t)), waves, tmp_path)
    )
    assert {place["why"] for place in rounds[-1]["unresolved"]} == {"training"}
    assert max(place["estimate"] for place in rounds[-1]["unresolved"]) > 0.05
    for at in np.linspace(0.13, 0.87, 9):
        bent = study(training=15)
        _, rounds = sample_by_bisection(
            bent, sweep_of(lambda t, at=at: (max(t - at, 0.0), float(t > at)), bent, tmp_path)
        )
        for place in rounds[-1].get("unresolved", []):
            assert place["why"] == "training"
            assert place["between"][0] <= 6e5 * at <= place["between"][1]
    line = study()
    _, rounds = sample_by_bisection(line, sweep_of(lambda t: (t, 1.0), line, tmp_path))
    assert "unresolved" not in rounds[-1]


def test_an_error_that_does_not_fall_is_no_lack_of_samples(tmp_path: Path) -> None:
    """Waves that become shorter without end towards 0.37: however near samples are, they miss what is between them."""
    chosen, at = study(), 0.37

    def waves(t: float) -> tuple[float, float]:
        phase = 0.01 / (t - at)
        return 1.0 + t + 0.3 * np.sin(phase), 1.0 - 0.3 * np.cos(phase) * phase / (t - at)

    samples, rounds = sample_by_bisection(chosen, sweep_of(waves, chosen, tmp_path))
    assert len(samples) < chosen.sampling.training
    (place,) = rounds[-1]["unresolved"]
    low, high = np.array(place["between"]) / 6e5
    assert place["why"] == "steady"
    assert low < at < high


@pytest.mark.parametrize(("function", "why"), [(step, "jump"), (bend, "failed")])
def test_where_no_solution_is_found_the_error_is_not_forgotten(tmp_path: Path, function: Callable, why: str) -> None:
    """Solutions around the jump, or the bend, are missing: samples there stop, and the interval is named."""
    chosen, place = study(), 0.37 if function is step else 0.3

    def sweep(samples: Array) -> SweepResult:
        result = sweep_of(function, chosen, tmp_path)(samples)
        near = np.flatnonzero(np.abs(samples[:, 0] / 6e5 - place) < 0.01)
        for index in near:
            result.failed[int(index)] = "no equilibrium"
            del result.solved[int(index)]
        return result

    _, rounds = sample_by_bisection(chosen, sweep)
    (found,) = rounds[-1]["unresolved"]
    low, high = np.array(found["between"]) / 6e5
    assert found["why"] == why
    assert low < place < high
    assert high - low <= 0.25


def test_a_body_that_rests_at_the_first_samples_is_looked_at_again(tmp_path: Path) -> None:
    """sin^2 of 4 pi t vanishes at the five samples that come first; all of it is missed, then."""
    chosen = study(training=40)
    samples, rounds = sample_by_bisection(
        chosen,
        sweep_of(
            lambda t: (
                np.sin(4 * np.pi * t) ** 2 * (abs(np.sin(4 * np.pi * t)) > 1e-9),
                4 * np.pi * np.sin(8 * np.pi * t),
            ),
            chosen,
            tmp_path,
        ),
    )
    assert rounds[0]["largest_estimate"] == pytest.approx(1.0)
    assert len(samples) > 15


def test_a_study_may_choose_otherwise() -> None:
    own = study(held_out=7, first=6).sampling
    assert (own.scheme, own.first, own.held_out) == ("adaptive", 6, 7)
