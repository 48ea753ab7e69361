"""Intervals of what is identified: against closed forms, other libraries, and how often they contain the truth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import fractional_matrix_power
from scipy.spatial.transform import Rotation
from scipy.stats import linregress, t

from morph_dslam.evaluation.force import reaction_in_direction
from morph_dslam.evaluation.force_curves import ForceCurve
from morph_dslam.identification.identify import identify
from morph_dslam.identification.measured_forces import MeasuredForces
from morph_dslam.identification.measured_points import MeasuredPoints
from morph_dslam.identification.scatter import Design, Noise, Scatter, directions
from tests.support.edge_plate import CORNERS, plate_of_load

TRUTH, NOISE = 0.3, 0.003


def points(loads: np.ndarray, rows: np.ndarray, rng: np.random.Generator, noise: float = NOISE) -> MeasuredPoints:
    """Corners ``rows`` along x in states of these loads, with independent errors."""
    states = tuple(f"state {i}" for i in range(len(loads)) for _ in rows)
    places, load = np.tile(CORNERS[rows], (len(loads), 1)), np.repeat(loads, len(rows))
    measured = np.full_like(places, np.nan)
    measured[:, 0] = places[:, 0] * (1.0 + TRUTH * load) + noise * rng.normal(size=len(places))
    return MeasuredPoints(plate_of_load(), states, {"load": load}, places, measured)


@pytest.mark.parametrize("count", [1, 2])
def test_a_table_with_few_values_does_not_take_all_weight(count: int) -> None:
    """Beside 16 values it counts as if it stood in the same table: the slope of one regression through the origin."""
    for draw in range(2):
        rng = np.random.default_rng(draw)
        many = points(np.linspace(0.0, 1.0, 4), np.arange(4), rng)
        few = points(np.ones(count), np.array([1]), rng)
        found = identify(many.model, [many, few], ["a"])["a"]
        ways = np.concatenate([table.places[:, 0] * table.known["load"] for table in (many, few)])
        changes = np.concatenate([table.measured[:, 0] - table.places[:, 0] for table in (many, few)])
        slope = float(ways @ changes) / float(ways @ ways)
        error = float(np.std(changes - slope * ways, ddof=1)) / np.sqrt(float(ways @ ways))
        assert found.std > 0.9 * error
        assert found.value == pytest.approx(slope, abs=error)
        assert found.interval[0] < TRUTH < found.interval[1]


def test_one_value_alone_tells_no_deviation() -> None:
    """It fits exactly, and nothing shows its error."""
    table = points(np.array([0.8]), np.array([1]), np.random.default_rng(1))
    found = identify(table.model, [table], ["a"])["a"]
    assert found.value == pytest.approx((table.measured[0, 0] - 1.0) / 0.8, abs=1e-6)
    assert not found.identified


def line(n: int) -> tuple[np.ndarray, np.ndarray]:
    """Places along a line, and the zero that is free there, (n, 1)."""
    return np.linspace(0.0, 1.0, n), np.ones((n, 1))


def test_deviations_of_a_slope_are_those_of_regression() -> None:
    """With a free zero, each value by itself: of independent errors by another library, of others in dense matrices."""
    rng = np.random.default_rng(3)
    places, ones = line(7)
    values = places + 0.1 * rng.normal(size=7)
    slope, intercept, _, _, error = map(float, linregress(places, values))
    residuals = intercept + slope * places - values
    design = Design(places[:, None], np.zeros((0, 1)), [directions(ones)], np.arange(7))
    noise = Noise.shown(design, [residuals], ["N"], np.ones(1))
    assert noise.freedom == pytest.approx([5.0])
    assert noise.std == pytest.approx([np.sqrt(residuals @ residuals / 5.0)])
    found = Scatter.of(design, residuals, noise.std**2, noise)
    columns = np.column_stack([places, ones])
    hat = columns @ np.linalg.solve(columns.T @ columns, columns.T)
    moves = np.linalg.solve(columns.T @ columns, columns.T)[0] / np.sqrt(1.0 - np.diag(hat))
    expected = np.diag(moves) @ (np.eye(7) - hat) @ np.diag(moves)
    of_groups = np.sqrt(np.sum((moves * residuals) ** 2))
    freedom = np.trace(expected) ** 2 / np.trace(expected @ expected)
    assert np.sqrt(found.covariance[0, 0]) == pytest.approx(max(error, of_groups))
    half = max(t.ppf(0.975, 5) * error, t.ppf(0.975, freedom) * of_groups)
    assert found.half == pytest.approx([half])


def test_deviations_by_groups_are_those_of_dense_matrices() -> None:
    """Four groups of three values, whose errors are nearly the same within each."""
    rng = np.random.default_rng(5)
    columns, groups = rng.normal(size=(12, 2)), np.repeat(np.arange(4), 3)
    errors = rng.normal(size=4)[groups] + 0.01 * rng.normal(size=12)
    hat = columns @ np.linalg.solve(columns.T @ columns, columns.T)
    residuals = errors - hat @ errors
    moved = np.zeros((4, 2))
    for group in range(4):
        own = groups == group
        root = fractional_matrix_power(np.eye(3) - hat[np.ix_(own, own)], -0.5)
        moved[group] = np.linalg.solve(columns.T @ columns, columns[own].T @ root @ residuals[own])
    design = Design(columns, np.zeros((0, 2)), [np.zeros((12, 0))], groups)
    noise = Noise.shown(design, [residuals], ["mm"], np.ones(1))
    found = Scatter.of(design, residuals, noise.std**2, noise)
    independent = np.linalg.inv(columns.T @ columns) * (residuals @ residuals) / 10.0
    assert np.diag(found.covariance) == pytest.approx(np.maximum(np.sum(moved**2, axis=0), np.diag(independent)))


@pytest.mark.parametrize(
    ("sizes", "of_state"),
    [(np.arange(5.0), 1.0), (np.arange(5.0), 0.0), (np.array([1.0, 4.0, 4.0, 3.0]), 1.0), (np.ones(6), 1.0)],
)
def test_intervals_contain_the_truth_as_often_as_they_say(sizes: np.ndarray, of_state: float) -> None:
    """States of these loads, each off by an error in proportion to its load, and independent errors of 12 points."""
    rng, hits, draws = np.random.default_rng(11), 0, 500
    groups = np.repeat(np.arange(len(sizes)), 12)
    ways = sizes[groups]
    design = Design(ways[:, None], np.zeros((0, 1)), [np.zeros((len(ways), 0))], groups)
    for _ in range(draws):
        errors = of_state * (sizes * rng.normal(size=len(sizes)))[groups] + 0.3 * rng.normal(size=len(ways))
        estimate = float(ways @ errors) / float(ways @ ways)
        residuals = ways * estimate - errors
        noise = Noise.shown(design, [residuals], ["mm"], np.ones(1))
        hits += abs(estimate) < Scatter.of(design, residuals, noise.std**2, noise).half[0]
    # Three deviations of a count below 95 %.
    assert hits > 0.95 * draws - 3.0 * np.sqrt(draws * 0.95 * 0.05)


def test_noise_is_what_is_left_of_each_table() -> None:
    """Two means, of ten and of seven values: standard deviations with one degree of freedom less each."""
    rng = np.random.default_rng(9)
    values = [0.2 * rng.normal(size=10), 3.0 * rng.normal(size=7)]
    slopes = np.zeros((17, 2))
    slopes[:10, 0], slopes[10:, 1] = 1.0 / 0.2, 1.0 / 3.0
    design = Design(slopes, np.zeros((0, 2)), [np.zeros((10, 0)), np.zeros((7, 0))], np.arange(17))
    noise = Noise.shown(design, [part.mean() - part for part in values], ["mm", "N"], np.ones(2))
    assert noise.std == pytest.approx([np.std(part, ddof=1) for part in values])
    assert noise.freedom == pytest.approx([9.0, 6.0])


def test_few_forces_with_a_free_zero_have_wide_intervals() -> None:
    """Four forces, two unknowns: at least the interval of regression with two degrees of freedom."""
    model, places = plate_of_load(), np.linspace(0.0, 1.0, 4)
    for draw in range(5):
        forces = 100.0 * TRUTH * places + 1.0 + 0.5 * np.random.default_rng(draw).normal(size=4)
        table = MeasuredForces(model, ForceCurve("load", places, forces), reaction_in_direction(model, "edge:x"))
        found = identify(model, [table], ["a"])["a"]
        slope, _, _, _, error = map(float, linregress(100.0 * places, forces))
        assert found.value == pytest.approx(slope, abs=1e-6)
        half = float(t.ppf(0.975, 2)) * error
        assert found.interval[0] < slope - 0.999 * half
        assert found.interval[1] > slope + 0.999 * half


@pytest.mark.parametrize(("scale", "rank"), [([1.0, 1.0, 1.0], 6), ([1.0, 0.0, 0.0], 5)])
def test_a_rigid_motion_takes_six_values_of_points_and_five_of_a_line(scale: list[float], rank: int) -> None:
    """What it takes is what small shifts and turns change."""
    rng = np.random.default_rng(2)
    places = np.array(scale) * rng.normal(size=(5, 3))
    table = replace(points(np.array([1.0]), np.arange(4), rng), measured=np.zeros((4, 3)), aligned=True)
    basis = directions(table.loose(places.ravel()))
    assert basis.shape == (15, rank)
    turned = Rotation.from_rotvec([1e-6, -2e-6, 3e-6]).apply(places) + np.array([2e-6, 0.0, 1e-6])
    change = 1e6 * (turned - places).ravel()
    assert basis @ (basis.T @ change) == pytest.approx(change, abs=1e-4)
