"""Several anchored objects in one map, and an anchored object before several cameras, against exact truth."""

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest

from morph_dslam.cli.app import main
from morph_dslam.evaluation.run_folder import load_run
from morph_dslam.geometry import RigidTransform
from morph_dslam.io.landmarks import Landmarks, save_landmarks
from morph_dslam.model import load_model
from morph_dslam.sources import open_source
from morph_dslam.tracking.multi_camera import RigTracker
from morph_dslam.tracking.outcomes import ObjectMoved
from morph_dslam.tracking.result import STAGES
from morph_dslam.tracking.setup import ObjectOptions, load_setup
from morph_dslam.tracking.tracker import CameraLocalization
from tests.support.rendered_anchored_rig import FRAMES, RIG, SCAN
from tests.support.tracked_rig import column, errors, exact_nodes

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
    assert main(command(folder, run, *also(folder, "wedge"))) == 0
    assert capsys.readouterr().out.count(f"tracked={FRAMES - SCAN + 1}/{FRAMES - SCAN + 1}") == 2
    for name, output in (("sheet", run), ("wedge", run / "wedge")):
        assert errors(folder, truth, name, output).max() < MAP_ERROR
        assert set(column(output, "pose_from")) == {"points and map"}
    expected = {name: truth[name]["parameters"][SCAN - 1 :] for name in truth}
    np.testing.assert_allclose(load_run(run).parameters[:, 0], expected["sheet"][:, 0], atol=0.3e-3)
    np.testing.assert_allclose(load_run(run / "wedge").parameters, expected["wedge"], atol=0.5e-3)
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


def test_registrations_of_different_maps_are_refused(recording, tmp_path, capsys):
    folder, _ = recording
    other = tmp_path / "other.h5"
    other.write_bytes((folder / "map.h5").read_bytes())
    start = changed(folder / "wedge" / "registration.json", tmp_path / "wedge.json", map=str(other))
    assert main(command(folder, tmp_path / "run", *also(folder, "wedge", start))) == 2
    assert "the objects are anchored in different maps" in capsys.readouterr().err


def test_a_registration_that_has_the_object_elsewhere_is_refused(recording, tmp_path, capsys):
    folder, _ = recording
    path = folder / "wedge" / "registration.json"
    matrix = np.array(json.loads(path.read_text())["world_from_object"])
    matrix[0, 3] += 0.5
    start = changed(path, tmp_path / "wedge.json", world_from_object=matrix.tolist())
    assert main(command(folder, tmp_path / "run", *also(folder, "wedge", start))) == 2
    assert "is not the map of the registration: by the map the object is" in capsys.readouterr().err


def test_objects_in_the_same_place_are_refused(recording, tmp_path, capsys):
    folder, _ = recording
    twice = ["--also", "twin", folder / "sheet.morph", folder / "sheet" / "registration.json"]
    assert main(command(folder, tmp_path / "run", *twice)) == 2
    assert "are registered in the same place of the map" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("more", "message"),
    [
        (["--reference-frame", "30"], "brings its own reference frame"),
        (["--refine"], "leave out --refine and --reregister-at"),
        (["--reregister-at", "40=wedge.csv"], "leave out --refine and --reregister-at"),
    ],
)
def test_what_does_not_fit_several_objects_is_refused(recording, tmp_path, capsys, more, message):
    folder, _ = recording
    assert main(command(folder, tmp_path / "run", *also(folder, "wedge"), *more)) == 2
    assert message in capsys.readouterr().err


def with_both(folder, output, *more, first="wedge", front=None, aside=None):
    arguments = command(folder, output, *more, first=first, camera="camchain.yaml#cam0")
    arguments[1] = str(front or folder / "front")
    return [*arguments, "--with", str(aside or folder / "aside")]


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
    options = ObjectOptions(
        folder / "wedge.morph", folder / "camera.yaml", registration=folder / "wedge" / "registration.json"
    )
    setup = load_setup(options)
    registration = setup.registration
    chain = setup.new_tracker(registration, setup.reference, in_sequence=False)
    sources = [open_source(folder / name, SCAN - 1, SCAN + 5) for name in ("front", "aside")]
    beside = next(iter(open_source(folder / "aside", registration.frame, registration.frame))).image
    rig = RigTracker(registration.model, RIG, [setup.reference, beside], registration.state, in_sequence=False)
    results = []
    for front, aside in zip(*sources, strict=True):
        known = chain.locate(front).pose_prior
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


def test_recordings_that_do_not_go_together_are_refused(recording, tmp_path, capsys):
    folder, _ = recording
    later = renumbered(folder / "front", tmp_path / "later", 1)
    assert main(with_both(folder, tmp_path / "run", front=later)) == 2
    assert "does not show the map's keyframe" in capsys.readouterr().err
    beside = renumbered(folder / "aside", tmp_path / "beside", 20)
    assert main(with_both(folder, tmp_path / "run", aside=beside)) == 2
    assert f"frame {SCAN - 1} is not in" in capsys.readouterr().err
    unknown = with_both(folder, tmp_path / "run")
    unknown[unknown.index("--camera") + 1] = str(folder / "camchain.yaml#cam7")
    assert main(unknown) == 2
    assert "give the first camera of a Kalibr camchain" in capsys.readouterr().err
    assert main(with_both(folder, tmp_path / "run", "--depth")) == 2
    assert "leave out --refine, --reregister-at, --depth and --discrepancy" in capsys.readouterr().err


def test_another_recording_than_the_scan_begins_with_an_undeformed_frame(recording, tmp_path, capsys):
    folder, truth = recording
    front, aside = (renumbered(folder / name, tmp_path / name, 100) for name in ("front", "aside"))
    arguments = with_both(folder, tmp_path / "run", front=front, aside=aside)
    arguments[arguments.index("--range") + 1] = f"{SCAN + 99}-{FRAMES + 99}"
    assert main(arguments) == 2
    assert "name a frame of these recordings in which it is undeformed" in capsys.readouterr().err
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


def test_a_shorter_recording_ends_the_run_and_is_named(recording, tmp_path, capsys):
    folder, _ = recording
    front = renumbered(folder / "front", tmp_path / "front", 0, last=SCAN + 5)
    short = renumbered(folder / "aside", tmp_path / "short", 0, last=SCAN + 2)
    arguments = with_both(folder, tmp_path / "run", front=front, aside=short)
    assert main(arguments) == 2
    assert f"frame {FRAMES - 1} is not in" in capsys.readouterr().err
    row = arguments.index("--range")
    assert main(arguments[:row] + arguments[row + 2 :]) == 0
    assert "frames: 9 were tracked, to the end of the shortest recording" in capsys.readouterr().out
