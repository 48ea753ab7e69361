"""Registration of a mesh by its edges in keyframes, with or without hints of where it is.

One keyframe is searched for the object's edges, or landmarks say where it is in a frame. The map's points on each
hypothesis give the unit and speak for it; the best ones are fitted to the edges of all keyframes, and these decide.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from morph_dslam.camera import Camera
from morph_dslam.errors import RegistrationError, RegistrationFailure
from morph_dslam.geometry import RigidTransform, SimilarityTransform, rotation_exp
from morph_dslam.registration.edges import CLICK_PX, EdgeEvidence, EdgeImages, MeshEdges, Sighting
from morph_dslam.registration.icp import Surface, same_place
from morph_dslam.registration.landmarks import solve_pnp
from morph_dslam.registration.scene import MapPoints, View, camera_from_object, spread_views, views_of
from morph_dslam.registration.search_space import plane_points
from morph_dslam.registration.view_search import EdgeDrawings, InView, hypotheses, map_unit, placed, sizes_and_places

Array = NDArray[np.float64]
#: A hypothesis needs so many points of the map that agree on a unit, and this share of those in its outline.
FEWEST_AGREEING, AGREEING_SHARE = 8, 0.6
#: A metric map's unit may be off by this part where points on the object show it: its depths have errors.
UNIT_ERROR = 0.12
#: Sums of log likelihoods: for a point that agrees, and against one that does not.
AGREES, DISAGREES = 0.5, 1.0
#: Hypotheses fitted to few keyframes, keyframes for it, and those fitted to more of them.
N_FITTED, FEW_VIEWS, N_FINE, MORE_VIEWS = 80, 4, 8, 12
#: Of these so many are fitted again from so many places around, turned by so much (rad) and moved by such a part of the
#: size: standard deviations.
N_AGAIN, N_AROUND, TURNED, MOVED = 12, 10, 0.08, 0.05
#: Pixels searched in turn for them.
ROUGH, FINE = (12, 8, 6, 4, 3), (8, 6, 5, 4, 3, 3, 3)
#: So many points must lie on the object outside of the one plane that holds most: a flat face fits on any print.
FEWEST_SOLID = 6
#: A point lies on the object if its depth is that of the surface, over the object's size.
ON_SURFACE = 0.06
#: Fewer landmarks than this in a frame are tried in so many other places, too.
MANY_CLICKS, N_MEANT = 6, 12
#: Factor by which a rough distance may be off.
ROUGH_FACTOR = 1.5


@dataclass(frozen=True)
class Hints:
    """What is known of where the object is in a map, each alone or together.

    Attributes
    ----------
    clicks : landmarks in frames whose camera is known.
    distance : rough distance of the object from the camera in the keyframes, metres.
    region : number of a keyframe, and left, top, right and bottom of a box around the object in it, pixels.
    """

    clicks: tuple[Sighting, ...] = ()
    distance: float | None = None
    region: tuple[int, tuple[float, float, float, float]] | None = None


@dataclass(frozen=True)
class EdgeRegistration:
    """An object laid by its edges.

    Attributes
    ----------
    place : metres to the map's unit.
    covariance : (7, 7) of log scale, rotation vector and translation about the mean node.
    edges : how much of its edges the keyframes show there.
    n_explained : points of the map on it.
    n_solid : those outside of the one plane that holds most.
    """

    place: SimilarityTransform
    covariance: Array
    edges: EdgeEvidence
    n_explained: int
    n_solid: int


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
    """

    def __init__(
        self,
        nodes: Array,
        triangles: NDArray[np.int64],
        points: MapPoints,
        views: Sequence[View],
        camera: Camera,
        metric: bool,
    ) -> None:
        self.edges, self.surface = MeshEdges(nodes, triangles), Surface.of_mesh(nodes, triangles)
        self._points, self._views, self.camera, self._metric = points, list(views), camera, metric

    def search(self, hints: Hints) -> list[EdgeRegistration]:
        """Distinct places, the best first; none where nothing resembles the object.

        Raises RegistrationError if a hint names what is not there.
        """
        starts = self._by_clicks(hints.clicks) if hints.clicks else self._in_keyframe(hints)
        few = EdgeImages(spread_views(self._views, FEW_VIEWS), self.camera)

        def fitted(starts: Sequence[SimilarityTransform]) -> list[tuple[float, SimilarityTransform]]:
            places = [few.refine(self.edges, start, self._metric, ROUGH, hints.clicks)[0] for start in starts]
            gains = [few.evidence(self.edges, place).total for place in places]
            return sorted(zip(gains, places, strict=True), key=lambda pair: -pair[0])

        first = fitted(starts)
        # A print has edges beside those of the object, which hold a fit that starts a little off.
        best = [place for _, place in first[: 0 if hints.clicks else N_AGAIN]]
        rough = sorted([*first, *fitted(self._around(best))], key=lambda pair: -pair[0])
        found: list[EdgeRegistration] = []
        for _, place in rough:
            if len(found) < N_FINE and not any(self._same(place, other.place) for other in found):
                found.append(self.refined(place, hints.clicks))
        found.sort(key=lambda each: -each.edges.total)
        kept: list[EdgeRegistration] = []
        for each in found:
            solid = bool(hints.clicks) or each.n_solid >= FEWEST_SOLID
            if solid and not any(self._same(each.place, other.place) for other in kept):
                kept.append(each)
        return kept

    def _around(self, places: Sequence[SimilarityTransform]) -> list[SimilarityTransform]:
        """Places a little off: turned, moved and, along the sight lines, scaled."""
        rng, centre = np.random.default_rng(0), self.edges.nodes.mean(axis=0)
        eye = self._views[len(self._views) // 2].camera_from_world.inverse.translation
        near = []
        for place in places:
            for _ in range(N_AROUND):
                turn = rotation_exp(TURNED * rng.normal(size=3)) @ place.rotation
                middle = place.apply(centre) + MOVED * self.edges.size * place.scale * rng.normal(size=3)
                farther = float(np.exp(0.0 if self._metric else MOVED * rng.normal()))
                middle = eye + farther * (middle - eye)
                scale = place.scale * farther
                near.append(SimilarityTransform(scale, turn, middle - scale * turn @ centre))
        return near

    def _same(self, a: SimilarityTransform, b: SimilarityTransform) -> bool:
        """Whether two places are one as a camera sees them; the map's unit may differ."""
        view = self._views[len(self._views) // 2]
        one, other = (camera_from_object(view, place) for place in (a, b))
        return same_place(
            SimilarityTransform(1.0, one.rotation, one.translation),
            SimilarityTransform(1.0, other.rotation, other.translation),
            self.surface,
        )

    def refined(self, start: SimilarityTransform, clicks: Sequence[Sighting] = ()) -> EdgeRegistration:
        """The place near ``start`` that has its edges on those of the keyframes that see it."""
        views = views_of(self.edges.nodes, start, self._views, self.camera, MORE_VIEWS)
        images = EdgeImages(views, self.camera)
        place, covariance = images.refine(self.edges, start, self._metric, FINE, clicks)
        # What the mesh's edges are off is the same in all keyframes.
        covariance = covariance * max(1, len(views))
        return EdgeRegistration(place, covariance, images.evidence(self.edges, place), *self._on_surface(place))

    def evidence(self, place: SimilarityTransform) -> EdgeEvidence:
        """How much of the object's edges the keyframes show at a place."""
        views = views_of(self.edges.nodes, place, self._views, self.camera, MORE_VIEWS)
        return EdgeImages(views, self.camera).evidence(self.edges, place)

    def _on_surface(self, place: SimilarityTransform) -> tuple[int, int]:
        """How many points of the map lie on the object, and of them outside of one plane."""
        local = place.inverse.apply(self._points.positions)
        near = self.surface.tree.query(local)[0] < ON_SURFACE / 2.0 * self.surface.size
        if near.sum() < 3:
            return int(near.sum()), 0
        flat = plane_points(local[near], ON_SURFACE / 2.0 * self.surface.size, np.random.default_rng(0))
        return int(near.sum()), int((~flat).sum())

    def _in_keyframe(self, hints: Hints) -> list[SimilarityTransform]:
        """Where one keyframe may show the object, and the map has points that agree."""
        view, camera = self._searched(hints), self.camera
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
            # The box's diagonal is that of the drawn outline, which is that of the mesh or less.
            across = float(np.hypot(right - left, bottom - top))
            sizes = sizes[(sizes > 0.8 * across) & (sizes < 1.5 * across)]
            places = places[((places > [left, top]) & (places < [right, bottom])).all(axis=1)]
        drawings = EdgeDrawings.of(self.edges)
        if not len(drawings.rotations) or not len(places):
            return []
        return self._agreeing(hypotheses(drawings, self.edges, view, camera, sizes, places), view)

    def _searched(self, hints: Hints) -> View:
        """The keyframe to search: that of the region, or the one that sees most points."""
        if hints.region is None:
            return self._views[len(self._views) // 2]
        for view in self._views:
            if view.frame == hints.region[0]:
                return view
        numbers = ", ".join(str(view.frame) for view in self._views)
        raise RegistrationError(
            f"frame {hints.region[0]} is no keyframe of the map: give the region in one of {numbers}"
        )

    def _agreeing(self, found: list[InView], view: View) -> list[SimilarityTransform]:
        """The best of the hypotheses by their edges and by the points of the map in their outline."""
        ranked = self._ranked(found, view)[:N_FITTED]
        return [placed(each.pose, view, unit, self._metric) for _, each, unit in ranked]

    def _ranked(self, found: Sequence[InView], view: View) -> list[tuple[float, InView, float]]:
        """Hypotheses with which the map agrees: what speaks for them, the best first, and the map's unit by them."""
        ranked = []
        for each in found:
            unit, agreeing, inside = map_unit(each.pose, self.edges, view, self._points, self.camera)
            if agreeing < FEWEST_AGREEING or agreeing < AGREEING_SHARE * inside:
                continue
            if self._metric and abs(np.log(unit)) > UNIT_ERROR:
                continue
            ranked.append((each.gain + AGREES * agreeing - DISAGREES * (inside - agreeing), each, unit))
        return sorted(ranked, key=lambda entry: -entry[0])

    def _by_clicks(self, clicks: Sequence[Sighting]) -> list[SimilarityTransform]:
        """Where landmarks in single frames have the object, in every unit that the points on it allow."""
        starts = []
        for click in clicks:
            if len(click.points) < 3:
                continue
            view = min(self._views, key=lambda view: abs(view.frame - click.frame))
            # Of few points, a pixel may turn the pose far: start from what the clicks may have meant, too.
            rng = np.random.default_rng(0)
            meant = [click] + [
                replace(click, pixels=click.pixels + CLICK_PX * rng.normal(size=click.pixels.shape))
                for _ in range(N_MEANT if len(click.points) < MANY_CLICKS else 0)
            ]
            for pose in (pose for each in meant for pose in solve_pnp(each.points, each.pixels, self.camera)):
                # The points are known where a keyframe sees them; the object stands still.
                near = RigidTransform.from_matrix(
                    view.camera_from_world.matrix @ np.linalg.inv(click.camera_from_world.matrix)
                )
                unit = 1.0
                for _ in range(3):
                    between = RigidTransform(near.rotation, near.translation / unit)
                    found = map_unit(between @ pose, self.edges, view, self._points, self.camera)[0]
                    unit = found if found > 0.0 else unit
                starts.append(placed(pose, click, unit, self._metric))
        if not starts:
            raise RegistrationError(
                "no pose of the object explains the landmarks: give three or more in one frame, and check that points "
                "and pixels belong together",
                RegistrationFailure.LANDMARKS_DO_NOT_FIT,
            )
        return starts
