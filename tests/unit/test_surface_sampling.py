"""Points spread over a surface, against areas and centroids that are known in closed form."""

import numpy as np

from morph_dslam.model.reduced_model import spread_over, triangle_normals

#: A rectangle 4 by 1 in three triangles of areas 0.5, 1.5 and 2.
NODES = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [4.0, 0.0, 0.0], [4.0, 1.0, 0.0], [0.0, 1.0, 0.0]])
TRIANGLES = np.array([[0, 1, 4], [1, 2, 4], [2, 3, 4]])


def test_normals_are_twice_as_long_as_the_areas():
    np.testing.assert_allclose(triangle_normals(NODES, TRIANGLES), [[0, 0, 1], [0, 0, 3], [0, 0, 4]])


def test_each_triangle_gets_as_many_points_as_its_area_asks_for():
    points = spread_over(NODES, TRIANGLES, 800)
    assert np.bincount(points.triangles).tolist() == [100, 300, 400]
    assert (points.weights >= 0.0).all()
    np.testing.assert_allclose(points.weights.sum(axis=1), 1.0)


def test_points_are_spread_evenly_within_the_triangles_and_the_same_every_time():
    points = spread_over(NODES, TRIANGLES, 8000)
    places = np.einsum("pc,pcx->px", points.weights, NODES[TRIANGLES[points.triangles]])
    # Of a rectangle: the middle, and a twelfth of the squared sides.
    np.testing.assert_allclose(places.mean(axis=0), [2.0, 0.5, 0.0], atol=0.03)
    np.testing.assert_allclose(places.var(axis=0), [16 / 12, 1 / 12, 0.0], rtol=0.03)
    np.testing.assert_array_equal(spread_over(NODES, TRIANGLES, 8000).weights, points.weights)


def test_a_triangle_without_area_gets_no_point():
    points = spread_over(NODES, np.concatenate([TRIANGLES, [[0, 0, 1]]]), 801)
    assert points.triangles.max() == 2
