"""What frames have to do with each other by choice."""

import numpy as np
import pytest

from morph_dslam.errors import TrackingError
from morph_dslam.geometry import RigidTransform, rotation_exp
from morph_dslam.tracking.estimator import Estimator, State
from morph_dslam.tracking.frame_estimation import at_constant_velocity, new_filter, temporal_facts
from morph_dslam.tracking.options import TrackerOptions
from tests.support.bent_sheet import PARAMETERS, bent_sheet_model
from tests.support.rendered_sequence import CAMERA


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"per_sequence": ("bend",)}, "'bend' cannot be one over the sequence: the model's parameters are arch"),
        ({"random_walk": (("bend", 1.0),)}, "'bend' cannot walk"),
        ({"random_walk": (("skew", 1.0),), "per_sequence": ("skew",)}, "leave out one of both"),
        ({"random_walk": (("skew", 0.0),)}, "must be a positive number"),
    ],
)
def test_what_cannot_be_is_refused(options, message):
    with pytest.raises(TrackingError, match=message):
        new_filter(Estimator(bent_sheet_model(22, 16), CAMERA), TrackerOptions(**options))


def test_constant_velocity_repeats_the_last_motion():
    """A turn of 0.1 rad about a fixed axis, a shift, and a parameter that grows."""

    def state(time):
        pose = RigidTransform(rotation_exp(np.array([0.0, 0.1 * time, 0.0])), np.array([0.0, 0.02 * time, 0.6]))
        return State(np.array([0.01 * time, 0.0, 0.1]), pose)

    # The turn is about the camera, so only the part across its axis goes on in a straight line.
    found = at_constant_velocity(state(1.0), state(2.0))
    np.testing.assert_allclose(found.parameters, state(3.0).parameters)
    np.testing.assert_allclose(found.camera_from_object.rotation, state(3.0).camera_from_object.rotation, atol=1e-12)
    assert found.camera_from_object.translation[1] == pytest.approx(0.06)


def test_facts_name_what_is_used_and_nothing_by_default():
    assert temporal_facts(PARAMETERS, TrackerOptions())["temporal_prior"] == "none"
    options = TrackerOptions(
        per_sequence=("skew",), random_walk=(("twist", np.radians(0.5)),), start="constant-velocity"
    )
    facts = temporal_facts(PARAMETERS, options)
    assert facts["temporal_prior"] == (
        "one over the sequence, from all frames so far: skew; random walk, standard deviation of the change "
        "from frame to frame: twist by 0.5 deg; none on the others"
    )
    assert facts["start_of_each_frame"] == "the state that the last two lead to at constant velocity"
