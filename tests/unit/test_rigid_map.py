"""The map's book-keeping, descriptors for relocalisation, and the point cloud file."""

import cv2
import meshio
import numpy as np

from morph_dslam.io.point_cloud import save_ply
from morph_dslam.online.features import match_descriptors
from morph_dslam.online.slam.relocalisation import describe, orientations, thumbnail
from morph_dslam.online.slam.rigid_map import CANDIDATE, GOOD, REMOVED, Followed, Keyframe, RigidMap
from tests.support.rendered_sequence import printed_texture


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


def test_new_corners_join_the_keyframe_that_found_them():
    rigid_map = small_map()
    ids = rigid_map.add_points(np.zeros((2, 3)), np.ones((2, 2)), 1, CANDIDATE)
    rigid_map.extend_keyframe(1, Followed(ids, np.ones((2, 2))))
    assert rigid_map.keyframes[1].point_ids.tolist() == [1, 3, 4, 5]
    assert rigid_map.good.tolist() == [0, 1, 2, 3]


def corners_of(image):
    mask = np.zeros_like(image)
    mask[60:-60, 60:-60] = 255
    return cv2.goodFeaturesToTrack(image, 150, 0.01, 8, mask=mask).reshape(-1, 2).astype(float)


def test_orientations_turn_with_the_image():
    image = printed_texture(401, 401)
    corners = corners_of(image)
    turned = np.ascontiguousarray(np.rot90(image, -1))
    moved = np.column_stack([400 - corners[:, 1], corners[:, 0]])
    difference = (orientations(turned, moved) - orientations(image, corners)) % 360.0
    assert np.median(np.abs(difference - 90.0)) < 1e-3


def test_descriptors_match_across_turns_and_scales():
    image = printed_texture(400, 400, seed=1)
    corners = corners_of(image)
    change = cv2.getRotationMatrix2D((200.0, 200.0), 35.0, 0.8)
    turned = cv2.warpAffine(image, change, (400, 400), flags=cv2.INTER_AREA, borderValue=225)
    moved = corners @ change[:, :2].T + change[:, 2]
    rows, descriptors = describe(image, corners, (0, 1))
    other_rows, other_descriptors = describe(turned, moved, (0,))
    first, second = match_descriptors(descriptors, other_descriptors, ratio=1.0)
    right = rows[first] == other_rows[second]
    assert right.sum() > 0.4 * len(corners)
    assert right.mean() > 0.7


def test_thumbnails_know_their_image_again():
    images = [printed_texture(480, 640, seed) for seed in range(4)]
    darker = np.clip(0.7 * images[2] + 5.0, 0, 255).astype(np.uint8)
    likeness = [thumbnail(image) @ thumbnail(darker) for image in images]
    assert np.argmax(likeness) == 2
    assert likeness[2] > 0.99


def test_the_point_cloud_is_read_by_another_program(tmp_path):
    points = np.random.default_rng(0).normal(size=(7, 3))
    save_ply(tmp_path / "map.ply", points)
    assert np.allclose(meshio.read(tmp_path / "map.ply").points, points, atol=1e-6)
