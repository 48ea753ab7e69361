"""Triangulated surfaces from STL, OBJ and PLY files, and whether they close a volume."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import meshio
import numpy as np
from numpy.typing import NDArray

from morph_dslam.errors import StudyError

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

#: Endings of the files that are read.
SURFACES = (".stl", ".obj", ".ply")


@dataclass(frozen=True)
class TriangleSurface:
    """Points (n, 3) in file units and outward triangles (t, 3) of point indices."""

    points: Array
    triangles: Indices


def read_surface(path: Path) -> TriangleSurface:
    """Read a surface; polygons are cut into triangles and coincident points made one.

    Raises
    ------
    StudyError
        If it is a file of another kind, cannot be read, or holds no faces.
    """
    if path.suffix.lower() not in SURFACES:
        raise StudyError(f"{path} is no surface file that is read; use {', '.join(SURFACES)}")
    try:
        points, triangles = _read_obj(path) if path.suffix.lower() == ".obj" else _read_stl_or_ply(path)
    except OSError as error:
        raise StudyError(f"cannot read the surface {path}: {error.strerror or error}") from error
    if not len(triangles):
        raise StudyError(f"{path} holds no faces; it is no closed surface, or is cut short")
    if not np.isfinite(points).all():
        raise StudyError(f"{path} holds coordinates that are not finite")
    if not 0 <= triangles.min() <= triangles.max() < len(points):
        raise StudyError(
            f"{path} has faces that refer to points which it does not hold ({len(points)} are there)"
        )
    points, merged = np.unique(points, axis=0, return_inverse=True)
    triangles = merged.ravel()[triangles]
    flat = (triangles == np.roll(triangles, 1, axis=1)).any(axis=1)
    return TriangleSurface(points, triangles[~flat])


def _fans(polygons: Indices) -> Indices:
    """Polygons (m, k) cut into triangles around their first corner."""
    return np.concatenate([polygons[:, [0, i, i + 1]] for i in range(1, polygons.shape[1] - 1)])


def _read_obj(path: Path) -> tuple[Array, Indices]:
    """Vertices and faces alone; meshio refuses files whose texture coordinates outnumber the vertices."""
    points: list[list[float]] = []
    triangles: list[tuple[int, int, int]] = []
    for number, line in enumerate(path.read_text(errors="replace").splitlines(), start=1):
        kind, *rest = line.split() or [""]
        try:
            if kind == "v":
                x, y, z = (float(text) for text in rest[:3])
                points.append([x, y, z])
            elif kind == "f":
                corners = [int(text.split("/")[0]) for text in rest]
                ids = [c - 1 if c > 0 else len(points) + c for c in corners]
                first, *others = ids
                triangles += [(first, a, b) for a, b in pairwise(others)]
        except ValueError:
            raise StudyError(f"{path}, line {number}: '{line.strip()}' is no vertex or face") from None
    return np.array(points).reshape(-1, 3), np.array(triangles, dtype=np.int64).reshape(-1, 3)


def _read_stl_or_ply(path: Path) -> tuple[Array, Indices]:
    reader = meshio.stl.read if path.suffix.lower() == ".stl" else meshio.ply.read
    try:
        with np.errstate(over="ignore"):  # meshio takes the text of an ASCII file for a count of triangles
            content = reader(str(path))
    except OSError:
        raise
    except Exception as error:  # a damaged file ends meshio's readers in errors of every kind
        raise StudyError(
            f"{path} is damaged, cut short, or no {path.suffix} file ({type(error).__name__}: {error})"
        ) from error
    faces = [_fans(np.asarray(b.data)) for b in content.cells if b.type in ("triangle", "quad", "polygon")]
    triangles = np.concatenate(faces) if faces else np.empty((0, 3))
    return np.asarray(content.points, dtype=np.float64), triangles.astype(np.int64)


def check_watertight(surface: TriangleSurface, path: Path) -> None:
    """Raise StudyError unless every edge joins two triangles that turn alike, with the inside within."""
    t = surface.triangles
    directed = np.concatenate([t[:, [0, 1]], t[:, [1, 2]], t[:, [2, 0]]])
    edges, inverse, counts = np.unique(
        np.sort(directed, axis=1), axis=0, return_inverse=True, return_counts=True
    )

    def at(edge: int) -> str:
        return "(" + ", ".join(f"{x:.6g}" for x in surface.points[edges[edge]].mean(axis=0)) + ")"

    open_edges, crowded = np.flatnonzero(counts == 1), np.flatnonzero(counts > 2)
    if len(open_edges):
        raise StudyError(
            f"the surface {path} is not watertight: {len(open_edges)} edges have a triangle on one side "
            f"only, the first around {at(open_edges[0])} in file units; close its holes"
        )
    if len(crowded):
        raise StudyError(
            f"the surface {path} bounds no volume: {len(crowded)} edges have more than two triangles, the "
            f"first around {at(crowded[0])} in file units; remove inner walls and doubled faces"
        )
    forwards = np.bincount(inverse.ravel(), weights=directed[:, 0] < directed[:, 1])
    turned = np.flatnonzero(forwards != 1)
    if len(turned):
        raise StudyError(
            f"the triangles of {path} do not all turn the same way, first around {at(turned[0])} in file "
            "units; make its normals consistent"
        )
    a, b, c = (surface.points[t[:, i]] for i in range(3))
    if np.einsum("ti,ti->", a, np.cross(b, c)) <= 0.0:
        raise StudyError(f"the triangles of {path} face inwards; flip its normals")
