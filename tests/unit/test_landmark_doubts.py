"""Landmarks place an object in a map that confirms it, in one that does not, and in one that is in doubt itself."""

from dataclasses import replace

import h5py
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from morph_dslam.geometry import RigidTransform, SimilarityTransform
from morph_dslam.io.trajectory import Trajectory
from morph_dslam.registration import register as register_module
from morph_dslam.registration.edges import EdgeEvidence, Sighting
from morph_dslam.registration.hints import Hints
from morph_dslam.registration.mesh import MeshRegistration, register_mesh
from morph_dslam.registration.messages import Ambiguity, Ambiguous, MapNotRigid, read_warning
from morph_dslam.registration.point_evidence import PointEvidence
from morph_dslam.registration.register import register
from morph_dslam.registration.scene import camera_from_object
from morph_dslam.registration.view_registration import EdgeRegistration, EdgeSearch
from morph_dslam.slam.rigid_map import GOOD, Keyframe, RigidMap
from morph_dslam.slam.scene import Scene, load_scene
from morph_dslam.slam.scene_rigidity import SceneNotRigid
from tests.support.bent_sheet import bent_sheet_model
from tests.support.rendered_object import CAMERA, scanned, shaded, wedge

WORLD = SimilarityTransform(3.7, Rotation.from_rotvec([0.4, -0.9, 1.3]).as_matrix(), np.array([0.5, -1.2, 2.0]))
NODES, TRIANGLES, _ = wedge()
#: Three corners of the wedge, metres.
CORNERS = np.array([[0.01, 0.05, 0.07], [0.05, 0.05, 0.045], [0.09, 0.0, 0.0]])
MOVED = SceneNotRigid(0.25, 0.05, 8)
NO_PATH = Trajectory(np.empty(0), np.empty((0, 4, 4)))


def blank():
    """A keyframe that shows nothing."""
    image = np.zeros((CAMERA.height, CAMERA.width), np.uint8)
    return Keyframe(0, 0.0, image, np.eye(4), np.empty(0, np.int64), np.empty((0, 2)))


@pytest.fixture(scope="module")
def scan():
    """Points and views of a map of the wedge on a table."""
    return scanned(WORLD)


def bent(views, degrees):
    """The views of a map whose path turns about the object, from keyframe to keyframe by so much more."""
    centre = WORLD.apply(NODES.mean(axis=0))
    poses = []
    for k, view in enumerate(views):
        turn = Rotation.from_rotvec(np.radians(k * degrees) * np.array([0.6, 0.0, 0.8])).as_matrix()
        poses.append(view.camera_from_world @ RigidTransform(turn, centre - turn @ centre))
    return [replace(view, camera_from_world=pose) for view, pose in zip(views, poses, strict=True)]


def clicks_in(view, off):
    """The corners as landmarks in a view, off by so many pixels (3, 2)."""
    pixels = CAMERA.project(camera_from_object(view, WORLD).apply(CORNERS)) + off
    return Hints(clicks=(Sighting(view.frame, view.camera_from_world, CORNERS, pixels),))


@pytest.mark.slow
@pytest.mark.parametrize("degrees", [0.0, 3.0, 5.0])
def test_where_landmarks_have_an_object_is_doubted_in_a_bent_map(scan, degrees):
    """No point of the map is on the object: only its outline confirms or refutes what the landmarks say."""
    points, views = scan
    views = bent(shaded(views, WORLD), degrees)
    on_table = WORLD.inverse.apply(points.positions)[:, 2] < 2e-3
    row = np.cumsum(on_table) - 1
    kept = [on_table[view.point_ids] for view in views]
    views = [
        replace(view, point_ids=row[view.point_ids[seen]], pixels=view.pixels[seen])
        for view, seen in zip(views, kept, strict=True)
    ]
    hints = clicks_in(views[0], np.array([[1.0, -0.5], [-1.0, 0.5], [0.5, 1.0]]))
    found = register_mesh(NODES, TRIANGLES, points[on_table], views, CAMERA, hints=hints)
    off = np.linalg.norm((WORLD.inverse @ found.world_from_object).apply(NODES) - NODES, axis=1).max()
    assert (off < 2e-3) == (degrees == 0.0)
    assert found.ambiguous == (degrees > 0.0)


@pytest.mark.parametrize(
    ("share", "gain_std", "explained", "occluded", "doubt"),
    [
        (0.75, 0.02, 8, 4, None),  # a smooth body of one colour: few points, but its outline is there
        (0.75, 0.02, 4, 8, Ambiguity.LANDMARKS_UNCONFIRMED),
        (0.55, 0.10, 8, 4, Ambiguity.LANDMARKS_UNCONFIRMED),
        (0.55, 0.01, 8, 4, None),
        (0.45, 0.12, 8, 4, Ambiguity.LANDMARKS_UNCONFIRMED),
    ],
)
def test_landmarks_need_an_outline_that_is_surely_seen_and_no_points_against_them(
    monkeypatch, scan, share, gain_std, explained, occluded, doubt
):
    """By chance no edge is seen, so that the gain is the share; the limit is one half, beyond 1.645 deviations."""
    points, views = scan
    rows = np.arange(len(points))
    is_explained, none = rows < explained, np.zeros(len(points), dtype=bool)
    is_occluded = ~is_explained & (rows < explained + occluded)
    evidence = PointEvidence(is_explained, is_occluded, none, none, is_explained.astype(float))
    edges = EdgeEvidence(share, 0.0, 0.0, 0.0, 2000, gain_std=gain_std)
    place = EdgeRegistration(WORLD, np.eye(7), edges, evidence)
    monkeypatch.setattr(EdgeSearch, "search", lambda _: [place])
    hints = clicks_in(views[0], np.zeros((3, 2)))
    assert register_mesh(NODES, TRIANGLES, points, views[:2], CAMERA, hints=hints).unconfirmed is doubt


#: Placed by landmarks, with too little evidence of its own, but an outline that is there.
WEAK = MeshRegistration(
    WORLD, None, 5.0, (), n_explained=0, rms_px=None, axis=None, edges=EdgeEvidence(0.9, 0.1, 0.0, 0.0, 2000)
)


@pytest.mark.parametrize(
    ("found", "is_doubted"),
    [(WEAK, True), (replace(WEAK, score=10.0), False), (replace(WEAK, shape_shown=True, rms_px=0.1), False)],
    ids=["weak", "confirmed by edges", "confirmed by images"],
)
@pytest.mark.parametrize("notices", [(), (MOVED,)], ids=["rigid", "moved"])
def test_a_map_whose_scene_moved_confirms_no_landmarks(monkeypatch, found, is_doubted, notices):
    monkeypatch.setattr(register_module, "register_in_unit", lambda *_: found)
    rigid_map = RigidMap()
    rigid_map.add_keyframe(blank())
    rigid_map.notices = notices
    placed = register(Scene(CAMERA, rigid_map, NO_PATH), bent_sheet_model(8, 6))
    doubt = Ambiguous(Ambiguity.LANDMARKS_UNCONFIRMED)
    assert (doubt in placed.warnings) == (is_doubted and bool(notices))
    assert [each for each in placed.warnings if isinstance(each, MapNotRigid)] == [MapNotRigid(0.25)] * len(notices)


def test_what_a_map_says_of_itself_is_kept_and_a_map_of_an_earlier_release_says_nothing(tmp_path):
    rigid_map = RigidMap()
    rigid_map.add_points(np.array([[0.0, 0.0, 1.0]]), np.zeros((1, 2)), 0, GOOD)
    rigid_map.add_keyframe(blank())
    rigid_map.notices = (MOVED,)
    Scene(CAMERA, rigid_map, NO_PATH).save(tmp_path / "map.h5")
    again = load_scene(tmp_path / "map.h5", CAMERA)
    assert again.notices == (MOVED,)
    assert again.map.copied().notices == (MOVED,)
    with h5py.File(tmp_path / "map.h5") as file, h5py.File(tmp_path / "earlier.h5", "w") as earlier:
        for name in file:
            file.copy(name, earlier)
        earlier.attrs.update({name: value for name, value in file.attrs.items() if name != "notices"})
    assert load_scene(tmp_path / "earlier.h5", CAMERA).notices == ()


def test_the_warning_of_a_map_is_read_back():
    read = read_warning(MapNotRigid(0.25).content())
    assert read == MapNotRigid(0.25)
