"""Camera tracking and mapping on rendered films with exact camera poses, in step with the frames and beside them."""

import csv
import json
import re
import shutil
import threading
import time
from dataclasses import replace

import cv2
import numpy as np
import pytest

from morph_dslam.camera import Camera
from morph_dslam.cli.app import main
from morph_dslam.errors import CameraError, MapError
from morph_dslam.evaluation.trajectory import absolute_error, match
from morph_dslam.io.camera_files import load_camera
from morph_dslam.io.trajectory import load_trajectory
from morph_dslam.slam.map_files import save_map
from morph_dslam.slam.mapping import Mapper
from morph_dslam.slam.options import SlamOptions
from morph_dslam.slam.result import NoPose, SlamReason, SlamStatus
from morph_dslam.slam.rigid_map import RigidMap
from morph_dslam.slam.scene import finish_scene, load_scene, map_scene, trajectory_of
from morph_dslam.slam.slam import Slam
from morph_dslam.sources.live import PacedRecording
from tests.support.real_data import ROOT, real_data
from tests.support.rendered_room import (
    CAMERA,
    SHEET_NODES,
    Film,
    RoomFilm,
    follow,
    hand_held,
    near_box,
    off_the_walls,
    path_errors,
    pose,
    rolling_frames,
    room,
    room_with_sheet,
    to_truth,
    wall,
    write_film,
)

WAITING, TRACKED, RELOCALIZED, LOST, FOUND_LATER = SlamStatus
BLACK = np.zeros((480, 640), np.uint8)


def statuses(frames):
    return [frame.status for frame in frames]


def noise(rng):
    return rng.integers(0, 256, (480, 640)).astype(np.uint8)


@pytest.fixture(scope="module")
def room_scene(room_film):
    return map_scene(Film(room_film[0]), CAMERA)


def test_the_path_through_a_room_is_found_and_the_map_lies_on_its_walls(room_scene, room_film):
    status, path = statuses(room_scene.frames), room_scene.trajectory
    start = status.index(TRACKED)
    assert start <= 30
    assert status == [FOUND_LATER] * start + [TRACKED] * (80 - start)
    assert path.indices.tolist() == list(range(80))
    assert path.timestamps == pytest.approx(path.indices / 30.0)
    errors = path_errors(path, room_film[1])
    assert np.median(errors) < 0.005
    assert errors.max() < 0.01
    outside = off_the_walls(to_truth(path, room_film[1]).apply(room_scene.points))
    assert len(outside) > 300
    assert np.quantile(outside, 0.98) < 0.06
    assert (np.abs(outside) < 0.03).mean() > 0.4
    assert not room_scene.is_metric
    summary = room_scene.summary()
    assert (summary["n_frames"], summary["start_frame"], summary["n_tracked"]) == (80, start, 80)
    assert not any(term["is_wrong"] for term in summary["camera"].values())
    assert not summary["flags"]
    assert summary["n_keyframes"] == len(room_scene.keyframes) > 4


def test_a_map_is_kept_if_the_check_of_its_camera_fails(room_scene, tmp_path, monkeypatch):
    def fail(*_):
        raise ZeroDivisionError

    monkeypatch.setattr("morph_dslam.slam.scene.estimate_camera", fail)
    with pytest.raises(ZeroDivisionError):
        replace(room_scene).save(tmp_path / "map.h5")
    assert len(load_scene(tmp_path / "map.h5", CAMERA).points) == len(room_scene.points)


def test_a_damaged_image_ends_a_run_that_says_what_it_kept(room_folder, tmp_path, refused):
    shutil.copytree(room_folder / "film", tmp_path / "film")
    damaged = sorted((tmp_path / "film").iterdir())[12]
    damaged.write_bytes(damaged.read_bytes()[:-2000])
    command = ["slam", tmp_path / "film", "--camera", room_folder / "camera.yaml", "--no-video", "-o", tmp_path / "run"]
    assert f"the 12 frames before it are in {tmp_path / 'run'}" in refused(*command)
    assert len((tmp_path / "run" / "frames.csv").read_text().splitlines()) == 13


def test_the_same_film_gives_the_same_result_and_a_rigid_scene_does_not_freeze(room_scene, room_film):
    again = map_scene(Film(room_film[0]), CAMERA, SlamOptions(freeze_when_deforming=True))
    assert not again.slam.is_frozen
    assert again.slam.frozen_at is None
    assert np.array_equal(again.trajectory.world_from_camera, room_scene.trajectory.world_from_camera)
    assert np.array_equal(again.points, room_scene.points)


def test_a_plane_gives_the_right_path():
    film, truth = RoomFilm(seed=2, scene=wall), hand_held(45, seed=2)
    errors = path_errors(map_scene(Film([film.frame(place) for place in truth]), CAMERA).trajectory, truth)
    assert len(errors) > 20
    assert np.median(errors) < 0.005


def test_a_camera_that_only_turns_waits_and_says_why():
    film = RoomFilm(seed=3)
    turns = [pose((0.0, 0.0, 0.0), (0.05 * np.sin(i / 4.0), 0.01 * i, 0.02 * np.cos(i / 5.0))) for i in range(25)]
    frames = follow(Slam(CAMERA), [film.frame(place) for place in turns])
    assert set(statuses(frames)) == {WAITING}
    assert frames[-1].reason == NoPose(SlamReason.ONLY_TURNED)


def test_the_command_ends_with_the_reason_where_no_frame_has_a_pose(tmp_path, capsys):
    film = RoomFilm(seed=3)
    write_film(tmp_path, [film.frame(pose((0.0, 0.0, 0.0), (0.0, 0.01 * i, 0.0))) for i in range(6)])
    command = ["slam", str(tmp_path / "film"), "--camera", str(tmp_path / "camera.yaml"), "-o", str(tmp_path / "run")]
    assert main([*command, "--no-video"]) == 2
    said = capsys.readouterr()
    assert "no map was begun" not in said.out
    assert "tracked=0/6" in said.out
    last = said.err.splitlines()[-1]
    assert last.startswith("morph: no map was begun: not enough parallax: ")
    assert str(tmp_path / "run" / "frames.csv") in last
    # What came of each frame is kept.
    with (tmp_path / "run" / "frames.csv").open() as file:
        assert [row["status"] for row in csv.DictReader(file)] == ["waiting"] * 6
    assert json.loads((tmp_path / "run" / "summary.json").read_text())["n_tracked"] == 0


def test_a_film_that_starts_no_map_ends_with_a_rolling_shutter_too():
    film = RoomFilm(seed=3)
    still = [film.frame(pose((0.0, 0.0, 0.0), (0.0, 0.0, 0.0)))] * 3
    scene = map_scene(Film(still), replace(CAMERA, readout_s=0.02))
    assert len(scene.trajectory.indices) == 0
    assert not scene.map.keyframes


def test_films_that_show_no_motion_start_nothing(room_film):
    rng, black = np.random.default_rng(0), Slam(CAMERA)
    assert {frame.reason for frame in follow(black, [BLACK] * 8)} == {NoPose(SlamReason.LITTLE_TEXTURE, (0,))}
    begun = NoPose(SlamReason.NO_MOTION)
    seen = follow(Slam(CAMERA), [noise(rng) for _ in range(8)])
    assert [f.reason for f in seen] == [begun, *[NoPose(SlamReason.FIRST_VIEW_LOST, cause=begun)] * 7]
    slam = Slam(CAMERA)
    still = follow(slam, [room_film[0][0]] * 8)
    assert [f.reason for f in still] == [begun, *[NoPose(SlamReason.ONLY_TURNED)] * 7]
    assert not slam.map.keyframes


def test_the_camera_is_found_again_after_noise_darkness_and_a_standstill(room_film):
    images, truth = room_film
    rng, slam = np.random.default_rng(1), Slam(CAMERA)
    disturbed = [*(noise(rng) for _ in range(5)), *[BLACK] * 10]
    frames = follow(slam, [*images[:50], *disturbed, *images[30:50], *[images[49]] * 8])
    assert set(statuses(frames[50:65])) == {LOST}
    assert all(isinstance(frame.reason, NoPose) for frame in frames[50:65])
    assert statuses(frames[65:]) == [RELOCALIZED, *[TRACKED] * 27]
    places = np.array([*truth[:50], *truth[:15], *truth[30:50], *[truth[49]] * 8])
    assert np.median(path_errors(trajectory_of(slam, frames), places)) < 0.005
    assert frames[-1].pose.camera_from_world == pytest.approx(frames[49].pose.camera_from_world, abs=2e-3)


def test_the_camera_stays_found_when_the_light_is_back(room_film):
    """It is followed through frames with a tenth of the light, in which the map has its points anew."""
    images, rng = room_film[0], np.random.default_rng(7)
    dim = [np.clip(0.1 * image + 2.0 * rng.standard_normal(image.shape), 0, 255) for image in images[35:65]]
    frames = follow(Slam(CAMERA), [*images[:35], *(image.astype(np.uint8) for image in dim), *images[65:80]])
    assert statuses(frames[35:65]) == [TRACKED] * 30
    assert any(frame.is_keyframe for frame in frames[35:65])
    assert set(statuses(frames[66:])) == {TRACKED}


@pytest.fixture(scope="module", params=[room, wall], ids=["room", "wall"])
def small_map(request):
    """A frozen map made by moving a quarter of a metre, the film, and the last pose."""
    film, truth = RoomFilm(seed=1, scene=request.param), hand_held(50, seed=1, reach=0.25)
    slam = Slam(CAMERA)
    scene = finish_scene(slam, follow(slam, [film.frame(place) for place in truth]))
    slam.freeze()
    return slam, film, truth[-1], to_truth(scene.trajectory, truth)


@pytest.mark.slow
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
    frames = follow(slam, [film.frame(place) for _ in range(3)], first=101)
    assert statuses(frames) == [RELOCALIZED, TRACKED, TRACKED]
    for frame in frames:
        centre = np.linalg.inv(frame.pose.camera_from_world)[:3, 3]
        assert world_from_map.apply(centre) == pytest.approx(place[:3, 3], abs=0.015)


@pytest.mark.slow
def test_the_camera_is_found_in_no_other_room(small_map):
    elsewhere = RoomFilm(seed=8)
    frames = follow(small_map[0], [elsewhere.frame(place) for place in hand_held(12, seed=8)], first=200)
    assert set(statuses(frames)) == {LOST}
    assert {frame.reason for frame in frames[1:]} == {NoPose(SlamReason.NO_SIMILAR_KEYFRAME)}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("term", "given"), [("focal", {"fx": 577.5, "fy": 577.5}), ("centre", {"cx": 349.5})], ids=["focal", "centre"]
)
def test_a_wrong_camera_is_found_out(tmp_path, room_film, term, given):
    scene = map_scene(Film(room_film[0]), replace(CAMERA, **given))
    summary = scene.summary()
    assert {name for name, found in summary["camera"].items() if found["is_wrong"]} == {term}
    assert summary["camera"]["focal"]["estimated"][0] == pytest.approx(525.0, rel=0.015)
    assert len(summary["flags"]) == 1
    scene.save(tmp_path / "map.h5")  # the other commands repeat what the map's file says
    assert list(load_scene(tmp_path / "map.h5", scene.camera).camera_notes) == summary["flags"]


def test_the_camera_is_refined_and_the_map_is_of_the_refined_one(tmp_path, room_film, capsys):
    write_film(tmp_path, room_film[0][:50], replace(CAMERA, fx=577.5, fy=577.5))
    run, camera = tmp_path / "run", tmp_path / "camera.yaml"
    command = ["slam", str(tmp_path / "film"), "--camera", str(camera), "-o", str(run), "--no-video"]
    assert main([*command, "--refine-camera", "focal"]) == 0
    assert "focal: 52" in capsys.readouterr().out
    refined = load_camera(run / "camera.yaml")
    assert refined == replace(CAMERA, fx=refined.fx, fy=refined.fy)
    assert refined.fx == pytest.approx(525.0, rel=0.01)
    summary = json.loads((run / "summary.json").read_text())
    assert summary["refined_camera"]["focal"]["given"] == [577.5]
    assert not summary["flags"]
    assert np.median(path_errors(load_scene(run / "map.h5", refined).trajectory, room_film[1])) < 0.005


@pytest.mark.slow
@pytest.mark.parametrize(("off_px", "within_px"), [(1.0, 1.0), (30.0, 2.0)])
def test_a_principal_point_is_refined_only_if_it_is_refuted(tmp_path, room_film, capsys, off_px, within_px):
    """It is stated a little beside the true one, and far from it."""
    given = replace(CAMERA, cx=CAMERA.cx + off_px)
    write_film(tmp_path, room_film[0], given)
    run = tmp_path / "run"
    command = ["slam", str(tmp_path / "film"), "--camera", str(tmp_path / "camera.yaml"), "-o", str(run), "--no-video"]
    assert main([*command, "--refine-camera", "centre", "--refine-camera", "focal"]) == 0
    refined = load_camera(run / "camera.yaml")
    assert ("not refuted, kept as given" in capsys.readouterr().out) == (off_px < 10.0)
    assert (refined.cx == given.cx) == (off_px < 10.0)
    assert refined.cx == pytest.approx(CAMERA.cx, abs=within_px)
    assert refined.fx == pytest.approx(CAMERA.fx, rel=0.01)


@pytest.mark.parametrize(
    ("more", "message"), [(["--map", "map.h5"], "leave out --map"), (["--trajectory", "t.txt"], "leave out --map")]
)
def test_no_camera_is_refined_in_a_known_map(tmp_path, room_folder, capsys, more, message):
    command = ["slam", str(room_folder / "film"), "--camera", str(room_folder / "camera.yaml"), "--refine-camera"]
    assert main([*command, *more, "-o", str(tmp_path / "run")]) == 2
    assert message in capsys.readouterr().err


def swaying(times):
    """Poses (n, 4, 4) of a hand-held camera at some times (n,), seconds: 6 pixels a frame."""
    waves = np.sin(np.outer(1.8 * times, [2.0, 2.7, 1.7, 3.1, 2.6, 3.0]))
    sways = waves * [0.16, 0.1, 0.05, 0.05, 0.07, 0.02]
    return np.array([pose(sway[:3], sway[3:]) for sway in sways])


@pytest.mark.slow
def test_a_rolling_shutter_bends_neither_the_path_nor_the_points_of_a_near_object():
    bands, readout = 8, 1.0 / 30.0
    film, path = RoomFilm(seed=4, scene=near_box), swaying(np.arange(bands * 46) / (30.0 * bands))
    images = rolling_frames(film, path, 30.0 * readout, bands)
    scene, truth = map_scene(Film(images), replace(CAMERA, readout_s=readout)), path[bands:-bands:bands]
    errors = path_errors(scene.trajectory, truth)
    assert len(errors) == len(images)
    assert np.median(errors) < 0.001
    assert errors.max() < 0.006
    points = to_truth(scene.trajectory, truth).apply(scene.points)
    # The box's front is at 1.2 m: taken for a body that moves, as without the rows' times, it would have no points.
    front = points[points[:, 2] < 1.5]
    assert len(front) > 10
    assert np.median(front[:, 2]) == pytest.approx(1.2, abs=0.02)


@pytest.mark.slow
def test_a_real_rolling_shutter_is_named_and_estimated(tmp_path):
    """The truth's own readout times are about a frame interval (`rbt_scene`); its poses are good to a few mm."""
    folder = real_data("rbt_scene")
    scene = map_scene(folder / "rgb", load_camera(folder / "camera.yaml"))
    estimate = scene.camera_estimate()
    assert [term for term, found in estimate.terms.items() if found.is_wrong] == ["readout"]
    readout = scene.camera_estimate(["readout"]).camera.readout_s
    assert readout == pytest.approx(1.0 / 30.0, rel=0.15)
    truth = load_trajectory(folder / "tags_shutter_corrected.txt")
    corrected = map_scene(folder / "rgb", replace(scene.camera, readout_s=readout))
    errors = [absolute_error(*match(s.trajectory, truth), with_scale=True).distances for s in (scene, corrected)]
    before, after = (1e3 * np.sqrt(np.mean(distances**2)) for distances in errors)
    assert after < 6.5 < before


@pytest.mark.slow
def test_the_usual_focal_length_of_a_real_recording_is_not_called_wrong():
    scene = map_scene(real_data("7scenes_redkitchen"), Camera(640, 480, 525.0, 525.0, 320.0, 240.0))
    wrong = [term for term, found in scene.camera_estimate().terms.items() if found.is_wrong]
    assert wrong in ([], ["readout"])  # the recording's colour camera has a rolling shutter


@pytest.mark.usefixtures("drawn_figures")
def test_the_command_writes_a_run_that_evaluate_reads(tmp_path, room_folder, capsys):
    run = tmp_path / "run"
    command = ["slam", str(room_folder / "film"), "--camera", str(room_folder / "camera.yaml"), "-o", str(run)]
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
    assert main(["evaluate", str(run), "--trajectory", str(room_folder / "truth.txt")]) == 0
    figures = json.loads((run / "trajectory_evaluation.json").read_text())
    assert figures["sim3"]["absolute_mm"]["rmse"] < 5.0
    assert load_scene(run / "map.h5", CAMERA).trajectory.indices.tolist() == list(range(40))
    rows = list(csv.DictReader((run / "frames.csv").read_text().splitlines()))
    later = [int(row["frame"]) for row in rows if row["status"] == "found later"]
    assert later == list(range(summary["start_frame"]))


@pytest.mark.slow
def test_the_documented_program_hands_over_each_frame(room_folder, monkeypatch):
    monkeypatch.chdir(room_folder)
    names = {}
    for program in re.findall(r"```python\n(.*?)```", (ROOT / "docs" / "slam.md").read_text(), flags=re.DOTALL):
        exec(program, names)
    assert names["result"].status is TRACKED
    local = names["points"] @ names["camera_from_world"][:3, :3].T + names["camera_from_world"][:3, 3]
    misses = np.linalg.norm(CAMERA.project(local) - names["pixels"], axis=1)
    assert len(misses) > 100
    assert misses.max() < 4.0
    assert np.linalg.eigvalsh(names["covariance"]).min() > 0.0
    assert names["astray"].shape[1:] == (3,)
    assert len(names["astray"]) == len(names["moved_to"])


@pytest.mark.slow
@pytest.mark.parametrize("at", [3, 25])
def test_an_interrupt_at_any_frame_keeps_what_was_mapped(tmp_path, room_folder, monkeypatch, at):
    process = Slam.process_frame

    def interrupted(slam, image, index, *rest):
        if index == at:
            raise KeyboardInterrupt
        return process(slam, image, index, *rest)

    monkeypatch.setattr(Slam, "process_frame", interrupted)
    command = ["slam", str(room_folder / "film"), "--camera", str(room_folder / "camera.yaml"), "--no-video"]
    assert main([*command, "-o", str(tmp_path / "run")]) == 130
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    assert summary["n_frames"] == at
    assert (summary["n_tracked"] > 0) == (at > 10)
    if summary["n_tracked"]:
        assert len(load_trajectory(tmp_path / "run" / "trajectory.txt")) == summary["n_tracked"]
        assert len(load_scene(tmp_path / "run" / "map.h5", CAMERA).map.good) == summary["n_map_points"] > 80


@pytest.mark.slow
def test_a_young_map_that_stays_lost_is_given_up_with_its_poses(room_film):
    images, truth = room_film
    elsewhere, places = RoomFilm(seed=9), hand_held(40, seed=9)
    film = Film([*images[:16], *(elsewhere.frame(place) for place in places)])
    scene = map_scene(film, CAMERA, SlamOptions(restart_after=5))
    assert scene.summary()["n_restarts"] == 1
    # Frames of the map that was given up show nothing of the one that stands.
    assert scene.trajectory.indices.min() >= 16
    assert np.median(path_errors(scene.trajectory, np.array([*truth[:16], *places]))) < 0.005


def test_a_frozen_map_stays_and_the_camera_is_still_found(room_film):
    images, truth = room_film
    slam, order = Slam(CAMERA, SlamOptions(freeze_at=50)), [*range(50), *range(49, 20, -1)]
    frames = follow(slam, [images[i] for i in order[:51]])
    before = slam.map.positions.copy(), len(slam.map.keyframes)
    frames += follow(slam, [images[i] for i in order[51:]], first=51)
    scene = finish_scene(slam, frames)
    assert np.array_equal(slam.map.positions, before[0])
    assert len(slam.map.keyframes) == before[1]
    assert set(statuses(frames[50:])) == {TRACKED}
    assert all(not len(frame.candidates) for frame in frames[50:])
    assert np.median(path_errors(scene.trajectory, truth[order])[-29:]) < 0.005


@pytest.mark.slow
def test_the_camera_is_found_in_a_saved_scene_which_may_grow(tmp_path, room_scene, room_film):
    images, truth = room_film
    room_scene.save(tmp_path / "map.h5")
    saved = load_scene(tmp_path / "map.h5", CAMERA)
    assert np.array_equal(saved.points, room_scene.points)
    assert np.array_equal(saved.trajectory.world_from_camera, room_scene.trajectory.world_from_camera)
    assert saved.summary()["n_keyframes"] == len(room_scene.keyframes)
    order = list(range(70, 40, -1))
    found = map_scene(Film([images[i] for i in order]), CAMERA, known=saved)
    assert statuses(found.frames) == [RELOCALIZED, *[TRACKED] * 29]
    assert len(found.keyframes) == len(room_scene.keyframes)
    assert np.median(path_errors(found.trajectory, truth[order])) < 0.005

    map_scene(Film(images[:40]), CAMERA).save(tmp_path / "map.h5")
    part = load_scene(tmp_path / "map.h5", CAMERA)
    before = len(part.keyframes), len(part.map.positions)
    grown = map_scene(Film(images[35:]), CAMERA, SlamOptions(extend=True), known=part)
    assert statuses(grown.frames) == [RELOCALIZED, *[TRACKED] * 44]
    assert len(grown.keyframes) > before[0]
    assert len(grown.map.positions) > before[1]
    assert np.median(path_errors(grown.trajectory, truth[35:])) < 0.005


@pytest.mark.slow
def test_the_map_freezes_by_itself_when_a_part_of_the_scene_moves():
    film, there = RoomFilm(seed=1, scene=room_with_sheet), hand_held(80, seed=1)[:42]
    truth, images = np.array([*there, *there[:20:-1]]), []
    for index, place in enumerate(truth):
        if index >= 30:
            film.nodes[-SHEET_NODES:] += [0.0, 0.03 if index < 40 else 0.0, 0.0]
        images.append(film.frame(place))
    scene = map_scene(Film(images), CAMERA, SlamOptions(freeze_when_deforming=True))
    frozen_at = scene.summary()["frozen_by_itself_at"]
    assert 30 <= frozen_at < 45
    assert scene.slam.is_frozen
    assert set(statuses(scene.frames[frozen_at:])) == {TRACKED}
    assert not any(frame.is_keyframe for frame in scene.frames[frozen_at + 1 :])
    assert np.median(path_errors(scene.trajectory, truth)[-10:]) < 0.01


def test_a_map_that_cannot_be_used_is_refused(tmp_path, room_scene):
    path = tmp_path / "map.h5"
    with pytest.raises(MapError, match=r"map\.h5"):
        load_scene(path, CAMERA)
    save_map(path, RigidMap(), CAMERA)
    with pytest.raises(MapError, match="empty"):
        load_scene(path, CAMERA)
    room_scene.save(path)
    with pytest.raises(MapError, match="camera file"):
        load_scene(path, replace(CAMERA, fx=600.0))
    whole = path.read_bytes()
    for at in np.linspace(0, len(whole) - 1, 10).astype(int):  # cut short, a byte doubled, a bit changed
        before, here, after = whole[:at], whole[at : at + 1], whole[at + 1 :]
        for damaged in (before, before + here + here + after, before + bytes([here[0] ^ 1]) + after):
            path.write_bytes(damaged)
            with pytest.raises(MapError, match="damaged"):
                load_scene(path, CAMERA)


def test_an_image_of_another_size_is_refused_and_leaves_the_rest_as_it_was(room_film):
    slam = Slam(CAMERA)
    follow(slam, room_film[0][:25])
    with pytest.raises(CameraError, match="frame 25 is 320x240"):
        slam.process_frame(room_film[0][25][::2, ::2], 25, 25 / 30.0)
    assert slam.process_frame(room_film[0][25], 25, 25 / 30.0).status is TRACKED


@pytest.mark.parametrize("mode", ["waiting", "mapping", "frozen", "lost"])
def test_a_reset_begins_anew_in_any_mode(room_film, mode):
    images, slam = room_film[0], Slam(CAMERA)
    follow(slam, images[: 2 if mode == "waiting" else 25])
    if mode == "frozen":
        slam.freeze()
    if mode == "lost":
        follow(slam, [BLACK] * 3)
    slam.reset()
    assert not slam.map.keyframes
    assert not slam.is_frozen
    status = statuses(follow(slam, images[30:55]))
    assert (status[0], status[-1]) == (WAITING, TRACKED)
    assert len(slam.map.keyframes) > 2


def test_records_of_frames_are_small_and_say_the_same(room_film):
    slam = Slam(CAMERA)
    frames = follow(slam, room_film[0][:60])
    frames = slam.refine_map(frames)
    records = [frame.record(is_final=False) for frame in frames]
    for frame, record in zip(frames, records, strict=True):
        before, after = slam.camera_from_world(frame), slam.camera_from_world(record)
        assert (before is None) == (after is None)
        assert before is None or np.array_equal(before, after)
        counts = len(frame.points.ids), len(frame.candidates), len(frame.disagreeing.ids)
        assert (record.n_points, record.n_candidates, record.n_disagreeing) == counts
        assert not len(record.candidates)
    last = frames[-1].record(is_final=True)
    assert not len(last.points.ids)
    assert last.n_points > 100


def beside(slam, images, first=0):
    """What a threaded `Slam` makes of images at a pace that leaves the mapper the time it needs."""
    frames = []
    for index, image in enumerate(images, start=first):
        frames.append(slam.process_frame(image, index, index / 30.0))
        slam.wait()
    return frames


def under_way(slam, images):
    """Go on until the mapper has begun work that is not done; returns the next frame's number."""
    for index, image in enumerate(images):
        slam.process_frame(image, index, index / 30.0)
        if slam.is_mapping:
            return index + 1
    raise AssertionError("the mapper was never at work")


@pytest.fixture
def may_go_on(monkeypatch):
    """An event that the mapper waits for before it inserts a keyframe."""
    event, insert = threading.Event(), Mapper.insert

    def held_up(mapper, tracked, view):
        assert event.wait(timeout=60.0)
        yield from insert(mapper, tracked, view)

    monkeypatch.setattr(Mapper, "insert", held_up)
    return event


def test_a_map_made_beside_the_frames_is_as_good(room_film):
    images, truth = room_film
    slam, frames = Slam(CAMERA, threaded=True), []
    for index, image in enumerate(images):
        frames.append(slam.process_frame(image, index, index / 30.0))
        # The pace of a camera: without it the whole film would be over before the mapper had its turn.
        time.sleep(0.01)
    scene = finish_scene(slam, frames)
    start = statuses(frames).index(TRACKED)
    assert start <= 30
    assert set(statuses(frames[start:])) == {TRACKED}
    assert sum(frame.is_keyframe for frame in frames) >= 4
    assert np.median(path_errors(scene.trajectory, truth)) < 0.005
    outside = off_the_walls(to_truth(scene.trajectory, truth).apply(scene.points))
    assert len(outside) > 300
    assert np.quantile(outside, 0.98) < 0.06


def test_a_reset_while_the_mapper_is_at_work_forgets_what_it_does(room_film, may_go_on):
    slam = Slam(CAMERA, threaded=True)
    under_way(slam, room_film[0])
    slam.reset()
    may_go_on.set()
    assert not slam.map.keyframes
    status = statuses(beside(slam, room_film[0][30:60]))
    assert (status[0], status[-1]) == (WAITING, TRACKED)
    # The new map's points have nothing of the old one.
    assert {keyframe.index for keyframe in slam.map.keyframes} <= set(range(30))
    assert len(slam.map.keyframes) > 2


def test_freezing_waits_for_nobody_and_the_map_stays(room_film, may_go_on):
    """Freezing returns though the mapper's step cannot end before: with any waiting this would hang."""
    slam = Slam(CAMERA, threaded=True)
    after = under_way(slam, room_film[0])
    n_keyframes, positions = len(slam.map.keyframes), slam.map.positions.copy()
    slam.freeze()
    may_go_on.set()
    later = beside(slam, room_film[0][after : after + 10], after)
    slam.refine_map(later)
    assert set(statuses(later)) == {TRACKED}
    assert len(slam.map.keyframes) == n_keyframes
    assert np.array_equal(slam.map.positions, positions)


class FilmCapture:
    """What `cv2.VideoCapture` offers, from images; each waits until the frame before was worked on."""

    def __init__(self, images):
        self.images, self.delivered, self.next = images, 0, threading.Semaphore(1)

    def isOpened(self):
        return True

    def read(self):
        if not self.next.acquire(timeout=60.0) or self.delivered == len(self.images):
            return False, None
        self.delivered += 1
        return True, cv2.cvtColor(self.images[self.delivered - 1], cv2.COLOR_GRAY2BGR)

    def get(self, propId):
        return 30.0

    def release(self):
        pass


@pytest.mark.slow
def test_a_webcam_is_tracked_until_it_ends(tmp_path, room_folder, room_film, monkeypatch, capsys):
    capture, process = FilmCapture(room_film[0][:40]), Slam.process_frame

    def released(slam, image, index, *rest):
        assert slam.threaded
        result = process(slam, image, index, *rest)
        capture.next.release()
        return result

    monkeypatch.setattr(cv2, "VideoCapture", lambda device: capture)
    monkeypatch.setattr(Slam, "process_frame", released)
    run, camera = tmp_path / "run", str(room_folder / "camera.yaml")
    assert main(["slam", "webcam:0", "--camera", camera, "-o", str(run), "--no-video"]) == 2
    assert "after frame 39" in capsys.readouterr().err
    summary = json.loads((run / "summary.json").read_text())
    assert (summary["n_frames"], summary["n_dropped"]) == (40, 0)
    assert summary["longest_wait_for_mapper_ms"] >= summary["p99_wait_for_mapper_ms"] > 0.0
    assert len(load_trajectory(run / "trajectory.txt")) == summary["n_tracked"] > 5
    assert (run / "map.h5").exists()


def test_an_interrupt_ends_the_mapping_of_a_live_source_but_not_of_a_recording(room_film):
    def interrupt(_, frame):
        if frame.index == 2:
            raise KeyboardInterrupt

    film = Film(room_film[0][:4])
    with PacedRecording(film, sleep=lambda seconds: time.sleep(0.2)) as stream:
        assert len(map_scene(stream, CAMERA, watch=interrupt).frames) <= 2
    with pytest.raises(KeyboardInterrupt):
        map_scene(film, CAMERA, watch=interrupt)
