"""The bar's silhouette: where the images show its edge, and which points of the model lie on it.

The edge of a solid is where a triangle that faces the camera meets one that does not. Points on these edges
are compared with the nearest points of the outline in the image, each across the outline only, because a
point may slide along it.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

import morph_dslam as md
from morph_dslam.extend.models import SurfacePoints
from morph_dslam.extend.tracking import BoundPoints, State, draw_view, facing, view_of

Array = NDArray[np.float64]

#: Outlines are read off an image that is so many times finer, pixels between its own.
FINER = 4
#: Points on each edge of the mesh.
PER_EDGE = 3
#: A point is on the silhouette if, so many pixels further out, there is nothing of the bar.
OUTWARDS = 2.0


def outline_of(level: NDArray[np.float32], inside: Array) -> Array:
    """The outline (k, 2), pixels, of the bright part of an image (h, w) that holds pixels ``inside`` (p, 2).

    Half of the brightness there divides it from what is around it.

    Raises
    ------
    MorphError
        If those pixels are not brighter than the image as a whole.
    """
    columns, rows = np.rint(inside).astype(int).T
    bright, dark = float(np.median(level[rows, columns])), float(np.median(level))
    if bright < dark + 0.1 * float(level.max() - dark):
        raise md.MorphError("the bar does not stand out from its surroundings in this image")
    fine = cv2.resize(level, None, fx=FINER, fy=FINER, interpolation=cv2.INTER_LINEAR)
    mask = (fine > 0.5 * (bright + dark)).astype(np.uint8)
    _, labels = cv2.connectedComponents(mask)
    found = labels[rows * FINER, columns * FINER]
    part = (labels == np.bincount(found[found > 0]).argmax()).astype(np.uint8)
    contours, _ = cv2.findContours(part, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    longest = max(contours, key=len)[:, 0].astype(float)
    # Contours run through the middles of the last pixels inside; the edge is half of one further out.
    grown, _ = cv2.findContours(1 - part, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    around = np.concatenate([contour[:, 0] for contour in grown]).astype(float)
    _, nearest = KDTree(around).query(longest)
    return (0.5 * (longest + around[nearest]) + 0.5) / FINER - 0.5


@dataclass(frozen=True)
class Matches:
    """Points of the model and where the image shows their edge.

    Attributes
    ----------
    points : bound, p of them.
    pixels : (p, 2) nearest on the outline.
    normals : (p, 2) across it.
    places : (p,) how far along the outline they are, in its points.
    """

    points: BoundPoints
    pixels: Array
    normals: Array
    places: NDArray[np.int64]


def silhouette_points(
    model: md.ReducedModel, camera: md.Camera, state: State, free: NDArray[np.bool_]
) -> tuple[BoundPoints, Array]:
    """Points of the model on its silhouette, and the image normals (p, 2) of their edges, outwards.

    Parameters
    ----------
    free : (n,) nodes that can be seen; edges with others are left out.
    """
    view = view_of(model, camera, state)
    front = facing(view, model.triangles)
    edges, owners = _edges(model.triangles)
    chosen = (front[owners[:, 0]] != front[owners[:, 1]]) & free[edges].all(axis=1)
    edges, owners = edges[chosen], owners[chosen]
    along = view.pixels[edges[:, 1]] - view.pixels[edges[:, 0]]
    normals = np.column_stack([along[:, 1], -along[:, 0]]) / np.linalg.norm(along, axis=1)[:, None]
    visible = np.where(front[owners[:, 0]], owners[:, 0], owners[:, 1])
    inwards = view.pixels[model.triangles[visible]].mean(axis=1) - view.pixels[edges].mean(axis=1)
    normals *= -np.sign(np.einsum("ex,ex->e", normals, inwards))[:, None]
    shares = (np.arange(PER_EDGE) + 0.5) / PER_EDGE
    weights = np.zeros((len(edges), PER_EDGE, 3))
    for end, share in ((0, 1.0 - shares), (1, shares)):
        corner = (model.triangles[visible] == edges[:, end, None]).argmax(axis=1)
        weights[np.arange(len(edges))[:, None], np.arange(PER_EDGE), corner[:, None]] = share
    surface = SurfacePoints(np.repeat(visible, PER_EDGE), weights.reshape(-1, 3))
    normals = np.repeat(normals, PER_EDGE, axis=0)
    points = BoundPoints.from_surface(model, surface)
    covered = draw_view(view, model.triangles, camera).covered
    outside = np.rint(camera.project(points.in_camera(state)) + OUTWARDS * normals).astype(int)
    limits = np.array([camera.width, camera.height]) - 1
    within = ((outside >= 0) & (outside <= limits)).all(axis=1)
    x, y = np.clip(outside, 0, limits).T
    kept = within & ~covered[y, x]
    return BoundPoints.from_surface(model, surface.take(kept)), normals[kept]


def _edges(triangles: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Edges (e, 2) of a closed surface and the two triangles (e, 2) of each."""
    sides = np.sort(np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]]), axis=1)
    owners = np.tile(np.arange(len(triangles)), 3)
    order = np.lexsort(sides.T)
    return sides[order][::2], owners[order].reshape(-1, 2)


def match(
    model: md.ReducedModel, camera: md.Camera, state: State, free: NDArray[np.bool_], outline: Array, reach_px: float
) -> Matches:
    """Silhouette points of a state and the nearest of the outline's points (k, 2), within a reach."""
    points, normals = silhouette_points(model, camera, state, free)
    predicted = camera.project(points.in_camera(state))
    distances, nearest = (np.asarray(values) for values in KDTree(outline).query(predicted))
    near = np.flatnonzero(distances < reach_px)
    bound = BoundPoints.from_surface(model, points.surface.take(near))
    return Matches(bound, outline[nearest[near]], normals[near], nearest[near])
