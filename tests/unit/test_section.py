"""Sections through solids: their areas in closed form, and how they are carried and drawn."""

from dataclasses import replace

import numpy as np
import pytest

from morph_dslam.camera import Camera
from morph_dslam.errors import ParameterError, TrackingError
from morph_dslam.geometry import RigidTransform
from morph_dslam.model import SeparatedField
from morph_dslam.model.functions import ParameterFunctions
from morph_dslam.tracking.drawing import AugmentedView, DrawOptions, SectionPlane, cut, surface_before
from morph_dslam.tracking.estimator import State
from tests.support.bent_sheet import bent_sheet_model
from tests.support.small_models import block_model

SIDE = 0.1
CAMERA = Camera(320, 240, 300.0, 300.0, 160.0, 120.0)
#: The camera looks along +x of the object, z up in the image.
ALONG_X = RigidTransform(np.array([[0.0, 1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]]), np.array([-0.05, 0.05, 0.3]))


def stretching_block():
    """A cube of 8 cells, 100 mm wide, whose displacement is u = mu_1 X, with strain and stress to match."""
    block = block_model("polynomial")
    powers = np.array([[0, 0, 0], [1, 0, 0]])
    functions = ParameterFunctions(block.lower, block.upper, powers, np.array([[0.0], [1.0]]))
    strain = np.tile([1.0, 0.0, 0.0, 0.0, 0.0, 0.0], (len(block.nodes), 1))[None]
    return replace(
        block,
        displacement=SeparatedField(block.nodes[None].copy(), functions),
        stresses={"solid": SeparatedField(1e6 * strain, functions)},
        strain=SeparatedField(0.3 * strain, functions),
        reactions={},
    )


def closed(model):
    """The block with all triangles of its surface, outwards: faces that belong to one cell."""
    rows = [[0, 3, 2, 1], [4, 5, 6, 7], [0, 1, 5, 4], [1, 2, 6, 5], [2, 3, 7, 6], [3, 0, 4, 7]]
    faces = model.cells["hex8"][:, rows].reshape(-1, 4)
    _, first, counts = np.unique(np.sort(faces, axis=1), axis=0, return_index=True, return_counts=True)
    outer = faces[first[counts == 1]]
    return replace(model, triangles=np.concatenate([outer[:, [0, 1, 2]], outer[:, [0, 2, 3]]]))


def area(nodes, triangles):
    a, b, c = (nodes[triangles[:, k]] for k in range(3))
    return 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1).sum()


def as_cells(model, kind):
    """The same block of tetrahedra or of prisms."""
    hexes = model.cells["hex8"]
    if kind == "tet4":
        rows = [[0, 1, 3, 4], [1, 2, 3, 6], [1, 4, 5, 6], [3, 4, 6, 7], [1, 3, 4, 6]]
    else:
        rows = [[0, 1, 2, 4, 5, 6], [0, 2, 3, 4, 6, 7]]
    return replace(model, cells={kind: hexes[:, rows].reshape(-1, len(rows[0]))})


@pytest.mark.parametrize("kind", ["hex8", "tet4", "prism6"])
@pytest.mark.parametrize(
    ("normal", "offset", "expected"),
    [
        ((1.0, 0.0, 0.0), 0.03, SIDE**2),
        ((0.0, 1.0, 0.0), 0.05, SIDE**2),  # through nodes
        ((1.0, 1.0, 0.0), 0.1, np.sqrt(2.0) * SIDE**2),
        ((1.0, 1.0, 1.0), 0.15, 0.75 * np.sqrt(3.0) * SIDE**2),  # a regular hexagon
    ],
)
def test_a_cube_is_cut_in_squares_rectangles_and_hexagons(kind, normal, offset, expected):
    model, length = stretching_block(), np.linalg.norm(normal)
    model = model if kind == "hex8" else as_cells(model, kind)
    plane = SectionPlane(np.array(normal) / length, offset / length)
    points, triangles = cut(model, plane)
    nodes = model.rest_positions(points)
    np.testing.assert_allclose(plane.beyond(nodes), 0.0, atol=1e-9)
    assert area(nodes, triangles) == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize(
    ("text", "left"),
    [("x=30", 2 + 4 * 0.3 - 1), ("-x=30", 2 + 4 * 0.7 - 1), ("y=50", 2 + 4 * 0.5 - 1), ("-z=71", 2 + 4 * 0.29 - 1)],
)
def test_the_surface_ends_where_it_is_cut(text, left):
    """Of a cube's six faces, one and a part of four others; with the cut it is closed: no vector area."""
    model, plane = closed(stretching_block()), SectionPlane.parse(text)
    points, triangles = surface_before(model, plane)
    nodes = model.rest_positions(points)
    assert plane.beyond(nodes).max() < 1e-9
    assert area(nodes, triangles) == pytest.approx(left * SIDE**2, rel=1e-6)
    a, b, c = (nodes[triangles[:, k]] for k in range(3))
    vector = 0.5 * np.cross(b - a, c - a).sum(axis=0)
    np.testing.assert_allclose(vector, -plane.normal * SIDE**2, atol=1e-8)


def test_what_is_drawn_is_carried_along_and_coloured():
    """Cut at x = 30 mm and stretched by 0.5, the section is a square of 150 mm at x = 45 mm."""
    model, state = stretching_block(), State(np.array([0.5, 0.0, 0.0]), ALONG_X)
    view = AugmentedView(model, CAMERA, DrawOptions("strain", SectionPlane.parse("-x=30")))
    nodes = state.camera_from_object.inverse.apply(view.view(state).nodes)
    section = nodes[np.abs(nodes[:, 0] - 0.045) < 1e-6]
    np.testing.assert_allclose(np.ptp(section, axis=0)[1:], 0.15, rtol=1e-5)
    # Equivalent strain of (e, 0, 0) is 2/3 e; here e = 0.15.
    np.testing.assert_allclose(view.values(state), 10.0, rtol=1e-5)
    stress = AugmentedView(model, CAMERA)
    np.testing.assert_allclose(stress.values(state), 0.5, rtol=1e-5)
    assert stress.range_of_box() == (0.0, pytest.approx(1.0, abs=0.05))
    grey = np.full((240, 320, 3), 90, dtype=np.uint8)
    drawn = view.draw(grey, state, (0.0, 10.0), "frame 1")
    # The section's square in the image: 150 mm at a distance of 345 mm, 50 mm of it left and below.
    changed = (drawn[:, :230] != grey[:, :230]).any(axis=2)
    assert changed[36:160, 120:230].all()
    assert not changed[:18].any()
    assert not changed[:200, :100].any()


@pytest.mark.parametrize(("show", "is_grey"), [("stress", True), ("strain", True), ("displacement", False)])
def test_what_is_not_to_be_relied_on_has_no_colour(show, is_grey):
    """Of displacement, which the images show, a part is right."""
    state, picture = State(np.array([0.5, 0.0, 0.0]), ALONG_X), np.full((240, 320, 3), 90, dtype=np.uint8)
    view = AugmentedView(stretching_block(), CAMERA, DrawOptions(show, SectionPlane.parse("-x=30")))
    for mistaken in (False, True):
        drawn = view.draw(picture, state, (0.0, 10.0), "", mistaken=mistaken)[36:160, 120:230].astype(int)
        assert (np.ptp(drawn, axis=2).max() < 3) == (mistaken and is_grey)


@pytest.mark.parametrize(("show", "of_one"), [("stress", 1.0), ("strain", 20.0)])
def test_what_is_shown_follows_the_state(show, of_one):
    """Of u = mu X, with the stress mu MPa and the strain 0.3 mu along x, whatever was asked for before."""
    field = AugmentedView(closed(stretching_block()), CAMERA, DrawOptions(show)).surface_field
    parameters = np.zeros(3)  # the same array anew, as who reuses one would
    for stretch in (0.5, 0.5, 0.25, 0.5):
        parameters[0] = stretch
        displacement = field.displacement(parameters)
        assert np.ptp(displacement, axis=0) == pytest.approx(0.1 * stretch, rel=1e-5)
        assert field.values(parameters, displacement) == pytest.approx(of_one * stretch, rel=1e-5)
    assert (
        AugmentedView(stretching_block(), CAMERA, DrawOptions(show, SectionPlane.parse("x=30"))).surface_field is None
    )


def test_what_cannot_be_drawn_is_said():
    model = stretching_block()
    with pytest.raises(TrackingError, match=r"'x>3' is no section: write x=12"):
        SectionPlane.parse("x>3")
    with pytest.raises(TrackingError, match=r"misses the object: .* reaches from 0.0 to 100.0 mm"):
        AugmentedView(model, CAMERA, DrawOptions(None, SectionPlane.parse("x=130")))
    with pytest.raises(TrackingError, match="is the model of a surface: it has no inside"):
        AugmentedView(bent_sheet_model(5, 5), CAMERA, DrawOptions(None, SectionPlane.parse("x=3")))
    with pytest.raises(ParameterError, match="holds no strain to show"):
        AugmentedView(bent_sheet_model(5, 5), CAMERA, DrawOptions("strain"))
