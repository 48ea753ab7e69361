"""Registration of a mesh by its edges in keyframes, with or without hints of where it is.

Some keyframes are searched for the object's edges, or landmarks say where it is in a frame. Points by depth
images or stereo on each hypothesis give the unit and speak for it. The best ones are fitted to points and edges of all
keyframes: a place that is right has its edges on theirs and their points on its surface, and a chance place seldom has
both.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import zip_longest

import numpy as np
from numpy.typing import NDArray

from morph_dslam.camera import Camera
from morph_dslam.errors import RegistrationError, RegistrationFailure
from morph_dslam.geometry import RigidTransform, SimilarityTransform, rotation_exp
from morph_dslam.registration.dense_points import DEPTH_NOISE, PointsOnSurface, with_dense_points
from morph_dslam.registration.edges import CLICK_PX, EdgeEvidence, EdgeImages, Sighting
from morph_dslam.registration.hints import NO_HINTS, GuessedPose, Hints
from morph_dslam.registration.icp import Surface, same_place
from morph_dslam.registration.mesh_edges import MeshEdges
from morph_dslam.registration.other_views import AskedView, gains_in
from morph_dslam.registration.point_evidence import PointEvidence, gather_evidence
from morph_dslam.registration.scene import METRIC_SCALE_STD, MapPoints, View, camera_from_object, spread_views, views_of
from morph_dslam.registration.search_space import on_large_planes
from morph_dslam.registration.starts import solve_pnp
from morph_dslam.registration.view_search import (
    EdgeDrawings,
    InView,
    hypotheses,
    map_unit,
    overlaps,
    placed,
    sizes_and_places,
)
from morph_dslam.threads import on_all_cores

Array = NDArray[np.float64]
#: A hypothesis needs so many points of the map that agree on a unit; where those of planes count, too, this share of
#: the points in its outline, and points that do not agree count twice.
FEWEST_AGREEING, AGREEING_SHARE = 6, 0.6
#: A metric map's unit may be off by this part where points on the object show it: its depths have errors.
UNIT_ERROR = 0.12
#: Log likelihood for a point that agrees, and against one that does not.
AGREES = 0.5
#: What several keyframes say counts by this, as steps of the search carry an object some way off in them.
BY_SEVERAL = 0.5
#: Edges of smaller objects, pixels, count less in proportion: their points are too near each other to be independent.
INDEPENDENT_PX = 200.0
#: Hypotheses of each ranking fitted to their own keyframe.
N_BY_ALL, N_BY_TELLING = 60, 300
#: Of these, those fitted to few keyframes from where they were found, as fitting them to their own may lead them away.
N_AS_FOUND = 20
#: Of the fitted ones, the best fitted to few keyframes, keyframes for it, and those of more.
N_FITTED, FEW_VIEWS, N_FINE, MORE_VIEWS = 30, 4, 8, 8
#: Edges say nothing where chance puts so much of an outline on some.
TELLING_CHANCE = 0.5
#: No other keyframe is searched if a place has such a rank, after the first one and later, and the next place less
#: than such a part of it. Places as good are fitted again from where each keyframe alone would have them.
ENOUGH, MUCH_WORSE = (0.5, 0.3), 0.5
#: So many keyframes are searched for that, and all until a place has this rank.
N_SEARCHED, SOMETHING = 3, 0.1
#: Sizes agree within so many standard deviations, where as much as this part still speaks for the place.
SIZES_AGREE, ABOUT_AS_MUCH = 2.0, 0.8
#: Hypotheses are alike in a square of so many pixels and within this of the size (log); so many of them are fitted.
CELL, SIZES_ALIKE, MOST_ALIKE = 64, 0.36, 3
#: Pixels searched in turn for them: in one keyframe, with few, with more of them, and from near.
QUICK, ROUGH, FINE, NEAREST = (8, 5, 3), (12, 8, 6, 4, 3), (8, 6, 5, 4, 3), (4, 3, 3, 3, 3, 3)
#: Keyframes that get points by stereo.
N_STEREO = 8
#: Where there are too few points to agree, edges decide among such places.
NO_POINTS = 0.05
#: A point lies on the object if it is so near to the surface, over the object's size.
TOLERANCE = 0.015
#: Units of the map that are tried where landmarks have the object: so many, from the one in which it is as far away as
#: the points are, divided by this, to that times this.
N_UNITS, UNIT_FROM = 9, 4.0
#: Fewer landmarks than this in a frame are tried in so many other places, too.
MANY_CLICKS, N_MEANT = 6, 12
#: Factor by which a rough distance may be off.
ROUGH_FACTOR = 1.5
#: A box that was drawn and that of the object's outline have so much in common, over what they cover together. A margin
#: of half the object's width on each side leaves a quarter, and the drawings of the search are a little off.
SAME_BOX = 0.2
#: A guess is one of so many places to begin from. The others are as far from it as guesses are from what is meant:
#: standard deviations in pixels, of the distance (log), and of the attitude, radians.
N_NEAR, NEAR_GUESS_PX, NEAR_GUESS_SIZE, NEAR_GUESS_TURN = 120, 12.0, 0.08, 0.12
#: Pixels searched in turn for the edges about these.
ABOUT_GUESS = (16, 8, 5, 3)


#: Takes points on other objects out of a map, and out of what its views have seen.
Claimed = Callable[[MapPoints, Sequence[View]], tuple[MapPoints, list[View]]]


@dataclass(frozen=True)
class EdgeRegistration:
    """An object laid by its edges.

    Attributes
    ----------
    place : metres to the map's unit.
    covariance : (7, 7) of log scale, rotation vector and translation about the mean node.
    edges : how much of its edges the keyframes show there.
    points : what the points of the map say.
    """

    place: SimilarityTransform
    covariance: Array
    edges: EdgeEvidence
    points: PointEvidence

    @property
    def rank(self) -> float:
        """What speaks for it."""
        return _rank(self.edges, self.points)


def _as_well_seen(other: EdgeRegistration, found: EdgeRegistration) -> bool:
    """Whether keyframes show as much of the outline at another place, as far as they agree on it.

    Edges place an object more exactly than points do, so that these choose among places where as many edges are seen.
    """
    return other.edges.gain >= found.edges.gain - found.edges.gain_std


def _rank(edges: EdgeEvidence, points: PointEvidence) -> float:
    """What speaks for a place, at most 1: its edges beyond chance and the points that agree must both do so."""
    return edges.total * max(points.agreement, NO_POINTS)


class EdgeSearch:
    """Finds an object by its edges.

    Parameters
    ----------
    nodes : (n, 3) metres.
    triangles : (m, 3) node indices.
    points : of the map.
    views : keyframes of the map.
    camera : of the views, without distortion.
    metric : whether the map's unit is the metre.
    hints : what is known of where the object is.
    claimed : takes points on other objects out of a map.
    most_keyframes : so many are searched at most; all by default.
    """

    def __init__(
        self,
        nodes: Array,
        triangles: NDArray[np.int64],
        points: MapPoints,
        views: Sequence[View],
        camera: Camera,
        metric: bool,
        hints: Hints = NO_HINTS,
        claimed: Claimed | None = None,
        most_keyframes: int | None = None,
    ) -> None:
        self.edges, self.surface = MeshEdges(nodes, triangles), Surface.of_mesh(nodes, triangles)
        self._points, self._views, self.camera, self.metric = points, list(views), camera, metric
        self._hints, self._claimed, self._most_keyframes = hints, claimed, most_keyframes
        self.scale_std = METRIC_SCALE_STD if metric else np.inf
        self._middle = self.edges.nodes.mean(axis=0)

    def search(self) -> list[EdgeRegistration]:
        """Distinct places, the best first; none where nothing resembles the object.

        Raises RegistrationError if a hint names what is not there.
        """
        if self._hints.clicks or self._hints.guess is not None:
            return self._in_box(self._polished(self._fitted_from(self._where_said())))
        found: list[EdgeRegistration] = []
        for number, view in enumerate(self._searched()):
            if number >= N_SEARCHED and found and found[0].rank >= SOMETHING:
                break
            found = self._distinct(found + self._fitted_from(self._in_keyframe(view)))
            ranks = [each.rank for each in found[:2]]
            if ranks and ranks[0] >= ENOUGH[min(number, 1)] and sum(ranks[1:]) <= MUCH_WORSE * ranks[0]:
                break
            # On a dense texture, edges are everywhere and say nothing, in other keyframes neither.
            if found and found[0].edges.chance >= TELLING_CHANCE:
                break
        return self._in_box(self._polished(found))

    def _in_box(self, found: list[EdgeRegistration]) -> list[EdgeRegistration]:
        """Those of the places that have the object in the box of the hints."""
        if self._hints.region is None or not found:
            return found
        frame, box = self._hints.region
        view = self._keyframe(frame)
        local = [camera_from_object(view, each.place).apply(self.edges.nodes) for each in found]
        pixels = [self.camera.project(nodes) if nodes[:, 2].min() > 0.0 else np.zeros((1, 2)) for nodes in local]
        boxes = np.array([np.concatenate([seen.min(axis=0), seen.max(axis=0)]) for seen in pixels])
        kept = overlaps(boxes, box, self.camera) >= SAME_BOX
        return [each for each, is_kept in zip(found, kept, strict=True) if is_kept]

    def _searched(self) -> list[View]:
        """Keyframes to search: that of the region; or one in the middle, an early, a late one, and the others."""
        views = self._dense[1]
        if self._hints.region is not None or not views:
            return views[:1]
        first = [len(views) // 2, len(views) // 6, 5 * len(views) // 6]
        return [views[k] for k in dict.fromkeys([*first, *range(len(views))])][: self._most_keyframes]

    def _fitted_from(self, starts: Sequence[SimilarityTransform]) -> list[EdgeRegistration]:
        """Distinct places near some others, the best first."""
        few = EdgeImages(spread_views(self._views, FEW_VIEWS), self.camera, self.scale_std)

        def rough(start: SimilarityTransform) -> tuple[float, SimilarityTransform]:
            place = few.refine(self.edges, start, ROUGH, self._hints.clicks, self._on_it)[0]
            return _rank(few.evidence(self.edges, place), self.points_at(place, FEW_VIEWS)), place

        chosen: list[SimilarityTransform] = []
        for _, place in sorted(on_all_cores(rough, starts), key=lambda pair: -pair[0]):
            if len(chosen) < N_FINE and not any(self.same(place, other) for other in chosen):
                chosen.append(place)
        return self._distinct(on_all_cores(lambda place: self._fitted(place, self._images(place), FINE), chosen))

    def _polished(self, found: Sequence[EdgeRegistration]) -> list[EdgeRegistration]:
        """Distinct places, the best first, those that may be right fitted from other starts, too."""
        best = max((each.rank for each in found), default=0.0)
        again = [self._again(each) if each.rank >= MUCH_WORSE * best else each for each in found]
        best = max((each.rank for each in again), default=0.0)
        return self._distinct([self._sized(each) if each.rank >= MUCH_WORSE * best else each for each in again])

    def _distinct(self, found: Sequence[EdgeRegistration]) -> list[EdgeRegistration]:
        """Those that are not the same place as a better one, the best first."""
        kept: list[EdgeRegistration] = []
        for each in sorted(found, key=lambda each: -each.rank):
            if not any(self.same(each.place, other.place) for other in kept):
                kept.append(each)
        return kept

    def same(self, a: SimilarityTransform, b: SimilarityTransform) -> bool:
        """Whether two places are one as a camera sees them; the map's unit may differ."""
        view = self._views[len(self._views) // 2]
        one, other = (camera_from_object(view, place) for place in (a, b))
        return same_place(
            SimilarityTransform(1.0, one.rotation, one.translation),
            SimilarityTransform(1.0, other.rotation, other.translation),
            self.surface,
        )

    def _fitted(self, start: SimilarityTransform, images: EdgeImages, reaches: Sequence[float]) -> EdgeRegistration:
        """The place near ``start`` for which most speaks: by edges in the size that points and edges give, or by edges.

        Points bring in what is far and give the size. But those around the object's foot may pull it, and edges are
        more exact.
        """
        clicks, edges = self._hints.clicks, self.edges
        by_both = images.refine(edges, start, reaches, clicks, self._on_it)
        by_edges = images.refine(edges, start, [*reaches, *NEAREST], clicks)
        in_size = images.refine(edges, by_both[0], NEAREST, clicks, keep_scale=True)[0]
        fits = [
            EdgeRegistration(place, covariance, images.evidence(edges, place), self.points_at(place))
            for place, covariance in (by_edges, (in_size, by_both[1]))
        ]
        return max(fits, key=lambda each: each.rank)

    def _again(self, found: EdgeRegistration) -> EdgeRegistration:
        """The best place near one that was found, of those begun where each keyframe alone has the object."""
        images = self._images(found.place)

        def from_view(view: View) -> EdgeRegistration:
            one = EdgeImages([view], self.camera)
            alone = one.refine(self.edges, found.place, NEAREST, self._hints.clicks, keep_scale=True)[0]
            pose = camera_from_object(view, alone)
            unit = map_unit(pose, self.edges, view, self._dense[0], self.camera)[0]
            start = placed(pose, view, unit if unit > 0.0 else alone.scale, self._middle, self.metric)
            return self._fitted(start, images, NEAREST)

        seeing = views_of(self.edges.nodes, found.place, self._dense[1], self.camera, MORE_VIEWS)
        fits = [each for each in on_all_cores(from_view, seeing) if _as_well_seen(each, found)]
        return max([found, *fits], key=lambda each: each.rank)

    def _sized(self, found: EdgeRegistration) -> EdgeRegistration:
        """A place with the size by its edges and the points in its outline together, unless they contradict each other.

        Where edges hardly tell the size they fit in many, and chance decides in which best. What lies beside the
        outline, as around the object's foot, is not on it.
        """
        seen, images = found.points, self._images(found.place)
        rows = np.flatnonzero(seen.explained | seen.occluded | seen.hidden_by)
        on_it = PointsOnSurface(self._dense[0][rows], self.surface, len(self._dense[1]))
        place, covariance = images.refine(self.edges, found.place, NEAREST, self._hints.clicks, on_it)
        sized = replace(self.at(place), covariance=covariance)
        apart = abs(np.log(place.scale / found.place.scale))
        agree = apart <= SIZES_AGREE * np.sqrt(found.covariance[0, 0]) and sized.rank > ABOUT_AS_MUCH * found.rank
        return sized if agree and _as_well_seen(sized, found) else found

    def _images(self, place: SimilarityTransform) -> EdgeImages:
        """Edges of the keyframes that see the object at a place."""
        views = views_of(self.edges.nodes, place, self._views, self.camera, MORE_VIEWS)
        return EdgeImages(views, self.camera, self.scale_std)

    def at(self, place: SimilarityTransform) -> EdgeRegistration:
        """What speaks for a place as it is."""
        edges = self._images(place).evidence(self.edges, place)
        return EdgeRegistration(place, np.zeros((7, 7)), edges, self.points_at(place))

    def points_at(self, place: SimilarityTransform, most: int = MORE_VIEWS) -> PointEvidence:
        """What the points seen in so many keyframes say of a place."""
        return self._points_in(place, views_of(self.edges.nodes, place, self._dense[1], self.camera, most))

    def _points_in(self, place: SimilarityTransform, views: Sequence[View]) -> PointEvidence:
        nodes, triangles = self.edges.drawn
        tolerance = TOLERANCE * self.edges.size * place.scale
        positions = self._dense[0].positions
        return gather_evidence(place, nodes, triangles, positions, views, self.camera, tolerance, DEPTH_NOISE)

    @cached_property
    def _dense(self) -> tuple[MapPoints, list[View]]:
        """The map with the points of edges and texture of some keyframes, and these."""
        asked = [] if self._hints.region is None else [self._keyframe(self._hints.region[0])]
        # Depth that was measured needs no other keyframe, and has no errors of their poses.
        with_depth = [view for view in self._views if len(view.depths)] if self.metric else []
        spread = spread_views(with_depth or self._views, N_STEREO)
        spread = [view for view in spread if all(view is not each for each in asked)]
        points, views = with_dense_points(self._points, self._views, asked + spread, self.camera)
        return (points, views) if self._claimed is None else self._claimed(points, views)

    def _keyframe(self, frame: int) -> View:
        """The keyframe of a number; raises RegistrationError if there is none."""
        for view in self._views:
            if view.frame == frame:
                return view
        numbers = ", ".join(str(view.frame) for view in self._views)
        raise RegistrationError(f"frame {frame} is no keyframe of the map: give the region in one of {numbers}")

    @cached_property
    def _off_planes(self) -> NDArray[np.bool_]:
        """Points that do not lie on the map's large planes, on which any flat face fits in any size."""
        points = self._dense[0]
        away = np.linalg.norm(points.positions - points.viewpoints, axis=1)
        return ~on_large_planes(points.positions, 0.5 * DEPTH_NOISE * float(np.median(away)))

    @cached_property
    def _drawings(self) -> EdgeDrawings:
        return EdgeDrawings.of(self.edges)

    @cached_property
    def _asked(self) -> list[AskedView]:
        """Keyframes that are asked of every hypothesis."""
        return [AskedView.of(view) for view in spread_views(self._views, FEW_VIEWS)]

    @cached_property
    def _on_it(self) -> PointsOnSurface:
        return PointsOnSurface(self._dense[0], self.surface, len(self._dense[1]))

    def _in_keyframe(self, view: View) -> list[SimilarityTransform]:
        """Where a keyframe may show the object, and the map has points that agree."""
        hints, camera = self._hints, self.camera
        if not np.ptp(view.normalized) > 0:
            return []
        frame_size = (0.0, 0.0, float(camera.width), float(camera.height))
        left, top, right, bottom = frame_size if hints.region is None else hints.region[1]
        inside = ((view.pixels > [left, top]) & (view.pixels < [right, bottom])).all(axis=1)
        sizes, places = sizes_and_places(camera, view.pixels[inside])
        if hints.distance is not None:
            apart = np.abs(np.log(self.edges.size * camera.fx / sizes / hints.distance))
            sizes = sizes[apart < np.log(ROUGH_FACTOR)]
        if hints.region is not None:
            places = places[((places > [left, top]) & (places < [right, bottom])).all(axis=1)]
        if not len(places) or not len(sizes):
            return []
        found = hypotheses(self._drawings, self.edges, view, camera, sizes, places)
        if found is not None and hints.region is not None:
            # The size is only known from the box of each drawing: a rod that is seen end on has a small one.
            found = found.chosen(overlaps(found.boxes(), hints.region[1], camera) >= SAME_BOX)
        starts = [] if found is None else self._agreeing(found, view)
        return self._best_in(view, starts, QUICK) + starts[:N_AS_FOUND]

    def _best_in(
        self, view: View, starts: Sequence[SimilarityTransform], reaches: Sequence[float]
    ) -> list[SimilarityTransform]:
        """The places near ``starts`` for which most speaks in one keyframe, the best first."""
        one = EdgeImages([view], self.camera)

        def ranked(start: SimilarityTransform) -> tuple[float, SimilarityTransform]:
            place = one.refine(self.edges, start, reaches, (), self._on_it, keep_scale=True)[0]
            return _rank(one.evidence(self.edges, place), self._points_in(place, [view])), place

        return [place for _, place in sorted(on_all_cores(ranked, starts), key=lambda pair: -pair[0])[:N_FITTED]]

    def _agreeing(self, found: InView, view: View) -> list[SimilarityTransform]:
        """The best of the hypotheses by their edges and by the points of the map in their outline, the best first."""
        unit, agreeing, off_planes, apart = found.units(view, self._dense[0], self._off_planes)
        possible = agreeing >= FEWEST_AGREEING
        if self.metric:
            possible &= np.abs(np.log(np.maximum(unit, 1e-300))) < UNIT_ERROR
        rows = np.flatnonzero(possible)
        gains = found.gains.copy()
        gains[rows] += BY_SEVERAL * gains_in(found, rows, unit[rows], view, self._asked)
        gains *= np.minimum(found.sizes / INDEPENDENT_PX, 1.0)
        mostly = possible & (agreeing >= AGREEING_SHARE * (agreeing + apart))
        by_all = np.where(mostly, gains + AGREES * (agreeing - 2 * apart), -np.inf)
        by_telling = np.where(possible, gains + AGREES * (off_planes - apart), -np.inf)
        # A large plane fits any flat face, so that its points may mislead; but the object's faces may be planes.
        both = _diverse(found, by_all, N_BY_ALL, N_BY_ALL), _diverse(found, by_telling, N_BY_TELLING, MOST_ALIKE)
        best = [k for pair in zip_longest(*both) for k in pair if k is not None]
        return [placed(found.pose(k), view, float(unit[k]), self._middle, self.metric) for k in dict.fromkeys(best)]

    def _where_said(self) -> list[SimilarityTransform]:
        """Where landmarks and a guess have the object."""
        starts = self._by_clicks()
        if self._hints.guess is not None:
            starts += self._by_guess(self._hints.guess)
        if not starts:
            raise RegistrationError(
                "no pose of the object explains the landmarks: give three or more in one frame, and check that points "
                "and pixels belong together",
                RegistrationFailure.LANDMARKS_DO_NOT_FIT,
            )
        return starts

    def _by_clicks(self) -> list[SimilarityTransform]:
        """Where landmarks in single frames have the object, in every unit that the points on it allow."""
        starts = list[SimilarityTransform]()
        for click in self._hints.clicks:
            if len(click.points) < 3:
                continue
            # Of few points, a pixel may turn the pose far: start from what the clicks may have meant, too.
            rng = np.random.default_rng(0)
            meant = [click] + [
                replace(click, pixels=click.pixels + CLICK_PX * rng.normal(size=click.pixels.shape))
                for _ in range(N_MEANT if len(click.points) < MANY_CLICKS else 0)
            ]
            poses = (pose for each in meant for pose in solve_pnp(each.points, each.pixels, self.camera))
            starts += [self._in_map(pose, click) for pose in poses]
        return starts

    def _by_guess(self, guess: GuessedPose) -> list[SimilarityTransform]:
        """Where the keyframe next to a guess has the object near it, the best first."""
        rng, pose = np.random.default_rng(0), guess.pose
        centre = pose.apply(self._middle)
        column, row = self.camera.project(centre[None])[0] if centre[2] > 0.0 else (-1.0, -1.0)
        if not (0.0 <= column < self.camera.width and 0.0 <= row < self.camera.height):
            raise RegistrationError(
                "the guess puts the object out of the image: its frame is the camera's, x right, y down, z ahead",
                RegistrationFailure.GUESS_CONTRADICTED,
            )
        starts = []
        for k in range(N_NEAR):
            spread = rng.normal(size=6) * (k > 0)  # the first is the guess itself
            turn = rotation_exp(NEAR_GUESS_TURN * spread[:3])
            aside = NEAR_GUESS_PX * spread[3:5] * centre[2] / self.camera.intrinsics[:2]
            there = np.exp(NEAR_GUESS_SIZE * spread[5]) * (centre + np.append(aside, 0.0))
            moved = RigidTransform(turn @ pose.rotation, there + turn @ (pose.translation - centre))
            starts.append(self._in_map(moved, guess))
        return self._best_in(self._beside(guess.frame), starts, ABOUT_GUESS)

    def _beside(self, frame: int) -> View:
        """The keyframe with dense points next to a frame."""
        return min(self._dense[1], key=lambda view: abs(view.frame - frame))

    def _in_map(self, pose: RigidTransform, seen: Sighting | GuessedPose) -> SimilarityTransform:
        """The place of an object at a pose, metres, in a frame, in the unit that the points on it give."""
        # The points are known where a keyframe sees them; the object stands still.
        view = self._beside(seen.frame)
        near = RigidTransform.from_matrix(view.camera_from_world.matrix @ np.linalg.inv(seen.camera_from_world.matrix))
        known = view.camera_from_world.apply(self._dense[0].positions[view.point_ids])[:, 2]
        # From the object's middle: its frame may have its origin anywhere.
        ahead = max(float(pose.apply(self._middle)[2]), 1e-9)
        usual = float(np.median(known)) / ahead if len(known) else 1.0
        # Points agree on the unit only about where it is right already. In their own view it changes nothing.
        factors = np.geomspace(1.0 / UNIT_FROM, UNIT_FROM, N_UNITS) if view.frame != seen.frame else np.ones(1)
        best, most = 1.0, 0
        for begun in usual * factors:
            unit, agreeing = float(begun), 0
            for _ in range(3):
                between = RigidTransform(near.rotation, near.translation / unit)
                found, agreeing, _ = map_unit(between @ pose, self.edges, view, self._dense[0], self.camera)
                unit = found if found > 0.0 else unit
            if agreeing > most:
                best, most = unit, agreeing
        return placed(pose, seen, best, self._middle, self.metric)


def _diverse(found: InView, speaking: Array, most: int, most_alike: int) -> list[int]:
    """The hypotheses for which most speaks (n,), but few that are alike; none for which nothing does (-inf)."""
    cells = np.column_stack([found.places // CELL, np.log(found.sizes) // SIZES_ALIKE]).astype(np.int64)
    best: list[int] = []
    taken = Counter[tuple[int, ...]]()
    for k in np.argsort(-speaking)[: int(np.isfinite(speaking).sum())].tolist():
        cell = tuple(cells[k].tolist())
        taken[cell] += 1
        if taken[cell] <= most_alike:
            best.append(k)
        if len(best) == most:
            break
    return best
