"""The pinhole camera against OpenCV and finite differences."""

import cv2
import numpy as np
import pytest

from morph_dslam.camera import PinholeCamera
from morph_dslam.errors import CameraError

PLAIN = PinholeCamera(640, 480, 528.0, 531.0, 318.5, 241.2)
BARREL = PinholeCamera(640, 480, 528.0, 531.0, 318.5, 241.2, (-0.28, 0.09, 1e-3, -5e-4, 0.02))


def points_in_view(n=200, seed=0):
    rng = np.random.default_rng(seed)
    depth = rng.uniform(0.3, 3.0, n)
    return np.column_stack([rng.uniform(-0.5, 0.5, n) * depth, rng.uniform(-0.4, 0.4, n) * depth, depth])


def opencv_pixels(camera, points):
    coefficients = np.array(camera.distortion) if camera.distortion else None
    return cv2.projectPoints(points, np.zeros(3), np.zeros(3), camera.matrix, coefficients)[0].reshape(-1, 2)


def test_projection_is_opencvs():
    points = points_in_view()
    np.testing.assert_allclose(PLAIN.project(points), opencv_pixels(PLAIN, points), atol=1e-9)


def test_points_not_in_front_have_no_pixel():
    pixels = PLAIN.project(np.array([[0.0, 0.0, 0.0], [0.1, 0.1, -1.0], [0.0, 0.0, 1.0]]))
    assert np.isnan(pixels[:2]).all()
    np.testing.assert_array_equal(pixels[2], [318.5, 241.2])


def test_projection_jacobian_by_central_differences():
    points, step = points_in_view(20), 1e-6
    jacobian = PLAIN.projection_jacobian(points)
    for axis in range(3):
        offset = step * np.eye(3)[axis]
        difference = (PLAIN.project(points + offset) - PLAIN.project(points - offset)) / (2 * step)
        np.testing.assert_allclose(jacobian[:, :, axis], difference, rtol=1e-6, atol=1e-4)


def test_rays_project_back_to_their_pixels():
    pixels = np.random.default_rng(1).uniform(0, 480, (50, 2))
    rays = PLAIN.rays(pixels)
    np.testing.assert_allclose(PLAIN.project(2.5 * rays), pixels, atol=1e-10)
    np.testing.assert_array_equal(rays[:, 2], 1.0)


def test_undistorted_pixels_are_the_ideal_projections():
    points = points_in_view()
    distorted = opencv_pixels(BARREL, points)
    assert np.abs(distorted - BARREL.project(points)).max() > 5.0
    # OpenCV's inverse iterates a fixed number of times; a tenth of a pixel is left at the image's corners.
    inner = np.abs(points[:, :2] / points[:, 2:]).max(axis=1) < 0.3
    np.testing.assert_allclose(
        BARREL.undistort_pixels(distorted)[inner], BARREL.project(points)[inner], atol=0.05
    )
    np.testing.assert_array_equal(PLAIN.undistort_pixels(distorted), distorted)


def test_undistortion_maps_bring_a_distorted_dot_to_its_ideal_pixel():
    point = np.array([[0.25, -0.15, 1.0]])
    dot, ideal = opencv_pixels(BARREL, point)[0], BARREL.project(point)[0]
    v, u = np.mgrid[0:480, 0:640]
    image = np.exp(-((u - dot[0]) ** 2 + (v - dot[1]) ** 2) / (2 * 4.0**2)).astype(np.float32)
    maps = BARREL.undistortion_maps()
    assert maps is not None
    undistorted = cv2.remap(image, *maps, cv2.INTER_LINEAR)
    found = np.unravel_index(undistorted.argmax(), undistorted.shape)[::-1]
    assert np.abs(np.array(found) - ideal).max() <= 1.5
    assert PLAIN.undistortion_maps() is None


def test_images_of_another_size_are_refused_by_name():
    PLAIN.check_image(np.zeros((480, 640, 3), np.uint8), "frame 7")
    with pytest.raises(CameraError, match="frame 7 is 480x640 pixels but the camera file is for 640x480"):
        PLAIN.check_image(np.zeros((640, 480), np.uint8), "frame 7")
