"""Functions of the parameters in every format, fields, models and their surfaces, against scipy and closed forms."""

from math import radians

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from morph_dslam.errors import ParameterError
from morph_dslam.model import SeparatedField, SurfacePoints
from morph_dslam.model.basis_functions import chebyshev_basis, cubic_spline_basis, fourier_basis
from morph_dslam.model.functions import ParameterFunctions, total_degree_indices
from morph_dslam.model.reduced_model import spread_over, triangle_normals
from morph_dslam.model.tensor_functions import CPFunctions, TensorTrainFunctions, TuckerFunctions
from tests.support.bent_sheet import LENGTH, bending_stress_terms, bent_sheet_model, deflection_terms
from tests.support.function_formats import FORMATS, OTHERS, SMOOTH, function_values, make_functions
from tests.support.small_models import block_model

MU = np.array([0.3, 0.6, 0.4])
OUTSIDE = np.array([1.3, -0.2, 0.5])
every_format = pytest.mark.parametrize("form", FORMATS)


@pytest.mark.parametrize(("dimension", "degree"), [(1, 0), (1, 9), (2, 5), (4, 4)])
def test_polynomials_of_any_number_of_parameters_are_their_sums(dimension, degree):
    rng = np.random.default_rng(0)
    indices = total_degree_indices(dimension, degree)
    lower = rng.uniform(-3.0, -1.0, dimension)
    functions = ParameterFunctions(lower, lower + 2.5, indices, rng.normal(size=(len(indices), 7)))
    for mu in rng.uniform(lower - 0.1, lower + 2.6, (10, dimension)):
        values, gradient = functions.evaluate(mu)
        np.testing.assert_allclose(values, function_values(functions, mu, (0,) * dimension), rtol=1e-10, atol=1e-10)
        expected = [function_values(functions, mu, orders) for orders in np.eye(dimension, dtype=int)]
        np.testing.assert_allclose(gradient, expected, rtol=1e-10, atol=1e-10)


def test_polynomials_that_are_even_odd_or_nothing_are_their_sums():
    rng, lower = np.random.default_rng(1), np.array([-1.0, 0.5])
    indices = total_degree_indices(2, 6)
    parity = indices[:, :1] % 2 == np.array([0, 1, 1, 0, 1])
    coefficients = np.where(parity, rng.normal(size=(len(indices), 5)), 1e-17)
    coefficients[:, 4] = 0.0
    functions = ParameterFunctions(lower, lower + 1.5, indices, coefficients)
    for mu in rng.uniform(lower - 0.1, lower + 1.6, (5, 2)):
        values, gradient = functions.evaluate(mu)
        np.testing.assert_allclose(values, function_values(functions, mu, (0, 0)), rtol=1e-10, atol=1e-10)
        expected = [function_values(functions, mu, orders) for orders in np.eye(2, dtype=int)]
        np.testing.assert_allclose(gradient, expected, rtol=1e-10, atol=1e-10)


@every_format
@pytest.mark.parametrize("bases", [SMOOTH, OTHERS], ids=["smooth bases", "other bases"])
@pytest.mark.parametrize("mu", [MU, OUTSIDE], ids=["inside", "outside"])
def test_values_and_gradients_are_the_sums_that_define_the_format(form, bases, mu):
    functions = make_functions(form, bases=bases)
    values, gradient = functions.evaluate(mu)
    np.testing.assert_allclose(values, function_values(functions, mu), rtol=1e-10, atol=1e-10)
    expected = [function_values(functions, mu, orders) for orders in np.eye(3, dtype=int)]
    np.testing.assert_allclose(gradient, expected, rtol=1e-10, atol=1e-10)
    assert functions.n_functions == 7


@every_format
def test_values_of_many_states_in_any_order_are_their_own_whatever_was_asked_before_and_done_with_it(form):
    functions, rng = make_functions(form), np.random.default_rng(4)
    states = rng.uniform(0.0, 1.0, (40, 3))
    expected = [function_values(functions, mu) for mu in states]
    for k in [*range(40), *rng.integers(0, 40, 60), *np.repeat(rng.integers(0, 40, 10), 2)]:
        found = functions.rows(states[k])
        np.testing.assert_allclose(found[0], expected[k], rtol=1e-10, atol=1e-10)
        found[:] = np.nan


@pytest.mark.parametrize(("precision", "tolerance"), [(np.float64, 1e-13), (np.float32, 1e-6)])
def test_placed_points_are_moved_turned_and_shifted(precision, tolerance):
    """More numbers than are added up at a time, and modes that are no multiple of four."""
    rng, functions = np.random.default_rng(5), make_functions(FORMATS[0])
    field = SeparatedField(rng.normal(size=(7, 301, 3)).astype(precision), functions)
    rest, shift = rng.normal(size=(301, 3)), rng.normal(size=3)
    turn = Rotation.from_rotvec([0.3, -1.1, 0.7])
    displacement = np.einsum("mpx,m->px", field.modes.astype(float), function_values(functions, MU))
    expected = turn.apply(rest + displacement) + shift
    scale = np.abs(displacement).max()
    np.testing.assert_allclose(field.placed(rest, MU, turn.as_matrix(), shift), expected, atol=tolerance * scale)


@every_format
def test_mixed_functions_are_the_linear_combinations_of_the_old(form):
    functions, mixing = make_functions(form), np.random.default_rng(3).normal(size=(7, 4))
    for new, old in zip(functions.mixed(mixing).evaluate(MU), functions.evaluate(MU), strict=True):
        np.testing.assert_allclose(new, old @ mixing, rtol=1e-10, atol=1e-12)


@every_format
def test_a_wrong_number_of_parameters_is_refused(form):
    functions, mu = make_functions(form), np.array([0.1, 0.2, 0.3])
    with pytest.raises(ValueError, match="3 parameters"):
        functions.evaluate(mu[:2])
    functions.evaluate(mu)
    with pytest.raises(ValueError, match="3 parameters"):  # the same numbers as those of the state that is kept
        functions.evaluate(mu[None])


def test_arrays_that_do_not_fit_are_refused():
    rng = np.random.default_rng(0)
    factors = tuple(rng.normal(size=(b.size, 2)) for b in SMOOTH)
    for make in (
        lambda: CPFunctions(SMOOTH, factors[::-1], np.eye(2)),
        lambda: CPFunctions(SMOOTH, factors, np.eye(3)),
        lambda: TuckerFunctions(SMOOTH, factors, rng.normal(size=(4, 2, 2, 3))),
        lambda: TensorTrainFunctions(SMOOTH, tuple(rng.normal(size=(2, b.size, 2)) for b in SMOOTH)),
    ):
        with pytest.raises(ValueError):  # noqa: PT011
            make()


def test_total_degree_indices_are_all_and_ordered():
    indices = total_degree_indices(3, 4)
    assert len(np.unique(indices, axis=0)) == len(indices) == 35  # (3 + 4)! / (3! 4!)
    totals = indices.sum(axis=1)
    assert totals.max() == 4
    assert (np.diff(totals) >= 0).all()


def test_an_angle_has_no_outside():
    bases = (chebyshev_basis(0.0, 1.0, 3), fourier_basis(-np.pi, np.pi, 2))
    functions = CPFunctions(bases, (np.ones((4, 2)), np.ones((5, 2))), np.eye(2))
    assert functions.inside([0.5, 9.0]).tolist() == [True, True]
    assert functions.inside([1.5, 9.0]).tolist() == [False, True]


@pytest.fixture(params=FORMATS)
def field(request):
    modes = np.random.default_rng(4).normal(size=(6, 11, 3))
    return SeparatedField(modes, make_functions(request.param, n_functions=6))


def test_fields_combine_the_modes_and_restrict_to_points(field):
    for mu in (MU, OUTSIDE):
        expected = [np.tensordot(part, field.modes, axes=1) for part in field.functions.evaluate(mu)]
        for one, other in zip(field.value_and_sensitivities(mu, "linear"), expected, strict=True):
            np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(field.value(mu, "linear"), expected[0], rtol=1e-9, atol=1e-9)
    corners, weights = np.array([[0, 3, 5], [10, 2, 2]]), np.array([[0.2, 0.3, 0.5], [1.0, 0.0, 0.0]])
    whole = field.value(MU)
    at_points = [0.2 * whole[0] + 0.3 * whole[3] + 0.5 * whole[5], whole[10]]
    np.testing.assert_allclose(field.restrict(corners, weights).value(MU), at_points, rtol=1e-9, atol=1e-9)


def test_a_bounded_field_is_that_of_the_nearest_state(field):
    found = field.value_and_sensitivities([1.4, 0.3, -0.2])
    nearest = field.value_and_sensitivities([1.0, 0.3, 0.0], outside="linear")
    for one, other in zip(found, nearest, strict=True):
        np.testing.assert_array_equal(one, other)
    assert field.inside([1.4, 0.3, -0.2]).tolist() == [False, True, False]
    assert field.inside([1.0, 0.0, 2.0]).all()
    with pytest.raises(ParameterError, match="wild"):
        field.value([0.0, 0.0, 0.0], outside="wild")


def test_outside_fields_go_on_along_straight_lines(field):
    """C1 across a face: the slope at the face is that of the line beyond."""
    mu, step = np.array([1.0, 0.4, 0.7]), np.array([0.8, 0.0, 0.0])
    near, middle, far = (field.value(mu + i * step, outside="linear") for i in (0.0, 0.5, 1.0))
    np.testing.assert_allclose(middle, (near + far) / 2.0, rtol=1e-10, atol=1e-10)
    np.testing.assert_allclose(far - near, 0.8 * field.value_and_sensitivities(mu)[1][0], rtol=1e-9, atol=1e-9)


def test_outside_two_ranges_the_tangent_is_bilinear():
    functions = make_functions("polynomial")
    width, mu = np.array([0.3, 0.2, 0.0]), np.array([1.0, 1.0, 0.4])
    value, gradient = functions.evaluate(mu)
    expected = value + width @ gradient + 0.06 * function_values(functions, mu, (1, 1, 0))
    np.testing.assert_allclose(functions.evaluate(mu + width)[0], expected, rtol=1e-10, atol=1e-10)


STATE = np.array([0.03, -0.25, radians(12)])


@pytest.fixture(scope="module")
def model():
    return bent_sheet_model(15, 11)


def monomial_sum(terms, mu):
    return sum(np.prod(mu ** np.array(powers)) * values for powers, values in terms.items())


def test_positions_and_stress_are_the_sums_they_were_made_from(model):
    x, y = model.nodes[:, 0], model.nodes[:, 1]
    displacement = monomial_sum(deflection_terms(x, y), STATE)
    np.testing.assert_allclose(model.positions(STATE), model.nodes + displacement, atol=1e-15)
    s11, s22, s12 = monomial_sum(bending_stress_terms(x, y), STATE).T
    # Von Mises' definition in three dimensions, with the stresses out of the plane zero.
    expected = np.sqrt(((s11 - s22) ** 2 + s22**2 + s11**2) / 2 + 3 * s12**2)
    for place in ("top", "bottom", None):
        np.testing.assert_allclose(model.von_mises(STATE, place), expected, rtol=1e-10)


def test_a_state_by_name_is_that_of_the_array():
    model = block_model("tucker")
    names = [parameter.name for parameter in model.parameters]
    state, mu = model.at({names[2]: 0.001, names[0]: -0.4}), np.array([-0.4, model.default[1], 0.001])
    np.testing.assert_array_equal(state.parameters, mu)
    np.testing.assert_array_equal(state.displacement(), model.displacement.value(mu))
    np.testing.assert_array_equal(state.positions(), model.positions(mu))
    np.testing.assert_array_equal(state.strain(), model.strain.value(mu))
    np.testing.assert_array_equal(state.stress(), model.stresses["solid"].value(mu))
    np.testing.assert_array_equal(state.von_mises(), model.von_mises(mu, "solid"))
    (name, force), (key, reaction) = *state.reactions().items(), *model.reactions.items()
    assert name == key
    np.testing.assert_array_equal(force, reaction.value(mu)[0])


def test_parameters_and_fields_that_a_model_lacks_are_named(model):
    for values, word in (({"bulge": 0.1}, "bulge"), ([0.1, 0.2], r"\(2,\)")):
        with pytest.raises(ParameterError, match=word):
            model.at(values)
    with pytest.raises(ParameterError, match="strain"):
        model.at({}).strain()
    with pytest.raises(ParameterError, match="side"):
        model.von_mises(STATE, "side")


def test_restriction_interpolates_the_full_field(model):
    rng = np.random.default_rng(0)
    points = SurfacePoints(rng.integers(len(model.triangles), size=30), rng.dirichlet(np.ones(3), 30))
    corners = model.triangles[points.triangles]
    full_value, full_sensitivities = model.displacement.value_and_sensitivities(STATE)
    value, sensitivities = model.restrict(points).value_and_sensitivities(STATE)
    np.testing.assert_allclose(value, np.einsum("pc,pcx->px", points.weights, full_value[corners]), atol=1e-14)
    expected = np.einsum("pc,dpcx->dpx", points.weights, full_sensitivities[:, corners])
    np.testing.assert_allclose(sensitivities, expected, atol=1e-12)
    rest = model.rest_positions(points)
    assert np.abs(rest[:, 0]).max() <= LENGTH / 2
    np.testing.assert_allclose(rest, np.einsum("pc,pcx->px", points.weights, model.nodes[corners]), atol=1e-16)


def test_points_can_be_chosen_by_index_and_by_mask():
    points = SurfacePoints(np.array([5, 6, 7]), np.eye(3))
    assert points.take(np.array([2, 0])).triangles.tolist() == [7, 5]
    np.testing.assert_array_equal(points.take(np.array([False, True, False])).weights, [[0, 1, 0]])


def test_parameters_are_shown_in_their_unit(model):
    assert model.parameters[2].display(model.parameters[2].upper) == pytest.approx(20.0)
    assert model.parameters[0].display(model.lower[0]) == pytest.approx(-60.0)


def test_a_model_passes_the_choice_of_the_outside_on(model):
    """Bending stress is proportional to the arch, so that its tangent is exact."""
    beyond, end = np.array([0.075, 0.0, 0.0]), np.array([0.060, 0.0, 0.0])
    np.testing.assert_array_equal(model.positions(beyond), model.positions(end))
    np.testing.assert_array_equal(model.von_mises(beyond, "top"), model.von_mises(end, "top"))
    expected = 0.075 / 0.060 * model.von_mises(end, "top")
    np.testing.assert_allclose(model.von_mises(beyond, "top", "linear"), expected, rtol=1e-9)
    assert not np.allclose(model.at(beyond, "linear").positions(), model.positions(beyond))
    assert model.inside(beyond).tolist() == [False, True, True]


def test_points_inside_of_cells_follow_the_interpolated_field():
    """Trilinear functions of the position, x y z and 1 + x, are exact between the nodes of hexahedra."""
    model = block_model("tucker")
    rng = np.random.default_rng(7)
    positions = rng.uniform(0.0, 0.1, (30, 3))
    points = model.points(positions)
    np.testing.assert_allclose(model.rest_positions(points), positions, atol=1e-12)
    known = lambda p: np.stack([p.prod(axis=1), 1.0 + p[:, 0], p[:, 1]], axis=-1)  # noqa: E731
    values = rng.normal(size=(6, 1, 1))
    field = SeparatedField(values * known(model.nodes), model.displacement.functions)
    factor = values.ravel() @ model.displacement.functions.evaluate(MU)[0]
    found = field.restrict(points.corners, points.weights).value(MU)
    np.testing.assert_allclose(found, factor * known(positions), rtol=1e-9, atol=1e-12)
    whole = model.stresses["solid"].value(MU)
    stress = model.restrict(points, "stress_solid").value(MU)
    np.testing.assert_allclose(stress, np.einsum("pc,pcx->px", points.weights, whole[points.corners]))
    with pytest.raises(ParameterError, match=r"1 of 2 points lie outside of the object, the first at \(120, 0, 0\)"):
        model.points(np.array([[0.05, 0.05, 0.05], [0.12, 0.0, 0.0]]))


def test_points_just_outside_are_drawn_to_the_solid():
    model = block_model("tucker")  # a cube of 100 mm
    positions = np.array([[0.1004, 0.03, 0.05], [-0.0003, 0.1002, 0.07], [0.02, 0.03, 0.04]])
    points = model.points(positions, reach=5e-4)
    np.testing.assert_allclose(model.rest_positions(points), np.clip(positions, 0.0, 0.1), atol=1e-12)
    with pytest.raises(ParameterError, match=r"1 of 3 points lie outside .*, the first at \(100.4, 30, 50\)"):
        model.points(positions, reach=3.9e-4)


def test_interpolated_functions_are_those_of_one_parameter():
    """A mixture of functions of one parameter needs no mixing matrix."""
    nodes = np.linspace(0.0, 1.0, 6)
    basis = cubic_spline_basis(nodes)
    functions = CPFunctions((basis,), (basis.interpolate(nodes, np.column_stack([nodes, nodes**2])),), np.eye(2))
    mixed = functions.mixed(np.array([[1.0], [2.0]]))
    assert mixed.is_unmixed
    np.testing.assert_allclose(mixed.evaluate([0.3])[0], [0.3 + 2.0 * 0.09])


def test_separated_form_equals_the_formula():
    model = bent_sheet_model(9, 7)
    arch, skew, twist = 0.05, -0.4, 0.2
    x, y, _ = model.nodes.T
    s = 2 * x / LENGTH
    z = arch * (1 - s**2) * (1 + skew * s) + twist * s * y
    np.testing.assert_allclose(model.positions(np.array([arch, skew, twist]))[:, 2], z, atol=1e-15)
    np.testing.assert_allclose(model.positions(model.default), model.nodes, atol=1e-15)


def test_length_along_the_middle_is_kept_to_second_order():
    model = bent_sheet_model()
    middle = np.flatnonzero(model.nodes[:, 1] == 0.0)
    for arch in (0.01, 0.02):
        line = model.positions(np.array([arch, 0.5, 0.3]))[middle]
        length = np.linalg.norm(np.diff(line, axis=0), axis=1).sum()
        assert abs(length / LENGTH - 1) < 12 * (arch / LENGTH) ** 3


#: A rectangle 4 by 1 in three triangles of areas 0.5, 1.5 and 2.
NODES = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [4.0, 0.0, 0.0], [4.0, 1.0, 0.0], [0.0, 1.0, 0.0]])
TRIANGLES = np.array([[0, 1, 4], [1, 2, 4], [2, 3, 4]])


def test_normals_are_twice_as_long_as_the_areas():
    np.testing.assert_allclose(triangle_normals(NODES, TRIANGLES), [[0, 0, 1], [0, 0, 3], [0, 0, 4]])


def test_each_triangle_gets_as_many_points_as_its_area_asks_for():
    points = spread_over(NODES, TRIANGLES, 800)
    assert np.bincount(points.triangles).tolist() == [100, 300, 400]
    assert (points.weights >= 0.0).all()
    np.testing.assert_allclose(points.weights.sum(axis=1), 1.0)


def test_points_are_spread_evenly_within_the_triangles_and_the_same_every_time():
    points = spread_over(NODES, TRIANGLES, 8000)
    places = np.einsum("pc,pcx->px", points.weights, NODES[TRIANGLES[points.triangles]])
    # Of a rectangle: the middle, and a twelfth of the squared sides.
    np.testing.assert_allclose(places.mean(axis=0), [2.0, 0.5, 0.0], atol=0.03)
    np.testing.assert_allclose(places.var(axis=0), [16 / 12, 1 / 12, 0.0], rtol=0.03)
    np.testing.assert_array_equal(spread_over(NODES, TRIANGLES, 8000).weights, points.weights)


def test_a_triangle_without_area_gets_no_point():
    points = spread_over(NODES, np.concatenate([TRIANGLES, [[0, 0, 1]]]), 801)
    assert points.triangles.max() == 2
