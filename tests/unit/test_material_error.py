"""Material error against truth that is exact, then displaced by known amounts."""

import numpy as np
import pytest

from morph_dslam.errors import EvaluationError
from morph_dslam.evaluation.points import PointTruth, bind_truth, load_truth, material_error, summarise
from morph_dslam.evaluation.run_folder import load_run
from morph_dslam.evaluation.trajectory import summarise_alignment
from morph_dslam.geometry import rotation_exp
from tests.support.run_folders import exact_truth, write_run


@pytest.fixture(scope="module")
def tracked(tmp_path_factory):
    folder = tmp_path_factory.mktemp("tracked")
    model = write_run(folder)
    return load_run(folder), exact_truth(model)


def saved(path, arrays):
    np.savez(path, **arrays)
    return load_truth(path)


@pytest.fixture
def compare(tracked, tmp_path):
    """A function that compares the run with its exact truth, some of whose arrays are changed."""
    run, truth = tracked

    def compared(bind_frame=10, **changes):
        return material_error(run, saved(tmp_path / "truth.npz", truth | changes), bind_frame)

    return compared


def test_exact_truth_has_no_error(compare):
    error = compare()
    # The model file keeps its modes in single precision: nanometres on a sheet of half a metre.
    assert error.distances.max() < 1e-7
    assert error.frames.tolist() == [11, 12, 13, 14, 15]
    assert error.distances.shape == (5, 60)


def test_known_offsets_are_split_along_and_across_the_sight_line(tracked, compare):
    points = tracked[1]["points_mm"].copy()
    sight = points / np.linalg.norm(points, axis=2, keepdims=True)
    across = np.cross(sight, [0.0, 1.0, 0.0])
    across /= np.linalg.norm(across, axis=2, keepdims=True)
    points[1] += 3.0 * sight[1]  # the truth is 3 mm farther away than the estimate
    points[2] += 4.0 * across[2]
    points[3] += 3.0 * sight[3] + 4.0 * across[3]
    figures = summarise(compare(points_mm=points))
    per_frame = figures["per_frame"]
    assert per_frame["11"]["mean_mm"] == pytest.approx(3.0, abs=1e-4)
    assert per_frame["11"]["mean_along_sight_mm"] == pytest.approx(3.0, abs=1e-4)
    assert per_frame["11"]["mean_across_sight_mm"] == pytest.approx(0.0, abs=0.02)
    assert per_frame["12"]["mean_across_sight_mm"] == pytest.approx(4.0, abs=0.02)
    assert per_frame["13"]["max_mm"] == pytest.approx(5.0, abs=1e-4)
    assert figures["mean_mm"] == pytest.approx((3 + 4 + 5 + 0 + 0) / 5, abs=1e-4)
    assert figures["median_mm"] == pytest.approx(3.0, abs=1e-4)
    assert figures["p95_mm"] == pytest.approx(5.0, abs=1e-4)


def test_the_error_is_not_aligned_away(tracked, compare):
    error = compare(points_mm=tracked[1]["points_mm"] + np.array([0.0, 0.0, 2.0]))
    assert np.nanmean(error.distances) == pytest.approx(2e-3, abs=1e-7)


def test_untracked_and_missing_truth_frames_are_named(tmp_path):
    model = write_run(tmp_path, ["tracked", "tracked", "lost", "tracked", "tracked", "tracked"])
    truth = exact_truth(model)
    truth["frame"] = truth["frame"].copy()
    truth["frame"][5] = 99
    figures = summarise(material_error(load_run(tmp_path), saved(tmp_path / "truth.npz", truth), 10))
    assert figures["truth_frames_not_tracked"] == [12]
    assert figures["truth_frames_outside_the_run"] == [99]
    assert figures["frames_compared"] == [11, 13, 14]


def test_points_off_the_surface_are_counted(tracked, tmp_path):
    run, truth = tracked
    pixels = truth["pixels"].copy()
    nodes = run.camera.project(run.camera_points(0))
    rightmost = nodes[:, 0].argmax()
    pixels[0, 0] = nodes[rightmost] + [2.0, 0.0]
    pixels[0, 1] = nodes[rightmost] + [40.0, 0.0]
    pixels[0, 2] = np.nan
    binding = bind_truth(run, saved(tmp_path / "truth.npz", truth | {"pixels": pixels}), 10)
    assert binding.n_outline == 1
    assert binding.unbound.tolist() == [1, 2]
    assert binding.n_unseen == 1  # the second has a pixel, but it misses the surface
    assert binding.columns.tolist() == [0, *range(3, 60)]


def test_unmeasured_points_are_left_out_and_counted(tracked, compare):
    points = tracked[1]["points_mm"].copy()
    points[1, :3], points[1, 3:5] = np.nan, np.inf
    figures = summarise(compare(points_mm=points))
    assert figures["n_comparisons_without_measurement"] == 5
    assert figures["n_comparisons"] == 5 * 60 - 5
    assert figures["mean_mm"] < 1e-4


@pytest.mark.parametrize(
    ("frame", "message"),
    [
        (8, "truth has no frame 8 to bind in; it has 10, 11, 12, 13, 14 and 15$"),
        (12, r"not tracked \(too few points\)"),
    ],
)
def test_binding_frame_must_be_known(tmp_path, frame, message):
    model = write_run(tmp_path, ["tracked", "tracked", "lost", "tracked", "tracked", "tracked"])
    truth = saved(tmp_path / "truth.npz", exact_truth(model))
    with pytest.raises(EvaluationError, match=message):
        material_error(load_run(tmp_path), truth, frame)


def test_of_many_frames_a_message_gives_the_range(tracked):
    points, pixels, hidden = np.zeros((150, 1, 3)), np.zeros((150, 1, 2)), np.zeros((150, 1), dtype=bool)
    many = PointTruth(np.arange(150), points, pixels, hidden)
    with pytest.raises(EvaluationError, match=r"has no frame 5000 to bind in; it has 150 frames from 0 to 149$"):
        material_error(tracked[0], many, 5000)


def test_points_are_bound_in_the_first_frame_tracked_and_measured_by_default(tmp_path):
    """The run loses its first frame, and no point is measured or seen in the two frames then."""
    model = write_run(tmp_path / "run", ["lost", *["tracked"] * 5])
    truth = exact_truth(model)
    truth["pixels"][1] = np.nan
    truth["visible"] = np.ones(truth["pixels"].shape[:2], dtype=bool)
    truth["visible"][2] = False
    error = material_error(load_run(tmp_path / "run"), saved(tmp_path / "truth.npz", truth))
    assert error.binding.frame == 13
    assert error.distances.max() < 1e-7
    truth["visible"][1:] = False
    with pytest.raises(EvaluationError, match=r"tracked none of the frames in which the truth has pixels \(10\)"):
        material_error(load_run(tmp_path / "run"), saved(tmp_path / "truth.npz", truth))


@pytest.mark.parametrize(
    ("bind_frame", "change", "message"),
    [
        (110, lambda t: {"frame": t["frame"] + 100}, "the run has no frame 110"),
        (10, lambda t: {name: array[:1] for name, array in t.items()}, "no truth frame besides 10"),
        (10, lambda t: {"pixels": t["pixels"] + 1000.0}, "no truth pixel falls"),
    ],
)
def test_truth_that_cannot_be_compared(tracked, compare, bind_frame, change, message):
    with pytest.raises(EvaluationError, match=message):
        compare(bind_frame, **change(tracked[1]))


@pytest.mark.parametrize(
    "change",
    [
        lambda t: t | {"points_mm": t["points_mm"].transpose(0, 2, 1)},
        lambda t: t | {"pixels": t["pixels"][:, :-1]},
        lambda t: t | {"frame": t["frame"][:-1]},
        lambda t: t | {"frame": t["frame"] * 0},
        lambda t: t | {"frame": t["frame"] + 0.5},
        lambda t: t | {"pixels": t["pixels"].astype(str)},
        lambda t: {"frame": t["frame"], "pixels": t["pixels"]},
    ],
)
def test_malformed_truth_is_refused(tracked, tmp_path, change):
    _, truth = tracked
    with pytest.raises(EvaluationError, match=r"truth\.npz"):
        saved(tmp_path / "truth.npz", change(truth))


def test_truth_files_that_cannot_be_read(tmp_path):
    with pytest.raises(EvaluationError, match="no truth file"):
        load_truth(tmp_path / "absent.npz")
    (tmp_path / "text.npz").write_text("frame,x,y")
    with pytest.raises(EvaluationError, match="not a readable"):
        load_truth(tmp_path / "text.npz")
    np.savez(tmp_path / "whole.npz", frame=np.arange(1000))
    cut = (tmp_path / "whole.npz").read_bytes()[:2000]
    (tmp_path / "cut.npz").write_bytes(cut)
    with pytest.raises(EvaluationError, match="not a readable"):
        load_truth(tmp_path / "cut.npz")


def test_run_folders_that_cannot_be_read(tmp_path):
    with pytest.raises(EvaluationError, match=r"no result\.h5"):
        load_run(tmp_path)
    write_run(tmp_path)
    whole = (tmp_path / "result.h5").read_bytes()
    (tmp_path / "result.h5").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(EvaluationError, match="damaged"):
        load_run(tmp_path)


def test_a_turned_truth_is_told_apart_from_errors_of_shape(tracked, compare):
    turn = np.radians([0.5, -2.0, 1.0])
    points = tracked[1]["points_mm"] @ rotation_exp(turn) + np.array([3.0, 0.0, -4.0])
    points[3] += [0.0, 0.0, 5.0]  # one frame is moved by itself
    points[4, 7] = np.nan
    error = compare(points_mm=points)
    figures = summarise_alignment(error)
    # Of five frames one is 5 mm off the others: the best motion lies a fifth of the way.
    together = figures["after_one_rigid_motion"]
    assert np.nanmean(error.distances) > 5e-3
    assert together["mean_mm"] == pytest.approx(4 / 5 * 1.0 + 1 / 5 * 4.0, rel=0.1)
    np.testing.assert_allclose(together["rotation_deg"], [0.5, -2.0, 1.0], atol=0.2)
    assert figures["after_one_in_each_frame"]["mean_mm"] < 1e-3
    even = points.copy()
    even[3] -= [0.0, 0.0, 5.0]
    together = summarise_alignment(compare(points_mm=even))["after_one_rigid_motion"]
    assert together["mean_mm"] < 1e-3
    np.testing.assert_allclose(together["rotation_deg"], [0.5, -2.0, 1.0], atol=1e-3)
