"""Camera files and calibrations of other programs: the numbers read, and what is refused.

Files are written as those programs write them; OpenCV's by OpenCV itself.
"""

from dataclasses import replace

import cv2
import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from morph_dslam.camera import Camera
from morph_dslam.errors import CameraError
from morph_dslam.geometry import RigidTransform
from morph_dslam.io.camera_doubts import camera_doubts
from morph_dslam.io.camera_files import load_camera, load_camera_or_pair, save_camera
from tests.support.real_data import real_data

GOOD = "width: 640\nheight: 480\nfx: 528.0\nfy: 527.5\ncx: 320\ncy: 239.5\n"
ROS = """image_width: 640
image_height: 480
camera_name: narrow_stereo
camera_matrix:
  rows: 3
  cols: 3
  data: [458.654, 0, 367.215, 0, 457.296, 248.375, 0, 0, 1]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [-0.28, 0.07, 0.0002, 1.76e-05, 0]
rectification_matrix: {rows: 3, cols: 3, data: [1, 0, 0, 0, 1, 0, 0, 0, 1]}
"""
ROS_TOPIC = """header: {frame_id: cam}
height: 480
width: 640
distortion_model: equidistant
d: [0.01, -0.02, 0.003, 1e-05]
k: [300.0, 0.0, 320.0, 0.0, 301.0, 240.0, 0.0, 0.0, 1.0]
"""
ORB_SLAM2 = """%YAML:1.0

# Camera calibration
Camera.fx: 458.654
Camera.fy: 457.296
Camera.cx: 367.215
Camera.cy: 248.375
Camera.k1: -0.28
Camera.k2: 0.07
Camera.p1: 0.0002
Camera.p2: 1.76e-05
Camera.width: 752
Camera.height: 480
Camera.fps: 20.0
ORBextractor.nFeatures: 1000
"""
ORB_SLAM3 = """%YAML:1.0
File.version: "1.0"
Camera.type: "KannalaBrandt8"
Camera1.fx: 190.97
Camera1.fy: 190.97
Camera1.cx: 254.93
Camera1.cy: 256.89
Camera1.k1: 0.0034
Camera1.k2: 0.0007
Camera1.k3: -0.002
Camera1.k4: 0.0002
Camera.width: 512
Camera.height: 512
"""
KALIBR = """cam0:
  cam_overlaps: [1]
  camera_model: pinhole
  distortion_coeffs: [-0.28, 0.07, 0.0002, 1e-05]
  distortion_model: radtan
  intrinsics: [458.654, 457.296, 367.215, 248.375]
  resolution: [752, 480]
  rostopic: /cam0/image_raw
cam1:
  T_cn_cnm1:
  - [1.0, 0.0, 0.0, -0.11]
  - [0.0, 1.0, 0.0, 0.0]
  - [0.0, 0.0, 1.0, 0.0]
  - [0.0, 0.0, 0.0, 1.0]
  camera_model: pinhole
  distortion_coeffs: [0.01, -0.02, 0.003, 0.0]
  distortion_model: equidistant
  intrinsics: [380.0, 381.0, 370.0, 250.0]
  resolution: [752, 480]
  rostopic: /cam1/image_raw
"""
EUROC = """%YAML:1.0
sensor_type: camera
comment: VI-Sensor cam0 (MT9M034)
T_BS:
  cols: 4
  rows: 4
  data: [1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0]
rate_hz: 20
resolution: [752, 480]
camera_model: pinhole
intrinsics: [458.654, 457.296, 367.215, 248.375] #fu, fv, cu, cv
distortion_model: radial-tangential
distortion_coefficients: [-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05]
"""
BROWN = (-0.28, 0.07, 0.0002, 1.76e-05)


def test_a_handwritten_file_is_read(tmp_path):
    (tmp_path / "camera.yaml").write_text(GOOD)
    assert load_camera(tmp_path / "camera.yaml") == Camera(640, 480, 528.0, 527.5, 320.0, 239.5)


def test_the_readout_time_of_a_rolling_shutter_is_read_and_written(tmp_path):
    path = tmp_path / "camera.yaml"
    path.write_text(GOOD + "readout_s: 0.0333\n")
    camera = load_camera(path)
    assert camera == Camera(640, 480, 528.0, 527.5, 320.0, 239.5, readout_s=0.0333)
    save_camera(path, camera)
    assert load_camera(path) == camera
    path.write_text(ROS + "readout_s: -0.02\n")
    assert load_camera(path).readout_s == -0.02


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (ROS, Camera(640, 480, 458.654, 457.296, 367.215, 248.375, BROWN)),
        (ROS_TOPIC, Camera(640, 480, 300, 301, 320, 240, (0.01, -0.02, 0.003, 1e-5), "fisheye")),
        (ROS.replace("-0.28, 0.07, 0.0002, 1.76e-05, 0", "0, 0, 0, 0, 0"), (458.654, ())),
        (ORB_SLAM2, Camera(752, 480, 458.654, 457.296, 367.215, 248.375, BROWN)),
        (ORB_SLAM3, Camera(512, 512, 190.97, 190.97, 254.93, 256.89, (0.0034, 0.0007, -0.002, 0.0002), "fisheye")),
        (EUROC, (458.654, (-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05))),
    ],
)
def test_yaml_of_other_programs(tmp_path, text, expected):
    path = tmp_path / "camera.yaml"
    path.write_text(text)
    camera = load_camera(path)
    if isinstance(expected, tuple):
        assert (camera.fx, camera.distortion) == expected
    else:
        assert camera == expected
    # What was read is kept by our own format.
    save_camera(tmp_path / "own.yaml", camera)
    assert load_camera(tmp_path / "own.yaml") == camera


def test_the_first_message_of_a_topic_is_read(tmp_path):
    path = tmp_path / "camera_info.yaml"
    path.write_text(f"{ROS_TOPIC}---\n")
    assert load_camera(path).fx == 300.0
    path.write_text(f"{ROS_TOPIC}---\n{ROS_TOPIC.replace('300.0', '310.0')}---\n")
    assert load_camera(path).fx == 300.0


ROI = "roi: {x_offset: %d, y_offset: %d, height: %d, width: %d, do_rectify: false}\n"


@pytest.mark.parametrize(
    ("lines", "left", "top", "size", "by"),
    [
        ("binning_x: 0\nbinning_y: 0\n" + ROI % (0, 0, 0, 0), 0, 0, (640, 480), 1),
        ("binning_x: 1\nbinning_y: 1\n" + ROI % (0, 0, 480, 640), 0, 0, (640, 480), 1),
        (ROI % (60, 40, 280, 360), 60, 40, (360, 280), 1),
        ("binning_x: 2\nbinning_y: 2\n", 0, 0, (320, 240), 2),
        ("binning_x: 4\nbinning_y: 4\n" + ROI % (60, 40, 280, 360), 60, 40, (90, 70), 4),
    ],
)
def test_what_ros_read_out_of_a_sensor(tmp_path, lines, left, top, size, by):
    path = tmp_path / "camera_info.yaml"
    path.write_text(ROS + lines)
    camera = load_camera(path)
    assert (camera.width, camera.height) == size
    assert camera.distortion == BROWN
    # Pictures whose values are where each pixel was in the full image, cut and merged as a sensor does.
    full = Camera(640, 480, 458.654, 457.296, 367.215, 248.375, BROWN)
    where = np.stack(np.meshgrid(np.arange(640.0), np.arange(480.0)), axis=-1)
    read = where[top : top + size[1] * by, left : left + size[0] * by]
    read = cv2.resize(read, size, interpolation=cv2.INTER_AREA)
    points = np.array([[0.0, 0.0, 1.0], [-0.2, 0.1, 1.0], [-0.3, -0.2, 1.1]])
    pixels = camera.project_recorded(points).astype(np.float32)
    found = cv2.remap(read, pixels[None, :, 0], pixels[None, :, 1], cv2.INTER_LINEAR)[0]
    np.testing.assert_allclose(found, full.project_recorded(points), atol=0.1)


@pytest.mark.parametrize(
    "lines",
    [ROI % (400, 0, 480, 360), ROI % (60, 40, 0, 0), ROI % (-1, 0, 9, 9), "binning_x: 0.5\n", "binning_y: 481\n"],
)
def test_what_no_sensor_reads_out_is_refused(tmp_path, lines):
    path = tmp_path / "camera_info.yaml"
    path.write_text(ROS + lines)
    with pytest.raises(CameraError, match=r"camera_info\.yaml: roi .* of 640x480, the full size: correct them"):
        load_camera(path)


CAMERA = Camera(640, 480, 528.0, 528.0, 320.0, 240.0)


@pytest.mark.parametrize(
    ("change", "doubt"),
    [
        ({"cx": 640.0, "cy": 480.0, "fx": 1056.0, "fy": 1056.0}, "principal point (640, 480) px is far"),
        ({"width": 1280, "height": 960}, "principal point (320, 240) px is far"),
        ({"fy": 352.0}, "fx and fy, 528 and 352 px"),
        # x (1 - 28 x^2 + 7 x^4) is largest at x = 0.11: all is imaged within 38 px of the middle.
        ({"distortion": (-28.0, 7.0, 0.0, 0.0)}, "folds the image"),
        ({}, ""),
        ({"cx": 230.0, "fx": 500.0}, ""),
        ({"distortion": (-0.28, 0.07, 0.0, 0.0)}, ""),
        # The first camera of TUM RGB-D, as published.
        ({"distortion": (0.2624, -0.9531, -0.0054, 0.0026, 1.1633)}, ""),
        ({"distortion": (0.01, 0.0, 0.0, 0.0), "lens_model": "fisheye", "fx": 150.0, "fy": 150.0}, ""),
    ],
)
def test_a_camera_that_is_hardly_right_is_doubted(change, doubt):
    doubts = list(camera_doubts(replace(CAMERA, **change)))
    assert len(doubts) == bool(doubt)
    assert doubt in "".join(doubts)


def test_a_camera_chosen_from_a_chain(tmp_path):
    path = tmp_path / "camchain.yaml"
    path.write_text(KALIBR)
    assert load_camera(tmp_path / "camchain.yaml#cam0").distortion == (-0.28, 0.07, 0.0002, 1e-5)
    second = load_camera(tmp_path / "camchain.yaml#cam1")
    assert second == Camera(752, 480, 380, 381, 370, 250, (0.01, -0.02, 0.003, 0.0), "fisheye")
    with pytest.raises(CameraError, match=r"holds the cameras cam0, cam1: choose one, .*camchain\.yaml#cam0"):
        load_camera(path)
    with pytest.raises(CameraError, match="holds the cameras cam0, cam1"):
        load_camera(tmp_path / "camchain.yaml#cam2")


@pytest.mark.parametrize("n_coefficients", [4, 5, 8, 14])
def test_what_opencv_writes(tmp_path, n_coefficients):
    path = tmp_path / "opencv.yml"
    matrix = np.array([[535.9157, 0.0, 342.283], [0.0, 534.1, 235.571], [0.0, 0.0, 1.0]])
    coefficients = np.zeros((n_coefficients, 1))
    used = min(n_coefficients, 8)
    coefficients[:used, 0] = [-0.266, -0.0386, 1.8e-3, -2.8e-4, 0.238, 0.01, 0.02, 0.03][:used]
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    storage.write("image_width", 640)
    storage.write("image_height", 480)
    storage.write("camera_matrix", matrix)
    storage.write("distortion_coefficients", coefficients)
    storage.release()
    camera = load_camera(path)
    np.testing.assert_allclose(camera.matrix, matrix, rtol=1e-14)
    np.testing.assert_allclose(camera.distortion, coefficients[:used, 0], rtol=1e-14)
    assert (camera.width, camera.height) == (640, 480)


@pytest.mark.parametrize(
    ("line", "distortion", "lens"),
    [
        ("SIMPLE_PINHOLE 640 480 500 320 240", (), "radial-tangential"),
        ("PINHOLE 640 480 500 500 320 240", (), "radial-tangential"),
        ("SIMPLE_RADIAL 640 480 500 320 240 -0.1", (-0.1, 0, 0, 0), "radial-tangential"),
        ("RADIAL 640 480 500 320 240 -0.1 0.02", (-0.1, 0.02, 0, 0), "radial-tangential"),
        ("OPENCV 640 480 500 500 320 240 -0.1 0.02 3e-4 4e-4", (-0.1, 0.02, 3e-4, 4e-4), "radial-tangential"),
        ("FULL_OPENCV 640 480 500 500 320 240 1 2 3 4 5 6 7 8", (1, 2, 3, 4, 5, 6, 7, 8), "radial-tangential"),
        ("OPENCV_FISHEYE 640 480 500 500 320 240 1 2 3 4", (1, 2, 3, 4), "fisheye"),
        ("RADIAL_FISHEYE 640 480 500 320 240 0.1 0.2", (0.1, 0.2, 0, 0), "fisheye"),
    ],
)
def test_colmap_cameras(tmp_path, line, distortion, lens):
    path = tmp_path / "cameras.txt"
    path.write_text(f"# Camera list\n#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n1 {line}\n")
    # COLMAP's centre of a 640x480 image is (320, 240); with pixel centres at whole numbers (319.5, 239.5).
    assert load_camera(path) == Camera(640, 480, 500, 500, 319.5, 239.5, distortion, lens)


def test_a_camera_chosen_from_a_colmap_model(tmp_path):
    path = tmp_path / "cameras.txt"
    path.write_text("1 PINHOLE 640 480 500 500 320 240\n7 PINHOLE 640 480 600 600 320 240\n")
    assert load_camera(tmp_path / "cameras.txt#7").fx == 600.0
    with pytest.raises(CameraError, match="holds the cameras 1, 7: choose one"):
        load_camera(path)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "holds no camera"),
        ("- 1\n- 2\n", "holds no camera"),
        ("width: [640\n", "not a YAML file"),
        (GOOD.replace("fx: 528.0\n", ""), "fx is missing"),
        (GOOD + "readout_s: 33.3\n", "readout_s is 33.3: give the seconds"),
        (GOOD + "focal: 3\n", "unknown key focal; known here: width, height, fx"),
        (GOOD.replace("528.0", "wide"), "fx: 'wide' must be a number"),
        (GOOD.replace("528.0", ".nan"), "fx: nan must be a finite number"),
        (GOOD.replace("528.0", "-528"), "fx: -528 must be greater than 0;"),
        (GOOD.replace("640", "0"), "width: 0 must be greater than 0;"),
        (GOOD + "distortion: [0.1, 0.2]\n", "distortion has 2 values"),
        (GOOD + "distortion: [0.1, .nan, 0, 0]\n", "distortion"),
        (ROS.replace("plumb_bob", "omni"), "unknown distortion model 'omni'; known are plumb_bob"),
        (ROS.replace("image_width: 640\n", ""), "does not say for what image size"),
        (ROS.replace("458.654, 0, 367", "458.654, 3, 367"), "skew is not modelled"),
        (ROS.replace(", 0, 0, 1]\ndist", ", 0, 0]\ndist"), "camera matrix has 8 values, not 9"),
        (ROS.replace("458.654", "'wide'"), "camera matrix is not a list of numbers"),
        (ROS.replace("458.654", "-458.654"), "fx: -458.654 must be greater than 0;"),
        (ROS.replace("1.76e-05, 0]", "1, 2, 3]"), "distortion has 6 values; give 4 or 5 or 8, or none"),
        (ROS_TOPIC.replace(", 1e-05]", "]"), "fisheye distortion has 3 values; give 4"),
        (ROS_TOPIC.replace("equidistant", "''"), "but no distortion model"),
        (ORB_SLAM2.replace("Camera.width: 752\n", ""), "add the lines Camera.width: and Camera.height:"),
        (ORB_SLAM2.replace("Camera.fx: 458.654\n", ""), "Camera.fx is missing"),
        (ORB_SLAM2.replace("Camera.fy: 457.296\n", ""), "fy is missing"),
        (ORB_SLAM3.replace("KannalaBrandt8", "Omni"), "unknown Camera.type 'Omni'"),
        (EUROC.replace("pinhole", "eucm"), "unknown camera model 'eucm'"),
        (EUROC.replace("[752, 480]", "752"), "resolution is not a list of numbers"),
        (EUROC.replace("[752, 480]", "[.nan, 480]"), "width: "),
        (EUROC.replace("[752, 480]", "[752, .inf]"), "height: "),
        (EUROC.replace("[752, 480]", "[752.7, 480]"), "width: "),
        ("M1: [1]\nM2: [1]\n", "stereo calibration without single cameras"),
    ],
)
def test_yaml_that_is_refused(tmp_path, text, message):
    path = tmp_path / "camera.yaml"
    path.write_text(text)
    with pytest.raises(CameraError, match=message) as caught:
        load_camera(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("# nothing\n", "holds no camera"),
        ("1 PINHOLE 640\n", r"line 1: a camera is ID MODEL"),
        ("1 FOV 640 480 500 500 320 240 1\n", "line 1: unknown camera model 'FOV'"),
        ("1 PINHOLE 640 480 500 320 240\n", "line 1: PINHOLE has width, height, then fx, fy, cx, cy"),
        ("1 PINHOLE 640 480 500 x 320 240\n", "line 1: PINHOLE has width"),
    ],
)
def test_colmap_cameras_that_are_refused(tmp_path, text, message):
    path = tmp_path / "cameras.txt"
    path.write_text(text)
    with pytest.raises(CameraError, match=message):
        load_camera(path)


def test_missing_binary_and_folder_are_refused(tmp_path):
    with pytest.raises(CameraError, match=r"cannot read the camera file .*absent\.yaml"):
        load_camera(tmp_path / "absent.yaml")
    with pytest.raises(CameraError, match=r"is a folder.*give a camera file"):
        load_camera(tmp_path)
    (tmp_path / "image.yaml").write_bytes(bytes(range(128, 256)))
    with pytest.raises(CameraError, match="not a text file"):
        load_camera(tmp_path / "image.yaml")
    (tmp_path / "camera.yaml").write_text(GOOD)
    with pytest.raises(CameraError, match="one camera only"):
        load_camera(tmp_path / "camera.yaml#cam1")


def test_the_published_calibration_of_opencvs_samples():
    camera = load_camera(real_data("opencv_calib") / "left_intrinsics.yml")
    assert camera.fx == pytest.approx(535.91573396163199, rel=1e-15)
    assert camera.distortion[0] == pytest.approx(-0.26637260909660682, rel=1e-15)
    assert (camera.width, camera.height) == (640, 480)


LEFT = Camera(320, 240, 210.0, 212.0, 161.0, 118.0, (-0.28, 0.07, 2e-4, 2e-5))
RIGHT = Camera(320, 240, 205.0, 204.0, 157.0, 121.0, (0.01, -0.02, 0.003, 0.0), "fisheye")
RIGHT_IN_LEFT = RigidTransform(
    Rotation.from_euler("xyz", [1.0, -2.0, 0.5], degrees=True).as_matrix(), np.array([0.11, -0.002, 0.001])
)


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
        "cam1": sensor(RIGHT, "distortion_coeffs", T_cn_cnm1=RIGHT_IN_LEFT.inverse.matrix.tolist()),
    }
    path.write_text(yaml.safe_dump(chain))
    pair = load_camera_or_pair(path)
    assert (pair.left, pair.right) == (LEFT, RIGHT)
    np.testing.assert_allclose(pair.right_from_left.matrix, RIGHT_IN_LEFT.inverse.matrix, atol=1e-12)
    # The readout time, which may be added, is that of the camera alone and in the pair: their maps are the same.
    chain["cam0"]["readout_s"] = 0.02
    path.write_text(yaml.safe_dump(chain))
    assert load_camera_or_pair(path).left == load_camera(f"{path}#cam0") == replace(LEFT, readout_s=0.02)
    del chain["cam1"]["T_cn_cnm1"]
    path.write_text(yaml.safe_dump(chain))
    with pytest.raises(CameraError, match="cam1: T_cn_cnm1 is not a list of numbers"):
        load_camera_or_pair(path)
    chain["cam1"]["T_cn_cnm1"] = (2.0 * np.eye(4)).tolist()
    path.write_text(yaml.safe_dump(chain))
    with pytest.raises(CameraError, match="is not a rotation and a translation"):
        load_camera_or_pair(path)


def test_euroc_gives_both_poses_in_the_body(tmp_path):
    body_from_left = RigidTransform(Rotation.from_euler("zyx", [80, 3, -2], degrees=True).as_matrix(), np.ones(3))
    body_from_right = body_from_left @ RIGHT_IN_LEFT
    for name, camera, pose in (("cam0", LEFT, body_from_left), ("cam1", RIGHT, body_from_right)):
        folder = tmp_path / "mav0" / name
        folder.mkdir(parents=True)
        matrix = {"rows": 4, "cols": 4, "data": pose.matrix.ravel().tolist()}
        (folder / "sensor.yaml").write_text("%YAML:1.0\n" + yaml.safe_dump(sensor(camera, T_BS=matrix)))
    for given in (tmp_path, tmp_path / "mav0"):
        pair = load_camera_or_pair(given)
        assert (pair.left, pair.right) == (LEFT, RIGHT)
        np.testing.assert_allclose(pair.right_from_left.matrix, RIGHT_IN_LEFT.inverse.matrix, atol=1e-12)
        # Where one camera is needed, as that of the pair's map, it is the left one.
        assert load_camera(given) == LEFT
    with (tmp_path / "mav0" / "cam0" / "sensor.yaml").open("a") as file:
        file.write("readout_s: 0.02\n")
    assert load_camera_or_pair(tmp_path).left == load_camera(tmp_path) == replace(LEFT, readout_s=0.02)
    for load in (load_camera, load_camera_or_pair):
        with pytest.raises(CameraError, match=r"is a folder.*cam0/sensor.yaml: give a camera file"):
            load(tmp_path / "mav0" / "cam1")
    (tmp_path / "mav0" / "cam1" / "sensor.yaml").unlink()
    with pytest.raises(CameraError, match=r"no stereo pair: there is no .*cam1"):
        load_camera_or_pair(tmp_path)


def test_opencvs_xml_is_named_with_what_to_save_instead(tmp_path):
    files = {name: tmp_path / f"camera.{name}" for name in ("xml", "yaml")}
    for path in files.values():
        storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
        storage.write("image_width", 640)
        storage.write("image_height", 480)
        storage.write("camera_matrix", np.array([[528.0, 0, 320], [0, 527.5, 239.5], [0, 0, 1]]))
        storage.release()
    with pytest.raises(CameraError, match=r"is XML, which is not read .* ends with \.yaml"):
        load_camera(files["xml"])
    assert load_camera(files["yaml"]).intrinsics.tolist() == [528.0, 527.5, 320.0, 239.5]


def test_a_euroc_folder_with_one_camera_is_no_pair_and_says_which_file_is_its_camera(tmp_path):
    left = tmp_path / "mav0" / "cam0" / "sensor.yaml"
    left.parent.mkdir(parents=True)
    content = {"camera_model": "pinhole", "resolution": [640, 480], "intrinsics": [528.0, 527.5, 320.0, 239.5]}
    left.write_text(yaml.safe_dump(content | {"T_BS": {"data": np.eye(4).ravel().tolist()}}))
    with pytest.raises(CameraError, match=r"no stereo pair: .*for one camera give ") as error:
        load_camera_or_pair(tmp_path)
    named = str(error.value).rsplit(" ", 1)[1]
    camera = load_camera_or_pair(named)
    assert isinstance(camera, Camera)
    assert camera.intrinsics.tolist() == [528.0, 527.5, 320.0, 239.5]
