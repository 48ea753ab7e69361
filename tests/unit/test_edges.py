"""An object laid by its edges: from near, by landmarks, a guess or a rough distance; and none where nothing is seen."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from morph_dslam.camera import Camera
from morph_dslam.errors import RegistrationError, RegistrationFailure
from morph_dslam.geometry import RigidTransform, SimilarityTransform
from morph_dslam.io.landmarks import Landmarks, load_landmarks, save_landmarks
from morph_dslam.registration.edges import EdgeImages, Sighting
from morph_dslam.registration.hints import GuessedPose, Hints
from morph_dslam.registration.mesh_edges import MeshEdges
from morph_dslam.registration.scene import View, camera_from_object
from morph_dslam.registration.view_registration import EdgeSearch
from morph_dslam.tracking.patches import normalize_contrast
from tests.support.rendered_object import CAMERA, scanned, shaded, wedge

WORLD = SimilarityTransform(3.7, Rotation.from_rotvec([0.4, -0.9, 1.3]).as_matrix(), np.array([0.5, -1.2, 2.0]))
NODES, TRIANGLES, _ = wedge()
#: Three corners of the wedge, metres.
CORNERS = np.array([[0.01, 0.05, 0.07], [0.05, 0.05, 0.045], [0.09, 0.0, 0.0]])


def apart(found, true):
    """Largest distance of any node between two placings, metres."""
    return np.linalg.norm((true.inverse @ found).apply(NODES) - NODES, axis=1).max()


def scaled(scan, scale):
    """Points and views of a map in which the object has another scale, and where the object is in it."""
    points, views = scan
    ratio = scale / WORLD.scale

    def moved(pose):
        return RigidTransform(pose.rotation, pose.translation * ratio)

    points = replace(points, positions=points.positions * ratio, viewpoints=points.viewpoints * ratio)
    views = [replace(view, camera_from_world=moved(view.camera_from_world)) for view in views]
    return points, views, SimilarityTransform(scale, WORLD.rotation, WORLD.translation * ratio)


@pytest.fixture(scope="module")
def scan():
    """A wedge whose faces have a grey each, before a grey table, with a little noise."""
    points, views = scanned(WORLD)
    return points, shaded(views, WORLD)


def test_edges_lay_an_object_from_near(scan):
    _, views = scan
    off = SimilarityTransform(1.02, Rotation.from_rotvec([0.0, 0.02, 0.01]).as_matrix(), np.array([1e-3, -1e-3, 5e-4]))
    images, edges = EdgeImages(views, CAMERA), MeshEdges(NODES, TRIANGLES)
    found, covariance = images.refine(edges, WORLD @ off)
    assert apart(found, WORLD) < 1e-3
    assert found.scale == pytest.approx(WORLD.scale, rel=0.01)
    assert np.linalg.eigvalsh(covariance).min() > 0.0
    assert images.evidence(edges, found).gain > 0.8
    beside = SimilarityTransform(1.0, np.eye(3), np.array([0.02, 0.0, 0.0]))
    assert images.evidence(edges, WORLD @ beside).gain < 0.5


#: A cube of 85 mm: corners, metres, and its faces as quadrilaterals seen from outside.
CUBE = 0.0425 * np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
FACES = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])
DESK_CAMERA = Camera(640, 480, 607.2, 607.2, 321.4, 241.9)


def painted(corners, greys, background, finer=16):
    """An image (h, w) of convex faces, by OpenCV's polygons in pixels ``finer`` times finer, and their means."""
    big = np.full((480 * finer, 640 * finer), background, np.uint8)
    for corner, grey in zip(corners, greys, strict=True):
        # A pixel's centre is at whole numbers, and it reaches half a pixel to all sides.
        cv2.fillPoly(big, [np.rint(256 * ((corner + 0.5) * finer - 0.5)).astype(np.int32)], grey, shift=8)
    image = cv2.resize(big, (640, 480), interpolation=cv2.INTER_AREA).astype(float)
    return cv2.GaussianBlur(image, (0, 0), 0.7)


def test_depth_by_edges_is_unbiased():
    """A cube as large as on a real desk, painted by OpenCV: half a pixel at its outline would be 1 % of its depth."""
    rng = np.random.default_rng(0)
    sides = np.concatenate([FACES[:, :3], FACES[:, [0, 2, 3]]])
    edges, misses = MeshEdges(CUBE, sides), []
    about = np.array([[-0.569, -0.821, 0.043], [-0.051, -0.018, -0.999], [0.821, -0.570, -0.032]])
    about = Rotation.from_matrix(about)
    for background in (60, 140, 220) * 4:
        turn = Rotation.from_rotvec(rng.normal(0.0, 0.2, 3)) * about
        place = np.array([*rng.uniform(-0.06, 0.06, 2), rng.uniform(0.4, 0.6)])
        local = turn.apply(CUBE) + place
        normals = np.cross(local[FACES[:, 1]] - local[FACES[:, 0]], local[FACES[:, 2]] - local[FACES[:, 0]])
        facing = np.einsum("fx,fx->f", normals, local[FACES[:, 0]]) < 0.0
        greys = rng.permutation([20, 90, 115, 165, 185, 245])[facing].tolist()
        image = painted(DESK_CAMERA.project(local)[FACES[facing]], greys, background) + rng.normal(0.0, 1.0, (480, 640))
        eye = RigidTransform(np.eye(3), np.zeros(3))
        grey = normalize_contrast(image.round().clip(0, 255).astype(np.uint8))
        view = View(0, grey, eye, np.empty(0, np.int64), np.empty((0, 2)))
        start = SimilarityTransform(1.0, turn.as_matrix(), place + rng.normal(0.0, 2e-3, 3))
        found, _ = EdgeImages([view], DESK_CAMERA).refine(edges, start, keep_scale=True)
        misses.append((found.translation - place) / place[2])
    assert np.abs(np.mean(misses, axis=0)).max() < 5e-4


def test_three_landmarks_in_one_frame_place_an_object_and_give_the_unit(scan):
    points, views = scan
    pixels = CAMERA.project(camera_from_object(views[2], WORLD).apply(CORNERS))
    clicks = Sighting(
        views[2].frame, views[2].camera_from_world, CORNERS, pixels + np.array([[1.5, -1], [-1.5, 1], [0.5, 1.5]])
    )
    best = EdgeSearch(NODES, TRIANGLES, points, views, CAMERA, False, Hints(clicks=(clicks,))).search()[0]
    assert apart(best.place, WORLD) < 1.5e-3
    assert best.place.scale == pytest.approx(WORLD.scale, rel=0.01)


@pytest.mark.slow
@pytest.mark.parametrize("scale", [0.985, 1.015])
def test_a_metric_maps_error_of_scale_is_not_one_of_distance(scan, scale):
    points, views, world = scaled(scan, scale)
    pixels = CAMERA.project(camera_from_object(views[2], world).apply(CORNERS))
    pixels = pixels + np.random.default_rng(1).normal(0.0, 1.0, pixels.shape)
    hints = Hints(clicks=(Sighting(views[2].frame, views[2].camera_from_world, CORNERS, pixels),))
    best = EdgeSearch(NODES, TRIANGLES, points, views, CAMERA, True, hints).search()[0]
    found, true = (camera_from_object(views[2], place).translation for place in (best.place, world))
    # Were the scale of the map believed, the object would be off by 1.5 % of its distance.
    assert abs(found[2] / true[2] - 1.0) < 0.005
    assert abs(np.log(best.place.scale / scale)) < 2.6 * np.sqrt(best.covariance[0, 0])
    assert np.sqrt(best.covariance[0, 0]) < 0.01


@pytest.mark.slow
@pytest.mark.parametrize("scale", [0.2, 1.0, 3.7])
def test_landmarks_in_a_frame_that_is_no_keyframe_place_an_object_in_a_map_of_any_unit(scan, scale):
    """The unit says where the points, which another view sees, lie beside the frame of the landmarks."""
    points, views, world = scaled(scan, scale)
    pixels = CAMERA.project(camera_from_object(views[0], world).apply(CORNERS))
    pixels = pixels + np.random.default_rng(1).normal(0.0, 1.0, pixels.shape)
    hints = Hints(clicks=(Sighting(-1, views[0].camera_from_world, CORNERS, pixels),))
    found = EdgeSearch(NODES, TRIANGLES, points, views[3:], CAMERA, False, hints).search()
    assert apart(found[0].place, world) < 2e-3
    assert found[0].place.scale == pytest.approx(scale, rel=0.02)


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (1, 2, 3))])
def test_a_guess_within_30_pixels_places_an_object_and_gives_the_unit(scan, seed):
    points, views = scan
    true, rng = camera_from_object(views[2], WORLD), np.random.default_rng(seed)
    aside = rng.normal(size=2)
    aside *= 24.0 * true.translation[2] / CAMERA.fx / np.linalg.norm(aside)
    turn = rng.normal(size=3)
    turned = Rotation.from_rotvec(np.radians(8.0) * turn / np.linalg.norm(turn)).as_matrix() @ true.rotation
    off = RigidTransform(turned, rng.choice([0.92, 1.08]) * (true.translation + np.append(aside, 0.0)))
    moved = np.linalg.norm(CAMERA.project(off.apply(NODES)) - CAMERA.project(true.apply(NODES)), axis=1)
    assert 20.0 < moved.max() < 50.0
    guess = GuessedPose(views[2].frame, views[2].camera_from_world, off)
    best = EdgeSearch(NODES, TRIANGLES, points, views, CAMERA, False, Hints(guess=guess)).search()[0]
    assert apart(best.place, WORLD) < 1.5e-3
    assert best.place.scale == pytest.approx(WORLD.scale, rel=0.01)


def test_a_guess_out_of_the_image_is_refused(scan):
    points, views = scan
    behind = RigidTransform(np.eye(3), np.array([0.0, 0.0, -0.5]))
    guess = GuessedPose(views[2].frame, views[2].camera_from_world, behind)
    with pytest.raises(RegistrationError) as caught:
        EdgeSearch(NODES, TRIANGLES, points, views, CAMERA, False, Hints(guess=guess)).search()
    assert caught.value.reason is RegistrationFailure.GUESS_CONTRADICTED


@pytest.mark.slow
def test_a_rough_distance_is_enough(scan):
    points, views = scan
    best = EdgeSearch(NODES, TRIANGLES, points, views, CAMERA, False, Hints(distance=0.4)).search()[0]
    assert apart(best.place, WORLD) < 1.5e-3
    assert best.edges.gain > 0.6


def test_nothing_is_found_in_blank_images(scan):
    points, views = scan
    blank = [replace(view, normalized=np.full_like(view.normalized, 128)) for view in views]
    assert EdgeSearch(NODES, TRIANGLES, points, blank, CAMERA, metric=False).search() == []


def test_a_region_in_a_frame_that_is_no_keyframe_is_refused(scan):
    points, views = scan
    hints = Hints(region=(99, (10.0, 10.0, 90.0, 90.0)))
    with pytest.raises(RegistrationError, match="no keyframe"):
        EdgeSearch(NODES, TRIANGLES, points, views, CAMERA, False, hints).search()


def test_landmark_files_keep_the_frames(tmp_path):
    path = tmp_path / "landmarks.csv"
    save_landmarks(path, Landmarks(CORNERS, np.array([[1.0, 2.0], [3.0, 4.0], [5.0, 6.0]]), np.array([7, 7, 9])))
    read = load_landmarks(path)
    np.testing.assert_array_equal(read.frames, [7, 7, 9])
    np.testing.assert_allclose(read.points, CORNERS)
