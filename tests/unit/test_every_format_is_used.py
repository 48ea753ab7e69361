"""Exports, the page in the browser and the estimator with every format, against a block's closed form."""

from __future__ import annotations

from dataclasses import replace

import meshio
import numpy as np
import pygltflib
import pytest

from morph_dslam.camera import Camera
from morph_dslam.explore.server import ModelSurface
from morph_dslam.export import StateChoice, export
from morph_dslam.geometry import RigidTransform, rotation_exp
from morph_dslam.model import SeparatedField, SurfacePoints, load_model, save_model
from morph_dslam.model.basis_functions import cubic_spline_basis
from morph_dslam.model.separated import ComponentModes
from morph_dslam.model.tensor_functions import CPFunctions, TensorTrainFunctions, TuckerFunctions
from morph_dslam.tracking.estimator import BoundPoints, Estimator, State, moved
from tests.support.stretched_block import PARAMETERS, SIZE, YOUNG_MODULUS, stretched_block_model


def linear_functions(form: str):
    """H_1 = stretch and H_2 = slide, with cubic splines, which hold straight lines exactly."""
    nodes = [np.linspace(p.lower, p.upper, 5) for p in PARAMETERS]
    bases = tuple(cubic_spline_basis(x) for x in nodes)
    (one, first), (unit, second) = (
        (b.interpolate(x, np.ones(5)), b.interpolate(x, x)) for b, x in zip(bases, nodes, strict=True)
    )
    if form == "cp":
        return CPFunctions(bases, (np.column_stack([first, one]), np.column_stack([unit, second])), np.eye(2))
    if form == "tucker":
        core = np.zeros((2, 2, 2))
        core[0, 1, 0] = core[1, 0, 1] = 1.0
        return TuckerFunctions(bases, (np.column_stack([one, first]), np.column_stack([unit, second])), core)
    start, end = np.zeros((2, 5, 2)), np.zeros((2, 5, 1))
    start[0, :, 0], start[1, :, 1], end[0, :, 0], end[1, :, 0] = first, one, unit, second
    return TensorTrainFunctions(bases, (start, end))


@pytest.fixture(scope="module", params=["cp", "tucker", "tensor_train", "by_component"])
def path(request, tmp_path_factory):
    """The stretched block, in a file, with all its fields in the format."""
    model = stretched_block_model()
    functions = linear_functions("tucker" if request.param == "by_component" else request.param)
    modes = model.displacement.modes
    displacement = SeparatedField(modes, functions)
    if request.param == "by_component":  # both modes are along x
        compact = ComponentModes(modes[:, :, 0], np.array([0, 0]), 3)
        displacement = SeparatedField.from_compact(compact, functions)
    found = replace(
        model,
        displacement=displacement,
        stresses={"solid": SeparatedField(model.stresses["solid"].modes, functions)},
        strain=SeparatedField(model.strain.modes, functions),
    )
    path = tmp_path_factory.mktemp("formats") / "block.morph"
    save_model(path, found)
    return path


STATE, MU = ["stretch=0.1:0.1:1", "slide=5:5:1"], np.array([0.1, 0.005])


def displacement_at(points):
    result = np.zeros_like(points)
    result[:, 0] = 0.1 * points[:, 0] + 0.005 * points[:, 2] / SIZE[2]
    return result


def test_exports_hold_the_closed_form(path, tmp_path):
    export(path, tmp_path, "vtu", StateChoice(vary=STATE))
    mesh = meshio.read(tmp_path / "block_0000.vtu")
    np.testing.assert_allclose(mesh.point_data["displacement"], displacement_at(mesh.points), atol=1e-8)
    np.testing.assert_allclose(mesh.point_data["stress"][:, 0], 0.1 * YOUNG_MODULUS, rtol=1e-6)
    np.testing.assert_allclose(mesh.point_data["strain"][:, 0], 0.1, rtol=1e-6)


def test_morph_targets_move_as_the_closed_form(path, tmp_path):
    document = pygltflib.GLTF2().load(export(path, tmp_path, "gltf", StateChoice(vary=STATE)))
    blob, (primitive,) = document.binary_blob(), document.meshes[0].primitives

    def array(index):
        view = document.bufferViews[document.accessors[index].bufferView]
        return np.frombuffer(blob[view.byteOffset : view.byteOffset + view.byteLength], "<f4").reshape(-1, 3)

    targets = np.array([array(target["POSITION"]) for target in primitive.targets])
    rest = array(primitive.attributes.POSITION).astype(float)
    moved_by = np.tensordot(document.meshes[0].weights, targets, axes=1)
    np.testing.assert_allclose(moved_by, displacement_at(rest), atol=1e-8)


def test_the_page_in_the_browser_shows_the_closed_form(path):
    surface = ModelSurface(load_model(path))
    expected = 1e3 * np.linalg.norm(displacement_at(surface.nodes), axis=1)
    np.testing.assert_allclose(surface.values(MU, "displacement"), expected, atol=1e-5)


def test_parameters_are_estimated_from_pixels(path):
    model, camera = load_model(path), Camera(640, 480, 528.0, 528.0, 320.0, 240.0)
    rng = np.random.default_rng(0)
    surface = SurfacePoints(rng.integers(len(model.triangles), size=80), rng.dirichlet(np.ones(3), 80))
    points = BoundPoints.from_surface(model, surface)
    pose = RigidTransform(rotation_exp(np.array([0.4, -0.5, 0.1])), np.array([-0.04, -0.02, 0.3]))
    pixels = camera.project(pose.apply(points.rest + displacement_at(points.rest)))
    start = moved(State(MU, pose), np.array([-0.1, -0.003, 0.02, 0.02, 0.02, 0.005, 0.005, 0.01]))
    found = Estimator(model, camera).estimate(points, pixels, np.ones(80), start)
    np.testing.assert_allclose(found.state.parameters, MU, rtol=1e-4)
