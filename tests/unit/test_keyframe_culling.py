"""Keyframes that are taken out, and what refers to them."""

import numpy as np
import pytest

from morph_dslam.camera import Camera
from morph_dslam.slam.map_files import load_map, save_map
from morph_dslam.slam.mapping import ENOUGH_KEYFRAMES, MOST_AT_ONCE, RECENT, cull_keyframes
from morph_dslam.slam.rigid_map import CANDIDATE, GOOD, REMOVED, Keyframe, RigidMap
from tests.support.rendered_room import pose

CAMERA = Camera(4, 4, 5.0, 5.0, 1.5, 1.5)


def add_keyframe(rigid_map, ids, place=(0.0, 0.0, 0.0)):
    number = len(rigid_map.keyframes)
    pixels = np.column_stack([ids, np.full(len(ids), number)]).astype(float)
    normalized = np.full((4, 4), number, np.uint8)
    rigid_map.add_keyframe(
        Keyframe(10 * number, 0.1 * number, normalized, pose(place), np.array(ids, dtype=np.int64), pixels)
    )


def map_of(*seen, n_points=10):
    rigid_map = RigidMap()
    rigid_map.add_points(np.zeros((n_points, 3)), np.zeros((n_points, 2)), 0, GOOD)
    for number, ids in enumerate(seen):
        add_keyframe(rigid_map, ids, (number, 0.0, 0.0))
    return rigid_map


def test_points_go_over_to_other_keyframes_or_go():
    rigid_map = map_of([0, 1, 2], [1, 2, 3], [0, 1, 2, 3, 4, 5], [2, 3], n_points=6)
    rigid_map.first_keyframe[[4, 5]] = 2
    rigid_map.remove_keyframe(2, carrier=1)
    # Points 4 and 5 were seen by this keyframe alone, 0 by one other one.
    assert rigid_map.state.tolist() == [REMOVED, GOOD, GOOD, GOOD, REMOVED, REMOVED]
    assert [k.point_ids.tolist() for k in rigid_map.keyframes] == [[1, 2], [1, 2, 3], [], [2, 3]]
    assert rigid_map.template_keyframe[[1, 2, 3]].tolist() == [1, 3, 3]
    assert rigid_map.template_pixels[1].tolist() == [1, 1]
    assert rigid_map.kept_keyframes.tolist() == [0, 1, 3]
    assert rigid_map.keyframes[2].index == 20


def test_a_keyframe_that_was_taken_out_moves_with_those_that_stand_for_it():
    rigid_map = map_of(*[[0, 1, 2]] * 4)
    before = rigid_map.pose_of(2)
    rigid_map.remove_keyframe(2, carrier=1)
    rigid_map.remove_keyframe(1, carrier=3)
    assert rigid_map.pose_of(2) == pytest.approx(before)
    moved = pose((0.0, 2.0, 1.0), (0.1, 0.0, 0.3))
    rigid_map.keyframes[3].camera_from_world = rigid_map.keyframes[3].camera_from_world @ moved
    assert rigid_map.pose_of(2) == pytest.approx(before @ moved)


def test_a_map_grows_with_the_scene_and_not_with_time():
    rigid_map = map_of(*[np.arange(10)] * ENOUGH_KEYFRAMES, n_points=40)
    cull_keyframes(rigid_map)
    assert len(rigid_map.kept_keyframes) == ENOUGH_KEYFRAMES
    for _ in range(30):
        add_keyframe(rigid_map, np.arange(10))
        cull_keyframes(rigid_map)
    assert len(rigid_map.kept_keyframes) == ENOUGH_KEYFRAMES
    kept = rigid_map.kept_keyframes.tolist()
    assert kept[0] == 0
    assert kept[-RECENT:] == list(range(70 - RECENT, 70))
    for _ in range(RECENT):
        add_keyframe(rigid_map, np.arange(10))
    cull_keyframes(rigid_map)
    assert len(rigid_map.kept_keyframes) == ENOUGH_KEYFRAMES + RECENT - MOST_AT_ONCE


def test_keyframes_stay_that_show_what_others_do_not_or_that_candidates_wait_for():
    ordinary = [np.arange(10)] * (ENOUGH_KEYFRAMES - 2)
    # The one shows two of ten points that only two others show; a candidate was first seen in the other.
    rigid_map = map_of(*ordinary[:9], [*range(8), 20, 21], *ordinary[9:], n_points=30)
    for _ in range(2):
        add_keyframe(rigid_map, [*range(10), 20, 21])
    rigid_map.state[29], rigid_map.first_keyframe[29] = CANDIDATE, 4
    for _ in range(60):
        add_keyframe(rigid_map, np.arange(10))
        cull_keyframes(rigid_map)
    assert {0, 4, 9} <= set(rigid_map.kept_keyframes.tolist())
    assert len(rigid_map.kept_keyframes) == ENOUGH_KEYFRAMES


def test_a_saved_map_has_only_the_keyframes_that_are_left(tmp_path):
    rigid_map = map_of([0, 1], [0, 1], [0, 1], [0, 1], n_points=2)
    rigid_map.remove_keyframe(1, carrier=0)
    save_map(tmp_path / "map.h5", rigid_map, CAMERA)
    loaded = load_map(tmp_path / "map.h5", CAMERA)
    assert [keyframe.index for keyframe in loaded.keyframes] == [0, 20, 30]
    assert loaded.template_keyframe.tolist() == [2, 2]
    assert loaded.keyframes[loaded.template_keyframe[0]].normalized[0, 0] == 3
    assert loaded.kept_keyframes.tolist() == [0, 1, 2]
