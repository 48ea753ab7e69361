"""What the video of camera tracking shows."""

import cv2
import numpy as np

from morph_dslam.slam.result import SlamFrame, SlamStatus
from morph_dslam.slam.rigid_map import NOWHERE
from morph_dslam.slam.run import draw_frame


def drawn(height, pixel):
    frame = SlamFrame(7, 0.2, SlamStatus.TRACKED, candidates=np.array([pixel], dtype=float), points=NOWHERE)
    return draw_frame(np.full((height, height * 4 // 3, 3), 128, dtype=np.uint8), frame)


def test_dots_and_text_are_as_large_beside_a_larger_picture():
    """Seen in one size, the pictures of 480 and 1440 lines differ by the rounding of pixels alone."""
    small, large = drawn(480, (320.0, 240.0)), drawn(1440, (960.0, 720.0))
    for rows, columns in ((slice(200, 280), slice(280, 360)), (slice(0, 30), slice(0, 120))):
        share = [(part[rows, columns] != 128).any(axis=2).mean() for part in (small, cv2.resize(large, (640, 480)))]
        assert share[0] > 0.001
        assert abs(share[1] / share[0] - 1) < 0.4
