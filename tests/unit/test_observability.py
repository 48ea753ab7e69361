"""What the images do not tell, and how far off what they tell may be: known blind combinations, samples."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from morph_dslam.geometry import RigidTransform
from morph_dslam.model import Parameter, ReducedModel, SeparatedField
from morph_dslam.model.functions import ParameterFunctions
from morph_dslam.model.reduced_model import von_mises
from morph_dslam.tracking.estimator import Estimate, Estimator, State
from morph_dslam.tracking.observability import (
    displacement_std,
    largest_displacement,
    largest_von_mises,
    one_value,
    statement,
    unobservable,
    value_line,
    von_mises_std,
)
from morph_dslam.tracking.outcomes import FoundBy, PastForgotten, Status
from morph_dslam.tracking.result import STAGES, FrameResult
from morph_dslam.tracking.run_folder import summarise
from morph_dslam.tracking.run_notices import RunNotice, RunWarning, flags_of
from morph_dslam.tracking.run_results import RunResults
from morph_dslam.tracking.sequence_filter import SequenceFilter
from tests.support.bent_sheet import bent_sheet_model, sheet_mesh
from tests.support.measured_points import bound_points, measured
from tests.support.rendered_sequence import CAMERA

POSE = RigidTransform(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, 0.6]))


def beam_model():
    """A sheet bent by load over stiffness to first order, (load - 2 stiffness) w; a colour has no effect.

    ``load`` and ``stiffness`` (-1 to 1 each) can therefore not be told apart; ``shear`` can.
    """
    nodes, triangles = sheet_mesh(22, 16)
    s, zero = 2.0 * nodes[:, 0] / 0.420, np.zeros(len(nodes))
    bend = 0.02 * np.column_stack([zero, zero, 1.0 - s**2])
    shear = 0.02 * np.column_stack([zero, s**3, zero])
    parameters = tuple(
        Parameter(name, "ratio", "1", -1.0, 1.0, 0.0) for name in ("load", "stiffness", "shear", "colour")
    )
    indices = np.eye(4, dtype=np.int64)[:3]
    rows = np.array([[1.0, 0.0], [-2.0, 0.0], [0.0, 1.0]])
    functions = ParameterFunctions(-np.ones(4), np.ones(4), indices, rows)
    return ReducedModel("beam", nodes, triangles, parameters, SeparatedField(np.stack([bend, shear]), functions))


MODEL = beam_model()


def run_of(per_sequence, frames=3, later_shear=None, wider=1.0):
    """A run in which 80 points with noise are seen in every frame.

    From frame 6 on the shear may be another one; all deviations may be stated ``wider`` times.
    """
    rng = np.random.default_rng(0)
    points, truth = bound_points(MODEL, 80, rng), State(np.array([0.3, 0.1, 0.2, 0.0]), POSE)
    estimator = Estimator(MODEL, CAMERA)
    names = [parameter.name for parameter in MODEL.parameters]
    filtered = SequenceFilter(estimator, [names.index(name) for name in per_sequence])
    run = RunResults(MODEL, 0, per_sequence=per_sequence)
    for number in range(frames):
        if number == 6 and later_shear is not None:
            truth = State(np.array([0.3, 0.1, later_shear, 0.0]), POSE)
        pixels = CAMERA.project(points.in_camera(truth)) + 0.3 * rng.standard_normal((80, 2))
        seen = measured(points, pixels)
        estimate = filtered.fuse(seen, estimator.fit(seen, truth))
        estimate = replace(estimate, covariance=wider**2 * estimate.covariance)
        times = dict.fromkeys(STAGES, 1.0)
        run.add(
            number,
            0.1 * number,
            FrameResult(
                MODEL,
                Status.TRACKED,
                estimate,
                FoundBy.FLOW,
                warnings=(PastForgotten(),) if filtered.forgot else (),
                n_points=80,
                n_inliers=80,
                residual_rms_px=0.4,
                timings_ms=times,
            ),
        )
    return run


def test_parameters_without_effect_and_those_that_act_alike_are_named():
    colour, both = summarise(run_of(()))["notices"]
    assert (colour["kind"], colour["parameters"], colour["count"]) == ("unobservable", ["colour"], 3)
    assert (both["kind"], both["parameters"], both["count"]) == ("unobservable", ["load", "stiffness"], 3)
    # 2 stiffness - load stays the same: twice as much of the load as of the stiffness, both in shares of 2.
    assert "'load' is 0.179 larger and 'stiffness' is 0.0894 larger" in both["text"]


def test_what_is_unobservable_is_said_in_two_lines_at_most():
    def unobservable_in(count, *names):
        data = {"parameters": list(names), "count": count, "statement": f"{names} in {count}"}
        return RunNotice.of(RunWarning.UNOBSERVABLE, **data, over_the_sequence=False)

    lost = RunNotice.of(RunWarning.LOST, count=1, n_frames=50)
    combinations = [
        unobservable_in(2, "left", "right"),
        unobservable_in(5, "left", "way"),
        unobservable_in(1, "a", "b"),
    ]
    said = flags_of([unobservable_in(35, "left"), *combinations, lost, unobservable_in(1, "right")])
    assert said == [
        lost.text,
        "parameters are unobservable in some frames: 'left' in 35 frames, 'right' in 1 frame",
        "('left', 'way') in 5; likewise 2 other combinations, in 3 frames",
    ]
    alone = [unobservable_in(4, "left"), unobservable_in(2, "left", "right")]
    assert flags_of(alone) == [notice.text for notice in alone]


def test_values_over_the_sequence_have_an_interval_and_say_when_nothing_tells():
    summary = summarise(run_of(("shear", "stiffness", "colour"), frames=12))
    stiffness, shear, colour = summary["one_over_the_sequence"]
    low, high = shear["interval_95"]
    assert low < 0.2 < high
    assert high - low < 0.05
    assert shear["observable"]
    assert not stiffness["observable"]
    assert not colour["observable"]
    assert any(notice["parameters"] == ["colour"] for notice in summary["notices"])
    assert value_line(shear).startswith("shear = 0.")
    assert value_line(colour).endswith("unobservable")


def test_a_value_that_is_not_one_over_the_sequence_is_named():
    """The shear is 0.2 in six frames and -0.4 in those that follow, of which the first two change nothing yet."""
    summary = summarise(run_of(("shear", "colour"), frames=12, later_shear=-0.4))
    (told,) = (notice for notice in summary["notices"] if notice["kind"] == "not_one_value")
    assert (told["parameter"], told["last"], told["first"]) == ("shear", 5, 8)
    before, after = (float(told[key].split(" ± ")[0]) for key in ("before", "after"))
    assert (before, after) == (pytest.approx(0.2, abs=0.02), pytest.approx(-0.4, abs=0.02))
    shear, colour = summary["one_over_the_sequence"]
    assert (shear["is_one_value"], colour["is_one_value"]) == (False, True)
    assert "last frames" in value_line(shear)


@pytest.mark.parametrize(("later_shear", "wider"), [(None, 1.0), (0.2, 1.0), (-0.4, 60.0)])
def test_frames_that_agree_within_their_deviations_are_not_accused(later_shear, wider):
    summary = summarise(run_of(("shear",), frames=12, later_shear=later_shear, wider=wider))
    assert [notice for notice in summary["notices"] if notice["kind"] == "not_one_value"] == []
    assert summary["one_over_the_sequence"][0]["is_one_value"]


def test_interval_is_in_the_parameters_unit():
    modulus = Parameter("shear_modulus", "stress", "kPa", 1e4, 9e4, 5e4)
    figures = one_value(modulus, 5.0e4, 1e3)
    assert figures["interval_95"] == pytest.approx([50.0 - 1.96, 50.0 + 1.96])
    assert value_line(figures) == "shear_modulus = 50 kPa over the sequence, 95 % interval 48.04 to 51.96 kPa"


def test_combinations_that_share_a_parameter_come_together():
    """Three angles of which only the sum counts: two directions are open."""
    seen = np.ones(3) / np.sqrt(3.0)
    covariance = np.linalg.inv(1e4 * np.outer(seen, seen) + 1e-6 * np.eye(3))
    (part,) = unobservable(covariance, np.ones(3))
    assert part.indices == (0, 1, 2)
    assert len(part.directions) == 2
    np.testing.assert_allclose(part.directions @ seen, 0.0, atol=1e-6)
    names = [Parameter(name, "angle", "deg", -1.0, 1.0, 0.0) for name in "abc"]
    assert statement(names, part, "in 5 frames") == (
        "only a combination of parameters 'a', 'b' and 'c' is observable in 5 frames"
    )


def test_all_told_and_nothing_told():
    assert unobservable(np.diag([0.01, 0.02]) ** 2, np.ones(2)) == []
    assert [part.indices for part in unobservable(np.full((2, 2), np.inf), np.ones(2))] == [(0,), (1,)]


SHEET = bent_sheet_model(22, 16)
MU = np.array([0.03, 0.15, 0.1])


@pytest.fixture(scope="module")
def estimate():
    root = np.array([[2e-4, 0.0, 0.0], [1e-3, 2e-3, 0.0], [-5e-4, 1e-3, 1e-3]])
    covariance = np.zeros((9, 9))
    covariance[:3, :3] = root @ root.T
    state = State(MU, RigidTransform(np.eye(3), np.zeros(3)))
    return Estimate(state, 1.0, np.zeros((1, 2)), 0.3, covariance, np.zeros(3, dtype=bool), 1, True)


@pytest.fixture(scope="module")
def drawn(estimate):
    """Parameters (k, 3) with the covariance, in pairs about their mean."""
    half = np.random.default_rng(0).multivariate_normal(np.zeros(3), estimate.covariance[:3, :3], 1500)
    return MU + np.concatenate([half, -half])


def test_displacement_spreads_as_stated(estimate, drawn):
    moved = np.array([SHEET.displacement.value(mu) for mu in drawn])
    expected = np.sqrt(moved.var(axis=0).sum(axis=1))
    stated = displacement_std(SHEET, estimate)
    assert expected.max() > 1e-4
    np.testing.assert_allclose(stated, expected, rtol=0.06, atol=2e-3 * expected.max())


def test_largest_displacement_spreads_as_stated(estimate, drawn):
    value, deviation = largest_displacement(SHEET, estimate)
    node = np.linalg.norm(SHEET.displacement.value(MU), axis=1).argmax()
    lengths = [np.linalg.norm(SHEET.displacement.value(mu)[node]) for mu in drawn]
    assert value == pytest.approx(np.mean(lengths), rel=1e-3)
    assert deviation == pytest.approx(np.std(lengths), rel=0.06)


def test_largest_stress_spreads_as_stated(estimate, drawn):
    """At the node where it is largest on either face."""
    value, deviation = largest_von_mises(SHEET, estimate)
    by_face = {place: von_mises(SHEET.stresses[place].value(MU)) for place in SHEET.stresses}
    place = max(by_face, key=lambda name: by_face[name].max())
    node = by_face[place].argmax()
    assert value == pytest.approx(by_face[place][node])
    sizes = [von_mises(SHEET.stresses[place].value(mu)[node]) for mu in drawn]
    assert deviation == pytest.approx(np.std(sizes), rel=0.06)


def test_model_without_stresses_has_no_largest_one(estimate):
    assert np.isnan(largest_von_mises(type(SHEET)(**{**vars(SHEET), "stresses": {}}), estimate)).all()


@pytest.mark.parametrize("components", [3, 6])
def test_stress_spreads_as_stated(estimate, drawn, components):
    """The stresses of a sheet, and six components made of them."""
    top = SHEET.stresses["top"]
    rng = np.random.default_rng(1)
    modes = top.modes if components == 3 else top.modes @ rng.standard_normal((3, 6))
    field = top.with_modes(modes)
    model = type(SHEET)(**{**vars(SHEET), "stresses": {"top": field}})
    stresses = np.array([von_mises(field.value(mu)) for mu in drawn])
    seen = stresses.mean(axis=0) > 0.1 * stresses.max()
    stated = von_mises_std(model, estimate, "top")
    np.testing.assert_allclose(stated[seen], stresses.std(axis=0)[seen], rtol=0.1)


def test_positions_in_the_camera_frame_are_as_well_known_as_shape_and_pose_together():
    """Against states drawn from the covariance."""
    result = run_of(("shear",)).results[-1]
    rng, known = np.random.default_rng(1), result.estimate.state
    covariance = 1e-4 * np.diag([1.0, 0.0, 1.0, 0.0, *[0.04] * 3, *[1e-4] * 3])
    result = replace(result, estimate=replace(result.estimate, covariance=covariance))
    here, squared = result.positions(), np.zeros(len(MODEL.nodes))
    steps = rng.multivariate_normal(np.zeros(10), covariance, 4000)
    for step in steps:
        parameters = known.parameters + step[:4]
        pose = known.camera_from_object
        turned = (MODEL.nodes + MODEL.displacement.value(parameters)) @ pose.rotation.T
        there = Rotation.from_rotvec(step[4:7]).apply(turned) + pose.translation + step[7:]
        squared += np.sum((there - here) ** 2, axis=1)
    assert result.position_std() == pytest.approx(np.sqrt(squared / len(steps)), rel=0.06)
