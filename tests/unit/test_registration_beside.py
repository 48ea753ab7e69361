"""A second object of the same kind is found beside the first, which keeps its points."""

import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from morph_dslam.errors import RegistrationError
from morph_dslam.geometry import SimilarityTransform
from morph_dslam.model import save_model
from morph_dslam.registration.mesh import register_mesh
from morph_dslam.registration.run import left_by_others
from tests.support.rendered_object import CAMERA, scanned, wedge
from tests.support.staged_scenes import bending_wedge

WORLD = SimilarityTransform(1.0, Rotation.from_rotvec([0.4, -0.9, 1.3]).as_matrix(), np.array([0.5, -1.2, 2.0]))
PLACES = (np.array([-0.08, 0.0, 0.0]), np.array([0.08, 0.03, 0.0]))


def true_place(number):
    return WORLD @ SimilarityTransform(1.0, np.eye(3), PLACES[number])


def write_registration(folder, place, **changes):
    """The registration of a wedge, with its model and an empty map beside it."""
    model = bending_wedge()
    save_model(folder / "wedge.morph", model)
    content = {
        "world_from_object": place.matrix.tolist(),
        "map_units_per_metre": place.scale,
        "mean_node_m": model.nodes.mean(axis=0).tolist(),
        "covariance": None,
        "map": "map.h5",
        "model": "wedge.morph",
    }
    path = folder / "registration.json"
    path.write_text(json.dumps(content | changes))
    return path


def apart(found, true):
    """Largest distance of any node of the wedge between two placings of it, metres."""
    nodes = wedge()[0]
    return np.linalg.norm((true.inverse @ found).apply(nodes) - nodes, axis=1).max()


def test_the_second_of_two_alike_is_found_beside_the_first(tmp_path):
    """Without the first one's registration it could be either (`test_mesh_registration`)."""
    nodes, triangles, _ = wedge()
    points, views = scanned(WORLD, objects=PLACES)
    path = write_registration(tmp_path, true_place(0))
    rest = left_by_others(points, views, [path], tmp_path / "map.h5")
    second = register_mesh(nodes, triangles, *rest, CAMERA, metric=True)
    assert not second.ambiguous
    assert apart(second.world_from_object, true_place(1)) < 1.5e-3


def test_the_points_on_an_object_are_left_to_it_and_no_others(tmp_path):
    points, views = scanned(WORLD, objects=PLACES, noise=0.0)
    path = write_registration(tmp_path, true_place(0))
    left, seen = left_by_others(points, views, [path], tmp_path / "map.h5")
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


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"map": "other.h5"}, "is of another map"),
        ({"model": None}, "does not say which object is where in which map"),
        ({"world_from_object": "there"}, "does not say which object is where in which map"),
    ],
)
def test_registrations_that_do_not_fit_are_refused(tmp_path, changes, message):
    points, views = scanned(WORLD, objects=PLACES[:1])
    path = write_registration(tmp_path, true_place(0), **changes)
    with pytest.raises(RegistrationError, match=message):
        left_by_others(points, views, [path], tmp_path / "map.h5")
    with pytest.raises(RegistrationError, match="cannot read the registration"):
        left_by_others(points, views, [tmp_path / "none.json"], tmp_path / "map.h5")
