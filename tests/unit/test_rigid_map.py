"""The map's book-keeping, and keyframes that are taken out."""

import numpy as np
import pytest

from morph_dslam.camera import Camera
from morph_dslam.slam.loop_closing import Similarities, spread
from morph_dslam.slam.map_files import save_map
from morph_dslam.slam.mapping import ENOUGH_KEYFRAMES, MOST_AT_ONCE, RECENT, cull_keyframes
from morph_dslam.slam.rigid_map import CANDIDATE, GOOD, REMOVED, Followed, Keyframe, RigidMap
from morph_dslam.slam.scene import load_scene
from morph_dslam.slam.tracking import FewViews
from tests.support.rendered_room import pose


def keyframe(ids, pixels, index=0):
    return Keyframe(index, 0.0, np.zeros((4, 4), np.uint8), np.eye(4), np.array(ids), np.array(pixels, float))


def small_map():
    rigid_map = RigidMap()
    rigid_map.add_points(np.arange(12.0).reshape(4, 3), np.zeros((4, 2)), 0, GOOD)
    rigid_map.add_keyframe(keyframe([0, 1, 2], [[0, 0], [1, 1], [2, 2]]))
    rigid_map.add_keyframe(keyframe([3, 1], [[3, 3], [5, 5]], index=7))
    return rigid_map


def test_the_newest_view_is_the_template_and_rows_are_found_by_number():
    rigid_map = small_map()
    assert rigid_map.template_keyframe.tolist() == [0, 1, 0, 1]
    assert rigid_map.template_pixels[1].tolist() == [5, 5]
    rows, seen = rigid_map.keyframes[1].rows_of(np.array([0, 1, 3]))
    assert seen.tolist() == [False, True, True]
    assert rigid_map.keyframes[1].pixels[rows[seen]].tolist() == [[5, 5], [3, 3]]


def test_covisibility_counts_shared_points():
    rigid_map = small_map()
    assert rigid_map.shared_points(np.array([0, 1])).tolist() == [2, 1]
    assert rigid_map.n_observations().tolist() == [1, 2, 1, 1]


def test_merged_points_keep_all_views_and_removed_ones_none():
    rigid_map = small_map()
    rigid_map.merge(0, 3)
    assert rigid_map.state.tolist() == [GOOD, GOOD, GOOD, REMOVED]
    assert rigid_map.keyframes[1].point_ids.tolist() == [0, 1]
    assert rigid_map.keyframes[1].pixels.tolist() == [[3, 3], [5, 5]]
    rigid_map.remove(np.array([1]))
    assert [k.point_ids.tolist() for k in rigid_map.keyframes] == [[0, 2], [0]]
    assert rigid_map.good.tolist() == [0, 2]


def test_a_frame_keeps_its_points_when_they_are_made_one_with_others():
    """2 became 3, which became 0; 0 was seen itself, where it counts first; 4 is a candidate."""
    rigid_map = small_map()
    rigid_map.add_points(np.zeros((1, 3)), np.zeros((1, 2)), 1, CANDIDATE)
    rigid_map.merge(3, 2)
    rigid_map.merge(0, 3)
    draft = RigidMap()
    draft.copy_of(rigid_map)
    pixels = np.array([[1.0, 2], [3, 4], [5, 6], [7, 8]])
    for one in (rigid_map, draft):
        seen = one.good_of(Followed(np.array([2, 4, 1, 3]), pixels))
        assert seen.ids.tolist() == [0, 1]
        assert seen.pixels.tolist() == [[1, 2], [5, 6]]
    rigid_map.remove(np.array([0]))
    assert rigid_map.good_of(Followed(np.array([2, 1]), pixels[:2])).ids.tolist() == [1]


def test_new_corners_join_the_keyframe_that_found_them():
    rigid_map = small_map()
    ids = rigid_map.add_points(np.zeros((2, 3)), np.ones((2, 2)), 1, CANDIDATE)
    rigid_map.extend_keyframe(1, Followed(ids, np.ones((2, 2))))
    assert rigid_map.keyframes[1].point_ids.tolist() == [1, 3, 4, 5]
    assert rigid_map.good.tolist() == [0, 1, 2, 3]


def test_few_keyframes_are_chosen_that_show_most_points():
    rigid_map, ids = RigidMap(), np.arange(60)
    rigid_map.add_points(np.zeros((60, 3)), np.zeros((60, 2)), 0, GOOD)
    for number, seen in enumerate([ids[:20], ids[5:45], ids[40:55], ids[50:60:2]]):
        rigid_map.add_keyframe(keyframe(seen, np.column_stack([seen, np.full(len(seen), number)])))
    chosen = FewViews(rigid_map)
    chosen.choose(ids[:58])
    views, pixels = chosen.template_keyframe[:58], chosen.template_pixels[:58]
    # The second shows 40 points; of the rest the third shows 10; what is left keeps its newest view.
    expected = [0] * 5 + [1] * 40 + [2] * 10 + [0, 3, 0]
    assert views.tolist() == expected
    shown = [*range(55), 56]
    assert pixels[shown].tolist() == [[i, expected[i]] for i in shown]


def test_a_copy_stays_while_the_map_goes_on():
    rigid_map, kept = small_map(), RigidMap()
    kept.copy_of(rigid_map)
    rigid_map.remove(np.array([1]))
    rigid_map.positions[0] = 9.0
    rigid_map.add_keyframe(keyframe([2], [[7, 7]]))
    assert kept.state.tolist() == [GOOD] * 4
    assert kept.positions[0].tolist() == [0.0, 1.0, 2.0]
    assert [k.point_ids.tolist() for k in kept.keyframes] == [[0, 1, 2], [1, 3]]


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


def test_a_keyframe_that_was_taken_out_moves_with_the_scale_around_those_that_stand_for_it():
    """A loop shrinks the whole map about the first camera: all cameras are as much nearer to it."""
    rigid_map = map_of(*[[0, 1, 2]] * 4)
    for k, keyframe in enumerate(rigid_map.keyframes):
        keyframe.camera_from_world = pose((0.2 * k, -0.1 * k, 0.0), (0.0, 0.1 * k, 0.0))
    rigid_map.remove_keyframe(2, carrier=1)
    rigid_map.remove_keyframe(1, carrier=3)
    shrunk = rigid_map.pose_of(2)
    shrunk[:3, 3] *= 0.8
    before = Similarities.of_poses(np.array([keyframe.camera_from_world for keyframe in rigid_map.keyframes]))
    spread(rigid_map, before, Similarities(np.full(4, 0.8), before.rotations, 0.8 * before.translations))
    assert rigid_map.pose_of(2) == pytest.approx(shrunk)


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
    rigid_map.keyframes[2].depths = np.array([[4.0, 12.0, 0.75]], dtype=np.float32)
    save_map(tmp_path / "map.h5", rigid_map, CAMERA)
    loaded = load_scene(tmp_path / "map.h5", CAMERA).map
    assert [keyframe.depths.tolist() for keyframe in loaded.keyframes] == [[], [[4.0, 12.0, 0.75]], []]
    assert [keyframe.index for keyframe in loaded.keyframes] == [0, 20, 30]
    assert loaded.template_keyframe.tolist() == [2, 2]
    assert loaded.keyframes[loaded.template_keyframe[0]].normalized[0, 0] == 3
    assert loaded.kept_keyframes.tolist() == [0, 1, 2]
