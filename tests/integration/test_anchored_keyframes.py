"""Several keyframes as reference views of two objects that hide each other, against exact truth."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

import morph_dslam as md
from morph_dslam.cli.app import main
from morph_dslam.evaluation.run_folder import load_run
from morph_dslam.model import load_model
from morph_dslam.render.rasteriser import rasterise
from morph_dslam.tracking.estimator import Estimator
from morph_dslam.tracking.placement import images_from, seen_part
from morph_dslam.tracking.reference import SurfaceSamples
from morph_dslam.tracking.run_options import ObjectOptions
from tests.support.rendered_anchored_rig import FIRST_BESIDE, LEFT_FRAMES, MIRRORED_RIG, RIG, SCAN
from tests.support.tracked_rig import column, errors, exact_nodes, placed_objects

NAMES = ("sheet", "wedge")
CAMERA = RIG[0].camera


def command(folder, output, *more):
    arguments = [folder / "left", "--camera", folder / "camera.yaml", "--range", f"0-{LEFT_FRAMES - 1}"]
    arguments += ["--model", folder / "sheet.morph", "--registration", folder / "sheet" / "adjusted.json"]
    arguments += ["--also", "wedge", folder / "wedge.morph", folder / "wedge" / "adjusted.json"]
    return ["track", *map(str, [*arguments, "-o", output, "--no-video", *more])]


@pytest.mark.slow
def test_objects_are_known_by_what_other_keyframes_show_of_them(left_recording, tmp_path):
    """The last keyframe shows neither the side of the wedge that is filmed nor the sheet behind it."""
    (folder, left), mean, most = left_recording, {}, {}
    for name, more in (("one", ["--one-view"]), ("several", [])):
        assert main(command(folder, tmp_path / name, *more)) == 0
        sheet, wedge = (
            errors(folder, left, "sheet", tmp_path / name),
            errors(folder, left, "wedge", tmp_path / name / "wedge"),
        )
        mean[name], most[name] = [sheet.mean(), wedge.mean()], np.percentile(sheet, 90)
    # 0.27 and 0.41 to 0.47 mm with one view, 0.32 and 0.52 to 0.54 with several: on another machine the map differs by
    # rounding. 0.28 is what the keyframes' poses are off by.
    assert mean["several"][0] < 0.4e-3
    assert most["several"] < 1.3 * most["one"]
    assert mean["several"][1] < min(0.7e-3, 1.5 * mean["one"][1])


def placed_in(folder, names=NAMES, **more):
    """The objects by name, with all keyframes."""
    first, *others = (
        {"model": folder / f"{name}.morph", "registration": folder / name / "adjusted.json"} for name in names
    )
    files = {"frames": folder / "front", "camera": folder / "camera.yaml"} | more
    also = tuple((name, ObjectOptions(**part)) for name, part in zip(names[1:], others, strict=True))
    return dict(zip(names, placed_objects(**first, others=also, **files), strict=True))


def exact_depth(folder, truth, name, frame):
    nodes, triangles = exact_nodes(folder, truth, name, frame), load_model(folder / f"{name}.morph").triangles
    return rasterise(CAMERA.project(nodes), nodes[:, 2], triangles, CAMERA.height, CAMERA.width).depth


def wedge_before_sheet(folder, truth, frame):
    return exact_depth(folder, truth, "wedge", frame) < exact_depth(folder, truth, "sheet", frame)


def bound_points(placed):
    """The points bound in all keyframes, and in each their pixels (p, 2)."""
    reference = placed.new_tracker().reference
    places = [CAMERA.project(reference.points.in_camera(part.state)[part.rows]) for part in reference.parts]
    pixels = [np.rint(own).astype(int) for own in places]
    return reference, dict(zip(placed.reference_keyframes, pixels, strict=True))


@pytest.fixture(scope="module")
def sheets(rig_recording):
    """The sheet, with and without what the wedge occludes of it in each keyframe; and the wedge."""
    folder = rig_recording[0]
    both = placed_in(folder)
    return {"aware": both["sheet"], "unaware": placed_in(folder, ("sheet",))["sheet"], "wedge": both["wedge"]}


def test_what_another_object_occludes_in_the_keyframes_is_known(rig_recording, sheets):
    folder, truth = rig_recording
    sheet, wedge, camera = sheets["aware"], sheets["wedge"], sheets["aware"].cameras[0]
    for frame in sheet.object.keyframes:
        # The sheet lies behind the wedge everywhere.
        assert seen_part(wedge, [sheet], camera, frame) is None
        seen, occluded = seen_part(sheet, [wedge], camera, frame), wedge_before_sheet(folder, truth, frame)
        assert not (seen & occluded).any()
        shown = np.isfinite(exact_depth(folder, truth, "sheet", frame)) & ~occluded
        assert (seen & shown).sum() > 0.9 * shown.sum()


def test_nothing_is_bound_where_another_object_is_before_it_in_a_keyframe(rig_recording, sheets):
    on_wedge = dict.fromkeys(("aware", "unaware"), 0)
    for name in on_wedge:
        _, bound = bound_points(sheets[name])
        for frame, pixels in bound.items():
            # What is compared of a point reaches beyond its pixel.
            before = wedge_before_sheet(*rig_recording, frame).astype(np.uint8)
            before = cv2.dilate(before, np.ones((7, 7), np.uint8)) > 0
            on_wedge[name] += int(before[pixels[:, 1], pixels[:, 0]].sum())
    assert on_wedge["unaware"] > 20
    assert on_wedge["aware"] == 0


def test_what_is_hidden_in_the_last_keyframe_is_bound_in_another(rig_recording, sheets):
    sheet = sheets["aware"]
    reference, bound = bound_points(sheet)
    assert len(bound) > 1
    pixels = np.rint(reference.projected(sheet.registration.state)).astype(int)
    inside = ((pixels >= 0) & (pixels < [CAMERA.width, CAMERA.height])).all(axis=1)
    hidden, before = (np.zeros(len(pixels), dtype=bool), wedge_before_sheet(*rig_recording, sheet.frame))
    hidden[inside] = before[pixels[inside, 1], pixels[inside, 0]]
    assert hidden.sum() > 50


def test_what_is_hidden_does_not_count_as_shown_by_the_reference_view(rig_recording, sheets):
    sheet, last = sheets["aware"], sheets["aware"].frame
    reference, bound = bound_points(replace(sheet, keyframes=None))
    assert list(bound) == [last]
    samples, state = SurfaceSamples(Estimator(sheet.model, CAMERA), reference.surface), sheet.registration.state
    share = np.abs(reference.shown(samples)).sum() / np.abs(samples.seen(state, reference.depth(state))).sum()
    covered = np.isfinite(exact_depth(*rig_recording, "sheet", last))
    hidden = wedge_before_sheet(*rig_recording, last) & covered
    assert hidden.sum() > 0.15 * covered.sum()
    # An object hides a margin of 5 pixels too.
    assert abs(share - (1.0 - hidden.sum() / covered.sum())) < 0.08


@pytest.mark.slow
def test_each_camera_of_a_rig_knows_the_object_by_its_own_pictures_of_the_scan(mirrored_recording, tmp_path):
    """In the last keyframe neither camera shows the side of the wedge that the first one films then."""
    (folder, truth), mean = mirrored_recording, {}
    files = {"frames": folder / "both", "other_cameras": (folder / "mirrored",)}
    placed = placed_in(folder, ("wedge",), **files, camera=f"{folder}/camchain_mirrored.yaml#cam0")["wedge"]
    for further, part in zip(placed.keyframes, MIRRORED_RIG, strict=True):
        assert further.views
        for view in further.views:
            exact = part.camera_from_rig.apply(exact_nodes(folder, truth, "wedge", view.frame))
            nodes = view.state.camera_from_object.apply(placed.model.positions(view.state.parameters))
            assert np.linalg.norm(nodes - exact, axis=1).max() < 0.4e-3
    arguments = [folder / "both", "--with", folder / "mirrored", "--camera", f"{folder}/camchain_mirrored.yaml#cam0"]
    arguments += ["--model", folder / "wedge.morph", "--registration", folder / "wedge" / "adjusted.json"]
    arguments += ["--range", f"{SCAN}-{SCAN + LEFT_FRAMES - 1}", "--no-video", "-o"]
    for name, more in (("one", ["--one-view"]), ("several", [])):
        assert main(["track", *map(str, [*arguments, tmp_path / name, *more])]) == 0
        mean[name] = errors(folder, truth, "wedge", tmp_path / name).mean()
    # 0.33 to 0.43 and 0.27 mm, by how rounding moves the map.
    assert mean["several"] < min(0.35e-3, 0.9 * mean["one"])
    run, apart = load_run(tmp_path / "several"), truth["wedge"]["parameters"][SCAN:]
    std = column(tmp_path / "several", "parameter_std")
    assert (np.abs(run.parameters - apart) < 3.0 * std + 0.02e-3).all()


def test_a_camera_has_those_pictures_of_the_scan_that_it_filmed(rig_recording):
    """The second camera's recording begins in the midst of the scan."""
    folder = rig_recording[0]
    files = {"frames": folder / "front", "other_cameras": (folder / "aside",)}
    placed = placed_in(folder, ("wedge",), **files, camera=f"{folder}/camchain.yaml#cam0")["wedge"]
    keyframes = sorted(placed.object.keyframes)
    filmed = [number for number in keyframes if number >= FIRST_BESIDE]
    assert 1 < len(filmed) < len(keyframes)
    assert sorted(images_from(md.open_source(folder / "aside"), RIG[1].camera, keyframes)) == filmed
    assert {view.frame for view in placed.keyframes[1].views} <= set(filmed)
