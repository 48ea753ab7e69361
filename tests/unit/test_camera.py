"""The pinhole camera against OpenCV and finite differences."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from morph_dslam.camera import Camera
from morph_dslam.errors import CameraError

PLAIN = Camera(640, 480, 528.0, 531.0, 318.5, 241.2)
BARREL = Camera(640, 480, 528.0, 531.0, 318.5, 241.2, (-0.28, 0.09, 1e-3, -5e-4, 0.02))
RATIONAL = replace(BARREL, distortion=(0.4, -0.1, 1e-3, -5e-4, 0.02, 0.6, -0.05, 0.01))
FISHEYE = replace(BARREL, distortion=(0.03, -0.02, 0.008, -0.001), lens_model="fisheye")


def points_in_view(n=200, seed=0):
    rng = np.random.default_rng(seed)
    depth = rng.uniform(0.3, 3.0, n)
    return np.column_stack([rng.uniform(-0.5, 0.5, n) * depth, rng.uniform(-0.4, 0.4, n) * depth, depth])


def opencv_pixels(camera, points):
    coefficients = np.array(camera.distortion) if camera.distortion else None
    if camera.lens_model == "fisheye":
        zero = np.zeros((1, 1, 3))
        pixels, _ = cv2.fisheye.projectPoints(points[:, None], zero, zero, camera.matrix, coefficients)
        return pixels.reshape(-1, 2)
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
    np.testing.assert_allclose(BARREL.undistort_pixels(distorted), BARREL.project(points), atol=1e-6)
    np.testing.assert_array_equal(PLAIN.undistort_pixels(distorted), distorted)


@pytest.mark.parametrize("camera", [PLAIN, BARREL, RATIONAL, FISHEYE])
def test_recorded_projection_is_opencvs(camera):
    points = points_in_view()
    np.testing.assert_allclose(camera.project_recorded(points), opencv_pixels(camera, points), atol=1e-9)
    ideal = camera.project(points)
    np.testing.assert_allclose(camera.distort_pixels(ideal), opencv_pixels(camera, points), atol=1e-9)
    np.testing.assert_allclose(camera.undistort_pixels(camera.distort_pixels(ideal)), ideal, atol=1e-5)


@pytest.mark.parametrize("camera", [PLAIN, BARREL, RATIONAL, FISHEYE])
def test_recorded_jacobian_by_central_differences(camera):
    points, step = points_in_view(20), 1e-6
    jacobian = camera.recorded_jacobian(points)
    for axis in range(3):
        offset = step * np.eye(3)[axis]
        difference = (camera.project_recorded(points + offset) - camera.project_recorded(points - offset)) / (2 * step)
        np.testing.assert_allclose(jacobian[:, :, axis], difference, rtol=1e-5, atol=1e-4)


def test_a_fisheye_sees_more_than_a_pinhole_does():
    # Equidistant with k = 0: the image radius is the angle itself, here 120 degrees to the right.
    lens = Camera(640, 480, 100.0, 100.0, 320.0, 240.0, (0.0, 0.0, 0.0, 0.0), "fisheye")
    aside = np.array([[np.sin(2.0 * np.pi / 3.0), 0.0, np.cos(2.0 * np.pi / 3.0)], [0.0, 0.0, 1.0]])
    expected = [[320.0 + 100.0 * 2.0 * np.pi / 3.0, 240.0], [320.0, 240.0]]
    np.testing.assert_allclose(lens.project_recorded(aside), expected, atol=1e-9)
    np.testing.assert_allclose(lens.recorded_jacobian(aside)[1], [[100, 0, 0], [0, 100, 0]], atol=1e-9)
    assert np.isnan(lens.undistort_pixels(np.array(expected))[0]).all()
    np.testing.assert_allclose(lens.undistort_pixels(np.array(expected))[1], [320.0, 240.0])


def test_pixels_beyond_the_fold_of_the_distortion_are_not_undistorted():
    # r (1 - r^2 / 3) is largest, 2/3, at r = 1: nothing is imaged farther out.
    folding = Camera(640, 480, 300.0, 300.0, 320.0, 240.0, (-1.0 / 3.0, 0.0, 0.0, 0.0))
    inside, outside = [320.0 + 300.0 * 0.5 * (1 - 0.25 / 3.0), 240.0], [320.0 + 300.0 * 0.7, 240.0]
    found = folding.undistort_pixels(np.array([inside, outside]))
    np.testing.assert_allclose(found[0], [470.0, 240.0], atol=1e-6)
    assert np.isnan(found[1]).all()


@pytest.mark.parametrize("camera", [BARREL, FISHEYE])
def test_undistortion_maps_are_opencvs(camera):
    coefficients, size = np.array(camera.distortion), (camera.width, camera.height)
    arguments = (camera.matrix, coefficients, np.eye(3), camera.matrix, size, cv2.CV_32FC1)
    make = cv2.fisheye.initUndistortRectifyMap if camera is FISHEYE else cv2.initUndistortRectifyMap
    image = cv2.GaussianBlur(np.random.default_rng(0).integers(0, 256, (480, 640), np.uint8), (0, 0), 3.0)
    ours, theirs = (cv2.remap(image, *m, cv2.INTER_LINEAR) for m in (camera.undistortion_maps(), make(*arguments)))
    # The maps are stored to 1/32 pixel.
    assert np.abs(ours.astype(int) - theirs)[5:-5, 5:-5].max() <= 2


def test_wrong_lenses_are_refused():
    with pytest.raises(CameraError, match="unknown lens model 'mirror'"):
        Camera(640, 480, 500.0, 500.0, 320.0, 240.0, (), "mirror")
    with pytest.raises(CameraError, match="fisheye distortion has 0 values; give 4"):
        Camera(640, 480, 500.0, 500.0, 320.0, 240.0, (), "fisheye")


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
