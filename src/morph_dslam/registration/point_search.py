"""Search for a surface in a map by the map's points alone.

Regions of the map that stand out of its planes are tried in turn. In each the surface starts in many attitudes and
sizes, is laid through the points by scaled robust ICP, and every result is scored by the keyframes: points that it
explains count for it, points that it would occlude against it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from morph_dslam.errors import RegistrationError, RegistrationFailure
from morph_dslam.geometry import SimilarityTransform
from morph_dslam.registration.icp import Surface, fit_surface, same_place
from morph_dslam.registration.point_evidence import PointEvidence, gather_evidence
from morph_dslam.registration.scene import MapPoints, View, spread_views
from morph_dslam.registration.search_space import attitudes, candidate_regions, find_planes
from morph_dslam.registration.surface_search import laid
from morph_dslam.registration.view_registration import EdgeSearch

Array = NDArray[np.float64]
#: Sizes at which the surface starts, over that of the region.
START_SIZES = (0.85, 1.1, 1.45)
#: How far its middle starts behind that of the points, which lie on the filmed side; over their spread.
START_BEHIND = (0.0, 0.6)
#: Points used while searching; starts of a region that are followed to their end, scored by few keyframes,
#: and refined and scored by more.
MOST_POINTS, N_FOLLOWED, N_SCORED, N_REFINED = 120, 120, 40, 5
#: Samples of the surface for all starts and for the better ones; keyframes asked for evidence, first and then.
ROUGH_SAMPLES, FIRST_ASKED, MOST_ASKED = (600, 1500), 3, 10
#: Widths of the robust weights over the surface's size: for all starts, for the better ones, to refine these.
COARSE = np.array([0.3, 0.25, 0.2, 0.15])
MIDDLE = np.array([0.15, 0.12, 0.1, 0.08, 0.07, 0.06, 0.05])
FINE = np.array([0.05, 0.04, 0.04, 0.03, 0.03, 0.025, 0.025, 0.02, 0.02, 0.02])
#: A point explained lies this near to the surface, over its size.
TOLERANCE = 0.015
#: A lower score is no evidence.
FEWEST_EXPLAINED = 20


@dataclass(frozen=True)
class Place:
    """A place of the surface in the map.

    Attributes
    ----------
    transform : metres to the map's unit.
    evidence : for it and against it, of the map's points.
    """

    transform: SimilarityTransform
    evidence: PointEvidence


def places_by_points(search: EdgeSearch, points: MapPoints, views: Sequence[View], progress: bool) -> list[Place]:
    """Where a surface may be by the points of the map, no two places the same, by their score.

    Parameters
    ----------
    search : for the same object by its edges, which says what is looked for.
    points, views, progress : as of `register_mesh`.

    Raises
    ------
    RegistrationError
        If no place explains enough points.
    """
    surface, nodes, triangles, camera = search.surface, search.edges.nodes, search.edges.triangles, search.camera
    rougher, rough = (Surface.of_mesh(nodes, triangles, count) for count in ROUGH_SAMPLES)
    planes = find_planes(points.positions)
    starts_in = attitudes(surface.axis_of_revolution, planes.largest_normal(points.positions))

    def judged(place: SimilarityTransform, asked: Sequence[View]) -> Place:
        tolerance = TOLERANCE * surface.size * place.scale
        return Place(place, gather_evidence(place, *search.edges.drawn, points.positions, asked, camera, tolerance))

    places: list[Place] = []
    few, more = spread_views(views, FIRST_ASKED), spread_views(views, MOST_ASKED)
    for region in tqdm(
        candidate_regions(points.positions, planes), desc="registering", unit="region", disable=not progress
    ):
        starts = [judged(place, few) for place in _searched(points[region], rougher, rough, starts_in, search.metric)]
        for start in sorted(starts, key=lambda place: -place.evidence.score)[:N_REFINED]:
            places.append(judged(_refined(start.transform, points, surface, search.metric), more))
    return _distinct(places, len(points), surface)


def _refined(start: SimilarityTransform, points: MapPoints, surface: Surface, metric: bool) -> SimilarityTransform:
    """The place near ``start`` that fits all points around it."""
    size = surface.size * start.scale
    near = np.linalg.norm(points.positions - start.apply(surface.centre), axis=1) < size
    return fit_surface(points[near], surface, start, FINE * size, metric)[0]


def _searched(
    points: MapPoints, rougher: Surface, rough: Surface, starts_in: list[Array], metric: bool
) -> list[SimilarityTransform]:
    """The best distinct fits to a region, before the keyframes have been asked."""
    some = points[np.random.default_rng(0).permutation(len(points))[:MOST_POINTS]]
    centre = np.median(points.positions, axis=0)
    spread = float(np.sqrt(np.mean(np.sum((points.positions - centre) ** 2, axis=1))))
    away = centre - points.viewpoints.mean(axis=0)
    away *= spread / np.linalg.norm(away)
    starts = [
        SimilarityTransform(scale, rotation, centre + behind * away - scale * rotation @ rougher.centre)
        for scale in ((1.0,) if metric else (np.array(START_SIZES) * spread / rougher.radius).tolist())
        for rotation, behind in product(starts_in, START_BEHIND)
    ]
    begun = laid(some, rougher, starts, COARSE, metric)[:N_FOLLOWED]
    chosen: list[SimilarityTransform] = []
    for place in laid(some, rough, begun, MIDDLE, metric):
        if len(chosen) < N_SCORED and all(not same_place(place, other, rough) for other in chosen):
            chosen.append(place)
    return chosen


def _distinct(places: list[Place], n_points: int, surface: Surface) -> list[Place]:
    """The best places, no two of them the same, by their score."""
    places = sorted(places, key=lambda place: -place.evidence.score)
    if not places or places[0].evidence.score < FEWEST_EXPLAINED:
        raise RegistrationError(
            f"the object was not found in the map of {n_points} points: {_best_of(places)}. Film the "
            "undeformed object closer and from more sides, and check the unit of its mesh",
            RegistrationFailure.NOT_FOUND,
        )
    kept: list[Place] = []
    for place in places:
        if all(not same_place(place.transform, other.transform, surface) for other in kept):
            kept.append(place)
    return kept


def _best_of(places: list[Place]) -> str:
    """What speaks for the best of the places (by score, the best first), none of which is good enough."""
    if not places:
        return "no region of it has enough points"
    best = places[0].evidence
    return (
        f"the best place explains {best.explained.sum()} of them, but only {best.solid.sum()} outside of a single "
        f"plane (a flat face fits anywhere), and would occlude {best.occluded.sum()} that were seen; "
        f"{FEWEST_EXPLAINED} outside of it are needed, and two more for each that is occluded"
    )
