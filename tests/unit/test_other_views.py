"""What other keyframes say of a hypothesis: a wedge seen from around, with exact poses."""

from functools import cache

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from morph_dslam.geometry import RigidTransform, SimilarityTransform
from morph_dslam.registration.mesh_edges import MeshEdges
from morph_dslam.registration.other_views import LOOSE, AskedView, added_gains, gains_in
from morph_dslam.registration.scene import camera_from_object
from morph_dslam.registration.view_search import N_POINTS, N_TURNS, PER_GAIN, EdgeDrawings, InView, edge_gains
from tests.support.rendered_object import CAMERA, scanned, shaded, wedge

WORLD = SimilarityTransform(3.7, Rotation.from_rotvec([0.4, -0.9, 1.3]).as_matrix(), np.array([0.5, -1.2, 2.0]))
NODES, TRIANGLES, _ = wedge()
EDGES = MeshEdges(NODES, TRIANGLES)
CENTRE = 0.5 * (NODES.min(axis=0) + NODES.max(axis=0))


@cache  # not at import: each process of a run imports all tests, and would compile what draws
def drawings():
    return EdgeDrawings.of(EDGES)


@pytest.fixture(scope="module")
def views():
    return shaded(scanned(WORLD)[1], WORLD)


def in_view(sizes, sides, turns, places):
    return InView(
        drawings(), CENTRE, EDGES.size, CAMERA, np.zeros(len(sizes)), np.asarray(sizes, dtype=float), np.asarray(sides),
        np.asarray(turns), np.asarray(places, dtype=float),
    )  # fmt: skip


def gains_of(views, poses):
    """Mean over views of the gains of an object there, of functions from its true pose to another one."""
    total = []
    for view in views:
        there = [moved(camera_from_object(view, WORLD)) for moved in poses]
        rotations = np.array([pose.rotation for pose in there])
        middles = np.array([pose.apply(CENTRE) for pose in there])
        gains = edge_gains(view, LOOSE)
        args = drawings().rotations[:, 2], drawings().points, drawings().tangents, CAMERA.intrinsics
        total.append(added_gains(gains, rotations, middles, *args) / PER_GAIN)
    return np.mean(total, axis=0)


def test_poses_have_the_object_where_it_was_drawn():
    """Against scipy's rotations: turned about the optical axis, then by the shortest way to the sight line."""
    rng = np.random.default_rng(4)
    sides, turns = rng.integers(0, len(drawings().rotations), 20), rng.integers(0, N_TURNS, 20)
    places, sizes = rng.uniform([10.0, 10.0], [470.0, 350.0], (20, 2)), rng.uniform(40.0, 300.0, 20)
    rotations, middles = in_view(sizes, sides, turns, places).poses(np.arange(20))
    np.testing.assert_allclose(CAMERA.project(middles), places, atol=1e-9)
    np.testing.assert_allclose(EDGES.size * CAMERA.fx / middles[:, 2], sizes, rtol=1e-12)
    for rotation, middle, side, turn in zip(rotations, middles, sides, turns, strict=True):
        towards = Rotation.align_vectors([middle / np.linalg.norm(middle)], [[0.0, 0.0, 1.0]])[0]
        about = Rotation.from_euler("z", 360.0 * turn / N_TURNS, degrees=True)
        np.testing.assert_allclose(rotation, (towards * about).as_matrix() @ drawings().rotations[side], atol=1e-9)


def test_edges_are_met_where_the_object_is_and_nowhere_near(views):
    def turned(degrees):
        turn = Rotation.from_euler("y", degrees, degrees=True).as_matrix()
        return lambda pose: RigidTransform(
            turn @ pose.rotation, turn @ (pose.translation - pose.apply(CENTRE)) + pose.apply(CENTRE)
        )

    def put(x, factor):
        return lambda pose: RigidTransform(pose.rotation, factor * pose.translation + [x, 0.0, 0.0])

    true, *others = gains_of(views, [put(0.0, 1.0), turned(50.0), turned(-50.0), put(0.03, 1.0), put(0.0, 1.4)])
    assert true > 0.5 * N_POINTS
    assert max(others) < 0.5 * true


def test_behind_the_camera_and_beside_the_image_is_nothing(views):
    def put(*aside):
        return lambda pose: RigidTransform(pose.rotation, pose.translation + np.array(aside))

    behind, beside = put(0.0, 0.0, -2.0), put(2.0, 0.0, 0.0)
    np.testing.assert_array_equal(gains_of(views, [behind, beside]), 0.0)


def test_of_hypotheses_in_one_keyframe_the_others_want_the_right_unit_and_attitude(views):
    """One that is right to the steps of the search, with the true unit, and with others; and turned upside down."""
    view, others = views[3], [AskedView.of(views[k]) for k in (0, 5, 7)]
    pose = camera_from_object(view, WORLD)
    sides, turns = (x.ravel() for x in np.meshgrid(np.arange(len(drawings().rotations)), np.arange(N_TURNS)))
    (place,), size = CAMERA.project(pose.apply(CENTRE)[None]), EDGES.size * CAMERA.fx / pose.apply(CENTRE)[2]
    found = in_view(np.full(len(sides), size), sides, turns, np.tile(place, (len(sides), 1)))
    rotations, _ = found.poses(np.arange(len(sides)))
    apart = np.degrees(Rotation.from_matrix(rotations @ pose.rotation.T).magnitude())
    near, far = int(np.argmin(apart)), np.flatnonzero(apart > 60.0)
    assert apart[near] < 12.0
    rows = np.full(4, near)
    right, *wrong = gains_in(found, rows, WORLD.scale * np.array([1.0, 0.7, 1.3, 2.0]), view, others)
    assert right > 0.3 * N_POINTS * len(others)
    assert max(wrong) < 0.5 * right
    turned = gains_in(found, far, np.full(len(far), WORLD.scale), view, others)
    assert np.percentile(turned, 99) < right
