"""What sensors keep from estimates, over the frames of a sequence: against where estimates really go.

Two sequences have the same noise. In the one the images show more of a parameter than the sensor says.
"""

from dataclasses import replace

import numpy as np
import pytest

from morph_dslam.camera import Camera
from morph_dslam.geometry import RigidTransform, rotation_exp
from morph_dslam.tracking.estimator import Estimator, State
from morph_dslam.tracking.noise import RigObservations
from morph_dslam.tracking.rig import RigCamera, RigEstimator
from morph_dslam.tracking.sequence_filter import PointChange, SequenceFilter
from tests.support.bent_sheet import bent_sheet_model
from tests.support.measured_points import bound_points, measured
from tests.support.rendered_sequence import CAMERA

MODEL = bent_sheet_model(22, 16)
#: The sheet leans by the product of arch and skew: where one is held, the other makes up for it.
ARCH, SKEW = 0, 1
STATE = State(np.array([0.035, 0.4, 0.0]), RigidTransform(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, 0.6])))
#: So much more is shown; the skew that makes up for it is the same share of its own value.
CHANGE, COUNT = np.array([3e-4, 0.0, 0.0]), 60
SKEW_ALONE = STATE.parameters[SKEW] * CHANGE[ARCH] / STATE.parameters[ARCH]
LEFT = RigCamera(CAMERA, RigidTransform.identity())
ASIDE = RigCamera(
    Camera(640, 480, 528.0, 528.0, 320.0, 240.0),
    RigidTransform(rotation_exp(np.array([0.0, 0.6, 0.0])), np.array([-0.4, 0.0, 0.1])),
)


class Sequence:
    """Frames of an object that shows ``change`` more than the sensor says of it, by one camera or several."""

    def __init__(self, rig, change):
        self.estimator = RigEstimator(MODEL, rig) if len(rig) > 1 else Estimator(MODEL, rig[0].camera)
        self.filtered, self._rng = SequenceFilter(self.estimator, [SKEW]), np.random.default_rng(3)
        self._rig, self._change = rig, change
        self._points = [bound_points(MODEL, COUNT, seed) for seed in range(len(rig))]
        self.estimator.known.learn(1.0)

    def know(self, values):
        self.estimator.known.tell(values)

    def parameters(self, state=STATE):
        """Those of the next frame's estimate."""
        shown, views = replace(state, parameters=state.parameters + self._change), []
        for part, points in zip(self._rig, self._points, strict=True):
            pixels = part.camera.project(points.in_camera(part.seen(shown)))
            views.append(measured(points, pixels + 0.3 * self._rng.standard_normal(pixels.shape)))
        seen = RigObservations(tuple(views)) if len(views) > 1 else views[0]
        return self.filtered.fuse(seen, self.estimator.fit(seen, state)).state.parameters


def assert_moved_by_what_is_left(moved, held):
    left = CHANGE - held[:3] @ CHANGE
    assert moved[ARCH] == pytest.approx(left[ARCH], abs=0.1 * CHANGE[ARCH])
    assert moved[SKEW] == pytest.approx(left[SKEW], abs=0.1 * SKEW_ALONE)


@pytest.mark.parametrize("rig", [[LEFT], [LEFT, ASIDE]])
def test_an_estimate_moves_by_what_sensors_leave_also_after_a_change_of_view_and_where_they_have_a_gap(rig):
    """A sensor tells the arch of the first frames, whose skew is one over the sequence, and moves that too."""
    both, kept = [Sequence(rig, change) for change in (CHANGE, 0.0 * CHANGE)], list[list[float]]()
    for number in range(12):
        for one in both:
            if number == 4 and len(rig) == 1:
                one.filtered.change_points(PointChange(0, 1, np.eye(COUNT), COUNT, [0, 1], np.zeros((9, 9))))
            one.know({} if number >= 8 else {"arch": (STATE.parameters[ARCH], 5e-4)})
        moved = both[0].parameters() - both[1].parameters()
        assert_moved_by_what_is_left(moved, both[0].filtered.held)
        kept.append([1.0 - moved[ARCH] / CHANGE[ARCH], moved[SKEW] / SKEW_ALONE])
    assert np.min(kept[:8]) > 0.25
    assert np.min(kept[8:], axis=0)[1] > 0.15, "the skew of all frames stays where the sensor has put it"


def test_in_a_frame_that_contradicts_the_past_a_sensor_keeps_what_it_does_in_that_frame_alone():
    both = [Sequence([LEFT], change) for change in (CHANGE, 0.0 * CHANGE)]
    other = replace(STATE, parameters=STATE.parameters * [1.0, -1.0, 1.0])
    for state in (STATE, STATE, other):
        for one in both:
            one.know({"arch": (STATE.parameters[ARCH], 5e-4)})
        moved = both[0].parameters(state) - both[1].parameters(state)
        assert_moved_by_what_is_left(moved, both[0].filtered.held)
        assert moved[SKEW] * state.parameters[SKEW] > 0.0
    assert not both[0].filtered.keeps


def test_nothing_is_kept_where_no_sensor_ever_told_anything():
    one = Sequence([LEFT], CHANGE)
    for _ in range(3):
        one.parameters()
    assert one.filtered.held is None
    assert not one.filtered.by_known.any()
