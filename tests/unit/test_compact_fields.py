"""Fields with modes by component, fields separated on structured meshes, and points inside of cells."""

from __future__ import annotations

import numpy as np
import pytest

from morph_dslam.errors import StudyError
from morph_dslam.mechanics.recovery import material_points
from morph_dslam.model import SeparatedField
from morph_dslam.model.basis_functions import hat_basis
from morph_dslam.model.separated import ComponentModes, GridModes
from morph_dslam.model.tensor_functions import CPFunctions, StackedFunctions, stack_components
from morph_dslam.reduction.grid_functions import separate_grid
from tests.support.function_formats import FORMATS, LOWER, UPPER, make_functions
from tests.support.small_models import block_model

MU = np.array([0.3, 0.6, 0.4])


@pytest.fixture(scope="module")
def parts():
    rng = np.random.default_rng(6)
    return [
        SeparatedField(rng.normal(size=(n, 11, 1)), make_functions(form, n, seed=n))
        for form, n in (("tucker", 4), ("polynomial", 2), ("tensor_train", 3))
    ]


def test_a_stacked_field_has_its_components_from_fields_of_their_own(parts):
    field = stack_components(parts)
    values, slopes = field.value_and_sensitivities(MU)
    for c, part in enumerate(parts):
        value, gradient = part.value_and_sensitivities(MU)
        np.testing.assert_allclose(values[:, c], value[:, 0], rtol=1e-12)
        np.testing.assert_allclose(slopes[:, :, c], gradient[:, :, 0], rtol=1e-12)
    for one, other in zip(field.value_and_sensitivities_numpy(MU), (values, slopes), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-9)


def test_no_zeros_are_counted_in_a_stacked_field(parts):
    field = stack_components(parts)
    # 9 modes of 11 points, and 9 bytes that name their components
    assert field.n_floats == 9 * 11 + 3 + sum(part.functions.n_floats for part in parts)
    assert field.restrict(np.array([[0, 1]]), np.array([[0.5, 0.5]])).compact is None


def test_mixed_stacked_functions_are_linear_combinations(parts):
    functions, mixing = stack_components(parts).functions, np.random.default_rng(3).normal(size=(9, 4))
    mixed = functions.mixed(mixing)
    for new, old in zip(mixed.evaluate(MU), functions.evaluate(MU), strict=True):
        np.testing.assert_allclose(new, old @ mixing, rtol=1e-10)
    again = mixed.mixed(mixing.T)
    np.testing.assert_allclose(again.evaluate(MU)[0], functions.evaluate(MU)[0] @ mixing @ mixing.T)
    assert (mixed.n_functions, again.n_functions) == (4, 9)


def test_parts_that_do_not_fit_are_refused(parts):
    with pytest.raises(ValueError, match="not components at the same points"):
        stack_components([parts[0], SeparatedField(np.zeros((4, 12, 1)), parts[0].functions)])
    other = CPFunctions((hat_basis([0.0, 1.0]),) * 3, (np.eye(2),) * 3, np.eye(2))
    with pytest.raises(ValueError, match="same ranges"):
        StackedFunctions((parts[0].functions, other))
    with pytest.raises(ValueError, match="is not one of 2"):
        ComponentModes(np.zeros((1, 5)), np.array([2]), 2)
    with pytest.raises(ValueError, match="not the factors of the same modes"):
        GridModes((np.zeros((2, 5)), np.zeros((3, 5))), np.zeros((2, 3)))


def test_grid_modes_are_products_with_the_last_direction_fastest():
    rng = np.random.default_rng(1)
    x, y, a = rng.normal(size=(2, 4)), rng.normal(size=(2, 5)), rng.normal(size=(2, 3))
    modes = GridModes((x, y), a).expand()
    assert modes.shape == (2, 20, 3)
    assert modes[1, 2 * 5 + 3, 1] == pytest.approx(x[1, 2] * y[1, 3] * a[1, 1])
    np.testing.assert_allclose(modes, np.einsum("kx,ky,kc->kxyc", x, y, a).reshape(2, 20, 3))


def error(found, field, samples):
    missed = sum(np.sum((found.value(mu) - field.value(mu)) ** 2) for mu in samples)
    return np.sqrt(missed / sum(np.sum(field.value(mu) ** 2) for mu in samples))


@pytest.mark.parametrize("form", FORMATS)
def test_a_field_of_few_products_is_found_again_on_its_grid(form):
    """Three terms X Y a hidden in six modes: any format of functions is kept, with fewer numbers."""
    rng = np.random.default_rng(4)
    hidden = GridModes((rng.normal(size=(3, 8)), rng.normal(size=(3, 9))), rng.normal(size=(3, 3)))
    modes = np.tensordot(rng.normal(size=(6, 3)), hidden.expand(), axes=1)
    field = SeparatedField(modes, make_functions(form, 6))
    samples = rng.uniform(LOWER, UPPER, (40, 3))
    found = separate_grid(field, (8, 9), samples, 1e-6, 8)
    assert found.n_modes == 3
    assert type(found.functions) is type(field.functions)
    assert error(found, field, samples) < 2e-6
    _, slopes = field.value_and_sensitivities(MU)
    _, found_slopes = found.value_and_sensitivities(MU)
    assert np.abs(found_slopes - slopes).max() < 1e-4 * np.abs(slopes).max()
    assert found.n_floats == 3 * (8 + 9 + 3) + found.functions.n_floats


@pytest.mark.parametrize("by_component", [True, False])
def test_snapshots_on_a_grid_become_products_of_x_y_and_the_parameter(by_component):
    """u = t² (1 + y) is one product, w = x² y t + cos(2 t) x are two: 3 terms, 71 numbers each."""
    x, y, t = np.linspace(-1.0, 1.0, 12), np.linspace(0.0, 1.0, 7), np.linspace(-1.0, 1.0, 50)
    a, b, c = np.meshgrid(t, x, y, indexing="ij")
    snapshots = np.stack([a**2 * (1.0 + c), b**2 * c * a + np.cos(2.0 * a) * b], axis=-1).reshape(50, -1, 2)
    field = SeparatedField(snapshots, CPFunctions((hat_basis(t),), (np.eye(50),), np.eye(50)))
    found = separate_grid(field, (12, 7), t[:, None], 1e-6, 8, by_component)
    assert found.n_modes == 3
    assert found.n_floats == 3 * (12 + 7 + 2 + 50)
    assert error(found, field, t[:, None]) < 1e-6
    if by_component:
        assert (np.count_nonzero(found.compact.components, axis=1) == 1).all()


def test_a_grid_that_is_not_the_mesh_is_refused(parts):
    with pytest.raises(ValueError, match=r"a grid of \(3, 4\) nodes is not a mesh of 11"):
        separate_grid(parts[0], (3, 4), np.array([MU]), 1e-3, 3)


def test_points_inside_of_cells_follow_the_interpolated_field():
    """Trilinear functions of the position, x y z and 1 + x, are exact between the nodes of hexahedra."""
    model = block_model("tucker")
    rng = np.random.default_rng(7)
    positions = rng.uniform(0.0, 0.1, (30, 3))
    points = material_points(model, positions)
    assert len(points) == 30
    np.testing.assert_allclose(model.rest_positions(points), positions, atol=1e-12)
    values = rng.normal(size=(6, 2))
    known = lambda p: np.stack([p.prod(axis=1), 1.0 + p[:, 0], p[:, 1]], axis=-1)  # noqa: E731
    modes = values[:, :1, None] * known(model.nodes)
    field = SeparatedField(modes, model.displacement.functions)
    at_points = field.restrict(points.corners, points.weights)
    factor = values[:, 0] @ model.displacement.functions.evaluate(MU)[0]
    np.testing.assert_allclose(at_points.value(MU), factor * known(positions), rtol=1e-9, atol=1e-12)
    stress = model.restrict(points, "stress_solid").value(MU)
    whole = model.stresses["solid"].value(MU)
    np.testing.assert_allclose(stress, np.einsum("pc,pcx->px", points.weights, whole[points.corners]))


def test_points_outside_of_the_solid_are_refused():
    with pytest.raises(StudyError, match=r"1 of 2 points lie outside of the solid, the first at \(120, 0, 0\)"):
        material_points(block_model("tucker"), np.array([[0.05, 0.05, 0.05], [0.12, 0.0, 0.0]]))
