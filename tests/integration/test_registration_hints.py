"""Hints of where an object is in a map: loose boxes do no harm, wrong landmarks are named, and reasons are true."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from morph_dslam.camera import Camera
from morph_dslam.errors import RegistrationError, RegistrationFailure
from morph_dslam.geometry import RigidTransform, SimilarityTransform
from morph_dslam.io.landmarks import Landmarks
from morph_dslam.io.trajectory import Trajectory
from morph_dslam.registration import mesh, register as registering
from morph_dslam.registration.mesh import MeshRegistration, register_in_unit, register_mesh
from morph_dslam.registration.mesh_edges import MeshEdges
from morph_dslam.registration.messages import (
    MeshOffSurface,
    NotRefined,
    OnlyInBox,
    TooLittleTexture,
    Unrefined,
    read_warning,
)
from morph_dslam.registration.register import draw_registration, register
from morph_dslam.registration.scene import camera_from_object
from morph_dslam.registration.texture import Agreement, TextureComparison
from morph_dslam.registration.view_registration import EdgeSearch
from morph_dslam.registration.view_search import N_TURNS, EdgeDrawings, InView, overlaps
from morph_dslam.slam.rigid_map import GOOD, Keyframe, RigidMap
from morph_dslam.slam.scene import Scene
from tests.support.rendered_object import CAMERA, scanned, shaded, wedge
from tests.support.staged_scenes import bending_wedge

WORLD = SimilarityTransform(3.7, Rotation.from_rotvec([0.4, -0.9, 1.3]).as_matrix(), np.array([0.5, -1.2, 2.0]))
#: The keyframe in which hints are given.
FRAME = 4
NODES, TRIANGLES, _ = wedge()


@pytest.fixture(scope="module")
def scan():
    """Points and views of a wedge that is shaded in grey, without texture."""
    points, views = scanned(WORLD)
    return points, shaded(views, WORLD)


@pytest.fixture(scope="module")
def scene(scan):
    points, views = scan
    rigid_map = RigidMap()
    rigid_map.add_points(points.positions, np.zeros((len(points), 2)), 0, GOOD)
    for view in views:
        pose = view.camera_from_world.matrix
        rigid_map.add_keyframe(Keyframe(view.frame, 0.0, view.normalized, pose, view.point_ids, view.pixels))
    return Scene(CAMERA, rigid_map, Trajectory(np.zeros(0), np.zeros((0, 4, 4))))


@pytest.fixture(scope="module")
def searched(scene):
    """A registration without hints, and the places that its search found by edges."""
    found, search = [], EdgeSearch.search
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(EdgeSearch, "search", lambda self: found.append(search(self)) or found[-1])
        return register(scene, bending_wedge()), found[0]


@pytest.fixture(scope="module")
def unhinted(searched):
    return searched[0]


@pytest.fixture(scope="module")
def places(searched):
    return searched[1]


def seen(view, points):
    """Pixels (k, 2) of points of the object, where it is."""
    return CAMERA.project(camera_from_object(view, WORLD).apply(points))


def apart(found):
    """Largest distance of any node from where it is, metres."""
    return np.linalg.norm((WORLD.inverse @ found.map_registration.world_from_object).apply(NODES) - NODES, axis=1).max()


def box_with(margin, pixels):
    low, high = pixels.min(axis=0), pixels.max(axis=0)
    aside = margin * (high - low)
    return (*(low - aside).tolist(), *(high + aside).tolist())


def test_an_object_without_texture_is_found_by_its_edges(unhinted):
    assert not unhinted.ambiguous
    assert apart(unhinted) < 1.5e-3
    assert unhinted.map_registration.world_from_object.scale == pytest.approx(WORLD.scale, rel=0.01)


@pytest.mark.slow
@pytest.mark.parametrize("margin", [0.0, 0.1, 0.3])
def test_a_box_with_any_usual_margin_leaves_the_object_where_it_is(scan, scene, unhinted, margin):
    region, model = (FRAME, box_with(margin, seen(scan[1][FRAME], NODES))), bending_wedge()
    model = replace(model, certificate={**model.certificate, "mesh_deviation": {"volume": -0.03, "mean_m": 1e-4}})
    found = register(scene, model, region=region)
    assert not unhinted.ambiguous
    assert not found.ambiguous
    assert apart(unhinted) < 1.5e-3
    assert apart(found) < 1.5e-3
    assert found.facts["map_units_per_metre"] == pytest.approx(unhinted.facts["map_units_per_metre"], rel=0.01)
    # A mesh that is smaller by 3 % in volume makes the distance wrong by 1 %.
    away = np.linalg.norm(found.state.camera_from_object.apply(NODES.mean(axis=0)))
    assert MeshOffSurface(-0.03, 1e-4) in found.warnings
    assert found.pose_deviations()[0] > 0.01 * away > unhinted.pose_deviations()[0]


@pytest.mark.slow
def test_a_box_beside_the_object_is_named(scene):
    found = register(scene, bending_wedge(), region=(FRAME, (20.0, 220.0, 160.0, 340.0)))
    print(found.warnings, found.facts)
    assert found.ambiguous
    assert OnlyInBox(FRAME) in found.warnings


def test_boxes_of_drawings_are_those_of_the_projected_object():
    edges, rng, n = MeshEdges(NODES, TRIANGLES), np.random.default_rng(3), 200
    drawings = EdgeDrawings.of(edges)
    centre = 0.5 * (NODES.min(axis=0) + NODES.max(axis=0))
    sides, turns = rng.integers(len(drawings.rotations), size=n), rng.integers(N_TURNS, size=n)
    sizes = rng.uniform(60.0, 100.0, n)  # far away, as the drawings show it
    places = rng.uniform([190.0, 130.0], [290.0, 230.0], (n, 2))
    found = InView(drawings, centre, edges.size, CAMERA, np.zeros(n), sizes, sides, turns, places)
    projected = [CAMERA.project(found.pose(k).apply(NODES)) for k in range(n)]
    boxes = np.array([np.concatenate([pixels.min(axis=0), pixels.max(axis=0)]) for pixels in projected])
    # 48 points of the edges come near to most corners.
    off_by = np.abs(found.boxes() - boxes) / sizes[:, None]
    assert np.quantile(off_by, 0.95) < 0.08
    assert np.mean(off_by) < 0.03
    kept = sides % 2 == 0
    np.testing.assert_allclose(found.chosen(kept).boxes(), found.boxes()[kept])


def test_overlap_of_boxes_is_what_they_have_in_common_in_the_image():
    camera = Camera(100, 100, 100.0, 100.0, 50.0, 50.0)
    boxes = np.array([[10, 10, 30, 30], [20, 10, 40, 30], [0, 0, 40, 40], [60, 60, 80, 80], [-50, 10, 30, 30]])
    shares = overlaps(boxes.astype(float), (10.0, 10.0, 30.0, 30.0), camera)
    np.testing.assert_allclose(shares, [1.0, 200 / 600, 400 / 1600, 0.0, 400 / 600])


#: Corners of the object that the keyframe sees.
CORNERS = np.array([[90, 0, 0], [90, 60, 0], [0, 60, 0], [50, 10, 30], [50, 50, 45], [10, 50, 70]], dtype=float) * 1e-3


def clicks(view, unit=1.0, count=6):
    pixels = seen(view, CORNERS) + np.random.default_rng(5).normal(size=(6, 2))
    return Landmarks(unit * CORNERS[:count], pixels[:count], np.full(count, FRAME))


@pytest.mark.slow
def test_right_landmarks_lead_to_the_object(scan, scene):
    found = register(scene, bending_wedge(), landmarks=clicks(scan[1][FRAME]))
    assert not found.ambiguous
    assert apart(found) < 1.5e-3


@pytest.mark.parametrize("wrong", range(6))
def test_a_click_that_the_others_contradict_is_named(scan, scene, wrong):
    given = clicks(scan[1][FRAME])
    given.pixels[wrong] += [-60.0, 80.0]
    with pytest.raises(RegistrationError, match=rf"landmark {wrong + 1} is (9\d|10\d)\.\d px from") as caught:
        register(scene, bending_wedge(), landmarks=given)
    assert caught.value.reason is RegistrationFailure.LANDMARKS_DO_NOT_FIT


def test_the_number_of_a_wrong_click_is_that_in_its_file(scan, scene):
    given, other = clicks(scan[1][FRAME]), scan[1][1]
    given.pixels[2] += [-60.0, 80.0]
    both = Landmarks(
        np.concatenate([CORNERS[:2], given.points]),
        np.concatenate([seen(other, CORNERS[:2]), given.pixels]),
        np.concatenate([np.full(2, other.frame), given.frames]),
    )
    with pytest.raises(RegistrationError, match="landmark 5 is"):
        register(scene, bending_wedge(), landmarks=both)


def test_landmarks_that_cannot_be_right_are_refused_before_the_search(scan, scene, monkeypatch):
    monkeypatch.setattr(EdgeSearch, "search", lambda self: pytest.fail("searched"))
    view = scan[1][FRAME]

    def refused(given, match):
        with pytest.raises(RegistrationError, match=match):
            register(scene, bending_wedge(), landmarks=given)

    outside = clicks(view)
    outside.pixels[1] = [701.5, 245.0]
    refused(outside, r"landmark 2 has the pixel \(701.5, 245\), outside the 480x360 image: give pixels of frame 4")
    refused(clicks(view, unit=1e-3), "the landmark file is in metres")
    refused(clicks(view, count=2), "2 landmarks in frame 4")
    refused(clicks(view, count=0), "no landmarks")


def reason(scan, monkeypatch, places, views=None):
    """Why the images did not refine the object's place, found by its edges."""
    monkeypatch.setattr(EdgeSearch, "search", lambda self: places)
    points, all_views = scan
    return register_mesh(NODES, TRIANGLES, points, views or all_views, CAMERA).unrefined


@pytest.mark.slow
def test_faces_of_one_grey_show_too_little_texture(scan, places, monkeypatch):
    plain = [replace(view, normalized=np.full_like(view.normalized, 128)) for view in scan[1]]
    monkeypatch.setattr(mesh, "CONFIRMED", 0.0)
    assert reason(scan, monkeypatch, places, plain) == TooLittleTexture()


def test_one_keyframe_of_the_object_is_named(scan, places, monkeypatch):
    views = scan[1]
    # Cameras that look the other way.
    about = RigidTransform(np.diag([-1.0, 1.0, -1.0]), np.zeros(3))
    away = [replace(view, camera_from_world=about @ view.camera_from_world) for view in views[:3]]
    found = reason(scan, monkeypatch, places, [*away, views[FRAME]])
    assert found == NotRefined(Unrefined.FEW_KEYFRAMES, 1)


def test_images_that_show_something_else_look_different(scan, places, monkeypatch):
    rng = np.random.default_rng(1)
    noise = [replace(view, normalized=rng.integers(0, 256, view.normalized.shape, np.uint8)) for view in scan[1]]
    found = reason(scan, monkeypatch, places, noise)
    assert isinstance(found, NotRefined)
    assert found.why is Unrefined.LOOK_DIFFERENT
    assert 0.0 <= found.value < 0.1


def test_images_that_do_not_agree_are_named(scan, places, monkeypatch):
    differing = Agreement(places[0].place, rms_px=0.6, share=0.8, relief_px=1.0)
    monkeypatch.setattr(TextureComparison, "refine", lambda *_: differing)
    assert reason(scan, monkeypatch, places) == NotRefined(Unrefined.IMAGES_DIFFER, 0.6)


@pytest.mark.slow
def test_images_that_move_the_object_off_its_edges_are_named(scan, places, monkeypatch):
    best = places[0].place
    beside = SimilarityTransform(best.scale, best.rotation, best.translation + 0.02 * best.scale)

    def moved(found, adjustment, *_):
        return replace(found, world_from_object=beside, keyframes=adjustment.adjust(best))

    textured = scanned(WORLD, with_images=True)[1]
    agreeing = Agreement(beside, rms_px=0.2, share=0.8, relief_px=1.0)
    monkeypatch.setattr(TextureComparison, "refine", lambda *_: agreeing)
    monkeypatch.setattr(mesh, "EXACT_PX", 0.0)
    monkeypatch.setattr(mesh, "_adjusted", moved)
    found = reason(scan, monkeypatch, places, textured)
    assert isinstance(found, NotRefined)
    assert found.why is Unrefined.OFF_EDGES
    assert found.value < 100.0 * places[0].rank - 5.0


@pytest.mark.parametrize("warning", [NotRefined(Unrefined.LOOK_DIFFERENT, 0.25), OnlyInBox(7)])
def test_warnings_are_read_back(warning):
    read = read_warning(warning.content())
    assert read == warning
    assert read.text == warning.text


@pytest.mark.parametrize(
    ("factor", "has_depth", "likelier", "other"),
    [
        (5.03, True, "the scale of the depth images", "the unit of its mesh"),
        (0.2, True, "the scale of the depth images", "the unit of its mesh"),
        (1.3, False, "the baseline of the stereo pair", "the unit of its mesh"),
        (0.00101, True, "the unit of its mesh", "the scale of the depth images"),
        (9.9, False, "the unit of its mesh", "the baseline of the stereo pair"),
        (25.4, True, "the unit of its mesh", "the scale of the depth images"),
    ],
)
def test_another_size_is_blamed_on_the_mesh_or_on_the_map(scan, monkeypatch, factor, has_depth, likelier, other):
    points, views = scan
    if has_depth:
        views = [replace(views[0], depths=np.array([[10.0, 10.0, 0.4]], np.float32)), *views[1:]]
    there = MeshRegistration(SimilarityTransform(factor, np.eye(3), np.zeros(3)), None, 50.0, (), 100, 0.1, None)

    def found(*arguments, **_):
        if arguments[5]:
            raise RegistrationError("not there", RegistrationFailure.NOT_FOUND)
        return there

    monkeypatch.setattr(mesh, "register_mesh", found)
    with pytest.raises(RegistrationError, match=f"correct {likelier}.* or else {other}") as caught:
        register_in_unit(NODES, TRIANGLES, points, views, CAMERA, metric=True)
    assert caught.value.reason is RegistrationFailure.WRONG_SIZE


def test_the_picture_has_the_objects_own_coordinates(scene, unhinted, monkeypatch):
    shown = []
    monkeypatch.setattr(registering, "draw_overlay", lambda image, *rest, **_: shown.append(rest) or image)
    model = unhinted.model
    lower = replace(model, nodes=model.nodes - [0.0, 0.0, 0.0425])
    draw_registration(replace(unhinted, model=lower), scene)
    z = 1e3 * (NODES[:, 2] - 0.0425)
    for _, _, _, values, limits in shown:
        np.testing.assert_allclose(np.sort(values), np.sort(z), atol=1e-9)
        assert limits == pytest.approx((z.min(), z.max()))
    assert len(shown) == 3
