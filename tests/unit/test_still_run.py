"""What a registration tells a pose that is one over the sequence."""

from types import SimpleNamespace

import numpy as np
import pytest

from morph_dslam import TrackerOptions
from morph_dslam.geometry import RigidTransform
from morph_dslam.io.landmarks import Landmarks
from morph_dslam.tracking.state import State
from morph_dslam.tracking.still_run import known_state
from tests.support.bent_sheet import bent_sheet_model
from tests.support.rendered_sequence import CAMERA

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


@pytest.mark.parametrize(("fitted", "counted"), [(0.08, 0.5), (1.2, 1.2), (np.nan, 0.5)])
def test_landmarks_count_with_half_a_pixel_at_least(fitted, counted):
    """As in their registration: residuals do not show what the mesh is off by, which the pose takes up."""
    nodes = MODEL.nodes[::4]
    pose = RigidTransform(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, 1.0]))
    part = SimpleNamespace(
        object=SimpleNamespace(start=Landmarks(nodes, CAMERA.project(pose.apply(nodes))), click_px=0.5),
        registration=SimpleNamespace(state=State(MODEL.default, pose), facts={"sigma_px": fitted}),
        model=MODEL,
        depth=None,
    )
    assert known_state(part).sigma_px == counted  # type: ignore[arg-type]
