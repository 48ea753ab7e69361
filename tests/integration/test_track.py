"""`track` from files to the run folder, whole, interrupted and refused."""

import csv
import json
import pkgutil
import signal
from itertools import count

import cv2
import h5py
import numpy as np
import pytest

from morph_dslam import TrackerOptions, TrackOptions, track
from morph_dslam.camera import Camera
from morph_dslam.cli.app import main
from morph_dslam.errors import CameraError, RegistrationError, SourceError, TrackingError
from morph_dslam.evaluation.run_folder import load_run
from morph_dslam.io.camera_files import save_camera
from morph_dslam.io.folders import only_writer
from morph_dslam.tracking.result import STAGES
from morph_dslam.tracking.tracker import Tracker
from tests.support.bent_sheet import bent_sheet_model
from tests.support.documents import code_words
from tests.support.rendered_sequence import SheetFilm, sheet_state, write_landmarks, write_recording

TIMES = np.linspace(0.0, 0.24, 7)
FILES = {"frames": "frames", "model": "sheet.morph", "camera": "camera.yaml", "landmarks": "landmarks.csv"}
BLANK = 4  # position of the frame that shows nothing


@pytest.fixture(scope="module")
def inputs(tmp_path_factory):
    """Frames 20..26 in a folder, model, camera and landmarks of frame 20."""
    folder = tmp_path_factory.mktemp("sequence")
    model = bent_sheet_model(43, 31)
    film = SheetFilm(model)
    images = [film.blank() if number == BLANK else film.frame(sheet_state(time)) for number, time in enumerate(TIMES)]
    write_recording(folder, dict(enumerate(images, 20)), model)
    write_landmarks(folder / "landmarks.csv", model, sheet_state(0.0))
    return folder


def options(inputs, output, **changes):
    # The landmarks are exact but for rounding.
    known = {name: inputs / path for name, path in FILES.items()} | {"click_px": 0.01, "output": output}
    return TrackOptions(**known | changes)


@pytest.fixture(scope="module")
def finished(inputs, tmp_path_factory, blank_figures):
    folder = tmp_path_factory.mktemp("runs") / "run"
    with blank_figures():
        return folder, track(options(inputs, folder))


def error_of(run, position):
    """Mean distance of the nodes of one frame from the truth in the camera frame, metres."""
    truth = sheet_state(TIMES[position])
    expected = truth.camera_from_object.apply(run.model.positions(truth.parameters))
    return np.linalg.norm(run.camera_points(position) - expected, axis=1).mean()


def test_run_folder_holds_the_states(finished):
    folder, _ = finished
    run = load_run(folder)
    assert run.frames.tolist() == list(range(20, 27))
    assert run.tracked.tolist() == [position != BLANK for position in range(7)]
    for position in np.flatnonzero(run.tracked):
        assert error_of(run, position) < 0.5e-3


def test_result_file_has_the_documented_layout(finished):
    folder, _ = finished
    with h5py.File(folder / "result.h5") as file:
        assert dict(file.attrs) == {
            "format": "morph-dslam run",
            "version": 1,
            "reference_frame": 20,
            "first_frame": 20,
            "last_frame": 26,
        }
        shapes = {name: item.shape for name, item in file.items()}
        assert file["timings_ms"].attrs["names"].tolist() == [*STAGES, "total"]
        assert "points agree" in file["reason"].asstr()[BLANK]
        assert np.isnan(file["parameters"][BLANK]).all()
        assert file["parameter_std"][1].max() < 0.01
        deviations = np.sqrt(np.diagonal(file["covariance"][:], axis1=1, axis2=2))
        assert deviations[1] == pytest.approx(np.concatenate([file["parameter_std"][1], file["pose_std"][1]]))
        assert np.isnan(file["covariance"][BLANK]).all()
        assert (file["n_inliers"][:BLANK] > 250).all()
        assert (file["timings_ms"][:, :-1].sum(axis=1) <= file["timings_ms"][:, -1]).all()
    states = {
        "camera_from_object": (7, 4, 4),
        "parameters": (7, 3),
        "parameter_std": (7, 3),
        "covariance": (7, 9, 9),
        "at_bound": (7, 3),
        "pose_std": (7, 6),
    }
    rows = ("frame", "timestamp", "status", "reason", "residual_rms_px", "unexplained_px", "n_points")
    rows += ("n_inliers", "largest_displacement", "largest_displacement_std", "pose_from")
    rows += ("largest_von_mises", "largest_von_mises_std", "motion_known")
    assert shapes == {**states, **dict.fromkeys(rows, (7,)), "timings_ms": (7, len(STAGES) + 1)}


def test_table_and_summary_are_in_display_units(finished):
    folder, summary = finished
    with (folder / "frames.csv").open() as file:
        rows = list(csv.DictReader(file))
    truth = sheet_state(TIMES[2])
    assert float(rows[2]["arch_mm"]) == pytest.approx(1e3 * truth.parameters[0], abs=0.3)
    assert float(rows[2]["twist_deg"]) == pytest.approx(np.degrees(truth.parameters[2]), abs=0.2)
    assert float(rows[2]["z_mm"]) == pytest.approx(1e3 * truth.camera_from_object.translation[2], abs=0.5)
    largest = np.linalg.norm(bent_sheet_model(43, 31).displacement.value(truth.parameters), axis=1).max()
    assert float(rows[2]["largest_displacement_mm"]) == pytest.approx(1e3 * largest, abs=0.3)
    assert 0.0 < float(rows[2]["largest_displacement_std_mm"]) < 0.3
    assert rows[BLANK]["arch_mm"] == ""
    assert json.loads((folder / "summary.json").read_text()) == json.loads(json.dumps(summary, default=str))
    assert (summary["n_tracked"], summary["n_lost"]) == (6, 1)
    assert any("1 of 7 frames was lost" in flag for flag in summary["flags"])
    assert summary.keys() - code_words("run-folder") == set()


def test_video_and_plots_are_there(finished):
    folder, _ = finished
    capture = cv2.VideoCapture(str(folder / "augmented.mp4"))
    assert int(capture.get(cv2.CAP_PROP_FRAME_COUNT)) == 7
    first = capture.read()[1].astype(float)
    capture.release()
    # The colours of the stress lie over the grey film where the object is.
    assert np.ptp(first[220:260, 250:390], axis=2).mean() > 20.0
    assert {path.name for path in (folder / "plots").iterdir()} == {
        "confidence.png",
        "parameters.png",
        "residual.png",
        "timings.png",
    }


def test_a_run_is_not_overwritten_unasked(inputs, finished):
    with pytest.raises(TrackingError, match="holds a run already"):
        track(options(inputs, finished[0]))


def test_interrupt_keeps_the_frames_so_far(inputs, tmp_path, monkeypatch):
    process = Tracker.track
    calls = []

    def interrupted(self, image, *rest):
        calls.append(1)
        if len(calls) == 6:  # two calls warm up
            raise KeyboardInterrupt
        return process(self, image, *rest)

    monkeypatch.setattr(Tracker, "track", interrupted)
    with pytest.raises(KeyboardInterrupt):
        track(options(inputs, tmp_path / "run"))
    assert load_run(tmp_path / "run").frames.tolist() == [20, 21, 22]
    assert (tmp_path / "run" / "augmented.mp4").is_file()


@pytest.fixture
def interrupted_at(interruptible, monkeypatch):
    """A function: what is called at a place, by its name, sends Ctrl-C first, as often as a number says."""

    def at(place, calls, times=1):
        owner, _, name = place.rpartition(".")
        function = getattr(pkgutil.resolve_name(owner), name)
        numbers = count(1)

        def interrupted(*args, **kwargs):
            if next(numbers) in calls:
                for _ in range(times):
                    signal.raise_signal(signal.SIGINT)
            return function(*args, **kwargs)

        monkeypatch.setattr(place, interrupted)

    return at


def command(inputs, output, *more):
    files = [f"--{name}={inputs / path}" for name, path in FILES.items() if name != "frames"]
    return ["track", str(inputs / FILES["frames"]), *files, "-o", str(output), *more]


IN_A_FRAME, REFINING, WRITING, DRAWING = (
    "morph_dslam.tracking.tracker.Tracker.track",
    "morph_dslam.tracking.track.refine_reference",
    "morph_dslam.tracking.run_folder.save_model",
    "morph_dslam.io.video.VideoWriter.write",
)
FOURTH = (6,)  # two calls warm up


def test_ctrl_c_ends_a_run_behind_the_frame_that_is_tracked(inputs, tmp_path, interrupted_at, capsys):
    interrupted_at(IN_A_FRAME, FOURTH)
    assert main(command(inputs, tmp_path / "run")) == 130
    assert capsys.readouterr().err.endswith("interrupted; the frames tracked so far are kept in the run folder\n")
    assert load_run(tmp_path / "run").frames.tolist() == [20, 21, 22, 23]
    assert (tmp_path / "run" / "augmented.mp4").is_file()


def test_a_second_ctrl_c_ends_it_at_once_and_loses_nothing_before(inputs, tmp_path, interrupted_at, capsys):
    interrupted_at(IN_A_FRAME, FOURTH, times=2)
    assert main(command(inputs, tmp_path / "run")) == 130
    assert capsys.readouterr().err.endswith("interrupted; the frames tracked so far are kept in the run folder\n")
    assert load_run(tmp_path / "run").frames.tolist() == [20, 21, 22]


@pytest.mark.parametrize("is_first", [True, False])
def test_ctrl_c_while_results_are_written_waits_for_them(is_first, inputs, tmp_path, interrupted_at, capsys):
    if not is_first:
        interrupted_at(IN_A_FRAME, FOURTH)
    interrupted_at(WRITING, (1,), times=3)
    assert main(command(inputs, tmp_path / "run", "--no-video")) == 130
    printed = capsys.readouterr()
    assert printed.err.count("writing what was tracked ...") == 1
    assert printed.err.endswith("interrupted; the frames tracked so far are kept in the run folder\n")
    assert f"wrote {tmp_path / 'run'}" in printed.out
    assert load_run(tmp_path / "run").frames.tolist() == list(range(20, 27 if is_first else 24))
    assert (tmp_path / "run" / "plots" / "parameters.png").is_file()
    assert main(["evaluate", str(tmp_path / "run"), "--trajectory", str(tmp_path / "run" / "trajectory.txt")]) == 0


@pytest.mark.parametrize(
    ("place", "calls", "frames"), [(REFINING, (1,), range(20, 27)), (IN_A_FRAME, (10,), range(20, 21))]
)
def test_ctrl_c_between_two_passes_keeps_one_of_them(place, calls, frames, inputs, tmp_path, interrupted_at, capsys):
    """The second pass, once it has begun."""
    interrupted_at(place, calls)
    assert main(command(inputs, tmp_path / "run", "--refine", "--no-video")) == 130
    assert "interrupted; the frames tracked so far are kept" in capsys.readouterr().err
    assert load_run(tmp_path / "run").frames.tolist() == list(frames)


def test_ctrl_c_while_the_video_is_drawn_leaves_the_rest_of_it_out(inputs, tmp_path, interrupted_at, capsys):
    interrupted_at(DRAWING, (4,))
    assert main(command(inputs, tmp_path / "run")) == 130
    assert f"wrote {tmp_path / 'run'}" in capsys.readouterr().out
    assert load_run(tmp_path / "run").frames.tolist() == list(range(20, 27))
    capture = cv2.VideoCapture(str(tmp_path / "run" / "augmented.mp4"))
    assert int(capture.get(cv2.CAP_PROP_FRAME_COUNT)) == 3
    capture.release()


def test_reference_may_lie_inside_the_range(inputs, tmp_path):
    """Frame 23 as the reference: the landmarks' pixels there, and the sequence still starts at 21."""
    write_landmarks(tmp_path / "landmarks.csv", bent_sheet_model(43, 31), sheet_state(TIMES[3]), seed=1)
    there = {"landmarks": tmp_path / "landmarks.csv", "reference_frame": 23}
    summary = track(options(inputs, tmp_path / "run", first=21, last=23, video=False, **there))
    assert summary["n_tracked"] == 3
    assert summary["reference_frame"] == 23
    assert not (tmp_path / "run" / "augmented.mp4").exists()


def test_camera_of_another_size_is_refused(inputs, tmp_path):
    save_camera(tmp_path / "camera.yaml", Camera(1280, 720, 900.0, 900.0, 640.0, 360.0))
    with pytest.raises(CameraError, match="is 640x480 pixels but the camera file is for 1280x720"):
        track(options(inputs, tmp_path / "run", camera=tmp_path / "camera.yaml"))


def test_landmarks_off_the_object_are_refused(inputs, tmp_path):
    (tmp_path / "landmarks.csv").write_text("x_mm,y_mm,z_mm,u_px,v_px\n" + "900,0,0,100,100\n" * 6)
    with pytest.raises(RegistrationError, match=r"landmark 1 at \(900, 0, 0\) mm is 690.0 mm off"):
        track(options(inputs, tmp_path / "run", landmarks=tmp_path / "landmarks.csv"))


def test_broken_frame_ends_the_run_but_keeps_it(inputs, tmp_path):
    frames = tmp_path / "frames"
    frames.mkdir()
    for path in sorted((inputs / "frames").iterdir())[:4]:
        (frames / path.name).write_bytes(path.read_bytes())
    (frames / "000022.png").write_bytes((frames / "000022.png").read_bytes()[:500])
    with pytest.raises(SourceError, match="000022"):
        track(options(inputs, tmp_path / "run", frames=frames))
    assert load_run(tmp_path / "run").frames.tolist() == [20, 21]
    assert (tmp_path / "run" / "augmented.mp4").is_file()


def test_refined_reference_is_named_and_still_right(inputs, tmp_path):
    summary = track(options(inputs, tmp_path / "run", refine_reference=True, video=False))
    assert summary["reference_refined_over_the_sequence"]
    run = load_run(tmp_path / "run")
    assert run.tracked.sum() == 6
    assert error_of(run, 6) < 1e-3


@pytest.mark.usefixtures("drawn_figures")
def test_run_without_the_object_is_whole_and_says_that_nothing_was_found(inputs, tmp_path):
    """Only the blank frame is tracked; the object is known from another one."""
    chosen = options(inputs, tmp_path / "run", first=24, last=24, reference_frame=20)
    summary = track(chosen)
    assert (summary["n_tracked"], summary["n_lost"]) == (0, 1)
    assert summary["flags"][-1].startswith("1 of 1 frames was lost")
    assert not load_run(tmp_path / "run").tracked.any()
    assert (tmp_path / "run" / "augmented.mp4").is_file()


def test_two_runs_do_not_write_to_one_folder(inputs, tmp_path):
    chosen = options(inputs, tmp_path / "run", last=20, video=False, overwrite=True)
    with only_writer(tmp_path / "run"), pytest.raises(TrackingError, match="another run is writing"):
        track(chosen)
    assert list((tmp_path / "run").iterdir()) == []
    assert track(chosen)["n_frames"] == 1
    assert track(chosen)["n_frames"] == 1


def test_random_walk_and_start_are_named(inputs, tmp_path):
    walk = TrackerOptions(random_walk=(("twist", np.radians(2.0)),), start="constant-velocity")
    summary = track(options(inputs, tmp_path / "run", last=22, video=False, tracker=walk))
    assert "random walk" in summary["temporal_prior"]
    assert "twist by 2 deg" in summary["temporal_prior"]
    assert summary["start_of_each_frame"] == "the state that the last two lead to at constant velocity"
    twists = load_run(tmp_path / "run").parameters[:, 2]
    np.testing.assert_allclose(twists, [sheet_state(time).parameters[2] for time in TIMES[:3]], atol=0.01)


def test_a_named_point_is_followed(inputs, tmp_path):
    """The middle of the sheet's right end, in millimetres, whose motion is known."""
    files = [
        "--model",
        inputs / "sheet.morph",
        "--camera",
        inputs / "camera.yaml",
        "--landmarks",
        inputs / FILES["landmarks"],
    ]
    more = ["--range", "20-23", "--fps", "20", "--point", "end=210,0,0", "--no-video", "-o", tmp_path / "run"]
    assert main([str(word) for word in ("track", inputs / "frames", *files, *more)]) == 0
    model = load_run(tmp_path / "run").model
    node = int(np.linalg.norm(model.nodes - [0.21, 0.0, 0.0], axis=1).argmin())
    rows = list(csv.DictReader((tmp_path / "run" / "frames.csv").read_text().splitlines()))
    for row, time in zip(rows, TIMES, strict=False):
        truth = 1e3 * (model.positions(sheet_state(time).parameters) - model.nodes)[node]
        found = [float(row[f"displacement_end_{axis}_mm"]) for axis in "xyz"]
        np.testing.assert_allclose(found, truth, atol=0.5)
    assert (tmp_path / "run" / "plots" / "points.png").is_file()
    check_that_the_run_can_be_repeated(inputs, json.loads((tmp_path / "run" / "summary.json").read_text()))


def check_that_the_run_can_be_repeated(inputs, summary):
    """From what the summary says of its files and options."""
    assert summary["inputs"] == {name: str(inputs / path) for name, path in FILES.items()}
    asked = {"first": 20, "last": 23, "fps": 20.0, "points": [["end", [pytest.approx(0.21), 0.0, 0.0]]], "video": False}
    left = {"snap": False, "at_rest": False, "time_zero": None, "refine_reference": False, "refine_camera": []}
    assert summary["settings"].items() >= (asked | left).items()


def test_parameter_that_is_one_over_the_sequence_is_named(inputs, finished, tmp_path):
    summary = track(
        options(inputs, tmp_path / "run", last=23, tracker=TrackerOptions(per_sequence=("twist",)), video=False)
    )
    assert summary["temporal_prior"] == "per-sequence parameters, from all frames so far: twist; none on the others"
    (twist,) = summary["one_over_the_sequence"]
    low, high = twist["interval_95"]
    assert (twist["name"], twist["unit"]) == ("twist", "deg")
    assert low < twist["value"] < high
    assert finished[1]["temporal_prior"] == "none"
    assert finished[1]["one_over_the_sequence"] == []
    with pytest.raises(TrackingError, match="'bend' cannot be a per-sequence parameter"):
        track(options(inputs, tmp_path / "other", tracker=TrackerOptions(per_sequence=("bend",))))


def test_what_a_sensor_knows_is_in_the_result(inputs, tmp_path):
    """A twist that is known exactly in two frames, and one that is a degree off in another, with little deviation."""
    twists = {number: np.degrees(sheet_state(time).parameters[2]) for number, time in enumerate(TIMES, 20)}
    rows = [f"21,{twists[21]},0.01", f"22,{twists[22]},0.01", f"23,{twists[23] + 1.0},0.01"]
    (tmp_path / "known.csv").write_text("\n".join(["frame,twist_deg,twist_std_deg", *rows]))
    track(options(inputs, tmp_path / "run", known=tmp_path / "known.csv", video=False))
    with (tmp_path / "run" / "frames.csv").open() as file:
        found = {int(row["frame"]): row for row in csv.DictReader(file)}
    for number, away in ((21, 0.0), (22, 0.0), (23, 1.0)):
        assert float(found[number]["twist_deg"]) == pytest.approx(twists[number] + away, abs=0.0301)
    assert float(found[21]["twist_std_deg"]) < 0.011
    # In the frames after it the images alone tell.
    assert float(found[25]["twist_deg"]) == pytest.approx(twists[25], abs=0.5)


def test_known_parameters_of_a_live_run_are_refused(inputs, tmp_path):
    with pytest.raises(TrackingError, match=r"Tracker\.know"):
        track(options(inputs, tmp_path / "run", known=tmp_path / "known.csv", live=True))
