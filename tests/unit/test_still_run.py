"""What a registration tells a pose that is one over the sequence."""

from types import SimpleNamespace

import numpy as np
import pytest

from morph_dslam import TrackerOptions
from morph_dslam.geometry import RigidTransform
from morph_dslam.tracking.state import State
from morph_dslam.tracking.still_run import known_state
from tests.support.bent_sheet import bent_sheet_model

MODEL = bent_sheet_model(7, 5)
#: As a registration at rest has it: parameters known, the pose to so much.
POSE_VARIANCES = np.array([1e-4, 1e-4, 1e-4, 1e-6, 1e-6, 1e-6])


@pytest.mark.parametrize("at_rest", [True, False])
def test_a_frame_at_rest_says_nothing_of_a_per_sequence_parameter(at_rest):
    """A modulus has no effect there: it is anywhere in its range, while the other parameters are known."""
    name = MODEL.parameters[1].name
    registration = SimpleNamespace(
        state=State(MODEL.default, RigidTransform(np.eye(3), np.array([0.0, 0.0, 1.0]))),
        covariance=np.diag([*np.zeros(3), *POSE_VARIANCES]),
        facts={"corrected_by_outline": True},
    )
    part = SimpleNamespace(
        object=SimpleNamespace(start=None, at_rest=at_rest),
        registration=registration,
        model=MODEL,
        options=TrackerOptions(per_sequence=(name,)),
    )
    found = known_state(part).covariance  # type: ignore[arg-type]
    half = 0.5 * (MODEL.upper - MODEL.lower)[1]
    np.testing.assert_allclose(np.diag(found), [0.0, half**2 if at_rest else 0.0, 0.0, *POSE_VARIANCES])
