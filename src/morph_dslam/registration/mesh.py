"""Registration of a mesh in a map: where the object is, how large the map's unit is, and how sure that is.

The object is looked for by its edges in the keyframes and by points of their stereo (`EdgeSearch`). Where these show
no clear place, as in pictures full of texture, it is looked for by the points of the map alone (`places_by_points`).
The best place is refined by comparing the keyframes' images on it. Last, these are asked whether they show its outline
there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cache, partial
from itertools import permutations

import numpy as np
from numpy.typing import NDArray

from morph_dslam.camera import Camera
from morph_dslam.errors import RegistrationError, RegistrationFailure
from morph_dslam.geometry import SimilarityTransform
from morph_dslam.registration.adjusted_keyframes import AdjustedKeyframes, similarity_of_path
from morph_dslam.registration.edges import EdgeEvidence
from morph_dslam.registration.hints import NO_HINTS, Hints
from morph_dslam.registration.icp import Surface, same_place
from morph_dslam.registration.keyframe_adjustment import KeyframeAdjustment, KnownPlace
from morph_dslam.registration.messages import (
    UNITS,
    Ambiguity,
    Ambiguous,
    NotRefined,
    OutlineElsewhere,
    RegistrationWarning,
    TooLittleTexture,
    Unrefined,
)
from morph_dslam.registration.outline_fit import OutlineFit, outline_fit
from morph_dslam.registration.point_search import MOST_ASKED, Place, places_by_points
from morph_dslam.registration.registration import Axis, Rival
from morph_dslam.registration.scene import METRIC_SCALE_STD, MapPoints, View, spread_views, views_of
from morph_dslam.registration.texture import FEWEST, Agreement, TextureComparison
from morph_dslam.registration.view_registration import TELLING_CHANCE, Claimed, EdgeRegistration, EdgeSearch
from morph_dslam.sources.recorded import DEPTH_SCALE

Array = NDArray[np.float64]
#: Other places that are kept.
MOST_RIVALS = 3
#: The runner-up's score over the best's above which they are ambiguous.
AMBIGUOUS = 0.8
#: An object laid by its edges is confirmed from this score on, if so much of its outline is on edges, of what chance
#: does not put there, as far as the keyframes agree on it; where landmarks have it, by the outline alone. A little less
#: does where images on its surface show its shape: texture hides edges; but a wall and a table have the shape of many
#: objects, in some size.
CONFIRMED, OUTLINE_SHOWN, OUTLINE_OF_TEXTURED = 10.0, 0.5, 0.45
#: Below this score edges that no images confirm are not enough: the points of the map are searched as well.
SURE = 20.0
#: Images on the object that show its shape are believed before its edges, unless they lose more than this of the score;
#: and always where the adjusted keyframes agree on them to so many pixels, as they do if nothing is off but noise.
LOST, EXACT_PX = 5.0, 0.05
#: An object of another size than its mesh's by less than so many of these is the same one.
SAME_SIZE = 3.0
#: The edges speak against a place found by points below this.
AGAINST = 0.25
#: So many of the best places are compared by the images on them, if they score at least this part of the
#: best. Images that differ by more than this, pixels, or so many times as much as on another place, speak
#: against a place.
N_COMPARED, WORTH_COMPARING, POOR_AGREEMENT_PX, MUCH_WORSE = 4, 0.5, 0.35, 2.0
#: Where fewer of the points that two images both see look alike, it is not for want of texture that there are few.
MOSTLY_ALIKE = 0.5


@dataclass(frozen=True)
class MeshRegistration:
    """An object found in a map.

    Attributes
    ----------
    world_from_object : metres to the map's unit.
    covariance : (7, 7) of log scale, rotation vector and translation about the mean node, world; None if there
        was too little to compare.
    score : what speaks for it: with ``edges``, percent; else the points explained outside of one plane, less twice
        those it would occlude.
    rivals : the next best places, the best first.
    n_explained : points on the surface.
    rms_px : how far the keyframes' images of the surface agree; None if they were not compared or not believed.
    axis : about which the surface can be turned without a difference, so that this angle is not known.
    keyframes : those with a pose of their own about the object; None if there was too little to compare, or the images
        do not show its shape.
    outline : how much of its outline the keyframes show where it is.
    unconfirmed : what too little confirms: a place where nothing on the object could be compared in the images, as
        between a floor and a wall that have its shape in another size, or where no image shows any of its outline; or
        one that landmarks alone speak for. None if enough does.
    edges : how much of its edges the keyframes show, if it was found by these or they contradict the points.
    shape_shown : whether the images agree on the surface as they would on no flat one.
    unrefined : why the images did not refine the place; None if they did, or agree with it.
    """

    world_from_object: SimilarityTransform
    covariance: Array | None
    score: float
    rivals: tuple[Rival, ...]
    n_explained: int
    rms_px: float | None
    axis: Axis | None
    keyframes: AdjustedKeyframes | None = None
    outline: OutlineFit = field(default_factory=OutlineFit)
    unconfirmed: Ambiguity | None = None
    edges: EdgeEvidence | None = None
    shape_shown: bool = False
    unrefined: RegistrationWarning | None = None

    @property
    def runner_up(self) -> float:
        """The score of the next best place, 0 if there is none."""
        return self.rivals[0].score if self.rivals else 0.0

    @property
    def warnings(self) -> tuple[RegistrationWarning, ...]:
        """What a reader must know."""
        warnings: list[RegistrationWarning] = []
        if self.outline.contradicts or self._lacks_edges:
            by_edges = self.edges if self._lacks_edges else None
            warnings.append(OutlineElsewhere(self.outline.share if by_edges is None else by_edges.gain))
        elif self.unconfirmed is not None:
            warnings.append(Ambiguous(self.unconfirmed))
        elif self.rms_px is not None and self.rms_px > POOR_AGREEMENT_PX:
            warnings.append(Ambiguous(Ambiguity.IMAGES_DIFFER, self.rms_px))
        elif self.runner_up > max(AMBIGUOUS * self.score, 0.0):
            # A place that landmarks give may have no score of its own, as map points are few or seem occluded.
            share = self.runner_up / self.score if self.score > 0.0 else 1.0
            warnings.append(Ambiguous(Ambiguity.SECOND_PLACE, share))
        return tuple(warnings) if self.unrefined is None else (*warnings, self.unrefined)

    @property
    def _lacks_edges(self) -> bool:
        """Whether the keyframes show too little of its outline, beyond what they are apart on it."""
        enough = OUTLINE_OF_TEXTURED if self.shape_shown else OUTLINE_SHOWN
        return self.edges is not None and self.edges.is_below(enough)

    @property
    def ambiguous(self) -> bool:
        """Whether another place is nearly as good, or the images contradict this one or do not confirm it."""
        return any(isinstance(warning, Ambiguous | OutlineElsewhere) for warning in self.warnings)


def register_mesh(
    nodes: Array,
    triangles: NDArray[np.int64],
    points: MapPoints,
    views: Sequence[View],
    camera: Camera,
    metric: bool = False,
    progress: bool = False,
    hints: Hints = NO_HINTS,
    claimed: Claimed | None = None,
    most_keyframes: int | None = None,
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
    claimed : takes points on other objects out of a map.
    most_keyframes : so many are searched for edges at most; all by default.

    Raises
    ------
    RegistrationError
        If the object is not found, or a hint names what is not there.
    """
    search = EdgeSearch(nodes, triangles, points, views, camera, metric, hints, claimed, most_keyframes)
    places = search.search()
    if hints != NO_HINTS:
        if not places:
            raise RegistrationError(_not_found(hints), RegistrationFailure.NOT_FOUND)
        return _by_edges(places, search, points, views, bool(hints.clicks))
    score = 100.0 * places[0].rank if places else 0.0
    by_edges = cache(partial(_by_edges, places, search, points, views))
    is_clear = score >= CONFIRMED and by_edges().runner_up <= AMBIGUOUS * score
    if is_clear and (score >= SURE or by_edges().rms_px is not None):
        return by_edges()
    try:
        found = _by_points(search, points, views, progress)
    except RegistrationError:
        if score < CONFIRMED:
            raise
        return by_edges()
    there = search.at(found.world_from_object)
    if score >= CONFIRMED and there.rank < AMBIGUOUS * places[0].rank:
        return by_edges()
    if not there.edges.count and not found.shape_shown:
        # Large enough, an object fits around everything, and its surface to any plane.
        return replace(found, unconfirmed=Ambiguity.UNCONFIRMED)
    informative = 0.0 < there.edges.chance < TELLING_CHANCE and there.edges.gain < AGAINST
    contradicts = informative and there.edges.is_below(AGAINST if found.shape_shown else OUTLINE_SHOWN)
    return replace(found, edges=there.edges) if contradicts else found


def _not_found(hints: Hints) -> str:
    """That an object is not where the hints have it."""
    said = "no keyframe shows the object's edges where the hints have it"
    if hints.region is None:
        return f"{said}: check them and the unit of the mesh, or give three landmarks"
    frame, box = hints.region
    sides = ", ".join(f"{side:g}" for side in box)
    return (
        f"{said}, in the box ({sides}) of keyframe {frame} and about as large as that: draw it around the whole "
        "object, with little margin, or leave it out; check the unit of the mesh, or give three landmarks"
    )


def _by_edges(
    places: list[EdgeRegistration],
    search: EdgeSearch,
    points: MapPoints,
    views: Sequence[View],
    by_clicks: bool = False,
) -> MeshRegistration:
    """The best of the places, refined by the images on it where its edges stay; the others are its rivals."""
    best, nodes, triangles = places[0], search.edges.nodes, search.edges.triangles
    axis, score = search.surface.axis_of_revolution, 100.0 * best.rank
    asked = spread_views(views, MOST_ASKED)
    found = MeshRegistration(
        best.place,
        best.covariance,
        score,
        _best_rivals([Rival(other.place, 100.0 * other.rank) for other in places[1:]]),
        int(best.points.explained.sum()),
        None,
        axis,
        outline=outline_fit(best.place, nodes, triangles, asked, search.camera),
        unconfirmed=_doubt(best, by_clicks),
        edges=best.edges,
    )
    comparison = TextureComparison(nodes, triangles, search.camera)
    aligned = comparison.refine(best.place, views, search.scale_std)
    if aligned is None:
        return replace(found, unrefined=_why_not_compared(comparison, search, best.place, views))
    if aligned.rms_px > POOR_AGREEMENT_PX:
        return replace(found, unrefined=NotRefined(Unrefined.IMAGES_DIFFER, aligned.rms_px))
    adjustment = KeyframeAdjustment(nodes, triangles, search.camera, points, views, axis)
    # As exact as the edges have it, where the images have it: what these leave open stayed there. Edges were fitted
    # with what a metric map says of the scale, which counts once.
    known = KnownPlace(aligned.place, best.covariance)
    adjusted = _adjusted(
        replace(found, world_from_object=aligned.place, rms_px=aligned.rms_px, shape_shown=aligned.shows_its_shape),
        adjustment,
        nodes.mean(axis=0),
        np.inf,
        known,
    )
    if adjusted.keyframes is None:
        return replace(found, unrefined=_why_not_compared(comparison, search, aligned.place, views))
    there, is_exact = search.at(adjusted.world_from_object), adjusted.keyframes.rms_px <= EXACT_PX
    if 100.0 * there.rank < score - LOST and not is_exact:
        return replace(found, unrefined=NotRefined(Unrefined.OFF_EDGES, 100.0 * there.rank))
    if not (aligned.shows_its_shape or is_exact):
        return replace(found, rms_px=aligned.rms_px)
    outline = outline_fit(adjusted.world_from_object, nodes, triangles, asked, search.camera)
    # In texture, edges have the object in several sizes about the place that images give.
    rivals = tuple(
        rival for rival in found.rivals if not search.same(rival.world_from_object, adjusted.world_from_object)
    )
    # Images that show its shape confirm where landmarks have it.
    unconfirmed = None if by_clicks else found.unconfirmed
    return replace(adjusted, edges=there.edges, outline=outline, rivals=rivals, unconfirmed=unconfirmed)


def _doubt(best: EdgeRegistration, by_clicks: bool) -> Ambiguity | None:
    """What too little of edges and points confirms about a place; None if enough does.

    Of a smooth body that landmarks place there may be few points; but its outline must be seen beyond doubt, and the
    points that there are must not contradict it.
    """
    if 100.0 * best.rank >= CONFIRMED:
        return None
    if not by_clicks:
        return Ambiguity.UNCONFIRMED
    is_shown = best.edges.is_above(OUTLINE_SHOWN) and not best.points.contradicts
    return None if is_shown else Ambiguity.LANDMARKS_UNCONFIRMED


def doubted(found: MeshRegistration) -> MeshRegistration:
    """A registration by a map that is in doubt itself: landmarks, which rest on it, need its edges or images, too."""
    is_confirmed = found.edges is None or found.score >= CONFIRMED or found.shape_shown
    if is_confirmed or found.unconfirmed is not None:
        return found
    return replace(found, unconfirmed=Ambiguity.LANDMARKS_UNCONFIRMED)


def _why_not_compared(
    comparison: TextureComparison, search: EdgeSearch, place: SimilarityTransform, views: Sequence[View]
) -> RegistrationWarning:
    """Why too little of the images could be compared with the object at a place."""
    seeing = views_of(search.edges.nodes, place, views, search.camera, len(views))
    if len(seeing) < 2:
        return NotRefined(Unrefined.FEW_KEYFRAMES, len(seeing))
    compared, alike = comparison.alike(place, views)
    if compared < FEWEST or alike >= MOSTLY_ALIKE * compared:
        return TooLittleTexture()
    return NotRefined(Unrefined.LOOK_DIFFERENT, alike / compared)


def _by_points(search: EdgeSearch, points: MapPoints, views: Sequence[View], progress: bool) -> MeshRegistration:
    """The object found by the points of the map alone; parameters as of `register_mesh`."""
    surface, nodes, triangles, camera = search.surface, search.edges.nodes, search.edges.triangles, search.camera
    candidates = places_by_points(search, points, views, progress)
    comparison = TextureComparison(nodes, triangles, camera)
    aligned = [comparison.refine(place.transform, views, search.scale_std) for place in _worth_comparing(candidates)]
    found = _chosen(candidates, aligned, surface)
    if found.rms_px is not None:
        adjustment = KeyframeAdjustment(nodes, triangles, camera, points, views, surface.axis_of_revolution)
        found = _adjusted(found, adjustment, nodes.mean(axis=0), search.scale_std)
    else:
        found = replace(found, unrefined=_why_not_compared(comparison, search, found.world_from_object, views))
    outline = outline_fit(found.world_from_object, nodes, triangles, spread_views(views, MOST_ASKED), camera)
    unconfirmed = found.rms_px is None and any(np.ptp(view.normalized) > 0 for view in views)
    return replace(found, outline=outline, unconfirmed=Ambiguity.UNCONFIRMED if unconfirmed else None)


def _best_rivals(others: list[Rival]) -> tuple[Rival, ...]:
    """The best of other places that anything speaks for."""
    return tuple(sorted((each for each in others if each.score > 0.0), key=lambda each: -each.score)[:MOST_RIVALS])


def _adjusted(
    found: MeshRegistration,
    adjustment: KeyframeAdjustment,
    mean_node: Array,
    scale_std: float,
    known: KnownPlace | None = None,
) -> MeshRegistration:
    """The registration with keyframes placed about the object, where there is enough to compare."""
    keyframes = adjustment.adjust(found.world_from_object, known)
    if keyframes is None:
        return found
    placed, covariance = similarity_of_path(keyframes, found.world_from_object, mean_node, scale_std)
    return replace(found, world_from_object=placed, covariance=covariance, keyframes=keyframes)


def _worth_comparing(candidates: list[Place]) -> list[Place]:
    """Of the candidates, the best first, those that score well."""
    least = WORTH_COMPARING * candidates[0].evidence.score
    return [place for place in candidates[:N_COMPARED] if place.evidence.score >= least]


def _chosen(candidates: list[Place], aligned: list[Agreement | None], surface: Surface) -> MeshRegistration:
    """The candidate on which the images agree best; ``aligned`` are the first ones, refined by images."""
    compared = candidates[: len(aligned)]
    moved = [place.transform if found is None else found.place for place, found in zip(compared, aligned, strict=True)]
    misfits = np.array([np.inf if found is None else found.rms_px for found in aligned])
    row = int(np.argmin(misfits))  # the first where no images can be compared
    best, place, refined = compared[row].evidence, moved[row], aligned[row]
    others = [Rival(other.transform, other.evidence.score) for other in candidates[len(compared) :]]
    for other, there, misfit in zip(compared, moved, misfits, strict=True):
        if misfit <= MUCH_WORSE * misfits[row] and not same_place(there, place, surface):
            others.append(Rival(there, other.evidence.score))
    return MeshRegistration(
        place,
        None,
        best.score,
        _best_rivals(others),
        int(best.explained.sum()),
        float(misfits[row]) if np.isfinite(misfits[row]) else None,
        surface.axis_of_revolution,
        shape_shown=refined is not None and refined.shows_its_shape,
    )


def same_size(scale: float) -> bool:
    """Whether an object of this scale in a metric map may have its mesh's size."""
    return bool(abs(np.log(scale)) < SAME_SIZE * METRIC_SCALE_STD)


def register_in_unit(
    nodes: Array,
    triangles: NDArray[np.int64],
    points: MapPoints,
    views: Sequence[View],
    camera: Camera,
    metric: bool,
    progress: bool = False,
    hints: Hints = NO_HINTS,
    claimed: Claimed | None = None,
) -> MeshRegistration:
    """As `register_mesh`; an object that a metric map does not hold is looked for in other sizes.

    A monocular map has no unit: there an object of another size is found, with another map_units_per_metre.
    """
    try:
        return register_mesh(nodes, triangles, points, views, camera, metric, progress, hints, claimed)
    except RegistrationError as error:
        if not metric or hints != NO_HINTS:
            raise
        try:
            # Whether it is there in another size is worth one keyframe's search, not as much as the first.
            found = register_mesh(
                nodes, triangles, points, views, camera, False, progress, claimed=claimed, most_keyframes=1
            )
        except RegistrationError:
            raise error from None
        if found.ambiguous:
            raise
        if same_size(found.world_from_object.scale):
            return found
        raise RegistrationError(
            _other_size(found.world_from_object.scale, any(len(view.depths) for view in views)),
            RegistrationFailure.WRONG_SIZE,
        ) from None


def _other_size(factor: float, has_depth: bool) -> str:
    """That the object is so many times as large as its mesh in a metric map, by depth images or by a stereo pair."""
    mesh = "the unit of its mesh (--unit of `morph build --rigid`, or that of the mesh in the study)"
    metre = DEPTH_SCALE if has_depth else "the baseline of the stereo pair"
    is_unit = any(same_size(factor * a / b) for a, b in permutations(UNITS.values(), 2))
    likelier, other = (mesh, metre) if is_unit else (metre, mesh)
    return (
        f"the object was not found in its size, but one of its shape that is {factor:.4g} times as large is there, and "
        f"the map is metric: correct {likelier}, or else {other}"
    )
