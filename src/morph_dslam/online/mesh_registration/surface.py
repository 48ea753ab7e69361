"""A mesh surface as registration sees it: points with normals, nearest-point search, and its symmetry."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from morph_dslam.geometry import rotation_exp
from morph_dslam.model.surface_sampling import spread_over, triangle_normals

Array = NDArray[np.float64]

#: Points spread over the surface.
N_SAMPLES = 12000
#: A surface turned about its axis of revolution stays where it was, up to this part of its size.
SYMMETRY_TOLERANCE = 0.01
#: A wall of a hollow body, whose other side may be nearer to a point, is at most so thick over its size.
WALL = 0.02


@dataclass(frozen=True)
class Axis:
    """A line: a point (3,) on it and its unit direction (3,), object frame, metres."""

    point: Array
    direction: Array

    def turned(self, points: Array, angle: float) -> Array:
        """Points (..., 3) turned about the axis by ``angle`` (rad)."""
        return (points - self.point) @ rotation_exp(angle * self.direction).T + self.point


@dataclass(frozen=True)
class Surface:
    """Points (n, 3) spread evenly over a surface, with unit normals (n, 3), object frame, metres.

    ``closed`` surfaces have an inside, and are seen from the side to which their normals point.
    """

    points: Array
    normals: Array
    closed: bool

    @classmethod
    def of_mesh(cls, nodes: Array, triangles: NDArray[np.int64], count: int = N_SAMPLES) -> Surface:
        """Sample a triangle mesh in proportion to its area, the same way every time."""
        edges = np.sort(
            np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]]), axis=1
        )
        _, uses = np.unique(edges, axis=0, return_counts=True)
        samples = spread_over(nodes, triangles, count)
        chosen = triangles[samples.triangles]
        points = np.einsum("pc,pcx->px", samples.weights, nodes[chosen])
        normals = triangle_normals(nodes, chosen)
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        return cls(points, normals, closed=bool((uses == 2).all()))

    @cached_property
    def tree(self) -> KDTree:
        """Nearest-point search."""
        return KDTree(self.points, leafsize=20)  # a quarter faster than with ten

    def nearest(self, points: Array, viewpoints: Array) -> NDArray[np.int64]:
        """The nearest sample (p,) to each point (p, 3) that faces its viewpoint (p, 3), object frame.

        On a thin wall the nearest sample may be on the other side. Open surfaces are seen from both sides.
        """
        if not self.closed:
            return np.asarray(self.tree.query(points)[1], dtype=np.int64)
        neighbours = np.asarray(self.tree.query(points, k=self._n_neighbours)[1], dtype=np.int64)
        facing = np.einsum("pkx,px->pk", self.normals[neighbours], viewpoints - points) > 0.0
        return neighbours[np.arange(len(points)), facing.argmax(axis=1)]

    @cached_property
    def _n_neighbours(self) -> int:
        """So many samples lie on both sides of a wall in a disc as wide as it is thick."""
        return int(np.clip(4.0 * np.pi * (WALL / 2.0) ** 2 / self._area_share, 8, 80))

    @cached_property
    def _area_share(self) -> float:
        """Area of one sample over the square of the size."""
        spacing = float(np.median(self.tree.query(self.points[::10], k=2)[0][:, 1]))
        return (2.0 * spacing) ** 2 / self.size**2

    @cached_property
    def centre(self) -> Array:
        """Mean (3,) of the points."""
        return self.points.mean(axis=0)

    @cached_property
    def size(self) -> float:
        """Diagonal of the bounding box."""
        return float(np.linalg.norm(np.ptp(self.points, axis=0)))

    @cached_property
    def radius(self) -> float:
        """Root mean square distance of the points from their mean."""
        return float(np.sqrt(np.mean(np.sum((self.points - self.centre) ** 2, axis=1))))

    @cached_property
    def axis_of_revolution(self) -> Axis | None:
        """The axis about which the surface may be turned by any angle; None if there is none.

        It can only be a principal axis of the surface's inertia. Turned about it by a few angles, of which
        none is a simple fraction of a turn, the surface has to lie on itself.
        """
        _, principal = np.linalg.eigh(np.cov((self.points - self.centre).T))
        spacing = float(np.median(self.tree.query(self.points, k=2)[0][:, 1]))
        allowed = SYMMETRY_TOLERANCE * self.size
        for direction in principal.T[::-1]:
            axis = Axis(self.centre, direction)
            farthest = 0.0
            for angle in (0.37, 1.0, 1.93, 2.81):
                turned = axis.turned(self.points, angle)
                _, nearest = self.tree.query(turned)
                # Across the surface: along it the nearest sample is up to a spacing away.
                off = np.abs(np.einsum("px,px->p", turned - self.points[nearest], self.normals[nearest]))
                farthest = max(farthest, float(np.percentile(off, 95)))
            if farthest <= max(allowed, 0.5 * spacing):
                return axis
        return None
