"""One pose over a sequence of a model whose parameters are millions in one unit and thousandths in another."""

import numpy as np
import pytest

from morph_dslam.geometry import RigidTransform
from morph_dslam.io.landmarks import Landmarks
from morph_dslam.model import Parameter, ReducedModel, SeparatedField
from morph_dslam.model.functions import ParameterFunctions
from morph_dslam.registration.landmark_binding import bind_landmarks
from morph_dslam.tracking.estimator import State
from morph_dslam.tracking.known_state import LandmarkTerm
from morph_dslam.tracking.refinement import Keyframe
from morph_dslam.tracking.still import StillProblem, fit_still
from tests.support.bent_sheet import sheet_mesh
from tests.support.measured_points import bound_points
from tests.support.rendered_sequence import CAMERA, UPRIGHT

YOUNG_MODULUS, POISSON_RATIO, LANDMARK_PX = 1e6, 0.3, 0.5
POSE = RigidTransform(UPRIGHT, np.array([0.0, 0.0, 0.6]))
NODES, TRIANGLES = sheet_mesh(9, 7)
UPPER = np.array([0.01, 1e5])
PARAMETERS = (
    Parameter("bow", "length", "mm", -UPPER[0], UPPER[0], 0.0, "motion of the middle along the sheet"),
    Parameter("pull", "stress", "kPa", -UPPER[1], UPPER[1], 0.0, "traction at both ends"),
)


def pulled_sheet():
    """A flat sheet in plane stress: u = (bow (1 - s^2) + x pull / E, -nu y pull / E, 0), s = -1 and 1 at the ends."""
    x, y = NODES[:, 0], NODES[:, 1]
    zero = np.zeros(len(NODES))
    bow = np.column_stack([1.0 - (x / x.max()) ** 2, zero, zero])
    pull = np.column_stack([x, -POISSON_RATIO * y, zero]) / YOUNG_MODULUS
    linear = ParameterFunctions(-UPPER, UPPER, np.eye(2, dtype=np.int64), np.diag(UPPER))
    return ReducedModel("pulled sheet", NODES, TRIANGLES, PARAMETERS, SeparatedField(np.stack([bow, pull]), linear))


@pytest.mark.parametrize(
    ("pull", "others", "share"),
    [(2e4, (0.0, 4e4, 8e4), 0.05), (UPPER[1], (UPPER[1] - 300.0, UPPER[1], UPPER[1] + 300.0), 0.5)],
)
def test_a_traction_beside_a_length_is_known_as_well_as_landmarks_tell_it(pull, others, share):
    """Frames of other tractions show the strain since the reference frame alone, not the strain there.

    Facing the sheet, landmarks give its scales 1 + e along x and 1 - nu e along y, e the strain, over the distance,
    with the deviations of two regressions through the origin. So it is at the end of the range too, where the traction
    of a frame is held that is 0.3 kPa beyond.
    """
    model, points, strain = pulled_sheet(), bound_points(pulled_sheet(), 120), pull / YOUNG_MODULUS
    truth = np.array([0.0, pull])
    corners = CAMERA.project(POSE.apply(model.positions(truth)))
    known = LandmarkTerm(bind_landmarks(model, Landmarks(NODES, corners).points), corners, LANDMARK_PX)

    def seen(pull):
        strain = pull / YOUNG_MODULUS
        return CAMERA.project(POSE.apply(points.rest * [1.0 + strain, 1.0 - POISSON_RATIO * strain, 1.0]))

    shapes = [State(np.array([0.0, min(other, UPPER[1])]), POSE) for other in others]
    frames = [Keyframe(seen(other), np.ones(120), shape, 0.3) for other, shape in zip(others, shapes, strict=True)]
    along, across = np.sum((corners - [CAMERA.cx, CAMERA.cy]) ** 2, axis=0)
    of_strain = 1.0 / (1.0 + strain) + POISSON_RATIO / (1.0 - POISSON_RATIO * strain)
    expected = YOUNG_MODULUS * LANDMARK_PX * np.sqrt(1.0 / along + 1.0 / across) / of_strain
    start = State(truth - np.array([0.0, 3.0 * expected]), POSE)
    found = fit_still(StillProblem(model, CAMERA, start, seen(pull), frames, known))
    assert np.sqrt(found.covariance[1, 1]) == pytest.approx(expected, rel=0.05)
    assert abs(found.state.parameters[1] - pull) < share * expected
