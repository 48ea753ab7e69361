"""Camera files: what is read back, and what is refused."""

import pytest

from morph_dslam.camera import Camera
from morph_dslam.errors import CameraError
from morph_dslam.io.camera_files import load_camera, save_camera

GOOD = "width: 640\nheight: 480\nfx: 528.0\nfy: 527.5\ncx: 320\ncy: 239.5\n"


@pytest.mark.parametrize("distortion", [(), (-0.2, 0.1, 1e-3, 2e-3), (-0.2, 0.1, 1e-3, 2e-3, 0.05)])
def test_a_saved_camera_is_read_back(tmp_path, distortion):
    camera = Camera(640, 480, 528.0144, 527.5, 320.25, 239.5, distortion)
    save_camera(tmp_path / "camera.yaml", camera)
    assert load_camera(tmp_path / "camera.yaml") == camera


def test_a_handwritten_file_is_read(tmp_path):
    (tmp_path / "camera.yaml").write_text(GOOD)
    assert load_camera(tmp_path / "camera.yaml") == Camera(640, 480, 528.0, 527.5, 320.0, 239.5)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "holds no camera"),
        ("- 1\n- 2\n", "holds no camera"),
        ("width: [640\n", "not a YAML file"),
        (GOOD.replace("fx: 528.0\n", ""), "fx: Field required"),
        (GOOD + "focal: 3\n", "focal: Extra inputs"),
        (GOOD.replace("528.0", "wide"), "fx: Input should be a valid number"),
        (GOOD.replace("528.0", ".nan"), "fx: Input should be"),
        (GOOD.replace("528.0", "-528"), "fx: Input should be greater than 0"),
        (GOOD.replace("640", "0"), "width: Input should be greater than 0"),
        (GOOD + "distortion: [0.1, 0.2]\n", "distortion has 2 values"),
        (GOOD + "distortion: [0.1, .nan, 0, 0]\n", "distortion"),
    ],
)
def test_bad_camera_files_are_refused(tmp_path, text, message):
    path = tmp_path / "camera.yaml"
    path.write_text(text)
    with pytest.raises(CameraError, match=message) as caught:
        load_camera(path)
    assert str(path) in str(caught.value)


def test_missing_binary_and_folder_are_refused(tmp_path):
    with pytest.raises(CameraError, match=r"cannot read the camera file .*absent\.yaml"):
        load_camera(tmp_path / "absent.yaml")
    with pytest.raises(CameraError, match="cannot read"):
        load_camera(tmp_path)
    (tmp_path / "image.yaml").write_bytes(bytes(range(128, 256)))
    with pytest.raises(CameraError, match="not a YAML file"):
        load_camera(tmp_path / "image.yaml")
