"""Tracks in images against projections written by hand, then shifted by known amounts."""

import json
from dataclasses import replace

import numpy as np
import pytest

import morph_dslam as md
from morph_dslam.cli.app import main
from morph_dslam.errors import EvaluationError
from morph_dslam.extend.reports import PixelTracks, evaluate_pixels, load_tracks
from tests.support.bent_sheet import bent_sheet_model
from tests.support.rendered_sequence import CAMERA
from tests.support.run_folders import exact_truth, write_run

#: Material points of the flat sheet, metres; the third is beside it.
POINTS = np.array([[0.0, 0.0], [0.1, -0.05], [0.5, 0.0]])
DEPTH, STEP = 0.6, 0.005
FRAMES = np.arange(20, 26)


def sliding_run(camera=CAMERA):
    """A flat sheet before the camera, whose x axis is the image's and y axis against it, that moves right."""
    poses = np.tile(np.diag([1.0, -1.0, -1.0, 1.0]), (len(FRAMES), 1, 1))
    poses[:, 0, 3], poses[:, 2, 3] = STEP * np.arange(len(FRAMES)), DEPTH
    words = ("tracked",) * len(FRAMES)
    times = {"total": np.full(len(FRAMES), 5.0)}
    return md.Run(bent_sheet_model(9, 7), camera, FRAMES, words, words, poses, np.zeros((len(FRAMES), 3)), times)


def projected(k1=0.0):
    """Pixels (frames, 3, 2) of `POINTS` by the pinhole's equation, with one radial term."""
    moved = np.arange(len(FRAMES))[:, None] * STEP
    x, y = (POINTS[:, 0] + moved) / DEPTH, np.broadcast_to(-POINTS[:, 1] / DEPTH, (len(FRAMES), 3))
    radial = 1.0 + k1 * (x**2 + y**2)
    return np.stack([320.0 + 528.0 * x * radial, 240.0 + 528.0 * y * radial], axis=2)


def tracks(pixels, frames=FRAMES):
    return PixelTracks(("a", "b", "off"), frames, pixels)


def test_exact_tracks_have_no_error_and_one_beside_the_surface_is_named():
    figures = evaluate_pixels(sliding_run(), tracks(projected()))
    assert figures["max_px"] < 1e-6
    assert figures["max_mm"] < 1e-6
    assert figures["frames_compared"] == [21, 22, 23, 24, 25]
    assert (figures["n_tracks"], figures["n_tracks_compared"], figures["n_comparisons"]) == (3, 2, 10)
    assert figures["tracks_off_the_surface"] == ["off"]


def test_a_known_shift_is_the_error_in_pixels_and_across_the_sight_line():
    """Track a lies on the axis in frame 20; a pixel 6 px off is seen 0.6 sin(atan(6 / 528)) m from the point."""
    pixels = projected()
    pixels[1:, 0] += [3.0, -4.0]
    still = sliding_run()
    still.camera_from_object[:, 0, 3] = 0.0
    held = np.tile(projected()[:1], (len(FRAMES), 1, 1))
    held[3, 0] += [6.0, 0.0]
    figures = evaluate_pixels(sliding_run(), tracks(pixels))
    assert figures["per_track"]["a"]["mean_px"] == pytest.approx(5.0, abs=1e-6)
    assert figures["per_track"]["b"]["max_px"] < 1e-6
    assert figures["mean_px"] == pytest.approx(2.5, abs=1e-6)
    assert figures["mean_shift_px"] == pytest.approx([-1.5, 2.0], abs=1e-6), "estimate minus measurement"
    assert figures["worst_tracks"] == ["a", "b"]
    figures = evaluate_pixels(still, tracks(held))
    expected = 1e3 * DEPTH * np.sin(np.arctan(6.0 / 528.0))
    assert figures["per_track"]["a"]["max_mm"] == pytest.approx(expected, rel=1e-6)
    assert figures["per_frame"]["23"]["mean_mm"] == pytest.approx(expected / 2.0, rel=1e-6)
    assert figures["per_frame"]["24"]["max_px"] < 1e-6


#: Frames of a rolling shutter a thirtieth of a second apart; a sheet that slides faster and faster, metres along x.
INTERVAL, READOUT = 1.0 / 30.0, 0.03
ROLLING = replace(CAMERA, readout_s=READOUT)


def slid(seconds):
    return 0.1 * seconds + 1.2 * seconds**2


def rolling_run(timestamps, anew=(20,)):
    """Exact at the middle row's instant, in frames where the tracker began ``anew`` at that of the row of "b"."""
    run, instants, known = sliding_run(ROLLING), INTERVAL * np.arange(len(FRAMES)), ~np.isin(FRAMES, anew)
    run.camera_from_object[:, 0, 3] = slid(instants + np.where(known, 0.0, READOUT * (284.0 - 239.5) / 480.0))
    return replace(run, timestamps=timestamps, motion_known=known)


def by_rows():
    """Pixels of `POINTS`, each at the instant of its row, which the slide does not change."""
    pixels = projected()
    instants = INTERVAL * np.arange(len(FRAMES))[:, None] + READOUT * (pixels[..., 1] - 239.5) / 480.0
    pixels[..., 0] = 320.0 + 528.0 * (POINTS[:, 0] + slid(instants)) / DEPTH
    return pixels


def test_tracks_of_a_rolling_shutter_are_compared_where_its_rows_show_the_points():
    """At the instant of the middle row, "b" is about 1 px elsewhere; a parabola is its path."""
    # In the first frame the tracker does not know how the sheet moves.
    exact = evaluate_pixels(rolling_run(INTERVAL * np.arange(len(FRAMES))), tracks(by_rows()[1:], FRAMES[1:]))
    assert exact["max_px"] < 1e-6
    assert exact["max_mm"] < 1e-6
    assert exact["notes"] == []


@pytest.mark.parametrize("away_s", [0.0, 1.0])
@pytest.mark.parametrize("before", ["tracked", "lost"])
def test_a_frame_whose_motion_the_tracker_did_not_know_is_compared_as_it_was_estimated(before, away_s):
    """The first one, and one after a new registration, after a gap, or after a loss."""
    times = INTERVAL * np.arange(len(FRAMES)) + np.where(FRAMES > 22, away_s, 0.0)
    run = rolling_run(times, anew=(20, 23))
    run.parameters[(FRAMES == 22) & (before == "lost")] = np.nan
    words = np.where(FRAMES == 22, before, "tracked")
    only_b = PixelTracks(("b",), FRAMES, by_rows()[:, 1:2])
    figures = evaluate_pixels(replace(run, status=tuple(words.tolist())), only_b)
    assert figures["frames_compared"] == [21, *[22] * (before == "tracked"), 23, 24, 25]
    assert figures["per_frame"]["23"]["max_px"] < 1e-6
    # Beside such a frame others tell less exactly how the sheet moves, from evenly to faster.
    assert figures["max_px"] < 0.2
    (note,) = figures["notes"]
    assert "20 and 23" in note
    assert "--bind-frame" in note


def test_frames_whose_motion_the_tracker_did_not_know_are_the_last_to_tell_of_others():
    """A parabola through three exact places is the path; frame 23 was registered anew."""
    run = rolling_run(INTERVAL * np.arange(len(FRAMES)), anew=(20, 23))
    figures = evaluate_pixels(run, PixelTracks(("b",), FRAMES, by_rows()[:, 1:2]))
    errors = {frame: error["max_px"] for frame, error in figures["per_frame"].items()}
    # Nodes are moved by their own rows, and "b", which is bound where nothing is moved, lies between them.
    assert max(errors[frame] for frame in ("22", "24")) < 1e-4
    assert min(errors["21"], errors["25"]) > 1e-3, "two frames away there is but one that is exact"


def test_a_point_that_moves_across_the_rows_is_found_in_its_row():
    """It goes down by w = 264 pixels a second: v = v0 + w (v - 239.5) r / 480, solved for v."""
    run, times = sliding_run(ROLLING), INTERVAL * np.arange(len(FRAMES))
    run.camera_from_object[:, 0, 3], run.camera_from_object[:, 1, 3] = 0.0, 0.3 * times
    pixels, share = np.tile(projected()[:1], (len(FRAMES), 1, 1)), 264.0 * READOUT / 480.0
    pixels[..., 1] = (pixels[..., 1] + 264.0 * times[:, None] - share * 239.5) / (1.0 - share)
    run = replace(run, timestamps=times, motion_known=FRAMES > 20)
    assert evaluate_pixels(run, tracks(pixels[1:], FRAMES[1:]))["max_px"] < 1e-4


@pytest.mark.parametrize(
    ("timestamps", "known"),
    [(None, FRAMES > 20), (0.5 * np.arange(len(FRAMES)), FRAMES < 20), (INTERVAL * np.arange(len(FRAMES)), None)],
    ids=["no-times", "rare", "not-said"],
)
def test_a_rolling_shutter_whose_motion_is_not_known_is_named(timestamps, known):
    run = replace(rolling_run(INTERVAL * np.arange(len(FRAMES)), anew=()), timestamps=timestamps, motion_known=known)
    figures = evaluate_pixels(run, tracks(by_rows()))
    assert figures["per_track"]["b"]["max_px"] > 0.5
    (note,) = figures["notes"]
    assert "20, 21, 22, 23, 24 and 25" in note
    assert evaluate_pixels(sliding_run(), tracks(projected()))["notes"] == []


def test_tracks_that_count_from_another_frame_are_named():
    """A sheet that moves faster and faster; at a constant speed other numbers explain nothing."""
    run, accelerating = sliding_run(), STEP * np.arange(len(FRAMES)) ** 2
    run.camera_from_object[:, 0, 3] = accelerating
    pixels = projected()
    pixels[:, :, 0] = 320.0 + 528.0 * (POINTS[:, 0] + accelerating[:, None]) / DEPTH
    for shift, said in ((1, "one less"), (-1, "one more")):
        (note,) = evaluate_pixels(run, tracks(pixels, FRAMES + shift))["notes"]
        assert f"with {said} in each frame number of the tracks" in note
        (note,) = evaluate_pixels(run, tracks(pixels, FRAMES + shift), bind_frame=22)["notes"]
        assert f"with {said} in each frame number of the tracks" in note
    assert evaluate_pixels(run, tracks(pixels))["notes"] == []
    assert evaluate_pixels(sliding_run(), tracks(projected()))["notes"] == []
    noisy = pixels + np.random.default_rng(2).normal(size=pixels.shape)
    assert evaluate_pixels(run, tracks(noisy))["notes"] == []


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda p: np.stack([639.0 - p[..., 0], p[..., 1]], axis=-1), "have u "),
        (lambda p: np.array([639.0, 479.0]) - p, "have u "),
    ],
)
def test_tracks_with_other_axes_or_of_another_picture_are_named(change, said):
    (note,) = evaluate_pixels(sliding_run(), tracks(change(projected())))["notes"]
    assert f"if their pixels {said}" in note
    assert "the mean error is 0 px then" in note or "e-1" in note


def test_right_tracks_name_no_axes_however_wrong_the_run():
    """A run that stands still, or slides half as far, is wrong by itself."""
    for share in (0.0, 0.5, 1.5):
        run = sliding_run()
        run.camera_from_object[:, 0, 3] *= share
        assert evaluate_pixels(run, tracks(projected()))["notes"] == []


def test_pixels_are_those_of_the_image_as_recorded():
    """One radial term moves the second track by 3 px and more."""
    camera = md.Camera(640, 480, 528.0, 528.0, 320.0, 240.0, distortion=(-0.2, 0.0, 0.0, 0.0))
    assert np.linalg.norm(projected(-0.2) - projected(), axis=2)[:, 1].min() > 0.5
    figures = evaluate_pixels(sliding_run(camera), tracks(projected(-0.2)))
    assert figures["max_px"] < 1e-6
    assert evaluate_pixels(sliding_run(), tracks(projected(-0.2)))["max_px"] > 0.5


def test_each_track_is_bound_in_its_first_frame_or_all_in_one():
    pixels = projected()
    pixels[:2, 1] = np.nan  # b begins in frame 22
    pixels[4, 0] = np.nan
    run = sliding_run()
    figures = evaluate_pixels(run, tracks(pixels))
    assert [figures["per_track"][name]["bind_frame"] for name in "ab"] == [20, 22]
    assert [figures["per_track"][name]["n_frames"] for name in "ab"] == [4, 3]
    figures = evaluate_pixels(run, tracks(pixels), bind_frame=24)
    assert figures["tracks_not_measured_where_bound"] == ["a"]
    assert figures["per_track"]["b"]["n_frames"] == 3, "also frames before the one that binds"


def test_frames_that_cannot_be_compared_are_counted():
    run = sliding_run()
    run.camera_from_object[0] = np.nan
    frames = np.array([20, 21, 22, 23, 24, 99])
    figures = evaluate_pixels(run, tracks(projected(), frames))
    assert figures["track_frames_not_tracked"] == [20]
    assert figures["track_frames_outside_the_run"] == [99]
    assert figures["per_track"]["a"]["bind_frame"] == 21
    assert (figures["n_frames_tracked"], figures["n_frames"]) == (5, 6)
    for frame, message in ((20, "not tracked"), (99, "not in the run"), (25, "no track is measured in frame 25")):
        with pytest.raises(EvaluationError, match=message):
            evaluate_pixels(run, tracks(projected(), frames), frame)


def test_a_frame_that_binds_nothing_is_refused_with_those_that_would():
    """Lines without pixels, as of a point that is hidden, measure nothing."""
    pixels = projected()
    pixels[3:5] = np.nan
    with pytest.raises(
        EvaluationError, match=r"no track is measured in frame 23: .*measurements \(20, 21, 22 and 25\)"
    ):
        evaluate_pixels(sliding_run(), tracks(pixels), 23)


@pytest.mark.parametrize(
    ("pixels", "frames", "message"),
    [
        (projected() + 900.0, FRAMES, "no track begins on the estimated surface"),
        (projected(), FRAMES + 100, "no track was measured in a frame"),
        (np.where(FRAMES[:, None, None] == 20, projected(), np.nan), FRAMES, "in a second frame"),
    ],
)
def test_tracks_that_cannot_be_compared(pixels, frames, message):
    with pytest.raises(EvaluationError, match=message):
        evaluate_pixels(sliding_run(), tracks(pixels, frames))


@pytest.mark.usefixtures("drawn_figures")
def test_the_command_writes_figures_pictures_and_one_report_of_all_evaluations(tmp_path, capsys):
    run = tmp_path / "run"
    truth = exact_truth(write_run(run, ["tracked", "tracked", "lost", "tracked", "tracked", "tracked"]))
    shifted = truth["pixels"] + np.where(np.arange(6)[:, None, None] > 0, [0.6, 0.8], 0.0)
    lines = [
        f"{frame},dot {j},{u:.9f},{v:.9f}"
        for frame, row in zip(truth["frame"], shifted, strict=True)
        for j, (u, v) in enumerate(row)
    ]
    (tmp_path / "tracks.csv").write_text("\n".join(["frame,id,u,v", *lines]) + "\n")
    np.savez(tmp_path / "truth.npz", **truth)
    assert main(["evaluate", str(run), "--points", str(tmp_path / "truth.npz"), "--bind-frame", "10"]) == 0
    assert main(["evaluate", str(run), "--pixels", str(tmp_path / "tracks.csv")]) == 0
    printed = capsys.readouterr().out.splitlines()
    values = dict(part.split("=") for part in printed[-1].split())
    assert (values["mean_px"], values["p95_px"]) == ("1.000", "1.000")
    # A pixel is 1.12 mm to 1.22 mm at 0.59 m to 0.65 m.
    assert 1.0 < float(values["mean_mm"]) < 1.25
    assert (values["tracks"], values["tracked"]) == ("60", "5/6")
    assert any("did not track" in line and "[12]" in line for line in printed)
    assert json.loads((run / "pixel_evaluation.json").read_text())["per_track"]["dot 7"]["n_frames"] == 4
    page = (run / "report.html").read_text()
    assert "Material error, without alignment" in page
    assert "1.000 px, " in page
    assert page.count("data:image/png;base64,") == 4


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("frame,id,u\n1,a,2\n", "no column v"),
        ("frame,id,u,v\n", "holds no measurement"),
        ("frame,id,u,v\n1,a,2,x\n", "line 2: '1,a,2,x'"),
        ("frame,id,u,v\n1,a,2,3\n\n1.5,a,2,3\n", "line 4"),
        ("frame,id,u,v\n1,,2,3\n", "line 2"),
        ("frame,id,u,v\n1,a\n", "line 2"),
        ("frame,id,u,v\n1,a,2,1e300\n", "line 2"),
        ("frame,id,u,v\n1,a,2,3\n1,a,2,4\n", "line 3: track 'a' occurs twice in frame 1"),
    ],
)
def test_a_file_that_cannot_be_meant_is_one_message(tmp_path, refused, text, message):
    write_run(tmp_path / "run")
    (tmp_path / "tracks.csv").write_text(text)
    said = refused("evaluate", tmp_path / "run", "--pixels", tmp_path / "tracks.csv")
    assert "tracks.csv" in said
    assert message in said


def test_columns_stand_in_any_order_and_what_was_not_measured_is_left_out(tmp_path):
    (tmp_path / "tracks.csv").write_text("id,size,v,u,frame\nb,3,40,30,7\na,3,20,10,5\nb,,,,5\n")
    found = load_tracks(tmp_path / "tracks.csv")
    assert (found.ids, found.frames.tolist()) == (("b", "a"), [5, 7])
    assert found.pixels[1, 0].tolist() == [30.0, 40.0]
    assert np.isnan(found.pixels[0, 0]).all()
