"""Which reference view serves: shares against closed forms of a sheet, and the choice among views."""

import numpy as np
import pytest

from morph_dslam.geometry import RigidTransform, rotation_exp
from morph_dslam.tracking.binding import DrawnSurface, draw_view, view_of
from morph_dslam.tracking.estimator import Estimator, State
from morph_dslam.tracking.reference import SurfaceSamples, choose_view, covered_share
from tests.support.bent_sheet import bent_sheet_model
from tests.support.rendered_sequence import CAMERA, UPRIGHT
from tests.support.turning_block import SIZE, block_state, turning_block

FAR = 2.0


def flat(turn=0.0, distance=FAR, x=0.0):
    pose = RigidTransform(UPRIGHT @ rotation_exp(np.array([0.0, turn, 0.0])), np.array([x, 0.0, distance]))
    return State(np.zeros(3), pose)


def looker(model):
    """What a view in a state shows of the samples of a model."""
    surface = DrawnSurface.of(model)
    samples = SurfaceSamples(Estimator(model, CAMERA), surface)

    def seen(state):
        drawn = surface.model
        return samples.seen(state, draw_view(view_of(drawn, CAMERA, state), drawn.triangles, CAMERA).depth)

    return seen


@pytest.fixture(scope="module")
def sheet():
    return looker(bent_sheet_model(43, 31))


@pytest.fixture(scope="module")
def block():
    return looker(turning_block()[0])


def test_what_is_seen_is_the_area_in_the_image_over_that_of_the_sheet(sheet):
    front = sheet(flat())
    np.testing.assert_allclose(np.abs(front), (CAMERA.fx / FAR) ** 2, rtol=1e-9)
    turned = sheet(flat(turn=np.radians(60)))
    assert np.abs(turned).mean() == pytest.approx(0.5 * (CAMERA.fx / FAR) ** 2, rel=0.05)


def test_the_other_side_is_not_covered(sheet):
    front, back = sheet(flat()), sheet(flat(turn=np.pi))
    assert covered_share(front, front) == 1.0
    assert covered_share(back, front) == 0.0


def test_a_view_from_twice_as_far_still_serves_and_one_from_farther_does_not(sheet):
    far = sheet(flat(distance=2.0))
    assert covered_share(sheet(flat(distance=1.05)), far) == 1.0
    assert covered_share(sheet(flat(distance=0.95)), far) == 0.0


def test_what_the_reference_did_not_show_is_not_covered(sheet):
    """In the reference half of the sheet is outside of the image."""
    at_edge = flat(x=0.5 * CAMERA.width / CAMERA.fx * FAR)
    assert covered_share(sheet(flat()), sheet(at_edge)) == pytest.approx(0.5, abs=0.06)


def test_share_of_a_turned_block_is_that_of_its_faces_in_the_image(block):
    """Seen from far enough, faces z and x take cos and sin of the turn; the top takes part of the rest."""
    turn = np.radians(50)
    front, now = block_state(0.0, 0.0), block_state(turn, 0.0)
    tilt = 0.25
    width, height, depth = SIZE
    faces = height * np.cos(tilt) * np.array([width * np.cos(turn), depth * np.sin(turn)])
    top = width * depth * np.sin(tilt)
    expected = (faces[0] + top) / (faces.sum() + top)
    assert covered_share(block(now), block(front)) == pytest.approx(expected, abs=0.1)


@pytest.mark.parametrize(
    ("shares", "active", "chosen"),
    [
        ([0.9], 0, 0),
        ([0.61], 0, 0),
        ([0.59], 0, None),
        # The first view is not gone back to before it serves well, and then even from one that serves better.
        ([0.7, 0.9, 0.9], 1, 1),
        ([0.8, 0.9, 0.9], 1, 0),
        # Of views that serve when the active one does not, the one that serves best.
        ([0.5, 0.62, 0.3, 0.7], 2, 3),
        ([0.5, 0.5, 0.3], 2, None),
        # A later view has larger errors: it is not changed to while the active one serves.
        ([0.1, 0.65, 0.99], 1, 1),
    ],
)
def test_choice_of_the_view(shares, active, chosen):
    errors = [0.0, 1e-4, 2e-4, 3e-4][: len(shares)]
    assert choose_view(shares, errors, active) == chosen
