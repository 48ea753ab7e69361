"""Registration by landmarks: exact recovery, every way in which it can be wrong, and the files of landmarks."""

import re
from dataclasses import replace

import cv2
import numpy as np
import pytest
import trimesh

from morph_dslam.camera import Camera
from morph_dslam.errors import ArgumentError, RegistrationError, RegistrationFailure
from morph_dslam.geometry import RigidTransform, rotation_exp, rotation_log
from morph_dslam.io.camera_files import save_camera
from morph_dslam.io.landmarks import Landmarks, load_landmarks, save_landmarks
from morph_dslam.model import save_model
from morph_dslam.registration.landmarks import register_landmarks
from morph_dslam.registration.messages import (
    Ambiguity,
    Ambiguous,
    AtBound,
    FewLandmarks,
    NotAtRest,
    PoorFit,
    Underdetermined,
)
from morph_dslam.registration.registration_file import load_registration
from morph_dslam.registration.starts import shape_starts, solve_pnp
from morph_dslam.sources import Frame
from morph_dslam.studies.rigid import build_rigid
from morph_dslam.tracking.estimator import State
from morph_dslam.tracking.rig import RigCamera
from morph_dslam.tracking.setup import TrackedObject
from tests.support.bent_sheet import bent_sheet_model
from tests.support.measured_points import bound_points
from tests.support.rendered_sequence import CAMERA

POSE = RigidTransform(
    rotation_exp(np.array([0.25, -0.3, 0.1])) @ np.diag([1.0, -1.0, -1.0]), np.array([0.02, -0.01, 0.6])
)
BENT = State(np.array([0.040, 0.25, -0.12]), POSE)
MODEL = bent_sheet_model(22, 16)


def landmarks(state=BENT, count=14, noise=0.0):
    """Object points at mesh nodes and their pixels in ``state``."""
    nodes = np.random.default_rng(1).choice(len(MODEL.nodes), count, replace=False)
    pixels = CAMERA.project(state.camera_from_object.apply(MODEL.positions(state.parameters))[nodes])
    return Landmarks(MODEL.nodes[nodes], pixels + noise * np.random.default_rng(0).standard_normal(pixels.shape))


def test_bent_object_is_found_exactly_without_a_start():
    found = register_landmarks(MODEL, CAMERA, landmarks())
    np.testing.assert_allclose(found.state.parameters, BENT.parameters, atol=1e-6)
    np.testing.assert_allclose(found.state.camera_from_object.matrix, POSE.matrix, atol=1e-6)
    assert found.facts["residual_rms_px"] < 1e-4
    assert found.warnings == ()


def test_a_start_close_by_leads_to_the_same_minimum():
    few = landmarks(noise=0.5)
    near = register_landmarks(MODEL, CAMERA, Landmarks(few.points[:9], few.pixels[:9])).state
    assert np.abs(near.parameters - BENT.parameters).max() > 1e-3
    found = register_landmarks(MODEL, CAMERA, landmarks(), near=near)
    np.testing.assert_allclose(found.state.parameters, BENT.parameters, atol=1e-6)
    np.testing.assert_allclose(found.state.camera_from_object.matrix, POSE.matrix, atol=1e-6)


def test_bend_the_other_way_is_distinguished():
    other = State(BENT.parameters * [-1, 1, 1], POSE)
    found = register_landmarks(MODEL, CAMERA, landmarks(other, noise=0.3))
    assert found.state.parameters[0] == pytest.approx(-0.040, abs=3e-3)


def test_distorted_pixels_are_undistorted():
    lens = Camera(640, 480, 528.0, 528.0, 320.0, 240.0, (-0.2, 0.05, 0.0, 0.0))
    exact = landmarks()
    x, y = ((exact.pixels - [320.0, 240.0]) / 528.0).T
    r2 = x**2 + y**2
    bent = 1 - 0.2 * r2 + 0.05 * r2**2
    recorded = np.column_stack([x * bent, y * bent]) * 528.0 + [320.0, 240.0]
    found = register_landmarks(MODEL, lens, Landmarks(exact.points, recorded))
    np.testing.assert_allclose(found.state.parameters, BENT.parameters, atol=1e-4)


def test_landmarks_that_cannot_be_right_are_named():
    points, pixels = landmarks().points.copy(), landmarks().pixels.copy()
    points[4, 2] += 0.020
    with pytest.raises(RegistrationError, match=r"landmark 5 at .* is 20.0 mm off"):
        register_landmarks(MODEL, CAMERA, Landmarks(points, pixels))
    pixels[2] = [700.0, 100.0]
    with pytest.raises(RegistrationError, match=r"landmark 3 has the pixel \(700, 100\)"):
        register_landmarks(MODEL, CAMERA, Landmarks(landmarks().points, pixels))
    with pytest.raises(RegistrationError, match="3 landmarks"):
        register_landmarks(MODEL, CAMERA, Landmarks(points[:3], pixels[:3]))


def test_landmarks_may_be_lists():
    exact = landmarks()
    found = register_landmarks(MODEL, CAMERA, Landmarks(exact.points.tolist(), exact.pixels.tolist()), at_rest=False)
    np.testing.assert_allclose(found.state.parameters, BENT.parameters, atol=1e-6)
    for points, pixels in (([[0.0, 0.0]], [[1.0, 2.0]]), ([[0.0] * 3], [[1.0, 2.0]] * 2), ([["a"] * 3], [[1.0, 2.0]])):
        with pytest.raises(RegistrationError, match="of landmarks"):
            Landmarks(points, pixels)


def test_landmarks_that_are_not_finite_are_named():
    exact = landmarks()
    for name, off in (("points", np.nan), ("pixels", np.nan), ("points", np.inf)):
        given = {"points": exact.points.copy(), "pixels": exact.pixels.copy()}
        given[name][3, 1] = off
        with pytest.raises(RegistrationError, match=f"{name} of landmark 4"):
            Landmarks(**given)


@pytest.mark.parametrize("frames", [[1.5] * 14, [-1] * 14, [np.inf] * 14, [1] * 13])
def test_frames_of_landmarks_are_whole_numbers(frames):
    exact = landmarks()
    with pytest.raises(RegistrationError, match="frame"):
        Landmarks(exact.points, exact.pixels, frames)


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (("notch.morph", CAMERA, landmarks()), "load_model"),
        ((MODEL, "camera.yaml", landmarks()), "load_camera"),
        ((MODEL, CAMERA, []), r"Landmarks\(points, pixels\)"),
        ((MODEL, CAMERA, landmarks().points), r"Landmarks\(points, pixels\)"),
    ],
)
def test_arguments_of_another_kind_are_named(arguments, named):
    with pytest.raises(ArgumentError, match=named):
        register_landmarks(*arguments)


def test_a_registration_is_shown_in_one_line():
    shown = repr(register_landmarks(MODEL, CAMERA, Landmarks(landmarks().points[:4], landmarks().pixels[:4])))
    assert "by landmarks" in shown
    assert "arch=" in shown
    assert "1 warnings" in shown
    assert len(shown) < 200
    warning = Underdetermined(numbers=8, unknowns=9, enough=7)
    assert str(warning) == warning.text


def test_landmarks_in_the_wrong_order_do_not_fit():
    with pytest.raises(RegistrationError) as caught:
        register_landmarks(MODEL, CAMERA, Landmarks(landmarks().points, landmarks().pixels[::-1]))
    assert caught.value.reason is RegistrationFailure.LANDMARKS_DO_NOT_FIT


def test_barely_enough_landmarks_are_flagged():
    found = register_landmarks(MODEL, CAMERA, Landmarks(landmarks().points[:4], landmarks().pixels[:4]))
    assert found.warnings == (Underdetermined(numbers=8, unknowns=9, enough=7),)
    assert found.facts["residual_rms_px"] < 0.1


@pytest.mark.parametrize(("count", "is_said"), [(7, True), (8, False)])
def test_few_landmarks_do_not_show_how_exact_they_are(count, is_said):
    """Of 9 unknowns, 7 landmarks leave 5 numbers, which fit by chance better than the clicks are exact."""
    found = register_landmarks(MODEL, CAMERA, landmarks(count=count))
    assert found.warnings == ((FewLandmarks(7, 0.5, 8),) if is_said else ())


def test_shape_beyond_the_range_is_flagged():
    found = register_landmarks(MODEL, CAMERA, landmarks(State(np.array([0.068, 0.25, -0.12]), POSE)))
    assert AtBound("arch") in found.warnings


def test_an_object_that_is_undeformed_at_an_end_of_the_range_may_be_there():
    arch, *others = MODEL.parameters
    model = replace(MODEL, parameters=(replace(arch, default=arch.upper), *others))
    found = register_landmarks(model, CAMERA, landmarks(State(np.array([arch.upper + 0.002, 0.25, -0.12]), POSE)))
    assert found.state.parameters[0] == pytest.approx(arch.upper, abs=3e-3)
    assert not [warning for warning in found.warnings if isinstance(warning, AtBound)]


def test_bend_that_landmarks_cannot_decide_is_ambiguous():
    """A long way off the image of a shallow arch is nearly the same for both signs of a mirrored pose."""
    far = Camera(640, 480, 9000.0, 9000.0, 320.0, 240.0)
    positions = RigidTransform(POSE.rotation, np.array([0.0, 0.0, 12.0])).apply(
        MODEL.positions(np.array([0.02, 0.0, 0.0]))
    )
    nodes = np.random.default_rng(1).choice(len(MODEL.nodes), 9, replace=False)
    found = register_landmarks(MODEL, far, Landmarks(MODEL.nodes[nodes], far.project(positions[nodes])))
    assert Ambiguous(Ambiguity.SHAPES, found.facts["n_alternatives"] + 1) in found.warnings
    assert found.ambiguous


def test_start_shapes_cover_the_box():
    shapes = np.array(shape_starts(MODEL))
    assert len(shapes) == 1 + 3**3
    np.testing.assert_allclose(shapes[0], MODEL.default)
    np.testing.assert_allclose(shapes.min(axis=0), MODEL.lower + (MODEL.upper - MODEL.lower) / 6)
    assert len(shape_starts(MODEL, largest=5)) == 1 + 2 * 3


def test_pnp_returns_the_pose_of_a_flat_and_of_a_bent_shape():
    for parameters in (np.zeros(3), BENT.parameters):
        points = MODEL.positions(parameters)[np.random.default_rng(1).choice(len(MODEL.nodes), 8, replace=False)]
        poses = solve_pnp(points, CAMERA.project(POSE.apply(points)), CAMERA)
        assert min(np.abs(pose.matrix - POSE.matrix).max() for pose in poses) < 1e-4


def test_landmarks_between_nodes_are_bound_to_their_triangle():
    bound = bound_points(MODEL, 12, seed=2)
    found = register_landmarks(MODEL, CAMERA, Landmarks(bound.rest, CAMERA.project(bound.in_camera(BENT))))
    np.testing.assert_allclose(found.state.parameters, BENT.parameters, atol=1e-6)


HEADER = "x_mm,y_mm,z_mm,u_px,v_px\n"


def test_written_landmarks_are_read_back_in_metres(tmp_path):
    path = tmp_path / "landmarks.csv"
    save_landmarks(path, Landmarks(np.array([[-0.21, 0.1485, 0.002]]), np.array([[172.125, 74.25]])))
    assert path.read_text() == HEADER + "-210,148.5,2,172.1250,74.2500\n"
    read = load_landmarks(path)
    np.testing.assert_allclose(read.points, [[-0.21, 0.1485, 0.002]])
    np.testing.assert_allclose(read.pixels, [[172.125, 74.25]])


def test_spreadsheet_habits_are_accepted(tmp_path):
    path = tmp_path / "landmarks.csv"
    path.write_text("\ufeffx_mm, y_mm, z_mm, u_px, v_px\r\n1,2,3,4,5\r\n\r\n", encoding="utf-8")
    np.testing.assert_allclose(load_landmarks(path).points, [[0.001, 0.002, 0.003]])


@pytest.mark.parametrize(
    ("content", "named"),
    [
        ("a,b\n1,2\n", "x_mm"),
        ("", "x_mm"),
        (HEADER + "1,2,3,4\n", "landmark 1 is '1,2,3,4'"),
        (HEADER + "1,2,3,4,5\n1,2,x,4,5\n", "landmark 2"),
        (HEADER + "1,2,nan,4,5\n", "landmark 1"),
        ("frame," + HEADER + "3,1,2,3,4,5\n12.7,1,2,3,4,5\n", r"landmarks\.csv.*landmark 2 is of frame 12\.7"),
        ("frame," + HEADER + "-3,1,2,3,4,5\n", "landmark 1 is of frame -3"),
        (None, r"landmarks\.csv"),
    ],
)
def test_wrong_files_are_refused(tmp_path, content, named):
    path = tmp_path / "landmarks.csv"
    if content is not None:
        path.write_text(content)
    with pytest.raises(RegistrationError, match=named):
        load_landmarks(path)


def test_an_object_at_rest_has_the_pose_that_opencv_finds():
    model = bent_sheet_model(15, 11)
    pose = RigidTransform(
        rotation_exp(np.array([0.3, -0.2, 0.1])) @ np.diag([1.0, -1.0, -1.0]), np.array([0.02, 0, 0.8])
    )
    camera = Camera(640, 480, 600.0, 600.0, 320.0, 240.0)
    points = np.ascontiguousarray(model.nodes[::7])
    pixels = camera.project(pose.apply(points)) + 0.5 * np.random.default_rng(2).standard_normal((len(points), 2))
    found = register_landmarks(model, camera, Landmarks(points, pixels), at_rest=True)
    _, rotation, translation = cv2.solvePnP(points, pixels, camera.matrix, None)
    state, d = found.state, len(model.parameters)
    assert state.parameters == pytest.approx(model.default, abs=1e-12)
    assert np.rad2deg(
        rotation_log(state.camera_from_object.rotation @ rotation_exp(rotation.ravel()).T)
    ) == pytest.approx(np.zeros(3), abs=0.02)
    assert state.camera_from_object.translation == pytest.approx(translation.ravel(), abs=2e-4)
    assert not found.covariance[:d].any()
    away = state.camera_from_object.translation - pose.translation
    assert (np.abs(away) < 4.0 * np.sqrt(np.diag(found.covariance)[d + 3 :])).all()


def test_an_object_that_is_not_at_rest_is_named_with_what_the_landmarks_alone_give(tmp_path):
    """Clicks of 0.5 px on a sheet that is arched by 25 mm; in a file it stands as well."""
    arched = landmarks(State(np.array([0.025, 0.0, 0.0]), POSE), noise=0.5)
    found = register_landmarks(MODEL, CAMERA, arched, at_rest=True)
    found.save(tmp_path / "registration.json")
    assert load_registration(tmp_path / "registration.json", MODEL).warnings == found.warnings
    (said,) = found.warnings
    assert isinstance(said, NotAtRest)
    name, value, unit = said.parameters.replace("=", "").split()
    assert (name, float(value), unit) == ("arch", pytest.approx(25.0, abs=1.5), "mm")
    assert said.free_px == pytest.approx(0.5, rel=0.4)
    assert said.sigma_px > 2.0 * said.free_px


def test_landmarks_on_a_line_of_an_object_at_rest_are_refused():
    row = np.flatnonzero(np.abs(MODEL.nodes[:, 1] - MODEL.nodes[8 * 22, 1]) < 1e-9)[::3]
    pixels = CAMERA.project(POSE.apply(MODEL.nodes[row]))
    pixels += 0.5 * np.random.default_rng(1).standard_normal(pixels.shape)
    with pytest.raises(RegistrationError, match="on one line"):
        register_landmarks(MODEL, CAMERA, Landmarks(MODEL.nodes[row], pixels), at_rest=True)


@pytest.mark.parametrize("seed", range(6))
def test_landmarks_close_to_a_line_have_the_deviation_of_the_turn_about_it(seed):
    """One of seven is 20 mm beside the line of the others."""
    row = np.flatnonzero(np.abs(MODEL.nodes[:, 1] - MODEL.nodes[8 * 22, 1]) < 1e-9)[::3].copy()
    row[3] += 22
    pixels = CAMERA.project(POSE.apply(MODEL.nodes[row]))
    pixels += 0.5 * np.random.default_rng(seed).standard_normal(pixels.shape)
    found = register_landmarks(MODEL, CAMERA, Landmarks(MODEL.nodes[row], pixels), at_rest=True)
    line, d = POSE.rotation[:, 0], len(MODEL.parameters)
    turn = rotation_log(found.state.camera_from_object.rotation @ POSE.rotation.T) @ line
    deviation = np.sqrt(line @ found.covariance[d : d + 3, d : d + 3] @ line)
    assert abs(turn) < 4.0 * deviation
    assert np.deg2rad(1.0) < deviation < np.deg2rad(10.0)


def strip_at_rest(width_m, seed, aid=None, folder=None):
    """A strip of 420 mm at rest, half tilted about its length: the error of that turn and its deviation, rad.

    ``aid`` : "depth" or "image" of the frame, which has a pixel's noise of its own; the landmarks alone by default.
    ``folder`` : to make the model of a rigid strip in, of which nobody has to say that it is at rest.
    """
    size = np.ptp(MODEL.nodes[:, 1])
    strip = replace(MODEL, nodes=MODEL.nodes * [1.0, width_m / size, 1.0])
    known = strip
    if folder is not None:
        trimesh.Trimesh(strip.nodes, strip.triangles, process=False).export(folder / "strip.stl")
        known = build_rigid(folder / "strip.stl", "m")
    on_edges = np.flatnonzero(np.abs(MODEL.nodes[:, 1]) > 0.49 * size)[::3]
    camera = Camera(1920, 1080, 2100.0, 2100.0, 959.5, 539.5)
    turned = rotation_exp(np.array([0.6, 0.25, 0.05])) @ np.diag([1.0, -1.0, -1.0])
    pose = RigidTransform(turned, np.array([0.0, 0.0, 0.62]))
    pixels = camera.project(pose.apply(strip.nodes[on_edges]))
    pixels += 0.5 * np.random.default_rng(seed).standard_normal(pixels.shape)
    more = {} if aid is None else {aid: seen_strip(strip, camera, pose, aid)}
    given, d = Landmarks(strip.nodes[on_edges], pixels), len(known.parameters)
    found = register_landmarks(known, camera, given, at_rest=folder is None, **more)
    line, of_rotation = turned[:, 0], slice(d, d + 3)
    turn = rotation_log(found.state.camera_from_object.rotation @ turned.T) @ line
    return turn, np.sqrt(line @ found.covariance[of_rotation, of_rotation] @ line)


def seen_strip(strip, camera, pose, aid):
    """Depth (h, w) or grey image (h, w) of a flat strip, each pixel the mean of 4 x 4 rays."""
    rng, (h, w) = np.random.default_rng(0), (camera.height, camera.width)
    corners = camera.project(pose.apply(strip.nodes))
    (left, top), (right, bottom) = corners.min(axis=0).astype(int) - 3, corners.max(axis=0).astype(int) + 4
    normal, centre, half = pose.rotation[:, 2], pose.translation, 0.5 * np.ptp(strip.nodes[:, :2], axis=0)

    def distance_and_place(shift):
        """Along the rays beside the pixels' middles to the strip's plane, and where they meet it (..., 2)."""
        pixels = np.stack(np.meshgrid(np.arange(left, right), np.arange(top, bottom)), axis=-1) + shift
        rays = np.dstack([(pixels - [camera.cx, camera.cy]) / [camera.fx, camera.fy], np.ones(pixels.shape[:2])])
        distance = (normal @ centre) / (rays @ normal)
        return distance, (distance[..., None] * rays - centre) @ pose.rotation[:, :2]

    shifts = (np.indices((4, 4)).reshape(2, -1).T - 1.5) / 4.0
    share = np.mean([(np.abs(distance_and_place(shift)[1]) < half).all(axis=-1) for shift in shifts], axis=0)
    there = (slice(top, bottom), slice(left, right))
    if aid == "image":
        grey = np.full((h, w), 60.0)
        grey[there] += 120.0 * share
        return np.clip(grey + 2.0 * rng.standard_normal((h, w)), 0, 255).astype(np.uint8)
    depth = np.full((h, w), 1.5)
    depth[there] = np.where(share >= 0.5, distance_and_place(np.zeros(2))[0], 1.5)
    return (depth + 1.4e-3 * depth**2 * rng.standard_normal((h, w))).astype(np.float32)


def test_landmarks_on_both_edges_of_a_slender_object_tell_its_turn_as_exactly_as_stated():
    """13 px wide in the image: 15 landmarks, 6.3 px beside the middle, of which the sine of the tilt shows the turn."""
    turns, deviations = np.array([strip_at_rest(3.7e-3, seed) for seed in range(12)]).T
    expected = 0.5 / (6.3 * np.sqrt(15) * np.sin(0.6))
    assert np.median(deviations) == pytest.approx(expected, rel=0.3)
    assert 0.5 < np.sqrt(np.mean((turns / deviations) ** 2)) < 1.5


def test_a_narrower_one_that_is_found_in_its_mirrored_tilt_has_a_deviation_that_holds_that():
    """4 px wide: from the other side of the camera's direction, turned by 1.2, it looks the same in these clicks."""
    turn, deviation = strip_at_rest(1.2e-3, seed=17)
    assert abs(turn) > 1.0
    assert deviation > 0.5


@pytest.mark.parametrize(("width_m", "seed", "aid"), [(1.2e-3, 17, "image"), (1.6e-3, 47, "depth")])
def test_the_deviation_holds_the_mirrored_tilt_where_depth_or_outline_correct_the_clicks(width_m, seed, aid):
    """Both place the strip, and hardly tell its tilts apart."""
    turn, deviation = strip_at_rest(width_m, seed, aid)
    assert abs(turn) < 3.0 * deviation
    assert 0.2 < deviation < 1.3


def test_the_deviation_holds_the_mirrored_tilt_of_a_rigid_object_too(tmp_path):
    """It has no parameters, and is at rest whether that is said or not."""
    turn, deviation = strip_at_rest(1.6e-3, 47, "depth", tmp_path)
    assert abs(turn) > 1.0
    assert abs(turn) < 3.0 * deviation
    assert deviation < 1.3


def test_an_object_so_narrow_that_clicks_do_not_tell_its_turn_is_refused():
    with pytest.raises(RegistrationError, match="on one line"):
        strip_at_rest(0.4e-3, seed=0)


def test_landmarks_on_one_edge_of_a_rigid_object_are_refused(tmp_path):
    trimesh.creation.box(extents=(60.0, 40.0, 30.0)).export(tmp_path / "box.stl")
    box = build_rigid(tmp_path / "box.stl", "mm", tmp_path / "box.morph")
    along = np.array([-30.0, -12.0, 5.0, 20.0, 30.0])
    edge = 1e-3 * np.column_stack([along, np.full(5, 20.0), np.full(5, 15.0)])
    with pytest.raises(RegistrationError, match="on one line"):
        register_landmarks(box, CAMERA, Landmarks(edge, CAMERA.project(POSE.apply(edge))))
    beside = np.vstack([edge, 1e-3 * np.array([[0.0, -20.0, 15.0]])])
    found = register_landmarks(box, CAMERA, Landmarks(beside, CAMERA.project(POSE.apply(beside))))
    np.testing.assert_allclose(found.state.camera_from_object.matrix, POSE.matrix, atol=1e-6)


@pytest.mark.parametrize(("count", "enough"), [(4, 6), (5, 6), (6, None), (7, None)])
def test_at_rest_the_pose_alone_is_unknown(count, enough):
    """Four landmarks are 8 numbers for 6 unknowns; six leave 6 to spare, which show how exact they are."""
    some = landmarks(State(np.zeros(3), POSE), noise=0.5)
    few = Landmarks(some.points[:count], some.pixels[:count])
    said = register_landmarks(MODEL, CAMERA, few, at_rest=True).warnings
    assert [type(warning) for warning in said] == ([] if enough is None else [FewLandmarks])
    assert all(warning.enough == enough for warning in said)


def test_an_object_that_is_not_at_rest_is_named_though_its_landmarks_fit_at_rest():
    """An arch of 18 mm, seen from the front and 0.8 m away, is less than a pixel beside a pose of the flat sheet."""
    away = RigidTransform(POSE.rotation, np.array([0.02, -0.01, 0.8]))
    arched = landmarks(State(np.array([0.018, 0.0, 0.0]), away), count=20, noise=0.4)
    (said,) = register_landmarks(MODEL, CAMERA, arched, at_rest=True).warnings
    assert isinstance(said, NotAtRest)
    name, value, unit = said.parameters.replace("=", "").split()
    assert (name, float(value), unit) == ("arch", pytest.approx(18.0, abs=2.5), "mm")
    assert said.sigma_px < 1.0
    assert said.free_px == pytest.approx(0.4, rel=0.3)


#: The same field in three times as many pixels, in which landmarks may be off by 12 px before they are refused.
FINE = Camera(3 * CAMERA.width, 3 * CAMERA.height, 3 * CAMERA.fx, 3 * CAMERA.fy, 3 * CAMERA.cx, 3 * CAMERA.cy)


def clicked_in_fine(parameters, noise, seed, stretch=1.0):
    """Landmarks of the sheet, longer by a factor than its mesh, off by so many pixels of the fine picture."""
    rng = np.random.default_rng(seed)
    nodes = rng.choice(len(MODEL.nodes), 14, replace=False)
    shape = MODEL.positions(np.asarray(parameters))[nodes] * [stretch, 1.0, 1.0]
    return Landmarks(MODEL.nodes[nodes], FINE.project(POSE.apply(shape)) + noise * rng.standard_normal((14, 2)))


@pytest.mark.parametrize("seed", range(4))
def test_an_object_that_is_not_at_rest_is_named_though_the_part_differs_from_its_mesh(seed):
    """By 3 px: residuals that are as large as a load makes them count by their squares."""
    said, *_ = register_landmarks(MODEL, FINE, clicked_in_fine([0.03, 0.0, 0.0], 3.0, seed), at_rest=True).warnings
    assert isinstance(said, NotAtRest)
    named = dict(part.split(" = ") for part in said.parameters.split(", "))
    assert float(named["arch"].split()[0]) == pytest.approx(30.0, abs=12.0)


@pytest.mark.parametrize("seed", range(4))
def test_a_part_at_rest_that_is_longer_than_its_mesh_is_not_accused(seed):
    """By so much that carefully set landmarks fit to 4 px at rest."""
    found = register_landmarks(MODEL, FINE, clicked_in_fine(MODEL.default, 0.5, seed, stretch=1.06), at_rest=True)
    assert [type(warning) for warning in found.warnings] == [PoorFit]


def test_landmarks_that_a_load_explains_are_refused_as_those_of_a_load():
    """And not for the landmark that is farthest off, which is right."""
    arched = landmarks(State(np.array([0.060, 0.0, 0.0]), POSE), noise=0.5)
    with pytest.raises(RegistrationError, match=r"arch = [0-9.]+ mm.*--at-rest") as refused:
        register_landmarks(MODEL, CAMERA, arched, at_rest=True)
    named = re.search(r"arch = ([0-9.]+) mm", str(refused.value))
    assert named is not None
    assert float(named[1]) == pytest.approx(60.0, abs=1.5)


@pytest.mark.slow
@pytest.mark.parametrize("wrong", ["clicks", "one click", "lens"])
def test_small_errors_of_landmarks_at_rest_do_not_accuse_it(wrong):
    """Clicks of 1 px; of 0.4 px with one that is 4 px off; of 0.4 px with a lens that is 1 px off in the corners."""
    exact, x = landmarks(State(np.zeros(3), POSE), count=20), [CAMERA.fx, CAMERA.fy]
    for seed in range(30):
        rng, off = np.random.default_rng(seed), np.zeros((20, 2))
        if wrong == "one click":
            off[rng.integers(20), rng.integers(2)] = 4.0
        if wrong == "lens":
            rays = (exact.pixels - [CAMERA.cx, CAMERA.cy]) / x
            off = 0.005 * rays * (rays**2).sum(axis=1, keepdims=True) * x
        clicks = (1.0 if wrong == "clicks" else 0.4) * rng.standard_normal((20, 2))
        found = register_landmarks(MODEL, CAMERA, Landmarks(exact.points, exact.pixels + off + clicks), at_rest=True)
        assert not any(isinstance(said, NotAtRest) for said in found.warnings)


def test_clicks_of_an_object_at_rest_do_not_accuse_it():
    """However inexact they are: three parameters explain a part of any clicks, by chance most of it once in 1000."""
    exact, said = landmarks(State(np.zeros(3), POSE)), []
    for seed in range(8):
        off = Landmarks(exact.points, exact.pixels + 2.0 * np.random.default_rng(seed).standard_normal((14, 2)))
        said += register_landmarks(MODEL, CAMERA, off, at_rest=True).warnings
    assert [warning.sigma_px for warning in said] == [pytest.approx(2.0, rel=0.4)] * 8
    assert sum(type(warning) is NotAtRest for warning in said) <= 1


@pytest.mark.parametrize("frame", [5, -1])
def test_landmarks_of_another_frame_are_not_used_in_this_one(frame):
    """The picture of another frame does not show the object there."""
    points, pixels = np.zeros((9, 3)), np.zeros((9, 2))
    part = TrackedObject("sheet", MODEL, Landmarks(points, pixels, np.full(9, 3)))
    wanted = "set in frame 3 are used in (frame 5|the reference image)"
    for landmarks in (None, Landmarks(points, pixels, np.full(9, 3))):
        with pytest.raises(RegistrationError, match=wanted):
            part.register(
                [RigCamera(CAMERA, RigidTransform.identity())],
                [Frame(frame, 0.0, np.zeros((4, 4, 3), dtype=np.uint8))],
                landmarks,
            )


def test_landmarks_of_several_frames_are_not_used_as_of_one():
    exact = landmarks()
    two = Landmarks(exact.points, exact.pixels, np.repeat([2, 9], [4, len(exact.points) - 4]))
    with pytest.raises(RegistrationError, match="set in frames 2 and 9"):
        register_landmarks(MODEL, CAMERA, two)


def test_landmarks_to_register_anew_are_of_their_frame(tmp_path, refused):
    save_model(tmp_path / "sheet.morph", MODEL)
    save_camera(tmp_path / "camera.yaml", CAMERA)
    for name, frames in (("first.csv", None), ("later.csv", np.full(14, 5))):
        found = landmarks()
        save_landmarks(tmp_path / name, Landmarks(found.points, found.pixels, frames))
    names = {"--model": "sheet.morph", "--camera": "camera.yaml", "--landmarks": "first.csv", "-o": "run"}
    words = [word for option, name in names.items() for word in (option, tmp_path / name)]
    later = f"7={tmp_path / 'later.csv'}"
    assert "set in frame 5 are used in frame 7" in refused("track", "film", *words, "--reregister-at", later)


@pytest.mark.parametrize(("options", "used"), [([], "frame 0"), (["--reference-frame", "2"], "frame 2")])
def test_a_guess_of_another_frame_is_not_used_in_the_reference_frame(options, used, tmp_path, refused):
    save_model(tmp_path / "sheet.morph", MODEL)
    save_camera(tmp_path / "camera.yaml", CAMERA)
    (tmp_path / "film").mkdir()
    for number in range(4):
        cv2.imwrite(str(tmp_path / "film" / f"{number}.png"), np.zeros((CAMERA.height, CAMERA.width, 3), np.uint8))
    guess = "[pose]\nposition_mm = [0, 0, 600]\nrotation_deg = [180, 0, 0]\n"
    names = {"--model": "sheet.morph", "--camera": "camera.yaml", "--guess": "guess.toml", "-o": "run"}
    words = [word for option, name in names.items() for word in (option, tmp_path / name)]
    (tmp_path / "guess.toml").write_text(f"frame = 3\n{guess}")
    assert f"a guess of frame 3 is used in {used}" in refused("track", tmp_path / "film", *words, *options)
    # In its own frame, or if it names none, the picture decides: there is nothing in it.
    own = refused("track", tmp_path / "film", *words, "--reference-frame", "3")
    (tmp_path / "guess.toml").write_text(guess)
    for said in (own, refused("track", tmp_path / "film", *words, *options)):
        assert "the image contradicts the guess" in said
