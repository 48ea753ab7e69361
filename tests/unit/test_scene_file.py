"""What is said of wrong scene files, and photographs by name."""

import sys
from pathlib import Path

import numpy as np
import pytest

from morph_dslam.errors import CameraError, ModelFileError, SceneError
from morph_dslam.io.hdf5_writing import written_hdf5
from morph_dslam.render.scene_file import Surface, interpolate_key_frames, load_scene_file
from morph_dslam.render.scene_renderer import LARGEST_PRINT, print_texture
from morph_dslam.render.simulation import simulate
from morph_dslam.render.texture import crop_to_aspect, load_photograph, resize_to_fill
from tests.support.scenes import CAMERA, write_scene, write_texture

PROJECT = Path(__file__).parents[2]
POSE = "[[pose]]\nframe = 0\nposition_mm = [0, 0, 620]\n"


def message_of(folder, error=SceneError, **changes):
    with pytest.raises(error) as caught:
        simulate(write_scene(folder, **changes), folder / "sequence", progress=False)
    return str(caught.value)


@pytest.mark.parametrize(
    ("top", "tail", "key", "known"),
    [
        ("framez = 5\n", POSE, "unknown key framez", "supersampling"),
        ("", POSE + "[light]\ndirecton = [0, 0, 1]\n", "unknown key light.directon", "direction"),
        ("", POSE + "rotation = [0, 0, 1]\n", "pose 1: unknown key rotation", "rotation_deg"),
        (
            "",
            POSE + "[occluder]\nradius_px = 3\n[[occluder.path]]\nframe = 0\ncentre_px = [0, 0]\nsize = 1\n",
            "occluder.path 1: unknown key size",
            "centre_px",
        ),
    ],
)
def test_unknown_key_is_named_with_those_known(tmp_path, top, tail, key, known):
    path = write_scene(tmp_path, top=top, tail=tail)
    with pytest.raises(SceneError) as caught:
        load_scene_file(path)
    said, listed = str(caught.value).split("; known here: ")
    assert said == f"{path}: {key}"
    assert known in listed.split(", ")


@pytest.mark.parametrize(
    ("tail", "expected"),
    [
        ("", "the key 'pose' is missing"),
        (POSE + "[light]\nambient = 1.5\n", "light.ambient"),
        (POSE + "[light]\ndirection = [0, 0, 0]\n", "direction must not be zero"),
        (POSE + "[background]\ncolour = [0, 0, 300]\n", "background.colour, entry 3: 300 must be at most 255"),
        (POSE + '[[parameters]]\nframe = 0\narch = "high"\n', "parameter 1: arch: 'high' must be a number"),
        (POSE + POSE, "pose must have increasing frame numbers, not [0, 0]"),
        (POSE.replace("620", "-620"), "frame 0 the object reaches behind the camera"),
        (POSE.replace("[0, 0, 620]", "[2000, 0, 620]"), "frame 0 shows 0 landmarks"),
        (
            POSE + "[[parameters]]\nframe = 2\nbulge = 1.0\n",
            "scene.toml: unknown parameter 'bulge' in key frame 2; the model has arch, skew, twist",
        ),
        (
            POSE + "[[parameters]]\nframe = 2\ntwist = 25.0\n",
            "parameter 'twist' is 25 deg in frame 2, outside the model's range -20 to 20",
        ),
    ],
)
def test_impossible_value_is_named(tmp_path, tail, expected):
    assert expected in message_of(tmp_path, tail=tail)


@pytest.mark.parametrize(
    ("top", "tail", "place"),
    [
        ("", POSE.replace("620", "1e300"), "pose 1: position_mm, entry 3: "),
        ("", POSE + "rotation_deg = [0, -1e300, 0]\n", "pose 1: rotation_deg, entry 2: "),
        ("", POSE + "[light]\ndirection = [1e300, 0, -1e300]\n", "light.direction, entry 1: "),
        ("", POSE + "[sensor]\nnoise = 1e300\n", "sensor.noise"),
        ("", POSE + "[background]\nblur_px = 1e7\n", "background.blur_px"),
        ("", POSE + f"[[pose]]\nframe = {10**30}\nposition_mm = [0, 0, 600]\n", "pose 2: frame: "),
        ("fps = 1e-300\n", POSE, "fps"),
        ("", POSE + "[[parameters]]\nframe = 0\narch = 1e300\n", "parameter 'arch' is 1e+300 mm in frame 0"),
    ],
)
def test_absurd_number_is_one_message(tmp_path, top, tail, place):
    message = message_of(tmp_path, top=top, tail=tail)
    assert message.startswith(f"{tmp_path / 'scene.toml'}: {place}")
    assert "\n" not in message


def test_absurdly_narrow_rectangle_is_drawn(tmp_path):
    """A texture cut to a rectangle a kilometre long and a millimetre high keeps one row of pixels."""
    write_texture(tmp_path)
    narrow = resize_to_fill(load_photograph("print.png", tmp_path), 3000, 2)
    assert narrow.shape == (2, 3000, 3)
    assert crop_to_aspect(np.zeros((300, 420, 3), np.uint8), 1e6).shape == (1, 420, 3)
    assert crop_to_aspect(np.zeros((300, 420, 3), np.uint8), 1e-6).shape == (300, 1, 3)


def test_print_seen_from_too_near_has_no_more_pixels_than_can_be_held(tmp_path):
    surface = Surface(texture=write_texture(tmp_path), border_mm=10.0)
    texture = print_texture(surface, tmp_path, np.array([0.4, 0.1]), 1e9)
    assert texture.shape == (LARGEST_PRINT // 4, LARGEST_PRINT, 3)
    assert (texture[:190] == 244).all()  # the border of 10 mm is 200 pixels then
    assert not (texture[210:400, 210:400] == 244).all()


def test_missing_file_and_file_that_is_not_toml(tmp_path):
    with pytest.raises(SceneError, match="cannot read the scene file"):
        load_scene_file(tmp_path / "none.toml")
    (tmp_path / "bad.toml").write_text("frames = = 3")
    with pytest.raises(SceneError, match="is not a TOML file"):
        load_scene_file(tmp_path / "bad.toml")


def test_key_frame_at_the_bound_is_in_range(tmp_path):
    path = write_scene(tmp_path, "frames = 1\n", POSE + "[[parameters]]\nframe = 0\ntwist = 20.0\n")
    simulate(path, tmp_path / "sequence", progress=False)
    assert np.load(tmp_path / "sequence" / "truth.npz")["parameters"][0, 2] == np.radians(20)


def test_curve_that_swings_out_of_range_between_key_frames(tmp_path):
    keys = "".join(f"[[parameters]]\nframe = {f}\narch = {a}\n" for f, a in ((0, 0), (10, 59), (12, 59), (22, 0)))
    message = message_of(tmp_path, top="frames = 23\n", tail=POSE + keys)
    assert "parameter 'arch'" in message
    assert "in frame 11" in message
    assert "swings beyond its key frames" in message


def test_files_that_it_names(tmp_path):
    assert "there is no image" in message_of(tmp_path, texture="none.png")
    assert "none.yaml" in message_of(tmp_path, CameraError, camera='camera = "none.yaml"\n')
    broken = CAMERA.replace("fx = 260.0, ", "")
    assert "camera: fx" in message_of(tmp_path, CameraError, camera=broken)
    folded = CAMERA.replace("121.0", "121.0, distortion = [-1.0, 0, 0, 0]")
    assert "give a weaker distortion" in message_of(tmp_path, camera=folded)
    lens = CAMERA.replace("121.0", "121.0, distortion = [0.1, 0, 0, 0]")
    assert "a depth sensor's images are those of an ideal pinhole" in message_of(
        tmp_path, camera=lens, tail=f"{POSE}[depth_sensor]\n"
    )
    path = write_scene(tmp_path)
    (tmp_path / "sheet.morph").write_bytes(b"no model")
    with pytest.raises(ModelFileError):
        simulate(path, tmp_path / "sequence", progress=False)


def test_damaged_texture_leaves_earlier_frames_alone(tmp_path):
    path = write_scene(tmp_path, "frames = 1\n", POSE)
    simulate(path, tmp_path / "sequence", progress=False)
    (tmp_path / "print.png").write_bytes(b"")
    with pytest.raises(SceneError, match=r"photograph 'print\.png'"):
        simulate(path, tmp_path / "sequence", progress=False)
    assert (tmp_path / "sequence" / "frames" / "000000.png").is_file()


def test_packaged_photograph(tmp_path):
    pytest.importorskip("skimage")
    assert load_photograph("coffee", tmp_path).shape == (400, 600, 3)
    with pytest.raises(SceneError, match=r"no photograph 'tea': use one of .*coffee"):
        load_photograph("tea", tmp_path)


def test_packaged_photograph_without_the_package(tmp_path, monkeypatch):
    monkeypatch.delitem(sys.modules, "skimage", raising=False)
    monkeypatch.setattr("morph_dslam.render.texture.find_spec", lambda name: None)
    with pytest.raises(SceneError, match=r"pip install '\.\[demo\]'"):
        load_photograph("coffee", tmp_path)


def test_key_frame_curve_is_smooth_to_the_second_derivative():
    keys, values = [0, 7, 11, 30], np.array([0.0, 2.0, -1.0, 3.0])
    step = 1e-3
    fine = interpolate_key_frames(keys, values, np.arange(0.0, 30.0, step))
    second = np.diff(fine, 2) / step**2
    # A jump in the second derivative would be far larger than its change over one step.
    assert np.abs(np.diff(second)).max() < 0.01 * np.ptp(second)
    np.testing.assert_allclose(interpolate_key_frames(keys, values, np.array(keys)), values, atol=1e-12)
    np.testing.assert_allclose(interpolate_key_frames(keys, values, np.array([-3, 40])), [0.0, 3.0])


def test_scene_of_the_demo_is_valid():
    assert load_scene_file(PROJECT / "examples" / "demo" / "scene.toml").frames > 1


def test_folder_that_another_simulation_writes_is_left_alone(tmp_path):
    path = write_scene(tmp_path, "frames = 1\n", POSE)
    simulate(path, tmp_path / "sequence", progress=False)
    with (
        written_hdf5(tmp_path / "sequence" / "depth.h5"),
        pytest.raises(SceneError, match=r"cannot write .*depth\.h5: is another simulation writing"),
    ):
        simulate(path, tmp_path / "sequence", progress=False)
    assert (tmp_path / "sequence" / "frames" / "000000.png").is_file()
