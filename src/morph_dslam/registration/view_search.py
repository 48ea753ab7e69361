"""Where one keyframe may show an object: its edges, drawn from many sides, compared with those of the image.

The mesh is metric, so every apparent size is a distance, and the map's unit follows from the map's points on the
object. Drawings of the edges from sides spread over the sphere are laid over the image, turned and in several sizes
(Ulrich, Wiedemann & Steger, Combining scale-space and similarity-based aspect graphs for fast 3D object recognition,
2012). A point that meets an edge of its direction counts by how much likelier that is on the object than by chance in
this part of the image (Olson & Huttenlocher, Automatic target recognition by matching oriented edge pixels, 1997), so
that a cluttered print does not win by its many edges.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from morph_dslam.camera import Camera
from morph_dslam.geometry import RigidTransform, SimilarityTransform
from morph_dslam.registration.edges import LEAST_EDGE, SHOWN
from morph_dslam.registration.mesh_edges import MeshEdges
from morph_dslam.registration.scene import HasPose, MapPoints, View
from morph_dslam.threads import on_all_cores

Array = NDArray[np.float64]
#: Sides from which the edges are drawn, turns of each drawing in the image, points compared, and directions of edges.
N_SIDES, N_TURNS, N_POINTS, N_DIRECTIONS = 160, 24, 48, 8
#: The image is halved; a point meets an edge within so many of these pixels, and the drawing moves by so many.
HALF, TOLERANCE, STEP = 2, 2.0, 4
#: A turned drawing is left where its first points add up to nothing, or some more of them to less than this.
FEW_POINTS, MORE_POINTS, MORE_GAIN = 6, 12, 3.0
#: Gains are whole numbers of so many to 1, and are looked at in blocks of so many places.
PER_GAIN, BLOCK = 40, 64
#: Window over which chance is measured, pixels of the halved image.
WINDOW = 65
#: Apparent diameters tried, over the image's height, and the factor from one to the next.
SMALLEST, LARGEST, FACTOR = 0.12, 0.9, 1.2
#: Points of the map are this near to the object's middle, over the image's height.
NEAR = 0.125
#: Distance at which the edges are drawn, and what is seen of it there to either side, over the object's size; pixels of
#: the drawn depth for it.
DRAWN_AT, SEEN, DEPTH_PX = 4.0, 0.7, 40
#: Hypotheses kept of each size, and side of the squares of which only the best one of each side is, pixels.
MOST, MOST_OF_SIDE, CELL = 4000, 400, 12
#: Hypotheses are worked on in so many parts.
N_PARTS = 16
#: Points of the map on the object have distances alike to this part, and at least so many give the map's unit.
ALIKE, FEWEST_POINTS = 0.03, 4


@dataclass(frozen=True)
class EdgeDrawings:
    """The edges of an object from many sides, over its diameter.

    Attributes
    ----------
    rotations : (s, 3, 3) camera from object.
    offsets : (s, N_POINTS, 2) from the object's middle, in parts of its size times focal length over distance.
    normals : (s, N_POINTS) direction across the edge in the image, rad.
    points : (s, N_POINTS, 3) object frame, from its middle, metres.
    depths : (s, d, d) how far its surface is behind its middle, in its size; inf where it is not. The drawing reaches
        `SEEN` times its size to all sides.
    """

    rotations: Array
    offsets: Array
    normals: Array
    points: Array
    depths: Array

    @property
    def tangents(self) -> Array:
        """Along the edges (s, N_POINTS, 3), object frame, as far as they are seen across the sight line."""
        along = np.stack([-np.sin(self.normals), np.cos(self.normals)], axis=2)
        return np.asarray(along @ self.rotations[:, :2])

    @classmethod
    def of(cls, edges: MeshEdges) -> EdgeDrawings:
        """Draw the edges of a mesh from sides spread evenly over the sphere (Fibonacci's spiral)."""
        number = np.arange(N_SIDES) + 0.5
        up, turn = 1.0 - 2.0 * number / N_SIDES, np.pi * (1.0 + 5.0**0.5) * number
        flat = np.sqrt(1.0 - up**2)
        sights = np.column_stack([flat * np.cos(turn), flat * np.sin(turn), up])
        focal = 100.0 * DRAWN_AT
        camera = Camera(256, 256, focal, focal, 127.5, 127.5)
        short, middle = DRAWN_AT * DEPTH_PX / (2.0 * SEEN), 0.5 * (DEPTH_PX - 1)
        small = Camera(DEPTH_PX, DEPTH_PX, short, short, middle, middle)
        centre = 0.5 * (edges.nodes.min(axis=0) + edges.nodes.max(axis=0))
        rng = np.random.default_rng(0)
        rotations, offsets, normals, points, depths = [], [], [], [], []
        for sight in sights:
            rotation = Rotation.align_vectors([[0.0, 0.0, 1.0]], [sight])[0].as_matrix()
            pose = RigidTransform(rotation, np.array([0.0, 0.0, DRAWN_AT * edges.size]) - rotation @ centre)
            seen = edges.visible(pose, camera)
            chosen = rng.permutation(len(seen.pixels))[:N_POINTS]
            if len(chosen) == N_POINTS:
                rotations.append(rotation)
                offsets.append((seen.pixels[chosen] - 127.5) / 100.0)
                normals.append(np.arctan2(seen.normals[chosen, 1], seen.normals[chosen, 0]))
                points.append(seen.points[chosen] - centre)
                depths.append(edges.depth(pose, small) / edges.size - DRAWN_AT)
        return cls(*(np.array(each) for each in (rotations, offsets, normals, points, depths)))


def edge_gains(view: View, tolerance: float = TOLERANCE) -> NDArray[np.int8]:
    """By how much an edge of each direction speaks for the object at each pixel (`N_DIRECTIONS`, h / 2, w / 2).

    Over `PER_GAIN`, the log of the likelihood of what is seen there, an edge of that direction or none, on an edge of
    the object over that in the image around.
    """
    small = cv2.resize(view.normalized, None, fx=1 / HALF, fy=1 / HALF, interpolation=cv2.INTER_AREA)
    smooth = cv2.GaussianBlur(small, (0, 0), 0.8).astype(np.float32)
    gx, gy = cv2.Sobel(smooth, cv2.CV_32F, 1, 0) / 8.0, cv2.Sobel(smooth, cv2.CV_32F, 0, 1) / 8.0
    strength, angle = np.hypot(gx, gy), np.arctan2(gy, gx)
    gains = []
    for k in range(N_DIRECTIONS):
        apart = np.abs((angle - np.pi * k / N_DIRECTIONS + np.pi / 2) % np.pi - np.pi / 2)
        is_edge = (strength > LEAST_EDGE) & (apart < 0.75 * np.pi / N_DIRECTIONS)
        away = cv2.distanceTransform((~is_edge).astype(np.uint8), cv2.DIST_L2, 3)
        hit = (away <= tolerance).astype(np.float32)
        chance = np.clip(cv2.blur(hit, (WINDOW, WINDOW)), 0.05, 0.95)
        shown = np.maximum(SHOWN, chance)
        gains.append(np.where(hit > 0, np.log(shown / chance), np.log((1.0 - shown) / (1.0 - chance))))
    return np.rint(PER_GAIN * np.asarray(gains)).astype(np.int8)


def in_phases(gains: NDArray[np.int8], margin: int) -> NDArray[np.int8]:
    """Gains (d, h, w) with a margin of zeros, so that those at every `STEP`-th pixel are neighbours.

    Returns
    -------
    (d, STEP, STEP, rows, columns): pixel (x, y) is at [:, v % STEP, u % STEP, v // STEP, u // STEP], where u and v are
    ``margin`` more than x and y.
    """
    height, width = (int(np.ceil((side + 2 * margin) / STEP)) * STEP for side in gains.shape[1:])
    wide = np.zeros((len(gains), height, width), np.int8)
    wide[:, margin : margin + gains.shape[1], margin : margin + gains.shape[2]] = gains
    split = wide.reshape(len(gains), height // STEP, STEP, width // STEP, STEP)
    return np.ascontiguousarray(split.transpose(0, 2, 4, 1, 3))


@njit(cache=True, nogil=True)
def lay_over(phases, margin, offsets, normals, turns, size, columns, rows, best, which):
    """Lay all drawings, turned, over places of an image, and keep the best of each side at each place.

    Parameters
    ----------
    phases : of `in_phases`: all places from the first to the last one are added in one go.
    margin : of them; no drawing reaches farther.
    offsets : (s, p, 2) of the drawings.
    normals : (s, p) of the drawings.
    turns : number of turns.
    size : of the object, pixels.
    columns : (k,) of the places, over `STEP`, rising in each row.
    rows : (k,) likewise, rising.
    best : (k, s) int16 sums of gains, filled.
    which : (k, s) int16 the turn that gives it, filled.
    """
    n_directions, _, _, height, width = phases.shape
    n_sides, n_points = offsets.shape[:2]
    flat, start = phases.reshape(-1), np.empty(n_points, np.int64)
    low = rows[0] * width + columns[0]
    count = rows[-1] * width + columns[-1] - low + 1
    place_at = np.full(count, -1)
    for place in range(len(columns)):
        place_at[rows[place] * width + columns[place] - low] = place
    few, more = np.empty(count, np.int16), np.empty(count, np.int16)
    for side in range(n_sides):
        for turn in range(turns):
            angle = 2.0 * np.pi * turn / turns
            c, s = np.cos(angle), np.sin(angle)
            for p in range(n_points):
                u, v = size * offsets[side, p, 0], size * offsets[side, p, 1]
                x, y = int(np.rint(c * u - s * v)) + margin, int(np.rint(s * u + c * v)) + margin
                direction = int(np.rint((normals[side, p] + angle) / np.pi * n_directions)) % n_directions
                phase = (direction * STEP + y % STEP) * STEP + x % STEP
                start[p] = (phase * height + y // STEP) * width + x // STEP + low
            few[:] = 0
            _add_lines(flat, start[:FEW_POINTS], few)
            for k in range(count):
                more[k] = few[k]
            _add_lines(flat, start[FEW_POINTS:MORE_POINTS], more)
            for first in range(0, count, BLOCK):
                if _largest(more[first : first + BLOCK]) < MORE_GAIN * PER_GAIN:
                    continue
                for k in range(first, min(first + BLOCK, count)):
                    place = place_at[k]
                    if place < 0 or few[k] < 0 or more[k] < MORE_GAIN * PER_GAIN:
                        continue
                    total = np.int64(more[k])
                    for p in range(MORE_POINTS, n_points):
                        total += flat[start[p] + k]
                    if total > best[place, side]:
                        best[place, side], which[place, side] = total, turn


@njit(cache=True, nogil=True)
def _add_lines(flat, starts, sums):
    """Add stretches of whole numbers. As slices: an index that might be negative would be looked at one by one."""
    for start in starts:
        line = flat[start : start + len(sums)]
        for k in range(len(sums)):
            sums[k] += line[k]


@njit(cache=True, nogil=True)
def _largest(values):
    largest = values[0]
    for value in values:
        largest = max(largest, value)
    return largest


@dataclass(frozen=True)
class InView:
    """Hypotheses of where one view shows an object.

    Attributes
    ----------
    drawings : of the object.
    centre : (3,) its middle, metres.
    diameter : of the object, metres.
    camera : of the view.
    gains : (n,) sums of what speaks for the edges there.
    sizes : (n,) apparent diameters, pixels.
    sides : (n,) which of the drawings.
    turns : (n,) and its turn in the image.
    places : (n, 2) where its middle is, pixels.
    """

    drawings: EdgeDrawings
    centre: Array
    diameter: float
    camera: Camera
    gains: Array
    sizes: Array
    sides: NDArray[np.int64]
    turns: NDArray[np.int64]
    places: Array

    def pose(self, k: int) -> RigidTransform:
        """The camera_from_object, metres, of one of them."""
        (rotation,), (middle,) = self.poses(np.array([k]))
        return RigidTransform(rotation, middle - rotation @ self.centre)

    def poses(self, rows: NDArray[np.int64]) -> tuple[Array, Array]:
        """Rotations (k, 3, 3), camera_from_object, and places (k, 3) of the object's middle in the camera, metres."""
        rays = self.camera.rays(self.places[rows])
        x, y, z = (rays / np.linalg.norm(rays, axis=1, keepdims=True)).T
        # The shortest turn from the optical axis to the ray.
        share, zeros = 1.0 / (1.0 + z), np.zeros(len(x))
        towards = np.stack([1.0 - share * x * x, -share * x * y, x, -share * x * y, 1.0 - share * y * y, y, -x, -y, z])
        angles = 2.0 * np.pi * self.turns[rows] / N_TURNS
        c, s = np.cos(angles), np.sin(angles)
        about = np.stack([c, -s, zeros, s, c, zeros, zeros, zeros, zeros + 1.0])
        turns = towards.T.reshape(-1, 3, 3) @ about.T.reshape(-1, 3, 3) @ self.drawings.rotations[self.sides[rows]]
        return turns, (self.diameter * self.camera.fx / self.sizes[rows])[:, None] * rays

    def boxes(self) -> Array:
        """Left, top, right and bottom (n, 4) of the drawn edges, pixels."""
        angles = 2.0 * np.pi * np.arange(N_TURNS) / N_TURNS
        c, s = np.cos(angles), np.sin(angles)
        turns = np.array([[c, -s], [s, c]])
        turned = np.einsum("xyt,spy->stpx", turns, self.drawings.offsets)
        ends = np.concatenate([turned.min(axis=2), turned.max(axis=2)], axis=2)
        return np.tile(self.places, 2) + self.sizes[:, None] * ends[self.sides, self.turns]

    def chosen(self, kept: NDArray[np.bool_]) -> InView:
        """Those of them that are kept (n,)."""
        return replace(
            self,
            gains=self.gains[kept],
            sizes=self.sizes[kept],
            sides=self.sides[kept],
            turns=self.turns[kept],
            places=self.places[kept],
        )

    def units(
        self, view: View, points: MapPoints, telling: NDArray[np.bool_]
    ) -> tuple[Array, NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
        """The map's unit by all of them, (n,) each, from the drawings.

        Parameters
        ----------
        view : of the hypotheses.
        points : of the map.
        telling : (p,) which of them are also counted by themselves.

        Returns
        -------
        The map's units per metre, numbers of points that agree on them, of telling ones that do, and of points in the
        outline that do not.
        """
        rays = self.camera.rays(self.places)
        rays = rays / np.linalg.norm(rays, axis=1, keepdims=True)
        depths = view.camera_from_world.apply(points.positions[view.point_ids])[:, 2]
        angles = 2.0 * np.pi * self.turns / N_TURNS
        distances = self.camera.fx / self.sizes

        def units_of(rows: NDArray[np.int64]) -> tuple[Array, NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
            return units_by_drawings(
                self.drawings.depths,
                self.sides[rows],
                angles[rows],
                self.sizes[rows],
                self.places[rows],
                rays[rows],
                distances[rows],
                view.pixels,
                depths,
                telling[view.point_ids],
            )

        parts = on_all_cores(units_of, np.array_split(np.arange(len(angles)), N_PARTS))
        units, agreeing, telling_ones, others = (np.concatenate(part) for part in zip(*parts, strict=True))
        return units / self.diameter, agreeing, telling_ones, others


@njit(cache=True, nogil=True)
def units_by_drawings(drawn, sides, angles, sizes, places, rays, distances, pixels, depths, telling):
    """The unit on which most points agree, for hypotheses of where an object of diameter 1 is seen.

    Parameters
    ----------
    drawn : (s, d, d) depths of `EdgeDrawings`.
    sides : (n,) which of them.
    angles : (n,) by which they are turned, rad.
    sizes : (n,) apparent diameters, pixels.
    places : (n, 2) of the middle, pixels.
    rays : (n, 3) unit vectors through them.
    distances : (n,) of the middle, along the optical axis, in diameters.
    pixels : (k, 2) of points.
    depths : (k,) of points, the map's unit.
    telling : (k,) points that are also counted by themselves.

    Returns
    -------
    Units of the map (n,), numbers (n,) of points that agree on it, of telling ones that do, and of points in the
    outline that do not.
    """
    n, width = len(sides), drawn.shape[1]
    units, counts = np.zeros(n), np.zeros((3, n), np.int64)
    ratios, tells = np.empty(len(depths)), np.empty(len(depths), np.bool_)
    for h in range(n):
        c, s, count = np.cos(angles[h]), np.sin(angles[h]), 0
        for p in range(len(depths)):
            x, y = (pixels[p, 0] - places[h, 0]) / sizes[h], (pixels[p, 1] - places[h, 1]) / sizes[h]
            if x * x + y * y > SEEN * SEEN:
                continue
            column = int(np.rint((c * x + s * y) / SEEN * 0.5 * width + 0.5 * (width - 1)))
            row = int(np.rint((c * y - s * x) / SEEN * 0.5 * width + 0.5 * (width - 1)))
            inside = 0 <= column < width and 0 <= row < width
            if not inside or not np.isfinite(drawn[sides[h], row, column]):
                continue
            # The drawing faces the camera: beside the optical axis it is tilted.
            behind = rays[h, 2] * drawn[sides[h], row, column] - rays[h, 0] * x - rays[h, 1] * y
            ratios[count], tells[count] = depths[p] / (distances[h] + behind), telling[p]
            count += 1
        if count < FEWEST_POINTS:
            continue
        ranked, first, least, largest = np.sort(ratios[:count]), 0, 0.0, 0.0
        for last in range(count):
            while ranked[last] > ranked[first] * (1.0 + 2.0 * ALIKE):
                first += 1
            if last - first + 1 > counts[0, h]:
                counts[0, h], units[h] = last - first + 1, ranked[(first + last) // 2]
                least, largest = ranked[first], ranked[last]
        for k in range(count):
            if tells[k] and least <= ratios[k] <= largest:
                counts[1, h] += 1
        counts[2, h] = count - counts[0, h]
    return units, counts[0], counts[1], counts[2]


def hypotheses(
    drawings: EdgeDrawings, edges: MeshEdges, view: View, camera: Camera, sizes: Array, places: Array
) -> InView | None:
    """Where a view may show the object; None if it has no edges.

    Parameters
    ----------
    drawings : of the object.
    edges : of the object.
    view : to search.
    camera : of the view.
    sizes : apparent diameters to try, pixels.
    places : (k, 2) pixels at which its middle may be, some of those of `sizes_and_places`, in their order.
    """
    if not len(drawings.rotations):
        return None
    columns, rows = np.rint((places + 0.5) / HALF - 0.5).astype(np.int64).T
    cells = rows // CELL * 10000 + columns // CELL
    margin = int(np.ceil(sizes.max() / HALF * np.linalg.norm(drawings.offsets, axis=2).max())) + 1
    phases = in_phases(edge_gains(view), margin)

    def of_size(size: float) -> tuple[Array, Array, NDArray[np.int64], NDArray[np.int16], Array]:
        best = np.zeros((len(places), len(drawings.rotations)), np.int16)
        which = np.zeros(best.shape, np.int16)
        lay_over(
            phases,
            margin,
            drawings.offsets,
            drawings.normals,
            N_TURNS,
            size / HALF,
            columns // STEP,
            rows // STEP,
            best,
            which,
        )
        # The best of each side in each square.
        order = np.argsort(-best, axis=0, kind="stable")[:MOST_OF_SIDE]
        kept = [order[np.unique(cells[order[:, side]], return_index=True)[1], side] for side in range(best.shape[1])]
        sides = np.repeat(np.arange(best.shape[1]), [len(places_kept) for places_kept in kept])
        at = np.concatenate(kept)
        chosen = np.argsort(-best[at, sides], kind="stable")[:MOST]
        at, sides = at[chosen], sides[chosen]
        return best[at, sides] / PER_GAIN, np.full(len(at), size), sides, which[at, sides], places[at]

    found = on_all_cores(of_size, sizes.tolist())
    gain, apparent, side, turn, place = (np.concatenate(part) for part in zip(*found, strict=True))
    centre = 0.5 * (edges.nodes.min(axis=0) + edges.nodes.max(axis=0))
    return InView(drawings, centre, edges.size, camera, gain, apparent, side, turn.astype(np.int64), place)


def sizes_and_places(camera: Camera, pixels: Array) -> tuple[Array, Array]:
    """Apparent diameters (s,), pixels, and places (k, 2) for the object's middle.

    Those with points of the map, seen at pixels (p, 2), near.
    """
    count = int(np.log(LARGEST / SMALLEST) / np.log(FACTOR)) + 1
    sizes = np.asarray(SMALLEST * camera.height * FACTOR ** np.arange(count), dtype=np.float64)
    step, near = STEP * HALF, NEAR * camera.height
    grid = np.stack(np.meshgrid(np.arange(step, camera.width, step), np.arange(step, camera.height, step)), axis=-1)
    places = grid.reshape(-1, 2).astype(float)
    if not len(pixels):
        return sizes, places[:0]
    count_near = KDTree(pixels).query_ball_point(places, near, return_length=True)
    return sizes, places[np.asarray(count_near) >= FEWEST_POINTS]


def overlaps(boxes: Array, box: tuple[float, float, float, float], camera: Camera) -> Array:
    """What boxes (n, 4) have in common with another one, over what they cover together (n,), inside of the image."""
    frame = np.tile([float(camera.width), float(camera.height)], 2)
    many, one = np.clip(boxes, 0.0, frame), np.clip(box, 0.0, frame)
    common = np.maximum(np.minimum(many[:, 2:], one[2:]) - np.maximum(many[:, :2], one[:2]), 0.0).prod(axis=1)
    together = (many[:, 2:] - many[:, :2]).prod(axis=1) + (one[2:] - one[:2]).prod() - common
    return np.asarray(common / np.maximum(together, 1e-9), dtype=np.float64)


def map_unit(
    pose: RigidTransform, edges: MeshEdges, view: View, points: MapPoints, camera: Camera
) -> tuple[float, int, int]:
    """The map's units per metre by its points on an object at a pose in a view.

    Returns
    -------
    The unit, of how many points it is, and how many points there are in the object's outline; 0 without any.
    """
    local = pose.apply(edges.nodes)
    if local[:, 2].min() <= 0.0:
        return 0.0, 0, 0
    factor = 4
    depth = edges.depth(pose, camera, factor)
    size = depth.shape
    column, row = np.rint((view.pixels + 0.5) / factor - 0.5).astype(np.int64).T
    inside = (column >= 0) & (row >= 0) & (column < size[1]) & (row < size[0])
    there = np.full(len(column), np.inf)
    there[inside] = depth[row[inside], column[inside]]
    seen = np.isfinite(there)
    if seen.sum() < FEWEST_POINTS:
        return 0.0, 0, int(seen.sum())
    ratios = np.sort(view.camera_from_world.apply(points.positions[view.point_ids[seen]])[:, 2] / there[seen])
    # The unit that most points agree on.
    last = np.searchsorted(ratios, ratios * (1.0 + 2.0 * ALIKE), side="right")
    first = int((last - np.arange(len(ratios))).argmax())
    return float(np.median(ratios[first : last[first]])), int(last[first] - first), len(ratios)


def placed(pose: RigidTransform, view: HasPose, unit: float, middle: Array, metric: bool) -> SimilarityTransform:
    """The world_from_object of an object at a pose, metres, in a view of a map of so many units per metre.

    In a metric map the object keeps its size, and its ``middle`` (3,), object frame, is moved along the sight line to
    where its points are.
    """
    world, scale = view.camera_from_world.inverse, 1.0 if metric else unit
    origin = unit * pose.apply(middle) - scale * pose.rotation @ middle
    return SimilarityTransform(scale, world.rotation @ pose.rotation, world.apply(origin))
