"""Whether a solid and a rigid obstacle have passed through each other.

Contact acts on the points of a surface that are inside of an obstacle. So it does not see an obstacle that a large
increment has moved from one side of a wall to the other, or into the solid. Therefore the points of a surface are
followed from one solution to the next, along straight lines past the moving obstacle: one that is outside at both ends
and deep inside between them has gone through. And the points of an obstacle that are farthest from its surface, its
core, are never in the solid.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from morph_dslam.mechanics.contact import RigidCylinder, RigidObstacle, RigidPlane, RigidSphere
from morph_dslam.mechanics.contact_surface import ContactSurface
from morph_dslam.mechanics.parameters import ParameterSymbols
from morph_dslam.mechanics.rigid_mesh import RigidMesh
from morph_dslam.small_arrays import cross, dot

Array = NDArray[np.float64]
#: A point has gone through an obstacle if it was inside by more than this part of the depth of the core, ...
THROUGH = 0.25
#: ... and outside at both ends, up to this part: surfaces in contact give way.
OUTSIDE = 0.125
#: Parts of the core's depth by which points move between two looks at them, and the most looks.
STRIDE, MOST_LOOKS = 0.5, 256
#: Most points along a side of a face that are followed, and along an axis.
MOST_ON_SIDE, MOST_ON_AXIS = 12, 128


@dataclass(frozen=True)
class Placed:
    """A solution as obstacles see it.

    Attributes
    ----------
    mu : (d,) parameters.
    coordinates : (n, 3) coefficients of the deformed positions, m.
    """

    mu: Array
    coordinates: Array


def core(obstacle: RigidObstacle, symbols: ParameterSymbols, corners: Array) -> Array:
    """Points (k, 3) of an obstacle farthest from its surface, at the present parameters, m.

    Those of a cylinder's axis lie in the box between ``corners`` (2, 3). Planes, and obstacles around the solid, have
    none.
    """
    if isinstance(obstacle, RigidMesh):
        return obstacle.core + symbols.values(obstacle.place)
    if isinstance(obstacle, RigidSphere) and not obstacle.inside:
        return symbols.values(obstacle.centre)[None]
    if isinstance(obstacle, RigidCylinder) and not obstacle.inside:
        return _axis_within(obstacle, symbols, corners)
    return np.zeros((0, 3))


def _axis_within(obstacle: RigidCylinder, symbols: ParameterSymbols, corners: Array) -> Array:
    """Points of the axis in a box, about a radius apart."""
    point, axis = symbols.values(obstacle.point), np.array(obstacle.axis) / np.linalg.norm(obstacle.axis)
    crossed = np.abs(axis) > 1e-12
    beside = ~crossed & ((point < corners[0]) | (point > corners[1]))
    ends = np.sort((corners[:, crossed] - point[crossed]) / axis[crossed], axis=0)
    begin, end = ends[0].max(), ends[1].min()
    if beside.any() or begin >= end:
        return np.zeros((0, 3))
    count = int(np.clip((end - begin) / symbols.value(obstacle.radius), 8, MOST_ON_AXIS))
    shares = (np.arange(count) + 0.5) / count
    return point + (begin + (end - begin) * shares)[:, None] * axis


def core_inside(
    obstacle: RigidObstacle, symbols: ParameterSymbols, nodes: Array, triangles: NDArray[np.int64]
) -> Array:
    """Points (k, 3) of an obstacle's core that lie in the solid of ``nodes`` (n, 3) and a closed surface (t, 3)."""
    on_surface = nodes[np.unique(triangles)]
    corners = np.array([on_surface.min(axis=0), on_surface.max(axis=0)])
    points = core(obstacle, symbols, corners)
    points = points[((points > corners[0]) & (points < corners[1])).all(axis=1)]
    if not len(points):
        return points
    return points[_windings(points, np.ascontiguousarray(nodes, dtype=np.float64), triangles) > 0.5]


@njit(cache=True, nogil=True)
def _windings(points, nodes, triangles):
    """How often a closed surface winds around points (k,): the solid angle over 4 pi (van Oosterom & Strackee 1983)."""
    windings = np.zeros(len(points))
    for k in range(len(points)):
        for t in range(len(triangles)):
            i, j, m = triangles[t]
            a, b, c = nodes[i] - points[k], nodes[j] - points[k], nodes[m] - points[k]
            na, nb, nc = np.sqrt(dot(a, a)), np.sqrt(dot(b, b)), np.sqrt(dot(c, c))
            volume = dot(a, cross(b, c))
            flat = na * nb * nc + dot(a, b) * nc + dot(b, c) * na + dot(c, a) * nb
            windings[k] += np.arctan2(volume, flat) / (2.0 * np.pi)
    return windings


def passes_through(
    obstacle: RigidObstacle, symbols: ParameterSymbols, surface: ContactSurface, before: Placed, after: Placed
) -> bool:
    """Whether points of a surface go through an obstacle between two solutions; ``symbols`` then have ``after``'s."""
    depth, moved = _depth_and_move(obstacle, symbols, before.mu, after.mu)
    if not depth > 0.0:
        return False
    face, place = _spread(surface, STRIDE * depth)
    begin, end = (surface.at(state.coordinates, face, place) for state in (before, after))
    travel = np.linalg.norm(end - begin - moved, axis=1)
    far = travel > depth
    if not far.any():
        return False
    looks = min(int(np.ceil(travel.max() / (STRIDE * depth))), MOST_LOOKS)
    gaps = []
    for share in np.linspace(0.0, 1.0, looks + 1):
        symbols.set(before.mu + share * (after.mu - before.mu))
        gaps.append(obstacle.touch(symbols, begin[far] + share * (end - begin)[far]).gap)
    symbols.set(after.mu)
    outside = np.minimum(gaps[0], gaps[-1]) > -OUTSIDE * depth
    return bool(np.any(outside & (np.min(gaps, axis=0) < -THROUGH * depth)))


def travel_in_depths(obstacle: RigidObstacle, symbols: ParameterSymbols, begin: Array, end: Array) -> float:
    """How far an obstacle moves between parameters (d,), over the depth of its core; 0 for one without a core."""
    depth, moved = _depth_and_move(obstacle, symbols, begin, end)
    return float(np.linalg.norm(moved)) / depth if depth > 0.0 else 0.0


def _depth_and_move(
    obstacle: RigidObstacle, symbols: ParameterSymbols, begin: Array, end: Array
) -> tuple[float, Array]:
    """The lesser depth of a core at parameters (d,) and others, which are set then, and how far it moves (3,), m."""
    depths, places = [], []
    for mu in (begin, end):
        symbols.set(mu)
        depths.append(_depth(obstacle, symbols))
        places.append(_reference(obstacle, symbols))
    return min(depths), places[1] - places[0]


def _depth(obstacle: RigidObstacle, symbols: ParameterSymbols) -> float:
    """Of the core below the obstacle's surface, m; 0 without a core."""
    if isinstance(obstacle, RigidMesh):
        middle = obstacle.core + symbols.values(obstacle.place)
        return float(-obstacle.touch(symbols, middle).gap.min(initial=0.0))
    if isinstance(obstacle, (RigidSphere, RigidCylinder)) and not obstacle.inside:
        return symbols.value(obstacle.radius)
    return 0.0


def _reference(obstacle: RigidObstacle, symbols: ParameterSymbols) -> Array:
    """A point (3,) that moves with the obstacle."""
    place = obstacle.place if isinstance(obstacle, RigidMesh) else None
    place = obstacle.centre if isinstance(obstacle, RigidSphere) else place
    place = obstacle.point if isinstance(obstacle, (RigidCylinder, RigidPlane)) else place
    return np.zeros(3) if place is None else symbols.values(place)


def _spread(surface: ContactSurface, spacing: float) -> tuple[NDArray[np.int64], Array]:
    """Faces (k,) and places (k, 2) of points all over a surface, ``spacing`` apart where that is affordable."""
    count = int(np.clip(np.ceil(surface.widths.max() / spacing), 2, MOST_ON_SIDE))
    steps = np.linspace(0.0, 1.0, count + 1)
    square = np.stack(np.meshgrid(steps, steps, indexing="ij"), axis=-1).reshape(-1, 2)
    triangle = square[square.sum(axis=1) <= 1.0 + 1e-9]
    faces, places = [], []
    for corners, points in ((3, triangle), (4, square)):
        own = np.flatnonzero(surface.corners == corners)
        faces.append(np.repeat(own, len(points)))
        places.append(np.tile(points, (len(own), 1)))
    return np.concatenate(faces), np.concatenate(places)
