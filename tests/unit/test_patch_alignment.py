"""Textures carried by a mesh and patches aligned: against plain twins, and displacements that are known."""

import numpy as np
import pytest

from morph_dslam.registration.texture import align_patches, align_patches_numpy, carry, carry_numpy
from morph_dslam.render.rasteriser import rasterise
from tests.support.rendered_object import CAMERA, cameras, scanned, wedge
from tests.unit.test_keyframe_adjustment import WORLD


def pattern(x, y):
    """A smooth texture between 0 and 255."""
    return 128.0 + 40.0 * np.sin(0.31 * x + 0.17 * y) + 35.0 * np.cos(0.23 * y - 0.11 * x) + 20.0 * np.sin(0.4 * y)


ROWS, COLUMNS = np.mgrid[0:120, 0:160].astype(float)
CENTRES = np.array([[40.2, 50.7], [80.0, 60.4], [100.6, 30.1], [120.3, 90.9]])


def test_a_known_displacement_is_measured_whatever_the_contrast():
    carried = pattern(COLUMNS, ROWS).astype(np.float32)
    image = np.rint(20.0 + 0.7 * pattern(COLUMNS - 0.37, ROWS + 0.61)).astype(np.uint8)
    moves, alike = align_patches(carried, np.ones(carried.shape, dtype=bool), image, CENTRES, 8)
    np.testing.assert_allclose(moves, np.tile([0.37, -0.61], (4, 1)), atol=0.03)
    assert (alike > 0.99).all()


def test_pixels_that_are_not_shown_do_not_count():
    rng = np.random.default_rng(0)
    carried = pattern(COLUMNS, ROWS).astype(np.float32)
    image = np.rint(pattern(COLUMNS - 0.4, ROWS)).astype(np.uint8)
    shown = COLUMNS + 0.3 * ROWS < 100.0
    carried[~shown], image[~shown] = 0.0, rng.integers(0, 255, (~shown).sum())
    # The edge runs through the patch; the pixel beside it takes part in the interpolation of the image.
    moves, alike = align_patches(carried, shown, image, np.array([[80.0, 60.0]]), 8)
    np.testing.assert_allclose(moves[0], [0.4, 0.0], atol=0.1)
    assert alike[0] > 0.95
    _, nothing = align_patches(carried, shown, image, np.array([[140.0, 60.0]]), 8)
    assert nothing[0] == -1.0


def test_patches_agree_with_the_plain_twin():
    rng = np.random.default_rng(1)
    carried = (pattern(COLUMNS, ROWS) + rng.normal(0.0, 2.0, ROWS.shape)).astype(np.float32)
    image = np.clip(pattern(COLUMNS - 0.8, ROWS - 0.3) + rng.normal(0.0, 2.0, ROWS.shape), 0, 255).astype(np.uint8)
    shown = (COLUMNS - 75.0) ** 2 + (ROWS - 60.0) ** 2 < 45.0**2
    compiled, plain = (function(carried, shown, image, CENTRES, 8) for function in (align_patches, align_patches_numpy))
    np.testing.assert_allclose(compiled[0], plain[0], atol=1e-6)
    np.testing.assert_allclose(compiled[1], plain[1], atol=1e-6)
    assert (plain[1] > 0.9).any()


@pytest.fixture(scope="module")
def two_views():
    nodes, triangles, _ = wedge()
    _, views = scanned(WORLD, with_images=True)
    drawn = []
    for pose in (cameras()[1], cameras()[4]):
        local = pose.apply(nodes)
        pixels = CAMERA.project(local)
        drawn.append((pixels, local[:, 2], rasterise(pixels, local[:, 2], triangles, CAMERA.height, CAMERA.width)))
    return triangles, drawn, views[1].normalized, views[4].normalized


def carried_by(function, two_views):
    triangles, ((pixels, depths, first), (_, _, second)), normalized, _ = two_views
    carried, shown = np.zeros(normalized.shape, np.float32), np.zeros(normalized.shape, dtype=bool)
    function(second.triangle_ids, second.weights, triangles, pixels, depths, first.depth, normalized, carried, shown)
    return carried, shown


def test_a_carried_texture_is_what_the_other_view_shows(two_views):
    carried, shown = carried_by(carry, two_views)
    assert shown.sum() > 5000
    assert np.corrcoef(carried[shown], two_views[3][shown].astype(float))[0, 1] > 0.75
    # What the first view cannot see, at least a face of the wedge, is not carried.
    assert (two_views[1][1][2].covered & ~shown).sum() > 500


def test_carrying_agrees_with_the_plain_twin(two_views):
    compiled, plain = carried_by(carry, two_views), carried_by(carry_numpy, two_views)
    # Pixels on the limit between seen and hidden may fall to either side.
    assert (compiled[1] != plain[1]).mean() < 1e-4
    both = compiled[1] & plain[1]
    np.testing.assert_allclose(compiled[0][both], plain[0][both], atol=1e-3)
