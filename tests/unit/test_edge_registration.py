"""What speaks for a place: likelihoods by closed forms, and places near each other that points do not tell apart."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import bernoulli

from morph_dslam.camera import Camera
from morph_dslam.geometry import RigidTransform, SimilarityTransform
from morph_dslam.registration.edge_registration import EdgeRegistration
from morph_dslam.registration.edges import EdgeEvidence, Sighting, add_clicks, click_likelihood
from morph_dslam.registration.increments import moved_similarity
from morph_dslam.registration.point_evidence import PointEvidence

CAMERA = Camera(640, 480, 560.0, 560.0, 320.0, 240.0)
PLACE = SimilarityTransform(1.6, Rotation.from_rotvec([0.3, -0.2, 0.5]).as_matrix(), np.array([0.02, -0.03, 0.7]))
POINTS = np.array([[0.04, 0.0, 0.01], [-0.04, 0.01, 0.0], [0.0, 0.03, -0.02]])


def clicked(off):
    """Landmarks in a camera at the origin, ``off`` (3, 2) pixels from where `PLACE` has them."""
    local = PLACE.apply(POINTS) / PLACE.scale
    return Sighting(0, RigidTransform(np.eye(3), np.zeros(3)), POINTS, CAMERA.project(local) + off)


def points_on_it(n_explained, n_solid):
    """Points of a map that lie exactly on an object, so many of them outside of one plane."""
    rows = np.arange(n_explained)
    none = np.zeros(n_explained, dtype=bool)
    return PointEvidence(~none, none, rows < n_solid, none, np.ones(n_explained))


def place_of(share, n_solid, clicks=0.0):
    """A place where seven keyframes show such a share of 4500 points of the outline."""
    edges = EdgeEvidence(share, 0.235, 0.0, 0.0, 4500, n_views=7)
    return EdgeRegistration(PLACE, np.zeros((7, 7)), edges, points_on_it(120, n_solid), clicks)


def test_of_places_near_each_other_that_with_more_of_the_outline_is_likelier():
    """Four of 120 points, which lie outside of one plane by chance, make the other one rank higher."""
    right, other = place_of(0.68, 4), place_of(0.63, 8)
    assert other.rank > right.rank
    # 280 draws count: 14 more are on edges than of the other one.
    ratio = bernoulli.logpmf([1, 0], 0.8) - bernoulli.logpmf([1, 0], 0.235)
    assert right.likelihood - other.likelihood == pytest.approx(14 * (ratio[0] - ratio[1]))


def test_where_as_many_edges_are_seen_points_and_landmarks_decide():
    assert place_of(0.66, 4, -1.0).likelihood > place_of(0.66, 4, -3.0).likelihood
    more, fewer = (
        EdgeRegistration(PLACE, np.zeros((7, 7)), place_of(0.66, 0).edges, points_on_it(n, 0)) for n in (60, 30)
    )
    assert more.likelihood > fewer.likelihood


@pytest.mark.parametrize(("count", "n_views", "counting"), [(100, 7, 100), (4500, 7, 280), (4500, 8, 320)])
def test_edges_are_as_likely_as_draws(count, n_views, counting):
    """40 points of a keyframe count as independent; on the object 80 % are on edges."""
    drawn = np.arange(counting) < 0.6 * counting
    ratio = bernoulli.logpmf(drawn, 0.8).sum() - bernoulli.logpmf(drawn, 0.3).sum()
    assert EdgeEvidence(0.6, 0.3, 0.0, 0.0, count, n_views=n_views).log_likelihood == pytest.approx(ratio)


def test_landmarks_that_are_met_cost_nothing_and_a_mistaken_one_no_more_than_another():
    assert click_likelihood([clicked(np.zeros((3, 2)))], PLACE, CAMERA) == pytest.approx(0.0, abs=1e-9)
    # Two pixels are one standard deviation: half a squared one, of each coordinate, as these are small.
    small = click_likelihood([clicked(np.full((3, 2), 0.02))], PLACE, CAMERA)
    assert small == pytest.approx(-0.5 * 6 * 0.01**2, rel=1e-3)
    far, farther = (click_likelihood([clicked(off * np.eye(3, 2))], PLACE, CAMERA) for off in (400.0, 4000.0))
    assert far == pytest.approx(farther, rel=1e-2)
    behind = SimilarityTransform(PLACE.scale, PLACE.rotation, -PLACE.translation)
    assert click_likelihood([clicked(np.zeros((3, 2)))], behind, CAMERA) == pytest.approx(3 * farther, rel=1e-2)


def test_the_step_by_landmarks_climbs_their_likelihood():
    click, centre = clicked(np.array([[3.0, -1.0], [-2.0, 4.0], [7.0, 0.5]])), POINTS.mean(axis=0)
    matrix, right = np.zeros((7, 7)), np.zeros(7)
    add_clicks(matrix, right, click, PLACE, centre, CAMERA)

    def along(k, step):
        return click_likelihood([click], moved_similarity(PLACE, step * np.eye(7)[k], centre), CAMERA)

    slopes = [(along(k, 1e-6) - along(k, -1e-6)) / 2e-6 for k in range(7)]
    np.testing.assert_allclose(right, slopes, rtol=1e-4, atol=1e-3 * np.abs(right).max())
