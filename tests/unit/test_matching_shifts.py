"""Where the picture of an object is found again, against pictures that are moved by whole pixels."""

import numpy as np
import pytest

from morph_dslam.tracking.measurement import Rendering
from morph_dslam.tracking.relocalization import matching_shifts

SHOWN, MOVED = np.s_[40:90, 60:130], np.array([34, 57])


def rendering(image, seen):
    depth = np.where(seen, np.float32(0.5), np.float32(np.inf))
    return Rendering(image.astype(np.float32), image, depth, np.where(seen, 0, -1).astype(np.int32))


@pytest.mark.parametrize("seed", range(12))
def test_an_exact_picture_is_found_where_it_is(seed):
    """Correlations of such a picture are one but for rounding, which exceeds it in a third of them."""
    rng = np.random.default_rng(seed)
    frame = rng.integers(0, 255, (240, 300), dtype=np.uint8)
    image, seen = np.full_like(frame, 127), np.zeros(frame.shape, dtype=bool)
    seen[SHOWN] = True
    image[SHOWN] = frame[40 + MOVED[1] : 90 + MOVED[1], 60 + MOVED[0] : 130 + MOVED[0]]
    assert matching_shifts(frame, rendering(image, seen))[0] == pytest.approx(MOVED)


def test_a_picture_without_contrast_is_found_nowhere():
    seen = np.zeros((240, 300), dtype=bool)
    seen[SHOWN] = True
    plain = np.full(seen.shape, 127, np.uint8)
    assert len(matching_shifts(plain, rendering(plain, seen))) == 0
