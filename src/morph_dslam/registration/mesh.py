"""Registration of a mesh in a sparse map: where the object is, how large the map's unit is, and how sure that is.

Regions of the map that stand out of its planes are tried in turn. In each the surface starts in many attitudes and
sizes, is laid through the points by scaled robust ICP, and every result is scored by the keyframes: points that it
explains count for it, points that it would occlude against it. The best and the best other one are kept, and the
best is refined by comparing the keyframes' images on it. Last, these are asked whether they show its outline there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import product

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from morph_dslam.camera import Camera
from morph_dslam.errors import RegistrationError, RegistrationFailure
from morph_dslam.geometry import SimilarityTransform
from morph_dslam.registration.edges import EdgeEvidence
from morph_dslam.registration.icp import Surface, fit_surface, same_place
from morph_dslam.registration.keyframe_adjustment import AdjustedKeyframes, KeyframeAdjustment, similarity_of_path
from morph_dslam.registration.messages import (
    Ambiguity,
    Ambiguous,
    OutlineElsewhere,
    RegistrationWarning,
    TooLittleTexture,
)
from morph_dslam.registration.outline_fit import OutlineFit, outline_fit
from morph_dslam.registration.registration import Axis
from morph_dslam.registration.scene import MapPoints, View, spread_views
from morph_dslam.registration.search_space import attitudes, candidate_regions, find_planes, plane_points
from morph_dslam.registration.texture import TextureComparison
from morph_dslam.registration.view_registration import EdgeRegistration, EdgeSearch, Hints
from morph_dslam.render.rasteriser import rasterise

Array = NDArray[np.float64]
#: A point that the object would occlude counts against it as much as so many that it explains.
VIOLATION = 2.0
#: The views are drawn this much smaller.
SHRINK = 4
#: Sizes at which the surface starts, over that of the region.
START_SIZES = (0.85, 1.1, 1.45)
#: How far its middle starts behind that of the points, which lie on the filmed side; over their spread.
START_BEHIND = (0.0, 0.6)
#: Points used while searching; starts of a region that are followed to their end, scored by few keyframes,
#: and refined and scored by more.
MOST_POINTS, N_FOLLOWED, N_SCORED, N_REFINED = 120, 120, 40, 5
#: Samples of the surface while searching, and keyframes asked for evidence, first and then.
ROUGH_SAMPLES, FIRST_ASKED, MOST_ASKED = 3000, 3, 10
#: Widths of the robust weights over the surface's size: for all starts, for the better ones, to refine these.
COARSE = np.array([0.3, 0.25, 0.2, 0.15])
MIDDLE = np.array([0.15, 0.12, 0.1, 0.08, 0.07, 0.06, 0.05])
FINE = np.array([0.05, 0.04, 0.04, 0.03, 0.03, 0.025, 0.025, 0.02, 0.02, 0.02])
#: A point explained lies this near to the surface, over its size.
TOLERANCE = 0.015
#: A lower score is no evidence.
FEWEST_EXPLAINED = 20
#: The runner-up's score over the best's above which they are ambiguous.
AMBIGUOUS = 0.8
#: An object laid by its edges is confirmed if so much of its outline is on edges, of what chance does not put there.
#: Its images are believed before its edges unless they lose more than this part of them.
CONFIRMED, LOST_EDGES = 0.6, 0.05
#: The same where landmarks have it there, and below which the edges speak against a place found by
#: points, if chance puts less than this on edges.
CONFIRMED_BY_CLICKS, AGAINST, TELLING_CHANCE = 0.5, 0.25, 0.5
#: So many of the best places are compared by the images on them, if they score at least this part of the
#: best. Images that differ by more than this, pixels, or so many times as much as on another place, speak
#: against a place.
N_COMPARED, WORTH_COMPARING, POOR_AGREEMENT_PX, MUCH_WORSE = 4, 0.5, 0.35, 2.0


@dataclass(frozen=True)
class _Evidence:
    """What speaks for a place.

    Attributes
    ----------
    explained : (n,) points that lie on the visible side of the object.
    occluded : (n,) points that it would occlude.
    solid : (n,) points explained without those of the one plane that holds most of them. Any flat face fits
        on any table or wall, in any size.
    """

    explained: NDArray[np.bool_]
    occluded: NDArray[np.bool_]
    solid: NDArray[np.bool_]

    @property
    def score(self) -> float:
        """Points explained, but for one plane, less those occluded, these `VIOLATION` times."""
        return float(self.solid.sum() - VIOLATION * self.occluded.sum())


def gather_evidence(
    world_from_object: SimilarityTransform,
    nodes: Array,
    triangles: NDArray[np.int64],
    positions: Array,
    views: Sequence[View],
    camera: Camera,
    tolerance: float,
) -> _Evidence:
    """Draw the object into every view and compare its depth with that of the points (p, 3) seen there.

    ``tolerance`` is how far from the surface a point may lie that it explains, world unit.
    """
    votes = np.zeros((2, len(positions)), dtype=np.int64)
    small = _shrunk(camera)
    world = world_from_object.apply(nodes)
    for view in views:
        local = view.camera_from_world.apply(world)
        buffers = rasterise(small.project(local), local[:, 2], triangles, small.height, small.width)
        depth = view.camera_from_world.apply(positions[view.point_ids])[:, 2]
        columns, rows = np.rint((view.pixels + 0.5) / SHRINK - 0.5).astype(np.int64).T
        inside = (columns >= 0) & (columns < small.width) & (rows >= 0) & (rows < small.height)
        drawn = np.full(len(depth), np.inf)
        drawn[inside] = buffers.depth[rows[inside], columns[inside]]
        # A grazing surface changes its depth within a pixel: what is occluded must be so by more.
        votes[0, view.point_ids] += np.abs(depth - drawn) <= 2.0 * tolerance
        votes[1, view.point_ids] += drawn < depth - 4.0 * tolerance
    explained, occluded = votes[0] > votes[1], votes[1] > votes[0]
    solid = explained.copy()
    found = np.flatnonzero(explained)
    if len(found) >= 3:
        solid[found] = ~plane_points(positions[found], tolerance, np.random.default_rng(0))
    return _Evidence(explained, occluded, solid)


def _shrunk(camera: Camera) -> Camera:
    return Camera(
        camera.width // SHRINK,
        camera.height // SHRINK,
        camera.fx / SHRINK,
        camera.fy / SHRINK,
        (camera.cx + 0.5) / SHRINK - 0.5,
        (camera.cy + 0.5) / SHRINK - 0.5,
    )


@dataclass(frozen=True)
class MeshRegistration:
    """An object found in a map.

    Attributes
    ----------
    world_from_object : metres to the map's unit.
    covariance : (7, 7) of log scale, rotation vector and translation about the mean node, world; None if there
        was too little to compare.
    score : points explained outside of one plane, less twice those it would occlude.
    runner_up : the score of the next best place.
    n_explained : points on the surface.
    rms_px : how far the keyframes' images of the surface agree; None if there was too little to compare.
    axis : about which the surface can be turned without a difference, so that this angle is not known.
    keyframes : those with a pose of their own about the object; None if there was too little to compare.
    outline : how much of its outline the keyframes show where it is.
    unconfirmed : whether there are images, but nothing on the object could be compared in them: a floor and a
        wall, say, that have its shape in another size.
    """

    world_from_object: SimilarityTransform
    covariance: Array | None
    score: float
    runner_up: float
    n_explained: int
    rms_px: float | None
    axis: Axis | None
    keyframes: AdjustedKeyframes | None = None
    outline: OutlineFit = field(default_factory=OutlineFit)
    unconfirmed: bool = False
    edges: EdgeEvidence | None = None
    by_clicks: bool = False

    @property
    def warnings(self) -> tuple[RegistrationWarning, ...]:
        """What a reader must know."""
        warnings: list[RegistrationWarning] = []
        if self.edges is not None:
            if self.edges.gain < (CONFIRMED_BY_CLICKS if self.by_clicks else CONFIRMED):
                warnings.append(OutlineElsewhere(self.edges.share))
            elif self.runner_up > AMBIGUOUS * self.score:
                warnings.append(Ambiguous(Ambiguity.SECOND_PLACE, self.runner_up / self.score))
            return tuple(warnings if self.rms_px is not None else [*warnings, TooLittleTexture()])
        if self.outline.contradicts:
            warnings.append(OutlineElsewhere(self.outline.share))
        elif self.unconfirmed:
            warnings.append(Ambiguous(Ambiguity.UNCONFIRMED))
        elif self.rms_px is not None and self.rms_px > POOR_AGREEMENT_PX:
            warnings.append(Ambiguous(Ambiguity.IMAGES_DIFFER, self.rms_px))
        elif self.runner_up > AMBIGUOUS * self.score:
            warnings.append(Ambiguous(Ambiguity.SECOND_PLACE, self.runner_up / self.score))
        if self.rms_px is None:
            warnings.append(TooLittleTexture())
        return tuple(warnings)

    @property
    def ambiguous(self) -> bool:
        """Whether another place is nearly as good, or the images contradict this one or do not confirm it."""
        return any(isinstance(warning, Ambiguous | OutlineElsewhere) for warning in self.warnings)


@dataclass(frozen=True)
class _Place:
    transform: SimilarityTransform
    evidence: _Evidence


def register_mesh(
    nodes: Array,
    triangles: NDArray[np.int64],
    points: MapPoints,
    views: Sequence[View],
    camera: Camera,
    metric: bool = False,
    progress: bool = False,
    hints: Hints | None = None,
) -> MeshRegistration:
    """Find an undeformed object in a map.

    Parameters
    ----------
    nodes : (n, 3) metres.
    triangles : (m, 3) node indices, outwards if the surface is closed.
    points : of the map.
    views : keyframes of the map, whose ``point_ids`` are rows of ``points``.
    camera : of the views, without distortion.
    metric : whether the map's unit is the metre.
    progress : whether to show a progress bar.
    hints : what is known of where the object is.

    Raises
    ------
    RegistrationError
        If the object is not found, or a hint names what is not there.
    """
    search = EdgeSearch(nodes, triangles, points, views, camera, metric)
    if hints is not None:
        places = search.search(hints)
        if not places:
            raise RegistrationError(
                "no keyframe shows the object's edges where the hints have it: check them and the unit of the mesh, or "
                "give three landmarks",
                RegistrationFailure.NOT_FOUND,
            )
        return _by_edges(places, search, points, views, metric, bool(hints.clicks))
    found = _by_points(search.surface, nodes, triangles, points, views, camera, metric, progress)
    edges = search.evidence(found.world_from_object)
    # On a dense texture, edges are everywhere and say nothing.
    informative = 0.0 < edges.chance < TELLING_CHANCE
    return replace(found, edges=edges) if informative and edges.gain < AGAINST else found


def _by_edges(
    places: list[EdgeRegistration],
    search: EdgeSearch,
    points: MapPoints,
    views: Sequence[View],
    metric: bool,
    by_clicks: bool,
) -> MeshRegistration:
    """The best of the places, refined by the images on it where its edges stay; the others are its rivals."""
    best, nodes, triangles = places[0], search.edges.nodes, search.edges.triangles
    axis = search.surface.axis_of_revolution
    found = MeshRegistration(
        best.place,
        best.covariance,
        100.0 * best.edges.total,
        max([0.0, *(100.0 * other.edges.total for other in places[1:])]),
        best.n_explained,
        None,
        axis,
        edges=best.edges,
        by_clicks=by_clicks,
    )
    aligned = TextureComparison(nodes, triangles, search.camera).refine(best.place, views, metric)
    if aligned is None:
        return found
    adjustment = KeyframeAdjustment(nodes, triangles, search.camera, points, views, axis)
    adjusted = _adjusted(
        replace(found, world_from_object=aligned[0], rms_px=aligned[1]), adjustment, nodes.mean(axis=0), metric
    )
    edges = search.evidence(adjusted.world_from_object)
    if adjusted.keyframes is None or edges.total < best.edges.total - LOST_EDGES or aligned[1] > POOR_AGREEMENT_PX:
        return found
    return replace(adjusted, edges=edges)


def _by_points(
    surface: Surface,
    nodes: Array,
    triangles: NDArray[np.int64],
    points: MapPoints,
    views: Sequence[View],
    camera: Camera,
    metric: bool,
    progress: bool,
) -> MeshRegistration:
    """The object found by the points of the map on its ``surface``; other parameters as of `register_mesh`."""
    rough = Surface.of_mesh(nodes, triangles, ROUGH_SAMPLES)
    planes = find_planes(points.positions)
    starts_in = attitudes(surface.axis_of_revolution, planes.largest_normal(points.positions))

    def judged(place: SimilarityTransform, asked: Sequence[View]) -> _Place:
        tolerance = TOLERANCE * surface.size * place.scale
        return _Place(place, gather_evidence(place, nodes, triangles, points.positions, asked, camera, tolerance))

    places: list[_Place] = []
    few, more = spread_views(views, FIRST_ASKED), spread_views(views, MOST_ASKED)
    for region in tqdm(
        candidate_regions(points.positions, planes), desc="registering", unit="region", disable=not progress
    ):
        starts = [judged(place, few) for place in _searched(points[region], rough, starts_in, metric)]
        for start in sorted(starts, key=lambda place: -place.evidence.score)[:N_REFINED]:
            places.append(judged(_refined(start.transform, points, surface, metric), more))
    candidates = _distinct(places, len(points), surface)
    comparison = TextureComparison(nodes, triangles, camera)
    aligned = [comparison.refine(place.transform, views, metric) for place in _worth_comparing(candidates)]
    found = _chosen(candidates, aligned, surface)
    if found.rms_px is not None:
        adjustment = KeyframeAdjustment(nodes, triangles, camera, points, views, surface.axis_of_revolution)
        found = _adjusted(found, adjustment, nodes.mean(axis=0), metric)
    outline = outline_fit(found.world_from_object, nodes, triangles, more, camera)
    unconfirmed = found.rms_px is None and any(np.ptp(view.normalized) > 0 for view in views)
    return replace(found, outline=outline, unconfirmed=unconfirmed)


def _adjusted(
    found: MeshRegistration, adjustment: KeyframeAdjustment, mean_node: Array, metric: bool
) -> MeshRegistration:
    """The registration with keyframes placed about the object, where there is enough to compare."""
    keyframes = adjustment.adjust(found.world_from_object)
    if keyframes is None:
        return found
    placed, covariance = similarity_of_path(keyframes, found.world_from_object, mean_node, metric)
    return replace(found, world_from_object=placed, covariance=covariance, keyframes=keyframes)


def _refined(start: SimilarityTransform, points: MapPoints, surface: Surface, metric: bool) -> SimilarityTransform:
    """The place near ``start`` that fits all points around it."""
    size = surface.size * start.scale
    near = np.linalg.norm(points.positions - start.apply(surface.centre), axis=1) < size
    return fit_surface(points[near], surface, start, FINE * size, metric)[0]


def _searched(points: MapPoints, surface: Surface, starts_in: list[Array], metric: bool) -> list[SimilarityTransform]:
    """The best distinct fits to a region, before the keyframes have been asked."""
    some = points[np.random.default_rng(0).permutation(len(points))[:MOST_POINTS]]
    centre = np.median(points.positions, axis=0)
    spread = float(np.sqrt(np.mean(np.sum((points.positions - centre) ** 2, axis=1))))
    away = centre - points.viewpoints.mean(axis=0)
    away *= spread / np.linalg.norm(away)
    starts = []
    for scale in (1.0,) if metric else np.array(START_SIZES) * spread / surface.radius:
        for rotation, behind in product(starts_in, START_BEHIND):
            place = centre + behind * away - scale * rotation @ surface.centre
            start = SimilarityTransform(scale, rotation, place)
            starts.append(fit_surface(some, surface, start, COARSE * surface.size * scale, metric, False))
    fits = []
    for begun in _by_weight(starts)[:N_FOLLOWED]:
        fits.append(fit_surface(some, surface, begun, MIDDLE * surface.size * begun.scale, metric, False))
    chosen: list[SimilarityTransform] = []
    for place in _by_weight(fits):
        if len(chosen) < N_SCORED and all(not same_place(place, other, surface) for other in chosen):
            chosen.append(place)
    return chosen


def _by_weight(fits: list[tuple[SimilarityTransform, Array]]) -> list[SimilarityTransform]:
    """The fits without their weights, those of most weight first."""
    return [transform for transform, _ in sorted(fits, key=lambda fit: -float(fit[1].sum()))]


def _distinct(places: list[_Place], n_points: int, surface: Surface) -> list[_Place]:
    """The best places, no two of them the same, by their score."""
    places = sorted(places, key=lambda place: -place.evidence.score)
    if not places or places[0].evidence.score < FEWEST_EXPLAINED:
        raise RegistrationError(
            f"the object was not found in the map of {n_points} points: {_best_of(places)}. Film the "
            "undeformed object closer and from more sides, and check the unit of its mesh",
            RegistrationFailure.NOT_FOUND,
        )
    kept: list[_Place] = []
    for place in places:
        if all(not same_place(place.transform, other.transform, surface) for other in kept):
            kept.append(place)
    return kept


def _best_of(places: list[_Place]) -> str:
    """What speaks for the best of the places (by score, the best first), none of which is good enough."""
    if not places:
        return "no region of it has enough points"
    best = places[0].evidence
    return (
        f"the best place explains {best.explained.sum()} of them, but only {best.solid.sum()} outside of a single "
        f"plane (a flat face fits anywhere), and would occlude {best.occluded.sum()} that were seen; "
        f"{FEWEST_EXPLAINED} outside of it are needed, and two more for each that is occluded"
    )


def _worth_comparing(candidates: list[_Place]) -> list[_Place]:
    """Of the candidates, the best first, those that score well."""
    least = WORTH_COMPARING * candidates[0].evidence.score
    return [place for place in candidates[:N_COMPARED] if place.evidence.score >= least]


def _chosen(
    candidates: list[_Place], aligned: list[tuple[SimilarityTransform, float] | None], surface: Surface
) -> MeshRegistration:
    """The candidate on which the images agree best; ``aligned`` are the first ones, refined by images."""
    compared = candidates[: len(aligned)]
    moved = [place.transform if found is None else found[0] for place, found in zip(compared, aligned, strict=True)]
    misfits = np.array([np.inf if found is None else found[1] for found in aligned])
    row = int(np.argmin(misfits))  # the first where no images can be compared
    best, place = compared[row].evidence, moved[row]
    others = [other.evidence.score for other in candidates[len(compared) :]]
    for other, there, misfit in zip(compared, moved, misfits, strict=True):
        if misfit <= MUCH_WORSE * misfits[row] and not same_place(there, place, surface):
            others.append(other.evidence.score)
    return MeshRegistration(
        place,
        None,
        best.score,
        max([0.0, *others]),
        int(best.explained.sum()),
        float(misfits[row]) if np.isfinite(misfits[row]) else None,
        surface.axis_of_revolution,
    )


def register_in_unit(
    nodes: Array,
    triangles: NDArray[np.int64],
    points: MapPoints,
    views: Sequence[View],
    camera: Camera,
    metric: bool,
    progress: bool = False,
    hints: Hints | None = None,
) -> MeshRegistration:
    """As `register_mesh`; an object that a metric map does not hold is looked for in other sizes.

    A monocular map has no unit: there an object of another size is found, with another map_units_per_metre.
    """
    try:
        return register_mesh(nodes, triangles, points, views, camera, metric, progress, hints)
    except RegistrationError as error:
        if not metric or hints is not None:
            raise
        try:
            found = register_mesh(nodes, triangles, points, views, camera, False, progress)
        except RegistrationError:
            raise error from None
        if found.ambiguous:
            raise
        raise RegistrationError(
            "the object was not found in its size, but one of its shape that is "
            f"{found.world_from_object.scale:.4g} times as large is there, and the map is metric: correct the "
            "unit of the study's mesh",
            RegistrationFailure.WRONG_SIZE,
        ) from None
