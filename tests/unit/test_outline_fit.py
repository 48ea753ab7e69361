"""Whether images show an outline where a place has it: on a rendered wedge, in right and in wrong places."""

from dataclasses import replace

import numpy as np
import pytest

from morph_dslam.geometry import SimilarityTransform
from morph_dslam.registration.outline_fit import clearest_cut, outline_fit
from tests.support.rendered_object import CAMERA, scanned, wedge
from tests.support.rendered_sequence import printed_texture

WORLD = SimilarityTransform(3.7, np.eye(3), np.array([0.5, -1.2, 2.0]))
NODES, TRIANGLES, _ = wedge()


def before(contrast, brightness):
    """Views of the wedge before a printed wall, with noise; without contrast it is plain."""
    rng = np.random.default_rng(1)
    found = []
    for view in scanned(WORLD, with_images=True)[1]:
        image = view.normalized.astype(float)
        wall = printed_texture(CAMERA.height, CAMERA.width, 9 + view.frame).astype(float)
        image = np.where(view.normalized == 128, contrast * wall + brightness, image)
        noisy = np.clip(image + 2.0 * rng.standard_normal(image.shape), 0, 255).astype(np.uint8)
        found.append(replace(view, normalized=noisy))
    return found


@pytest.fixture(scope="module", params=[(0.0, 128.0), (0.2, 100.0)])
def views(request):
    return before(*request.param)


def scaled(factor):
    """`WORLD`, the object in another size about its middle."""
    middle = WORLD.apply(NODES.mean(axis=0)[None])[0]
    return SimilarityTransform(WORLD.scale * factor, WORLD.rotation, middle + factor * (WORLD.translation - middle))


def test_the_right_place_fits(views):
    found = outline_fit(WORLD, NODES, TRIANGLES, views, CAMERA)
    assert found.count >= 100
    assert found.share > 0.6
    assert not found.contradicts


@pytest.mark.parametrize("factor", [0.85, 0.9, 1.1, 1.15])
def test_another_size_is_contradicted_before_a_plain_wall(factor):
    found = outline_fit(scaled(factor), NODES, TRIANGLES, before(0.0, 128.0), CAMERA)
    assert found.share < 0.4
    assert found.contradicts


def test_a_smaller_size_is_contradicted_before_a_printed_wall_too():
    found = outline_fit(scaled(0.85), NODES, TRIANGLES, before(0.2, 100.0), CAMERA)
    assert found.share < 0.2
    assert found.contradicts


def test_another_place_is_contradicted():
    beside = replace(WORLD, translation=WORLD.translation + WORLD.scale * np.array([0.012, 0.008, 0.0]))
    assert outline_fit(beside, NODES, TRIANGLES, before(0.0, 128.0), CAMERA).contradicts


def test_images_without_anything_tell_nothing(views):
    rng = np.random.default_rng(2)
    blank = [replace(v, normalized=(128 + rng.integers(-1, 2, v.normalized.shape)).astype(np.uint8)) for v in views]
    found = outline_fit(WORLD, NODES, TRIANGLES, blank, CAMERA)
    assert found.count < 60
    assert not found.contradicts


@pytest.mark.parametrize("contrast", [0.5, 1.0])
def test_a_wall_that_looks_like_the_object_does_not_accuse_the_right_place(contrast):
    found = outline_fit(WORLD, NODES, TRIANGLES, before(contrast, 128.0 * (1.0 - contrast)), CAMERA)
    assert found.share < 0.4  # it cannot be seen where it is
    assert not found.contradicts


@pytest.mark.parametrize("place", [-9, 0, 7])
def test_a_cut_is_found_at_an_edge_and_where_texture_ends(place):
    offsets = np.arange(-16, 17)
    assert clearest_cut(1.0 + 9.0 * (np.abs(offsets - place) <= 1))[0] == place
    # Between two textures no edge is needed: it ends up on either side of the step.
    assert abs(clearest_cut(np.where(offsets <= place, 5.0, 0.2))[0] - place) <= 2


def test_a_level_profile_has_no_clear_cut():
    assert clearest_cut(np.full(33, 4.0))[1] == pytest.approx(0.0, abs=1e-9)
