"""Maps that were known before a recording: their keyframes belong to another one."""

from dataclasses import replace

import numpy as np
import pytest

from morph_dslam.camera import Camera
from morph_dslam.errors import MapError, RegistrationError
from morph_dslam.geometry import RigidTransform, SimilarityTransform, rotation_exp
from morph_dslam.io.colmap import ColmapImage, ColmapModel
from morph_dslam.io.landmarks import Landmarks
from morph_dslam.io.trajectory import Trajectory
from morph_dslam.registration.register import register
from morph_dslam.registration.registration import KeyframePose, MapRegistration, in_scene, registration_in_map
from morph_dslam.registration.registration_file import load_registration
from morph_dslam.slam.frame_images import FrameImages
from morph_dslam.slam.local_map import correct_map
from morph_dslam.slam.map_files import map_from_colmap
from morph_dslam.slam.options import SlamOptions
from morph_dslam.slam.result import SlamFrame, SlamStatus
from morph_dslam.slam.rigid_map import GOOD, Keyframe, RigidMap
from morph_dslam.slam.rolling_shutter import after, row_times
from morph_dslam.slam.scene import Scene, finish_scene, load_scene, start_slam
from morph_dslam.tracking.views import registered_keyframes
from tests.support.bent_sheet import bent_sheet_model
from tests.support.rendered_room import Film

CAMERA = Camera(640, 480, 500, 500, 319.5, 239.5)
ROLLING = Camera(640, 480, 500, 500, 319.5, 239.5, readout_s=0.03)
RNG = np.random.default_rng(0)
POINTS = np.column_stack([RNG.uniform(-1, 1, 120), RNG.uniform(-0.8, 0.8, 120), RNG.uniform(2, 4, 120)])
NO_PATH = Trajectory(np.empty(0), np.empty((0, 4, 4)))


def at(x):
    """camera_from_world of a camera that is ``x`` metres to the right."""
    pose = np.eye(4)
    pose[0, 3] = -x
    return pose


def keyframe(index, x, speed=0.0):
    """What a camera that moves to the right by ``speed`` (m/s) sees, row after row."""
    twist, local = np.array([0, 0, 0, -speed, 0, 0]), POINTS - [x, 0, 0]
    pixels = CAMERA.project(local)
    for _ in range(10):
        seconds = ROLLING.readout_s * row_times(pixels[:, 1], ROLLING)
        pixels = CAMERA.project(after(local, np.broadcast_to(twist, (len(local), 6)), seconds))
    image = np.zeros((480, 640), np.uint8)
    return Keyframe(index, index / 30, image, at(x), np.arange(len(POINTS)), pixels, twist=twist.astype(float))


def map_of(*keyframes):
    rigid_map = RigidMap()
    rigid_map.add_points(POINTS.copy(), np.zeros((len(POINTS), 2)), 0, GOOD)
    for each in keyframes:
        rigid_map.add_keyframe(each)
    return rigid_map


@pytest.mark.parametrize("first", [0, 1000])
def test_keyframes_of_a_known_map_keep_their_velocity_where_it_grows(first):
    """Whether frames of the new recording, which goes the other way, have their numbers or not."""
    known = [keyframe(first + 10 * k, 0.1 * k, 1.0) for k in range(4)]
    path = 0.3 - 1.5 * np.arange(41) / 30
    rigid_map = map_of(*known, *(keyframe(k, path[k], -1.5) for k in (5, 15, 25)))
    before = [each.camera_from_world.copy() for each in rigid_map.keyframes]
    poses = np.linalg.inv(np.array([at(x) for x in path]))
    correct_map(rigid_map, ROLLING, Trajectory(np.arange(41) / 30, poses, np.arange(41)), n_known=len(known))
    assert [each.twist[3] for each in rigid_map.keyframes[:4]] == [-1.0] * 4
    # Everything was exact, and stays so.
    assert np.abs(rigid_map.positions - POINTS).max() < 1e-4
    moved = [each.camera_from_world - old for each, old in zip(rigid_map.keyframes, before, strict=True)]
    assert np.abs(moved).max() < 1e-4


@pytest.mark.parametrize("is_frozen", [False, True])
def test_a_map_that_grew_has_one_keyframe_of_each_number(is_frozen):
    """Also where it was frozen after that, as by --freeze-at."""
    known = Scene(CAMERA, map_of(keyframe(0, 0.0), keyframe(20, 0.2)), NO_PATH)
    slam = start_slam(Film([]), CAMERA, SlamOptions(extend=True), known)
    slam.map.add_keyframe(keyframe(20, 0.4))
    if is_frozen:
        slam.freeze()
    scene = finish_scene(slam, [SlamFrame(k, k / 30, SlamStatus.LOST) for k in range(90, 120)])
    assert [each.index for each in scene.keyframes] == [1000, 1020, 20]


def test_a_map_that_did_not_grow_keeps_its_numbers():
    known = Scene(CAMERA, map_of(keyframe(0, 0.0), keyframe(20, 0.2)), NO_PATH)
    slam = start_slam(Film([]), CAMERA, SlamOptions(extend=True), known)
    scene = finish_scene(slam, [SlamFrame(k, k / 30, SlamStatus.LOST) for k in range(90, 120)])
    assert [each.index for each in scene.keyframes] == [0, 20]


def test_a_known_map_is_kept_however_long_the_camera_is_elsewhere():
    """One of few keyframes that is to grow, too: only a map that was begun in this recording is given up."""
    known = Scene(CAMERA, map_of(keyframe(0, 0.0), keyframe(20, 0.2)), NO_PATH)
    slam = start_slam(Film([]), CAMERA, SlamOptions(extend=True, restart_after=2), known)
    for number in range(5):
        slam.process_frame(np.zeros((480, 640), np.uint8), number, number / 30)
    assert slam.n_restarts == 0
    np.testing.assert_array_equal(slam.map.positions, POINTS)


@pytest.mark.parametrize("rounds", [1, 2])
def test_a_registration_made_before_the_map_grew_is_one_of_it(rounds, tmp_path):
    """Also where keyframes of the new recording have its numbers; the scene that it was made in stays as it was."""
    known, model = Scene(CAMERA, map_of(keyframe(0, 0.0), keyframe(20, 0.2)), NO_PATH), bent_sheet_model(8, 6)
    placed = MapRegistration(SimilarityTransform(1.0, np.eye(3), np.array([0, 0, 2.0])), model.nodes.mean(axis=0), None)
    views = [KeyframePose(each.index, placed.pose_in(each.camera_from_world)) for each in known.keyframes]
    registration_in_map(model, placed, views, {}).save(tmp_path / "registration.json")
    scene = known
    for _ in range(rounds):
        slam = start_slam(Film([]), CAMERA, SlamOptions(extend=True), scene)
        for number in (0, 20):
            slam.map.add_keyframe(keyframe(number, 0.2 + 0.01 * (20 - number) + 0.02))
        scene = finish_scene(slam, [SlamFrame(k, k / 30, SlamStatus.LOST) for k in range(90, 120)])
    found = load_registration(tmp_path / "registration.json", model, scene)
    assert [found.frame, *(view.frame for view in found.keyframes)] == [1000 * rounds + k for k in (20, 0, 20)]
    there = next(each for each in scene.keyframes if each.index == found.frame)
    np.testing.assert_array_equal(there.camera_from_world, at(0.2))
    assert [each.index for each in known.keyframes] == [0, 20]
    assert load_registration(tmp_path / "registration.json", model, known).frame == 20


def registered(model, rigid_map):
    """A registration 2 m before the first camera in all keyframes of a map; only the first two have a covariance."""
    placed = MapRegistration(
        SimilarityTransform(1.0, np.eye(3), np.array([0, 0, 2.0])), model.nodes.mean(axis=0), 1e-8 * np.eye(7)
    )
    own = [1e-6 * np.eye(6) if k < 2 else None for k in range(len(rigid_map.keyframes))]
    views = [
        KeyframePose(each.index, placed.pose_in(each.camera_from_world), covariance)
        for each, covariance in zip(rigid_map.keyframes, own, strict=True)
    ]
    return registration_in_map(model, placed, views, {})


def grown(known, *new, gone=()):
    """A scene whose map has grown by a recording of 120 frames, and has lost known keyframes meanwhile."""
    slam = start_slam(Film([]), CAMERA, SlamOptions(extend=True), known)
    for each in new:
        slam.map.add_keyframe(each)
    for number in gone:
        slam.map.remove_keyframe(number, carrier=len(slam.map.keyframes) - 1)
    return finish_scene(slam, [SlamFrame(k, k / 30, SlamStatus.LOST) for k in range(120)])


@pytest.mark.parametrize(
    ("gone", "frame", "left", "deviation"),
    [([1], 1027, [0, 13, 27], 5**0.5 * 1e-4), ([3], 1007, [0, 7, 13], 1e-3), ([1, 3], 1000, [0, 13], 1e-3)],
    ids=["another", "its-own", "both"],
)
@pytest.mark.parametrize("in_memory", [True, False])
def test_a_registration_goes_on_with_the_keyframes_that_a_grown_map_has_left(
    in_memory, gone, frame, left, deviation, tmp_path
):
    """Saved again, too; new keyframes whose numbers end alike are nearly where the known ones were."""
    model, places = bent_sheet_model(8, 6), {0: 0.0, 7: 0.02, 13: 0.05, 27: 0.08}
    known = Scene(CAMERA, map_of(*(keyframe(number, x) for number, x in places.items())), NO_PATH)
    registered(model, known.map).save(tmp_path / "registration.json")
    scene = grown(known, *(keyframe(10 + number, x + 0.01) for number, x in places.items()), gone=gone)
    if not in_memory:
        scene.save(tmp_path / "map.h5")
        scene = load_scene(tmp_path / "map.h5", CAMERA)
    found = load_registration(tmp_path / "registration.json", model, scene)
    found.save(tmp_path / "again.json")
    for each in (found, load_registration(tmp_path / "again.json", model, scene)):
        assert each.frame == frame
        assert [view.frame for view in each.keyframes] == [1000 + number for number in left]
        assert each.state.camera_from_object.translation == pytest.approx([-places[frame - 1000], 0.0, 2.0])
        assert np.sqrt(each.covariance[-1, -1]) == pytest.approx(deviation, rel=0.01)
        assert "frame" not in each.facts
    pictures = registered_keyframes(found)
    assert {pictures[view.frame].normalized.shape for view in found.keyframes} == {(480, 640)}
    assert in_scene(found, scene).frame == frame


def test_a_registration_of_a_grown_map_keeps_its_numbers_until_that_grows_again(tmp_path):
    model, known = bent_sheet_model(8, 6), Scene(CAMERA, map_of(keyframe(0, 0.0), keyframe(20, 0.2)), NO_PATH)
    once = grown(known, keyframe(20, 0.25))
    placed = registered(model, once.map)
    registration_in_map(model, placed.map_registration, placed.keyframes, {}, scene=once).save(tmp_path / "r.json")
    twice = grown(once, keyframe(20, 0.28), keyframe(1020, 0.29))
    alike = Scene(CAMERA, map_of(*once.keyframes), NO_PATH)  # as it comes back from a format without its history
    for scene, numbers in ((once, [1000, 1020, 20]), (twice, [2000, 2020, 1020]), (alike, [1000, 1020, 20])):
        found = load_registration(tmp_path / "r.json", model, scene)
        assert [view.frame for view in found.keyframes] == numbers
    with pytest.raises(MapError):  # it knows of a recording that this one has not grown by
        load_registration(tmp_path / "r.json", model, known)


@pytest.mark.parametrize(
    ("numbers", "missing"), [((0, 8, 13, 27), 7), ((1, 8, 14, 28), 27)], ids=["one-missing", "all-missing"]
)
def test_a_map_that_never_grew_and_lacks_a_keyframe_of_the_registration_is_another_one(numbers, missing, tmp_path):
    model, places = bent_sheet_model(8, 6), (0.0, 0.02, 0.05, 0.08)
    registered(model, map_of(*map(keyframe, (0, 7, 13, 27), places))).save(tmp_path / "registration.json")
    other = Scene(CAMERA, map_of(*map(keyframe, numbers, places)), NO_PATH)
    with pytest.raises(MapError, match=f"no keyframe {missing} "):
        load_registration(tmp_path / "registration.json", model, other)


def test_a_map_that_agrees_in_the_reference_keyframe_alone_is_another_one(tmp_path):
    model, numbers = bent_sheet_model(8, 6), (0, 7, 13, 27)
    registered(model, map_of(*map(keyframe, numbers, (0.0, 0.02, 0.05, 0.08)))).save(tmp_path / "registration.json")
    other = Scene(CAMERA, map_of(*map(keyframe, numbers, (0.5, 0.02, 0.45, 0.08))), NO_PATH)
    with pytest.raises(MapError, match="400 mm and 0 deg from where the registration has it in keyframe 13"):
        load_registration(tmp_path / "registration.json", model, other)


@pytest.mark.parametrize("origin", [(0.0, 0.0, 0.0), (0.0, 0.0, 5.0), (-0.195, 0.0, 0.59)], ids=["in", "far", "camera"])
def test_a_map_is_told_by_where_it_has_the_object_and_not_the_origin_of_its_coordinates(origin):
    """The object is 0.6 m away; the origin lies in it, 5 m before it, or 10 mm from a camera.

    Its own map has one keyframe that the registration turned by 4 mrad about the object; in the other all cameras are
    300 mm elsewhere.
    """
    model = bent_sheet_model(8, 6)
    model = replace(model, nodes=model.nodes + origin)
    centre = model.nodes.mean(axis=0)
    placed = MapRegistration(SimilarityTransform(1.0, np.eye(3), [0, 0, 0.6] - centre), centre, 1e-8 * np.eye(7))
    here, turned = placed.pose_in(at(0.0)), placed.pose_in(at(0.2))
    seen, turn = turned.apply(centre), rotation_exp(np.array([0.0, 4e-3, 0.0]))
    turned = RigidTransform(turn @ turned.rotation, turn @ (turned.translation - seen) + seen)
    registration = registration_in_map(model, placed, [KeyframePose(0, here), KeyframePose(20, turned)], {})
    assert in_scene(registration, Scene(CAMERA, map_of(keyframe(0, 0.0), keyframe(20, 0.2)), NO_PATH)).frame == 20
    other = Scene(CAMERA, map_of(keyframe(0, 0.3), keyframe(20, 0.5)), NO_PATH)
    with pytest.raises(MapError, match="the object is 300 mm and 0 deg from where the registration has it"):
        in_scene(registration, other)


def test_landmarks_in_a_number_of_two_recordings_are_refused():
    rigid_map = map_of(keyframe(0, 0.0), keyframe(20, 0.2))
    path = Trajectory(np.arange(3.0), np.linalg.inv(np.array([at(x) for x in (0.0, 0.1, 1.5)])), np.array([0, 10, 20]))
    nodes = bent_sheet_model(8, 6).nodes
    clicks = Landmarks(nodes[:3], np.array([[100.0, 100], [200, 100], [100, 200]]), np.full(3, 20))
    with pytest.raises(RegistrationError, match=r"frame 20 has no pose in the map.* frame 10"):
        register(Scene(CAMERA, rigid_map, path), bent_sheet_model(8, 6), landmarks=clicks)


def test_a_model_of_two_images_with_one_number_is_refused():
    images = [ColmapImage(f"{side}/0001.png", np.eye(4), np.arange(3), np.zeros((3, 2))) for side in ("left", "right")]
    with pytest.raises(MapError, match=r"left/0001\.png and right/0001\.png"):
        map_from_colmap(ColmapModel(images, POINTS[:3]), Film([]), FrameImages(CAMERA))
