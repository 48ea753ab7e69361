"""Patches of map points in a new picture, against known motions and OpenCV's Lucas-Kanade."""

import cv2
import numpy as np
import pytest
from scipy.ndimage import fourier_shift

from morph_dslam.slam.templates import Templates, image_pyramid, is_small
from morph_dslam.tracking.patches import follow
from tests.support.rendered_room import pose as rigid_pose

INTRINSICS = np.array([500.0, 510.0, 319.5, 239.5])
DEPTH = 2.0


@pytest.fixture(scope="module")
def texture():
    noise = np.random.default_rng(0).uniform(0, 255, (480, 640)).astype(np.float32)
    smooth = cv2.GaussianBlur(noise, (0, 0), 2.5)
    return np.clip(128 + 2.5 * (smooth - smooth.mean()), 0, 255).astype(np.uint8)


@pytest.fixture(scope="module")
def pixels():
    return np.random.default_rng(1).uniform([120, 100], [520, 380], size=(60, 2))


def plane_points(pixels):
    """Points of a plane parallel to the image of a camera at the origin."""
    rays = np.column_stack([(pixels - INTRINSICS[2:]) / INTRINSICS[:2], np.ones(len(pixels))])
    return DEPTH * rays


def found(texture, image, pixels, pose, guesses, levels, reach=np.inf):
    """Where points seen at ``pixels`` from the origin are in the image of another pose, and how alike they look."""
    templates, ids, rows = Templates(INTRINSICS), np.arange(len(pixels)), np.zeros(len(pixels), dtype=np.int64)
    keyframes = np.eye(4)[None], rows
    outdated = templates.outdated(ids, rows, pose, keyframes, plane_points(pixels), pixels)
    assert outdated.all()
    templates.make(ids, pixels, image_pyramid(texture))
    assert not templates.outdated(ids, rows, pose, keyframes, plane_points(pixels), pixels).any()
    return templates.align(ids, image_pyramid(image), guesses, levels, reach)


@pytest.mark.parametrize(("gain", "offset"), [(1.0, 0.0), (0.6, 30.0)])
def test_a_shift_is_found_whatever_the_light(texture, pixels, gain, offset):
    # OpenCV's shifts are multiples of 1/32 pixel.
    shift = np.array([11.3125, -6.59375])
    moved = cv2.warpAffine(texture, np.column_stack([np.eye(2), shift]), (640, 480), flags=cv2.INTER_CUBIC)
    image = np.clip(gain * moved.astype(float) + offset, 0, 255).astype(np.uint8)
    places, likeness = found(texture, image, pixels, np.eye(4), pixels.copy(), 3)
    assert np.abs(places - pixels - shift).max() < 0.1
    assert likeness.min() > 0.99
    if gain == 1.0:
        expected, ok = follow(texture, image, pixels, pixels)
        assert ok.all()
        assert np.abs(places - expected).max() < 0.06


def test_a_part_of_a_pixel_is_found_to_a_fiftieth(texture, pixels):
    shift = np.array([0.44, -0.81])
    moved = fourier_shift(np.fft.fft2(texture.astype(float)), shift[::-1])
    image = np.clip(np.rint(np.fft.ifft2(moved).real), 0, 255).astype(np.uint8)
    places, _ = found(texture, image, pixels, np.eye(4), pixels.copy(), 0)
    assert np.median(np.linalg.norm(places - pixels - shift, axis=1)) < 0.02


def test_points_are_looked_for_no_farther_than_they_may_be(texture, pixels):
    moved = cv2.warpAffine(texture, np.array([[1.0, 0.0, 3.0], [0.0, 1.0, 0.0]]), (640, 480))
    for reach, expected in ((6.0, 1.0), (2.0, -1.0)):
        _, likeness = found(texture, moved, pixels, np.eye(4), pixels.copy(), 0, reach)
        assert np.abs(np.median(likeness) - expected) < 0.01


@pytest.mark.parametrize(
    ("turn", "shift"),
    [([0.0, 0.0, 0.6], [0.0, 0.0, 0.0]), ([0.0, 0.0, 0.0], [0.0, 0.0, -0.8]), ([0.1, 0.3, -0.4], [-0.5, 0.1, 0.3])],
    ids=["rolled", "nearer", "beside"],
)
def test_patches_are_warped_as_the_view_of_their_plane_is(texture, pixels, turn, shift):
    pose = rigid_pose(shift, turn)
    matrix = np.array([[INTRINSICS[0], 0, INTRINSICS[2]], [0, INTRINSICS[1], INTRINSICS[3]], [0, 0, 1]])
    of_plane = pose[:3, :3] + np.outer(pose[:3, 3], [0.0, 0.0, 1.0 / DEPTH])
    image = cv2.warpPerspective(
        texture, matrix @ of_plane @ np.linalg.inv(matrix), (640, 480), flags=cv2.INTER_CUBIC, borderValue=(128,)
    )
    local = plane_points(pixels) @ pose[:3, :3].T + pose[:3, 3]
    expected = local[:, :2] / local[:, 2:] * INTRINSICS[:2] + INTRINSICS[2:]
    inside = ((expected > 30) & (expected < [610, 450])).all(axis=1)
    assert inside.sum() > 20
    places, likeness = found(texture, image, pixels[inside], pose, expected[inside] + [1.0, -0.8], 1)
    assert np.median(likeness) > 0.95
    assert np.median(np.linalg.norm(places - expected[inside], axis=1)) < 0.1


def test_a_patch_that_is_not_in_the_image_or_has_no_contrast_is_not_found(texture, pixels):
    other = np.random.default_rng(5).permutation(texture.ravel()).reshape(texture.shape)
    _, likeness = found(texture, other, pixels, np.eye(4), pixels.copy(), 1)
    assert likeness.max() < 0.6
    _, likeness = found(np.full_like(texture, 90), texture, pixels, np.eye(4), pixels.copy(), 1)
    assert np.array_equal(likeness, np.full(len(pixels), -1.0))
    outside = np.array([[3.0, 200.0], [639.0, 200.0], [320.0, 478.0]])
    _, likeness = found(texture, texture, pixels[:3], np.eye(4), outside, 0)
    assert likeness.max() < 0.6


def test_patches_are_made_anew_only_when_the_view_has_changed_much():
    templates, pixels, rows = Templates(INTRINSICS), np.array([[320.0, 240.0]]), np.zeros(1, dtype=np.int64)

    def outdated(roll, shift=(0.0, 0.0, 0.0), view=0):
        pose, keyframes = rigid_pose(shift, [0.0, 0.0, roll]), (np.eye(4)[None], rows)
        return templates.outdated(rows, np.full(1, view), pose, keyframes, plane_points(pixels), pixels)[0]

    assert outdated(0.0)
    assert not outdated(0.1, shift=(0.1, 0.0, 0.2))
    assert outdated(0.6)
    # A little further on the same warped patch still serves; much further, or from another keyframe, none does.
    assert not outdated(0.65)
    assert outdated(1.0)
    assert outdated(1.0, view=1)


@pytest.mark.parametrize(
    ("change", "small"),
    [(np.eye(2), True), (1.2 * np.eye(2), True), (1.3 * np.eye(2), False), (np.diag([1.0, 0.75]), False)],
)
def test_changes_within_reach_of_following(change, small):
    assert is_small(*change.ravel(), 1.0) == small
