"""Parameters that something else measures: the table, its messages, and what a value does to an estimate."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from morph_dslam.errors import ArgumentError, TrackingError
from morph_dslam.geometry import RigidTransform, rotation_exp, rotation_log
from morph_dslam.io.landmarks import Landmarks, save_landmarks
from morph_dslam.registration.registration import Registration
from morph_dslam.tracking.estimator import EstimationOptions, Estimator, State
from morph_dslam.tracking.known_values import KnownParameters, KnownValues, registered_with
from tests.support.bent_sheet import bent_sheet_model
from tests.support.measured_points import bound_points, measured
from tests.support.rendered_sequence import CAMERA, UPRIGHT, SheetFilm, sheet_state, write_recording
from tests.support.tracked_rig import placed_objects

MODEL = bent_sheet_model(22, 16)
POSE = RigidTransform(rotation_exp(np.array([0.3, -0.2, 0.0])) @ UPRIGHT, np.array([0.0, 0.0, 0.6]))
TRUTH = State(np.array([0.03, 0.2, 0.05]), POSE)


def write(folder, *lines):
    path = folder / "known.csv"
    path.write_text("\n".join(lines))
    return path


def test_a_table_has_values_and_deviations_by_frame(tmp_path):
    path = write(tmp_path, "twist_deg,frame,arch_mm,arch_std_mm", "5.7,20,30,0.5", ",21,31,", "6,23,,")
    found = KnownValues.read(path, MODEL)
    np.testing.assert_array_equal(found.indices, [2, 0])
    assert found.by_frame[20] == pytest.approx(np.array([[np.radians(5.7), np.radians(0.2)], [0.03, 0.0005]]))
    # Half a percent of the range where no deviation is given; a value that is missing is not known.
    assert found.by_frame[21][1] == pytest.approx([0.031, 0.005 * 0.12])
    assert np.isnan([found.by_frame[21][0, 0], found.by_frame[23][1, 0]]).all()


def test_titles_may_have_their_unit_in_brackets_and_a_parameter_may_be_called_as_a_deviation(tmp_path):
    found = KnownValues.read(write(tmp_path, "frame,arch [mm],arch_std [mm]", "20,30,0.5"), MODEL)
    assert found.by_frame[20] == pytest.approx(np.array([[0.03, 0.0005]]))
    arch, skew, twist = MODEL.parameters
    model = replace(MODEL, parameters=(replace(arch, name="gap_std"), skew, twist))
    found = KnownValues.read(write(tmp_path, "frame,gap_std_mm,gap_std_std_mm", "20,30,0.5"), model)
    assert found.by_frame[20] == pytest.approx(np.array([[0.03, 0.0005]]))


def test_the_table_of_a_run_tells_what_the_run_found(tmp_path):
    """Not the pose, nor parameters of another model, nor frames in which the object was lost."""
    path = write(
        tmp_path,
        "frame,timestamp_s,status,pose_from,arch_mm,arch_std_mm,arch_at_bound,bend_deg,bend_std_deg,bend_at_bound,x_mm",
        "20,0.1,tracked,points,30,0.5,0,10,1,0,7",
        "21,0.2,lost,,,,,,,,",
        "22,0.3,tracked,points,31,inf,0,10,1,0,7",
    )
    found = KnownValues.read(path, MODEL)
    assert found.by_frame[20] == pytest.approx(np.array([[0.03, 0.0005]]))
    assert np.isnan([found.by_frame[number][0, 0] for number in (21, 22)]).all()


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        (
            ["frame,bend_mm", "0,1"],
            "'bend_mm' is no column with a parameter of the model; write frame, arch_mm, skew_1",
        ),
        (["frame,arch_deg", "0,1"], "'arch_deg' is no column"),
        (["arch_mm", "1"], "needs the columns frame and one or more of arch_mm"),
        (["frame,arch_std_mm", "0,1"], "needs the columns frame"),
        (["frame,skew_1,arch_std_mm", "0,0.1,1"], "a deviation of arch, but no value"),
        (["frame,arch_mm,arch_cm", "0,1,1"], "two columns hold the parameter arch"),
        (["frame,arch_mm", "0,one"], "line 2: 'one' is no number"),
        (["frame,arch_mm", "0.5,1"], "line 2: '0.5' is no number of a frame"),
        (["frame,arch_mm", "3,1", "3,2"], "line 3: frame 3 is there already"),
        (["frame,arch_mm", "3,90"], "arch is 90 mm, outside of the model's range from -60 to 60 mm"),
        (["frame,arch_mm,arch_std_mm", "3,9,0"], "the deviation of arch is not above zero"),
        (["frame,arch_mm", "3,"], "has no value of a parameter"),
        (["frame,arch_mm", "3,1,5"], "line 2: 3 cells under 2 titles"),
        (["frame,arch_mm", "3"], "line 2: 1 cells under 2 titles"),
        ([], "needs the columns frame"),
    ],
)
def test_mistakes_in_a_table_are_one_message(tmp_path, lines, message):
    with pytest.raises(TrackingError, match=message):
        KnownValues.read(write(tmp_path, *lines), MODEL)


def estimator_and_pixels(noise):
    points = bound_points(MODEL, 150)
    pixels = CAMERA.project(points.in_camera(TRUTH)) + noise * np.random.default_rng(4).standard_normal((150, 2))
    estimator = Estimator(MODEL, CAMERA, EstimationOptions(max_iterations=30, tolerance=1e-9))
    estimator.known.squared_px = max(noise, 0.1) ** 2
    return estimator, points, pixels


def test_gradient_and_cost_belong_together():
    estimator, points, pixels = estimator_and_pixels(0.0)
    estimator.known.tell({"arch": (0.04, 0.002), "twist": 0.03})
    state = State(np.array([0.028, 0.15, 0.06]), POSE)
    cost, _, gradient, _ = estimator.evaluate(points, pixels, np.zeros(150), state)
    assert cost == pytest.approx(0.5 * 0.01 * ((0.012 / 0.002) ** 2 + (0.03 / (0.005 * np.radians(40))) ** 2))
    for k in range(3):
        step = 1e-6 * np.eye(3)[k]
        costs = [
            estimator.evaluate(points, pixels, np.zeros(150), State(state.parameters + sign * step, POSE))[0]
            for sign in (1.0, -1.0)
        ]
        assert gradient[k] == pytest.approx((costs[0] - costs[1]) / 2e-6, rel=1e-6, abs=1e-6)


def test_a_value_and_the_images_are_weighed_by_their_deviations():
    """Two measurements of one parameter, all else free: the mean by inverse variances, and its variance."""
    noise = 0.5
    estimator, points, pixels = estimator_and_pixels(noise)
    ones = np.ones(150)
    alone = estimator.estimate(points, pixels, ones, TRUTH)
    std = alone.parameter_std[0]
    value = alone.state.parameters[0] + 1.5 * std
    estimator.known.squared_px = alone.sigma_px**2
    estimator.known.tell({"arch": (value, std)})
    both = estimator.estimate(points, pixels, ones, TRUTH)
    assert both.state.parameters[0] == pytest.approx(alone.state.parameters[0] + 0.75 * std, abs=0.03 * std)
    assert both.parameter_std[0] == pytest.approx(std / np.sqrt(2.0), rel=0.05)
    linear = estimator.linear(measured(points, pixels), both)
    assert linear.of_depths[0, 0] == pytest.approx(alone.sigma_px**4 / std**2)
    estimator.known.tell({})
    again = estimator.estimate(points, pixels, ones, TRUTH)
    np.testing.assert_allclose(again.state.parameters, alone.state.parameters, rtol=1e-6)


def test_images_do_not_outweigh_a_sensor():
    """Pixels of another arch, exact to a tenth: the estimate stays within three deviations of what is known."""
    estimator, points, pixels = estimator_and_pixels(0.1)
    estimator.known.tell({"arch": (0.02, 1e-4)})
    found = estimator.estimate(points, pixels, np.ones(150), TRUTH)
    assert 0.02 < found.state.parameters[0] <= 0.0203 + 1e-12


@pytest.mark.parametrize(
    ("values", "message"),
    [({"bend": 0.1}, "'bend' is not a parameter"), ({"arch": 1.0}, "outside"), ({"arch": (0.01, 0.0)}, "above zero")],
)
def test_mistakes_of_a_program_are_one_message(values, message):
    with pytest.raises(TrackingError, match=message):
        Estimator(MODEL, CAMERA).known.tell(values)


@pytest.mark.parametrize("value", ["10 mm", [0.01, 0.001], np.array([0.01, 0.001]), np.nan, None, (0.01, np.nan), ()])
def test_what_is_no_number_is_not_known(value):
    with pytest.raises(ArgumentError, match=r"the known 'arch' is .*: give a finite number in SI"):
        Estimator(MODEL, CAMERA).known.tell({"arch": value})


def test_a_registration_takes_in_what_is_known_in_its_frame():
    """The product of two normal distributions has the sum of their informations."""
    scale = np.array([2e-3, 0.1, 0.02, *[0.01] * 3, *[0.002] * 3])
    root = scale[:, None] * (np.eye(9) + 0.4 * np.random.default_rng(3).standard_normal((9, 9)))
    covariance, information = root @ root.T, np.zeros((9, 9))
    information[2, 2], information[0, 0] = 1.0 / 0.001**2, 1.0 / 0.0005**2
    known = KnownParameters(MODEL)
    known.values = KnownValues(np.array([2, 0]), {7: np.array([[0.052, 0.001], [0.031, 0.0005]])})
    known.begin(7)
    found = registered_with(Registration(MODEL, TRUTH, covariance), known)
    expected = np.linalg.inv(np.linalg.inv(covariance) + information)
    np.testing.assert_allclose(found.covariance, expected, rtol=1e-6, atol=1e-12)
    step = expected @ information @ [0.001, 0.0, 0.002, *[0.0] * 6]
    assert found.state.parameters == pytest.approx(TRUTH.parameters + step[:3], rel=1e-9)
    turn = rotation_log(found.state.camera_from_object.rotation @ POSE.rotation.T)
    assert turn == pytest.approx(step[3:6], abs=1e-12)
    assert found.state.camera_from_object.translation == pytest.approx(POSE.translation + step[6:], abs=1e-12)
    known.begin(8)
    assert registered_with(Registration(MODEL, TRUTH, covariance), known).state is TRUTH


def test_values_of_no_tracked_frame_are_named(tmp_path):
    known = KnownValues.read(write(tmp_path, "frame,arch_mm", "100,30", "120,31"), MODEL)
    (text,) = known.remarks([3, 4, 5])
    assert text == "--known told nothing: its values are of frames 100 to 120, and frames 3 to 5 were tracked"
    assert known.remarks([99, 100]) == []


@pytest.mark.parametrize(("named", "first", "begins_there"), [(None, 4, True), (4, 4, True), (6, 6, False)])
def test_a_sensors_value_of_the_reference_frame_counts_whether_the_frame_is_named_or_not(
    tmp_path, named, first, begins_there
):
    """Nine landmarks, a pixel off, leave the arch open; the sensor has it to 0.6 mm."""
    film, states = SheetFilm(MODEL), {number: sheet_state(0.05 * number) for number in (4, 5, 6)}
    write_recording(tmp_path, {number: film.frame(state) for number, state in states.items()}, MODEL)
    rng, state = np.random.default_rng(5), states[first]
    nodes = rng.choice(len(MODEL.nodes), 9, replace=False)
    pixels = CAMERA.project(state.camera_from_object.apply(MODEL.positions(state.parameters)[nodes]))
    save_landmarks(tmp_path / "landmarks.csv", Landmarks(MODEL.nodes[nodes], pixels + rng.standard_normal((9, 2))))
    rows = [f"{number},{1e3 * state.parameters[0]:.6f}" for number, state in states.items()]
    (placed,) = placed_objects(
        frames=tmp_path / "frames",
        camera=tmp_path / "camera.yaml",
        model=tmp_path / "sheet.morph",
        landmarks=tmp_path / "landmarks.csv",
        known=write(tmp_path, "frame,arch_mm", *rows),
        reference_frame=named,
    )
    assert (placed.frame, placed.in_sequence) == (first, begins_there)
    assert np.sqrt(placed.registration.covariance[0, 0]) > 10.0 * 0.6e-3
    assert placed.new_tracker().state.parameters[0] == pytest.approx(state.parameters[0], abs=3.0 * 0.6e-3)
