"""Comparing patches, on images whose motion and light are known."""

import cv2
import numpy as np
import pytest
from scipy.ndimage import shift

from morph_dslam.tracking.patches import (
    FLOW_WINDOW,
    compare_patches,
    follow,
    normalize_contrast,
    patch_correlation,
    spread_corners,
)
from tests.support.rendered_sequence import printed_texture

SHIFT = np.array([0.3, -0.2])


@pytest.fixture(scope="module")
def image():
    """A print as a camera sees it, a little blurred: what is sharper cannot be moved by parts of a pixel."""
    return cv2.GaussianBlur(printed_texture(480, 640, seed=4), (0, 0), 1.0)


def shifted(image, x, y):
    moved = shift(image.astype(float), (y, x), order=3, mode="nearest")
    return np.clip(np.rint(moved), 0, 255).astype(np.uint8)


def spread_points(normalized, count=300):
    return spread_corners(normalized, np.pad(np.full((400, 560), 255, np.uint8), 40), count)


def test_light_that_slopes_over_the_windows_does_not_move_what_is_found(image):
    """A shadow's edge, softer than the windows are wide, falls on an image that moves by a known shift."""
    dull = (60 + 0.5 * image.astype(float)).astype(np.uint8)
    points = spread_points(dull)
    columns = np.arange(640.0)
    shadow = 15.0 * np.sin(2.0 * np.pi * columns / 80.0)[None, :]
    target = np.clip(0.8 * shifted(dull, *SHIFT).astype(float) + 20.0 + shadow, 0, 255).astype(np.uint8)
    found, ok = follow(dull, target, points, points)
    places, correlation, spread = compare_patches(dull, target, points, found, 7)
    good = ok & (correlation > 0.6) & np.isfinite(spread)
    good &= np.linalg.norm(found - points - SHIFT, axis=1) < 0.8
    assert good.sum() > 100
    before, after = (np.abs(at - points - SHIFT)[good] for at in (found, places))
    assert np.median(before) > 0.1
    assert np.median(after) < 0.2 * np.median(before)


def test_without_a_change_of_light_the_places_stay_as_they_are_found(image):
    points = spread_points(image)
    found, ok = follow(image, shifted(image, *SHIFT), points, points)
    places, _, spread = compare_patches(image, shifted(image, *SHIFT), points, found, 7)
    good = ok & np.isfinite(spread)
    assert good.mean() > 0.9
    assert np.median(np.abs(places - points - SHIFT)[good]) < 0.02


def test_the_spread_of_a_patch_is_how_far_off_points_are_found(image):
    """Points are followed into images with more and more noise; in each the errors are as told."""
    normalized = normalize_contrast(image, 31)
    points, half = spread_points(normalized), FLOW_WINDOW // 2
    errors, told = [], []
    for noise in (2.0, 8.0, 16.0):
        rng = np.random.default_rng(int(noise))
        noisy = np.clip(image + noise * rng.standard_normal(image.shape), 0, 255).astype(np.uint8)
        target = normalize_contrast(noisy, 31)
        found, ok = follow(normalized, target, points, points)
        close = ok & (np.linalg.norm(found - points, axis=1) < 2.0)
        places, _, spread = compare_patches(normalized, target, points[close], found[close], half)
        known = np.isfinite(spread)
        errors.append(np.sqrt(np.mean((places - points[close])[known] ** 2)))
        told.append(np.sqrt(np.mean(spread[known] ** 2)))
    assert errors[2] > 4.0 * errors[0]
    np.testing.assert_allclose(told, errors, rtol=0.3)


def test_a_window_that_is_covered_in_part_is_told_by_its_spread(image):
    """A disc moves over the image: its rim shifts what is found in the windows that straddle it."""
    normalized = normalize_contrast(image, 31)
    points = spread_points(normalized, 800)
    covered = image.copy()
    cv2.circle(covered, (320, 240), 90, 150, -1, cv2.LINE_AA)
    target = normalize_contrast(covered, 31)
    found, ok = follow(normalized, target, points, points)
    places, correlation, spread = compare_patches(normalized, target, points, found, 7)
    far = np.linalg.norm(points - [320.0, 240.0], axis=1)
    off = np.linalg.norm(places - points, axis=1)
    passed = ok & (correlation > 0.6) & np.isfinite(spread)
    rim, free = passed & (far < 100.0), passed & (far > 130.0)
    assert rim.sum() > 5
    assert np.median(off[rim]) > 5.0 * np.median(off[free])
    assert np.median(spread[rim]) > 5.0 * np.median(spread[free])


def test_correlation_ignores_gain_and_offset_and_sees_difference(image):
    centre = np.array([[320.0, 240.0], [100.0, 100.0]])
    darker = (0.5 * image + 20).astype(np.uint8)
    assert patch_correlation(image, darker, centre, centre, 7).min() > 0.99
    assert patch_correlation(image, image, centre, centre + 35.0, 7).max() < 0.6
    assert patch_correlation(image, image, centre, np.array([[-3.0, 5.0], [639.0, 5.0]]), 7).tolist() == [-1, -1]
