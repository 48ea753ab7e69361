"""Camera tracking and mapping with depth images and stereo pairs, on rendered films with exact truth."""

import json

import cv2
import numpy as np
import pytest

from morph_dslam.camera import StereoCamera
from morph_dslam.cli.app import main
from morph_dslam.errors import CameraError, MapError
from morph_dslam.geometry import RigidTransform
from morph_dslam.io.trajectory import Trajectory, save_trajectory
from morph_dslam.slam.output import trajectory_of
from morph_dslam.slam.rigid_map import RigidMap
from morph_dslam.slam.slam import Slam
from tests.support.rendered_room import CAMERA, RoomFilm, hand_held, pose

N_FRAMES = 36
BASELINE = 0.11
PAIR = StereoCamera(CAMERA, CAMERA, RigidTransform(np.eye(3), np.array([-BASELINE, 0.0, 0.0])))
TO_RIGHT = pose((BASELINE, 0.0, 0.0))


def views(kind, seed, n=N_FRAMES):
    """Images, what measures depth by its name in `process_frame`, and the true poses."""
    film, truth = RoomFilm(seed=seed), hand_held(n, seed=seed)
    images = [film.frame(place) for place in truth]
    if kind == "depth":
        return images, [{"depth": film.depth(place)} for place in truth], truth
    return images, [{"right": film.frame(place @ TO_RIGHT)} for place in truth], truth


def follow(slam, images, more):
    return [slam.process_frame(image, i, i / 30.0, **m) for i, (image, m) in enumerate(zip(images, more, strict=True))]


@pytest.fixture(scope="module", params=["depth", "stereo"])
def metric_run(request):
    images, more, truth = views(request.param, seed=1)
    slam = Slam(PAIR) if request.param == "stereo" else Slam(CAMERA, with_depth=True)
    frames = follow(slam, images, more)
    slam.refine_map()
    return slam, frames, truth


def test_the_path_is_metric_from_the_first_frame_on(metric_run):
    slam, frames, truth = metric_run
    assert {frame.status for frame in frames} == {"tracked"}
    estimate = trajectory_of(slam, frames).world_from_camera
    # The first camera is the world's origin in both: nothing is aligned, and the scale is the estimate's own.
    errors = np.linalg.norm(estimate[:, :3, 3] - truth[:, :3, 3], axis=1)
    length = np.linalg.norm(np.diff(truth[:, :3, 3], axis=0), axis=1).sum()
    assert np.median(errors) < 0.005 * length
    assert errors.max() < 0.01 * length


def test_the_map_lies_on_the_walls_in_metres(metric_run):
    slam, _, _ = metric_run
    points = slam.map.positions[slam.map.good]
    assert len(points) > 400
    outside = np.maximum.reduce([np.abs(points[:, 0]) - 2.0, points[:, 2] - 4.0, points[:, 1] - 1.3])
    # At 4 m a fifth of a pixel of disparity is 8 cm.
    assert np.quantile(outside, 0.98) < 0.1
    assert (np.abs(outside) < 0.03).mean() > 0.4


def test_a_camera_that_only_turns_is_placed_too():
    film = RoomFilm(seed=3)
    turns = [pose((0.0, 0.0, 0.0), (0.0, 0.012 * i, 0.0)) for i in range(20)]
    slam = Slam(CAMERA, with_depth=True)
    frames = follow(slam, [film.frame(p) for p in turns], [{"depth": film.depth(p)} for p in turns])
    assert {frame.status for frame in frames} == {"tracked"}
    estimate = trajectory_of(slam, frames)
    assert np.linalg.norm(estimate.positions, axis=1).max() < 0.01
    assert estimate.world_from_camera[-1, :3, :3] == pytest.approx(turns[-1][:3, :3], abs=2e-3)


def test_frames_without_depth_are_bridged_but_nothing_starts_on_one():
    images, more, truth = views("depth", seed=4, n=25)
    more[0], more[10:20] = {}, [{}] * 10
    slam = Slam(CAMERA, with_depth=True)
    frames = follow(slam, images, more)
    assert frames[0].reason == "this frame has no depth"
    assert {frame.status for frame in frames[1:]} == {"tracked"}
    path = trajectory_of(slam, frames).positions
    expected = (np.linalg.inv(truth[1]) @ truth[1:])[:, :3, 3]
    assert np.linalg.norm(path - expected, axis=1).max() < 0.008


def test_too_few_depths_start_nothing():
    images, more, _ = views("depth", seed=4, n=3)
    for kind in more:
        kind["depth"][:, 60:] = np.nan
    frames = follow(Slam(CAMERA, with_depth=True), images, more)
    assert {frame.status for frame in frames} == {"waiting"}
    assert "corners with depth" in frames[-1].reason


def test_what_does_not_fit_together_is_refused():
    images, more, _ = views("depth", seed=4, n=1)
    with pytest.raises(CameraError, match="measures depth itself"):
        Slam(PAIR, with_depth=True)
    with pytest.raises(CameraError, match="depth image of frame 0 is 320x240"):
        Slam(CAMERA, with_depth=True).process_frame(images[0], 0, 0.0, depth=more[0]["depth"][::2, ::2])
    with pytest.raises(CameraError, match="right image of frame 0 is 320x240"):
        Slam(PAIR).process_frame(images[0], 0, 0.0, right=images[0][::2, ::2])
    with pytest.raises(MapError, match="from the motion of one camera alone, this camera's from"):
        Slam(PAIR).use_map(RigidMap(), extend=True)


def write_truth(path, truth):
    save_trajectory(path, Trajectory(np.arange(len(truth)) / 30.0, truth))


def write_tum(folder, images, more):
    lists = {"rgb": [], "depth": []}
    for name, lines in lists.items():
        (folder / name).mkdir(parents=True)
        for i in range(len(images)):
            stored = images[i] if name == "rgb" else np.nan_to_num(5000.0 * more[i]["depth"]).astype(np.uint16)
            cv2.imwrite(str(folder / name / f"{i:03d}.png"), stored)
            lines.append(f"{i / 30.0:.6f} {name}/{i:03d}.png")
        (folder / f"{name}.txt").write_text("\n".join(lines) + "\n")
    camera = f"width: 640\nheight: 480\nfx: {CAMERA.fx}\nfy: {CAMERA.fy}\ncx: {CAMERA.cx}\ncy: {CAMERA.cy}\n"
    (folder.parent / "camera.yaml").write_text(camera)
    return folder.parent / "camera.yaml"


def write_euroc(folder, images, more):
    for name, place, pictures in (("cam0", 0.0, images), ("cam1", BASELINE, [m["right"] for m in more])):
        camera = folder / "mav0" / name
        (camera / "data").mkdir(parents=True)
        rows = []
        for i, picture in enumerate(pictures):
            stamp = round(i / 30.0 * 1e9)
            cv2.imwrite(str(camera / "data" / f"{stamp}.png"), picture)
            rows.append(f"{stamp},{stamp}.png")
        (camera / "data.csv").write_text("#timestamp [ns],filename\n" + "\n".join(rows) + "\n")
        (camera / "sensor.yaml").write_text(
            f"T_BS:\n  cols: 4\n  rows: 4\n  data: [1, 0, 0, {place}, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]\n"
            "resolution: [640, 480]\ncamera_model: pinhole\n"
            f"intrinsics: [{CAMERA.fx}, {CAMERA.fy}, {CAMERA.cx}, {CAMERA.cy}]\n"
            "distortion_model: radial-tangential\ndistortion_coefficients: [0.0, 0.0, 0.0, 0.0]\n"
        )
    return folder


@pytest.mark.parametrize(("kind", "write"), [("depth", write_tum), ("stereo", write_euroc)])
def test_the_command_reads_recordings_with_depth_and_stereo_pairs(tmp_path, kind, write):
    images, more, truth = views(kind, seed=5, n=15)
    camera = write(tmp_path / "recording", images, more)
    write_truth(tmp_path / "truth.txt", truth)
    run = tmp_path / "run"
    command = ["slam", str(tmp_path / "recording"), "--camera", str(camera), "--no-video", "-o", str(run)]
    assert main(command) == 0
    summary = json.loads((run / "summary.json").read_text())
    assert summary["start_frame"] == 0
    assert summary["n_tracked"] == 15
    assert summary["scale"] == "metres"
    assert main(["evaluate", str(run), "--trajectory", str(tmp_path / "truth.txt")]) == 0
    figures = json.loads((run / "trajectory_evaluation.json").read_text())
    assert figures["se3"]["absolute_mm"]["rmse"] < 3.0
    # The saved map is metric too, and serves a camera alone.
    alone = ["slam", str(tmp_path / "recording"), "--camera", str(camera), "--map", str(run / "map.h5")]
    assert main([*alone, "--no-depth", "--no-video", "-o", str(tmp_path / "again")]) == 0
    again = json.loads((tmp_path / "again" / "summary.json").read_text())
    assert again["n_tracked"] == 15
    assert again["scale"] == "metres"


def test_depth_that_is_left_aside_leaves_one_camera(tmp_path):
    images, more, _ = views("depth", seed=5, n=4)
    camera = write_tum(tmp_path / "recording", images, more)
    command = ["slam", str(tmp_path / "recording"), "--camera", str(camera), "--no-depth", "--no-video"]
    assert main([*command, "-o", str(tmp_path / "run")]) == 0
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    assert summary["scale"] == "the median depth of the map's first view is 1"
