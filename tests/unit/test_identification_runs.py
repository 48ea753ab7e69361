"""Intervals of what is identified from forces by frame: errors of the states that a run found are in them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from morph_dslam.camera import Camera
from morph_dslam.errors import IdentificationError
from morph_dslam.evaluation.force import reaction_in_direction
from morph_dslam.evaluation.force_curves import ForceCurve
from morph_dslam.evaluation.run_folder import Run
from morph_dslam.identification.identify import identify
from morph_dslam.identification.measured_forces import MeasuredForces
from morph_dslam.identification.report import identification_lines, summarise
from morph_dslam.identification.run_values import values_of_run
from morph_dslam.identification.values import FACTOR
from morph_dslam.model import SeparatedField
from morph_dslam.model.functions import ParameterFunctions
from morph_dslam.model.unknown_loads import UnknownLoads, with_unknown_loads
from tests.support.edge_plate import plate_of_load

LOADS = np.linspace(0.1, 0.9, 17)


def run_of(loads: np.ndarray, stds: np.ndarray) -> Run:
    """A run that found these loads with these deviations (n,), and a = 0.5 exactly."""
    count = len(loads)
    words, poses = ("tracked",) * count, np.tile(np.eye(4), (count, 1, 1))
    covariances = np.zeros((count, 8, 8))
    covariances[:, 0, 0] = stds**2
    states = np.column_stack([loads, np.full(count, 0.5)])
    camera = Camera(640, 480, 500.0, 500.0, 320.0, 240.0)
    return Run(plate_of_load(), camera, np.arange(count), words, words, poses, states, {}, covariances=covariances)


def by_frame(run: Run, forces: np.ndarray, free_zero: bool = False) -> MeasuredForces:
    curve = ForceCurve("frame", np.arange(len(forces), dtype=np.float64), forces)
    return MeasuredForces(run.model, curve, reaction_in_direction(run.model, "edge:x"), run, free_zero)


def test_errors_of_all_states_together_are_in_the_deviation() -> None:
    """All loads are off by one error: that of a factor is its part along the forces, by hand."""
    run, forces = run_of(LOADS, np.full(17, 0.02)), 100.0 * 0.5 * LOADS
    found = identify(run.model, [by_frame(run, 1.2 * forces)], moduli=True)
    shift = 100.0 * 0.5 * 0.02
    expected = 1.2 * float(np.sum(forces * shift)) / float(forces @ forces)
    assert found[FACTOR].run_std == pytest.approx(expected, rel=1e-4)
    assert found[FACTOR].std == pytest.approx(expected, rel=1e-3)
    # The zero of a load cell takes up what is the same in all frames.
    found = identify(run.model, [by_frame(run, 1.2 * forces, free_zero=True)], moduli=True)
    assert found[FACTOR].run_std < 1e-6


def test_what_grows_with_the_load_is_no_zero_of_a_load_cell() -> None:
    """Loads that are all off by 3 % are a factor of the forces, and the note says where the interval comes from."""
    run, forces = run_of(LOADS, 0.03 * LOADS), 100.0 * 0.5 * LOADS
    found = identify(run.model, [by_frame(run, forces, free_zero=True)], moduli=True)
    assert found[FACTOR].run_std == pytest.approx(0.03, rel=1e-4)
    assert f"most of the interval of {FACTOR} is by errors of the run" in "\n".join(
        identification_lines(summarise(found))
    )


def test_what_is_identified_has_no_error_of_the_run() -> None:
    """The run's a is not used where a is identified, but its loads are: a relative error of them is one of a."""
    run = run_of(LOADS, 0.03 * LOADS)
    assert run.covariances is not None
    run.covariances[:, 1, 1] = 0.2**2
    found = identify(run.model, [by_frame(run, 100.0 * 0.4 * LOADS)], ["a"])
    assert found["a"].value == pytest.approx(0.4, abs=1e-6)
    assert found["a"].run_std == pytest.approx(0.03 * 0.4, rel=1e-4)


def test_forces_by_a_known_load_do_not_have_the_errors_of_a_run() -> None:
    """Beside a run, whose covariances are none of theirs, they have the interval that they have without one."""
    forces = 100.0 * 0.5 * LOADS + 0.3 * np.random.default_rng(4).normal(size=17)
    curve = ForceCurve("load", LOADS, forces)
    run = run_of(LOADS, np.full(17, 0.1))
    alone = MeasuredForces(run.model, curve, reaction_in_direction(run.model, "edge:x"))
    intervals = [identify(run.model, [t], moduli=True)[FACTOR].interval for t in (alone, replace(alone, run=run))]
    assert intervals[0] == intervals[1]


@pytest.mark.parametrize("content", [None, "{}", "[]", "{", '{"one_over_the_sequence": 1}'])
def test_a_summary_that_does_not_tell_is_named(tmp_path: Path, content: str | None) -> None:
    if content is not None:
        (tmp_path / "summary.json").write_text(content)
    with pytest.raises(IdentificationError, match=r"summary\.json"):
        values_of_run(tmp_path, run_of(LOADS, np.zeros(17)), ["a"], measured=False)


def test_a_run_with_unknown_loads_is_refused_by_the_name_of_the_option() -> None:
    plate, constant = (
        plate_of_load(),
        ParameterFunctions(np.zeros(2), np.ones(2), np.zeros((1, 2), int), np.ones((1, 1))),
    )
    responses = {
        "displacement": SeparatedField(np.ones((1, 4, 3)), constant),
        "reaction_force_edge": SeparatedField(np.zeros((1, 1, 3)), constant),
        "compliance_root": SeparatedField(np.ones((1, 1, 1)), constant),
    }
    loads = UnknownLoads("", False, np.arange(4), np.ones((4, 3, 1)), np.ones((1, 6)), responses)
    run, forces = run_of(LOADS, np.zeros(17)), 100.0 * 0.5 * LOADS
    assert by_frame(run, forces).left_out == 0
    loaded = with_unknown_loads(replace(plate, unknown_loads=loads))
    loaded = replace(run, model=loaded, parameters=np.column_stack([run.parameters, np.full(17, 0.1)]))
    with pytest.raises(IdentificationError, match="tracked with --unknown-loads"):
        MeasuredForces(plate, by_frame(run, forces).curve, by_frame(run, forces).reaction, loaded)
    # Forces by a known load do not need what the run has of its loads.
    known = ForceCurve("load", LOADS, forces)
    assert MeasuredForces(plate, known, by_frame(run, forces).reaction, loaded).left_out == 0


@pytest.mark.slow
@pytest.mark.parametrize("free_zero", [True, False])
def test_intervals_hold_as_often_as_they_say(free_zero: bool) -> None:
    """Errors that all frames share, which grow with the load, smaller ones of each frame, and noise of the forces."""
    hits, draws = 0, 100
    common, own = 0.01 + 0.02 * LOADS, 0.003
    for seed in range(draws):
        rng = np.random.default_rng(seed)
        loads = LOADS + common * rng.normal() + own * rng.normal(size=17)
        run = run_of(loads, np.hypot(common, own))
        table = by_frame(run, 1.1 * 50.0 * LOADS + 0.1 * rng.normal(size=17), free_zero)
        low, high = identify(run.model, [table], moduli=True)[FACTOR].interval
        hits += low < 1.1 < high
    # Three deviations of a count below 95 %.
    assert hits > 0.95 * draws - 3.0 * np.sqrt(draws * 0.95 * 0.05)
