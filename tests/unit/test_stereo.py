"""Stereo pairs: rows and disparities against closed forms, and the calibrations they are read from."""

import cv2
import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from morph_dslam.camera import Camera, StereoCamera
from morph_dslam.errors import CameraError
from morph_dslam.geometry import RigidTransform
from morph_dslam.io.camera_files import load_stereo

LEFT = Camera(320, 240, 210.0, 212.0, 161.0, 118.0, (-0.28, 0.07, 2e-4, 2e-5))
FISHEYE = Camera(320, 240, 205.0, 204.0, 157.0, 121.0, (0.01, -0.02, 0.003, 0.0), "fisheye")
# The right camera is 11 cm to the right, a little higher, and turned.
RIGHT_IN_LEFT = RigidTransform(
    Rotation.from_euler("xyz", [1.0, -2.0, 0.5], degrees=True).as_matrix(), np.array([0.11, -0.002, 0.001])
)
PAIR = StereoCamera(LEFT, FISHEYE, RIGHT_IN_LEFT.inverse)


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
def test_rectified_images_share_rows_and_tell_depth(point):
    point, pair = np.array(point), PAIR.rectify()
    right_point = PAIR.right_from_left.apply(point)
    left = centre(cv2.remap(dot_image(LEFT, point), *pair.left_maps, cv2.INTER_LINEAR))
    right = centre(cv2.remap(dot_image(FISHEYE, right_point), *pair.right_maps, cv2.INTER_LINEAR))
    rectified = pair.rectified_from_left @ point
    np.testing.assert_allclose(left, pair.camera.project(rectified[None])[0], atol=0.1)
    assert right[1] == pytest.approx(left[1], abs=0.1)
    disparity = left[0] - right[0]
    assert disparity == pytest.approx(pair.camera.fx * np.linalg.norm([0.11, 0.002, 0.001]) / rectified[2], abs=0.1)
    assert pair.depth(np.array([disparity]))[0] == pytest.approx(rectified[2], rel=0.02)


def test_the_rectified_frame_points_to_the_right_camera():
    pair = PAIR.rectify()
    np.testing.assert_allclose(
        pair.rectified_from_left @ RIGHT_IN_LEFT.translation, [PAIR.baseline, 0.0, 0.0], atol=1e-12
    )
    np.testing.assert_allclose(pair.rectified_from_left @ pair.rectified_from_left.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(pair.rectified_from_left) == pytest.approx(1.0)
    np.testing.assert_array_equal(pair.depth(np.array([0.0, -1.0])), np.inf)


def test_pairs_that_cannot_be_rectified():
    with pytest.raises(CameraError, match="is not to the right of the first"):
        StereoCamera(LEFT, FISHEYE, RIGHT_IN_LEFT).rectify()
    with pytest.raises(CameraError, match="in one place"):
        StereoCamera(LEFT, FISHEYE, RigidTransform.identity()).rectify()
    small = Camera(160, 120, 100.0, 100.0, 80.0, 60.0)
    with pytest.raises(CameraError, match="320x240 pixels, the right one 160x120"):
        StereoCamera(LEFT, small, PAIR.right_from_left).rectify()


def sensor(camera, distortion_key="distortion_coefficients", **more):
    model = "equidistant" if camera.lens_model == "fisheye" else "radial-tangential"
    return {
        "camera_model": "pinhole",
        "intrinsics": [camera.fx, camera.fy, camera.cx, camera.cy],
        "resolution": [camera.width, camera.height],
        "distortion_model": model,
        distortion_key: list(camera.distortion),
        **more,
    }


def test_a_kalibr_chain(tmp_path):
    path = tmp_path / "camchain.yaml"
    chain = {
        "cam0": sensor(LEFT, "distortion_coeffs"),
        "cam1": sensor(FISHEYE, "distortion_coeffs", T_cn_cnm1=PAIR.right_from_left.matrix.tolist()),
    }
    path.write_text(yaml.safe_dump(chain))
    pair = load_stereo(path)
    assert (pair.left, pair.right) == (LEFT, FISHEYE)
    np.testing.assert_allclose(pair.right_from_left.matrix, PAIR.right_from_left.matrix, atol=1e-12)
    del chain["cam1"]["T_cn_cnm1"]
    path.write_text(yaml.safe_dump(chain))
    with pytest.raises(CameraError, match="cam1: T_cn_cnm1 is not a list of numbers"):
        load_stereo(path)
    chain["cam1"]["T_cn_cnm1"] = (2.0 * np.eye(4)).tolist()
    path.write_text(yaml.safe_dump(chain))
    with pytest.raises(CameraError, match="is not a rotation and a translation"):
        load_stereo(path)
    path.write_text("cam0: 1\n")
    with pytest.raises(CameraError, match="holds no stereo pair"):
        load_stereo(path)


def test_euroc_gives_both_poses_in_the_body(tmp_path):
    body_from_left = RigidTransform(Rotation.from_euler("zyx", [80, 3, -2], degrees=True).as_matrix(), np.ones(3))
    body_from_right = body_from_left @ RIGHT_IN_LEFT
    for name, camera, pose in (("cam0", LEFT, body_from_left), ("cam1", FISHEYE, body_from_right)):
        folder = tmp_path / "mav0" / name
        folder.mkdir(parents=True)
        matrix = {"rows": 4, "cols": 4, "data": pose.matrix.ravel().tolist()}
        (folder / "sensor.yaml").write_text("%YAML:1.0\n" + yaml.safe_dump(sensor(camera, T_BS=matrix)))
    for given in (tmp_path, tmp_path / "mav0"):
        pair = load_stereo(given)
        assert (pair.left, pair.right) == (LEFT, FISHEYE)
        np.testing.assert_allclose(pair.right_from_left.matrix, PAIR.right_from_left.matrix, atol=1e-12)
    (tmp_path / "mav0" / "cam1" / "sensor.yaml").unlink()
    with pytest.raises(CameraError, match=r"cannot read the camera file .*cam1"):
        load_stereo(tmp_path)
