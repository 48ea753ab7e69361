"""Points by stereo of keyframes, and what they say of a place, on a rendered wedge whose surface is known."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from morph_dslam.geometry import SimilarityTransform
from morph_dslam.registration.dense_points import PointsOnSurface, with_dense_points
from morph_dslam.registration.icp import Surface
from morph_dslam.registration.point_evidence import gather_evidence
from morph_dslam.registration.search_space import on_large_planes
from tests.support.rendered_object import CAMERA, scanned, wedge

WORLD = SimilarityTransform(3.7, Rotation.from_rotvec([0.4, -0.9, 1.3]).as_matrix(), np.array([0.5, -1.2, 2.0]))
NODES, TRIANGLES, _ = wedge()


@pytest.fixture(scope="module")
def richer():
    """The map's points and its keyframes, without and with those of stereo."""
    points, views = scanned(WORLD, with_images=True)
    return points, *with_dense_points(points, views, views, CAMERA)


def test_points_by_stereo_lie_on_the_surface(richer):
    sparse, dense, views = richer
    new = dense.positions[len(sparse) :]
    assert len(new) > 1000
    surface = Surface.of_mesh(NODES, TRIANGLES, 20000)
    local = WORLD.inverse.apply(new)
    off = np.linalg.norm(
        local - surface.points[surface.nearest(local, WORLD.inverse.apply(dense.viewpoints[len(sparse) :]))], axis=1
    )
    depth = np.median(np.linalg.norm(new - dense.viewpoints[len(sparse) :], axis=1)) / WORLD.scale
    assert np.median(off) < 0.005 * depth
    assert np.mean(off < 0.02 * depth) > 0.9
    # Every keyframe sees its points where they are.
    for view in views:
        rows = view.point_ids >= len(sparse)
        seen = CAMERA.project(view.camera_from_world.apply(dense.positions[view.point_ids[rows]]))
        np.testing.assert_allclose(seen, view.pixels[rows], atol=1e-6)


def test_agreement_tells_the_place_from_one_beside_it(richer):
    _, dense, views = richer

    def agreement(place):
        found = gather_evidence(place, NODES, TRIANGLES, dense.positions, views, CAMERA, 0.015 * 3.7 * 0.13, 0.01)
        return found.agreement

    assert agreement(WORLD) > 0.6
    for step in ([0.03, 0.0, 0.0], [0.0, 0.0, 0.03], [0.0, -0.03, 0.0]):
        assert agreement(WORLD @ SimilarityTransform(1.0, np.eye(3), np.array(step))) < 0.5 * agreement(WORLD)


def test_points_move_a_place_onto_them(richer):
    """Gauss-Newton's step by points alone undoes a small shift, but along the faces."""
    _, dense, views = richer
    surface = Surface.of_mesh(NODES, TRIANGLES)
    centre = NODES.mean(axis=0)
    off = WORLD @ SimilarityTransform(1.0, np.eye(3), np.array([0.0, 0.0, 2e-3]))
    matrix, right = PointsOnSurface(dense, surface, len(views)).near(off).equations(off, centre, 3.0)
    step = np.linalg.solve(matrix[4:, 4:], right[4:])
    wanted = WORLD.apply(centre) - off.apply(centre)
    np.testing.assert_allclose(step, wanted, atol=0.25 * float(np.linalg.norm(wanted)))


def test_measured_depth_takes_the_place_of_stereo():
    """Images without contrast have no stereo; the points are where the depth says."""
    points, views = scanned(SimilarityTransform.identity())
    rng = np.random.default_rng(0)
    pixels = rng.uniform([0.0, 0.0], [CAMERA.width - 1.0, CAMERA.height - 1.0], (50, 2)).astype(np.float32)
    depths = rng.uniform(0.3, 0.6, 50).astype(np.float32)
    measuring = replace(views[0], depths=np.column_stack([pixels, depths]))
    dense, (richer,) = with_dense_points(points, [measuring, *views[1:]], [measuring], CAMERA)
    local = measuring.camera_from_world.apply(dense.positions[richer.point_ids[len(views[0].point_ids) :]])
    np.testing.assert_allclose(CAMERA.project(local), pixels, atol=1e-3)
    np.testing.assert_allclose(local[:, 2], depths, atol=1e-6)


def test_points_of_a_large_plane_are_told_from_those_above_it():
    rng = np.random.default_rng(0)
    table = np.column_stack([rng.uniform(-1.0, 1.0, (400, 2)), rng.normal(0.0, 1e-3, 400)])
    above = np.column_stack([rng.uniform(-0.1, 0.1, (60, 2)), rng.uniform(0.02, 0.2, 60)])
    on_plane = on_large_planes(np.concatenate([table, above]), 5e-3)
    assert on_plane[:400].mean() > 0.99
    assert not on_plane[400:].any()
