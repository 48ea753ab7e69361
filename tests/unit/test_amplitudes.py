"""Amplitudes, the instants at which viscous solutions are taken, and functions through paths in time."""

from __future__ import annotations

import copy
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicSpline

import morph_dslam as md
from morph_dslam.errors import StudyError
from morph_dslam.mechanics.amplitudes import Amplitude
from morph_dslam.model import Parameter
from morph_dslam.reduction.path_functions import TimePaths, fit_paths
from morph_dslam.studies.defaults import resolve_defaults
from morph_dslam.studies.sampling import training_samples
from morph_dslam.studies.solid_study import SolidStudy
from morph_dslam.studies.time_sampling import time_instants

BAR: dict[str, Any] = {
    "name": "bar",
    "mesh": {"generator": "block", "size": ["10 mm", "10 mm", "20 mm"], "divisions": [1, 1, 1], "cells": "hex8"},
    "materials": {
        "gel": {
            "law": "neo_hookean",
            "young": "1 MPa",
            "poisson": 0.3,
            "prony": {"relative_moduli": [0.4, 0.3], "times": ["0.5 s", "6 s"]},
        }
    },
    "supports": [{"kind": "fixed", "on": "z_min"}, {"kind": "displacement", "on": "z_max", "z": "pull * ramp"}],
    "parameters": {"pull": {"range": ["0 mm", "8 mm"]}, "clock": {"range": ["0 s", "20 s"]}},
    "time": {
        "parameter": "clock",
        "step": "0.1 s",
        "amplitudes": {"ramp": {"times": ["1 s", "3 s"], "values": [0.0, 1.0]}},
    },
}


def bar(**sections: Any) -> SolidStudy:
    study = resolve_defaults(md.make_study(copy.deepcopy(BAR) | sections))
    assert isinstance(study, SolidStudy)
    return study


def test_a_maxwell_element_relaxes_as_its_differential_equation_says() -> None:
    """q' = a' - q / tau, which begins with the jump to a(start)."""
    amplitude = Amplitude((1.0, 3.0, 3.5, 9.0), (0.5, 2.0, 2.0, -1.0))
    slopes = {(1.0, 3.0): 0.75, (3.0, 3.5): 0.0, (3.5, 9.0): -3.0 / 5.5, (9.0, 12.0): 0.0}
    value = float(amplitude(2.0))
    for (begin, end), slope in slopes.items():
        begin = max(begin, 2.0)
        solution = solve_ivp(lambda _, q, a=slope: a - q / 1.7, (begin, end), [value], rtol=1e-11, atol=1e-12)
        value = float(solution.y[0, -1])
        assert amplitude.relaxed(np.array([end]), 2.0, 1.7)[0] == pytest.approx(value, abs=1e-8)


@pytest.mark.parametrize("span", [2.0, 20.0, 300.0])
def test_splines_through_the_instants_take_relaxation_and_ramps(span: float) -> None:
    """Against SciPy's splines, at a thousand times in between."""
    study = bar(parameters=BAR["parameters"] | {"clock": {"range": ["0 s", f"{span} s"]}})
    instants, fine = time_instants(study), np.linspace(0.0, span, 1001)
    assert (instants[0], instants[-1]) == (0.0, span)
    for truth in (lambda t: np.exp(-t / 0.5), lambda t: np.exp(-t / 6.0), lambda t: np.interp(t, [1.0, 3.0], [0, 1])):
        assert np.abs(CubicSpline(instants, truth(instants))(fine) - truth(fine)).max() < 2e-3
    assert len(instants) < 150
    assert np.diff(instants).min() < 0.05 * np.diff(instants).max(), "they are dense where the response is fast"


def test_paths_share_their_instants_and_begin_with_the_defaults() -> None:
    study = bar()
    assert (study.sampling.scheme, study.sampling.training) == ("paths", 24)
    samples, instants = training_samples(study), time_instants(study)
    assert len(samples) == 24 * len(instants)
    np.testing.assert_allclose(samples[: len(instants), 1], instants)
    assert not samples[: len(instants), 0].any(), "the first path has the default pull"
    paths = TimePaths.of(samples, study.model_parameters())
    assert paths is not None
    assert paths.rows.shape == (24, len(instants))


def test_what_is_a_polynomial_at_each_instant_is_met_exactly() -> None:
    """f = (1 + a b - b^3) exp(-t), and twice a; a path that is not whole is left out."""
    parameters = [
        Parameter("a", "ratio", "1", 0.0, 2.0, 0.0),
        Parameter("t", "time", "s", 0.0, 4.0, 0.0),
        Parameter("b", "ratio", "1", -1.0, 1.0, 0.0),
    ]
    rng, instants = np.random.default_rng(0), 4.0 * np.linspace(0.0, 1.0, 30) ** 2
    others = np.column_stack([rng.uniform(0, 2, 40), rng.uniform(-1, 1, 40)])
    samples = np.array([[a, t, b] for a, b in others for t in instants])[:-1]
    a, t, b = samples.T
    values = np.column_stack([(1.0 + a * b - b**3) * np.exp(-t), 2.0 * a])
    paths = TimePaths.of(samples, parameters)
    assert paths is not None
    assert paths.rows.shape == (39, 30)
    box = np.array([[0.0, 2.0], [0.0, 4.0], [-1.0, 1.0]])
    functions, errors = fit_paths(paths, samples, values, box, 5, np.ones(len(samples)), 1e-10)
    assert min(errors, key=lambda degree: errors[degree]) >= 3
    for point in rng.uniform(box[:, 0], box[:, 1], (20, 3)):
        a, t, b = point
        spline = CubicSpline(instants, np.exp(-instants))(t)
        found, slopes = functions.evaluate(point)
        np.testing.assert_allclose(found, [(1.0 + a * b - b**3) * spline, 2.0 * a], atol=2e-4)
        np.testing.assert_allclose(slopes[2], [(a - 3.0 * b**2) * spline, 0.0], atol=2e-3)


def test_scattered_samples_are_on_no_paths() -> None:
    parameters = [Parameter("a", "ratio", "1", 0.0, 1.0, 0.0), Parameter("t", "time", "s", 0.0, 1.0, 0.0)]
    assert TimePaths.of(np.random.default_rng(0).random((50, 2)), parameters) is None


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"ramp": {"times": ["1 s", "1 s"], "values": [0, 1]}}, "times must rise"),
        ({"ramp": {"times": ["1 s", "2 s"], "values": [0]}}, "2 times and 1 values"),
        ({"other": {"times": ["1 s", "2 s"], "values": [0, 1]}}, "the amplitudes are other"),
        ({"pull": {"times": ["1 s", "2 s"], "values": [0, 1]}}, "'pull' is a parameter too"),
        ({"a b": {"times": ["1 s", "2 s"], "values": [0, 1]}}, "'a b' is no name for an amplitude"),
    ],
)
def test_amplitudes_that_cannot_be_are_refused(change: dict[str, Any], message: str) -> None:
    with pytest.raises(StudyError, match=message):
        bar(time=BAR["time"] | {"amplitudes": change})


def test_a_traction_with_an_amplitude_that_is_far_too_large_is_asked_about() -> None:
    loads = [{"kind": "traction", "on": "z_max", "traction": ["0 Pa", "0 Pa", "press * ramp"]}]
    parameters = BAR["parameters"] | {"press": {"range": ["0 kPa", "10 MPa"]}}
    ramp = {"ramp": {"times": ["1 s", "3 s"], "values": [0.0, 2.0]}}
    study = bar(loads=loads, parameters=parameters, time=BAR["time"] | {"amplitudes": ramp})
    assert "reaches 20 MPa, 52 times the shear modulus" in study.load_doubt()


def test_paths_need_a_time() -> None:
    content = copy.deepcopy(BAR) | {"sampling": {"scheme": "paths"}, "time": None}
    del content["materials"]["gel"]["prony"]
    content["supports"][1]["z"] = "pull"
    with pytest.raises(StudyError, match=r"is for studies with \[time\]"):
        resolve_defaults(md.make_study(content))
