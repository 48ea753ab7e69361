"""Meshes an organ anew: from a fine mesh of tetrahedra to a coarse one of second order with named surfaces.

The surface published beside the fine mesh cuts through itself, so that no mesher can fill it. The organ is
therefore drawn as voxels, smoothed, and given a new surface by marching cubes, which Netgen fills.
"""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter
from scipy.sparse import coo_matrix
from skimage.measure import marching_cubes

from morph_dslam.extend.mechanics import Mesh, check_mesh, load_mesh, to_second_order

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

#: Voxels along one edge of the coarse surface's grid.
FINER = 4
#: Rounds of smoothing; Taubin's two factors, which keep the volume (Taubin 1995).
ROUNDS, SHRINK, GROW = 30, 0.5, -0.52


@dataclass(frozen=True)
class Patch:
    """A part of an organ's surface: what lies within ``radius`` of ``centre`` (3,), metres."""

    centre: tuple[float, float, float]
    radius: float


def voxels(mesh: Mesh, spacing: float, margin: float) -> tuple[NDArray[np.bool_], Array]:
    """Which points of a grid lie inside of a mesh of linear tetrahedra.

    Parameters
    ----------
    spacing : of the grid, metres.
    margin : of empty space around the mesh, metres.

    Returns
    -------
    (i, j, k) inside, and the first point of the grid (3,), metres.
    """
    low, high = mesh.nodes.min(axis=0) - margin, mesh.nodes.max(axis=0) + margin
    axes = [np.arange(a, b, spacing) for a, b in zip(low, high, strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    inside = np.zeros(grid.shape[:3], dtype=bool)
    for corners in mesh.nodes[mesh.blocks[0].connectivity]:
        first = np.ceil((corners.min(axis=0) - low) / spacing).astype(int)
        last = np.floor((corners.max(axis=0) - low) / spacing).astype(int) + 1
        box = tuple(slice(a, b) for a, b in zip(first, last, strict=True))
        weights = (grid[box] - corners[0]) @ np.linalg.inv(corners[1:] - corners[0])
        inside[box] |= (weights >= -1e-9).all(axis=-1) & (weights.sum(axis=-1) <= 1.0 + 1e-9)
    return inside, low


def smoothed(points: Array, triangles: Indices) -> Array:
    """The points (n, 3) of a closed surface after smoothing, its volume nearly kept."""
    edges = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    count = len(points)
    # In a closed surface every edge occurs once in each direction.
    beside = coo_matrix((np.ones(len(edges)), (edges[:, 0], edges[:, 1])), shape=(count, count)).tocsr()
    degree = np.asarray(beside.sum(axis=1))
    for _ in range(ROUNDS):
        for factor in (SHRINK, GROW):
            points = points + factor * (beside @ points / degree - points)
    return points


def coarse_surface(mesh: Mesh, size: float) -> tuple[Array, Indices]:
    """A closed surface around a mesh of linear tetrahedra: nodes (n, 3), metres, and triangles (m, 3).

    Parameters
    ----------
    size : length of the triangles' edges, metres, about.
    """
    spacing = size / FINER
    inside, low = voxels(mesh, spacing, 3.0 * size)
    blurred = gaussian_filter(inside.astype(float), FINER / 2.0)[::FINER, ::FINER, ::FINER]
    points, triangles, _, _ = marching_cubes(blurred, 0.5, spacing=(size, size, size))
    # Marching cubes turns its triangles towards the higher value, which is inside.
    triangles = triangles[:, ::-1].astype(np.int64)
    return smoothed(points + low, triangles), triangles


def write_surface(path: Path, points: Array, triangles: Indices) -> None:
    """Write a surface as .obj, in millimetres."""
    lines = ["v {:.6f} {:.6f} {:.6f}".format(*point) for point in 1e3 * points]
    lines += ["f {} {} {}".format(*triangle) for triangle in triangles + 1]
    path.write_text("\n".join(lines) + "\n")


def with_patches(mesh: Mesh, patches: Mapping[str, Patch]) -> Mesh:
    """The mesh with these parts of its boundary named; a face belongs to one if its middle does."""
    faces = mesh.boundary_faces()
    middles = mesh.nodes[mesh.face_nodes(faces, corners_only=True)].mean(axis=1)
    near = {name: np.linalg.norm(middles - patch.centre, axis=1) < patch.radius for name, patch in patches.items()}
    return replace(mesh, surfaces={name: faces[chosen] for name, chosen in near.items()})


def organ_mesh(fine: Mesh, size: float, patches: Mapping[str, Patch]) -> Mesh:
    """An organ's mesh of second-order tetrahedra with edges of about ``size``, metres, and named surfaces.

    Raises
    ------
    MorphError
        If the organ cannot be meshed at this size, or a patch has no face.
    """
    with tempfile.TemporaryDirectory() as folder:
        surface = Path(folder) / "organ.obj"
        write_surface(surface, *coarse_surface(fine, size))
        filled = load_mesh(surface, "mm")
    mesh = to_second_order(with_patches(filled, patches))
    check_mesh(mesh, sets=list(patches))
    return mesh


def write_inp(path: Path, mesh: Mesh) -> None:
    """Write second-order tetrahedra and their named surfaces as an Abaqus input file, in millimetres."""
    lines = ["*NODE"]
    lines += ["{}, {:.9g}, {:.9g}, {:.9g}".format(label, *node) for label, node in enumerate(1e3 * mesh.nodes, 1)]
    lines.append("*ELEMENT, TYPE=C3D10")
    for label, cell in enumerate(mesh.blocks[0].connectivity + 1, 1):
        lines.append(f"{label}, " + ", ".join(map(str, cell)))
    for name, faces in mesh.surfaces.items():
        lines.append(f"*SURFACE, NAME={name}, TYPE=ELEMENT")
        lines += [f"{cell + 1}, S{face + 1}" for cell, face in faces]
    path.write_text("\n".join(lines) + "\n")
