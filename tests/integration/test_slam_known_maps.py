"""Maps that another program made: COLMAP models, and trajectories from which only points are missing."""

import re
from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from morph_dslam.cli.app import main
from morph_dslam.errors import MapError
from morph_dslam.evaluation.trajectory import evaluate_trajectory
from morph_dslam.io.colmap import ColmapImage, read_colmap_model, write_colmap_model
from morph_dslam.io.trajectory import Trajectory, load_trajectory, save_trajectory
from morph_dslam.slam.options import SlamOptions
from morph_dslam.slam.result import NoPose, SlamReason, SlamStatus
from morph_dslam.slam.scene import Scene, load_scene, map_scene, start_slam
from tests.support.rendered_room import (
    CAMERA,
    PERIOD,
    Film,
    RoomFilm,
    follow,
    hand_held,
    pose,
    repeated_wall,
    write_film,
)

NO_PATH = Trajectory(np.empty(0), np.empty((0, 4, 4)))
#: Another program's world and unit.
WORLD, UNIT = pose((3.0, -1.0, 2.0), (0.4, -0.2, 0.9)), 2.5


def in_other_world(world_from_camera):
    """Poses as the other program gives them."""
    moved = WORLD @ world_from_camera
    moved[..., :3, 3] *= UNIT
    return moved


@pytest.fixture(scope="module")
def room():
    """A renderer, 40 images, and their poses."""
    film, truth = RoomFilm(seed=1), hand_held(40, seed=1)
    return film, [film.frame(place) for place in truth], truth


@pytest.fixture(scope="module")
def poses(room):
    return Trajectory(np.arange(40) / 30.0, in_other_world(room[2]))


def track(room, known, camera=CAMERA):
    """Track the second half of the film in a map of all of it."""
    return map_scene(Film(room[1][20:], first=20), camera, known=known, images=Film(room[1]))


def largest_error(room, scene):
    """Distance of the found from the true camera centres, in true metres, without any alignment."""
    assert [frame.status for frame in scene.frames] == [SlamStatus.RELOCALIZED, *[SlamStatus.TRACKED] * 19]
    expected = in_other_world(room[2])[20:, :3, 3]
    return np.linalg.norm(scene.trajectory.positions - expected, axis=1).max() / UNIT


def test_the_camera_is_found_in_the_world_of_a_trajectory(room, poses):
    scene = track(room, poses)
    assert largest_error(room, scene) < 0.005
    assert scene.slam.is_frozen


@pytest.mark.slow
def test_poses_by_frame_numbers_belong_to_the_frames_of_these_numbers(room, poses):
    """As KITTI's files have them: taken for seconds, every thirtieth frame of this film had one, of another frame."""
    numbered = replace(poses, timestamps=np.rint(30.0 * poses.timestamps), is_numbered=True)
    assert largest_error(room, track(room, numbered)) < 0.005


@pytest.mark.slow
def test_looking_for_a_camera_again_leaves_the_map_as_it_is(room, poses):
    slam = track(room, poses).slam
    before, finder = (slam.map.usual_rms_px, slam.map.n_expected.copy(), slam.map.n_found.copy()), slam.finder()
    found = [finder.process_frame(image, index, index / 30) for index, image in enumerate(room[1][:4])]
    assert any(frame.pose is not None for frame in found)
    assert slam.map.usual_rms_px == before[0]
    np.testing.assert_array_equal(slam.map.n_expected, before[1])
    np.testing.assert_array_equal(slam.map.n_found, before[2])


@pytest.fixture(scope="module")
def colmap(room, tmp_path_factory):
    """A COLMAP model of every fourth image: corners, with their points by the renderer's depth."""
    film, pictures, truth = room
    points = []
    for source in range(0, 40, 4):
        corners = np.rint(cv2.goodFeaturesToTrack(pictures[source], 120, 0.01, 12)[:, 0].astype(float))
        depth = film.depth(truth[source], noise=0.0)[corners[:, 1].astype(int), corners[:, 0].astype(int)]
        local = CAMERA.rays(corners) * depth[:, None]
        points.append((local @ truth[source][:3, :3].T + truth[source][:3, 3])[np.isfinite(depth)])
    points, images = np.concatenate(points), []
    for index in range(0, 40, 4):
        local = (points - truth[index][:3, 3]) @ truth[index][:3, :3]
        pixels = CAMERA.project(local)
        inside = (local[:, 2] > 0) & (np.abs(pixels - [320, 240]) < [310, 230]).all(axis=1)
        seen = np.flatnonzero(inside)
        columns, rows = np.rint(pixels[seen]).astype(int).T
        # Of points behind something the image shows what is before them.
        depth = film.depth(truth[index], noise=0.0)[rows, columns]
        seen = seen[np.abs(depth / local[seen, 2] - 1.0) < 0.02]
        other = np.linalg.inv(in_other_world(truth[index]))
        images.append(ColmapImage(f"shot_{index:04d}.jpg", other, seen, pixels[seen]))
    model = tmp_path_factory.mktemp("model") / "colmap"
    write_colmap_model(model, CAMERA, images, UNIT * (points @ WORLD[:3, :3].T + WORLD[:3, 3]))
    return model


def test_the_camera_is_found_in_a_colmap_model(room, colmap):
    assert largest_error(room, track(room, read_colmap_model(colmap))) < 0.01


def test_frames_that_have_the_numbers_of_the_maps_keyframes_are_not_taken_for_these(room, poses):
    """Poses of a rolling shutter are found again from where the frames, not the keyframes, saw points."""
    film, rolling = Film(room[1][20:]), replace(CAMERA, readout_s=1e-9)
    assert largest_error(room, map_scene(film, rolling, known=poses, images=Film(room[1]))) < 0.005


@pytest.mark.slow
def test_the_camera_of_a_known_map_is_not_checked_and_one_that_is_elsewhere_is_told(room, poses):
    scene = track(room, poses)
    assert scene.camera_estimate() is None
    assert scene.summary()["flags"] == []
    assert scene.summary()["scale"] == "the unit of the given map or poses"
    known = replace(scene, slam=None)
    known.map.camera_notes = ("of the map's recording",)
    assert map_scene(Film(room[1][:3]), CAMERA, known=known).summary()["flags"] == ["of the map's recording"]
    elsewhere = RoomFilm(seed=8)
    film = Film([elsewhere.frame(place) for place in hand_held(3, seed=8)])
    (flag,) = map_scene(film, CAMERA, known=known).summary()["flags"]
    assert flag.startswith("the camera was found in no frame of this map: ")


def through_a_lens(pictures, distortion):
    """Pictures as recorded through a lens, by OpenCV's undistortion of each recorded pixel."""
    pixels = np.stack(np.meshgrid(np.arange(640.0), np.arange(480.0)), axis=-1).reshape(-1, 1, 2)
    ideal = cv2.undistortPoints(pixels, CAMERA.matrix, np.array(distortion), P=CAMERA.matrix)
    x, y = ideal.reshape(480, 640, 2).astype(np.float32).transpose(2, 0, 1)
    return [cv2.remap(picture, x, y, cv2.INTER_LINEAR) for picture in pictures]


@pytest.mark.slow
def test_a_lens_that_does_not_fit_the_recording_is_named_in_a_known_map(room, colmap):
    k1, k2 = -0.25, 0.07
    pictures = through_a_lens(room[1], (k1, k2, 0.0, 0.0))
    model, undistorted = read_colmap_model(colmap), Film(room[1])
    (flag,) = map_scene(Film(pictures), CAMERA, known=model, images=undistorted).summary()["flags"]
    numbers = [float(number) for number in re.findall(r"-?\d+\.\d{4}", flag)]
    given, (estimated, two_std) = numbers[:2], numbers[2:4]
    assert given == [0.0, 0.0]
    assert estimated == pytest.approx(k1, abs=0.02)
    assert two_std < 0.02
    # The same pictures with their lens fit the same map.
    slam = start_slam(undistorted, CAMERA, SlamOptions(), model, undistorted)
    camera, known = replace(CAMERA, distortion=(k1, k2, 0.0, 0.0)), Scene(CAMERA, slam.map, NO_PATH)
    right = map_scene(Film(pictures[20:], first=20), camera, known=known)
    assert len(right.trajectory) == 20
    assert right.summary()["flags"] == []


@pytest.mark.slow
def test_another_focal_length_than_the_maps_is_named(room, poses):
    """A zoom is a homography of the picture, so that the second recording needs no other renderer."""
    zoom = 1.1
    of_zoomed = CAMERA.matrix.copy()
    of_zoomed[:2, :2] *= zoom
    pictures = [cv2.warpPerspective(image, of_zoomed @ np.linalg.inv(CAMERA.matrix), (640, 480)) for image in room[1]]
    slam = start_slam(Film(room[1]), CAMERA, SlamOptions(), poses, Film(room[1]))
    known = Scene(CAMERA, slam.map, NO_PATH)
    (flag,) = map_scene(Film(pictures), CAMERA, known=known).summary()["flags"]
    given, found, two_std = (float(number) for number in re.findall(r"\d+\.\d", flag)[:3])
    assert given == CAMERA.fx
    assert found == pytest.approx(zoom * CAMERA.fx, rel=0.02)
    assert two_std < 0.04 * found


def test_what_does_not_fit_is_refused(room, poses, colmap):
    late = Trajectory(poses.timestamps + 100.0, poses.world_from_camera)
    with pytest.raises(MapError, match=r"only 0 of 40 frames of film .* 0\.000 to 1\.300 s.* 100\.000 to 101\.300"):
        track(room, late)
    # Three frames late: points are somewhere, but not where the next frames have them.
    with pytest.raises(MapError, match="do not fit the images"):
        track(room, Trajectory(poses.timestamps, np.roll(poses.world_from_camera, 3, axis=0)))
    model = read_colmap_model(colmap)
    with pytest.raises(MapError, match=r"miss their pixels by \d+"):
        track(room, model, replace(CAMERA, fx=800.0, fy=800.0, cx=250.0, cy=200.0))
    with pytest.raises(MapError, match=r"none of the 10 images .*\(9000-9036"):
        track(room, replace(model, images=[replace(i, name=f"shot_{9000 + i.number}.jpg") for i in model.images]))


def test_poses_of_another_convention_or_body_are_named(room, poses):
    marker = pose((0.05, -0.03, 0.08), (0.2, 1.5, -0.4))
    w_first = poses.world_from_camera.copy()
    quaternions = Rotation.from_matrix(w_first[:, :3, :3]).as_quat(scalar_first=True)
    w_first[:, :3, :3] = Rotation.from_quat(quaternions).as_matrix()
    for wrong, words in (
        (poses.camera_from_world, "inverted"),
        (poses.world_from_camera @ np.diag([1.0, -1.0, -1.0, 1.0]), "OpenGL"),
        (w_first, "begin with qw"),
        (poses.world_from_camera @ marker, "another body"),
    ):
        with pytest.raises(MapError, match=f"do not fit the images of film: they .*{words}"):
            track(room, Trajectory(poses.timestamps, wrong))


def test_poses_that_are_a_little_off_are_used(room, poses):
    """Half a millimetre and a thirtieth of a degree, as of motion capture, at random."""
    rng, noisy = np.random.default_rng(0), poses.world_from_camera.copy()
    noisy[:, :3, 3] += UNIT * 0.0005 * rng.standard_normal((40, 3))
    noisy[:, :3, :3] @= Rotation.from_rotvec(np.radians(0.03) * rng.standard_normal((40, 3))).as_matrix()
    assert largest_error(room, track(room, Trajectory(poses.timestamps, noisy))) < 0.05


def test_pictures_of_another_recording_are_not_those_of_a_model(room, colmap):
    other = RoomFilm(seed=8)
    film = Film([other.frame(place) for place in hand_held(40, seed=8)])
    with pytest.raises(MapError, match=r"are not those of film.*--images"):
        map_scene(Film(room[1][:3]), CAMERA, known=read_colmap_model(colmap), images=film)
    # The same room, but its pictures in another order.
    with pytest.raises(MapError, match=r"are not those of film.*--images"):
        map_scene(Film(room[1][:3]), CAMERA, known=read_colmap_model(colmap), images=Film(room[1][::-1]))


def test_a_map_of_given_poses_has_their_scale(room, poses, tmp_path):
    scene = track(room, poses)
    scene.save(tmp_path / "map.h5")
    assert load_scene(tmp_path / "map.h5", CAMERA).map.has_given_lengths
    save_trajectory(tmp_path / "trajectory.txt", scene.trajectory)
    figures = evaluate_trajectory(tmp_path, poses)
    assert figures["notes"] == []
    assert figures["se3"]["absolute_mm"]["rmse"] < 1e3 * UNIT * 0.005


def test_the_command_takes_known_maps(tmp_path, room, room_folder, colmap, refused):
    command = ["slam", str(room_folder / "film"), "--camera", str(room_folder / "camera.yaml"), "--no-video"]
    write_film(tmp_path / "of_model", room[1])
    model = ["--map", str(colmap), "--images", str(tmp_path / "of_model" / "film")]
    for number, known in enumerate((["--trajectory", str(room_folder / "truth.txt")], model)):
        assert main([*command, *known, "--range", "36-39", "-o", str(tmp_path / str(number))]) == 0
        assert len(load_trajectory(tmp_path / str(number) / "trajectory.txt")) == 4
    save_trajectory(tmp_path / "poses.txt", load_trajectory(room_folder / "truth.txt"))
    (tmp_path / "empty").mkdir()
    for wrong, words in (
        (["--map", str(colmap), "--trajectory", str(tmp_path / "poses.txt")], "--trajectory"),
        (["--map", str(tmp_path / "empty")], "images.txt"),
        (["--extend"], "--extend"),
        (["--images", str(room_folder / "film")], "--images"),
    ):
        assert words in refused(*command, *wrong, "-o", tmp_path / "run")


@pytest.fixture(scope="module")
def repeating():
    """A wall that looks the same again after a period, and a map of more than one."""
    wall = RoomFilm(seed=1, scene=repeated_wall)
    path = np.array([pose((x, 0.1 * np.sin(2 * x), 0.0)) for x in np.linspace(0.0, PERIOD + 0.4, 60)])
    return wall, Film([wall.frame(place) for place in path]), Trajectory(np.arange(60) / 30.0, path)


@pytest.fixture
def seen_from(repeating):
    """Follows a camera through places (metres to the right, None where it is covered); their frames."""
    wall, recording, path = repeating
    slam = start_slam(recording, CAMERA, SlamOptions(), path)
    return lambda *places: follow(
        slam, [np.zeros((480, 640), np.uint8) if x is None else wall.frame(pose((x, 0.05, 0.03))) for x in places]
    )


def rightwards(frame):
    return np.linalg.inv(frame.pose.camera_from_world)[0, 3]


def test_a_camera_is_not_placed_where_two_places_look_alike(seen_from):
    for frame in seen_from(0.15, 0.15 + PERIOD, 0.15):
        assert frame.status is SlamStatus.LOST
        assert isinstance(frame.reason, NoPose)
        assert frame.reason.reason is SlamReason.TWO_PLACES
    found = seen_from(PERIOD / 2)[0]  # the map has less than a period to either side of it
    assert rightwards(found) == pytest.approx(PERIOD / 2, abs=0.01)


@pytest.mark.slow
@pytest.mark.parametrize(("n_covered", "is_found"), [(12, True), (90, False)])
def test_of_places_that_look_alike_the_one_is_taken_that_the_camera_can_have_reached(seen_from, n_covered, is_found):
    """It goes on by a quarter of a period while it is covered: the other place is three quarters away."""
    start = np.linspace(1.6, 0.95, 8).tolist()
    frames = seen_from(*start, *[None] * n_covered, 0.15)
    assert frames[7].status is SlamStatus.TRACKED
    if is_found:
        assert rightwards(frames[-1]) == pytest.approx(0.15, abs=0.01)
    else:
        assert frames[-1].status is SlamStatus.LOST
        assert frames[-1].reason.reason is SlamReason.TWO_PLACES
