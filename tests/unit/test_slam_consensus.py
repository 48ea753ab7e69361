"""Which pose is believed when a part of the scene moves: hand-made points with known truth."""

import numpy as np
import pytest

from morph_dslam.slam.result import NoPose, SlamReason
from morph_dslam.slam.rigid_map import GOOD, Followed, Keyframe, PassingViews, RigidMap
from morph_dslam.slam.sight import Sight

INTRINSICS = np.array([525.0, 525.0, 319.5, 239.5])
NOISE_PX = 0.2


def projected(points, shift=(0.0, 0.0, 0.0)):
    """Pixels in a camera that has moved by ``shift``."""
    local = points - shift
    return local[:, :2] / local[:, 2:] * INTRINSICS[:2] + INTRINSICS[2:]


def box(rng, n, low, high):
    return rng.uniform(low, high, (n, 3))


def map_of(points, born, n_keyframes=6, usual_px=0.3):
    """A map of points (n, 3) first seen in keyframes ``born`` (n,)."""
    rigid_map = RigidMap()
    rigid_map.add_points(points, projected(points), 0, GOOD)
    rigid_map.first_keyframe = np.asarray(born)
    image, nothing = np.zeros((4, 4), np.uint8), np.empty(0, dtype=np.int64)
    rigid_map.keyframes = [
        Keyframe(i, float(i), image, np.eye(4), nothing, np.empty((0, 2))) for i in range(n_keyframes)
    ]
    rigid_map.usual_rms_px = usual_px
    return rigid_map


def scene(n_far, n_near, slide, camera, born_near=0, seed=0):
    """A sight of a far part that rests and a near one that slid along x, from a camera that moved along x."""
    rng = np.random.default_rng(seed)
    far = box(rng, n_far, [-1.5, -1.0, 2.0], [1.5, 1.0, 4.5])
    near = box(rng, n_near, [-0.4, -0.4, 1.5], [0.4, 0.4, 1.8])
    rigid_map = map_of(np.vstack([far, near]), np.repeat([0, born_near], [n_far, n_near]))
    shift = np.array([camera, 0.0, 0.0])
    pixels = np.vstack([projected(far, shift), projected(near + np.array([slide, 0.0, 0.0]), shift)])
    pixels += NOISE_PX * rng.standard_normal(pixels.shape)
    sight = Sight(rigid_map, Followed(np.arange(len(pixels)), pixels), INTRINSICS)
    return sight, np.repeat([True, False], [n_far, n_near])


def centre(pose):
    return -pose.camera_from_world[:3, :3].T @ pose.camera_from_world[:3, 3]


@pytest.mark.parametrize("slide", [0.012, 0.02, 0.1])
def test_a_near_part_that_begins_to_slide_does_not_draw_the_camera_along(slide):
    sight, rests = scene(160, 60, slide, camera=0.01)
    pose = sight.pose(np.eye(4))
    assert centre(pose) == pytest.approx([0.01, 0.0, 0.0], abs=0.002)
    assert pose.inliers[rests].mean() > 0.98
    # It misses by 3.8 pixels and more; 1.5 are allowed for.
    assert pose.inliers[~rests].mean() < 0.05


def test_young_points_do_not_outvote_old_ones():
    young, _ = scene(45, 60, 0.02, camera=0.0, born_near=5)
    assert centre(young.pose(np.eye(4))) == pytest.approx([0.0, 0.0, 0.0], abs=0.004)


def test_two_equal_parts_that_move_apart_are_not_told_apart():
    sight, _ = scene(100, 90, 0.1, camera=0.0)
    assert sight.pose(np.eye(4)) == NoPose(SlamReason.RIVAL_MOTIONS)


def test_many_points_that_deform_are_no_rival_of_those_that_rest():
    rng = np.random.default_rng(1)
    points = box(rng, 190, [-2.0, -1.3, 2.0], [2.0, 1.3, 4.5])
    pixels = projected(points) + NOISE_PX * rng.standard_normal((190, 2))
    pixels[100:] += rng.uniform(-40.0, 40.0, (90, 2))
    rigid_map = map_of(points, np.zeros(190, dtype=int))
    pose = Sight(rigid_map, Followed(np.arange(190), pixels), INTRINSICS).pose(np.eye(4))
    assert centre(pose) == pytest.approx([0.0, 0.0, 0.0], abs=0.003)


def test_too_few_points_are_said():
    sight, _ = scene(12, 3, 0.0, camera=0.0)
    assert sight.pose(np.eye(4)) == NoPose(SlamReason.FEW_POINTS, (15,))


def passing(points, motion):
    """Frames of a camera that moves along x to 0.2 m, while ``motion(t)`` (3,) moves the points."""
    views = PassingViews()
    for t in np.linspace(0.1, 0.9, 8):
        camera_from_world = np.eye(4)
        camera_from_world[0, 3] = -0.2 * t
        seen = projected(points + motion(t), [0.2 * t, 0.0, 0.0])
        views.note(0, np.eye(4), camera_from_world, np.arange(len(points)), seen)
    return views


def triangulated(points, motion):
    """Where two views at either end put the points, if these move along x: in depth z b / (b - slide)."""
    slide = motion(1.0)[0]
    return points * (0.2 / (0.2 - slide))


@pytest.mark.parametrize(
    ("motion", "agrees"),
    [
        (lambda t: np.zeros(3), True),
        (lambda t: np.array([0.05 * max(t - 0.5, 0.0) / 0.5, 0.0, 0.0]), False),
        (lambda t: np.array([0.05 * t**2, 0.0, 0.0]), False),
        # At the camera's own pace nothing tells a moving point from one that is farther away.
        (lambda t: np.array([0.05 * t, 0.0, 0.0]), True),
    ],
    ids=["rests", "starts halfway", "accelerates", "keeps pace"],
)
def test_frames_in_between_tell_which_points_moved(motion, agrees):
    points = box(np.random.default_rng(2), 30, [-0.5, -0.4, 1.5], [0.5, 0.4, 1.8])
    put = triangulated(points, motion)
    # Both ends agree on the places, whatever happened in between.
    assert projected(put, [0.2, 0.0, 0.0]) == pytest.approx(projected(points + motion(1.0), [0.2, 0.0, 0.0]), abs=1e-9)
    fits = passing(points, motion).agree(np.arange(30), put, np.eye(4)[None], INTRINSICS, 1.5)
    assert fits.all() if agrees else not fits.any()


def test_frames_that_show_no_waiting_point_are_forgotten_and_their_number_stays_bounded():
    points = box(np.random.default_rng(3), 20, [-0.5, -0.4, 1.5], [0.5, 0.4, 1.8])
    views = PassingViews()
    for i in range(100):
        ids = np.arange(20) if i < 60 else np.arange(20, 40)
        seen = projected(points, [0.02 * i, 0.0, 0.0])
        views.note(0, np.eye(4), np.eye(4), ids, seen)
        assert len(views._views) <= 16
    assert all((view.ids >= 20).all() for view in views._views)
