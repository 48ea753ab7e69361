"""Where a registered object is: its file, its pose in a camera found in the map, and points that it takes."""

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import block_diag
from scipy.spatial.transform import Rotation

from morph_dslam.camera import Camera
from morph_dslam.errors import RegistrationError
from morph_dslam.geometry import RigidTransform, SimilarityTransform, rotation_exp
from morph_dslam.io.camera_files import save_camera
from morph_dslam.model import ReducedModel, SeparatedField, save_model
from morph_dslam.model.functions import ParameterFunctions
from morph_dslam.registration.mesh import register_mesh
from morph_dslam.registration.messages import (
    Ambiguity,
    Ambiguous,
    AngleOpen,
    AtBound,
    MeshOffSurface,
    TurnArbitrary,
    read_warning,
)
from morph_dslam.registration.register import (
    mesh_error_factors,
    mesh_off_surface,
    run_registration,
    with_mesh_error,
    without_points_on,
)
from morph_dslam.registration.registration import (
    Axis,
    KeyframePose,
    MapRegistration,
    Registration,
    Rival,
    registration_in_map,
)
from morph_dslam.registration.registration_file import load_registration
from morph_dslam.registration.scene import View, views_apart
from morph_dslam.slam.pose import PoseEstimate
from morph_dslam.slam.rigid_map import GOOD, Keyframe, RigidMap
from morph_dslam.tracking.anchoring import Anchor, points_on_object
from morph_dslam.tracking.depth_scale import DepthScale
from morph_dslam.tracking.state import State, moved
from tests.support.bent_sheet import bent_sheet_model
from tests.support.bent_tube import bent_tube
from tests.support.rendered_object import CAMERA, scanned, wedge
from tests.support.staged_scenes import bending_wedge

CENTRE = np.array([0.01, 0.02, 0.05])
SHEET = bent_sheet_model(7, 5)


def shifted(x):
    return RigidTransform(np.eye(3), np.array([x, 0.2, 0.5]))


def in_map(model, centre=(0.0, 0.0, 0.0), axis=None, warnings=()):
    """A registration with two keyframes, of which the later one has a pose of its own."""
    placed = MapRegistration(
        SimilarityTransform(2.0, np.eye(3), np.array([1.0, 2.0, 3.0])), np.array(centre), 1e-8 * np.eye(7)
    )
    keyframes = [KeyframePose(7, shifted(0.1), 1e-6 * np.eye(6), 1e-3 * np.eye(6)), KeyframePose(3, shifted(0.0))]
    facts = {"from": "map", "score": 50.0, "runner_up_score": 45.0, "rms_px": 0.1, "map_units_per_metre": 2.0}
    return registration_in_map(model, placed, keyframes, facts, warnings, axis)


def test_the_stated_deviations_are_those_of_the_middle_of_the_object():
    model = bent_tube()
    centre = model.nodes.mean(axis=0)
    pose = RigidTransform(rotation_exp(np.array([0.3, -0.4, 0.2])), np.array([0.05, -0.02, 0.6]))
    distance = float(np.linalg.norm(pose.apply(centre)))

    def stated(variances, own=None):
        placed = MapRegistration(SimilarityTransform.identity(), centre, np.diag(variances))
        return registration_in_map(model, placed, [KeyframePose(3, pose, own)], {}, ()).pose_deviations()

    # One percent of size is one of distance; a turn about the middle leaves it where it is.
    assert stated([1e-4, 0, 0, 0, 0, 0, 0]) == pytest.approx((0.01 * distance, 0.0), abs=1e-9)
    assert stated([0, 4e-4, 1e-4, 1e-4, 0, 0, 0]) == pytest.approx((0.0, 0.02), abs=1e-9)
    # A keyframe's own covariance is one of a turn about the object's origin and a shift of it.
    own = np.diag([1e-4, 1e-4, 1e-4, 4e-6, 4e-6, 4e-6])
    assert stated(np.zeros(7), own) == pytest.approx((np.sqrt(4e-6 + 1e-4 * centre @ centre), 0.01))


def test_a_mesh_that_is_off_its_surface_makes_the_place_less_exact():
    """One that is 3 % smaller in volume is 1 % smaller, and so the object seems 1 % nearer."""
    tube = bent_tube()
    assert mesh_off_surface(tube) is None
    model = replace(tube, certificate={**tube.certificate, "mesh_deviation": {"volume": -0.03, "mean_m": 2e-4}})
    off, centre = mesh_off_surface(model), model.nodes.mean(axis=0)
    assert off is not None
    assert off == MeshOffSurface(-0.03, 2e-4)
    assert read_warning(off.content()) == off
    pose = RigidTransform(rotation_exp(np.array([0.3, -0.4, 0.2])), np.array([0.05, -0.02, 0.6]))
    away, radius = np.linalg.norm(pose.apply(centre)), np.sqrt(np.trace(np.cov(model.nodes.T, bias=True)))
    expected = pytest.approx((np.hypot(0.01 * away, 2e-4), 2e-4 / radius))
    exact = MapRegistration(SimilarityTransform(2.0, np.eye(3), np.zeros(3)), centre, np.zeros((7, 7)))
    for view in (KeyframePose(3, pose), KeyframePose(3, pose, np.zeros((6, 6)), np.zeros((6, 8)))):
        found, views = with_mesh_error(exact, [view], mesh_error_factors(off, model.nodes, 2.0))
        assert registration_in_map(model, found, views, {}, ()).pose_deviations() == expected
    assert views[0].error_factors @ views[0].error_factors.T == pytest.approx(views[0].covariance)


def test_views_from_the_most_different_sides_are_chosen():
    """Around a point at 1 m: two that are nearly the same, one a quarter round, and two between."""
    image, none = np.zeros((2, 2), np.uint8), np.empty(0, dtype=np.int64)
    views = []
    for frame, degrees in ((0, 0.0), (2, 1.0), (58, 90.0), (70, 50.0), (80, 30.0)):
        turn = rotation_exp(np.array([0.0, np.radians(degrees), 0.0]))
        pose = RigidTransform(turn, np.array([0.0, 0.0, 1.0]))
        views.append(View(frame, image, pose, none, np.empty((0, 2))))
    point = np.zeros(3)
    assert [view.frame for view in views_apart(views, point, 2, kept=58)] == [0, 58]
    assert [view.frame for view in views_apart(views, point, 3, kept=2)] == [2, 58, 70]
    assert [view.frame for view in views_apart(views, point, 9)] == [0, 2, 58, 70, 80]


def test_a_rigid_body_of_revolution_is_placed_up_to_its_turn(tmp_path):
    """A cup from a drawing: whether its nodes fall on themselves does not matter, and its turn is no parameter."""
    tube = bent_tube()
    nodes = tube.nodes + np.random.default_rng(0).normal(scale=1e-4, size=tube.nodes.shape)
    constant = ParameterFunctions(np.empty(0), np.empty(0), np.zeros((1, 0), dtype=np.int64), np.ones((1, 1)))
    still = SeparatedField(np.zeros((1, len(nodes), 3)), constant)
    cup = ReducedModel("cup", nodes, tube.triangles, (), still)
    pose = RigidTransform(rotation_exp(np.array([0.3, -0.4, 0.2])), np.array([0.05, -0.02, 0.6]))
    # Known to 0.01 rad but for the turn about the axis, which is not known at all.
    covariance = block_diag(0.0, np.diag([1e-4, 1e-4, 4.0]), np.zeros((3, 3)))
    placed = MapRegistration(SimilarityTransform.identity(), nodes.mean(axis=0), covariance)
    axis = Axis(np.zeros(3), np.array([0.0, 0.0, 1.0]))
    saved = registration_in_map(cup, placed, [KeyframePose(7, pose)], {}, (), axis)
    assert (saved.per_sequence, saved.warnings) == ((), (TurnArbitrary(),))
    assert saved.pose_deviations() == pytest.approx((0.0, 0.01), abs=1e-6)
    saved.save(tmp_path / "registration.json")
    read = load_registration(tmp_path / "registration.json", cup)
    assert read.warnings == (TurnArbitrary(),)
    assert read.model.parameters == ()


def test_a_registration_in_a_map_is_read_as_it_was_saved(tmp_path):
    axis = Axis(np.array([0.0, 0.0, 0.05]), np.array([0.0, 0.0, 1.0]))
    saved = in_map(bent_tube(), (0.0, 0.0, 0.05), axis, [Ambiguous(Ambiguity.SECOND_PLACE, 0.9)])
    rival = Rival(SimilarityTransform(1.5, rotation_exp(np.array([0.3, -0.2, 1.0])), np.array([3.0, 2.0, 1.0])), 45.0)
    saved = replace(saved, rivals=(rival,))
    saved.save(tmp_path / "place" / "registration.json", tmp_path / "scan" / "map.h5", tmp_path / "tube.morph")
    read = load_registration(tmp_path / "place" / "registration.json", bent_tube())
    assert read.frame == 7
    np.testing.assert_array_equal(read.state.camera_from_object.matrix, shifted(0.1).matrix)
    np.testing.assert_array_equal(read.covariance, saved.covariance)
    assert read.facts == saved.facts
    assert read.warnings == saved.warnings == (Ambiguous(Ambiguity.SECOND_PLACE, 0.9), AngleOpen("turn"))
    assert read.per_sequence == (read.model.parameters[-1].name,) == ("turn",)
    assert [view.frame for view in read.views] == [7]
    (again,) = read.rivals
    np.testing.assert_allclose(again.world_from_object.matrix, rival.world_from_object.matrix, rtol=0, atol=1e-15)
    assert again.score == 45.0
    content = json.loads((tmp_path / "place" / "registration.json").read_text())
    assert (content["map"], content["model"]) == ("../scan/map.h5", "../tube.morph")
    assert content["ambiguous"]
    (tmp_path / "file").write_text("")
    with pytest.raises(RegistrationError, match="file"):
        saved.save(tmp_path / "file" / "registration.json")


def test_a_registration_in_a_frame_is_read_as_it_was_saved(tmp_path):
    state = State(SHEET.default + 0.01, shifted(0.3))
    other = State(SHEET.default - 0.02, shifted(0.4))
    saved = Registration(
        SHEET,
        state,
        2.0 * np.eye(9),
        facts={"from": "landmarks", "depth_scale": {"factor": 0.98, "std": 0.003}},
        warnings=(AtBound("arch"),),
        alternatives=(other,),
        depth_scale=DepthScale(0.98, 0.003),
    )
    saved.save(tmp_path / "registration.json")
    read = load_registration(tmp_path / "registration.json", SHEET)
    np.testing.assert_array_equal(read.state.parameters, state.parameters)
    np.testing.assert_array_equal(read.state.camera_from_object.matrix, state.camera_from_object.matrix)
    np.testing.assert_array_equal(read.covariance, saved.covariance)
    assert (read.frame, read.facts, read.warnings) == (None, saved.facts, saved.warnings)
    # Depths are multiplied by the factor, and a pose for all frames is sought from the other states too.
    assert read.depth_scale == DepthScale(0.98, 0.003)
    (again,) = read.alternatives
    np.testing.assert_array_equal(again.parameters, other.parameters)
    np.testing.assert_array_equal(again.camera_from_object.matrix, other.camera_from_object.matrix)


def test_an_earlier_file_without_other_states_is_read(tmp_path):
    path = tmp_path / "registration.json"
    Registration(SHEET, State(SHEET.default, shifted(0.3))).save(path)
    content = json.loads(path.read_text())
    path.write_text(json.dumps({key: value for key, value in content.items() if key != "alternatives"}))
    read = load_registration(path, SHEET)
    assert (read.alternatives, read.depth_scale) == ((), None)


def test_an_earlier_file_that_does_not_name_its_own_keyframe_has_the_last_one(tmp_path):
    path = tmp_path / "registration.json"
    in_map(SHEET).save(path)
    content = json.loads(path.read_text())
    for named, frame in (({"frame": 3}, 3), ({}, 7)):
        path.write_text(json.dumps({key: value for key, value in content.items() if key != "frame"} | named))
        assert load_registration(path, SHEET).frame == frame


@pytest.mark.parametrize(
    "wrong",
    [
        {"depth_scale": {"factor": 0.0, "std": 0.01}},
        {"depth_scale": {"factor": 1.0, "std": -0.01}},
        {"depth_scale": {"factor": 1.0}},
        {"depth_scale": 1.0},
        {"alternatives": [{"parameters": [0.0], "camera_from_object": np.eye(4).tolist()}]},
        {"alternatives": [{}]},
    ],
)
def test_damaged_registrations_in_a_frame_are_refused(tmp_path, wrong):
    path = tmp_path / "registration.json"
    Registration(SHEET, State(SHEET.default, shifted(0.3))).save(path)
    path.write_text(json.dumps(json.loads(path.read_text()) | wrong))
    with pytest.raises(RegistrationError, match=r"registration\.json"):
        load_registration(path, SHEET)


def test_damaged_registrations_are_refused(tmp_path):
    path = tmp_path / "registration.json"
    in_map(SHEET).save(path)
    content = json.loads(path.read_text())
    keyframe = content["keyframes"][0]
    for wrong in (
        {"world_from_object": [1, 2]},
        {"world_from_object": np.diag([1.0, 1.0, 1.1, 1.0]).tolist()},
        {"world_from_object": np.diag([1e300, 1.0, 1.0, 1.0]).tolist()},
        {"map_units_per_metre": 0.0},
        {"mean_node_m": [1, 2]},
        {"mean_node_m": -3},
        {"covariance": np.eye(6).tolist()},
        {"covariance": (np.eye(7) * np.nan).tolist()},
        {"axis_of_revolution": "z"},
        {"axis_of_revolution": {"direction": [0, 1]}},
        {"warnings": [{"kind": "nothing"}]},
        {"rivals": [{"world_from_object": np.eye(4).tolist(), "map_units_per_metre": 2.0, "score": 1.0}]},
        {"rivals": [{}]},
        {"frame": 4},
        {"frame": "last"},
        {"frame": np.inf},
        {"frame": 7.6},
        {"map_renumbered": [np.inf]},
        {"map_renumbered": [True, 3]},
        {"keyframes": []},
        {"keyframes": [keyframe | {"frame": 3.7}]},
        {"keyframes": [keyframe | {"frame": True}]},
        {"keyframes": [keyframe | {"camera_from_object": [[1.0]]}]},
        {"keyframes": [keyframe | {"covariance": [[1.0]]}]},
    ):
        path.write_text(json.dumps(content | wrong))
        with pytest.raises(RegistrationError, match=r"registration\.json"):
            load_registration(path, SHEET)
    for text in ("{}", "[]", "nothing"):
        path.write_text(text)
        with pytest.raises(RegistrationError, match=r"registration\.json"):
            load_registration(path, SHEET)
    with pytest.raises(RegistrationError, match=r"none\.json"):
        load_registration(tmp_path / "none.json", SHEET)


def test_a_registration_of_another_object_is_refused(tmp_path):
    path, size = tmp_path / "registration.json", np.linalg.norm(np.ptp(SHEET.nodes, axis=0))
    in_map(SHEET, (0.08 * size, 0.0, 0.0)).save(path)
    assert load_registration(path, SHEET).frame == 7
    in_map(SHEET, (0.0, 0.2 * size, 0.0)).save(path)
    with pytest.raises(RegistrationError, match=rf"{200 * size:.1f} mm apart"):
        load_registration(path, SHEET)


def similarity(rng):
    return SimilarityTransform(2.3, rotation_exp(rng.normal(size=3)), rng.normal(size=3))


def camera_pose(rng):
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation_exp(rng.normal(size=3)), [0.1, 0.2, 1.5]
    return pose


def test_a_point_of_the_object_is_seen_where_the_map_has_it():
    """Its direction in the camera is that of its place in the map; its distance is that in metres."""
    rng = np.random.default_rng(0)
    placed, pose = similarity(rng), camera_pose(rng)
    known = MapRegistration(placed, CENTRE, np.eye(7) * 1e-8).pose_prior(
        PoseEstimate(pose, np.eye(6) * 1e-8, np.ones(5, dtype=bool), 0.3)
    )
    points = 0.1 * rng.normal(size=(6, 3))
    in_map_units = placed.apply(points) @ pose[:3, :3].T + pose[:3, 3]
    np.testing.assert_allclose(known.pose.apply(points), in_map_units / 2.3, atol=1e-12)
    step = 0.1 * rng.normal(size=6)
    there = moved(State(np.zeros(0), known.pose), step).camera_from_object
    np.testing.assert_allclose(known.away(there), step, atol=1e-12)


def test_the_covariance_is_that_of_samples():
    """30 000 registrations and cameras with normally distributed errors, moved one by one."""
    rng = np.random.default_rng(1)
    placed, pose = similarity(rng), camera_pose(rng)
    of_place = np.diag(rng.uniform(1.0, 3.0, 7)) * 1e-8
    of_place[0, 3] = of_place[3, 0] = 0.8e-8
    of_camera = np.diag(rng.uniform(1.0, 3.0, 6)) * 1e-8
    found = PoseEstimate(pose, of_camera, np.ones(5, dtype=bool), 0.3)
    known = MapRegistration(placed, CENTRE, of_place).pose_prior(found)
    middle, away = placed.apply(CENTRE), []
    for place_error, camera_error in zip(
        rng.multivariate_normal(np.zeros(7), of_place, 30_000),
        rng.multivariate_normal(np.zeros(6), of_camera, 30_000),
        strict=True,
    ):
        scale = placed.scale * np.exp(place_error[0])
        rotation = rotation_exp(place_error[1:4]) @ placed.rotation
        shift = middle + place_error[4:] - scale * rotation @ CENTRE
        turn = rotation_exp(camera_error[:3])
        camera_rotation = turn @ pose[:3, :3]
        camera_shift = turn @ pose[:3, 3] + camera_error[3:]
        sample = RigidTransform(camera_rotation @ rotation, (camera_rotation @ shift + camera_shift) / scale)
        away.append(known.away(sample))
    expected = np.cov(np.array(away).T)
    np.testing.assert_allclose(known.covariance, expected, atol=0.03 * np.abs(expected).max())
    lasting = known.lasting @ known.lasting.T
    assert (np.linalg.eigvalsh(known.covariance - lasting) > 0.0).all()


def sheet_map():
    """A sheet of 420 mm that turns about one end, points along it, and points off it, in map units."""
    sheet = bent_sheet_model(5, 3)
    powers = np.array([[0, 0, 0], [1, 0, 0]])
    functions = ParameterFunctions(-np.ones(3), np.ones(3), powers, np.array([[0.0], [1.0]]))
    lift = np.zeros((1, len(sheet.nodes), 3))
    lift[0, :, 2] = 0.1 * (sheet.nodes[:, 0] + 0.21)
    parameters = tuple(replace(p, lower=-1.0, upper=1.0, default=0.0) for p in sheet.parameters)
    model = replace(sheet, displacement=SeparatedField(lift, functions), parameters=parameters)
    x = np.concatenate([np.linspace(-0.2, 0.2, 41), np.linspace(-0.2, 0.2, 10)])
    points = np.column_stack([x, np.zeros(51), np.r_[np.zeros(41), np.full(10, -0.03)]])
    place = MapRegistration(
        SimilarityTransform(3.0, rotation_exp(np.array([0.3, -0.2, 0.5])), np.array([1.0, 2.0, 3.0])),
        np.zeros(3),
        np.eye(7) * 1e-8,
    )
    return model, place, place.world_from_object.apply(points), x


def test_only_what_can_move_is_taken_out_of_the_scene():
    model, place, positions, x = sheet_map()
    on_object, movable = points_on_object(positions, place, model)
    # The sheet is 514 mm large. What lies 30 mm off it is not on it; what moves by less than 2.6 mm does not
    # move: that is 39 mm from the end at two thirds of the largest turn. Samples are a few mm apart.
    assert on_object[:41].all()
    assert not on_object[41:].any()
    assert movable[:41][x[:41] > -0.165].all()
    assert not movable[:41][x[:41] < -0.177].any()


def test_an_anchor_keeps_the_scene_and_needs_to_know_how_well_the_place_is_known():
    model, place, positions, _ = sheet_map()
    camera = Camera(320, 240, 300.0, 300.0, 160.0, 120.0)
    rigid_map = RigidMap()
    ids = rigid_map.add_points(positions, np.zeros((51, 2)), 0, GOOD)
    normalized = np.full((240, 320), 128, dtype=np.uint8)
    rigid_map.add_keyframe(Keyframe(0, 0.0, normalized, np.eye(4), ids, np.zeros((51, 2))))
    expected = points_on_object(positions, place, model)[1]
    blind = MapRegistration(place.world_from_object, place.centre, None)
    with pytest.raises(RegistrationError, match="registration"):
        Anchor(rigid_map, camera, {"sheet": (blind, model)})
    assert blind.pose_covariance(RigidTransform.identity()) is None
    with pytest.raises(RegistrationError, match="'sheet' and 'again'"):
        Anchor(rigid_map, camera, {"sheet": (place, model), "again": (place, model)})
    anchor = Anchor(rigid_map, camera, {"sheet": (place, model)})
    assert (anchor.n_movable, anchor.n_scene) == (expected.sum(), (~expected).sum())
    np.testing.assert_array_equal(anchor.slam.map.good, ids[~expected])
    np.testing.assert_array_equal(rigid_map.good, ids)  # what it was made from is left alone


WORLD = SimilarityTransform(1.0, Rotation.from_rotvec([0.4, -0.9, 1.3]).as_matrix(), np.array([0.5, -1.2, 2.0]))
PLACES = (np.array([-0.08, 0.0, 0.0]), np.array([0.08, 0.03, 0.0]))


def true_place(number):
    return WORLD @ SimilarityTransform(1.0, np.eye(3), PLACES[number])


def first_wedge():
    model = bending_wedge()
    return Registration(
        model,
        State(model.default, shifted(0.0)),
        map_registration=MapRegistration(true_place(0), model.nodes.mean(axis=0), None),
        keyframes=(KeyframePose(0, shifted(0.0)),),
    )


@pytest.mark.slow
def test_the_second_of_two_alike_is_found_beside_the_first():
    """Without the first one's registration it could be either (`test_mesh_registration`)."""
    nodes, triangles, _ = wedge()
    rest = without_points_on([first_wedge()], *scanned(WORLD, objects=PLACES))
    second = register_mesh(nodes, triangles, *rest, CAMERA, metric=True)
    assert not second.ambiguous
    off = (true_place(1).inverse @ second.world_from_object).apply(nodes) - nodes
    assert np.linalg.norm(off, axis=1).max() < 1.5e-3


def test_the_points_on_an_object_are_left_to_it_and_no_others():
    points, views = scanned(WORLD, objects=PLACES, noise=0.0)
    left, seen = without_points_on([first_wedge()], points, views)
    lows, highs = PLACES[0], PLACES[0] + [0.09, 0.06, 0.07]
    local = WORLD.inverse.apply(points.positions)
    raised = local[:, 2] > 5e-3
    of_first = raised & ((local > lows - 1e-6) & (local < highs + 1e-6)).all(axis=1)
    assert of_first.sum() > 100
    rest = WORLD.inverse.apply(left.positions)
    # All raised points are gone that lie in the first one's box, and none of the second's.
    assert (rest[:, 2] > 5e-3).sum() == (raised & ~of_first).sum()
    for view, before in zip(seen, views, strict=True):
        kept = np.isin(before.point_ids, np.flatnonzero(np.isin(points.positions, left.positions).all(axis=1)))
        np.testing.assert_array_equal(left.positions[view.point_ids], points.positions[before.point_ids[kept]])
        np.testing.assert_array_equal(view.pixels, before.pixels[kept])


def test_an_object_beside_that_is_of_another_map_is_refused(tmp_path):
    save_camera(tmp_path / "camera.yaml", CAMERA)
    save_model(tmp_path / "wedge.morph", first_wedge().model)
    files = (tmp_path / "map.h5", tmp_path / "wedge.morph", tmp_path / "camera.yaml", tmp_path)
    first_wedge().save(tmp_path / "other.json", tmp_path / "other.h5", tmp_path / "wedge.morph")
    with pytest.raises(RegistrationError, match=r"other\.h5"):
        run_registration(*files, beside=[tmp_path / "other.json"])
    with pytest.raises(RegistrationError, match="beside"):
        run_registration(*files, beside=[tmp_path / "other.json"], board=tmp_path / "board.toml")
