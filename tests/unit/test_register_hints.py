"""What `register` and `morph register` make of hints, empty maps and files that are there already."""

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest

from morph_dslam.camera import Camera
from morph_dslam.errors import RegistrationError, RegistrationFailure
from morph_dslam.geometry import RigidTransform
from morph_dslam.io.trajectory import Trajectory
from morph_dslam.registration import register as register_module
from morph_dslam.registration.register import register, run_registration
from morph_dslam.registration.registration import Registration
from morph_dslam.registration.registration_file import load_registration
from morph_dslam.slam.rigid_map import Keyframe, RigidMap
from morph_dslam.slam.scene import Scene
from morph_dslam.tracking.state import State
from tests.support.bent_sheet import bent_sheet_model

CAMERA = Camera(640, 480, 600, 600, 319.5, 239.5)
WIDE = Camera(640, 480, 330.0, 330.0, 319.5, 239.5, (-0.2, 0.03, 0.0, 0.0))
FISHEYE = Camera(640, 480, 245.0, 245.0, 319.5, 239.5, (0.0, 0.0, 0.0, 0.0), "fisheye")


def scene_of(*keyframes):
    rigid_map = RigidMap()
    for each in keyframes:
        rigid_map.add_keyframe(each)
    return Scene(CAMERA, rigid_map, Trajectory(np.empty(0), np.empty((0, 4, 4))))


def blank(index=0):
    return Keyframe(index, 0.0, np.zeros((480, 640), np.uint8), np.eye(4), np.empty(0, np.int64), np.empty((0, 2)))


def test_in_a_map_without_points_an_object_is_not_found():
    with pytest.raises(RegistrationError) as caught:
        register(scene_of(blank()), bent_sheet_model(8, 6))
    assert caught.value.reason is RegistrationFailure.NOT_FOUND


@pytest.mark.parametrize("distance", [-1.0, 0.0, float("nan")])
def test_a_distance_that_is_none_is_refused(distance):
    with pytest.raises(RegistrationError, match="distance"):
        register(scene_of(blank()), bent_sheet_model(8, 6), distance=distance)


def test_what_is_unknown_is_written_in_json_and_read(tmp_path):
    """As four landmarks of a sheet with three parameters leave it: they show not how exact they are."""
    model, path = bent_sheet_model(8, 6), tmp_path / "registration.json"
    covariance = np.full((9, 9), np.inf)
    facts = {"from": "landmarks", "sigma_px": np.inf, "n_landmarks": 4}
    Registration(model, State(model.default, RigidTransform.identity()), covariance, facts=facts).save(path)
    # Strictly: other programs' parsers know no Infinity.
    json.loads(path.read_text(), parse_constant=lambda name: pytest.fail(f"{name} is not JSON"))
    read = load_registration(path, model)
    assert read.facts == facts
    np.testing.assert_array_equal(read.covariance, covariance)


@pytest.mark.parametrize("camera", [WIDE, FISHEYE])
def test_a_box_is_drawn_in_the_image_as_recorded(monkeypatch, camera):
    given = []
    monkeypatch.setattr(register_module, "register_in_unit", lambda *arguments: given.append(arguments[7]) or 1 / 0)
    with pytest.raises(ZeroDivisionError):
        register(replace(scene_of(blank()), camera=camera), bent_sheet_model(8, 6), region=(0, (435, 295, 525, 385)))
    (hints,) = given
    across, along = (axis.ravel() for axis in np.meshgrid(np.linspace(435, 525, 91), np.linspace(295, 385, 91)))
    undistort = cv2.fisheye.undistortPoints if camera is FISHEYE else cv2.undistortPoints
    pixels = np.column_stack([across, along])[:, None]
    seen = undistort(pixels, camera.matrix, np.array(camera.distortion), P=camera.matrix)[:, 0]
    np.testing.assert_allclose(hints.region[1], [*seen.min(axis=0), *seen.max(axis=0)], atol=0.5)


def test_the_picture_of_an_earlier_registration_goes_and_one_that_cannot_be_written_is_told(monkeypatch, tmp_path):
    model = bent_sheet_model(8, 6)
    start = Registration(model, State(model.default, RigidTransform.identity()))
    for name, given in (("load_camera", CAMERA), ("load_model", model), ("load_scene", None)):
        monkeypatch.setattr(register_module, name, lambda *_, given=given: given)
    for name in ("register", "register_board"):
        monkeypatch.setattr(register_module, name, lambda *_, **__: start)
    picture = np.full((4, 4, 3), 200, np.uint8)
    monkeypatch.setattr(register_module, "draw_registration", lambda *_: picture)
    files = ("map.h5", "sheet.morph", "camera.yaml", tmp_path)
    run_registration(*files)
    assert (tmp_path / "registration.jpg").is_file()
    run_registration(*files, board="board.toml", overwrite=True)
    assert [path.name for path in tmp_path.iterdir()] == ["registration.json"]
    (tmp_path / "registration.jpg").mkdir()
    with pytest.raises(RegistrationError, match=r"registration\.jpg"):
        run_registration(*files, overwrite=True)
