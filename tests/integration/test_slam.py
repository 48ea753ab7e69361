"""Camera tracking and mapping on rendered films with exact camera poses."""

import json
import re
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from morph_dslam.cli.app import main
from morph_dslam.errors import MapError
from morph_dslam.geometry import fit_similarity
from morph_dslam.io.trajectory import Trajectory, load_trajectory, save_trajectory
from morph_dslam.slam.map_files import load_map, save_map
from morph_dslam.slam.options import SlamOptions
from morph_dslam.slam.output import trajectory_of
from morph_dslam.slam.rigid_map import RigidMap
from morph_dslam.slam.slam import Slam
from tests.support.rendered_room import CAMERA, SHEET_NODES, RoomFilm, hand_held, pose, room, room_with_sheet, wall

N_FRAMES = 80
DOCS = Path(__file__).parents[2] / "docs"


def follow(images):
    slam = Slam(CAMERA)
    return slam, [slam.process_frame(image, index, index / 30.0) for index, image in enumerate(images)]


def errors_after_alignment(slam, frames, truth):
    """Distances of the camera centres after Sim(3), and the length of the true path."""
    estimate = trajectory_of(slam, frames).positions
    expected = np.array([truth[f.index][:3, 3] for f in frames if f.pose is not None])
    aligned = fit_similarity(estimate, expected).apply(estimate)
    length = np.linalg.norm(np.diff(expected, axis=0), axis=1).sum()
    return np.linalg.norm(aligned - expected, axis=1), length


@pytest.fixture(scope="module")
def room_run(room_film):
    return follow(room_film[0])


def test_the_path_through_a_room_is_found(room_run, room_film):
    slam, frames = room_run
    slam.refine_map()
    status = [frame.status for frame in frames]
    start = status.index("tracked")
    assert start <= 30
    assert set(status[:start]) == {"waiting"}
    assert set(status[start:]) == {"tracked"}
    errors, length = errors_after_alignment(slam, frames, room_film[1])
    assert np.median(errors) < 0.005 * length
    assert errors.max() < 0.01 * length


def test_the_map_lies_on_the_walls(room_run, room_film):
    slam, frames = room_run
    estimate = trajectory_of(slam, frames).positions
    truth = np.array([room_film[1][f.index][:3, 3] for f in frames if f.pose is not None])
    points = fit_similarity(estimate, truth).apply(slam.map.positions[slam.map.good])
    assert len(points) > 300
    # The room's walls are at x = -2 and 2, z = 4, the floor at y = 1.3; nothing is behind them.
    outside = np.maximum.reduce([np.abs(points[:, 0]) - 2.0, points[:, 2] - 4.0, points[:, 1] - 1.3])
    assert np.quantile(outside, 0.98) < 0.06
    assert (np.abs(outside) < 0.03).mean() > 0.4


def test_reported_deviations_are_of_the_size_of_the_errors(room_run):
    _, frames = room_run
    found = [frame for frame in frames if frame.pose is not None]
    assert all(0.05 < frame.pose.rms_px < 1.5 for frame in found)
    assert all(np.isfinite(frame.pose.covariance).all() for frame in found)


def test_the_same_film_gives_the_same_result(room_run, room_film):
    _, again = follow(room_film[0][:40])
    for one, other in zip(room_run[1], again, strict=False):
        assert one.status == other.status
        assert np.array_equal(one.points.ids, other.points.ids)
        if one.pose is not None:
            assert np.array_equal(one.pose.camera_from_world, other.pose.camera_from_world)


def test_a_plane_gives_the_right_path():
    film, truth = RoomFilm(seed=2, scene=wall), hand_held(45, seed=2)
    slam, frames = follow([film.frame(place) for place in truth])
    errors, length = errors_after_alignment(slam, frames, truth)
    assert len(errors) > 20
    assert np.median(errors) < 0.005 * length


def test_a_camera_that_only_turns_waits_and_says_why():
    film = RoomFilm(seed=3)
    turns = [pose((0.0, 0.0, 0.0), (0.05 * np.sin(i / 4.0), 0.01 * i, 0.02 * np.cos(i / 5.0))) for i in range(25)]
    _, frames = follow([film.frame(place) for place in turns])
    assert {frame.status for frame in frames} == {"waiting"}
    assert "not enough parallax" in frames[-1].reason


def test_the_camera_is_found_again_after_a_blackout(room_film):
    images, truth = room_film
    dark = [np.full_like(images[0], 3)] * 15
    slam, frames = follow([*images[:50], *dark, *images[30:50]])
    assert {frame.status for frame in frames[50:65]} == {"lost"}
    assert all(frame.reason for frame in frames[50:65])
    again = [frame.status for frame in frames[65:]]
    assert again[0] == "relocalised"
    assert set(again[1:]) == {"tracked"}
    errors, length = errors_after_alignment(slam, frames, [*truth[:50], *truth[:15], *truth[30:50]])
    assert np.median(errors) < 0.005 * length


@pytest.fixture(scope="module", params=[room, wall], ids=["room", "wall"])
def small_map(request):
    """A frozen map made by moving a quarter of a metre, the film, and the last pose."""
    film, truth = RoomFilm(seed=1, scene=request.param), hand_held(50, seed=1, reach=0.25)
    slam = Slam(CAMERA)
    frames = [slam.process_frame(film.frame(place), i, i / 30.0) for i, place in enumerate(truth)]
    slam.refine_map()
    slam.freeze()
    estimate = trajectory_of(slam, frames).positions
    expected = np.array([truth[f.index][:3, 3] for f in frames if f.pose is not None])
    return slam, film, truth[-1], fit_similarity(estimate, expected)


@pytest.mark.parametrize(
    ("shift", "turn"),
    [
        ((0.5, 0.0, 0.0), (0.0, 0.0, 0.0)),
        ((-0.5, 0.0, 0.0), (0.0, 0.2, 0.0)),
        ((0.0, 0.0, 0.6), (0.0, 0.0, 0.0)),
        ((0.0, 0.0, -0.6), (0.0, 0.0, 0.0)),
        ((0.1, 0.0, 0.0), (0.0, 0.0, 0.5)),
    ],
    ids=["right", "left and turned", "nearer", "farther", "rolled"],
)
def test_the_camera_is_found_from_beside_the_keyframes_and_stays_found(small_map, shift, turn):
    slam, film, last, world_from_map = small_map
    slam.process_frame(np.full((480, 640), 3, np.uint8), 100, 3.3)
    place = last @ pose(shift, turn)
    frames = [slam.process_frame(film.frame(place), 101 + i, 3.4 + i / 30.0) for i in range(3)]
    assert [frame.status for frame in frames] == ["relocalised", "tracked", "tracked"]
    for frame in frames:
        centre = np.linalg.inv(frame.pose.camera_from_world)[:3, 3]
        assert world_from_map.apply(centre) == pytest.approx(place[:3, 3], abs=0.015)


def test_the_camera_is_found_in_no_other_room(small_map):
    slam = small_map[0]
    elsewhere = RoomFilm(seed=8)
    images = [elsewhere.frame(place) for place in hand_held(12, seed=8)]
    frames = [slam.process_frame(image, 200 + i, 7.0 + i / 30.0) for i, image in enumerate(images)]
    assert {frame.status for frame in frames} == {"lost"}
    assert {frame.reason for frame in frames[1:]} == {"the view resembles no keyframe"}


@pytest.mark.parametrize("kind", ["black", "noise", "repeated"])
def test_films_that_show_no_motion_start_nothing(kind, room_film):
    rng = np.random.default_rng(0)
    images = {
        "black": [np.zeros((480, 640), np.uint8)] * 8,
        "noise": [rng.integers(0, 256, (480, 640)).astype(np.uint8) for _ in range(8)],
        "repeated": [room_film[0][0]] * 8,
    }[kind]
    slam, frames = follow(images)
    assert {frame.status for frame in frames} == {"waiting"}
    assert all(frame.reason for frame in frames)
    assert not slam.map.keyframes


def write_film(folder, film):
    images, truth = film
    folder.mkdir()
    for index, image in enumerate(images[:40]):
        cv2.imwrite(str(folder / f"{index:04d}.png"), image)
    camera = f"width: 640\nheight: 480\nfx: {CAMERA.fx}\nfy: {CAMERA.fy}\ncx: {CAMERA.cx}\ncy: {CAMERA.cy}\n"
    (folder.parent / "camera.yaml").write_text(camera)
    save_trajectory(folder.parent / "truth.txt", Trajectory(np.arange(40) / 30.0, np.array(truth[:40])))


def test_the_command_writes_a_run_that_evaluate_reads(tmp_path, room_film, capsys):
    write_film(tmp_path / "film", room_film)
    run = tmp_path / "run"
    command = ["slam", str(tmp_path / "film"), "--camera", str(tmp_path / "camera.yaml"), "-o", str(run)]
    assert main(command) == 0
    assert "tracked=" in capsys.readouterr().out
    written = {str(path.relative_to(run)) for path in run.rglob("*.*")}
    assert written == {
        *("trajectory.txt", "map.ply", "map.h5", "frames.csv", "summary.json", "tracked.mp4"),
        *("plots/trajectory.png", "plots/frames.png"),
        *("colmap/cameras.txt", "colmap/images.txt", "colmap/points3D.txt"),
    }
    summary = json.loads((run / "summary.json").read_text())
    assert summary["n_frames"] == 40
    assert summary["n_tracked"] == len(load_trajectory(run / "trajectory.txt"))
    assert len((run / "frames.csv").read_text().splitlines()) == 41
    assert main(["evaluate", str(run), "--trajectory", str(tmp_path / "truth.txt")]) == 0
    figures = json.loads((run / "trajectory_evaluation.json").read_text())
    assert figures["sim3"]["absolute_mm"]["rmse"] < 5.0
    # A second run does not replace the first unless it is told to.
    assert main(command) == 2
    assert "holds a run already" in capsys.readouterr().err


def test_the_documented_program_hands_over_each_frame(tmp_path, room_film, monkeypatch):
    write_film(tmp_path / "film", room_film)
    monkeypatch.chdir(tmp_path)
    (program,) = re.findall(r"```python\n(.*?)```", (DOCS / "slam.md").read_text(), flags=re.DOTALL)
    names = {}
    exec(program, names)
    assert names["result"].status == "tracked"
    local = names["points"] @ names["camera_from_world"][:3, :3].T + names["camera_from_world"][:3, 3]
    misses = np.linalg.norm(CAMERA.project(local) - names["pixels"], axis=1)
    assert len(misses) > 100
    assert misses.max() < 4.0
    assert np.linalg.eigvalsh(names["covariance"]).min() > 0.0
    assert names["astray"].shape[1:] == (3,)
    assert len(names["astray"]) == len(names["moved_to"])


def test_an_interrupted_run_keeps_what_was_mapped(tmp_path, room_film, monkeypatch):
    write_film(tmp_path / "film", room_film)
    process = Slam.process_frame

    def interrupted(slam, image, index, *rest):
        if index == 25:
            raise KeyboardInterrupt
        return process(slam, image, index, *rest)

    monkeypatch.setattr(Slam, "process_frame", interrupted)
    run = tmp_path / "run"
    camera = str(tmp_path / "camera.yaml")
    assert main(["slam", str(tmp_path / "film"), "--camera", camera, "-o", str(run), "--no-video"]) == 130
    assert json.loads((run / "summary.json").read_text())["n_frames"] == 25
    assert len(load_trajectory(run / "trajectory.txt")) > 5
    assert not (run / "tracked.mp4").exists()


def test_a_young_map_that_stays_lost_is_given_up_with_its_poses(room_film):
    images, truth = room_film
    elsewhere, places = RoomFilm(seed=9), hand_held(40, seed=9)
    slam = Slam(CAMERA, SlamOptions(restart_after=5))
    film = [*images[:16], *(elsewhere.frame(place) for place in places)]
    frames = [slam.process_frame(image, index, index / 30.0) for index, image in enumerate(film)]
    assert slam.n_restarts == 1
    errors, length = errors_after_alignment(slam, [f for f in frames if slam.is_placed(f)], [*truth[:16], *places])
    assert len(trajectory_of(slam, frames)) == len(errors)
    assert all(frame.index > 20 for frame in frames if slam.is_placed(frame))
    assert np.median(errors) < 0.005 * length


def test_a_frozen_map_stays_and_the_camera_is_still_found(room_film):
    images, truth = room_film
    slam = Slam(CAMERA)
    film = [*images[:50], *images[49:20:-1]]
    places = [*truth[:50], *truth[49:20:-1]]
    frames = []
    for index, image in enumerate(film):
        if index == 50:
            slam.freeze()
            before = slam.map.positions.copy(), len(slam.map.keyframes)
        frames.append(slam.process_frame(image, index, index / 30.0))
    slam.refine_map()
    assert np.array_equal(slam.map.positions, before[0])
    assert len(slam.map.keyframes) == before[1]
    assert {frame.status for frame in frames[50:]} == {"tracked"}
    assert all(not len(frame.candidates) for frame in frames[50:])
    errors, length = errors_after_alignment(slam, frames, places)
    assert np.median(errors[-29:]) < 0.005 * length


def test_the_camera_is_found_in_a_saved_map(tmp_path, room_run, room_film):
    mapped, _ = room_run
    images, truth = room_film
    save_map(tmp_path / "map.h5", mapped.map, CAMERA)
    slam = Slam(CAMERA)
    slam.use_map(load_map(tmp_path / "map.h5", CAMERA))
    order = list(range(70, 40, -1))
    frames = [slam.process_frame(images[i], n, n / 30.0) for n, i in enumerate(order)]
    assert [frame.status for frame in frames[:2]] == ["relocalised", "tracked"]
    assert {frame.status for frame in frames[1:]} == {"tracked"}
    assert len(slam.map.keyframes) == len(mapped.map.keyframes)
    errors, length = errors_after_alignment(slam, frames, [truth[i] for i in order])
    assert np.median(errors) < 0.005 * length


def test_a_saved_map_grows_where_the_camera_goes_on(tmp_path, room_film):
    images, truth = room_film
    first, _ = follow(images[:40])
    save_map(tmp_path / "map.h5", first.map, CAMERA)
    slam = Slam(CAMERA)
    slam.use_map(load_map(tmp_path / "map.h5", CAMERA), extend=True)
    frames = [slam.process_frame(images[i], i - 35, i / 30.0) for i in range(35, 80)]
    assert frames[0].status == "relocalised"
    assert {frame.status for frame in frames[1:]} == {"tracked"}
    assert len(slam.map.keyframes) > len(first.map.keyframes)
    assert len(slam.map.positions) > len(first.map.positions)
    slam.refine_map()
    errors, length = errors_after_alignment(slam, frames, truth[35:])
    assert np.median(errors) < 0.005 * length


def test_the_map_freezes_by_itself_when_a_part_of_the_scene_moves():
    film, there = RoomFilm(seed=1, scene=room_with_sheet), hand_held(N_FRAMES, seed=1)[:42]
    truth = [*there, *there[:20:-1]]
    slam = Slam(CAMERA, freeze_when_deforming=True)
    frames = []
    for index, place in enumerate(truth):
        if index >= 30:
            film.nodes[-SHEET_NODES:] += [0.0, 0.03 if index < 40 else 0.0, 0.0]
        frames.append(slam.process_frame(film.frame(place), index, index / 30.0))
    assert 30 <= slam.frozen_at < 45
    assert slam.is_frozen
    assert {frame.status for frame in frames[slam.frozen_at :]} == {"tracked"}
    assert not any(frame.is_keyframe for frame in frames[slam.frozen_at + 1 :])
    errors, length = errors_after_alignment(slam, frames, truth)
    assert np.median(errors[-10:]) < 0.01 * length


def test_a_rigid_scene_does_not_freeze(room_film):
    slam = Slam(CAMERA, freeze_when_deforming=True)
    for index, image in enumerate(room_film[0]):
        slam.process_frame(image, index, index / 30.0)
    assert not slam.is_frozen
    assert slam.frozen_at is None


def test_a_map_that_cannot_be_used_is_refused(tmp_path, room_run):
    path = tmp_path / "map.h5"
    with pytest.raises(MapError, match="there is no map"):
        load_map(path, CAMERA)
    save_map(path, RigidMap(), CAMERA)
    with pytest.raises(MapError, match="empty"):
        load_map(path, CAMERA)
    save_map(path, room_run[0].map, CAMERA)
    with pytest.raises(MapError, match="use the camera file it was made with"):
        load_map(path, replace(CAMERA, fx=600.0))
    path.write_bytes(path.read_bytes()[:2000])
    with pytest.raises(MapError, match="damaged"):
        load_map(path, CAMERA)
    path.write_text("no map")
    with pytest.raises(MapError, match="no map of"):
        load_map(path, CAMERA)
