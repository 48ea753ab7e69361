"""An outline of which a part is missing: torn off, covered, or like what is beside it."""

import numpy as np
import pytest

from morph_dslam.model import SurfacePoints
from morph_dslam.tracking.estimator import BoundPoints
from morph_dslam.tracking.outline import OutlineMeasurement, n_absent
from tests.support.bent_sheet import bent_sheet_model

#: A square in the image: left, top, right and bottom, pixels.
LEFT, TOP, RIGHT, BOTTOM = 60, 40, 240, 160
ALONG = np.arange(LEFT + 15, RIGHT - 14, 10)


def seen():
    """Points on the upper and lower side of the square, of which those on the left half were found."""
    pixels = np.concatenate([np.column_stack([ALONG, np.full(len(ALONG), y)]) for y in (TOP, BOTTOM)]).astype(float)
    normals = np.repeat([[0.0, -1.0], [0.0, 1.0]], len(ALONG), axis=0)
    n = len(pixels)
    slots = SurfacePoints(np.zeros(n, dtype=np.int64), np.tile([1.0, 0.0, 0.0], (n, 1)))
    points = BoundPoints.from_surface(bent_sheet_model(), slots)
    weights = (pixels[:, 0] < 150.0).astype(float)
    return OutlineMeasurement(points, pixels, normals, np.ones(n, dtype=bool), weights)


def picture(square, beside=220.0, right_half=None):
    """A square before something; its right half, and what is above and below of that, may look otherwise."""
    image = np.full((200, 300), 0.0) + beside
    image[TOP : BOTTOM + 1, LEFT : RIGHT + 1] = square
    if right_half is not None:
        image[TOP - 20 : BOTTOM + 21, 150:] = np.broadcast_to(right_half, image.shape)[TOP - 20 : BOTTOM + 21, 150:]
    image += np.random.default_rng(0).normal(0.0, 3.0, image.shape)
    return image.round().clip(0, 255).astype(np.uint8)


#: Squares of all greys, in which anything may be what is beside an object.
CLUTTER = np.kron(np.random.default_rng(1).uniform(10.0, 245.0, (20, 30)), np.ones((10, 10)))


@pytest.mark.parametrize(
    ("image", "expected"),
    [
        (picture(40), 0),
        (picture(40, right_half=220), 16),
        (picture(40, right_half=120), 0),
        (picture(212, right_half=220), 0),
        (picture(40, CLUTTER, CLUTTER), 0),
    ],
    ids=["whole", "torn", "covered", "hardly darker", "torn before clutter"],
)
def test_only_a_part_in_whose_place_the_background_is_seen_is_absent(image, expected):
    assert n_absent(image, seen()) == expected


def test_points_outside_of_the_image_tell_nothing():
    assert n_absent(picture(40, right_half=220)[:, :200], seen()) == 10
