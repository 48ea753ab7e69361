"""Cameras, lenses and stereo pairs against OpenCV, finite differences and closed forms."""

import re
from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from morph_dslam.camera import Camera, StereoCamera
from morph_dslam.errors import CameraError
from morph_dslam.geometry import RigidTransform
from morph_dslam.io.camera_doubts import camera_doubts

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


def test_a_fisheye_sees_more_than_a_pinhole_does():
    # Equidistant with k = 0: the image radius is the angle itself, here 120 degrees to the right.
    lens = Camera(640, 480, 100.0, 100.0, 320.0, 240.0, (0.0, 0.0, 0.0, 0.0), "fisheye")
    aside = np.array([[np.sin(2.0 * np.pi / 3.0), 0.0, np.cos(2.0 * np.pi / 3.0)], [0.0, 0.0, 1.0]])
    expected = [[320.0 + 100.0 * 2.0 * np.pi / 3.0, 240.0], [320.0, 240.0]]
    np.testing.assert_allclose(lens.project_recorded(aside), expected, atol=1e-9)
    assert np.isnan(lens.undistort_pixels(np.array(expected))[0]).all()
    np.testing.assert_allclose(lens.undistort_pixels(np.array(expected))[1], [320.0, 240.0])


def test_pixels_beyond_the_fold_of_the_distortion_are_not_undistorted():
    # r (1 - r^2 / 3) is largest, 2/3, at r = 1: nothing is imaged farther out.
    folding = Camera(640, 480, 300.0, 300.0, 320.0, 240.0, (-1.0 / 3.0, 0.0, 0.0, 0.0))
    inside, outside = [320.0 + 300.0 * 0.5 * (1 - 0.25 / 3.0), 240.0], [320.0 + 300.0 * 0.7, 240.0]
    found = folding.undistort_pixels(np.array([inside, outside]))
    np.testing.assert_allclose(found[0], [470.0, 240.0], atol=1e-6)
    assert np.isnan(found[1]).all()


#: r - r^3 / 2 + r^5 / 10 grows up to 0.6 at r = 1, falls to r = sqrt(2), and grows again; the fisheye's r is an angle.
GROWS_AGAIN = Camera(640, 480, 400.0, 400.0, 319.5, 239.5, (-0.5, 0.1, 0.0, 0.0))
FISHEYE_GROWS_AGAIN = replace(GROWS_AGAIN, distortion=(-0.5, 0.1, 0.0, 0.0), lens_model="fisheye")


@pytest.mark.parametrize("camera", [GROWS_AGAIN, FISHEYE_GROWS_AGAIN])
def test_the_inverse_of_a_lens_ends_at_its_fold_though_the_image_grows_again_behind_it(camera):
    def recorded_at(r):
        radius = r - r**3 / 2.0 + r**5 / 10.0
        directions = np.deg2rad(np.arange(0.0, 360.0, 30.0))
        x, y = np.outer(radius, np.cos(directions)), np.outer(radius, np.sin(directions))
        return 400.0 * np.stack([x, y], axis=-1).reshape(-1, 2) + [319.5, 239.5]

    before = np.linspace(0.01, 0.999, 200)
    rays = camera.rays(camera.undistort_pixels(recorded_at(before)))
    found = np.hypot(rays[:, 0], rays[:, 1]).reshape(200, 12)
    expected = np.tan(before) if camera is FISHEYE_GROWS_AGAIN else before
    np.testing.assert_allclose(found, np.tile(expected[:, None], (1, 12)), rtol=1e-5)
    beyond = recorded_at(np.linspace(2.0, 2.3, 50))  # radii from 1.2, which are larger than 0.6
    assert np.isnan(camera.undistort_pixels(beyond)).all()
    just_beyond = np.array([[319.5 + 400.0 * radius, 239.5] for radius in np.linspace(0.6001, 0.7, 50)])
    assert np.isnan(camera.undistort_pixels(just_beyond)).all()


@pytest.mark.parametrize("k", [(-0.2, 0.0, 0.0, 0.0), (-0.1, -0.05, 0.0, 0.0), (-0.05, -0.03, 0.01, -0.004)])
def test_a_fisheye_gives_the_pixels_within_its_largest_radius_a_ray_and_no_others(k):
    lens = Camera(640, 480, 300.0, 300.0, 319.5, 239.5, k, "fisheye")
    angles = np.linspace(0.0, np.pi / 2, 200_001)
    largest = np.max(angles * (1.0 + sum(c * angles ** (2 * i + 2) for i, c in enumerate(k))))
    columns, rows = np.meshgrid(np.arange(0.0, 640.0, 3.0), np.arange(0.0, 480.0, 3.0))
    pixels = np.column_stack([columns.ravel(), rows.ravel()])
    radius = np.hypot(*(pixels - [319.5, 239.5]).T) / 300.0
    beyond = radius > largest
    assert 0.02 < beyond.mean() < 0.5
    np.testing.assert_array_equal(np.isnan(lens.undistort_pixels(pixels)).all(axis=1), beyond)


@pytest.mark.parametrize("distortion", [RATIONAL.distortion, (0.25, -0.1, 0.0, 0.0, 0.04), (-0.2, 0.06, 1e-3, 1e-3)])
def test_each_pixel_before_the_fold_has_its_ray(distortion):
    lens = replace(PLAIN, fx=300.0, fy=300.0, distortion=distortion)
    columns, rows = np.meshgrid(np.linspace(0.0, 639.0, 40), np.linspace(0.0, 479.0, 30))
    rays = PLAIN.rays(np.column_stack([columns.ravel(), rows.ravel()])) * [1.5, 1.5, 1.0]
    found = lens.rays(lens.undistort_pixels(opencv_pixels(lens, rays)))
    np.testing.assert_allclose(found, rays, atol=1e-6)


def test_what_is_beyond_the_fold_is_not_undistorted_and_a_doubt_says_how_much_of_the_picture_that_is():
    columns, rows = np.meshgrid(np.arange(640.0), np.arange(480.0))
    radius = np.hypot(columns - 319.5, rows - 239.5) / 400.0
    wide = replace(GROWS_AGAIN, fx=300.0, fy=300.0)
    white = np.full((480, 640), 255, np.uint8)
    undistorted = cv2.remap(white, *wide.undistortion_maps(), cv2.INTER_LINEAR)
    assert not undistorted[radius * 4.0 / 3.0 > 1.01].any()
    assert (undistorted[radius * 4.0 / 3.0 < 0.99] == 255).all()
    (doubt,) = camera_doubts(wide)
    share = float(re.search(r"in (\d+)% of it", doubt)[1])
    assert abs(share - 100.0 * (radius * 4.0 / 3.0 > 0.6).mean()) < 5.0


@pytest.mark.parametrize("camera", [BARREL, FISHEYE])
def test_undistortion_maps_are_opencvs(camera):
    coefficients, size = np.array(camera.distortion), (camera.width, camera.height)
    arguments = (camera.matrix, coefficients, np.eye(3), camera.matrix, size, cv2.CV_32FC1)
    make = cv2.fisheye.initUndistortRectifyMap if camera is FISHEYE else cv2.initUndistortRectifyMap
    image = cv2.GaussianBlur(np.random.default_rng(0).integers(0, 256, (480, 640), np.uint8), (0, 0), 3.0)
    ours, theirs = (cv2.remap(image, *m, cv2.INTER_LINEAR) for m in (camera.undistortion_maps(), make(*arguments)))
    # The maps are stored to 1/32 pixel.
    assert np.abs(ours.astype(int) - theirs)[5:-5, 5:-5].max() <= 2


@pytest.mark.parametrize("camera", [PLAIN, BARREL, FISHEYE])
def test_what_is_not_blended_comes_from_the_nearest_recorded_pixel(camera):
    columns, rows = np.meshgrid(np.arange(640.0), np.arange(480.0))
    pixels = np.column_stack([columns.ravel(), rows.ravel()])
    recorded = opencv_pixels(camera, camera.rays(pixels))
    # Each recorded pixel's value says where it is.
    values = (columns + 1000.0 * rows).astype(np.float32)
    found = camera.undistort_unblended(values, np.nan).ravel()
    taken = np.column_stack([found % 1000.0, found // 1000.0])
    inside = ((recorded > 0.0) & (recorded < [639.0, 479.0])).all(axis=1)
    assert np.abs(taken - recorded)[inside].max() < 0.501
    outside = ((recorded < -1.0) | (recorded > [640.0, 480.0])).any(axis=1)
    assert np.isnan(found[outside]).all()


def test_wrong_lenses_are_refused():
    with pytest.raises(CameraError, match="unknown lens model 'mirror'"):
        Camera(640, 480, 500.0, 500.0, 320.0, 240.0, (), "mirror")
    with pytest.raises(CameraError, match="fisheye distortion has 0 values; give 4"):
        Camera(640, 480, 500.0, 500.0, 320.0, 240.0, (), "fisheye")


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"width": 0}, "width is 0"),
        ({"height": -480}, "height is -480"),
        ({"fx": -5.0}, "fx is -5"),
        ({"fy": float("nan")}, "fy is nan"),
        ({"fx": float("inf")}, "fx is inf"),
        ({"cx": float("nan")}, "finite"),
        ({"distortion": (0.1, float("inf"), 0.0, 0.0)}, "finite"),
    ],
)
def test_no_camera_has_such_intrinsics(change, named):
    with pytest.raises(CameraError, match=named):
        replace(PLAIN, **change)


def test_one_point_has_one_pixel_and_points_have_three_coordinates():
    np.testing.assert_allclose(PLAIN.project(np.array([0.1, -0.2, 2.0])), [318.5 + 26.4, 241.2 - 53.1])
    for shape in ((4, 2), (2,), (2, 4, 3)):
        with pytest.raises(CameraError, match=r"shape \(n, 3\)"):
            PLAIN.project(np.ones(shape))


def test_pictures_are_bytes_in_colour_or_grey():
    picture = np.arange(480 * 640 * 3, dtype=np.uint8).reshape(480, 640, 3)
    for channels in (picture, picture[..., 0], picture[..., :1]):
        found = PLAIN.checked_picture(channels, "frame 7")
        np.testing.assert_array_equal(found, channels.squeeze())
    unfit = [picture.astype(kind) for kind in (np.uint16, np.int64, np.float32, bool)]
    for wrong in (*unfit, np.zeros((480, 640, 4), np.uint8), picture[0, 0], picture[None], None, "frame.png"):
        with pytest.raises(CameraError, match=r"^frame 7 is .*array of uint8, \(480, 640, 3\)"):
            PLAIN.checked_picture(wrong, "frame 7")


def test_the_camera_of_images_that_were_resized_is_told():
    with pytest.raises(CameraError, match="fx: ") as caught:
        PLAIN.check_image(np.zeros((240, 320, 3), np.uint8), "frame 7")
    told = {name: float(value) for name, value in re.findall(r"(\w+): ([\d.]+)", str(caught.value).split("; of")[1])}
    points = np.random.default_rng(0).uniform([-0.5, -0.5, 1.0], [0.5, 0.5, 2.0], (9, 3))
    # The middle of the first pixel of the small image is that of the first four of the large one.
    assert Camera(**told).project(points) == pytest.approx((PLAIN.project(points) - 0.5) / 2.0, abs=0.02)
    with pytest.raises(CameraError, match=r"resize the images$"):
        PLAIN.check_image(np.zeros((640, 480), np.uint8), "frame 7")


def test_images_of_another_size_are_refused_by_name():
    PLAIN.check_image(np.zeros((480, 640, 3), np.uint8), "frame 7")
    with pytest.raises(CameraError, match="frame 7 is 0x0 pixels: it holds no picture"):
        PLAIN.check_image(np.zeros((0, 0), np.uint8), "frame 7")
    with pytest.raises(CameraError, match="frame 7 is 480x640 pixels but the camera file is for 640x480"):
        PLAIN.check_image(np.zeros((640, 480), np.uint8), "frame 7")


LEFT = Camera(320, 240, 210.0, 212.0, 161.0, 118.0, (-0.28, 0.07, 2e-4, 2e-5))
RIGHT = Camera(320, 240, 205.0, 204.0, 157.0, 121.0, (0.01, -0.02, 0.003, 0.0), "fisheye")
# The right camera is 11 cm to the right, a little higher, and turned.
RIGHT_IN_LEFT = RigidTransform(
    Rotation.from_euler("xyz", [1.0, -2.0, 0.5], degrees=True).as_matrix(), np.array([0.11, -0.002, 0.001])
)
PAIR = StereoCamera(LEFT, RIGHT, RIGHT_IN_LEFT.inverse)


def dot_image(camera, point):
    """A picture of a bright dot at a point (3,) in the camera's frame."""
    u, v = camera.project_recorded(point[None])[0]
    rows, columns = np.mgrid[: camera.height, : camera.width]
    return np.exp(-((columns - u) ** 2 + (rows - v) ** 2) / (2 * 2.0**2)).astype(np.float32)


def centre(image):
    rows, columns = np.mgrid[: image.shape[0], : image.shape[1]]
    weights = np.where(image > 0.05 * image.max(), image, 0.0)
    return np.array([(columns * weights).sum(), (rows * weights).sum()]) / weights.sum()


@pytest.mark.parametrize("point", [[0.05, 0.0, 1.0], [-0.2, 0.15, 0.8], [0.5, -0.4, 2.0]])
def test_rectified_images_share_rows_and_disparity_gives_the_point(point):
    rectified = PAIR.rectify()
    camera = rectified.camera
    right_point = PAIR.right_from_left.apply(np.array(point))
    left = centre(cv2.remap(dot_image(LEFT, np.array(point)), *rectified.left_maps, cv2.INTER_LINEAR))
    right = centre(cv2.remap(dot_image(RIGHT, right_point), *rectified.right_maps, cv2.INTER_LINEAR))
    assert right[1] == pytest.approx(left[1], abs=0.1)
    # The rectified frame is the left one turned: distances from both centres stay.
    found = camera.rays(left[None])[0] * camera.fx * PAIR.baseline / (left[0] - right[0])
    assert np.linalg.norm(found) == pytest.approx(np.linalg.norm(point), rel=0.01)
    beside = found - [PAIR.baseline, 0.0, 0.0]
    assert np.linalg.norm(beside) == pytest.approx(np.linalg.norm(right_point), rel=0.01)


def test_pairs_that_cannot_be_rectified():
    with pytest.raises(CameraError, match="is not to the right of the first"):
        StereoCamera(LEFT, RIGHT, RIGHT_IN_LEFT).rectify()
    with pytest.raises(CameraError, match="in one place"):
        StereoCamera(LEFT, RIGHT, RigidTransform.identity()).rectify()
    small = Camera(160, 120, 100.0, 100.0, 80.0, 60.0)
    with pytest.raises(CameraError, match="320x240 pixels, the right one 160x120"):
        StereoCamera(LEFT, small, PAIR.right_from_left).rectify()
