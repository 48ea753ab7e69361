"""Camera tracking and mapping with depth images and stereo pairs, on rendered films with exact truth."""

import json

import cv2
import numpy as np
import pytest

from morph_dslam.camera import StereoCamera
from morph_dslam.cli.app import main
from morph_dslam.errors import CameraError, MapError
from morph_dslam.geometry import RigidTransform
from morph_dslam.io.camera_files import load_camera, save_camera
from morph_dslam.io.trajectory import Trajectory, save_trajectory
from morph_dslam.slam.options import SlamOptions
from morph_dslam.slam.result import NoPose, SlamReason, SlamStatus
from morph_dslam.slam.rigid_map import RigidMap
from morph_dslam.slam.scene import load_scene, map_scene
from morph_dslam.slam.slam import Slam
from tests.support.rendered_room import CAMERA, Film, RoomFilm, follow, hand_held, off_the_walls, pose

BASELINE = 0.11
#: The right camera stands to the right and is toed in by 0.07 rad: rectified images are turned against the left ones.
TO_RIGHT = pose((BASELINE, 0.0, 0.004), (0.0, -0.07, 0.0))
PAIR = StereoCamera(CAMERA, CAMERA, RigidTransform.from_matrix(TO_RIGHT).inverse)


def recording(kind, path):
    """A film of the room along a path, with depth images or right ones."""
    film = RoomFilm(seed=1)
    images = [film.frame(place) for place in path]
    if kind == "depth":
        return Film(images, [{"depth": film.depth(place)} for place in path])
    return Film(images, [{"right": film.frame(place @ TO_RIGHT)} for place in path])


@pytest.fixture(scope="module")
def with_depth():
    return recording("depth", hand_held(36, seed=1))


@pytest.fixture(scope="module")
def stereo():
    return recording("stereo", hand_held(36, seed=1))


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["with_depth", "stereo"])
def test_path_and_map_are_metric_from_the_first_frame_on(kind, request):
    film, truth = request.getfixturevalue(kind), hand_held(36, seed=1)
    scene = map_scene(film, PAIR if kind == "stereo" else CAMERA)
    assert {frame.status for frame in scene.frames} == {SlamStatus.TRACKED}
    assert scene.is_metric
    # The first camera is the world's origin in both: nothing is aligned, and scale and axes are the estimate's own.
    errors = np.linalg.norm(scene.trajectory.positions - truth[:, :3, 3], axis=1)
    length = np.linalg.norm(np.diff(truth[:, :3, 3], axis=0), axis=1).sum()
    assert np.median(errors) < 0.005 * length
    assert errors.max() < 0.01 * length
    outside = off_the_walls(scene.points)
    assert len(outside) > 400
    # At 4 m a fifth of a pixel of disparity is 8 cm.
    assert np.quantile(outside, 0.98) < 0.1
    depths = np.concatenate([(scene.points - place[:3, 3]) @ place[:3, 2] for place in truth])
    assert scene.summary()["median_depth_m"] == pytest.approx(np.median(depths), rel=0.15)
    assert (np.abs(outside) < 0.03).mean() > 0.4


def test_a_camera_that_only_turns_is_placed_too():
    turns = [pose((0.0, 0.0, 0.0), (0.0, 0.012 * i, 0.0)) for i in range(20)]
    path = map_scene(recording("depth", turns), CAMERA).trajectory
    assert len(path) == 20
    assert np.linalg.norm(path.positions, axis=1).max() < 0.01
    assert path.world_from_camera[-1, :3, :3] == pytest.approx(turns[-1][:3, :3], abs=2e-3)


def test_frames_without_depth_are_bridged_but_nothing_starts_on_one(with_depth):
    truth, frames = hand_held(36, seed=1), with_depth.frames[:25]
    more = [{} if i == 0 or 10 <= i < 20 else {"depth": frame.depth} for i, frame in enumerate(frames)]
    scene = map_scene(Film([frame.image for frame in frames], more), CAMERA)
    assert scene.frames[0].status is SlamStatus.FOUND_LATER
    assert {frame.status for frame in scene.frames[1:]} == {SlamStatus.TRACKED}
    expected = (np.linalg.inv(truth[1]) @ truth[:25])[:, :3, 3]
    assert np.linalg.norm(scene.trajectory.positions - expected, axis=1).max() < 0.008


def test_a_frame_without_depth_starts_nothing_and_says_so(with_depth):
    (seen,) = follow(Slam(CAMERA, with_depth=True), [with_depth.frames[0].image])
    assert (seen.status, seen.reason) == (SlamStatus.WAITING, NoPose(SlamReason.NO_DEPTH))


def test_too_few_depths_start_nothing(with_depth):
    frame = with_depth.frames[0]
    depth = frame.depth.copy()
    depth[:, 60:] = np.nan
    (seen,) = follow(Slam(CAMERA, with_depth=True), [frame.image], [{"depth": depth}])
    assert (seen.status, seen.reason.reason) == (SlamStatus.WAITING, SlamReason.FEW_DEPTHS)
    assert seen.reason.numbers[0] < seen.reason.numbers[1] == 80


def test_what_does_not_fit_together_is_refused(with_depth):
    frame = with_depth.frames[0]
    with pytest.raises(CameraError, match="measures depth itself"):
        Slam(PAIR, with_depth=True)
    with pytest.raises(CameraError, match="depth image of frame 0 is 320x240"):
        follow(Slam(CAMERA, with_depth=True), [frame.image], [{"depth": frame.depth[::2, ::2]}])
    with pytest.raises(CameraError, match="right image of frame 0 is 320x240"):
        follow(Slam(PAIR), [frame.image], [{"right": frame.image[::2, ::2]}])
    with pytest.raises(MapError, match=r"baseline.*--no-depth"):
        Slam(PAIR, SlamOptions(extend=True)).use_map(RigidMap())


def with_depth_times(film, factor, n=8):
    """The first frames of a film as if its depth images had another unit."""
    frames = film.frames[:n]
    return Film([f.image for f in frames], [{"depth": np.float32(factor) * f.depth} for f in frames])


def test_depths_out_of_reach_are_told_with_their_range(with_depth):
    scene = map_scene(with_depth_times(with_depth, 100.0), CAMERA)
    far = scene.frames[-1].reason.cause
    assert far.reason is SlamReason.FAR_DEPTHS
    # A disparity of 10 px at a baseline of 8 cm.
    assert far.numbers[2] == pytest.approx(525.0 * 0.08 / 10.0)
    known = 100.0 * with_depth.frames[7].depth
    assert np.nanmin(known) <= far.numbers[0] < np.nanquantile(known, 0.1)
    assert np.nanquantile(known, 0.9) < far.numbers[1] <= np.nanmax(known)
    (flag,) = scene.summary()["flags"]
    assert "--depth-per-metre" in flag


@pytest.fixture(scope="module")
def metric_map(with_depth, tmp_path_factory):
    """The file of a map of the film."""
    path = tmp_path_factory.mktemp("metric") / "map.h5"
    map_scene(with_depth, CAMERA).save(path)
    return path


@pytest.mark.slow
@pytest.mark.parametrize("extend", [False, True])
@pytest.mark.parametrize("factor", [0.2, 0.95, 1.05, 5.0])
def test_depth_of_another_scale_than_the_known_map_is_refused(with_depth, metric_map, extend, factor):
    film, known = with_depth_times(with_depth, factor), load_scene(metric_map, CAMERA)
    if 0.9 < factor < 1.1:
        assert len(map_scene(film, CAMERA, SlamOptions(extend=extend), known=known).trajectory) == 8
        return
    with pytest.raises(MapError, match=f"contradict each other: measured depths are {factor:g}.* times"):
        map_scene(film, CAMERA, SlamOptions(extend=extend), known=known)


def test_a_map_is_not_overwritten_with_depth_of_another_scale(tmp_path, with_depth, refused):
    camera = write_tum(tmp_path / "recording", with_depth.frames[:8])
    run = tmp_path / "run"
    command = ["slam", tmp_path / "recording", "--camera", camera, "-o", run]
    assert main([str(word) for word in command]) == 0
    before = {path: path.read_bytes() for path in run.rglob("*") if path.is_file()}
    assert run / "tracked.mp4" in before
    wrong = ["--map", run / "map.h5", "--extend", "--overwrite", "--depth-per-metre", 1000]
    assert "contradict" in refused(*command, *wrong)
    assert {path: path.read_bytes() for path in run.rglob("*") if path.is_file()} == before


def write_tum(folder, film):
    lists = {"rgb": [], "depth": []}
    for name, lines in lists.items():
        (folder / name).mkdir(parents=True)
        for i, frame in enumerate(film):
            stored = frame.image if name == "rgb" else np.nan_to_num(5000.0 * frame.depth).astype(np.uint16)
            cv2.imwrite(str(folder / name / f"{i:03d}.png"), stored)
            lines.append(f"{i / 30.0:.6f} {name}/{i:03d}.png")
        (folder / f"{name}.txt").write_text("\n".join(lines) + "\n")
    save_camera(folder.parent / "camera.yaml", CAMERA)
    return folder.parent / "camera.yaml"


def write_euroc(folder, film):
    for name, place in (("cam0", np.eye(4)), ("cam1", TO_RIGHT)):
        camera = folder / "mav0" / name
        (camera / "data").mkdir(parents=True)
        rows = []
        for i, frame in enumerate(film):
            stamp = round(i / 30.0 * 1e9)
            cv2.imwrite(str(camera / "data" / f"{stamp}.png"), frame.image if name == "cam0" else frame.right)
            rows.append(f"{stamp},{stamp}.png")
        (camera / "data.csv").write_text("#timestamp [ns],filename\n" + "\n".join(rows) + "\n")
        (camera / "sensor.yaml").write_text(
            f"T_BS:\n  cols: 4\n  rows: 4\n  data: {place.ravel().tolist()}\n"
            "resolution: [640, 480]\ncamera_model: pinhole\n"
            f"intrinsics: [{CAMERA.fx}, {CAMERA.fy}, {CAMERA.cx}, {CAMERA.cy}]\n"
            "distortion_model: radial-tangential\ndistortion_coefficients: [0.0, 0.0, 0.0, 0.0]\n"
        )
    return folder


@pytest.mark.parametrize(("kind", "write"), [("with_depth", write_tum), ("stereo", write_euroc)])
def test_the_command_reads_recordings_with_depth_and_stereo_pairs(tmp_path, kind, write, request):
    camera = write(tmp_path / "recording", request.getfixturevalue(kind).frames[:15])
    save_trajectory(tmp_path / "truth.txt", Trajectory(np.arange(15) / 30.0, hand_held(36, seed=1)[:15]))
    run, command = tmp_path / "run", ["slam", str(tmp_path / "recording"), "--camera", str(camera), "--no-video", "-o"]
    assert main([*command, str(run)]) == 0
    summary = json.loads((run / "summary.json").read_text())
    assert (summary["start_frame"], summary["n_tracked"], summary["scale"]) == (0, 15, "metres")
    assert main(["evaluate", str(run), "--trajectory", str(tmp_path / "truth.txt")]) == 0
    figures = json.loads((run / "trajectory_evaluation.json").read_text())
    assert figures["se3"]["absolute_mm"]["rmse"] < 3.0
    # The saved map is metric too, and serves a camera alone.
    assert main([*command, str(tmp_path / "again"), "--map", str(run / "map.h5"), "--no-depth"]) == 0
    assert json.loads((tmp_path / "again" / "summary.json").read_text())["n_tracked"] == 15
    # What was given as the camera is that of the map for all other commands too.
    assert load_scene(tmp_path / "again" / "map.h5", load_camera(camera)).is_metric


@pytest.mark.slow
def test_the_unit_of_depth_images_is_given(tmp_path, with_depth, capsys, refused):
    camera = write_tum(tmp_path / "recording", with_depth.frames[:8])
    command = ["slam", tmp_path / "recording", "--camera", camera, "--no-video", "--depth-per-metre"]
    depths = []
    for name, values in (("as_written", 5000), ("half", 10_000)):
        assert main([str(word) for word in [*command, values, "-o", tmp_path / name]]) == 0
        depths.append(float(capsys.readouterr().out.split("median_depth_m=")[1]))
    assert depths[0] == pytest.approx(2.0 * depths[1], rel=0.03)
    (tmp_path / "recording" / "depth.txt").unlink()
    assert "leave --depth-per-metre out" in refused(*command, 1000, "-o", tmp_path / "none")


def test_depth_that_is_left_aside_leaves_one_camera(with_depth):
    assert not map_scene(Film([f.image for f in with_depth]), CAMERA).is_metric
    slam = map_scene(with_depth, CAMERA, SlamOptions(use_depth=False)).slam
    assert not slam.map.is_metric
