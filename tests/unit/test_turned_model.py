"""Bodies of revolution loaded from an unknown side, and products of functions: closed forms."""

import numpy as np
import pytest

from morph_dslam.errors import ModelFileError
from morph_dslam.evaluation.model_summary import summarise_model
from morph_dslam.meshing.generators import block, tube
from morph_dslam.meshing.meshes import model_mesh_of
from morph_dslam.model import Parameter, ReducedModel, SeparatedField, load_model, save_model
from morph_dslam.model.basis_functions import chebyshev_basis, fourier_basis
from morph_dslam.model.functions import ParameterFunctions
from morph_dslam.model.revolution import with_revolution_angle
from morph_dslam.model.tensor_functions import CPFunctions, ProductFunctions
from tests.support.bent_tube import AXIS, bent_tube, polynomial


def turned_stress(nodes, load, angle):
    """The stress of `bent_tube` turned by an angle: R S(R^T X) R^T (n, 3, 3)."""
    c, s = np.cos(angle), np.sin(angle)
    rotation = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    y = (nodes @ rotation)[:, 1]
    local = np.zeros((len(nodes), 3, 3))
    local[:, 0, 0] = 1e6
    local[:, 0, 1] = local[:, 1, 0] = 1e7 * y
    return load * rotation @ local @ rotation.T


@pytest.mark.parametrize("angle", [0.0, 0.4, -2.3, 2.0 * np.pi / 24 * 5])
def test_displacement_and_stress_turn_with_the_load(angle):
    turned = with_revolution_angle(bent_tube(), AXIS)
    mu, z = np.array([1.3, angle]), turned.nodes[:, 2]
    expected = 1.3 * z[:, None] ** 2 * np.array([np.cos(angle), np.sin(angle), 0.0])
    np.testing.assert_allclose(turned.displacement.value(mu), expected, atol=1e-12)
    tensor = turned_stress(turned.nodes, 1.3, angle)
    components = tensor[:, [0, 1, 2, 1, 0, 0], [0, 1, 2, 2, 2, 1]]
    np.testing.assert_allclose(turned.stresses["solid"].value(mu), components, atol=1e-4)


def test_sensitivity_to_the_angle_is_that_of_finite_differences():
    field = with_revolution_angle(bent_tube(), AXIS).displacement
    mu, step = np.array([1.3, 0.7]), 1e-6
    _, slopes = field.value_and_sensitivities(mu)
    for k in range(2):
        delta = step * np.eye(2)[k]
        difference = (field.value(mu + delta) - field.value(mu - delta)) / (2.0 * step)
        np.testing.assert_allclose(slopes[k], difference, atol=1e-9)


def test_only_products_that_count_are_kept():
    """Of 2 functions and 1 + 2 h harmonics two products make all of this field: z² cos and z² sin, times the load."""
    assert with_revolution_angle(bent_tube(), AXIS).displacement.n_modes == 2


def test_a_turned_model_is_kept_in_a_file(tmp_path):
    turned = with_revolution_angle(bent_tube(), AXIS)
    save_model(tmp_path / "turned.morph", turned)
    loaded = load_model(tmp_path / "turned.morph")
    mu = np.array([0.6, 1.1])
    assert [parameter.name for parameter in loaded.parameters] == ["load", "turn"]
    np.testing.assert_allclose(loaded.positions(mu), turned.positions(mu), atol=1e-8)
    assert loaded.displacement.n_floats == turned.displacement.n_floats


def test_a_turned_model_is_described_as_any_other():
    turned = with_revolution_angle(bent_tube(), AXIS)
    rows = {row[0]: row[1:] for row in summarise_model(turned)["fields"].rows}
    assert rows["displacement"][:2] == [str(turned.displacement.n_modes), "products"]
    assert rows["Cauchy stress"][1] == "products"


def test_a_block_cannot_be_turned():
    mesh = block((0.02, 0.03, 0.1), (2, 3, 4), "hex8")
    with pytest.raises(ModelFileError, match="body of revolution"):
        with_revolution_angle(bent_tube(mesh), AXIS)


def test_an_angle_that_there_is_already_is_refused():
    with pytest.raises(ModelFileError, match="'load'"):
        with_revolution_angle(bent_tube(), AXIS, name="load")


def test_products_are_those_of_their_factors():
    """Against polynomials and cosines, mixtures too."""
    first = polynomial([[0.5, 1.0], [1.0, 0.0], [0.0, -2.0]])
    unit = np.eye(3)
    second = CPFunctions((fourier_basis(0.0, 2.0 * np.pi, 1),), (unit,), unit)
    product = ProductFunctions(first, second)
    x, a = 0.3, 0.9
    t = x - 1.0
    h, dh = np.array([0.5 + t, 1.0 - 2.0 * (2 * t**2 - 1)]), np.array([1.0, -8.0 * t])
    k, dk = np.array([1.0, np.cos(a), np.sin(a)]), np.array([0.0, -np.sin(a), np.cos(a)])
    rows = product.rows([x, a])
    np.testing.assert_allclose(rows[0], np.outer(h, k).ravel())
    np.testing.assert_allclose(rows[1], np.outer(dh, k).ravel(), atol=1e-12)
    np.testing.assert_allclose(rows[2], np.outer(h, dk).ravel())
    matrix = np.random.default_rng(0).standard_normal((6, 2))
    np.testing.assert_allclose(product.mixed(matrix).rows([x, a]), rows @ matrix)
    with pytest.raises(ValueError, match="mixed by a matrix"):
        ProductFunctions(first, CPFunctions((chebyshev_basis(0.0, 1.0, 2),), (unit,), unit), np.eye(4))


@pytest.mark.parametrize("cell", ["hex20", "prism15", "hex27"])
def test_second_order_cells_have_two_nodes_each_around(cell):
    """z² of bending along x, turned by an angle between two cells; one of the modes is zero everywhere."""
    mesh = tube(0.02, 0.024, 0.06, (2, 1, 12), cell)
    z, surface = mesh.nodes[:, 2], model_mesh_of(mesh)
    modes = np.zeros((2, mesh.n_nodes, 3))
    modes[1, :, 0] = z**2
    functions = ParameterFunctions(np.zeros(1), np.ones(1), np.array([[0], [1]]), np.eye(2))
    load = Parameter("load", "ratio", "1", 0.0, 1.0, 0.0)
    model = ReducedModel("tube", mesh.nodes, surface.triangles, (load,), SeparatedField(modes, functions))
    field = with_revolution_angle(model, AXIS).displacement
    expected = z[:, None] ** 2 * np.array([np.cos(0.7), np.sin(0.7), 0.0])
    np.testing.assert_allclose(field.value(np.array([1.0, 0.7])), expected, atol=1e-12)
