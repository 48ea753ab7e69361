"""The model's time by the times of frames."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from morph_dslam.errors import TrackingError
from morph_dslam.geometry import RigidTransform
from morph_dslam.io.landmarks import Landmarks, save_landmarks
from morph_dslam.model import Parameter
from morph_dslam.registration.registration import PosePrior, Registration
from morph_dslam.sources import Frame
from morph_dslam.tracking.combinations import check_options, check_times
from morph_dslam.tracking.estimator import Estimator, State
from morph_dslam.tracking.known_values import KnownTime, KnownValues
from morph_dslam.tracking.outcomes import Status, TimeOutside
from morph_dslam.tracking.run_options import TrackOptions
from morph_dslam.tracking.tracker import CameraLocalization, Tracker
from tests.support.bent_sheet import bent_sheet_model
from tests.support.measured_points import bound_points
from tests.support.rendered_sequence import CAMERA, SheetFilm, sheet_state, write_recording
from tests.support.tracked_rig import placed_objects

POSE = RigidTransform(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, 0.6]))
SHEET = bent_sheet_model(22, 16)
TIME = Parameter("hold", "time", "s", 0.0, 20.0, 0.0)
MODEL = replace(SHEET, parameters=(SHEET.parameters[0], TIME, SHEET.parameters[2]))


def known_in(timestamp, known):
    known.begin(7, timestamp)
    return {MODEL.parameters[k].name: tuple(row) for k, row in zip(known.indices, known.now.tolist(), strict=True)}


def test_time_is_that_of_the_frame_after_the_zero_as_exact_as_half_an_interval_at_most():
    known = Estimator(MODEL, CAMERA).known
    known.clock = KnownTime.of(MODEL, 99.7)
    assert known_in(100.0, known) == {"hold": pytest.approx((0.3, 0.02))}
    assert known_in(100.03, known) == {"hold": pytest.approx((0.33, 0.015))}
    assert known_in(104.0, known) == {"hold": pytest.approx((4.3, 0.02))}
    assert known.warnings == ()
    # Before the zero, and beyond the range, it is not known, and that is said.
    assert known_in(119.8, known) == {}
    assert known.warnings == (TimeOutside("hold", "20.1 s", "0 to 20 s"),)
    assert known_in(99.0, known) == {}
    assert [(warning.time, warning.is_before) for warning in known.warnings] == [("-0.7 s", True)]


def test_time_is_known_beside_a_sensor():
    known = Estimator(MODEL, CAMERA).known
    known.clock = KnownTime.of(MODEL, 1.0)
    known.values = KnownValues(np.array([0]), {7: np.array([[0.03, 1e-3]])})
    assert known_in(3.0, known) == {"arch": (0.03, 1e-3), "hold": pytest.approx((2.0, 0.02))}


def test_models_without_one_time_are_refused():
    with pytest.raises(TrackingError, match="has no parameter that measures time: leave it out"):
        KnownTime.of(SHEET, 0.0)
    twice = replace(MODEL, parameters=(replace(TIME, name="delay"), *MODEL.parameters[1:]))
    with pytest.raises(TrackingError, match=r"several parameters that measure time \(delay, hold\)"):
        KnownTime.of(twice, 0.0)
    # A relaxation time is not the clock that the study names.
    named = replace(twice, provenance={"time_parameter": "hold"})
    assert KnownTime.of(named, 0.0).index == 1


def test_frames_without_times_are_refused_and_rigs_are_not():
    class Numbered:
        has_assumed_times = True

    files = [Path(name) for name in ("m.morph", "l.csv", "c.yaml", "f", "o")]
    model, landmarks, camera, frames, output = files
    run = TrackOptions(model=model, landmarks=landmarks, camera=camera, frames=frames, output=output, time_zero=1.0)
    with pytest.raises(TrackingError, match=r"nothing tells the times of the frames of f: .* give --fps"):
        check_times(run, Numbered())
    check_times(replace(run, fps=30.0), Numbered())
    check_times(replace(run, time_zero=None), Numbered())
    check_options(replace(run, other_cameras=(Path("g"),)))


def test_a_time_that_is_known_is_at_no_bound():
    """In the last frame of the range; a pull at the end of its own range is at the bound all the same."""
    estimator, rng = Estimator(SHEET, CAMERA), np.random.default_rng(3)
    upper = SHEET.upper.copy()
    points, truth = bound_points(SHEET, 80, rng), State(np.array([upper[0], 0.0, upper[2]]), POSE)
    pixels = CAMERA.project(points.in_camera(truth))
    estimator.known.tell({"twist": upper[2]})
    estimate = estimator.estimate(points, pixels, np.ones(len(points)), truth)
    assert estimate.state.parameters == pytest.approx(truth.parameters, abs=1e-6)
    assert estimate.at_bound.tolist() == [True, False, False]


def test_a_hidden_object_is_told_of_the_time_too():
    """Its place is known by the map, and nothing of it is seen."""
    film = SheetFilm(SHEET)
    start = Registration(SHEET, sheet_state(0.1), covariance=np.diag([2e-3, 2e-2, 5e-3] + [3e-3] * 6) ** 2)
    tracker = Tracker(SHEET, CAMERA, start, reference=film.frame(sheet_state(0.1)))
    tracker.estimator.known.clock = KnownTime(0, TIME, zero=10.0)
    place = PosePrior(sheet_state(0.1).camera_from_object, 1e-6 * np.eye(6), np.zeros((6, 0)))
    result = tracker.track(Frame(1, 3.0, film.blank()), CameraLocalization(place))
    assert result.status is Status.HIDDEN
    assert result.warnings == (TimeOutside("hold", "-7 s", "0 to 20 s", is_before=True),)


def test_the_time_of_the_reference_frame_counts_in_the_registration(tmp_path):
    """Nine landmarks, a pixel off, leave the time open; it is known to a thousandth of its range of 1.2 s."""
    hold = replace(TIME, lower=SHEET.lower[1], upper=SHEET.upper[1])  # as the file scales the field by it
    model = replace(MODEL, parameters=(MODEL.parameters[0], hold, MODEL.parameters[2]))
    state, rng = sheet_state(0.2), np.random.default_rng(5)
    write_recording(tmp_path, {4: SheetFilm(SHEET).frame(state)}, model)
    nodes = rng.choice(len(model.nodes), 9, replace=False)
    pixels = CAMERA.project(state.camera_from_object.apply(SHEET.positions(state.parameters)[nodes]))
    save_landmarks(tmp_path / "landmarks.csv", Landmarks(model.nodes[nodes], pixels + rng.standard_normal((9, 2))))
    (placed,) = placed_objects(
        frames=tmp_path / "frames",
        camera=tmp_path / "camera.yaml",
        model=tmp_path / "sheet.morph",
        landmarks=tmp_path / "landmarks.csv",
        fps=10.0,
        time_zero=4 / 10.0 - state.parameters[1],
    )
    by_landmarks = placed.registration
    assert np.sqrt(by_landmarks.covariance[1, 1]) > 10.0 * 1.2e-3
    assert abs(by_landmarks.state.parameters[1] - state.parameters[1]) > 10.0 * 1.2e-3
    assert placed.new_tracker().state.parameters[1] == pytest.approx(state.parameters[1], abs=3.0 * 1.2e-3)
