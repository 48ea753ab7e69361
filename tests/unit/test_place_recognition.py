"""Descriptors, and the bag of words that recognises places."""

import cv2
import numpy as np
import pytest

from morph_dslam.slam.frame_images import describe, least_distances, match_points, orientations
from morph_dslam.slam.relocalization import PlaceIndex, Vocabulary
from morph_dslam.slam.rigid_map import Keyframe, RigidMap
from tests.support.rendered_sequence import printed_texture


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


def test_distances_are_those_of_opencv_by_point():
    rng = np.random.default_rng(0)
    first, second = (rng.integers(0, 256, (n, 32)).astype(np.uint8) for n in (9, 12))
    first_points, second_points = np.repeat(np.arange(3), 3), np.tile(np.arange(6), 2)
    expected = np.full((3, 6), 256)
    for match in (m for row in cv2.BFMatcher(cv2.NORM_HAMMING).knnMatch(first, second, k=12) for m in row):
        place = first_points[match.queryIdx], second_points[match.trainIdx]
        expected[place] = min(expected[place], match.distance)
    assert np.array_equal(least_distances(first, first_points, second, second_points), expected)


def test_matches_are_mutual_near_and_clear():
    distances = np.array([[10, 90, 90], [12, 95, 30], [99, 70, 68]], dtype=np.uint16)
    # The first two both like column 0, which likes the first; the last cannot decide between two.
    rows, columns = match_points(distances, ratio=0.95, most=80)
    assert (rows.tolist(), columns.tolist()) == ([0], [0])
    rows, columns = match_points(distances[:, 1:], ratio=1.0, most=80)
    assert (rows.tolist(), columns.tolist()) == ([1], [1])
    assert not len(match_points(distances[:, 1:], ratio=1.0, most=30)[0])
    assert not len(match_points(distances[:, :1], ratio=1.0, most=80)[0])


@pytest.mark.parametrize("scale", [0.7, 0.8, 1.25, 1.45])
def test_descriptors_match_across_turns_and_scales(scale):
    image = printed_texture(400, 400, seed=1)
    corners = corners_of(image)
    change = cv2.getRotationMatrix2D((200.0, 200.0), 35.0, scale)
    turned = cv2.warpAffine(image, change, (400, 400), flags=cv2.INTER_AREA, borderValue=225)
    moved = corners @ change[:, :2].T + change[:, 2]
    rows, descriptors = describe(image, corners, (0, 2, 4))
    other_rows, other = describe(turned, moved, (0, 2, 4))
    first, second = match_points(least_distances(descriptors, rows, other, other_rows), 0.95, 80)
    assert (first == second).mean() > 0.75
    assert len(first) > 0.33 * len(np.unique(other_rows))


def test_points_too_near_the_border_are_not_described():
    rows, descriptors = describe(printed_texture(200, 200), np.array([[5.0, 100.0], [100.0, 196.0]]), (0, 2))
    assert (rows.shape, descriptors.shape) == ((0,), (0, 32))


def test_words_are_the_centres_of_clusters():
    rng = np.random.default_rng(2)
    centres = rng.integers(0, 2, (5, 256)).astype(np.uint8)
    members = np.repeat(np.arange(5), 60)
    bits = centres[members] ^ (rng.random((300, 256)) < 0.08)
    descriptors = np.packbits(bits, axis=1)
    vocabulary = Vocabulary(descriptors, n_words=20)
    assert np.array_equal(vocabulary.words, Vocabulary(descriptors, n_words=20).words)
    # No word serves two clusters, and words are nearer to their cluster's centre than its members are.
    assigned = vocabulary.assign(descriptors)
    assert all(len(np.unique(members[assigned == word])) == 1 for word in assigned)
    words = np.unpackbits(vocabulary.words[assigned], axis=1)
    assert (words != centres[members]).mean() < 0.02
    assert vocabulary.histogram(descriptors).sum() == pytest.approx(1.0)
    assert not vocabulary.histogram(descriptors[:0]).any()


def test_an_image_resembles_the_keyframe_of_its_place():
    images = [printed_texture(400, 400, seed) for seed in range(6)]
    rigid_map = RigidMap()
    for image in images:
        points = corners_of(image)
        keyframe = Keyframe(0, 0.0, image, np.eye(4), np.arange(len(points)), points)
        rows, keyframe.descriptors = describe(image, points, (0, 2, 4))
        keyframe.described_ids = rows
        rigid_map.keyframes.append(keyframe)
    places = PlaceIndex(rigid_map)
    places.update()
    for number, image in enumerate(images):
        change = cv2.getRotationMatrix2D((200.0, 200.0), 20.0, 0.9)
        darker = cv2.warpAffine((0.6 * image).astype(np.uint8), change, (400, 400), borderValue=110)
        _, descriptors = describe(darker, corners_of(darker), (0, 2, 4))
        similarities = places.similarities(descriptors)
        assert similarities.argmax() == number
        assert similarities[number] > 1.1 * np.delete(similarities, number).max()


def test_a_keyframe_that_is_described_after_it_was_taken_in_is_recognised():
    """The camera may be lost while its newest keyframe is still being described."""
    rng, rigid_map = np.random.default_rng(0), RigidMap()
    descriptors = [rng.integers(0, 255, (300, 32)).astype(np.uint8) for _ in range(5)]
    for number, each in enumerate(descriptors):
        keyframe = Keyframe(number, 0.0, np.zeros((4, 4), np.uint8), np.eye(4), np.arange(0), np.empty((0, 2)))
        if number < 4:
            keyframe.descriptors = each
        rigid_map.keyframes.append(keyframe)
    places = PlaceIndex(rigid_map)
    places.update()
    assert places.similarities(descriptors[4])[4] == 0.0
    rigid_map.keyframes[4].descriptors = descriptors[4]
    places.update()
    # An image resembles itself wholly.
    assert places.similarities(descriptors[4])[4] == pytest.approx(1.0)
