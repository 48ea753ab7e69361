"""Unknown loads on slender bodies: they bend far, and get no longer by it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from morph_dslam import Parameter, SolidProblem, build, load_model, make_study
from morph_dslam.extend.mechanics import DeadTraction, ParameterSymbols, advance, fixed
from morph_dslam.model.model_errors import ModelErrors
from morph_dslam.model.parameter_errors import parameter_errors
from morph_dslam.model.storage import save_model
from morph_dslam.model.unknown_loads import with_unknown_loads

LENGTH, WIDTH = 0.08, 0.004
STUDY = {
    "name": "beam",
    "mesh": {"generator": "block", "size": ["80 mm", "4 mm", "4 mm"], "divisions": [24, 2, 2], "cells": "hex8"},
    "materials": {"silicone": {"law": "neo_hookean", "young": "1 MPa", "poisson": 0.3}},
    "supports": [{"kind": "fixed", "on": "x_min"}],
    "loads": [{"kind": "traction", "on": "x_max", "traction": ["0 Pa", "pull", "0 Pa"]}],
    "parameters": {"pull": {"range": ["-100 Pa", "100 Pa"], "default": "0 Pa"}},
    "solver": {"threads": 1},
    "sampling": {"scheme": "even", "training": 9, "held_out": 4, "refined": 0},
    "unknown_loads": {"on": "x_max", "direction": "any", "modes": 27},
}
#: Traction across, Pa, that moves the end by about a sixth of the length (in the beam's theory).
TRACTION = 3.0 * 1e6 * WIDTH**2 / 12.0 / (6.0 * LENGTH**2)


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    path = tmp_path_factory.mktemp("beam") / "beam.morph"
    build(make_study(STUDY), path)
    return path


@pytest.fixture(scope="module")
def loaded(file):
    return with_unknown_loads(load_model(file), 1e-3)


def uniform(loaded, pull, traction):
    """The model's parameters with a uniform traction (3,) on the end as unknown load."""
    loads = loaded.energy.loads
    on_end = np.tile(traction, (len(loads.nodes), 1)).ravel()
    coefficients, *_ = np.linalg.lstsq(loads.tractions.reshape(-1, loads.count), on_end, rcond=None)
    return np.array([pull, *coefficients])


@pytest.mark.slow
@pytest.mark.parametrize("pull", [0.0, 60.0])
def test_a_bent_beam_is_where_finite_elements_have_it(loaded, pull):
    """The second order leaves less than a third of what the first one misses: most of that is of third order."""
    symbols = ParameterSymbols([Parameter("down", "stress", "Pa", 0.0, 1e3, 0.0)])
    study = make_study(STUDY)
    silicone = study.problem().regions[0].material
    loads = [DeadTraction("x_max", (0.0, pull, -symbols["down"]))]
    problem = SolidProblem(study.solid_mesh(), {"all": silicone}, [fixed("x_min")], loads, symbols)
    state = advance(problem, problem.initial_state(), np.array([TRACTION]))[-1]
    truth = problem.nodal_displacement(state.dofs)
    mu = uniform(loaded, pull, [0.0, 0.0, -TRACTION])
    first_only = with_unknown_loads(
        replace(loaded.energy.model, unknown_loads=replace(loaded.energy.loads, second_order=None)), 1e-3
    )
    missed = [np.linalg.norm(model.displacement.value(mu) - truth) for model in (first_only, loaded)]
    assert missed[0] > 0.05 * np.linalg.norm(truth)
    assert missed[1] < 0.33 * missed[0]


def test_a_bent_beam_keeps_its_length(loaded):
    """A beam with a force at its end that moves by v is 3 v^2 / 5 L shorter along its axis.

    The force is not quite one of the softest combinations: most of it counts to second order.
    """
    end = np.flatnonzero(loaded.nodes[:, 0] > LENGTH - 1e-9)
    moved = loaded.displacement.value(uniform(loaded, 0.0, [0.0, 0.0, -0.5 * TRACTION]))[end].mean(axis=0)
    assert moved[2] == pytest.approx(-LENGTH / 12.0, rel=0.03)
    assert moved[0] == pytest.approx(-0.6 * moved[2] ** 2 / LENGTH, rel=0.06)


@pytest.mark.slow
def test_a_strip_that_bends_under_an_even_load_keeps_its_length():
    """A cantilever under an even load whose end moves by v is 4 v^2 / 7 L shorter along its axis."""
    study = {
        "name": "strip",
        "mesh": {"generator": "plate", "size": ["80 mm", "10 mm"], "divisions": [12, 2]},
        "shell": {"thickness": "1 mm"},
        "material": {"young": "1 MPa", "poisson": 0.3},
        "supports": [{"kind": "clamped", "on": "x_min"}],
        "loads": [{"kind": "traction", "traction": ["0 Pa", "0 Pa", "down"]}],
        "parameters": {"down": {"range": ["-0.5 Pa", "0.5 Pa"], "default": "0 Pa"}},
        "sampling": {"scheme": "even", "training": 8, "held_out": 4, "refined": 0},
        "unknown_loads": {"direction": "any", "modes": 24},
    }
    loaded = with_unknown_loads(build(make_study(study)), 1e-4)
    end = np.flatnonzero(loaded.nodes[:, 0] > LENGTH - 1e-9)
    moved = loaded.displacement.value(uniform(loaded, 0.0, [0.0, 0.0, -0.2]))[end].mean(axis=0)
    assert 0.1 * LENGTH < -moved[2] < 0.2 * LENGTH
    assert moved[0] == pytest.approx(-4.0 / 7.0 * moved[2] ** 2 / LENGTH, rel=0.02)


def test_derivatives_agree_with_differences(loaded):
    rng = np.random.default_rng(0)
    mu = np.array([30.0, *0.02 * rng.standard_normal(loaded.n_loads)])
    _, slopes = loaded.displacement.value_and_sensitivities(mu)
    for k in (0, 1, 2, 9):
        step = np.eye(len(mu))[k] * (1.0 if k == 0 else 1e-4)
        upper, lower = (loaded.displacement.value(mu + sign * step) for sign in (1.0, -1.0))
        np.testing.assert_allclose(slopes[k], (upper - lower) / (2.0 * step[k]), atol=1e-5 * np.abs(slopes[k]).max())


def test_a_model_file_keeps_it_and_is_checked(file, tmp_path):
    model = load_model(file)
    second = model.unknown_loads.second_order
    assert second.soft.shape == (3, model.unknown_loads.count)
    short = replace(model.unknown_loads, second_order=replace(second, soft=second.soft[:2]))
    with pytest.raises(ValueError, match="second order"):
        save_model(tmp_path / "wrong.morph", replace(model, unknown_loads=short))


def test_what_the_mesh_is_off_by_is_a_deviation_of_unknown_loads(loaded):
    """Finer elements that are off as under a force of 1 mN on the end: deviations hold it, also where it is pushed."""
    model, count = loaded.energy.model, loaded.n_loads
    force = uniform(loaded, 0.0, [0.0, 0.0, -1e-3 / WIDTH**2])[1:]
    mu = np.array([50.0])
    own = model.displacement.value(mu)
    _, slopes = loaded.displacement.value_and_sensitivities(np.append(mu, np.zeros(count)))
    entry = parameter_errors(model, [(mu, own, own + np.tensordot(force, slopes[1:], axes=1))])
    assert entry["left_rms_mm"][0] > 10.0 * entry["with_unknown_loads"]["left_rms_mm"][0]
    certified = replace(model, certificate={"discretisation": {"parameters": entry}})
    errors = ModelErrors.of(with_unknown_loads(certified, 1e-3))
    assert errors is not None
    resultant = loaded.energy.loads.resultants[:, 2]

    def stated(coefficients):
        covariance = errors.at(np.append(mu, coefficients)).parameters[1:, 1:]
        return float(np.sqrt(resultant @ covariance @ resultant))

    at_rest = stated(np.zeros(count))
    # In proportion to the displacement of the surface: that of the finer elements is a little larger.
    size = [
        np.sqrt(np.mean(np.sum(moved[np.unique(model.triangles)] ** 2, axis=1)))
        for moved in (own, own + np.tensordot(force, slopes[1:], axes=1))
    ]
    assert at_rest == pytest.approx(1e-3 * size[0] / size[1], rel=0.03)
    # A load that pushes the end back takes nothing away.
    back = uniform(loaded, 0.0, [0.0, -50.0, 0.0])[1:]
    assert stated(back) > 1.3 * at_rest
