"""Arrows of forces over the picture: where they begin and end."""

import numpy as np
import pytest

from morph_dslam.camera import Camera
from morph_dslam.geometry import RigidTransform
from morph_dslam.model import Parameter, ReducedModel, SeparatedField
from morph_dslam.model.functions import ParameterFunctions
from morph_dslam.tracking.estimator import State
from morph_dslam.tracking.force_arrows import COLOUR, ForceArrows

CAMERA = Camera(640, 480, 500.0, 500.0, 320.0, 240.0)


@pytest.fixture(scope="module")
def arrows():
    """A bar of 1 m at one depth, whose end is pulled along x with 10 a newtons and moves nowhere."""

    def linear(constant, slope):
        functions = ParameterFunctions(-np.ones(1), np.ones(1), np.array([[0], [1]]), np.eye(2))
        return SeparatedField(np.array([constant, slope], dtype=float), functions)

    nodes, triangles = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]]), np.empty((0, 3), dtype=np.int64)
    model = ReducedModel(
        "bar", nodes, triangles, (Parameter("a", "length", "m", -1.0, 1.0, 0.0),),
        linear(np.zeros((2, 3)), np.zeros((2, 3))), supports={"end": np.array([1])},
        reactions={"force_end": linear([[0, 0, 0]], [[10, 0, 0]])},
    )  # fmt: skip
    return ForceArrows(model)


def drawn(arrows, a, x):
    """First and last column of the arrow's colour, of a bar whose end is ``x`` m from the axis at 2.5 m; or None."""
    state = State(np.array([a]), RigidTransform(np.eye(3), np.array([x - 1.0, 0.0, 2.5])))
    image = arrows.draw(np.zeros((480, 640, 3), np.uint8), state, CAMERA)
    columns = np.flatnonzero((image == COLOUR).all(axis=2).any(axis=0))
    return (columns[0], columns[-1]) if len(columns) else None


@pytest.mark.parametrize(
    ("a", "x", "begin", "end"),
    [
        (0.5, 0.0, 320, 360),  # 0.2 m of the 1 m bar for half of the largest force: 200 px a metre
        (-0.5, 0.0, 280, 320),
        (0.5, 1.5, 580, 620),  # from the support to where there is room
        (0.5, 1.58, 596, 636),
        (0.75, 1.4, 540, 600),  # would end at 660: it ends at the support
        (-0.75, -1.4, 40, 100),
    ],
)
def test_an_arrow_is_along_the_force_and_within_the_picture(arrows, a, x, begin, end):
    found = drawn(arrows, a, x)
    assert found == pytest.approx((begin, end), abs=4 + 0.03 * abs(end - begin))


def test_a_support_outside_of_the_picture_has_no_arrow(arrows):
    assert drawn(arrows, 0.5, 1.62) is None
    assert drawn(arrows, -0.5, -1.62) is None
