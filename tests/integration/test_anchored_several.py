"""Several anchored objects in one map, and an anchored object before several cameras, against exact truth."""

import json
from dataclasses import replace
from functools import partial
from threading import Semaphore
from time import monotonic

import cv2
import numpy as np
import pytest

from morph_dslam import sources
from morph_dslam.cli.app import main
from morph_dslam.evaluation.run_folder import load_run
from morph_dslam.geometry import RigidTransform
from morph_dslam.io.landmarks import Landmarks, save_landmarks
from morph_dslam.model import load_model
from morph_dslam.render.rasteriser import rasterise
from morph_dslam.sources import Frame, open_source
from morph_dslam.sources.live import PacedRecording
from morph_dslam.tracking import track as track_module
from morph_dslam.tracking.anchoring import CameraLocalization
from morph_dslam.tracking.drawing import AugmentedPicture, AugmentedView, DrawOptions
from morph_dslam.tracking.estimator import Estimate, State
from morph_dslam.tracking.outcomes import ObjectMoved, Status
from morph_dslam.tracking.placement import new_anchor
from morph_dslam.tracking.result import STAGES, FrameResult
from morph_dslam.tracking.sinks import LiveTimes
from tests.support.rendered_anchored_rig import FRAMES, RIG, SCAN
from tests.support.tracked_rig import column, errors, exact_nodes, placed_objects

#: What the map made from the scan is off by at the objects, and the registrations with it, metres.
MAP_ERROR = 1.6e-3


@pytest.fixture(scope="module")
def recording(rig_recording):
    return rig_recording


def command(folder, output, *more, first="sheet", camera="camera.yaml"):
    start = [] if first is None else ["--registration", str(folder / first / "registration.json")]
    arguments = [str(folder / "front"), "--camera", str(folder / camera), *start]
    arguments += ["--model", str(folder / f"{first or 'wedge'}.morph"), "--range", f"{SCAN - 1}-{FRAMES - 1}"]
    return ["track", *arguments, "-o", str(output), "--no-video", *map(str, more)]


def also(folder, name, start=None):
    start = start or folder / name / "registration.json"
    return ["--also", name, folder / f"{name}.morph", start]


def test_two_objects_are_tracked_in_one_map(recording, tmp_path, capsys):
    folder, truth = recording
    run = tmp_path / "run"
    log = tmp_path / "frames.jsonl"
    assert main(command(folder, run, *also(folder, "wedge"), "--frame-log", log)) == 0
    assert capsys.readouterr().out.count(f"tracked={FRAMES - SCAN + 1}/{FRAMES - SCAN + 1}") == 2
    for name, output in (("sheet", run), ("wedge", run / "wedge")):
        assert errors(folder, truth, name, output).max() < MAP_ERROR
        assert set(column(output, "pose_from")) == {"points and map"}
    expected = {name: truth[name]["parameters"][SCAN - 1 :] for name in truth}
    np.testing.assert_allclose(load_run(run).parameters[:, 0], expected["sheet"][:, 0], atol=0.3e-3)
    np.testing.assert_allclose(load_run(run / "wedge").parameters, expected["wedge"], atol=0.5e-3)
    lines = [json.loads(line) for line in log.read_text().splitlines()]
    assert [line["frame"] for line in lines] == np.repeat(range(SCAN - 1, FRAMES), 2).tolist()
    for name, output in (("sheet", run), ("wedge", run / "wedge")):
        logged = [line["camera_from_object"] for line in lines if line["object"] == name]
        np.testing.assert_array_equal(logged, column(output, "camera_from_object"))
    # The camera was found once a frame, for both.
    np.testing.assert_array_equal(locate_ms(run), locate_ms(run / "wedge"))
    assert (locate_ms(run) > 0.0).all()
    # The wedge hides a part of the sheet in the reference view already: nothing of the sheet is bound there.
    assert (column(run, "n_inliers") > 0.9 * column(run, "n_points")).all()


@pytest.mark.slow
def test_an_object_that_is_registered_beside_another_one_is_tracked_with_it(recording, tmp_path):
    folder, truth = recording
    register = ["register", folder / "map.h5", "--model", folder / "wedge.morph", "--camera"]
    register += [folder / "camera.yaml", "--beside", folder / "sheet" / "registration.json", "-o", tmp_path]
    assert main([str(word) for word in register]) == 0
    start = also(folder, "wedge", tmp_path / "registration.json")
    assert main(command(folder, tmp_path / "run", *start)) == 0
    assert errors(folder, truth, "sheet", tmp_path / "run").max() < MAP_ERROR
    assert errors(folder, truth, "wedge", tmp_path / "run" / "wedge").max() < 0.7e-3


def locate_ms(run_folder):
    return column(run_folder, "timings_ms")[:, STAGES.index("locate")]


@pytest.fixture(scope="module")
def landmarks(recording, tmp_path_factory):
    """Of the wedge, in the first frame tracked."""
    folder, truth = recording
    nodes = load_model(folder / "wedge.morph").nodes
    pixels = RIG[0].camera.project(exact_nodes(folder, truth, "wedge", SCAN - 1))
    chosen = np.random.default_rng(0).choice(len(nodes), 30, replace=False)
    path = tmp_path_factory.mktemp("landmarks") / "wedge.csv"
    save_landmarks(path, Landmarks(nodes[chosen], pixels[chosen]))
    return path


@pytest.mark.slow
@pytest.mark.parametrize("anchored_first", [True, False])
def test_a_free_object_beside_an_anchored_one(recording, landmarks, tmp_path, anchored_first):
    folder, truth = recording
    run, reference = tmp_path / "run", ["--reference-frame", SCAN - 1]
    if anchored_first:
        arguments = command(folder, run, *also(folder, "wedge", landmarks), *reference)
        outputs = {"sheet": run, "wedge": run / "wedge"}
    else:
        more = ["--landmarks", landmarks, *also(folder, "sheet"), *reference]
        arguments = command(folder, run, *more, first=None)
        outputs = {"sheet": run / "sheet", "wedge": run}
    assert main(arguments) == 0
    assert errors(folder, truth, "sheet", outputs["sheet"]).max() < MAP_ERROR
    assert errors(folder, truth, "wedge", outputs["wedge"]).max() < 0.5e-3
    assert set(column(outputs["sheet"], "pose_from")) == {"points and map"}
    assert set(column(outputs["wedge"], "pose_from")) == {"points"}


def changed(path, target, **changes):
    """A registration with other content, whose map is found in its old place."""
    content = json.loads(path.read_text())
    content["map"] = str((path.parent / content["map"]).resolve())
    target.write_text(json.dumps(content | changes))
    return target


def test_registrations_of_different_maps_are_refused(recording, tmp_path, refused):
    folder, _ = recording
    other = tmp_path / "other.h5"
    other.write_bytes((folder / "map.h5").read_bytes())
    start = changed(folder / "wedge" / "registration.json", tmp_path / "wedge.json", map=str(other))
    assert "the objects are anchored in different maps" in refused(
        *command(folder, tmp_path / "run", *also(folder, "wedge", start))
    )


def test_a_registration_that_has_the_object_elsewhere_is_refused(recording, tmp_path, refused):
    folder, _ = recording
    path = folder / "wedge" / "registration.json"
    matrix = np.array(json.loads(path.read_text())["world_from_object"])
    matrix[0, 3] += 0.5
    start = changed(path, tmp_path / "wedge.json", world_from_object=matrix.tolist())
    assert "is not the map of the registration: by the map the object is" in refused(
        *command(folder, tmp_path / "run", *also(folder, "wedge", start))
    )


def test_objects_in_the_same_place_are_refused(recording, tmp_path, refused):
    folder, _ = recording
    twice = ["--also", "twin", folder / "sheet.morph", folder / "sheet" / "registration.json"]
    assert "are registered in the same place of the map" in refused(*command(folder, tmp_path / "run", *twice))


def with_both(folder, output, *more, first="wedge", front=None, aside=None):
    arguments = command(folder, output, *more, first=first, camera="camchain.yaml#cam0")
    arguments[1] = str(front or folder / "front")
    return [*arguments, "--with", str(aside or folder / "aside")]


@pytest.mark.slow
def test_an_anchored_object_before_two_cameras(recording, tmp_path, capsys):
    folder, truth = recording
    assert main(with_both(folder, tmp_path / "run")) == 0
    assert f"tracked={FRAMES - SCAN + 1}/{FRAMES - SCAN + 1}" in capsys.readouterr().out
    assert errors(folder, truth, "wedge", tmp_path / "run").max() < 1.1e-3
    assert set(column(tmp_path / "run", "pose_from")) == {"points and map"}
    assert (locate_ms(tmp_path / "run") > 0.0).all()
    found, expected = load_run(tmp_path / "run").parameters, truth["wedge"]["parameters"][SCAN - 1 :]
    np.testing.assert_allclose(found, expected, atol=0.4e-3)
    # What is the same in all frames, from the map and the registration, is in the deviations.
    assert (np.abs(found - expected) < 3.0 * column(tmp_path / "run", "parameter_std") + 0.02e-3).all()
    exact = truth["wedge"]["camera_from_object"][SCAN - 1 :, :3, 3]
    apart = np.abs(load_run(tmp_path / "run").camera_from_object[:, :3, 3] - exact)
    assert (apart < 3.0 * column(tmp_path / "run", "pose_std")[:, 3:]).all()


@pytest.mark.slow
def test_two_objects_before_two_cameras(recording, tmp_path):
    """What the wedge occludes of the sheet, in each camera, in the reference frames and later, does not count."""
    folder, truth = recording
    arguments = with_both(folder, tmp_path / "run", *also(folder, "wedge"), first="sheet")
    assert main(arguments) == 0
    assert errors(folder, truth, "sheet", tmp_path / "run").max() < MAP_ERROR
    assert errors(folder, truth, "wedge", tmp_path / "run" / "wedge").max() < 1.1e-3
    for output in (tmp_path / "run", tmp_path / "run" / "wedge"):
        assert set(column(output, "pose_from")) == {"points and map"}
        assert (column(output, "n_inliers") > 0.9 * column(output, "n_points")).all()


def covered(folder, truth, target, number, frames):
    """A camera's recording in which something lies on all that it sees of the wedge in some frames."""
    target.mkdir()
    for path in sorted((folder / ("front", "aside")[number]).iterdir()):
        image, frame = cv2.imread(str(path)), int(path.stem)
        if frame in frames:
            nodes = RIG[number].camera_from_rig.apply(exact_nodes(folder, truth, "wedge", frame))
            outline = cv2.convexHull(np.rint(RIG[number].camera.project(nodes)).astype(np.int32))
            cv2.drawContours(image, [outline], -1, (110, 110, 110), thickness=16)
            cv2.fillConvexPoly(image, outline, (110, 110, 110))
        cv2.imwrite(str(target / path.name), image)
    return target


@pytest.mark.slow
def test_what_one_camera_does_not_see_the_other_tells_and_else_it_is_hidden(recording, tmp_path):
    folder, truth = recording
    front = covered(folder, truth, tmp_path / "front", 0, range(SCAN + 2, FRAMES))
    aside = covered(folder, truth, tmp_path / "aside", 1, range(SCAN + 7, FRAMES))
    assert main(with_both(folder, tmp_path / "run", front=front, aside=aside)) == 0
    run = load_run(tmp_path / "run")
    pose_from, reasons = (column(tmp_path / "run", name) for name in ("pose_from", "reason"))
    exact = truth["wedge"]["camera_from_object"][run.frames]
    apart = np.linalg.norm(run.camera_from_object[:, :3, 3] - exact[:, :3, 3], axis=1)
    assert apart.max() < MAP_ERROR
    for row, frame in enumerate(run.frames):
        is_hidden = frame >= SCAN + 7
        assert (run.status[row], pose_from[row]) == (("hidden", "map") if is_hidden else ("tracked", "points and map"))
        assert ("camera 0: hidden" in reasons[row]) == (frame >= SCAN + 2)
        if not is_hidden:
            true = truth["wedge"]["parameters"][frame]
            np.testing.assert_allclose(run.parameters[row], true, atol=0.4e-3)


def test_an_object_moved_before_two_cameras_is_followed_by_its_points(recording):
    """The map's pose is shifted, as if the object had been pushed by 20 mm."""
    folder, truth = recording
    start = folder / "wedge" / "registration.json"
    (placed,) = placed_objects(
        frames=folder / "front",
        other_cameras=(folder / "aside",),
        camera=folder / "camchain.yaml#cam0",
        model=folder / "wedge.morph",
        registration=start,
    )
    sources = [open_source(folder / name, SCAN - 1, SCAN + 5) for name in ("front", "aside")]
    rig, anchor = placed.new_tracker(), new_anchor([placed])
    results = []
    for front, aside in zip(*sources, strict=True):
        known = anchor.locate(front.image, front.index, front.timestamp)[0][placed.name]
        if front.index >= SCAN + 1:
            pose = known.pose
            there = RigidTransform(pose.rotation, pose.translation + pose.rotation @ [0.02, 0.0, 0.0])
            known = replace(known, pose=there)
        results.append(rig.track([front.image, aside.image], CameraLocalization(known)))
        exact = truth["wedge"]["camera_from_object"][front.index][:3, 3]
        assert np.linalg.norm(results[-1].pose.translation - exact) < MAP_ERROR
    assert [result.pose_from for result in results] == ["points and map"] * 2 + ["points"] * 5
    # Three frames on end make it sure.
    assert [result.warning(ObjectMoved) is not None for result in results] == [False] * 4 + [True] * 3


def renumbered(source, target, shift, last=FRAMES):
    target.mkdir()
    for path in sorted(source.iterdir()):
        if int(path.stem) < last:
            (target / f"{int(path.stem) + shift:06}.png").symlink_to(path)
    return target


def test_recordings_that_do_not_go_together_are_refused(recording, tmp_path, refused):
    folder, _ = recording
    later = renumbered(folder / "front", tmp_path / "later", 1)
    assert "map's keyframe" in refused(*with_both(folder, tmp_path / "run", front=later))
    beside = renumbered(folder / "aside", tmp_path / "beside", 20)
    assert f"frame {SCAN - 1} is not in" in refused(*with_both(folder, tmp_path / "run", aside=beside))


@pytest.mark.slow
def test_another_recording_than_the_scan_begins_with_an_undeformed_frame(recording, tmp_path, refused):
    folder, truth = recording
    front, aside = (renumbered(folder / name, tmp_path / name, 100) for name in ("front", "aside"))
    arguments = with_both(folder, tmp_path / "run", front=front, aside=aside)
    arguments[arguments.index("--range") + 1] = f"{SCAN + 99}-{FRAMES + 99}"
    assert "name a frame of these recordings in which it is undeformed" in refused(*arguments)
    assert main([*arguments, "--reference-frame", f"{SCAN + 97}"]) == 0
    run = load_run(tmp_path / "run")
    assert run.frames[0] == SCAN + 99
    assert set(run.status) == {"tracked"}
    expected = truth["wedge"]["parameters"][run.frames - 100]
    np.testing.assert_allclose(run.parameters, expected, atol=0.5e-3)
    exact = truth["wedge"]["camera_from_object"][run.frames - 100, :3, 3]
    apart = np.abs(run.camera_from_object[:, :3, 3] - exact)
    assert apart.max() < MAP_ERROR
    assert (apart < 3.0 * column(tmp_path / "run", "pose_std")[:, 3:]).all()


def test_after_a_shorter_recording_the_run_goes_on_and_it_is_named(recording, tmp_path, capsys, refused):
    folder, _ = recording
    front = renumbered(folder / "front", tmp_path / "front", 0, last=SCAN + 5)
    short = renumbered(folder / "aside", tmp_path / "short", 0, last=SCAN + 2)
    arguments = with_both(folder, tmp_path / "run", front=front, aside=short)
    assert f"frame {FRAMES - 1} is not in" in refused(*arguments)
    arguments[arguments.index("--range") + 1] = f"{SCAN - 1}-"
    assert main(arguments) == 0
    run = load_run(tmp_path / "run")
    assert (run.frames[-1], set(run.status)) == (SCAN + 4, {"tracked"})
    assert "camera 1 lacks 3" in capsys.readouterr().out


def live_command(folder, output, *more):
    arguments = [folder / "front", "--camera", folder / "camera.yaml", "--range", f"{SCAN - 1}-{FRAMES - 1}"]
    arguments += ["--model", folder / "sheet.morph", "--registration", folder / "sheet" / "adjusted.json"]
    arguments += [*also(folder, "wedge", folder / "wedge" / "adjusted.json"), "-o", output]
    return ["live", *map(str, [*arguments, *more])]


@pytest.fixture
def unhurried(monkeypatch):
    """Each frame of a recording that plays live comes when the one before is done, however busy the machine is."""
    done, begun = Semaphore(0), monotonic()

    class Times(LiveTimes):
        def __call__(self, tracked):
            super().__call__(tracked)
            done.release()

    slowly = partial(PacedRecording, clock=lambda: begun, sleep=lambda seconds: done.acquire(timeout=60.0))
    monkeypatch.setattr(sources, "PacedRecording", slowly)
    monkeypatch.setattr(track_module, "LiveTimes", Times)


@pytest.mark.slow
def test_two_objects_are_tracked_live_in_one_map(recording, unhurried, tmp_path, capsys, refused):
    folder, truth = recording
    run = tmp_path / "run"
    assert "--show displacement" in refused(*live_command(folder, run))
    assert not run.exists()
    assert main(live_command(folder, run, "--show", "displacement")) == 0
    said = capsys.readouterr().out
    assert f"wrote {run / 'wedge'}" in said
    frames = np.arange(SCAN - 1, FRAMES)
    assert said.count(f"tracked={len(frames)}/{len(frames)} fps=") == 2
    for name, output in (("sheet", run), ("wedge", run / "wedge")):
        np.testing.assert_array_equal(load_run(output).frames, frames)
        # The keyframes' poses are 0.28 mm off.
        assert errors(folder, truth, name, output).max() < 0.6e-3
        assert set(column(output, "pose_from")) == {"points and map"}
        summary = json.loads((output / "summary.json").read_text())
        assert summary["live"]["n_dropped"] == 0
    # There is one picture of both.
    capture = cv2.VideoCapture(str(run / "augmented.mp4"))
    assert int(capture.get(cv2.CAP_PROP_FRAME_COUNT)) == frames[-1] - frames[0] + 1
    capture.release()
    assert not (run / "wedge" / "augmented.mp4").exists()


def result_of(folder, truth, name, frame):
    model, of_object = load_model(folder / f"{name}.morph"), truth[name]
    pose = RigidTransform.from_matrix(of_object["camera_from_object"][frame])
    state, size = State(of_object["parameters"][frame], pose), len(model.parameters)
    estimate = Estimate(state, 1.0, np.zeros((0, 2)), 0.3, np.eye(size + 6), np.zeros(size, dtype=bool), 1, True)
    return FrameResult(model, Status.TRACKED, estimate)


def drawn_area(folder, truth, name, frame):
    """Where the object is in the picture, without its rim."""
    nodes, camera = exact_nodes(folder, truth, name, frame), RIG[0].camera
    triangles = load_model(folder / f"{name}.morph").triangles
    drawn = rasterise(camera.project(nodes), nodes[:, 2], triangles, camera.height, camera.width).covered
    return cv2.erode(drawn.astype(np.uint8), np.ones((7, 7), np.uint8)) > 0


def test_the_nearest_object_is_drawn_over_the_others(recording):
    folder, truth = recording
    models = {name: load_model(folder / f"{name}.morph") for name in ("wedge", "sheet")}
    drawing, camera = DrawOptions("displacement"), RIG[0].camera
    picture = AugmentedPicture(camera, {name: AugmentedView(model, camera, drawing) for name, model in models.items()})
    frame = Frame(FRAMES - 1, 0.0, np.full((360, 480, 3), 90, np.uint8))
    results = {name: result_of(folder, truth, name, FRAMES - 1) for name in models}
    lost = {name: FrameResult(model, Status.LOST) for name, model in models.items()}

    def drawn(**changes):
        return picture.draw(frame, results | changes).astype(int)

    together, only_sheet, only_wedge = drawn(), drawn(wedge=lost["wedge"]), drawn(sheet=lost["sheet"])
    both = np.logical_and(*(drawn_area(folder, truth, name, FRAMES - 1) for name in models))
    assert both.sum() > 1000
    away = [np.abs(together - only)[both].mean() for only in (only_wedge, only_sheet)]
    assert away[0] < 0.6 * away[1]
    beside = drawn_area(folder, truth, "sheet", FRAMES - 1) & ~both
    beside[:, 400:] = False  # the colour bar
    wedge = cv2.dilate((np.abs(only_wedge - 90).sum(axis=2) > 0).astype(np.uint8), np.ones((5, 5))) > 0
    np.testing.assert_array_equal(together[beside & ~wedge], only_sheet[beside & ~wedge])
    # Only where it says so is a picture without any object different.
    changed = np.argwhere(np.abs(drawn(**lost) - 90).sum(axis=2) > 0)
    assert len(changed)
    assert changed[:, 0].min() > 330


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[pose]\nposition_mm = [0, 0, 400]\nrotation_deg = [0, 0, 0]\n", "needs the number of its frame"),
        (
            "frame = 3\n[pose]\nposition_mm = [0, 0, 400]\nrotation_deg = [0, 0, 0]\n[parameters]\nbend = 1\n",
            "undeformed",
        ),
        ("frame = 9999\n[pose]\nposition_mm = [0, 0, 400]\nrotation_deg = [0, 0, 0]\n", "frame 9999 has no pose"),
        ("frame = 3\n[pose]\nposition_mm = [0, 0, -400]\nrotation_deg = [0, 0, 0]\n", "out of the image"),
    ],
)
def test_guesses_that_a_map_cannot_use_are_refused(recording, tmp_path, refused, text, message):
    folder, _ = recording
    guess = tmp_path / "guess.toml"
    guess.write_text(text)
    register = ["register", folder / "map.h5", "--model", folder / "wedge.morph", "--camera", folder / "camera.yaml"]
    assert message in refused(*map(str, [*register, "--guess", guess, "-o", tmp_path / "place"]))
    assert not (tmp_path / "place").exists()
