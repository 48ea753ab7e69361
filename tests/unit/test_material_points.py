"""Points of a model by their positions, fields there, and states that a model has."""

from dataclasses import replace

import numpy as np
import pytest

from morph_dslam.errors import ParameterError
from morph_dslam.model.point_location import material_points
from morph_dslam.studies.rigid import build_rigid
from tests.support.bent_sheet import bent_sheet_model
from tests.support.stretched_block import SHEAR_MODULUS, SIZE, YOUNG_MODULUS, stretched_block_model

#: Inside, on a face, on an edge, in a corner.
PLACES = np.array([[0.013, 0.021, 0.034], [0.08, 0.01, 0.02], [0.05, 0.0, 0.04], [0.0, 0.04, 0.0]])


def test_fields_at_points_are_the_closed_form():
    """The block's fields are affine, so that shape functions are exact everywhere."""
    model = stretched_block_model()
    points, state = model.points(PLACES), model.at({"stretch": 0.15, "slide": "-4 mm"})
    x, _, z = PLACES.T
    zero, slope = np.zeros(len(x)), -0.004 / SIZE[2]
    np.testing.assert_allclose(model.rest_positions(points), PLACES, atol=1e-15)
    moved = np.column_stack([0.15 * x + slope * z, zero, zero])
    np.testing.assert_allclose(state.displacement(points), moved, atol=1e-15)
    np.testing.assert_allclose(state.positions(points), PLACES + moved, atol=1e-15)
    stress = [0.15 * YOUNG_MODULUS, 0.0, 0.0, 0.0, SHEAR_MODULUS * slope, 0.0]
    np.testing.assert_allclose(state.stress(points=points), np.tile(stress, (4, 1)), rtol=1e-12)
    expected = np.hypot(stress[0], 3**0.5 * stress[4])
    np.testing.assert_allclose(state.von_mises(points=points), expected, rtol=1e-12)
    np.testing.assert_allclose(state.strain(points)[:, 0], 0.15, rtol=1e-12)
    by_stretch, by_slide = state.derivatives("displacement", points)
    np.testing.assert_allclose(by_stretch, np.column_stack([x, zero, zero]), atol=1e-15)
    np.testing.assert_allclose(by_slide, np.column_stack([z / SIZE[2], zero, zero]), atol=1e-15)
    assert state.derivatives("stress_solid").shape == (2, len(model.nodes), 6)


def test_a_point_of_a_sheet_is_its_barycentric_combination():
    model, weights = bent_sheet_model(9, 7), np.array([0.2, 0.5, 0.3])
    corners = model.triangles[[0, 31]]
    points = model.points(np.einsum("c,pcx->px", weights, model.nodes[corners]))
    displacement = model.at([0.04, 0.3, 0.1]).displacement()
    expected = np.einsum("c,pcx->px", weights, displacement[corners])
    np.testing.assert_allclose(model.at([0.04, 0.3, 0.1]).displacement(points), expected, atol=1e-12)
    above = model.nodes[corners[:, 0]] + [0.0, 0.0, 2e-3]
    np.testing.assert_allclose(model.rest_positions(model.points(above, 3e-3)), model.nodes[corners[:, 0]], atol=1e-12)
    with pytest.raises(ParameterError, match=r"2 of 2 points lie outside .* about 2 mm away"):
        model.points(above)


def test_a_point_outside_is_named_with_its_distance():
    model = stretched_block_model()
    with pytest.raises(ParameterError, match=r"1 of 2 points .* \(92, 10, 10\) mm, about 12 mm away"):
        model.points([[0.01, 0.01, 0.01], [0.092, 0.01, 0.01]])
    for wrong in ([1.0, 2.0], [[0.01, 0.01, np.nan]]):
        with pytest.raises(ParameterError, match=r"points are positions \(p, 3\)"):
            model.points(wrong)


def test_points_of_another_mesh_are_refused():
    """The same mesh, reduced anew and rounded by its file, takes them; one with as many nodes elsewhere does not."""
    model = stretched_block_model()
    points, state = model.points(PLACES), {"stretch": 0.1}
    rounded = replace(model, name="again", nodes=model.nodes.astype(np.float32).astype(np.float64))
    np.testing.assert_array_equal(rounded.at(state).displacement(points), model.at(state).displacement(points))
    longer, fewer = replace(model, name="longer", nodes=1.001 * model.nodes), bent_sheet_model(3, 3)
    assert len(fewer.nodes) <= points.corners.max()
    for other, values in ((longer, state), (fewer, {})):
        for use in (other.rest_positions, other.restrict, other.at(values).displacement, other.at(values).positions):
            with pytest.raises(ParameterError, match=f"with another mesh than '{other.name}'"):
                use(points)


def test_a_point_in_a_long_cell_is_found_beside_many_short_ones():
    """Fifty centres are nearer to it than that of its own cell."""
    x = np.concatenate([[0.0], np.linspace(1.0, 1.05, 51)])
    nodes = np.array([(a, b, c) for a in x for b in (0.0, 0.1) for c in (0.0, 0.1)])
    first = np.array([0, 4, 6, 2, 1, 5, 7, 3])
    cells = {"hex8": first + 4 * np.arange(len(x) - 1)[:, None]}
    place = np.array([[0.99, 0.03, 0.06]])
    points = material_points(nodes, cells, place)
    np.testing.assert_array_equal(np.sort(points.corners[0]), np.arange(8))
    np.testing.assert_allclose(np.einsum("pc,pcx->px", points.weights, nodes[points.corners]), place, atol=1e-12)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"slide": 0.05}, "slide = 50 mm is outside of its range, -10 to 10 mm"),
        ({"slide": 5}, "slide = 5000 mm is outside"),
        ({"stretch": -0.3}, "stretch = -0.3 is outside of its range, -0.2 to 0.2"),
        ({"slide": float("nan")}, "slide = nan is not a finite number"),
        ([0.0, np.inf], "slide = inf is not a finite number"),
        ({"slide": "5 kN"}, "slide: 'kN' is not a unit of length"),
        ({"slide": "0.005"}, "slide: '0.005' is not a number with a unit of length"),
        ({"slide": None}, "slide = None is not a number"),
        ("x", "'x' is neither an array of parameters nor a table"),
    ],
)
def test_states_that_a_model_does_not_have_are_refused(values, message):
    with pytest.raises(ParameterError, match=message):
        stretched_block_model().at(values)


def test_outside_of_the_range_as_asked_for_and_by_rounding():
    model = stretched_block_model()
    end, beyond = model.at({"slide": "1 cm", "stretch": "0.1"}), {"slide": 0.02, "stretch": 0.1}
    np.testing.assert_array_equal(end.parameters, [0.1, 0.01])
    np.testing.assert_array_equal(model.at(beyond, "bounded").positions(), end.positions())
    np.testing.assert_allclose(model.at(beyond, "linear").displacement()[:, 0].max(), 0.1 * SIZE[0] + 0.02)
    rounded = model.at({"slide": 0.01 * (1.0 + 1e-9), "stretch": 0.1})
    np.testing.assert_array_equal(rounded.positions(), end.positions())
    for use in (model.at, model.positions, lambda values, word: model.von_mises(values, outside=word)):
        with pytest.raises(ParameterError, match="outside='foo' is not known: give 'bounded' or 'linear'"):
            use([0.1, 0.0], "foo")


def test_what_a_model_lacks_is_said_with_what_it_has(tmp_path):
    model = stretched_block_model()
    with pytest.raises(ParameterError, match="no field 'stress'; it has displacement, stress_solid, strain"):
        model.restrict(model.points(PLACES), "stress")
    with pytest.raises(ParameterError, match="no stress 'top'; it has solid"):
        model.at({}).stress("top")
    (tmp_path / "part.stl").write_text(TETRAHEDRON)
    rigid = build_rigid(tmp_path / "part.stl", "mm", tmp_path / "part.morph")
    with pytest.raises(ParameterError, match="'part' has no stress; it has displacement"):
        rigid.at({}).stress()


def test_a_model_is_shown_in_one_line():
    assert repr(stretched_block_model()) == (
        "<ReducedModel 'stretched block': 12 nodes, stretch -0.2 to 0.2, slide -10 to 10 mm>"
    )


_CORNERS = ((0, 0, 0), (10, 0, 0), (0, 10, 0), (0, 0, 10))
_FACETS = "".join(
    "facet normal 0 0 0\nouter loop\n"
    + "".join("vertex {} {} {}\n".format(*_CORNERS[corner]) for corner in face)
    + "endloop\nendfacet\n"
    for face in ((0, 2, 1), (0, 1, 3), (1, 2, 3), (2, 0, 3))
)
TETRAHEDRON = f"solid part\n{_FACETS}endsolid part\n"
