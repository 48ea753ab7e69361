"""Where a picture of the print places the object, on images whose pixels are those of the print."""

from dataclasses import replace

import cv2
import numpy as np

from morph_dslam.camera import Camera
from morph_dslam.model import SeparatedField
from morph_dslam.model.functions import ParameterFunctions
from morph_dslam.registration.picture import PictureInitializer
from tests.support.bent_sheet import LENGTH, WIDTH, bent_sheet_model


def rigid_sheet():
    """A flat sheet that does not deform."""
    sheet = bent_sheet_model(22, 16)
    constant = ParameterFunctions(np.zeros(0), np.zeros(0), np.zeros((1, 0), dtype=np.int64), np.ones((1, 1)))
    still = SeparatedField(np.zeros((1, *sheet.nodes.shape)), constant)
    return replace(sheet, parameters=(), displacement=still, stresses={}, cells={}, strain=None)


def test_a_print_seen_upside_down_is_where_its_pixels_are():
    # The corners of pixels are those of the print, turned by half a turn: nothing is interpolated.
    height, width = 180, round(180 * LENGTH / WIDTH)
    texture = cv2.GaussianBlur(np.random.default_rng(0).integers(0, 256, (height, width), np.uint8), (0, 0), 2.0)
    texture = cv2.normalize(texture, None, 0, 255, cv2.NORM_MINMAX)
    frame = np.full((240, 320), 120, np.uint8)
    frame[20 : 20 + height, 40 : 40 + width] = texture[::-1, ::-1]
    corners = [[-0.5 * LENGTH, 0.5 * WIDTH, 0.0], [LENGTH, 0.0, 0.0], [0.0, -WIDTH, 0.0]]
    initializer = PictureInitializer(texture, np.array(corners), None)
    camera = Camera(320, 240, 300.0, 300.0, 159.5, 119.5)
    found = initializer.register(rigid_sheet(), camera, frame)
    centre = camera.project(found.state.camera_from_object.apply(np.zeros((1, 3))))[0]
    np.testing.assert_allclose(centre, [39.5 + 0.5 * width, 19.5 + 0.5 * height], atol=0.05)
