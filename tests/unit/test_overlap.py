"""Whether bodies stand in one place: boxes and sheets whose overlap is known in closed form."""

from dataclasses import replace

import numpy as np
import pytest

from morph_dslam.geometry import RigidTransform, rotation_exp
from morph_dslam.model import SeparatedField
from morph_dslam.model.functions import ParameterFunctions
from morph_dslam.tracking.overlap import Body
from morph_dslam.tracking.state import State
from tests.support.bent_sheet import bent_sheet_model
from tests.support.stretched_block import SIZE, stretched_block_model

BLOCK, SHEET = stretched_block_model(), bent_sheet_model(22, 16)
LENGTH, WIDTH, HEIGHT = SIZE
TURNED = rotation_exp(np.array([0.0, 0.0, np.pi]))


def rigid(factors):
    """The block without parameters and cells, its sides multiplied."""
    constant = ParameterFunctions(np.zeros(0), np.zeros(0), np.zeros((1, 0), dtype=np.int64), np.ones((1, 1)))
    still = SeparatedField(np.zeros((1, *BLOCK.nodes.shape)), constant)
    return replace(
        BLOCK, nodes=BLOCK.nodes * factors, parameters=(), displacement=still, stresses={}, cells={}, strain=None
    )


def standing(model, shift=(0.0, 0.0, 0.0), parameters=None, rotation=None):
    pose = RigidTransform(np.eye(3) if rotation is None else rotation, np.asarray(shift, dtype=float))
    return Body.of(model).standing(State(model.default if parameters is None else np.array(parameters), pose))


@pytest.mark.parametrize(
    ("shift", "share"),
    [
        ((0.0, 0.0, 0.0), 1.0),
        ((0.2 * LENGTH, 0.0, 0.0), 0.8),
        ((0.0, 0.2 * WIDTH, 0.2 * HEIGHT), 0.64),
        ((0.0, 0.0, 0.97 * HEIGHT), 0.03),
        ((LENGTH, 0.0, 0.0), 0.0),
        ((0.0, 0.0, 3.0 * HEIGHT), 0.0),
    ],
)
@pytest.mark.parametrize("model", [BLOCK, rigid((1.0, 1.0, 1.0))], ids=["cells", "surface"])
def test_blocks_stand_in_one_place_if_they_share_more_than_half_of_their_volume(model, shift, share):
    one, other = standing(model), standing(model, shift)
    assert one.is_where(other) is other.is_where(one) is (share > 0.5)
    end_for_end = standing(model, np.add(shift, (LENGTH, WIDTH, 0.0)), rotation=TURNED)
    assert one.is_where(end_for_end) is (share > 0.5)


def test_a_lid_and_a_needle_are_not_accused():
    """A lid that sinks by a fifth of its height; a needle, and the block around it, which shows no hollow."""
    lid, needle = rigid((1.0, 1.0, 0.1)), rigid((0.5, 0.05, 0.05))
    assert not standing(BLOCK).is_where(standing(lid, (0.0, 0.0, HEIGHT - 0.02 * HEIGHT)))
    assert not standing(BLOCK).is_where(standing(needle, (0.2 * LENGTH, 0.4 * WIDTH, 0.4 * HEIGHT)))
    # A block half as large that is inside is one that was taken for this one.
    half = rigid((0.6, 0.6, 0.6))
    assert standing(BLOCK).is_where(standing(half, (0.2 * LENGTH, 0.2 * WIDTH, 0.2 * HEIGHT)))


def test_the_deformed_shapes_are_compared():
    """A block that is stretched by a fifth ends where the next one begins, 0.2 lengths farther off."""
    far = 1.1 * LENGTH
    assert not standing(BLOCK, parameters=[0.2, 0.0]).is_where(standing(BLOCK, (far, 0.0, 0.0)))
    slid = standing(BLOCK, parameters=[0.2, 0.01])
    assert slid.is_where(standing(BLOCK, parameters=[0.2, -0.01]))


def test_sheets_lie_on_each_other_and_stand_in_one_place_only_if_they_cover_each_other():
    size = np.ptp(SHEET.nodes, axis=0)
    one = standing(SHEET)
    assert one.is_where(standing(SHEET, (0.002 * size[0], 0.0, 0.0)))
    assert not one.is_where(standing(SHEET, (0.5 * size[0], 0.0, 0.0)))
    assert not one.is_where(standing(SHEET, (0.0, 0.0, 0.1 * size[0])))
    patch = replace(SHEET, nodes=0.5 * SHEET.nodes)
    assert not one.is_where(standing(patch))
    # A sheet may lie on, or in, a solid, which is another kind of body.
    assert not one.is_where(standing(BLOCK))
