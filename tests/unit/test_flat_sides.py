"""Parameters that change nothing on one side, as the way of a plate that has not touched yet."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import morph_dslam as md
from morph_dslam.errors import IdentificationError
from morph_dslam.geometry import RigidTransform
from morph_dslam.identification.identify import identify
from morph_dslam.identification.measured_points import MeasuredPoints
from morph_dslam.tracking.estimator import Estimate, State
from morph_dslam.tracking.flat_sides import FlatSides, reach
from morph_dslam.tracking.frame_results import with_flat_sides
from morph_dslam.tracking.observability import covariance_of_parameters
from morph_dslam.tracking.outcomes import Status
from morph_dslam.tracking.result import FrameResult

#: A cube of 20 mm, free to grow aside, under a plate that touches it after 1 mm of at most 3 mm.
SIDE, GAP, RANGE = 0.02, 1e-3, 3e-3


@pytest.fixture(scope="module")
def model():
    slides = [{"kind": "displacement", "on": f"{axis}_min", axis: "0 mm"} for axis in "xyz"]
    plate = {"kind": "plane", "on": "z_max", "point": ["0 mm", "0 mm", "21 mm - depth"], "normal": [0, 0, -1]}
    study = {
        "name": "cube",
        "mesh": {"generator": "block", "size": ["20 mm"] * 3, "divisions": [1, 1, 1], "cells": "hex8"},
        "materials": {"rubber": {"law": "neo_hookean", "young": "1 MPa", "poisson": 0.3}},
        "supports": slides,
        "contacts": [plate],
        "parameters": {"depth": {"range": ["0 mm", "3 mm"]}},
        "sampling": {"scheme": "grid", "points": [31], "held_out": 4, "refined": 0},
        "solver": {"threads": 1, "workers": 1},
    }
    return md.build(md.make_study(study))


@pytest.mark.parametrize(
    ("change", "room", "expected"),
    [
        (lambda t: t**2, 50.0, 0.0),  # as the derivatives say
        (lambda t: min(t, 0.9) ** 2, 50.0, 50.0),  # no more than 0.9 of 2 anywhere
        (lambda t: min(t, 0.9) ** 2, 1.9, 0.0),  # the range ends before
        (lambda t: max(0.0, t - 10.0) ** 2, 50.0, 12.0),  # a flat part between
        (lambda t: 0.64 * t**2, 50.0, 0.0),  # bent, but not flat
        (lambda t: np.nan, 50.0, 0.0),
    ],
)
def test_a_parameter_may_go_where_predictions_are_within_two_deviations(change, room, expected):
    assert reach(change, 4.0, room) == pytest.approx(expected, rel=0.05)


@pytest.mark.parametrize(("off", "deviation"), [(0.01e-3, 0.02e-3), (0.05e-3, 0.04e-3)])
def test_a_plate_that_may_not_touch_yet_may_be_anywhere_before(model, off, deviation):
    """An estimate where it just touches: any depth up to there gives the shape at rest."""
    mu = np.array([GAP + off])
    found = FlatSides(model).variances(mu, np.array([deviation]))
    assert found is not None
    assert found[0] == pytest.approx(mu[0] ** 2 / 3.0, rel=1e-6)


def test_a_plate_that_clearly_touches_is_known_by_its_derivatives(model):
    sides = FlatSides(model)
    for depth in (1.5e-3, 2e-3, 2.5e-3):
        assert sides.variances(np.array([depth]), np.array([0.05e-3])) is None
    assert sides.variances(np.array([GAP]), np.array([np.inf])) is None


def test_a_frame_says_how_far_a_parameter_may_be_off_and_not_a_shape(model):
    state = State(np.array([GAP + 1e-5]), RigidTransform(np.eye(3), np.array([0.0, 0.0, 0.5])))
    covariance = np.diag([0.02e-3, *np.full(6, 1e-4)]) ** 2
    estimate = Estimate(state, 0.0, np.zeros((30, 2)), 0.3, covariance, np.zeros(1, dtype=bool), 1, True)
    before = FrameResult(model, Status.TRACKED, estimate)
    after = with_flat_sides(before, FlatSides(model))
    truth = 0.2e-3  # the same shape
    assert abs(GAP - truth) > 10.0 * estimate.parameter_std[0]
    assert abs(GAP - truth) < 2.0 * after.estimate.parameter_std[0]
    assert covariance_of_parameters(after.estimate)[0, 0] == pytest.approx(after.estimate.parameter_std[0] ** 2)
    assert np.array_equal(after.estimate.covariance, covariance)
    lost = FrameResult(model, Status.LOST)
    assert with_flat_sides(lost, FlatSides(model)) is lost
    clear = replace(before, estimate=replace(estimate, state=replace(state, parameters=np.array([2e-3]))))
    assert with_flat_sides(clear, FlatSides(model)).estimate.flat is None


def compressed(nodes, depth):
    """Displacements (n, 3) of a cube of a neo-Hookean solid of Poisson's ratio 0.3 in uniaxial compression."""
    shear, bulk_like = 1.0 / 2.6, 0.3 / (1.3 * 0.4)
    along = 1.0 - max(0.0, depth - GAP) / SIDE
    # mu (l - 1 / l) + lambda ln(J) / l = 0 aside, with J = l^2 l_z.
    aside = np.linspace(1.0, 1.2, 200001)
    stress = shear * (aside - 1.0 / aside) + bulk_like * np.log(aside**2 * along) / aside
    across = float(np.interp(0.0, stress, aside))
    return nodes * (np.array([across, across, along]) - 1.0)


@pytest.mark.slow
@pytest.mark.parametrize("depth", [0.3e-3, 0.9e-3, 2e-3])
def test_identification_allows_for_all_that_fits(model, depth):
    """The interval holds the truth before the plate touches, if there is one at all, and is narrow after."""
    places, widths = model.nodes[np.unique(model.triangles)], []
    for seed in range(8):
        noise = np.random.default_rng(seed).normal(0.0, 1e-5, places.shape)
        measured = places + compressed(places, depth) + noise
        table = MeasuredPoints(model, ("pressed",) * len(places), {}, places, measured)
        try:
            low, high = identify(model, [table], ["depth"])["depth"].interval
        except IdentificationError:  # by chance the best fit changes nothing on either side
            continue
        assert low <= depth <= high
        widths.append(high - low)
    assert len(widths) == 8 if depth > GAP else 0 < len(widths) < 8
    assert max(widths) < 0.2e-3 if depth > GAP else min(widths) > 0.9e-3
