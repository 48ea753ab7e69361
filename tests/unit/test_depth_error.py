"""The surface error: distances in closed form, sensor points at known distances, and what is left out."""

import json

import cv2
import h5py
import numpy as np
import pytest

from morph_dslam.cli.app import main
from morph_dslam.errors import EvaluationError
from morph_dslam.evaluation.depth import RIM_PX, DepthError, depth_error, read_depths, summarise_depth
from morph_dslam.evaluation.run_folder import load_run
from morph_dslam.evaluation.run_report import plot_depth_errors_by_frame
from morph_dslam.render.rasteriser import rasterise
from morph_dslam.surface_distances import distances_to_surface
from tests.support.run_folders import CAMERA, write_run


def surface_depth(run, row):
    """Exact depth (h, w) of the estimated surface, 0 beside it."""
    nodes = run.camera_points(row)
    drawn = rasterise(CAMERA.project(nodes), nodes[:, 2], run.model.triangles, 480, 640).depth
    return np.where(np.isfinite(drawn), drawn, 0.0)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A run whose sensor sees the surface 3 mm nearer than it is in frame 11, and exactly in frame 10."""
    folder = tmp_path_factory.mktemp("depth") / "run"
    write_run(folder, ["tracked", "tracked", "lost", "tracked", "tracked", "tracked"])
    run = load_run(folder)
    depth = np.zeros((12, 480, 640), dtype=np.float32)
    depth[10], depth[11] = surface_depth(run, 0), surface_depth(run, 1)
    depth[11][depth[11] > 0.0] -= 0.003
    depth[11][200:260, 280:340] = 0.4  # a hand in front, 0.2 m nearer
    with h5py.File(folder.parent / "depth.h5", "w") as file:
        file["depth_m"] = depth
    return folder


def test_distances_are_those_of_the_sensor_and_what_is_in_front_is_left_out(folder):
    error = depth_error(load_run(folder), read_depths(folder.parent / "depth.h5", range(12)), base_frame=10)
    assert error.frames.tolist() == [10, 11]
    assert error.base is not None
    assert error.base.max() < 1e-5
    # 3 mm along the axis are more along an oblique ray, and less across a surface that is turned away
    longest_ray = np.linalg.norm([320.0 / 528.0, 240.0 / 528.0, 1.0])
    assert error.compared.max() <= 0.003 * longest_ray
    assert np.median(error.compared) == pytest.approx(0.003, rel=0.05)
    covered = surface_depth(load_run(folder), 1) > 0.0
    inside = cv2.erode(covered.astype(np.uint8), cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * RIM_PX + 1,) * 2))
    assert error.left_out[1] == pytest.approx(60 * 60 / np.count_nonzero(inside), rel=0.1)
    assert error.left_out[0] == 0.0


def test_means_at_nodes_are_of_the_points_around_them(folder):
    run = load_run(folder)
    error = depth_error(run, read_depths(folder.parent / "depth.h5", [10, 11]))
    means = error.node_means(len(run.model.nodes))
    seen = np.isfinite(means)
    assert seen.mean() > 0.8
    assert np.median(means[seen]) == pytest.approx(0.0015, rel=0.05)  # half of the points have no error


@pytest.mark.usefixtures("drawn_figures")
def test_the_command_prints_the_base_beside_the_error(folder, capsys):
    assert main(["evaluate", str(folder), "--depth", str(folder.parent / "depth.h5"), "--base-frame", "10"]) == 0
    line = capsys.readouterr().out.splitlines()[-1]
    values = dict(part.split("=") for part in line.split())
    assert float(values["surface_median_mm"]) == pytest.approx(3.0, rel=0.05)
    assert float(values["base_mean_mm"]) < 0.01
    assert values["frames"] == "2/6"
    figures = json.loads((folder / "depth_evaluation.json").read_text())
    assert set(figures["per_frame"]) == {"10", "11"}
    for name in ("depth_evaluation.png", "depth_error_map.png"):
        assert (folder / name).read_bytes().startswith(b"\x89PNG")


def test_a_folder_of_images_is_read_in_its_unit(folder, tmp_path):
    """Where they hold the largest value nothing was measured, as where they hold 0: that is nothing else."""
    stored = np.rint(4000.0 * surface_depth(load_run(folder), 1)).astype(np.uint16)
    stored[200:260, 280:340] = 65535
    cv2.imwrite(str(tmp_path / "depth-11.png"), stored)
    error = depth_error(load_run(folder), read_depths(tmp_path, [10, 11], values_per_metre=4000.0))
    assert (error.frames.tolist(), error.left_out.tolist()) == ([11], [0.0])
    assert error.compared.max() <= 0.125e-3 + 1e-6  # half of the sensor's step


def test_depth_of_a_recording_is_read_in_its_layout_s_unit_or_the_given_one(tmp_path):
    for name, image in (("rgb", np.zeros((4, 4, 3), np.uint8)), ("depth", np.full((4, 4), 1500, np.uint16))):
        (tmp_path / name).mkdir()
        cv2.imwrite(str(tmp_path / name / "0.png"), image)
        (tmp_path / f"{name}.txt").write_text(f"0.0 {name}/0.png\n")
    for given, metres in ((None, 0.3), (1000.0, 1.5)):
        ((number, depth),) = read_depths(tmp_path, [0], given)
        assert (number, float(depth.min()), float(depth.max())) == (0, pytest.approx(metres), pytest.approx(metres))
    with pytest.raises(EvaluationError, match="cannot have 0 values a metre"):
        list(read_depths(tmp_path, [0], 0.0))


@pytest.mark.parametrize("values_per_metre", [None, 1000.0, 0.0])
def test_depth_that_is_not_registered_to_the_colour_is_refused(tmp_path, values_per_metre):
    for number in (0, 1):
        cv2.imwrite(str(tmp_path / f"frame-{number:06d}.color.png"), np.zeros((4, 4, 3), np.uint8))
    cv2.imwrite(str(tmp_path / "frame-000001.depth.png"), np.full((4, 4), 1000, np.uint16))
    with pytest.raises(EvaluationError, match="not registered to the colour camera"):
        list(read_depths(tmp_path, [0, 1], values_per_metre))


@pytest.mark.parametrize("n_frames", [3, 40])
def test_a_frame_whose_depth_is_all_of_something_else_is_counted_and_not_drawn(tmp_path, n_frames):
    distances = [np.array([]), *(np.full(5, 1e-3 * k) for k in range(1, n_frames))]
    nodes = [np.zeros(len(row), dtype=int) for row in distances]
    error = DepthError(np.arange(n_frames), distances, nodes, 0.1, np.eye(n_frames)[0], None)
    plot_depth_errors_by_frame(tmp_path / "errors.png", error)
    assert (tmp_path / "errors.png").read_bytes().startswith(b"\x89PNG")
    figures = summarise_depth(error)
    assert figures["per_frame"]["0"] == {"n_points": 0, "left_out_percent": 100.0}
    assert figures["mean_mm"] == pytest.approx(np.arange(1, n_frames).mean())


def test_depth_that_shows_the_object_in_the_base_frame_alone_is_refused(folder):
    run = load_run(folder)
    own, other = ((frame, depth) for frame, depth in read_depths(folder.parent / "depth.h5", [10, 11]))
    behind = (other[0], other[1] + 0.5 * np.linalg.norm(np.ptp(run.model.nodes, axis=0)))
    with pytest.raises(EvaluationError, match="but the base frame 10"):
        depth_error(run, [own, behind], base_frame=10)
    assert len(depth_error(run, [own, behind]).compared) > 0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["missing.h5"], "no depth images at"),
        (["depth.h5", "--base-frame", "12"], "base frame 12 was not tracked or has no depth"),
        (["small"], "is no recording with depth"),
        (["small", "--depth-per-metre", "1000"], "register the depth"),
        (["small", "--depth-per-metre", "0"], "cannot have 0 values a metre"),
        (["broken.h5"], "simulate again"),
        (["depth.h5", "--depth-per-metre", "1000"], "--depth-per-metre is for a folder of depth images"),
    ],
)
def test_what_cannot_be_compared_is_one_message(folder, refused, arguments, message):
    parent = folder.parent
    (parent / "small").mkdir(exist_ok=True)
    cv2.imwrite(str(parent / "small" / "11.png"), np.full((24, 32), 600, np.uint16))
    (parent / "broken.h5").write_bytes((parent / "depth.h5").read_bytes()[:3000])
    assert message in refused("evaluate", folder, "--depth", parent / arguments[0], *arguments[1:])


TRIANGLE = np.array([[0.0, 0.0, 0.0], [3.0, 0.0, 0.0], [0.0, 4.0, 0.0]])


@pytest.mark.parametrize(
    ("point", "distance"),
    [
        ((1.0, 1.0, 2.0), 2.0),  # above the face
        ((-3.0, -4.0, 0.0), 5.0),  # nearest to a corner
        ((1.5, -2.0, 0.0), 2.0),  # nearest to an edge
        ((3.0, 4.0, 0.0), 12.0 / 5.0),  # the far corner of the rectangle, off the hypotenuse
        ((1.0, 1.0, 0.0), 0.0),
    ],
)
def test_distance_to_one_triangle_is_the_closed_form(point, distance):
    found = distances_to_surface(np.array([point]), TRIANGLE, np.array([[0, 1, 2]]))
    assert found[0] == pytest.approx(distance, abs=1e-12)


def test_distances_are_those_to_the_nearest_of_all_triangles():
    rng = np.random.default_rng(3)
    nodes = rng.normal(size=(60, 3))
    triangles = np.array([rng.choice(60, 3, replace=False) for _ in range(90)])
    points = 2.0 * rng.normal(size=(200, 3))
    alone = [distances_to_surface(points, nodes, triangle[None]) for triangle in triangles]
    found = distances_to_surface(points, nodes, triangles)
    assert np.allclose(found, np.min(alone, axis=0), atol=1e-12)


def test_distance_to_a_fine_sphere_is_the_difference_of_radii():
    polar, around = np.meshgrid(np.linspace(0.02, np.pi - 0.02, 60), np.linspace(0.0, 2.0 * np.pi, 120))
    nodes = np.stack([np.sin(polar) * np.cos(around), np.sin(polar) * np.sin(around), np.cos(polar)], axis=-1)
    index = np.arange(60 * 120).reshape(120, 60)
    a, b, c, d = index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]
    triangles = np.concatenate([np.stack(t, axis=-1).reshape(-1, 3) for t in ((a, b, c), (a, c, d))])
    directions = np.random.default_rng(0).normal(size=(50, 3))
    directions = directions[np.abs(directions[:, 2]) < 0.9 * np.linalg.norm(directions, axis=1)]
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    found = distances_to_surface(1.7 * directions, nodes.reshape(-1, 3), triangles)
    assert np.allclose(found, 0.7, atol=2e-3)
