"""Maps that another program made: COLMAP models, and trajectories from which only points are missing."""

import json

import cv2
import numpy as np
import pytest

from morph_dslam.cli.app import main
from morph_dslam.errors import MapError
from morph_dslam.io.colmap import ColmapImage, read_colmap_model, write_colmap_model
from morph_dslam.io.trajectory import Trajectory, load_trajectory, save_trajectory
from tests.support.rendered_room import CAMERA, RoomFilm, hand_held, pose

N_FRAMES = 40
#: Another program's world and unit.
WORLD, UNIT = pose((3.0, -1.0, 2.0), (0.4, -0.2, 0.9)), 2.5


def in_other_world(world_from_camera):
    """Poses as the other program gives them."""
    moved = WORLD @ world_from_camera
    moved[..., :3, 3] *= UNIT
    return moved


@pytest.fixture(scope="module")
def film(tmp_path_factory):
    """A folder with the images of a film, its poses in the other world, and a camera file."""
    folder = tmp_path_factory.mktemp("film")
    room, truth = RoomFilm(seed=1), hand_held(N_FRAMES, seed=1)
    (folder / "images").mkdir()
    for index, place in enumerate(truth):
        cv2.imwrite(str(folder / "images" / f"{index:04d}.png"), room.frame(place))
    values = f"fx: {CAMERA.fx}\nfy: {CAMERA.fy}\ncx: {CAMERA.cx}\ncy: {CAMERA.cy}\n"
    (folder / "camera.yaml").write_text(f"width: 640\nheight: 480\n{values}")
    (folder / "wrong.yaml").write_text("width: 640\nheight: 480\nfx: 800\nfy: 800\ncx: 250\ncy: 200\n")
    save_trajectory(folder / "poses.txt", Trajectory(np.arange(N_FRAMES) / 30.0, in_other_world(truth)))
    return folder, room, truth


def slam(film, run, *more, camera="camera.yaml"):
    """Track the second half of the film."""
    folder = film[0]
    command = ["slam", str(folder / "images"), "--camera", str(folder / camera), "-o", str(run)]
    return main([*command, "--range", f"20-{N_FRAMES - 1}", "--no-video", *map(str, more)])


def largest_error(film, run):
    """Distance of the found from the true camera centres, in true metres, without any alignment."""
    found = load_trajectory(run / "trajectory.txt")
    assert len(found) == N_FRAMES - 20
    expected = in_other_world(film[2])[20:, :3, 3]
    return np.linalg.norm(found.positions - expected, axis=1).max() / UNIT


def test_the_camera_is_found_in_the_world_of_a_trajectory(tmp_path, film):
    assert slam(film, tmp_path / "run", "--trajectory", film[0] / "poses.txt") == 0
    assert largest_error(film, tmp_path / "run") < 0.005
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    assert summary["map_frozen"]
    assert summary["status"] == {"relocalised": 1, "tracked": N_FRAMES - 21}


@pytest.fixture(scope="module")
def colmap(film, tmp_path_factory):
    """A COLMAP model of every fourth image: corners, with their points by the renderer's depth."""
    _, room, truth = film
    points = []
    for source in range(0, N_FRAMES, 4):
        grey, world_from_camera = room.frame(truth[source]), truth[source]
        corners = cv2.goodFeaturesToTrack(grey, 120, 0.01, 12)[:, 0].astype(float)
        corners = np.rint(corners)
        depth = room.depth(world_from_camera, noise=0.0)[corners[:, 1].astype(int), corners[:, 0].astype(int)]
        local = CAMERA.rays(corners) * depth[:, None]
        points.append((local @ world_from_camera[:3, :3].T + world_from_camera[:3, 3])[np.isfinite(depth)])
    points, images = np.concatenate(points), []
    for index in range(0, N_FRAMES, 4):
        local = (points - truth[index][:3, 3]) @ truth[index][:3, :3]
        pixels = CAMERA.project(local)
        inside = (local[:, 2] > 0) & (np.abs(pixels - [320, 240]) < [310, 230]).all(axis=1)
        seen = np.flatnonzero(inside)
        columns, rows = np.rint(pixels[seen]).astype(int).T
        # Of points behind something the image shows what is before them.
        depth = room.depth(truth[index], noise=0.0)[rows, columns]
        seen = seen[np.abs(depth / local[seen, 2] - 1.0) < 0.02]
        other = np.linalg.inv(in_other_world(truth[index]))
        images.append(ColmapImage(f"shot_{index:04d}.jpg", other, seen, pixels[seen]))
    moved = UNIT * (points @ WORLD[:3, :3].T + WORLD[:3, 3])
    model = tmp_path_factory.mktemp("model") / "colmap"
    write_colmap_model(model, CAMERA, images, moved)
    return model


def test_the_camera_is_found_in_a_colmap_model(tmp_path, film, colmap):
    assert slam(film, tmp_path / "run", "--map", colmap) == 0
    assert largest_error(film, tmp_path / "run") < 0.01


def test_what_does_not_fit_is_refused_with_the_reason(tmp_path, film, colmap, capsys):
    def message(*more, **options):
        assert slam(film, tmp_path / "run", *more, **options) == 2
        return capsys.readouterr().err

    late = load_trajectory(film[0] / "poses.txt")
    save_trajectory(tmp_path / "late.txt", Trajectory(late.timestamps + 100.0, late.world_from_camera))
    text = message("--trajectory", tmp_path / "late.txt")
    assert "only 0 of 40 frames" in text
    assert "0.000 to 1.300 s, the trajectory's from 100.000 to 101.300 s" in text
    inverted = np.linalg.inv(late.world_from_camera).astype(float)
    save_trajectory(tmp_path / "inverted.txt", Trajectory(late.timestamps, inverted))
    assert "do not fit the images" in message("--trajectory", tmp_path / "inverted.txt")
    # Three frames late: every point is somewhere, but not where the next frames have it.
    late = Trajectory(late.timestamps, np.roll(late.world_from_camera, 3, axis=0))
    save_trajectory(tmp_path / "late.txt", late)
    assert "do not fit the images" in message("--trajectory", tmp_path / "late.txt")
    assert "give the camera" in " ".join(message("--map", colmap, camera="wrong.yaml").split())
    assert "not from both" in message("--map", colmap, "--trajectory", tmp_path / "late.txt")
    (tmp_path / "empty").mkdir()
    assert "save the COLMAP model as text" in message("--map", tmp_path / "empty")


def test_a_model_of_other_frames_is_refused(tmp_path, film, colmap):
    text = (colmap / "images.txt").read_text().replace("shot_00", "shot_90")
    for name in ("cameras.txt", "points3D.txt"):
        (tmp_path / name).write_bytes((colmap / name).read_bytes())
    (tmp_path / "images.txt").write_text(text)
    assert slam(film, tmp_path / "run", "--map", tmp_path) == 2


def test_a_written_model_is_read_back(tmp_path):
    rng = np.random.default_rng(0)
    points, ids = rng.uniform([-1, -1, 3], [1, 1, 5], size=(6, 3)), np.array([0, 2, 3, 5])
    image = ColmapImage("7.png", pose((0.1, 0.2, 0.0), (0.1, -0.2, 0.3)), ids, rng.uniform(0, 400, (4, 2)))
    write_colmap_model(tmp_path / "colmap", CAMERA, [image], points)
    model = read_colmap_model(tmp_path / "colmap")
    (read,) = model.images
    assert read.number == 7
    assert read.camera_from_world == pytest.approx(image.camera_from_world, abs=1e-8)
    assert read.pixels == pytest.approx(image.pixels, abs=1e-3)
    assert model.points[read.point_ids] == pytest.approx(points[ids], abs=1e-8)
    (tmp_path / "colmap" / "images.txt").write_text("1 0 0\n\n")
    with pytest.raises(MapError, match="damaged"):
        read_colmap_model(tmp_path / "colmap")
