"""Several objects, several cameras, and what goes with them, on rendered sheets with known states."""

import json
import re
import shutil
from dataclasses import replace

import h5py
import numpy as np
import pytest

import morph_dslam as md
from morph_dslam.cli.app import main
from morph_dslam.errors import ArgumentError, RegistrationError, SourceError
from morph_dslam.evaluation.run_folder import load_run
from morph_dslam.geometry import RigidTransform, rotation_exp
from morph_dslam.io.camera_files import save_rig
from morph_dslam.io.landmarks import Landmarks, save_landmarks
from morph_dslam.registration.registration import Registration
from morph_dslam.sources import Frame
from morph_dslam.sources.frames import MissingFrame
from morph_dslam.sources.live import PacedRecording
from morph_dslam.tracking.estimator import State
from morph_dslam.tracking.multi_camera import RigTracker
from morph_dslam.tracking.occlusion import MultiObjectTracker
from morph_dslam.tracking.outcomes import CameraIgnored, KnownRefuted, RejectionReason, SamePlace
from morph_dslam.tracking.rig import RigCamera
from morph_dslam.tracking.synchronized import SynchronizedFrames
from morph_dslam.tracking.tracker import Tracker
from tests.support.bent_sheet import bent_sheet_model
from tests.support.rendered_sequence import (
    ASIDE,
    CAMERA,
    FRONT,
    RIG,
    TURN,
    UPRIGHT,
    SheetFilm,
    mean_error,
    sheet_depth,
    sheet_state,
    write_landmarks,
    write_recording,
)

TIMES = np.linspace(0.0, 1.0, 21)


@pytest.fixture(scope="module")
def model():
    return bent_sheet_model(43, 31)


# Several objects: one sheet passes in front of another.


@pytest.fixture(scope="module")
def films(model):
    return {"behind": SheetFilm(model, seed=1), "before": SheetFilm(model, seed=2)}


def states(time):
    """The sheet behind bends; the one before passes it from right to left."""
    bend = np.array([0.03 * np.sin(4.0 * time), 0.2, 0.1])
    behind = RigidTransform(rotation_exp(np.array([0.1, 0.2, 0.1 * time])) @ UPRIGHT, np.array([-0.1, 0.0, 0.9]))
    before = RigidTransform(
        rotation_exp(np.array([0.0, -0.3, 0.0])) @ UPRIGHT, np.array([0.33 - 0.35 * time, 0.12, 0.75])
    )
    return {"behind": State(bend, behind), "before": State(np.array([0.02, 0.0, 0.05]), before)}


def frame(model, films, time):
    """Both sheets, the nearer one before the other."""
    images = {name: film.frame(states(time)[name]) for name, film in films.items()}
    no_noise = np.random.default_rng(0)
    depths = {name: sheet_depth(model, states(time)[name], no_noise, 0.0, 9.0) for name in films}
    nearer = depths["before"] < depths["behind"]
    return np.where(nearer[:, :, None], images["before"], images["behind"])


def new_trackers(model, films):
    first = frame(model, films, 0.0)
    return {name: Tracker(model, CAMERA, Registration(model, states(0.0)[name]), reference=first) for name in films}


def test_a_session_without_files_keeps_what_passes_before_an_object_from_spoiling_it(model, films):
    recording = [Frame(number, time, frame(model, films, time)) for number, time in enumerate(TIMES[1:])]
    errors, visible = {name: [] for name in films}, []

    def take(tracked):
        for name, result in tracked.results.items():
            assert result.status is md.Status.TRACKED, (name, result.reason)
            truth = states(tracked.frame.timestamp)[name]
            errors[name].append(mean_error(model, result.estimate.state, truth))
        visible.append(tracked.results["behind"].n_points)

    md.Session(new_trackers(model, films), recording, [take]).run()
    assert len(visible) == len(recording)
    assert max(errors["before"]) < 0.3e-3
    # Two thirds of its points are occluded at last.
    assert min(visible) < 0.4 * visible[0]
    assert np.mean(errors["behind"]) < 0.3e-3
    assert max(errors["behind"]) < 1.0e-3


def test_two_objects_are_tracked_from_the_first_frame_of_a_session(model, films):
    """Without a reference, as the page on programs of one's own has them: the first frame is the registrations'."""
    trackers = {name: Tracker(model, CAMERA, Registration(model, state)) for name, state in states(0.0).items()}
    recording = [Frame(number, time, frame(model, films, time)) for number, time in enumerate(TIMES[:3])]
    for tracked in md.Session(trackers, recording):
        for name, result in tracked.results.items():
            assert result.tracked, (name, result.reason)
            assert mean_error(model, result.estimate.state, states(tracked.frame.timestamp)[name]) < 0.3e-3


def test_occluded_points_are_known_to_be_occluded(model, films):
    """By themselves, points behind the other sheet count as visible, and have to be thrown out by looks."""
    aware, unaware = MultiObjectTracker(new_trackers(model, films)), new_trackers(model, films)["behind"]
    for time in TIMES[1:]:
        image = frame(model, films, time)
        counts = aware.track([Frame(0, time, image)])["behind"].n_points, unaware.track(image).n_points
    positions = aware.trackers["behind"].reference.points.in_camera(states(1.0)["behind"])
    pixels = np.rint(CAMERA.project(positions)).astype(int)
    depth = sheet_depth(model, states(1.0)["before"], np.random.default_rng(0), 0.0, 9.0)
    occluded = depth[pixels[:, 1], pixels[:, 0]] < positions[:, 2]
    assert occluded.sum() > 60
    assert counts[0] <= counts[1] - occluded.sum()


def test_a_lost_object_occludes_nothing(model, films):
    objects = MultiObjectTracker(new_trackers(model, films))
    for time in TIMES[1:14]:
        before = objects.track([Frame(0, time, frame(model, films, time))])
    results = objects.track([Frame(0, 0.0, films["behind"].frame(states(TIMES[14])["behind"]))])
    assert results["before"].status is md.Status.LOST
    assert results["behind"].n_points > before["behind"].n_points + 80


def twins(places, film, model):
    """One picture of sheets with the same print at places (3,), the nearer ones before the others."""
    shown = film.blank()
    for place in sorted(places, key=lambda place: -place[2]):
        state = twin_state(place)
        covered = sheet_depth(model, state, np.random.default_rng(0), 0.0, 9.0) < 9.0
        shown = np.where(covered[:, :, None], film.frame(state), shown)
    return shown


def twin_state(place):
    return State(np.array([0.02, 0.1, 0.0]), RigidTransform(UPRIGHT, np.array(place)))


def test_a_twin_that_leaves_the_picture_is_not_found_where_the_other_one_stands(model):
    """Two sheets alike: one leaves, is lost as long as it is away, and comes back elsewhere."""
    film, left, right, back = SheetFilm(model, seed=1), [-0.25, 0.0, 1.2], [0.2, 0.0, 1.2], [-0.2, 0.08, 1.2]
    film_of = {"left": left, "right": right}
    trackers = {name: Tracker(model, CAMERA, Registration(model, twin_state(at))) for name, at in film_of.items()}
    objects = MultiObjectTracker(trackers)
    placed = [[left, right]] * 2 + [[right]] * 2 + [[back, right]] * 2
    for number, places in enumerate(placed):
        results = objects.track([Frame(number, number / 30, twins(places, film, model))])
        assert mean_error(model, results["right"].estimate.state, twin_state(right)) < 0.5e-3
        if len(places) == 1:
            assert results["left"].status is md.Status.LOST
            assert results["left"].rejection.then.reason is RejectionReason.PLACE_TAKEN
        else:
            assert mean_error(model, results["left"].estimate.state, twin_state(places[0])) < 1e-3
        assert not any(result.warning(SamePlace) for result in results.values())


def test_two_objects_in_one_place_are_both_named(model):
    """Landmarks of one of two that look alike were given to both."""
    film, place = SheetFilm(model, seed=1), [0.0, 0.0, 0.9]
    trackers = {name: Tracker(model, CAMERA, Registration(model, twin_state(place))) for name in ("one", "other")}
    results = MultiObjectTracker(trackers).track([Frame(0, 0.0, film.frame(twin_state(place)))])
    assert results["one"].warning(SamePlace) == SamePlace("other")
    assert results["other"].warning(SamePlace) == SamePlace("one")


@pytest.fixture(scope="module")
def two_sheets(model, films, tmp_path_factory):
    """Frames, model, camera, and landmarks of both sheets in frames 0 and 3."""
    folder = tmp_path_factory.mktemp("two_sheets")
    write_recording(folder, {n: frame(model, films, time) for n, time in enumerate(TIMES[:12:2])}, model)
    for number in (0, 3):
        for name, state in states(TIMES[2 * number]).items():
            write_landmarks(folder / f"{name}_{number}.csv", model, state, count=24)
    return folder


def with_two_sheets(folder, output, *more):
    return [
        "track", folder / "frames", "--model", folder / "sheet.morph", "--camera", folder / "camera.yaml",
        "--landmarks", folder / "behind_0.csv", "--also", "before", folder / "sheet.morph", folder / "before_0.csv",
        "-o", output, "--no-video", *more,
    ]  # fmt: skip


def run_command(arguments):
    return main([str(word) for word in arguments])


@pytest.mark.slow
@pytest.mark.parametrize("more", ["plain", "refined", "registered anew"])
def test_each_object_has_a_run_folder_and_all_that_one_object_has(model, two_sheets, tmp_path, capsys, more):
    options = {
        "plain": [],
        "refined": ["--refine"],
        "registered anew": ["--reregister-at", f"before:3={two_sheets / 'before_3.csv'}"],
    }[more]
    assert run_command(with_two_sheets(two_sheets, tmp_path / "run", *options)) == 0
    said = capsys.readouterr().out
    assert said.count("tracked=6/6") == 2
    assert said.count("registered anew in frame 3") == (more == "registered anew")
    for folder, name in ((tmp_path / "run", "behind"), (tmp_path / "run" / "before", "before")):
        run = load_run(folder)
        for row, time in enumerate(TIMES[:12:2]):
            state = states(time)[name]
            exact = state.camera_from_object.apply(model.positions(state.parameters))
            assert np.linalg.norm(run.camera_points(row) - exact, axis=1).mean() < 0.5e-3


def test_an_object_in_the_place_of_another_one_is_named_as_such(two_sheets, tmp_path, capsys):
    """It shows no corner of its own, however sharp the frame is."""
    arguments = with_two_sheets(two_sheets, tmp_path / "run")
    twice = [two_sheets / "behind_0.csv" if word == two_sheets / "before_0.csv" else word for word in arguments]
    assert run_command(twice) == 2
    assert re.search(
        r"other objects hide (100|[5-9][0-9])% of the object in the reference frame", capsys.readouterr().err
    )


# Several cameras.

RIG_TIMES = np.linspace(0.0, 0.3, 10)[1:]


@pytest.fixture
def rig_films(model):
    return [SheetFilm(model, part.camera) for part in RIG]


def images(films, time):
    state = sheet_state(time)
    return [film.frame(part.seen(state), noise=6.0) for film, part in zip(films, RIG, strict=True)]


def new_rig(model, references, **options):
    registration = Registration(model, sheet_state(0.0))
    return RigTracker(model, RIG, registration, md.TrackerOptions(**options), references=references)


def test_two_cameras_are_nearer_to_the_truth_than_one(model, rig_films):
    """Something covers most of the object in the first camera, and some of it in the second."""
    first = images(rig_films, 0.0)
    alone = Tracker(model, FRONT.camera, Registration(model, sheet_state(0.0)), reference=first[0])
    rig = new_rig(model, first)
    errors, deviations = {"alone": [], "rig": []}, {"alone": [], "rig": []}
    for time in RIG_TIMES:
        seen = images(rig_films, time)
        seen[0][:, 250:] = 90
        seen[1][:160] = 90
        for name, result in (("alone", alone.track(seen[0])), ("rig", rig.track(seen))):
            assert result.status is md.Status.TRACKED, result.reason
            errors[name].append(mean_error(model, result.estimate.state, sheet_state(time)))
            deviations[name].append(result.estimate.pose_std[5])
    assert np.mean(errors["rig"]) < 0.5 * np.mean(errors["alone"])
    assert np.mean(deviations["rig"]) < 0.5 * np.mean(deviations["alone"])


def test_a_covered_camera_goes_on_from_the_other(model, rig_films):
    rig = new_rig(model, images(rig_films, 0.0))
    for number, time in enumerate(RIG_TIMES):
        seen = images(rig_films, time)
        if 2 <= number <= 6:
            seen[1] = rig_films[1].blank()
        result = rig.track(seen)
        assert result.status is md.Status.TRACKED, result.reason
        assert mean_error(model, result.estimate.state, sheet_state(time)) < 0.6e-3
        assert [warning.camera for warning in result.warnings] == ([1] if 2 <= number <= 6 else [])
    assert rig.trackers[1].last_measured.weights.sum() > 100


def test_a_sensor_tells_a_rig_of_a_parameter_and_is_named_when_the_images_refute_it(model, rig_films):
    """Its readings have another zero in the last three frames; the first camera is covered in two before."""
    rig, random, sensor_std = new_rig(model, images(rig_films, 0.0)), np.random.default_rng(2), 2e-4
    for number, time in enumerate(RIG_TIMES):
        truth, zero, seen = sheet_state(time).parameters[0], -0.02 if number >= 6 else 0.0, images(rig_films, time)
        if number in (2, 3):
            seen[0] = rig_films[0].blank()
        rig.know({"arch": (truth + zero + sensor_std * random.standard_normal(), sensor_std)})
        result = rig.track(seen)
        assert result.status is md.Status.TRACKED, result.reason
        assert result.estimate.state.parameters[0] == pytest.approx(truth + zero, abs=4.0 * sensor_std)
        if not zero:
            assert result.estimate.parameter_std[0] < sensor_std
        warnings = [warning for warning in result.warnings if not isinstance(warning, CameraIgnored)]
        assert [type(warning) for warning in warnings] == ([KnownRefuted] if zero else [])
        for warning in warnings:
            assert float(warning.found.removesuffix(" mm")) == pytest.approx(1e3 * truth, abs=2.0)
    rig.know({})
    result = rig.track(images(rig_films, time))
    assert result.estimate.state.parameters[0] == pytest.approx(truth, abs=4.0 * result.estimate.parameter_std[0])


def test_an_object_that_no_camera_sees_is_lost(model, rig_films):
    result = new_rig(model, images(rig_films, 0.0)).track([film.blank() for film in rig_films])
    assert result.status is md.Status.LOST
    assert [warning.camera for warning in result.warnings] == [0, 1]


def test_a_reference_frame_without_texture_names_its_camera(model, rig_films):
    first = [images(rig_films, 0.0)[0], np.full((360, 480, 3), 128, np.uint8)]
    with pytest.raises(RegistrationError, match="camera 1: the object shows only"):
        new_rig(model, first)


def test_depth_images_of_the_first_camera_count(model, rig_films):
    """The cameras' calibration is off, which the sight line of the first one shows."""
    rng, shift, sight_line = np.random.default_rng(0), np.array([4e-3, 0.0, 0.0]), {}
    for use_depth in (False, True):
        rig = RigTracker(
            model,
            [FRONT, RigCamera(ASIDE.camera, RigidTransform(TURN, ASIDE.camera_from_rig.translation + shift))],
            Registration(model, sheet_state(0.0)),
            md.TrackerOptions(use_depth=use_depth),
            references=images(rig_films, 0.0),
        )
        found = []
        for time in RIG_TIMES:
            front, aside = (Frame(0, time, image) for image in images(rig_films, time))
            depth = sheet_depth(model, sheet_state(time), rng, camera=FRONT.camera)
            result = rig.track([Frame(0, time, front.image, depth=depth), aside])
            away = result.pose.translation - sheet_state(time).camera_from_object.translation
            found.append(abs(away[2]))
        sight_line[use_depth] = np.mean(found)
    assert sight_line[True] < 0.5 * sight_line[False]


def test_depth_of_zero_is_not_measured(model, rig_films):
    """With holes in 30 % of the pixels the results are those of NaN there."""
    found, film = {}, rig_films[0]
    reference, *pictures = [film.frame(sheet_state(time)) for time in (0.0, *RIG_TIMES[:3])]  # with noise
    for hole in (0.0, np.nan):
        rng, options = np.random.default_rng(0), md.TrackerOptions(use_depth=True)
        tracker = Tracker(model, FRONT.camera, Registration(model, sheet_state(0.0)), options, reference=reference)
        for time, picture in zip(RIG_TIMES, pictures, strict=False):
            depth = sheet_depth(model, sheet_state(time), rng, camera=FRONT.camera)
            depth[rng.random(depth.shape) < 0.3] = hole
            result = tracker.track(Frame(0, time, picture, depth=depth))
        assert not result.warnings
        found[str(hole)] = result.pose.matrix
    np.testing.assert_array_equal(found["0.0"], found["nan"])


class DepthFilm:
    """A recording of the first camera, with depth."""

    name, fps, has_registered_depth = "depth film", 30.0, True

    def __init__(self, model, films):
        self.model, self.film = model, films[0]

    def __iter__(self):
        rng = np.random.default_rng(0)
        for number, time in enumerate(RIG_TIMES):
            depth = sheet_depth(self.model, sheet_state(time), rng, 1e-4, camera=FRONT.camera)
            yield Frame(number, time, self.film.frame(sheet_state(time)), depth=depth)


def test_depth_images_count_live(model, rig_films):
    """The place along the sight line is known much better with them, whose scale is right; frames may be dropped."""
    first, error, deviation = rig_films[0].frame(sheet_state(0.0)), {}, {}
    for use_depth in (False, True):
        options, found = md.TrackerOptions(use_depth=use_depth, depth_sigma=1e-4, depth_scale_std=0.0), []
        tracker = Tracker(model, FRONT.camera, Registration(model, sheet_state(0.0)), options, reference=first)
        with PacedRecording(DepthFilm(model, rig_films)) as stream:
            md.Session({"sheet": tracker}, stream, [found.append]).run()
        result, truth = found[-1].results["sheet"], sheet_state(found[-1].frame.timestamp)
        error[use_depth] = mean_error(model, result.estimate.state, truth)
        deviation[use_depth] = result.estimate.pose_std[5]
    assert deviation[True] < 0.5 * deviation[False]
    assert error[True] < 0.6e-3


def test_the_outline_counts_in_every_camera(model, rig_films):
    rig = new_rig(model, images(rig_films, 0.0), use_outline=True)
    for time in RIG_TIMES:
        result = rig.track(images(rig_films, time))
        assert mean_error(model, result.estimate.state, sheet_state(time)) < 0.3e-3
        for tracker in rig.trackers:
            assert (tracker.last_measured.weights[len(tracker.reference.points) :] > 0.0).any()


@pytest.fixture(scope="module")
def rig_recording_of_sheet(model, tmp_path_factory):
    """What both cameras recorded, their camchain, the model, and landmarks in the first camera."""
    folder = tmp_path_factory.mktemp("rig")
    films = [SheetFilm(model, part.camera) for part in RIG]
    pairs = {number: images(films, time) for number, time in enumerate([0.0, *RIG_TIMES[:4]])}
    for k, name in enumerate(("front", "aside")):
        write_recording(folder, {number: pair[k] for number, pair in pairs.items()}, model, name=name)
    save_rig(folder / "camchain.yaml", [(part.camera, part.camera_from_rig) for part in RIG])
    write_landmarks(folder / "landmarks.csv", model, sheet_state(0.0), FRONT.camera, count=24)
    return folder


def with_both_cameras(folder, output, *more, camera="camchain.yaml#cam0"):
    return [
        "track", folder / "front", "--with", folder / "aside", "--camera", f"{folder}/{camera}",
        "--model", folder / "sheet.morph", "--landmarks", folder / "landmarks.csv", "-o", output, *more,
    ]  # fmt: skip


def test_what_a_sensor_knows_counts_with_both_cameras_too(rig_recording_of_sheet, tmp_path, capsys):
    """A twist that is a degree off in one frame, with little deviation, and right in all others."""
    times, folder = [0.0, *RIG_TIMES[:4]], rig_recording_of_sheet
    twists = [np.degrees(sheet_state(time).parameters[2]) + (number == 3) for number, time in enumerate(times)]
    rows = [f"{number},{twist},0.01" for number, twist in enumerate(twists)]
    (tmp_path / "known.csv").write_text("\n".join(["frame,twist_deg,twist_std_deg", *rows]))
    told = "--known", tmp_path / "known.csv", "--no-video"
    assert run_command(with_both_cameras(folder, tmp_path / "run", *told)) == 0
    run = load_run(tmp_path / "run")
    assert np.degrees(run.parameters[:, 2]) == pytest.approx(twists, abs=0.0301)
    assert "refute the known values of 'twist' in 1 of 5 frames, first in frame 3" in capsys.readouterr().out


def assert_follows_the_sheet(run, model):
    for row, time in enumerate([0.0, *RIG_TIMES[:4]]):
        state = sheet_state(time)
        exact = state.camera_from_object.apply(model.positions(state.parameters))
        assert np.linalg.norm(run.camera_points(row) - exact, axis=1).mean() < 0.4e-3


def test_the_command_tracks_with_both_cameras(model, rig_recording_of_sheet, tmp_path, capsys, refused):
    folder = rig_recording_of_sheet
    assert run_command(with_both_cameras(folder, tmp_path / "run")) == 0
    assert "tracked=5/5" in capsys.readouterr().out
    run = load_run(tmp_path / "run")
    assert_follows_the_sheet(run, model)
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    assert summary["inputs"]["with"] == [str(folder / "aside")]
    assert summary["new_reference_views"] == {"allowed": False, "made": 0, "frames_compared_with_them": 0}
    assert "has 2 cameras, but there are 3" in refused(
        *with_both_cameras(folder, tmp_path / "again", "--with", folder / "aside")
    )
    assert "camchain.yaml#cam1" in refused(*with_both_cameras(folder, tmp_path / "again", camera="camchain.yaml#cam1"))


def write_noisy_landmarks(path, model, part, seed):
    """16 nodes of the sheet where a camera of the rig sees them in the first frame, half a pixel off."""
    rng, state = np.random.default_rng(seed), part.seen(sheet_state(0.0))
    nodes = rng.choice(len(model.nodes), 16, replace=False)
    pixels = part.camera.project(state.camera_from_object.apply(model.positions(state.parameters)[nodes]))
    save_landmarks(path, Landmarks(model.nodes[nodes], pixels + 0.5 * rng.standard_normal(pixels.shape)))


def test_landmarks_in_both_cameras_place_the_sheet_better(model, rig_recording_of_sheet, tmp_path, refused):
    """The truth is that of the film."""
    folder, off, deviation = rig_recording_of_sheet, {}, {}
    for number, part in enumerate(RIG):
        write_noisy_landmarks(tmp_path / f"{number}.csv", model, part, number)
    for name, more in (("one", []), ("both", ["--with-landmarks", tmp_path / "1.csv"])):
        arguments = [*with_both_cameras(folder, tmp_path / name, *more), "--no-video"]
        arguments[arguments.index("--landmarks") + 1] = tmp_path / "0.csv"
        assert run_command(arguments) == 0
        run, off[name] = load_run(tmp_path / name), []
        for row, time in enumerate([0.0, *RIG_TIMES[:4]]):
            state = sheet_state(time)
            exact = state.camera_from_object.apply(model.positions(state.parameters))
            off[name].append(np.linalg.norm(run.camera_points(row) - exact, axis=1).mean())
        deviation[name] = np.sqrt(np.median(run.covariances[:, -1, -1]))
    assert np.mean(off["both"]) < 0.6 * np.mean(off["one"])
    assert deviation["both"] < 0.5 * deviation["one"]
    assert "name the recording of each further camera" in refused(
        *with_both_cameras(folder, tmp_path / "again", "--with-landmarks", "1.csv", "--with-landmarks", "2.csv")
    )


@pytest.mark.slow
def test_cameras_that_do_not_agree_are_named_and_one_recording_twice_is_refused(
    rig_recording_of_sheet, tmp_path, capsys, refused
):
    """The second camera is said to be turned by 30 degrees about its axis."""
    folder, said, unexplained = rig_recording_of_sheet, {}, {}
    off = RigidTransform(rotation_exp(np.array([0.0, 0.0, np.pi / 6])), np.zeros(3)) @ ASIDE.camera_from_rig
    save_rig(folder / "moved.yaml", [(FRONT.camera, RigidTransform.identity()), (ASIDE.camera, off)])
    for camera in ("camchain", "moved"):
        arguments = with_both_cameras(folder, tmp_path / camera, "--no-video", camera=f"{camera}.yaml#cam0")
        assert run_command(arguments) == 0
        said[camera] = capsys.readouterr().out
        with h5py.File(tmp_path / camera / "result.h5") as file:
            unexplained[camera] = np.nanmax(file["unexplained_px"][()])
    assert "the cameras do not agree with each other" not in said["camchain"]
    assert "of 5 frames the cameras do not agree with each other, first in frame 1: up to" in said["moved"]
    assert unexplained["camchain"] < 0.1
    assert unexplained["moved"] > 0.5
    twice = [
        word if word != folder / "aside" else folder / "front" for word in with_both_cameras(folder, tmp_path / "r")
    ]
    assert "front is given for two cameras" in refused(*twice)


def test_frames_of_different_numbers_do_not_go_together(rig_recording_of_sheet):
    front, aside = (md.open_source(rig_recording_of_sheet / "front", first) for first in (0, 1))
    both = SynchronizedFrames([front, aside])
    assert len(both) == 5
    with pytest.raises(md.MorphError, match="begin with frames 0, 1"):
        next(iter(both))


def test_what_is_no_tracker_is_refused():
    with pytest.raises(ArgumentError, match=r"trackers\['sheet'\] is 1: give a Tracker or a RigTracker"):
        md.Session({"sheet": 1}, [])  # type: ignore[dict-item]


def numbered(*numbers):
    return [md.Frame(number, number / 30.0, np.full((4, 4, 3), number, dtype=np.uint8)) for number in numbers]


@pytest.mark.parametrize(
    ("cameras", "missing"),
    [
        ([(0, 1, 2, 3), (0, 2, 3)], [0, 1]),
        ([(0, 2, 3, 5, 6), (0, 1, 3, 4, 6), (0, 3, 6)], [2, 2, 4]),
        ([(0, 1, 2, 3, 4), (0, 2)], [0, 3]),  # one ends earlier
    ],
)
def test_frames_that_one_camera_lacks_have_stand_ins(cameras, missing):
    """By the clock of their camera: those of the others are 100 s ahead, and 200."""
    recordings = [
        [replace(frame, timestamp=frame.timestamp + 100.0 * k) for frame in numbered(*numbers)]
        for k, numbers in enumerate(cameras)
    ]
    both = SynchronizedFrames(recordings)
    for _ in range(2):
        instants = list(both)
        assert [frames[0].index for frames in instants] == sorted(set().union(*cameras))
        for k, numbers in enumerate(cameras):
            times = [frames[k].timestamp for frames in instants]
            np.testing.assert_allclose(times, [100.0 * k + frames[0].index / 30.0 for frames in instants])
            stand_ins = [frames[k] for frames in instants if isinstance(frames[k], MissingFrame)]
            assert {frame.index for frame in stand_ins} == set().union(*cameras) - set(numbers)
            assert not any(frame.image.any() for frame in stand_ins)
        assert both.n_missing == missing


class Timed(list[Frame]):
    """Frames with times of their own, 25 a second."""

    has_assumed_times, fps, name = False, 25.0, "recorded"


def timed(instants, ahead=0.0, seed=0):
    """Frames numbered from 0 as they come, of these instants of 40 ms by a clock with 3 ms of noise."""
    noise = 0.003 * np.random.default_rng(seed).uniform(-1.0, 1.0, len(instants))
    image = np.full((4, 6, 3), 9, dtype=np.uint8)
    return Timed(Frame(k, 0.04 * n + ahead + e, image) for k, (n, e) in enumerate(zip(instants, noise, strict=True)))


@pytest.mark.parametrize("ahead", [0.0, -0.01, 300.0])
@pytest.mark.parametrize(
    ("cameras", "together", "missing", "left_out"),
    [
        (([0, 1, 2, 3, 4], [0, 1, 3, 4]), [(0, 0), (1, 1), (2, None), (3, 2), (4, 3)], [0, 1], 0),
        (([0, 1, 3, 4], [0, 1, 2, 3, 4]), [(0, 0), (1, 1), (2, 3), (3, 4)], [1, 0], 1),
        (([0, 1, 2, 3, 4], [0, 2, 4]), [(0, 0), (1, None), (2, 1), (3, None), (4, 2)], [0, 2], 0),
        (([0, 1], [0, 1, 2]), [(0, 0), (1, 1), (None, 2)], [1, 0], 0),
    ],
)
def test_frames_go_together_by_their_times(cameras, together, missing, left_out, ahead):
    """As when a recorder drops messages of one camera: the numbers of its frames go on, and their times tell."""
    both = SynchronizedFrames([timed(cameras[0]), timed(cameras[1], ahead, seed=1)])
    for _ in range(2):
        pairs = list(both)
        assert [pair[0].index for pair in pairs] == list(range(len(pairs)))
        for pair, rows in zip(pairs, together, strict=True):
            for frame, source, row in zip(pair, both.sources, rows, strict=True):
                assert isinstance(frame, MissingFrame) is (row is None)
                if row is not None:
                    assert (frame.timestamp, frame.index) == (source[row].timestamp, pair[0].index)
        assert (both.n_missing, both.n_left_out) == (missing, left_out)


def test_a_camera_whose_first_frame_was_lost_is_paired_by_the_common_clock():
    both = SynchronizedFrames([timed([0, 1, 2, 3]), timed([1, 2, 3], seed=1)])
    said = [tuple(None if isinstance(frame, MissingFrame) else frame.timestamp for frame in pair) for pair in both]
    assert said[0][1] is None
    assert all(abs(first - second) < 0.01 for first, second in said[1:])
    for number in (1, 3):
        assert [frame.timestamp for frame in both.at(number)] == list(said[number])
    with pytest.raises(SourceError, match="camera 1 has no frame of the instant of frame 0"):
        both.at(None)
    with pytest.raises(SourceError, match="holds no frame 4"):
        both.at(4)


@pytest.mark.slow
@pytest.mark.parametrize(("lacking", "number", "shown"), [("aside", 2, 5), ("front", 2, 4), ("front", 4, 4)])
def test_a_frame_missing_in_one_camera_of_a_rig_is_tracked_with_the_other(
    lacking, number, shown, model, rig_recording_of_sheet, tmp_path, capsys
):
    folder = tmp_path / "rig"
    shutil.copytree(rig_recording_of_sheet, folder)
    next((folder / lacking).glob(f"*{number}.png")).unlink()
    assert run_command(with_both_cameras(folder, tmp_path / "run")) == 0
    camera, said = ("front", "aside").index(lacking), capsys.readouterr().out
    assert f"have not recorded the same frames: of 5, camera {camera} lacks 1; there the others count" in said
    run = load_run(tmp_path / "run")
    assert run.frames.tolist() == [0, 1, 2, 3, 4]
    assert set(run.status) == {"tracked"}
    assert_follows_the_sheet(run, model)
    assert len(md.open_source(tmp_path / "run" / "augmented.mp4")) == shown


def test_an_object_out_of_the_picture_of_a_camera_of_a_rig_is_named(rig_recording_of_sheet, tmp_path, refused):
    """The baseline in millimetres instead of metres."""
    folder, pose = rig_recording_of_sheet, ASIDE.camera_from_rig
    far = RigidTransform(pose.rotation, 1000.0 * pose.translation)
    distance = np.linalg.norm(far.translation)
    save_rig(folder / "far.yaml", [(FRONT.camera, RigidTransform.identity()), (ASIDE.camera, far)])
    said = refused(*with_both_cameras(folder, tmp_path / "run", camera="far.yaml#cam0"))
    assert f"camera 1: the object is not in its picture, by the pose of the camera, {distance:.4g} m" in said
