"""Simulated sequences and scenes with a world: pictures, depths and truth against closed forms and OpenCV."""

import cv2
import h5py
import numpy as np
import pytest
import trimesh

import morph_dslam as md
from morph_dslam.cli.app import main
from morph_dslam.extend.studies import build_rigid
from morph_dslam.io.camera_files import load_camera
from morph_dslam.io.trajectory import load_trajectory
from morph_dslam.model import load_model
from morph_dslam.render.simulation import simulate
from morph_dslam.sources import open_source
from tests.support.bent_sheet import LENGTH, WIDTH
from tests.support.scenes import CAMERA, MOTION, write_scene


@pytest.fixture(scope="module")
def moving(tmp_path_factory):
    folder = tmp_path_factory.mktemp("moving")
    tail = "[sensor]\nnoise = 2.0\nblur_px = 0.5\n[occluder]\nradius_px = 25\n"
    tail += "[[occluder.path]]\nframe = 1\ncentre_px = [-40, 120]\n[[occluder.path]]\nframe = 4\n"
    tail += "centre_px = [160, 120]\n"
    simulate(write_scene(folder, top="seed = 5\n", tail=MOTION + tail), folder / "sequence", progress=False)
    return folder


@pytest.fixture(scope="module")
def truth(moving):
    return np.load(moving / "sequence" / "truth.npz")


def read_depth(folder):
    with h5py.File(folder / "sequence" / "depth.h5") as file:
        return file["depth_m"][()]


def test_the_folder_holds_what_a_tracker_needs(moving, truth):
    frames = list(open_source(moving / "sequence" / "frames"))
    assert [frame.index for frame in frames] == [0, 1, 2, 3, 4]
    assert frames[0].image.shape == (240, 320, 3)
    assert load_camera(moving / "sequence" / "camera.yaml").fy == 262.0
    n_points = truth["points_mm"].shape[1]
    assert 250 <= n_points <= 350
    assert truth["points_mm"].shape == (5, n_points, 3)
    assert truth["pixels"].shape == (5, n_points, 2)
    assert truth["visible"].shape == (5, n_points)
    assert truth["frame"].tolist() == [0, 1, 2, 3, 4]


def test_a_sequence_in_memory_is_that_of_the_folder(moving, truth):
    sequence = md.SimulatedSequence(moving / "scene.toml")
    np.testing.assert_array_equal(sequence.parameters, truth["parameters"])
    poses = [pose.matrix for pose in sequence.camera_from_object]
    np.testing.assert_array_equal(poses, truth["camera_from_object"])
    written = list(open_source(moving / "sequence" / "frames"))
    assert len(sequence) == len(written)
    for frame, other in zip(sequence, written, strict=True):
        assert (frame.index, frame.depth) == (other.index, None)
        np.testing.assert_array_equal(frame.image, other.image)


def test_truth_points_follow_the_sheet_equation(truth):
    x, y = np.meshgrid(((np.arange(21) + 0.5) / 21 - 0.5) * LENGTH, ((np.arange(15) + 0.5) / 15 - 0.5) * WIDTH)
    s, y = 2 * x.ravel() / LENGTH, y.ravel()
    for frame in range(5):
        pose = truth["camera_from_object"][frame]
        arch, skew, twist = truth["parameters"][frame]
        in_object = (truth["points_mm"][frame] * 1e-3 - pose[:3, 3]) @ pose[:3, :3]
        height = arch * (1 - s**2) * (1 + skew * s) + twist * s * y
        # Linear triangles of 15 mm sides lie up to (15 mm)²/8 times the curvature off the smooth surface.
        np.testing.assert_allclose(in_object[:, 2], height, atol=1.5e-4)


def test_truth_pixels_equal_opencv_projection(moving, truth):
    camera = load_camera(moving / "sequence" / "camera.yaml")
    for points, pixels in zip(truth["points_mm"], truth["pixels"], strict=True):
        expected, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), camera.matrix, np.zeros(5))
        np.testing.assert_allclose(pixels, expected[:, 0], atol=1e-9)


def test_key_frames_are_met_with_no_velocity_at_the_ends(truth):
    np.testing.assert_allclose(truth["parameters"][0], [0.005, 0.3, np.radians(12)], atol=1e-12)
    np.testing.assert_allclose(truth["parameters"][4], [0.045, 0.3, np.radians(12)], atol=1e-12)
    # The clamped cubic between two keys is 3 t² - 2 t³.
    np.testing.assert_allclose(truth["parameters"][1, 0], 0.005 + 0.040 * (3 / 16 - 2 / 64), atol=1e-12)
    np.testing.assert_allclose(truth["camera_from_object"][0][:3, :3], np.diag([1.0, -1.0, -1.0]), atol=1e-12)


def test_depth_images_hold_the_visible_truth_points(moving, truth):
    depth = read_depth(moving)
    for frame in range(5):
        seen = truth["visible"][frame]
        columns, rows = np.rint(truth["pixels"][frame][seen]).astype(int).T
        gap = depth[frame, rows, columns] - truth["points_mm"][frame][seen][:, 2] * 1e-3
        # Half a pixel sideways on a slope changes the depth by a millimetre or so.
        assert np.abs(gap).max() < 2.5e-3


def test_points_on_the_far_sides_of_a_thin_block_are_hidden(tmp_path):
    """Of a convex body a point is to be seen where its side is turned to the camera."""
    sides = np.array([40.0, 10.0, 5.0])
    block = trimesh.creation.box(extents=sides).subdivide_to_size(4.0)
    block.export(tmp_path / "block.stl")
    build_rigid(tmp_path / "block.stl", "mm", tmp_path / "block.morph")
    scene = tmp_path / "scene.toml"
    pose = "[[pose]]\nframe = 0\nposition_mm = [0, 0, 80]\nrotation_deg = [35, 20, 0]\n"
    surface = "[surface]\ntexture = 'gravel'\n"
    scene.write_text(f"model = 'block.morph'\nframes = 1\n{CAMERA}{surface}{pose}")
    simulate(scene, tmp_path / "sequence", progress=False)
    truth = np.load(tmp_path / "sequence" / "truth.npz")
    matrix = truth["camera_from_object"][0]
    seen_from = -matrix[:3, :3].T @ matrix[:3, 3]
    points = (truth["points_mm"][0] / 1e3 - matrix[:3, 3]) @ matrix[:3, :3]
    side = (np.abs(points) / sides).argmax(axis=1)
    rows = np.arange(len(points))
    outwards = np.sign(points[rows, side])
    faces_camera = outwards * (seen_from - points)[rows, side] > 0.0
    on_an_edge = np.sort(np.abs(points) / (sides / 2e3), axis=1)[:, 1] > 1.0 - 1e-6
    np.testing.assert_array_equal(truth["visible"][0][~on_an_edge], faces_camera[~on_an_edge])
    assert 60 < faces_camera[~on_an_edge].sum() < 0.7 * len(points)


def test_occluder_hides_what_it_covers(moving, truth):
    distance = np.linalg.norm(truth["pixels"][4] - [160, 120], axis=1)
    np.testing.assert_array_equal(truth["visible"][4], distance > 25)
    assert truth["visible"][0].all()
    assert read_depth(moving)[4, 120, 160] == 0.0
    image = list(open_source(moving / "sequence" / "frames"))[4].image
    np.testing.assert_allclose(image[110:131, 150:171].mean(axis=(0, 1)), [122, 150, 196], atol=1.0)


def test_landmarks_are_mesh_nodes_with_their_pixels(moving, truth):
    rows = np.loadtxt(moving / "sequence" / "landmarks.csv", delimiter=",", skiprows=1)
    assert len(rows) >= 8
    corners = {(x, y) for x in (-210.0, 210.0) for y in (-148.5, 148.5)}
    assert corners <= {tuple(row[:2]) for row in rows}
    model = load_model(moving / "sheet.morph")
    camera = load_camera(moving / "sequence" / "camera.yaml")
    displaced = model.positions(truth["parameters"][0])
    for x, y, z, u, v in rows:
        node = np.linalg.norm(model.nodes * 1e3 - [x, y, z], axis=1).argmin()
        pose = truth["camera_from_object"][0]
        point = pose[:3, :3] @ displaced[node] + pose[:3, 3]
        expected = (camera.matrix @ point)[:2] / point[2]
        np.testing.assert_allclose([u, v], expected, atol=1e-4)


def print_value(x, y):
    """Grey level at fractions x, y in [-0.5, 0.5] of the sheet, x to the right and y up."""
    return 120.0 + 60.0 * np.sin(14.0 * x) + 50.0 * np.cos(9.0 * y + 0.7)


def flat_picture(folder, extra="", rotation="[180, 0, 0]", light="ambient = 1.0\n"):
    """A flat sheet face on at 0.6 m whose print is a smooth function of the place on it.

    Returns
    -------
    picture : (h, w, 3)
    expected : (h, w), by the pinhole formula.
    inside : (h, w), the pixels well inside the sheet.
    """
    x, y = np.meshgrid((np.arange(840) + 0.5) / 840 - 0.5, 0.5 - (np.arange(594) + 0.5) / 594)
    cv2.imwrite(str(folder / "smooth.png"), np.rint(print_value(x, y)).astype(np.uint8))
    tail = f"[[pose]]\nframe = 0\nposition_mm = [0, 0, 600]\nrotation_deg = {rotation}\n[light]\n{light}{extra}"
    scene = write_scene(folder, top="frames = 1\n", tail=tail, texture="smooth.png")
    simulate(scene, folder / "sequence", progress=False)
    camera = load_camera(folder / "sequence" / "camera.yaml")
    rows, columns = np.indices((240, 320))
    x = (columns - camera.cx) / camera.fx * 0.6 / LENGTH
    y = -(rows - camera.cy) / camera.fy * 0.6 / WIDTH
    (frame,) = open_source(folder / "sequence" / "frames")
    return frame.image.astype(float), print_value(x, y)[:, :, None], (np.abs(x) < 0.48) & (np.abs(y) < 0.48)


def test_flat_sheet_face_on_shows_its_print(tmp_path):
    picture, expected, inside = flat_picture(tmp_path)
    difference = (picture - expected)[inside]
    assert np.abs(difference).max() < 2.0
    assert abs(difference.mean()) < 0.4
    np.testing.assert_allclose(read_depth(tmp_path)[0][inside], 0.6, rtol=1e-6)


def test_noise_has_the_deviation_asked_for(tmp_path):
    picture, expected, inside = flat_picture(tmp_path, "[sensor]\nnoise = 4.0\n")
    assert (picture - expected)[inside].std() == pytest.approx(4.0, rel=0.03)


def test_back_of_the_sheet_has_its_colour(tmp_path):
    picture, _, inside = flat_picture(tmp_path, rotation="[0, 0, 0]")
    assert (picture[inside] == [218, 224, 226]).all()


def test_lambert_light_from_the_side(tmp_path):
    light = "direction = [-0.6, 0.0, -0.8]\nambient = 0.25\n"
    picture, _, inside = flat_picture(tmp_path, rotation="[0, 0, 0]", light=light)
    # 0.25 + 0.75 cos, with the light 0.8 along the normal.
    np.testing.assert_allclose(picture[inside].mean(axis=0), 0.85 * np.array([218, 224, 226]), atol=0.6)


LENS = (-0.25, 0.08, 0.002, -0.001)


def smooth_film(folder, tail, camera=CAMERA, top="frames = 1\n"):
    """Frames of a flat sheet face on with a smooth print, as floats, and their camera."""
    x, y = np.meshgrid((np.arange(840) + 0.5) / 840 - 0.5, 0.5 - (np.arange(594) + 0.5) / 594)
    cv2.imwrite(str(folder / "smooth.png"), np.rint(print_value(x, y)).astype(np.uint8))
    scene = write_scene(folder, top, f"{tail}[light]\nambient = 1.0\n", camera, "smooth.png")
    simulate(scene, folder / "sequence", progress=False)
    frames = [frame.image.astype(float) for frame in open_source(folder / "sequence" / "frames")]
    return frames, load_camera(folder / "sequence" / "camera.yaml")


def shown(camera, rays, shift=0.0):
    """The print's grey values (h, w, 1) along rays (h, w, 2), and which (h, w) are well inside the sheet."""
    x, y = (0.6 * rays[..., 0] - shift) / LENGTH, -0.6 * rays[..., 1] / WIDTH
    return print_value(x, y)[:, :, None], (np.abs(x) < 0.46) & (np.abs(y) < 0.46)


def test_a_lens_bends_the_picture_as_opencv_has_it(tmp_path):
    lens = CAMERA.replace("121.0", f"121.0, distortion = {list(LENS)}")
    (picture,), camera = smooth_film(tmp_path, "[[pose]]\nframe = 0\nposition_mm = [0, 0, 600]\n", lens)
    rows, columns = np.indices((240, 320))
    pixels = np.stack([columns, rows], axis=-1).reshape(-1, 1, 2).astype(float)
    rays = cv2.undistortPoints(pixels, camera.matrix, np.array(LENS)).reshape(240, 320, 2)
    expected, inside = shown(camera, rays)
    assert np.abs((picture - expected)[inside]).max() < 2.5
    assert abs((picture - expected)[inside].mean()) < 0.4
    truth = np.load(tmp_path / "sequence" / "truth.npz")
    points, _ = cv2.projectPoints(truth["points_mm"][0], np.zeros(3), np.zeros(3), camera.matrix, np.array(LENS))
    np.testing.assert_allclose(truth["pixels"][0], points[:, 0], atol=1e-9)


def test_rows_of_a_rolling_shutter_see_their_own_instants(tmp_path):
    rolling = CAMERA.replace("121.0", "121.0, readout_s = 0.02")
    tail = "[[pose]]\nframe = 0\nposition_mm = [0, 0, 600]\n[[pose]]\nframe = 2\nposition_mm = [60, 0, 600]\n"
    frames, camera = smooth_film(tmp_path, tail, rolling, "frames = 3\nfps = 30\n")
    rows, columns = np.indices((240, 320))
    rays = np.stack([(columns - camera.cx) / camera.fx, (rows - camera.cy) / camera.fy], axis=-1)
    time = (1.0 + 30.0 * 0.02 * (rows - 119.5) / 240) / 2.0  # 0 to 1 from key frame to key frame
    expected, inside = shown(camera, rays, 0.06 * (3.0 * time**2 - 2.0 * time**3))
    # A band of 24 rows is of one instant, 0.3 px from that of its rim, where the print has 5 grey levels a pixel.
    assert np.abs((frames[1] - expected)[inside]).max() < 4.0
    at_once, inside = shown(camera, rays, 0.03)
    assert np.abs((frames[1] - at_once)[inside]).max() > 12.0


def test_exposure_multiplies_and_saturates_and_jpeg_is_opencvs(tmp_path):
    pose = "[[pose]]\nframe = 0\nposition_mm = [0, 0, 600]\n"
    gains = "[[exposure]]\nframe = 0\ngain = 0.5\n[[exposure]]\nframe = 2\ngain = 2.0\n"
    (dark, middle, bright), camera = smooth_film(tmp_path, pose + gains, top="frames = 3\n")
    rows, columns = np.indices((240, 320))
    rays = np.stack([(columns - camera.cx) / camera.fx, (rows - camera.cy) / camera.fy], axis=-1)
    expected, inside = shown(camera, rays)
    for picture, gain in ((dark, 0.5), (middle, 1.0), (bright, 2.0)):  # halfway, the logarithm's mean
        assert np.abs((picture - np.minimum(gain * expected, 255.0))[inside]).max() < 2.0 * max(gain, 1.0)
    plain = (tmp_path / "scene.toml").read_text()
    (tmp_path / "scene.toml").write_text(plain.replace('image_format = "png"', "jpeg_quality = 40"))
    simulate(tmp_path / "scene.toml", tmp_path / "jpeg", progress=False)
    encoded = cv2.imencode(".jpg", middle.astype(np.uint8), [cv2.IMWRITE_JPEG_QUALITY, 40])[1]
    assert (tmp_path / "jpeg" / "frames" / "000001.jpg").read_bytes() == encoded.tobytes()


def test_outline_is_antialiased_at_the_right_place(tmp_path):
    picture, _, _ = flat_picture(tmp_path, "[background]\ncolour = [0, 0, 0]\n")
    # The left edge falls on 158 px - 260 px * 210 mm / 600 mm = 67, the middle of a pixel.
    row = picture[121, :, 0]
    assert row[66] == 0.0
    assert row[67] == pytest.approx(row[68] / 2, rel=0.05)
    assert row[68] == pytest.approx(row[69], rel=0.1)


def test_same_seed_same_pictures_other_seed_other_noise(tmp_path):
    images = {}
    for name, seed in (("a", 1), ("b", 1), ("c", 2)):
        scene = write_scene(
            tmp_path,
            top=f"frames = 1\nseed = {seed}\n",
            tail="[sensor]\nnoise = 3.0\n[[pose]]\nframe = 0\nposition_mm = [0, 0, 600]\n",
        )
        simulate(scene, tmp_path / name, progress=False)
        images[name] = next(iter(open_source(tmp_path / name / "frames"))).image
    np.testing.assert_array_equal(images["a"], images["b"])
    assert (images["a"] != images["c"]).mean() > 0.5


def test_frames_of_a_longer_earlier_run_do_not_stay(tmp_path):
    pose = "[[pose]]\nframe = 0\nposition_mm = [0, 0, 600]\n"
    for frames in (3, 2):
        simulate(write_scene(tmp_path, f"frames = {frames}\n", pose), tmp_path / "sequence", progress=False)
    assert len(open_source(tmp_path / "sequence" / "frames")) == 2


WALL = 0.9  # how far ahead of the camera the wall is, metres
#: A sheet that lies flat at z = 0, seen obliquely, and a camera that goes round it.
ROUND = """
[[camera_path]]
frame = 0
position_mm = [0, -500, 400]
target_mm = [0, 0, 0]
[[camera_path]]
frame = 4
position_mm = [300, -450, 350]
target_mm = [20, 10, 0]
"""


def wall_value(x, y):
    """Grey level at fractions x, y in [0, 1] of the wall, x to the right and y down."""
    return 120.0 + 60.0 * np.sin(9.0 * x) + 50.0 * np.cos(7.0 * y + 0.7)


def write_wall_scene(folder, extra=""):
    """A wall 1.2 m x 0.8 m square across the view, 0.9 m ahead; the sheet is behind the camera's wall."""
    x, y = np.meshgrid((np.arange(1200) + 0.5) / 1200, (np.arange(800) + 0.5) / 800)
    cv2.imwrite(str(folder / "wall.png"), np.rint(wall_value(x, y)).astype(np.uint8))
    tail = """
[light]
ambient = 1.0
[[camera_path]]
frame = 0
position_mm = [0, -900, 100]
target_mm = [0, 0, 100]
[[pose]]
frame = 0
position_mm = [0, 500, 100]
[[environment.rectangles]]
texture = "wall.png"
centre_mm = [0, 0, 100]
right_mm = [1200, 0, 0]
down_mm = [0, 0, -800]
"""
    return write_scene(folder, top="frames = 1\n", tail=tail + extra)


def test_a_wall_face_on_shows_its_texture_and_hides_what_is_behind(tmp_path):
    # The sheet would be in view, but all of it is behind the wall: no landmark can be seen.
    scene = write_wall_scene(tmp_path)
    assert main(["simulate", str(scene), "-o", str(tmp_path / "hidden")]) == 2
    # In front of the wall, below the picture's middle, it leaves the upper half to the wall.
    scene.write_text(scene.read_text().replace("[0, 500, 100]", "[0, -250, 0]"))
    simulate(scene, tmp_path / "sequence", progress=False)
    camera = load_camera(tmp_path / "sequence" / "camera.yaml")
    rows, columns = np.indices((240, 320))
    x = (columns - camera.cx) / camera.fx * WALL / 1.2 + 0.5
    y = (rows - camera.cy) / camera.fy * WALL / 0.8 + 0.5
    (frame,) = open_source(tmp_path / "sequence" / "frames")
    upper = (rows < 110) & (np.abs(x - 0.5) < 0.49) & (np.abs(y - 0.5) < 0.49)
    difference = frame.image.astype(float) - wall_value(x, y)[:, :, None]
    assert np.abs(difference[upper]).max() < 2.5
    assert abs(difference[upper].mean()) < 0.4


def test_the_camera_goes_where_its_path_says(tmp_path):
    simulate(write_scene(tmp_path, tail=ROUND), tmp_path / "sequence", progress=False)
    truth = np.load(tmp_path / "sequence" / "truth.npz")
    path = load_trajectory(tmp_path / "sequence" / "groundtruth.txt").world_from_camera
    np.testing.assert_allclose(path[0, :3, 3], [0.0, -0.5, 0.4], atol=1e-8)
    np.testing.assert_allclose(path[4, :3, 3], [0.3, -0.45, 0.35], atol=1e-8)
    # It looks at its target, upright: the target is on the optical axis, and its right side is level.
    to_target = np.array([0.02, 0.01, 0.0]) - path[4, :3, 3]
    np.testing.assert_allclose(path[4, :3, 2], to_target / np.linalg.norm(to_target), atol=1e-8)
    np.testing.assert_allclose(path[:, 2, 0], 0.0, atol=1e-8)
    # The object stays at the world's origin, so its pose in the camera is that of the world.
    np.testing.assert_allclose(truth["camera_from_object"], np.linalg.inv(path), atol=1e-7)


def test_the_depth_sensor_is_as_noisy_as_asked_and_makes_a_recording(tmp_path):
    extra = "[depth_sensor]\nnoise_mm_at_1m = 4.0\nrim_px = 0\n"
    scene = write_wall_scene(tmp_path, extra)
    scene.write_text(scene.read_text().replace("[0, 500, 100]", "[0, -250, 0]"))
    simulate(scene, tmp_path / "sequence", progress=False)
    (frame,) = open_source(tmp_path / "sequence")  # TUM's layout
    assert frame.image.shape == (240, 320, 3)
    assert frame.depth is not None
    np.testing.assert_array_equal(next(iter(md.SimulatedSequence(scene))).depth, frame.depth)
    wall = frame.depth[20:100, 20:300]
    assert np.mean(wall) == pytest.approx(WALL, abs=1e-4)
    assert np.std(wall) == pytest.approx(4.0e-3 * WALL**2, rel=0.03)
    with h5py.File(tmp_path / "sequence" / "depth.h5") as file:
        assert (file["depth_m"][0, 20:100] == 0.0).all()  # the object's alone


@pytest.mark.parametrize(
    ("tail", "message"),
    [
        ("", "'pose' is missing, or 'camera_path'"),
        ("[[pose]]\nframe = 0\nposition_mm = [0, 0, 600]\n[[environment.boxes]]\ntexture = 'print.png'\n"
         "centre_mm = [0, 0, 0]\nsize_mm = [1, 1, 1]\n", "say with camera_path where the camera is"),
        (ROUND + "[environment]\n", "give it rectangles or boxes"),
        (ROUND + "[[environment.rectangles]]\ntexture = 'print.png'\ncentre_mm = [0, 0, 0]\n"
         "right_mm = [100, 0, 0]\ndown_mm = [50, 50, 0]\n", "perpendicular"),
        (ROUND.replace("[0, -500, 400]", "[0, 0, 400]"), "straight up or down"),
        (ROUND + "[[environment.boxes]]\ntexture = 'none.png'\ncentre_mm = [0, 0, 0]\n"
         "size_mm = [1, 1, 1]\n", "there is no image"),
    ],
)  # fmt: skip
def test_scenes_that_cannot_be_are_one_message(tmp_path, refused, tail, message):
    assert message in refused("simulate", write_scene(tmp_path, tail=tail), "-o", tmp_path / "out")
