"""The camera by the points of a tracked object; pixels are OpenCV's projections of an exact motion."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from morph_dslam.camera import Camera
from morph_dslam.geometry import RigidTransform
from morph_dslam.model.reduced_model import spread_over
from morph_dslam.studies.rigid import build_rigid
from morph_dslam.tracking.camera_check import CameraCheck
from morph_dslam.tracking.refinement import Keyframe
from morph_dslam.tracking.state import BoundPoints, State
from tests.support.bent_sheet import bent_sheet_model

CAMERA = Camera(640, 480, 600.0, 600.0, 320.0, 240.0)
CUBE = """v -50 -50 -50\nv -50 50 -50\nv 50 -50 -50\nv 50 50 -50\nv -50 -50 50\nv -50 50 50\nv 50 -50 50\nv 50 50 50
f 1 2 4 3\nf 5 7 8 6\nf 1 5 6 2\nf 3 4 8 7\nf 1 3 7 5\nf 2 6 8 4
"""


@pytest.fixture(scope="module")
def points(tmp_path_factory):
    """Points all over a cube of 100 mm."""
    folder = tmp_path_factory.mktemp("cube")
    (folder / "cube.obj").write_text(CUBE)
    model = build_rigid(folder / "cube.obj", "mm", folder / "cube.morph")
    nodes = model.positions(model.default)
    return BoundPoints.from_surface(model, spread_over(nodes, model.triangles, 300))


def checked(points, given, turn):
    """The check after 60 frames in which the cube turns to and fro by so much, rad; its poses fit the given camera."""
    check, rng = CameraCheck(given, deforms=False), np.random.default_rng(0)
    for k in range(60):
        axis = turn * np.array([np.sin(0.11 * k), np.sin(0.17 * k + 0.4), 0.3 * np.sin(0.07 * k)])
        rotation, place = Rotation.from_rotvec(axis), np.array([0.04 * np.sin(0.1 * k), 0.0, 0.3])
        pixels = cv2.projectPoints(points.rest, rotation.as_rotvec(), place, CAMERA.matrix, None)[0][:, 0]
        pixels = pixels + 0.2 * rng.standard_normal(pixels.shape)
        _, spin, shift = cv2.solvePnP(points.rest, pixels, given.matrix, None)
        spin, shift = np.asarray(spin, dtype=np.float64).ravel(), np.asarray(shift, dtype=np.float64).ravel()
        pose = RigidTransform(Rotation.from_rotvec(spin).as_matrix(), shift)
        seen = (rotation.apply(points.rest)[:, 2] < 0.0).astype(float)
        check.add(k / 30.0, points, Keyframe(pixels, seen, State(np.empty(0), pose), 0.2))
    estimate = check.estimate()
    assert estimate is not None
    return estimate


@pytest.mark.parametrize(("factor", "wrong"), [(1.0, set()), (1.1, {"focal"}), (0.9, {"focal"})])
def test_a_turning_object_shows_the_focal_length(points, factor, wrong):
    estimate = checked(points, replace(CAMERA, fx=600.0 * factor, fy=600.0 * factor), turn=0.6)
    assert {term for term, found in estimate.terms.items() if found.is_wrong and found.is_observable} == wrong
    assert estimate.terms["focal"].is_observable
    assert estimate.terms["focal"].estimated[0] == pytest.approx(600.0, rel=0.03)


def test_a_still_object_shows_nothing(points):
    estimate = checked(points, replace(CAMERA, fx=660.0, fy=660.0), turn=0.0)
    assert not estimate.terms["focal"].is_observable
    assert not any(found.is_wrong and found.is_observable for found in estimate.terms.values())


def test_nothing_seen_gives_no_estimate():
    assert CameraCheck(CAMERA, deforms=True).estimate() is None


def of_sheet(bound, given, believed, tells):
    """The check after 40 frames of a sheet that arches and turns; its arch is ``believed`` times the true one.

    ``tells`` : whether the check is told by how much the sheet would move if the arch were off by a tenth.
    """
    check, rng = CameraCheck(given, deforms=True), np.random.default_rng(1)

    def place(arch):
        return bound.rest + bound.field.value(np.array([arch, 0.0, 0.0]))

    for k in range(40):
        turn = np.sin(0.3 * k)
        axis, arch = np.array([0.1 * np.sin(0.2 * k), 0.25 * turn, 0.0]), 0.03 + 0.02 * turn**2
        shift = np.array([0.02 * np.sin(0.3 * k), 0.0, 0.5])
        seen = cv2.projectPoints(place(arch), axis, shift, CAMERA.matrix, None)[0][:, 0]
        seen = seen + 0.1 * rng.standard_normal(seen.shape)
        found = place(believed * arch)
        _, spin, moved = cv2.solvePnP(found, seen, given.matrix, None, axis, shift.copy(), True)
        spin, moved = np.ravel(spin).astype(float), np.ravel(moved).astype(float)
        state = State(
            np.array([believed * arch, 0.0, 0.0]), RigidTransform(Rotation.from_rotvec(spin).as_matrix(), moved)
        )
        there, larger = (
            cv2.projectPoints(points, spin, moved, given.matrix, None)[0][:, 0]
            for points in (found, place(1.1 * believed * arch))
        )
        errors = (larger - there)[:, :, None]
        keyframe = Keyframe(seen, np.ones(len(seen)), state, 0.1)
        check.add(k / 30.0, bound, keyframe, (lambda errors=errors: errors) if tells else None)
    return check.estimate()


@pytest.fixture(scope="module")
def sheet():
    model = bent_sheet_model()
    return BoundPoints.from_surface(model, spread_over(model.nodes, model.triangles, 200))


def test_an_error_of_the_deformation_that_was_to_be_expected_is_no_wrong_camera(sheet):
    """With an arch that is nine tenths of the true one, as by a coarse mesh and a sensor that tells its load."""
    unaware = of_sheet(sheet, CAMERA, 0.9, tells=False).terms["focal"]
    aware = of_sheet(sheet, CAMERA, 0.9, tells=True).terms["focal"]
    assert abs(unaware.estimated[0] - 600.0) > 3.0 * unaware.std[0]
    assert abs(aware.estimated[0] - 600.0) < 2.6 * aware.std[0]
    assert not aware.is_wrong


@pytest.mark.parametrize("factor", [0.9, 1.1])
def test_a_wrong_camera_is_named_with_such_errors_to_be_expected(sheet, factor):
    focal = of_sheet(sheet, replace(CAMERA, fx=600.0 * factor, fy=600.0 * factor), 1.0, tells=True).terms["focal"]
    assert focal.is_wrong
    assert focal.is_observable
