"""Which points of a surface have passed through another, or through another part of the same.

A point may have entered a face that it faces: the normals of the two are opposed. Faces near each other are found by a
tree of their centres and normals, and points are projected on them along their normals, with their true curvature. Two
things look like contact and are not. A point is as deep behind the other side of its own wall as this is thick; so a
depth must be small against the undeformed distance of the two, where the point lay behind the face. And where a fold
closes, a point is as deep behind the far side of the next wall as both are thick; so a depth must not be much more than
a layer of cells.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from morph_dslam.mechanics.contact_surface import ContactSurface, unit

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
#: Faces looked at for each face.
NEAREST = 8
#: A depth is at most such a part of the undeformed distance of point and face, and of the height of the cells of both.
SHARE_OF_DISTANCE, SHARE_OF_LAYER = 0.5, 1.5
#: Points that were nearer to a face than such a part of its width are beside it: around a corner that closes.
BESIDE = 0.2
#: The cosine of the angle between normals that face each other is below this.
FACING = -0.5
#: A projection may lie so far outside of its face, in units of the face's coordinates: faces at an angle leave gaps.
MARGIN = 0.05
STEPS = 8
#: A point that lies behind a face by less than such a part of a layer of cells lies on it.
ROUNDING = 1e-3
#: No point of a face is farther from the plane through its centre, in units of its radius.
NEARLY_PLANE = 0.3


@dataclass(frozen=True)
class Crossings:
    """Points of a surface that have passed through faces, k of them.

    Attributes
    ----------
    points : (k,) numbers of the quadrature points.
    face : (k,) face that each has passed through.
    place : (k, 2) its projection there.
    gap : (k,) distance from it, m, negative.
    normal : (k, 3) of the face there.
    """

    points: Indices
    face: Indices
    place: Array
    gap: Array
    normal: Array


def find_crossings(
    surface: ContactSurface, other: ContactSurface, undeformed: tuple[Array, Array], deformed: tuple[Array, Array]
) -> Crossings:
    """The points of ``surface`` that have passed through the ``other``.

    Parameters
    ----------
    undeformed : coefficients (n, 3) of the positions of both, m.
    deformed : the same where they are now.
    """
    normals = surface.normals_at(deformed[0], surface.face, surface.place)
    point, face = _candidates(surface, other, deformed, normals)
    points = surface.positions(deformed[0])
    place, gap, normal = project(other, deformed[1], points[point], face)
    overshoot = _overshoot(other.corners[face], place)
    between = surface.positions(undeformed[0])[point] - other.at(undeformed[1], face, place)
    distance = np.linalg.norm(between, axis=1)
    in_front = np.einsum("kx,kx->k", between, other.normals_at(undeformed[1], face, place))
    layer = np.minimum(surface.heights[surface.face[point]], other.heights[face])
    good = (overshoot < MARGIN) & (np.einsum("kx,kx->k", normals[point], normal) < FACING)
    good &= (-gap < SHARE_OF_DISTANCE * distance) | (in_front > -ROUNDING * layer)
    good &= -gap < SHARE_OF_LAYER * layer
    if surface is other:
        good &= distance > BESIDE * other.widths[face]
    kept = np.flatnonzero(good)
    # Around an edge the point has to be behind both faces, and is as deep as behind the nearer one.
    order = kept[np.lexsort((-gap[kept], point[kept]))]
    _, first = np.unique(point[order], return_index=True)
    chosen = order[first]
    chosen = chosen[gap[chosen] < 0.0]
    return Crossings(point[chosen], face[chosen], place[chosen], gap[chosen], normal[chosen])


def _candidates(
    surface: ContactSurface, other: ContactSurface, deformed: tuple[Array, Array], normals: Array
) -> tuple[Indices, Indices]:
    """Quadrature points (k,) of ``surface`` and faces (k,) of the ``other`` that may have met."""
    reach = float(max(surface.widths.max(), other.widths.max()))
    points, there = surface.positions(deformed[0]), other.positions(deformed[1])
    centres, facing = other.centres(there), unit(other.centres(other.normals_at(deformed[1], other.face, other.place)))
    radii = np.zeros(len(centres))
    np.maximum.at(radii, other.face, np.linalg.norm(there - centres[other.face], axis=1))
    own = np.hstack([surface.centres(points), -reach * surface.centres(normals)])
    tree = KDTree(np.hstack([centres, reach * facing]))
    _, near = tree.query(own, min(NEAREST, len(centres)), distance_upper_bound=1.5 * reach)
    candidates = near.reshape(len(own), -1)[surface.face]
    point, column = np.nonzero(candidates < len(centres))
    face = candidates[point, column]
    # A face is nearly plane: what is far from its centre's plane, or beside it, cannot have met it.
    arms = points[point] - centres[face]
    height = np.einsum("kx,kx->k", arms, facing[face])
    aside = np.linalg.norm(arms - height[:, None] * facing[face], axis=1)
    bend = NEARLY_PLANE * radii[face]
    close = (aside < 1.1 * radii[face]) & (height < bend) & (-height < SHARE_OF_LAYER * other.heights[face] + bend)
    return point[close], face[close]


def project(surface: ContactSurface, coordinates: Array, points: Array, face: Indices) -> tuple[Array, Array, Array]:
    """Places (k, 2) of ``points`` (k, 3) on faces (k,), distances (k,) along the normals, and normals (k, 3).

    Newton's method for the place whose normal meets the point, on the face continued beyond its sides.
    """
    place = np.where(surface.corners[face, None] == 3, 1.0 / 3.0, 0.5) * np.ones(2)
    for _ in range(STEPS):
        away, first, second, metric, bend = local_geometry(surface, coordinates, points, face, place)
        right = np.stack([np.einsum("kx,kx->k", away, first), np.einsum("kx,kx->k", away, second)], axis=1)
        matrix = metric - np.einsum("kx,kabx->kab", away, bend)
        definite = np.linalg.det(matrix) > 0.1 * np.linalg.det(metric)
        matrix = np.where(definite[:, None, None], matrix, metric)
        change = np.linalg.solve(matrix, right[:, :, None])[:, :, 0]
        place = np.clip(place + change, -0.5, 1.5)
        if not len(change) or np.abs(change).max() < 1e-10:
            break
    away, *_ = local_geometry(surface, coordinates, points, face, place)
    normal = surface.normals_at(coordinates, face, place)
    return place, np.einsum("kx,kx->k", away, normal), normal


def local_geometry(
    surface: ContactSurface, coordinates: Array, points: Array, face: Indices, place: Array
) -> tuple[Array, Array, Array, Array, Array]:
    """Of faces (k,) at places (k, 2), as points (k, 3) see them.

    Returns
    -------
    Vectors (k, 3) from there to the points, tangents (k, 3) along both coordinates, their metric (k, 2, 2), and second
    derivatives (k, 2, 2, 3) of the position.
    """
    away = points - surface.at(coordinates, face, place)
    first, second = (surface.at(coordinates, face, place, d) for d in ((1, 0), (0, 1)))
    tangents = np.stack([first, second], axis=1)
    metric = np.einsum("kax,kbx->kab", tangents, tangents)
    ss, st, tt = (surface.at(coordinates, face, place, d) for d in ((2, 0), (1, 1), (0, 2)))
    return away, first, second, metric, np.stack([ss, st, st, tt], axis=1).reshape(-1, 2, 2, 3)


def _overshoot(corners: Indices, place: Array) -> Array:
    """How far (k,) places are outside of their faces, in the faces' coordinates; 0 inside."""
    s, t = place.T
    beyond = np.where(corners == 3, s + t - 1.0, np.maximum(s, t) - 1.0)
    return np.maximum.reduce([-s, -t, beyond, np.zeros(len(s))])
