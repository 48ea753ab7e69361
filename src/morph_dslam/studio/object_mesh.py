"""The object: the mesh in a file, its outer surface for a page, faces that belong together, and named sets of them.

These functions run in the worker process.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from morph_dslam.errors import MorphError, StudioError
from morph_dslam.extend.mechanics import Mesh, check_mesh, load_mesh, save_mesh
from morph_dslam.extend.studies import file_notes
from morph_dslam.io.file_kinds import file_kind
from morph_dslam.io.packing import packed

Array = NDArray[np.float64]
#: Units that a file may be drawn in.
UNITS = ("mm", "cm", "m", "um")
Indices = NDArray[np.int64]
_SET_NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_]{0,39}")
_INCLUDE = re.compile(rb"^\s*\*\s*INCLUDE", re.IGNORECASE | re.MULTILINE)


@dataclass(frozen=True)
class _Outside:
    """A mesh and its outer surface, of which faces are picked.

    Attributes
    ----------
    mesh : in metres.
    faces : (f, 2) cell and local face number of the outer faces.
    notes : sentences on how it was made of its file: what was repaired, how far it is off.
    """

    mesh: Mesh
    faces: Indices
    notes: tuple[str, ...]

    @cached_property
    def corners(self) -> Indices:
        """Corner nodes (f, 3 or 4) of the faces, -1 in the place of a fourth that is not there."""
        return self.mesh.face_nodes(self.faces, corners_only=True)

    @cached_property
    def normals(self) -> Array:
        """Unit normals (f, 3), outwards."""
        points = self.mesh.nodes[self.corners]
        last = np.where((self.corners[:, -1] >= 0)[:, None], points[:, -1], points[:, 2])
        normals = np.cross(points[:, 1] - points[:, 0], last - points[:, 0])
        return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)

    @cached_property
    def neighbours(self) -> Indices:
        """Pairs (p, 2) of faces that share an edge."""
        rows, edges = [], []
        for k in range(self.corners.shape[1]):
            start, end = self.corners[:, k], self.corners[:, (k + 1) % self.corners.shape[1]]
            end = np.where(end < 0, self.corners[:, 0], end)
            there = start >= 0
            rows.append(np.flatnonzero(there))
            edges.append(np.sort(np.column_stack([start, end])[there], axis=1))
        face, edge = np.concatenate(rows), np.concatenate(edges)
        order = np.lexsort(edge.T)
        face, edge = face[order], edge[order]
        same = (edge[1:] == edge[:-1]).all(axis=1)
        return np.column_stack([face[:-1][same], face[1:][same]])

    def triangles(self) -> tuple[Indices, Indices]:
        """Triangles (t, 3) of node indices, and the face (t,) that each is a part of."""
        fourth = np.flatnonzero(self.corners[:, -1] >= 0) if self.corners.shape[1] == 4 else np.empty(0, dtype=int)
        number = np.arange(len(self.faces))
        return (
            np.concatenate([self.corners[:, :3], self.corners[fourth][:, [0, 2, 3]]]) if len(fourth)
            else self.corners[:, :3]
        ), np.concatenate([number, fourth])  # fmt: skip


@dataclass(frozen=True)
class _Version:
    """A file as it stands; one that was moved and not written since is the same.

    Attributes
    ----------
    path : of the file.
    name : of the file, without its folder.
    seal : inode, time of writing in nanoseconds, and bytes.
    """

    path: Path = field(compare=False)
    name: str
    seal: tuple[int, int, int]


@lru_cache(maxsize=2)
def _outside(version: _Version, unit: str, size: float | None) -> _Outside:
    path = version.path
    if file_kind(path) == ".inp" and _INCLUDE.search(path.read_bytes()):
        raise StudioError(f"{path.name} includes other files: write one flat file")
    mesh = load_mesh(path, unit, size)
    check_mesh(mesh)
    if any(block.type.dimension != 3 for block in mesh.blocks):
        raise StudioError(
            f"{path.name} is a mesh of a surface; the pages here make studies of solids. Write a study of a shell by "
            "hand (docs/shell-study.md)"
        )
    return _Outside(mesh, mesh.boundary_faces(), tuple(file_notes(mesh, path, unit, size)))


def _opened(path: Path, unit: str, size: float | None) -> _Outside:
    if not path.is_file():
        raise StudioError(f"{path.name} is not in the project: upload it as an object first")
    found = path.stat()
    return _outside(_Version(path, path.name, (found.st_ino, found.st_mtime_ns, found.st_size)), unit, size)


def check_object(path: Path, unit: str) -> None:
    """Raise an error if a mesh file cannot be read as an object in any unit.

    Parameters
    ----------
    path : mesh file.
    unit : that it is read in first; by another one its size may be plausible.
    """
    refusal: MorphError | None = None
    for one in dict.fromkeys((unit, *UNITS)):
        try:
            _opened(path, one, None)
            return
        except MorphError as error:
            refusal = refusal or error
    if refusal is not None:
        raise refusal


def object_surface(path: Path, unit: str, size: float | None) -> bytes:
    """The outer surface: ``nodes`` (n, 3), ``triangles`` (t, 3), ``faces`` (t,) numbers of the face of each.

    Facts are counts, the extent in millimetres, the names of the file's own sets, and notes on what was repaired.

    Parameters
    ----------
    path : mesh file.
    unit : that it was drawn in.
    size : longest edge of a cell where its volume is to be meshed, metres.
    """
    outside = _opened(path, unit, size)
    mesh = outside.mesh
    triangles, faces = outside.triangles()
    used, corners = np.unique(triangles, return_inverse=True)
    facts: dict[str, Any] = {
        "n_nodes": mesh.n_nodes,
        "n_cells": mesh.n_cells,
        "n_faces": len(outside.faces),
        "cells": sorted({block.cell_type for block in mesh.blocks}),
        "extent_mm": (1e3 * np.ptp(mesh.nodes, axis=0)).tolist(),
        "sets": _own_sets(outside),
        "cell_sets": sorted(mesh.cell_sets),
        "notes": list(outside.notes),
    }
    return packed(facts, nodes=mesh.nodes[used], triangles=corners.reshape(-1, 3), faces=faces)


def _own_sets(outside: _Outside) -> dict[str, list[int]]:
    """The file's own surfaces, as numbers of outer faces; node sets have no faces."""
    numbers = {tuple(face): k for k, face in enumerate(outside.faces.tolist())}
    found = {
        name: [numbers[tuple(face)] for face in faces.tolist() if tuple(face) in numbers]
        for name, faces in outside.mesh.surfaces.items()
    }
    return {name: [] for name in outside.mesh.node_sets} | found


def grown_faces(path: Path, unit: str, size: float | None, face: int, angle: float) -> list[int]:
    """The faces that are reached from one over edges at which the surface turns by at most an angle.

    Parameters
    ----------
    path, unit, size : as of `object_surface`.
    face : number of the face to start from.
    angle : degrees between the normals of neighbours.

    Raises
    ------
    StudioError
        If there is no such face.
    """
    outside = _opened(path, unit, size)
    if not 0 <= face < len(outside.faces):
        raise StudioError(f"there is no face {face}; the surface has {len(outside.faces)}")
    a, b = outside.neighbours.T
    cosines = np.einsum("px,px->p", outside.normals[a], outside.normals[b])
    smooth = cosines >= np.cos(np.radians(min(max(angle, 0.0), 180.0))) - 1e-9
    links = coo_array((np.ones(smooth.sum()), (a[smooth], b[smooth])), shape=(len(outside.faces),) * 2)
    _, label = connected_components(links, directed=False)
    return np.flatnonzero(label == label[face]).tolist()


def write_object(
    path: Path, unit: str, size: float | None, sets: Mapping[str, Sequence[int]], target: Path, target_unit: str
) -> None:
    """Write the mesh with named sets of outer faces beside the file's own sets.

    Parameters
    ----------
    path, unit, size : as of `object_surface`.
    sets : numbers of faces by name; they come in the place of the file's own ones of the same names.
    target, target_unit : .inp file to write, and the unit of its coordinates.

    Raises
    ------
    StudioError
        If a name cannot stand in a study, or a set is empty or names faces that are not there.
    """
    outside = _opened(path, unit, size)
    for name, faces in sets.items():
        check_set(name, faces, len(outside.faces))
    chosen = {name: outside.faces[np.unique(np.asarray(faces, dtype=np.int64))] for name, faces in sets.items()}
    own = {name: faces for name, faces in outside.mesh.surfaces.items() if name not in sets}
    nodes = {name: found for name, found in outside.mesh.node_sets.items() if name not in {*sets, *own}}
    save_mesh(target, replace(outside.mesh, surfaces=own | chosen, node_sets=nodes), target_unit)


def check_set(name: str, faces: Sequence[int], n_faces: int) -> None:
    """Raise StudioError unless this can be a set of some of so many faces."""
    if not _SET_NAME.fullmatch(name) or name == "all":
        raise StudioError(f"{name!r:.60} is no name for a set: use letters, digits and _, not a digit first, not 'all'")
    if not faces or not all(0 <= face < n_faces for face in faces):
        raise StudioError(f"the set {name} must name faces of the surface, 0 to {n_faces - 1}, one at least")
