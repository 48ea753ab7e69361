"""Turns by which surfaces lie on themselves, and whether what looks the same turned also deforms the same."""

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from morph_dslam.model import Parameter, ReducedModel, SeparatedField
from morph_dslam.model.functions import ParameterFunctions
from morph_dslam.registration.messages import Ambiguity, Ambiguous, AttitudeArbitrary
from morph_dslam.registration.registration import Axis
from morph_dslam.registration.symmetry import turn_warning, turns_alike
from tests.support.bent_tube import polynomial

TURN = Rotation.from_rotvec([0.3, -0.5, 1.1])


def box(*sides, pitch=0.006):
    return trimesh.creation.box(sides).subdivide_to_size(pitch)


def model_of(mesh, mode=None):
    """A model of a surface that a parameter between 0 and 2 moves by that much of the mode (n, 3); rigid without."""
    nodes = np.asarray(mesh.vertices)
    constant = ParameterFunctions(np.empty(0), np.empty(0), np.zeros((1, 0), dtype=np.int64), np.ones((1, 1)))
    linear = polynomial([[1.0], [1.0]])
    field = SeparatedField((np.zeros_like(nodes) if mode is None else mode)[None], constant if mode is None else linear)
    parameters = () if mode is None else (Parameter("load", "ratio", "1", 0.0, 2.0, 0.0),)
    return ReducedModel("box", nodes, np.asarray(mesh.faces, dtype=np.int64), parameters, field)


def test_a_box_lies_on_itself_half_turned_and_not_with_a_knob():
    plain = box(0.09, 0.06, 0.04)
    found = turns_alike(TURN.apply(plain.vertices), np.asarray(plain.faces, dtype=np.int64), None)
    axes = np.array([TURN.inv().apply(about.direction) for about, _ in found])
    np.testing.assert_allclose(np.abs(axes[np.abs(axes).argmax(axis=1).argsort()]), np.eye(3), atol=1e-6)
    assert [angle for _, angle in found] == pytest.approx([np.pi] * 3)
    # Six millimetres wide, and two percent of the size high.
    knob = trimesh.creation.box((0.006, 0.006, 0.005), trimesh.transformations.translation_matrix([0.03, 0.01, 0.02]))
    both = trimesh.util.concatenate([plain, knob])
    assert turns_alike(np.asarray(both.vertices), np.asarray(both.faces, dtype=np.int64), None) == []


def test_a_rigid_prism_may_be_turned_by_its_order_and_a_cube_by_a_quarter():
    prism = trimesh.creation.cylinder(0.03, 0.08, sections=3)
    assert turn_warning(model_of(prism), None) == AttitudeArbitrary(pytest.approx(120.0))
    angles = {round(np.degrees(angle)) for _, angle in turns_alike(*_parts(box(0.05, 0.05, 0.05)), None)}
    assert angles == {90, 180}


def test_a_box_that_stands_on_its_end_and_is_bent_is_ambiguous_and_one_that_is_stretched_is_not():
    """Bent by u = p z² e_x from its foot, it leans to the other side when turned; stretched, it does not change."""
    mesh = box(0.03, 0.05, 0.1)
    z = mesh.vertices[:, 2]
    bent = np.column_stack([(z + 0.05) ** 2, 0.0 * z, 0.0 * z])
    assert turn_warning(model_of(mesh, bent), None) == Ambiguous(Ambiguity.TURNED, pytest.approx(180.0))
    stretched = np.column_stack([0.0 * z, 0.0 * z, 0.1 * z])
    assert turn_warning(model_of(mesh, stretched), None) == AttitudeArbitrary(pytest.approx(180.0))
    # The knob tells the sides apart.
    knob = trimesh.creation.box((0.006, 0.006, 0.006), trimesh.transformations.translation_matrix([0.005, 0.01, 0.05]))
    assert turn_warning(model_of(trimesh.util.concatenate([mesh, knob])), None) is None


@pytest.mark.parametrize(("place", "expected"), [(0.0, AttitudeArbitrary), (0.02, Ambiguous)])
def test_a_small_stamp_on_a_frustum_is_the_same_turned_where_it_is_in_the_middle(place, expected):
    """Its field exp(-(r / a)^2), 8 mm wide on 80 mm, is exactly that of the turned one there."""
    corners = [[x, y, 0.0] for x in (-0.05, 0.05) for y in (-0.05, 0.05)]
    corners += [[x, y, 0.05] for x in (-0.04, 0.04) for y in (-0.04, 0.04)]
    mesh = trimesh.convex.convex_hull(np.array(corners)).subdivide_to_size(0.004)
    x, y, z = np.asarray(mesh.vertices).T
    pressed = np.where(z > 0.0499, -0.004 * np.exp(-((x - place) ** 2 + y**2) / 0.008**2), 0.0)
    assert isinstance(turn_warning(model_of(mesh, np.column_stack([0 * x, 0 * x, pressed])), None), expected)


@pytest.mark.parametrize(("place", "expected"), [(0.0, AttitudeArbitrary), (0.05, Ambiguous)])
def test_a_tube_pressed_from_a_side_is_the_same_turned_where_that_is_in_its_middle(place, expected):
    """Any half turn across it is one about the side, and a turn about its length, which is a parameter."""
    angles, heights = np.meshgrid(0.4 + 2.0 * np.pi * np.arange(36) / 36, np.linspace(-0.1, 0.1, 31), indexing="ij")
    x, y, z = np.array([0.03 * np.cos(angles), 0.03 * np.sin(angles), heights]).reshape(3, -1)
    at = np.arange(x.size).reshape(36, 31)
    quads = np.stack([at[:, :-1], np.roll(at, -1, axis=0)[:, :-1], np.roll(at, -1, axis=0)[:, 1:], at[:, 1:]], axis=-1)
    faces = quads.reshape(-1, 4)[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3)
    mesh = trimesh.Trimesh(np.column_stack([x, y, z]), faces, process=False)
    pressed = -0.01 * np.exp(-(((z - place) / 0.04) ** 2)) * np.maximum(x / 0.03, 0.0)
    model = model_of(mesh, np.column_stack([pressed, 0 * x, 0 * x]))
    assert isinstance(turn_warning(model, Axis(np.zeros(3), np.array([0.0, 0.0, 1.0]))), expected)


def _parts(mesh):
    return np.asarray(mesh.vertices), np.asarray(mesh.faces, dtype=np.int64)
