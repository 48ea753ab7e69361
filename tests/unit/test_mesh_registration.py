"""Registration of a mesh in a map: known places, in every unit; none, two, turns, and where the search starts."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from morph_dslam.errors import RegistrationError, RegistrationFailure
from morph_dslam.geometry import SimilarityTransform
from morph_dslam.io.trajectory import Trajectory
from morph_dslam.meshing.generators import tube
from morph_dslam.registration.edges import Sighting
from morph_dslam.registration.hints import Hints
from morph_dslam.registration.icp import Surface, fit_surface
from morph_dslam.registration.mesh import MeshRegistration, register_in_unit, register_mesh
from morph_dslam.registration.messages import Ambiguity, Ambiguous, OtherSize, OutlineElsewhere, TooLittleTexture
from morph_dslam.registration.register import register
from morph_dslam.registration.registration import Axis, Rival
from morph_dslam.registration.scene import MapPoints, View, camera_from_object
from morph_dslam.registration.search_space import TURNS, attitudes, find_planes
from morph_dslam.registration.texture import TextureComparison
from morph_dslam.render.rasteriser import rasterise
from morph_dslam.render.texture import render_textured
from morph_dslam.slam.rigid_map import GOOD, Keyframe, RigidMap
from morph_dslam.slam.scene import Scene
from morph_dslam.tracking.patches import normalize_contrast
from tests.support.bent_sheet import bent_sheet_model, grid_triangles
from tests.support.rendered_object import CAMERA, cameras, scanned, wedge
from tests.support.rendered_sequence import printed_texture
from tests.support.staged_scenes import bending_wedge
from tests.unit.test_keyframe_adjustment import corner, seen_corner

WORLD = SimilarityTransform(3.7, Rotation.from_rotvec([0.4, -0.9, 1.3]).as_matrix(), np.array([0.5, -1.2, 2.0]))
#: The same in a map whose unit is the metre.
METRIC = SimilarityTransform(1.0, WORLD.rotation, WORLD.translation)


def apart(found, true, nodes):
    """Largest distance of any node between two placings of it, metres."""
    return np.linalg.norm((true.inverse @ found).apply(nodes) - nodes, axis=1).max()


@pytest.mark.slow
def test_a_wedge_on_a_table_is_found_in_a_map_of_unknown_scale():
    nodes, triangles, _ = wedge()
    points, views = scanned(WORLD)
    found = register_mesh(nodes, triangles, points, views, CAMERA)
    assert found.world_from_object.scale == pytest.approx(WORLD.scale, rel=0.01)
    assert apart(found.world_from_object, WORLD, nodes) < 1.5e-3
    assert not found.ambiguous
    assert found.axis is None
    assert found.rms_px is None  # the views have no images here


@pytest.mark.slow
def test_a_place_that_no_image_confirms_is_doubted():
    """The same map, with images that show something beside the object, and nothing on it."""
    nodes, triangles, _ = wedge()
    points, views = scanned(WORLD)
    rim = np.full_like(views[0].normalized, 128)
    rim[:4] = np.arange(rim.shape[1]) % 251
    found = register_mesh(nodes, triangles, points, [replace(view, normalized=rim) for view in views], CAMERA)
    assert found.runner_up < 0.8 * found.score
    assert found.warnings == (Ambiguous(Ambiguity.UNCONFIRMED), TooLittleTexture())


def test_images_refine_what_the_points_leave_open():
    nodes, triangles, _ = wedge()
    _, views = scanned(WORLD, with_images=True)
    # 2 % of scale, a degree and a millimetre off
    off = SimilarityTransform(1.02, Rotation.from_rotvec([0.0, 0.018, 0.0]).as_matrix(), np.array([1e-3, 0.0, -5e-4]))
    found = TextureComparison(nodes, triangles, CAMERA).refine(WORLD @ off, views)
    assert found.place.scale == pytest.approx(WORLD.scale, rel=1e-3)
    assert apart(found.place, WORLD, nodes) < 2e-4
    assert found.rms_px < 0.2


@pytest.mark.parametrize("height", [0.0, 0.02])
def test_images_show_the_shape_of_an_arch_and_none_of_a_plate(height):
    across, along = (x.ravel() for x in np.meshgrid(np.linspace(0.0, 1.0, 21), np.linspace(0.0, 1.0, 21)))
    nodes = np.column_stack([0.09 * across, 0.06 * along, 4.0 * height * across * (1.0 - across)])
    triangles, coordinates = grid_triangles(21, 21), 20.0 + 200.0 * np.column_stack([across, along])
    texture = normalize_contrast(printed_texture(400, 520, 0), 31)
    views = []
    for number, pose in enumerate(cameras()):
        local = pose.apply(nodes)
        drawn = rasterise(CAMERA.project(local), local[:, 2], triangles, CAMERA.height, CAMERA.width)
        image = np.where(drawn.covered, render_textured(drawn, triangles, coordinates, texture), np.uint8(128))
        views.append(View(number, image.astype(np.uint8), pose, np.zeros(0, np.int64), np.zeros((0, 2))))
    still = SimilarityTransform(1.0, np.eye(3), np.zeros(3))
    found = TextureComparison(nodes, triangles, CAMERA).refine(still, views, scale_std=1e-6)
    assert found.share > 0.9
    assert found.rms_px < 0.1
    assert found.shows_its_shape == (height > 0.0)
    # The nearest plane is 6 mm off an arch in the mean; seen 13 to 35 degrees aside, at 1.3 pixels a millimetre.
    assert found.relief_px == pytest.approx(0.0 if height == 0.0 else 3.0, abs=1e-6 if height == 0.0 else 2.0)


@pytest.mark.slow
@pytest.mark.parametrize("off", [0.0, 0.015, 0.045])
def test_an_error_of_a_metric_maps_scale_does_not_move_the_object(off):
    world = SimilarityTransform(1.0 + off, METRIC.rotation, METRIC.translation)
    points, views = scanned(world, with_images=True)
    rigid_map = RigidMap(baseline_px=40.0)
    rigid_map.add_points(points.positions, np.zeros((len(points), 2)), 0, GOOD)
    rng, views = np.random.default_rng(2), views[1::2]  # enough, the last one among them
    views = [replace(view, pixels=view.pixels + rng.normal(0.0, 0.3, view.pixels.shape)) for view in views]
    for view in views:
        pose = view.camera_from_world.matrix
        rigid_map.add_keyframe(Keyframe(view.frame, 0.0, view.normalized, pose, view.point_ids, view.pixels))
    model = bending_wedge()
    found = register(Scene(CAMERA, rigid_map, Trajectory(np.zeros(0), np.zeros((0, 4, 4)))), model)
    scale = found.map_registration.world_from_object.scale
    # Three standard deviations.
    assert found.warnings == ((OtherSize(scale),) if off > 0.03 else ())
    assert [view.frame for view in found.keyframes] == [view.frame for view in views]
    assert len(found.views) == len(views)
    assert scale == pytest.approx(1.0 + off, abs=0.007)
    # Were the scale of the map believed, it would be 4.8 mm away with an error of 1.5 %.
    misses = found.state.camera_from_object.apply(model.nodes) - cameras()[-1].apply(model.nodes)
    assert np.linalg.norm(misses, axis=1).max() < 2.5e-3
    ahead = cameras()[-1].apply(model.nodes).mean(axis=0)
    towards = np.concatenate([np.zeros(3), ahead / np.linalg.norm(ahead)])
    spread = found.map_registration.pose_covariance(cameras()[-1])
    assert abs(misses.mean(axis=0) @ towards[3:]) < 2.6 * np.sqrt(towards @ spread @ towards)


@pytest.mark.slow
def test_the_unit_of_a_metric_map_gives_that_of_the_mesh():
    nodes, triangles, _ = wedge()
    with pytest.raises(RegistrationError, match=r"0\.039\d*") as caught:
        register_in_unit(25.4 * nodes, triangles, *scanned(METRIC, with_images=True), CAMERA, metric=True)
    assert caught.value.reason is RegistrationFailure.WRONG_SIZE


@pytest.mark.slow
@pytest.mark.parametrize("stretch", [1.0, 1.1])
def test_a_mesh_that_is_drawn_out_is_accused_by_its_outline(stretch):
    """Its faces lie on those of the object in another size, where the images of them agree."""
    nodes, triangles, _ = wedge()
    points, views = scanned(WORLD, with_images=True)
    found = register_mesh(nodes * [stretch, 1.0, 1.0], triangles, points, views, CAMERA)
    right = abs(found.world_from_object.scale / 3.7 - 1.0) < 0.01
    assert right == (stretch == 1.0)
    assert any(isinstance(warning, OutlineElsewhere) for warning in found.warnings) == (not right)


@pytest.mark.slow
def test_what_a_metric_map_says_of_the_scale_counts_once():
    """Independent pieces of information add up: without it and with it they differ by that of its deviation of 1 %."""
    nodes, triangles, _ = corner()
    points, views = seen_corner(METRIC)
    rows = np.linspace(0, len(nodes) - 1, 7).astype(int)
    pixels = CAMERA.project(camera_from_object(views[0], METRIC).apply(nodes[rows]))
    hints = Hints((Sighting(views[0].frame, views[0].camera_from_world, nodes[rows], pixels),))
    known, free = (
        register_mesh(nodes, triangles, points, views, CAMERA, metric=metric, hints=hints) for metric in (True, False)
    )
    added = 1.0 / known.covariance[0, 0] - 1.0 / free.covariance[0, 0]
    assert added == pytest.approx(0.01**-2, rel=0.2)


@pytest.mark.slow
def test_two_of_a_kind_are_ambiguous():
    nodes, triangles, _ = wedge()
    shifts = np.array([[-0.08, 0.0, 0.0], [0.08, 0.03, 0.0]])
    points, views = scanned(METRIC, objects=tuple(shifts))
    # Of a metric map one size is searched, not three: that takes a third of the time.
    found = register_mesh(nodes, triangles, points, views, CAMERA, metric=True)
    assert found.warnings == (Ambiguous(Ambiguity.SECOND_PLACE, found.runner_up / found.score), TooLittleTexture())
    both = [METRIC @ SimilarityTransform(1.0, np.eye(3), shift) for shift in shifts]
    there = [found.world_from_object, found.rivals[0].world_from_object]
    off = np.array([[apart(place, true, nodes) for true in both] for place in there])
    assert sorted(off.argmin(axis=1)) == [0, 1]
    assert off.min(axis=1).max() < 5e-3


@pytest.mark.parametrize(
    ("score", "rivals", "share"), [(50.0, (41.0,), 0.82), (50.0, (39.0,), None), (-0.2, (), None), (-0.2, (30.0,), 1.0)]
)
def test_a_place_is_ambiguous_by_another_one_alone(score, rivals, share):
    found = MeshRegistration(
        WORLD, None, score, tuple(Rival(METRIC, each) for each in rivals), n_explained=0, rms_px=0.1, axis=None
    )
    assert found.warnings == (() if share is None else (Ambiguous(Ambiguity.SECOND_PLACE, share),))


@pytest.mark.slow
def test_an_absent_object_is_not_found():
    nodes, triangles, _ = wedge()
    points, views = scanned(WORLD, objects=())
    with pytest.raises(RegistrationError) as caught:
        register_mesh(nodes, triangles, points, views, CAMERA)
    assert caught.value.reason is RegistrationFailure.NOT_FOUND


def test_a_tube_may_be_turned_about_its_axis_and_a_wedge_may_not():
    mesh = tube(0.03, 0.04, 0.1, (1, 40, 10))
    surface = Surface.of_mesh(mesh.nodes, mesh.surface_triangles())
    axis = surface.axis_of_revolution
    assert axis is not None
    assert abs(axis.direction[2]) > 0.999
    np.testing.assert_allclose(axis.point[:2], 0.0, atol=1e-3)
    nodes, triangles, _ = wedge()
    assert Surface.of_mesh(nodes, triangles).axis_of_revolution is None


def test_a_disc_may_be_turned_about_its_axis_and_a_rectangle_may_not():
    """Both lie in their plane however they are turned."""
    rectangle = bent_sheet_model(9, 7)
    assert Surface.of_mesh(rectangle.nodes, rectangle.triangles).axis_of_revolution is None
    angles = np.linspace(0.0, 2.0 * np.pi, 61)[:-1]
    nodes = np.vstack([np.zeros(3), np.column_stack([np.cos(angles), np.sin(angles), np.zeros(60)])])
    rim = np.arange(60)
    axis = Surface.of_mesh(0.1 * nodes, np.column_stack([0 * rim, rim + 1, (rim + 1) % 60 + 1])).axis_of_revolution
    assert axis is not None
    assert abs(axis.direction[2]) > 0.999


def test_exact_points_lead_back_from_a_disturbed_place():
    nodes, triangles, _ = wedge()
    surface = Surface.of_mesh(nodes, triangles)
    some = surface.points[::20]
    outside = some + surface.normals[::20]
    points = MapPoints(WORLD.apply(some), WORLD.apply(outside))
    start = WORLD @ SimilarityTransform(0.95, Rotation.from_rotvec([0.1, 0.05, -0.08]).as_matrix(), np.full(3, 2e-3))
    widths = WORLD.scale * surface.size * np.array([0.2] * 5 + [0.1] * 10 + [0.03] * 15)
    found, weights = fit_surface(points, surface, start, widths)
    assert apart(found, WORLD, nodes) < 1e-6
    np.testing.assert_allclose(weights, 1.0, atol=1e-6)


NORMAL = np.array([2.0, -3.0, 6.0]) / 7.0


def test_body_stands_on_each_of_its_six_sides_in_all_turns():
    rotations = attitudes(None, NORMAL)
    for side in (*np.eye(3), *-np.eye(3)):
        upright = [rotation for rotation in rotations if np.allclose(rotation @ side, NORMAL, atol=1e-9)]
        assert len(upright) >= TURNS
        relative = [np.trace(upright[0].T @ other) for other in upright[:TURNS]]
        turns = 1.0 + 2.0 * np.cos(2.0 * np.pi * np.arange(TURNS) / TURNS)
        np.testing.assert_allclose(np.sort(relative), np.sort(turns), atol=1e-9)
    for rotation in rotations:
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(rotation) == pytest.approx(1.0)


def test_axis_of_revolution_stands_upright_either_way_and_points_everywhere_once():
    axis = Axis(np.zeros(3), np.array([0.0, 0.6, 0.8]))
    directions = np.array([rotation @ axis.direction for rotation in attitudes(axis, NORMAL)])
    for sign in (1.0, -1.0):
        assert np.linalg.norm(directions - sign * NORMAL, axis=1).min() < 1e-9
    between = np.linalg.norm(directions[:, None] - directions[None], axis=2)
    assert between[~np.eye(len(between), dtype=bool)].min() > 0.09
    everywhere = np.random.default_rng(0).normal(size=(500, 3))
    everywhere /= np.linalg.norm(everywhere, axis=1)[:, None]
    nearest = np.linalg.norm(everywhere[:, None] - directions[None], axis=2).min(axis=1)
    assert np.degrees(2.0 * np.arcsin(nearest.max() / 2.0)) < 40.0


def test_largest_plane_is_found_among_clutter_and_none_where_there_is_none():
    rng = np.random.default_rng(1)
    basis = np.linalg.svd(NORMAL[None])[2][1:]
    table = rng.uniform(-1.0, 1.0, (400, 2)) @ basis + 0.002 * rng.normal(size=(400, 1)) * NORMAL
    clutter = rng.uniform(-1.0, 1.0, (150, 3))
    points = np.concatenate([table, clutter])
    planes = find_planes(points)
    found = planes.largest_normal(points)
    assert found is not None
    assert abs(found @ NORMAL) > np.cos(np.radians(1.0))
    # What is taken out is the table, and of the clutter only what lies in it.
    assert np.mean(np.isin(np.arange(400), planes.taken_out[0])) > 0.95
    assert np.all(np.abs(points[planes.taken_out[0]] @ NORMAL) < 0.05)
    cloud = rng.normal(size=(400, 3))
    assert find_planes(cloud).largest_normal(cloud) is None
