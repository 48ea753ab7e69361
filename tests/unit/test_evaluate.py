"""The evaluation command: what it writes, and the line it ends with."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest

import morph_dslam as md
from morph_dslam.cli.app import main
from morph_dslam.errors import ArgumentError, EvaluationError
from morph_dslam.evaluation.run_folder import remarks
from morph_dslam.extend.reports import PointTruth
from morph_dslam.extend.slam import Trajectory
from morph_dslam.geometry import RigidTransform
from morph_dslam.io.camera_files import save_camera
from morph_dslam.model import save_model
from morph_dslam.tracking.estimator import Estimate
from morph_dslam.tracking.row_motion import RowMotion
from morph_dslam.tracking.run_folder import write_hdf5
from morph_dslam.tracking.run_results import RunResults
from morph_dslam.tracking.state import State
from tests.support.bent_sheet import bent_sheet_model
from tests.support.run_folders import CAMERA, FRAMES, exact_truth, states, write_run


@pytest.fixture
def run_and_truth(tmp_path):
    run = tmp_path / "run"
    model = write_run(run, ["tracked", "tracked", "lost", "tracked", "tracked", "tracked"])
    truth = exact_truth(model)
    truth["points_mm"] = truth["points_mm"] + np.array([0.0, 3.0, 4.0])
    np.savez(tmp_path / "truth.npz", **truth)
    flags = {"flags": ["the object may be <outside> the model"], "n_recovered": 3, "versions": {"numpy": "9.9"}}
    (run / "summary.json").write_text(json.dumps(flags))
    return run, tmp_path / "truth.npz"


@pytest.mark.usefixtures("drawn_figures")
def test_evaluate_writes_figures_pictures_and_report_and_ends_with_the_result(run_and_truth, capsys):
    run, truth = run_and_truth
    assert main(["evaluate", str(run), "--points", str(truth), "--bind-frame", "10"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[-1] == (
        "mean_mm=5.000 median_mm=5.000 p95_mm=5.000 tracked=5/6 median_ms=9.00 p95_ms=9.00 rigid_mm=0.000"
    )
    assert "note: truth frames that were not tracked and so not compared: 12" in lines
    assert not any("frame number" in line for line in lines)
    figures = json.loads((run / "evaluation.json").read_text())
    assert figures["mean_mm"] == pytest.approx(5.0, abs=1e-3)
    assert figures["truth_frames_not_tracked"] == [12]
    for name in ("evaluation.png", "error_map.png"):
        assert (run / name).read_bytes().startswith(b"\x89PNG")
    page = (run / "report.html").read_text()
    assert "5.000 mm" in page
    assert "too few points" in page
    assert '<p class="warning">the object may be &lt;outside&gt; the model</p>' in page
    assert "<tr><td>n recovered</td><td>3</td></tr>" in page
    assert page.index("n recovered") < page.index("9.9")
    assert page.count("data:image/png;base64,") == 2
    assert not re.search(r'(src|href)="(http|/)', page)  # self-contained


def test_many_frames_that_cannot_be_compared_are_counted():
    figures = {"truth_frames_not_tracked": list(range(5, 30)), "truth_frames_outside_the_run": [40, 3]}
    assert remarks(figures | {"points_not_bound": [], "n_points_bound_at_outline": 0}) == [
        "truth frames that were not tracked and so not compared: 25 frames from 5 to 29",
        "truth frames outside the run: 3 and 40",
    ]


def test_the_frame_that_binds_is_named_where_nobody_chose_it(run_and_truth, capsys):
    run, truth = run_and_truth
    assert main(["evaluate", str(run), "--points", str(truth)]) == 0
    said = capsys.readouterr().out
    assert "note: points are bound in frame 10;" in said
    assert said.splitlines()[-1].startswith("mean_mm=5.000 ")


@pytest.fixture
def results():
    """What a tracker returns that follows `states`, and loses the third frame."""
    model, found = bent_sheet_model(22, 16), {}
    for frame, mu, pose in zip(FRAMES.tolist(), *states(len(FRAMES)), strict=True):
        state = State(mu, RigidTransform.from_matrix(pose))
        estimate = Estimate(state, 1.0, np.zeros((0, 2)), 0.3, np.eye(9), np.zeros(3, bool), 4, True)
        found[frame] = md.FrameResult(model, md.Status.TRACKED, estimate, total_ms=7.0)
    found[12] = md.FrameResult(model, md.Status.LOST)
    return found


def test_results_in_memory_are_compared_with_points(results):
    truth = exact_truth(results[10].model)
    points = 1e-3 * (truth["points_mm"] + np.array([0.0, 3.0, 4.0]))
    given = PointTruth(truth["frame"], points, truth["pixels"], np.zeros(points.shape[:2], dtype=bool))
    figures = md.evaluate(md.Run.of(CAMERA, results), given, 10)
    assert figures["mean_mm"] == pytest.approx(5.0, abs=1e-3)
    assert (figures["n_frames_tracked"], figures["truth_frames_not_tracked"]) == (5, [12])
    assert figures["median_ms"] == pytest.approx(7.0)


def test_frames_that_are_counted_from_one_are_named(results, run_and_truth, capsys):
    run, path = run_and_truth
    truth = exact_truth(results[10].model)
    np.savez(path, **truth | {"frame": truth["frame"] + 1})
    assert main(["evaluate", str(run), "--points", str(path)]) == 0
    said = [line for line in capsys.readouterr().out.splitlines() if "frame number" in line]
    assert len(said) == 1
    assert said[0].startswith("note: with one less in each frame number of the truth the mean error is ")


def test_points_in_another_unit_are_refused(results, tmp_path):
    truth = exact_truth(results[10].model)
    np.savez(tmp_path / "truth.npz", **truth | {"points_mm": 1e-3 * truth["points_mm"]})
    with pytest.raises(EvaluationError, match="give points_mm in mm"):
        md.evaluate(md.Run.of(CAMERA, results), tmp_path / "truth.npz")


def test_results_that_make_no_run_are_refused(results):
    with pytest.raises(ArgumentError, match=r"results is of type list: give the result of each frame by its number"):
        md.Run.of(CAMERA, list(results.values()))
    with pytest.raises(ArgumentError, match=r"camera is 'camera\.yaml'"):
        md.Run.of("camera.yaml", results)
    with pytest.raises(EvaluationError, match="give that of at least one frame"):
        md.Run.of(CAMERA, {})


def test_results_in_memory_are_compared_with_depth(results):
    """A plane 2 mm behind the flat sheet at 0.6 m, which faces the camera."""
    flat = State(np.zeros(3), RigidTransform(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, 0.6])))
    estimate = Estimate(flat, 1.0, np.zeros((0, 2)), 0.3, np.eye(9), np.zeros(3, bool), 4, True)
    run = md.Run.of(CAMERA, {10: md.FrameResult(results[10].model, md.Status.TRACKED, estimate)})
    figures = md.evaluate_depth(run, [(9, np.zeros((1, 1))), (10, np.full((480, 640), 0.602))])
    assert figures["frames_compared"] == [10]
    assert figures["mean_mm"] == pytest.approx(2.0, abs=1e-3)
    with pytest.raises(EvaluationError, match="show nothing of the estimated surface"):
        md.evaluate_depth(run, [])


def test_times_of_results_in_memory_are_those_of_their_frames(results):
    assert md.Run.of(CAMERA, results).timestamps is None
    run = md.Run.of(CAMERA, {frame: results[frame] for frame in (12, 10)}, {9: 0.25, 10: 0.5, 12: 0.75})
    np.testing.assert_array_equal(run.timestamps, [0.75, 0.5])


def test_paths_in_memory_are_compared():
    """A path twice as long as the true one, which climbs steadily round a corner."""
    poses = np.tile(np.eye(4), (30, 1, 1))
    poses[:, :2, 3] = np.column_stack([np.arange(30.0), np.maximum(0.0, np.arange(30.0) - 10.0)])
    larger = poses.copy()
    larger[:, :3, 3] *= 2.0
    figures = md.evaluate_trajectory(Trajectory(np.arange(30.0), larger), Trajectory(np.arange(30.0), poses))
    assert figures["sim3"]["scale"] == pytest.approx(0.5)
    assert figures["sim3"]["absolute_mm"]["max"] < 1e-6
    assert figures["truth_length_m"] == pytest.approx(10.0 + 19.0 * np.sqrt(2.0))


def test_a_run_says_where_its_tracker_knew_how_the_object_moved(results, tmp_path):
    """In memory, and in a run folder."""
    last, run = results[14].estimate.state, RunResults(results[10].model, reference_frame=10)
    results[15] = replace(results[15], motion=RowMotion(CAMERA, np.zeros(3), ((1.0 / 30.0, last),)))
    for frame, result in results.items():
        run.add(frame, frame / 30.0, result)
    write_hdf5(tmp_path / "result.h5", run)
    save_model(tmp_path / "model.morph", run.model)
    save_camera(tmp_path / "camera.yaml", CAMERA)
    for found in (md.Run.of(CAMERA, results), md.load_run(tmp_path)):
        assert found.motion_known.tolist() == [frame == 15 for frame in found.frames]
