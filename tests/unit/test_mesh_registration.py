"""Registration of a mesh to a map: known places, in every unit; none, two, and turns that cannot be told."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from morph_dslam.errors import RegistrationError
from morph_dslam.geometry import SimilarityTransform
from morph_dslam.meshing.generators import tube
from morph_dslam.registration.icp import Surface, fit_surface, normal_equations, normal_equations_numpy
from morph_dslam.registration.mesh import register_mesh
from morph_dslam.registration.scene import MapPoints
from morph_dslam.registration.texture_alignment import TextureAlignment
from tests.support.rendered_object import CAMERA, scanned, wedge

WORLD = SimilarityTransform(3.7, Rotation.from_rotvec([0.4, -0.9, 1.3]).as_matrix(), np.array([0.5, -1.2, 2.0]))
#: The same in a map whose unit is the metre.
METRIC = SimilarityTransform(1.0, WORLD.rotation, WORLD.translation)


def apart(found, true, nodes):
    """Largest distance of any node between two placings of it, metres."""
    return np.linalg.norm((true.inverse @ found).apply(nodes) - nodes, axis=1).max()


def test_a_wedge_on_a_table_is_found_in_a_map_of_unknown_scale():
    nodes, triangles, _ = wedge()
    points, views = scanned(WORLD)
    found = register_mesh(nodes, triangles, points, views, CAMERA)
    assert found.world_from_object.scale == pytest.approx(WORLD.scale, rel=0.01)
    assert apart(found.world_from_object, WORLD, nodes) < 1.5e-3
    assert not found.ambiguous
    assert found.axis is None
    assert found.rms_px is None  # the views have no images here


def test_a_place_that_no_image_confirms_is_doubted():
    """The same map, with images that show something beside the object, and nothing on it."""
    nodes, triangles, _ = wedge()
    points, views = scanned(WORLD)
    rim = np.full_like(views[0].normalized, 128)
    rim[:4] = np.arange(rim.shape[1]) % 251
    found = register_mesh(nodes, triangles, points, [replace(view, normalized=rim) for view in views], CAMERA)
    assert found.rms_px is None
    assert found.runner_up < 0.8 * found.score
    assert found.ambiguous


def test_images_refine_what_the_points_leave_open():
    nodes, triangles, _ = wedge()
    _, views = scanned(WORLD, with_images=True)
    # 2 % of scale, a degree and a millimetre off
    off = SimilarityTransform(1.02, Rotation.from_rotvec([0.0, 0.018, 0.0]).as_matrix(), np.array([1e-3, 0.0, -5e-4]))
    result = TextureAlignment(nodes, triangles, CAMERA, views).refine(WORLD @ off)
    assert result is not None
    assert result.world_from_object.scale == pytest.approx(WORLD.scale, rel=1e-3)
    assert apart(result.world_from_object, WORLD, nodes) < 2e-4
    assert result.rms_px < 0.2


def test_a_metric_map_keeps_its_scale():
    nodes, triangles, _ = wedge()
    points, views = scanned(METRIC, with_images=True)
    found = register_mesh(nodes, triangles, points, views, CAMERA, metric=True)
    assert found.world_from_object.scale == 1.0
    assert apart(found.world_from_object, METRIC, nodes) < 5e-4


def test_two_of_a_kind_are_ambiguous():
    nodes, triangles, _ = wedge()
    points, views = scanned(METRIC, objects=(np.array([-0.08, 0.0, 0.0]), np.array([0.08, 0.03, 0.0])))
    # Of a metric map one size is searched, not three: that takes a third of the time.
    assert register_mesh(nodes, triangles, points, views, CAMERA, metric=True).ambiguous


def test_an_absent_object_is_not_found():
    nodes, triangles, _ = wedge()
    points, views = scanned(WORLD, objects=())
    with pytest.raises(RegistrationError, match="not found in the map"):
        register_mesh(nodes, triangles, points, views, CAMERA)


def test_a_tube_may_be_turned_about_its_axis_and_a_wedge_may_not():
    mesh = tube(0.03, 0.04, 0.1, (1, 40, 10))
    surface = Surface.of_mesh(mesh.nodes, mesh.surface_triangles())
    axis = surface.axis_of_revolution
    assert axis is not None
    assert abs(axis.direction[2]) > 0.999
    np.testing.assert_allclose(axis.point[:2], 0.0, atol=1e-3)
    nodes, triangles, _ = wedge()
    assert Surface.of_mesh(nodes, triangles).axis_of_revolution is None


@pytest.mark.parametrize("to_planes", [True, False])
def test_compiled_and_plain_normal_equations_agree(to_planes):
    rng = np.random.default_rng(2)
    gaps, arms, normals = rng.normal(size=(3, 200, 3))
    found = normal_equations(gaps, arms, normals, 1.5, to_planes)
    plain = normal_equations_numpy(gaps, arms, normals, 1.5, to_planes)
    assert 20 < np.count_nonzero(plain[2]) < 180
    for a, b in zip(found, plain, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-10, atol=1e-12)


def test_exact_points_lead_back_from_a_disturbed_place():
    nodes, triangles, _ = wedge()
    surface = Surface.of_mesh(nodes, triangles)
    some = surface.points[::20]
    outside = some + surface.normals[::20]
    points = MapPoints(WORLD.apply(some), WORLD.apply(outside))
    start = WORLD @ SimilarityTransform(0.95, Rotation.from_rotvec([0.1, 0.05, -0.08]).as_matrix(), np.full(3, 2e-3))
    widths = WORLD.scale * surface.size * np.array([0.2] * 5 + [0.1] * 10 + [0.03] * 15)
    fit = fit_surface(points, surface, start, widths)
    assert apart(fit.world_from_object, WORLD, nodes) < 1e-6
    np.testing.assert_allclose(fit.weights, 1.0, atol=1e-6)
