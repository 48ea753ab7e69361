"""Points of a moving object as a rolling shutter records them, against paths in closed form."""

from dataclasses import replace

import numpy as np
import pytest

from morph_dslam.camera import Camera
from morph_dslam.geometry import RigidTransform, rotation_exp
from morph_dslam.tracking.row_motion import StateHistory
from morph_dslam.tracking.state import State

CAMERA = Camera(640, 480, 500.0, 500.0, 319.5, 239.5, readout_s=0.03)
INTERVAL = 1.0 / 30.0
POINTS = np.random.default_rng(1).uniform([-0.12, -0.09, -0.03], [0.12, 0.09, 0.03], (40, 3))


def state_at(time, velocity, acceleration=(0.0, 0.0, 0.0), turning=(0.0, 0.0, 0.0)):
    """Half a metre before the camera at time 0, with this motion; SI."""
    position = np.array([0.0, 0.0, 0.5]) + time * np.array(velocity) + 0.5 * time**2 * np.array(acceleration)
    return State(np.zeros(0), RigidTransform(rotation_exp(time * np.array(turning)), position))


def places(state):
    return CAMERA.project(state.camera_from_object.apply(POINTS))


def recorded(motion):
    """Pixels (40, 2) at the instants of their rows, found by iteration, and these instants (40,), seconds."""
    pixels = places(motion(0.0))
    for _ in range(30):
        times = CAMERA.readout_s * (pixels[:, 1] - 239.5) / 480.0
        pixels = np.array([places(motion(time))[k] for k, time in enumerate(times)])
    return pixels, times


def history(motion, frames=(-2, -1)):
    known = StateHistory(CAMERA, np.zeros(3))
    for frame in frames:
        known.motion(INTERVAL * frame)
        known.add(motion(INTERVAL * frame))
    return known


def test_pixels_are_moved_to_the_middle_row_along_an_accelerated_path():
    def motion(time):
        return state_at(time, (0.2, -0.3, 0.0), (1.0, 2.0, 0.0))

    seen, _ = recorded(motion)
    found = history(motion).motion(0.0)
    truth = places(motion(0.0))
    assert np.abs(seen - truth).max() > 1.5
    # Without turns and motion in depth the path is a parabola in the image.
    assert seen - found.shift(places, motion(0.0), seen) == pytest.approx(truth, abs=1e-9)
    assert truth + found.drift(places, motion(0.0)) == pytest.approx(seen, abs=0.05)


def test_a_turning_body_is_moved_nearly_as_well():
    def motion(time):
        return state_at(time, (0.1, 0.2, -0.2), turning=(1.0, -0.5, 1.5))

    seen, _ = recorded(motion)
    truth = places(motion(0.0))
    moved = seen - history(motion).motion(0.0).shift(places, motion(0.0), seen)
    assert np.abs(seen - truth).max() > 1.0
    assert np.abs(moved - truth).max() < 0.02


def test_what_moves_on_evenly_needs_no_state_in_the_frame():
    def motion(time):
        return state_at(time, (0.2, -0.3, 0.0))

    seen, _ = recorded(motion)
    moved = history(motion).motion(0.0).since_last(places(motion(-INTERVAL)), seen)
    assert moved == pytest.approx(places(motion(0.0)), abs=1e-9)


def test_states_of_points_that_are_bound_wrongly_are_compared_with_each_other():
    """An outline has moved all states by 4 mm, in frames of a sheet that moves evenly."""

    def by_points(time):
        return state_at(time, (0.2, -0.3, 0.0))

    def corrected(time):
        there = by_points(time)
        pose = there.camera_from_object
        return replace(
            there, camera_from_object=RigidTransform(pose.rotation, pose.translation + np.array([4e-3, 0.0, 0.0]))
        )

    known = StateHistory(CAMERA, np.zeros(3))
    for frame in (-2, -1):
        known.motion(INTERVAL * frame)
        known.add(corrected(INTERVAL * frame), by_points(INTERVAL * frame))
    for motion, states in ((known.motion(0.0), corrected), (known.motion(0.0).of_points, by_points)):
        seen, _ = recorded(states)
        assert seen - motion.shift(places, states(0.0), seen) == pytest.approx(places(states(0.0)), abs=1e-9)
    # What else is seen moves as the points do, wherever it is in this frame.
    seen, _ = recorded(corrected)
    motion = known.motion(0.0).moving_as(by_points(0.0))
    assert seen - motion.shift(places, corrected(0.0), seen) == pytest.approx(places(corrected(0.0)), abs=1e-9)
    # Other points, which were bound by the corrected states, have the object there.
    known.change_points(None)
    seen, _ = recorded(corrected)
    moved = known.motion(0.0).of_points.shift(places, corrected(0.0), seen)
    assert seen - moved == pytest.approx(places(corrected(0.0)), abs=1e-9)
    # Of those that nothing else has bound only the last frame tells.
    known.change_points(by_points(-INTERVAL))
    seen, _ = recorded(by_points)
    moved = known.motion(0.0).of_points.shift(places, by_points(0.0), seen)
    assert seen - moved == pytest.approx(places(by_points(0.0)), abs=1e-9)


def test_the_object_is_drawn_where_its_rows_show_it():
    def motion(time):
        return state_at(time, (0.2, -0.3, 0.0), turning=(0.0, 0.0, 0.4))

    shown = history(motion).motion(0.0).as_seen(motion(0.0))
    pixel = CAMERA.project(shown.camera_from_object.translation[None])[0]
    time = CAMERA.readout_s * (pixel[1] - 239.5) / 480.0
    assert shown.camera_from_object.matrix == pytest.approx(motion(time).camera_from_object.matrix, abs=1e-6)


def test_a_rectified_image_shows_the_object_at_the_middle_row():
    """Bars that move along the rows lean by readout times speed, and stand upright afterwards."""

    def motion(time):
        return state_at(time, (0.3, 0.0, 0.0))

    rows, columns = np.mgrid[0:480, 0:640]
    speed = 0.3 * 500.0 / 0.5
    leaning = columns - speed * CAMERA.readout_s * (rows - 239.5) / 480.0
    bars, upright = (
        (127.5 + 100.0 * np.sin(2.0 * np.pi * x / 40.0)).astype(np.uint8) for x in (leaning, columns.astype(float))
    )
    positions = motion(0.0).camera_from_object.apply(POINTS * [1.0, 1.0, 0.0])
    found = history(motion).motion(0.0).rectified(bars, motion(0.0), positions)
    inside = np.s_[40:440, 60:580]
    assert np.abs(bars[inside].astype(float) - upright[inside]).max() > 50.0
    assert np.abs(found[inside].astype(float) - upright[inside]).max() < 6.0


@pytest.mark.parametrize(
    ("camera", "last", "now"),
    [
        (replace(CAMERA, readout_s=0.0), -INTERVAL, 0.0),  # a global shutter
        (CAMERA, -1.0, 0.0),  # too long ago
        (CAMERA, 0.0, 0.0),  # stamps rounded to one
        (CAMERA, -INTERVAL, None),  # a picture without a time
    ],
)
def test_nothing_is_moved_where_the_velocity_is_not_known(camera, last, now):
    known = StateHistory(camera, np.zeros(3))
    known.motion(last)
    known.add(state_at(last, (0.2, 0.0, 0.0)))
    assert known.motion(now) is None


def test_a_frame_in_which_the_object_is_lost_ends_what_is_known():
    known = history(lambda time: state_at(time, (0.2, 0.0, 0.0)))
    known.motion(0.0)
    known.add(None)
    assert known.motion(INTERVAL) is None


@pytest.mark.parametrize(("gap", "is_used"), [(INTERVAL, True), (1e3 * INTERVAL, False), (1e-6, False)])
def test_times_that_tell_nothing_of_the_motion_are_named(gap, is_used):
    """Milliseconds, or stamps rounded to one; the first frame has none before it."""
    known = StateHistory(CAMERA, np.zeros(3))
    for frame in range(3):
        motion = known.motion(gap * frame)
        assert (motion is not None) == (is_used and frame > 0)
        assert bool(known.warnings) == (not is_used and frame > 0)
        known.add(state_at(0.0, (0.0, 0.0, 0.0)))
    if not is_used:
        assert known.warnings[0].gap_s == pytest.approx(gap)


def test_a_frame_without_a_time_is_named_where_rows_have_times():
    for camera, count in ((CAMERA, 1), (replace(CAMERA, readout_s=0.0), 0)):
        known = StateHistory(camera, np.zeros(3))
        assert known.motion(None) is None
        assert len(known.warnings) == count
