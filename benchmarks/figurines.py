"""Smooth animals of one colour, as 3-D printed ones: without a plane, a straight edge or a mark to hold on to."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from skimage.measure import marching_cubes

Array = NDArray[np.float64]
#: Spacing of the grid, and over which two limbs blend, mm.
SPACING, BLEND = 1.2, 2.0
#: Points along the back, and the radius there, mm, by the share of the length.
N_BACK = 14
RADII = ((0.0, 0.15, 0.35, 0.6, 0.85, 1.0), (7.0, 6.0, 9.0, 10.0, 5.0, 1.2))


def figurine(seed: int) -> tuple[Array, NDArray[np.int64]]:
    """Points (n, 3), mm, and outward triangles (m, 3) of an animal: a winding back with spikes, a head, four legs.

    Limbs are cones with round ends, blended into each other; the surface is where their distance is zero.
    """
    rng = np.random.default_rng([23, seed])
    share = np.linspace(0.0, 1.0, N_BACK)
    back = np.column_stack(
        [
            90.0 * share - 45.0,
            8.0 * np.sin(2.0 * np.pi * (0.9 * share + rng.uniform())),
            22.0 + 14.0 * np.sin(2.0 * np.pi * (1.3 * share + rng.uniform(-0.1, 0.1))),
        ]
    )
    radii = np.interp(share, *RADII) * rng.uniform(0.9, 1.1)
    limbs = [*zip(back[:-1], back[1:], radii[:-1], radii[1:], strict=True), *_head(back[0]), *_legs(back)]
    limbs += [(back[k] + [0, 0, 0.8 * radii[k]], back[k] + [3, 0, radii[k] + 5], 2.2, 0.7) for k in range(1, 12)]
    ends = np.array([[a, b] for a, b, _, _ in limbs])
    low, high = ends.min(axis=(0, 1)) - 14.0, ends.max(axis=(0, 1)) + 14.0
    axes = [np.arange(a, b, SPACING) for a, b in zip(low, high, strict=True)]
    places = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    distance = np.full(places.shape[:3], 1e3)
    for limb in limbs:
        other = _cone(places, *limb)
        mixed = np.clip(0.5 + 0.5 * (distance - other) / BLEND, 0.0, 1.0)
        distance = distance * (1.0 - mixed) + other * mixed - BLEND * mixed * (1.0 - mixed)
    points, triangles, _, _ = marching_cubes(distance, 0.0, spacing=(SPACING,) * 3)
    return points - (points.min(axis=0) + points.max(axis=0)) / 2.0, triangles.astype(np.int64)


def _head(neck: Array) -> list[tuple[Array, Array, float, float]]:
    """Two jaws and two horns: both ends and radii there."""
    jaws = [(np.array([-14, -2, 4]), 7.0, 4.0), (np.array([-13, -2, -4]), 5.0, 2.5)]
    horns = [(np.array([8, 6, 16]), 2.5, 0.9), (np.array([8, -8, 15]), 2.5, 0.9)]
    return [(neck, neck + away, first, last) for away, first, last in (*jaws, *horns)]


def _legs(back: Array) -> list[tuple[Array, Array, float, float]]:
    """Four of them, each a thigh, a shank and a foot."""
    found = []
    for k in (3, 4, 8, 9):
        side, hip = (1.0 if k % 2 else -1.0), back[k]
        knee = np.array([hip[0] + 6.0, hip[1] + 12.0 * side, 9.0])
        heel = np.array([hip[0], hip[1] + 14.0 * side, 2.5])
        toes = np.array([hip[0] - 8.0, hip[1] + 15.0 * side, 2.0])
        found += [(hip, knee, 5.0, 3.6), (knee, heel, 3.6, 2.8), (heel, toes, 2.6, 1.6)]
    return found


def _cone(places: Array, start: Array, end: Array, first: float, last: float) -> Array:
    """Distance of places (..., 3) from a cone with round ends, whose radius changes from one to the other."""
    along = end - start
    share = np.clip(((places - start) @ along) / (along @ along), 0.0, 1.0)
    return np.linalg.norm(places - (start + share[..., None] * along), axis=-1) - (first + share * (last - first))
