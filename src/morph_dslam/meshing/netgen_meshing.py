"""Volumes meshed by Netgen: from closed triangulated surfaces (STL, OBJ, PLY) and from STEP solids."""

# Netgen's Python modules are filled at run time by its C++ library, out of pyright's sight.
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

import os
import re
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import islice, pairwise
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import meshio
import numpy as np
from netgen import meshing, occ, stl
from numpy.typing import NDArray

from morph_dslam.errors import StudyError
from morph_dslam.io.file_kinds import file_kind
from morph_dslam.meshing.mesh_checks import check_corners, check_extent, described_extent
from morph_dslam.meshing.meshes import CellBlock, Mesh, end_surfaces, find_faces
from morph_dslam.meshing.surface_repair import repaired_surface, surface_parts

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
#: Endings of the files that are read.
SURFACES = (".stl", ".obj", ".ply")
#: More cells than anyone solves on: their size is a mistake, and meshing them would take for ever.
MOST_CELLS = 10_000_000
#: Solids overlap if they have more than this share of their volume in common; less is rounding.
OVERLAP = 1e-6
#: No header of a .ply file has more.
MOST_HEADER_LINES = 10_000


@dataclass(frozen=True)
class _TriangleSurface:
    """Points (n, 3) in file units and outward triangles (t, 3) of point indices."""

    points: Array
    triangles: Indices


def read_surface(path: Path) -> _TriangleSurface:
    """Read a surface; polygons are cut into triangles and coincident points made one.

    Raises StudyError if it is a file of another kind, cannot be read, or holds no faces.
    """
    kind = file_kind(path)
    if kind not in SURFACES:
        raise StudyError(f"{path} is no surface file that is read; use {', '.join(SURFACES)}")
    try:
        points, triangles = _read_obj(path) if kind == ".obj" else _read_stl_or_ply(path, kind)
    except OSError as error:
        raise StudyError(f"cannot read the surface {path}: {error.strerror or error}") from error
    if not len(triangles):
        raise StudyError(f"{path} holds no faces; it is no closed surface, or is cut short")
    if not np.isfinite(points).all():
        raise StudyError(f"{path} holds coordinates that are not finite")
    check_corners(triangles, len(points), path, "faces", "points")
    points, merged = np.unique(points, axis=0, return_inverse=True)
    triangles = merged.ravel()[triangles]
    flat = (triangles == np.roll(triangles, 1, axis=1)).any(axis=1)
    return _TriangleSurface(points, triangles[~flat])


def _fans(polygons: Indices) -> Indices:
    """Polygons (m, k) cut into triangles around their first corner."""
    return np.concatenate([polygons[:, [0, i, i + 1]] for i in range(1, polygons.shape[1] - 1)])


def _read_obj(path: Path) -> tuple[Array, Indices]:
    """Vertices and faces alone; meshio refuses files whose texture coordinates outnumber the vertices."""
    points: list[list[float]] = []
    triangles: list[tuple[int, int, int]] = []
    for number, line in enumerate(path.read_text(encoding="utf-8", errors="replace").splitlines(), start=1):
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


def _read_stl_or_ply(path: Path, kind: str) -> tuple[Array, Indices]:
    reader = meshio.stl.read if kind == ".stl" else meshio.ply.read
    if kind == ".ply":
        with path.open("rb") as file:  # meshio would look for the end of the header for ever
            if not any(line.strip() == b"end_header" for line in islice(file, MOST_HEADER_LINES)):
                raise StudyError(f"{path} is damaged, cut short, or no .ply file: its header has no end_header")
    try:
        with np.errstate(over="ignore"):  # meshio takes the text of an ASCII file for a count of triangles
            content = reader(str(path))
    except OSError:
        raise
    except Exception as error:  # a damaged file ends meshio's readers in errors of every kind
        raise StudyError(
            f"{path} is damaged, cut short, or no {kind} file ({type(error).__name__}: {error})"
        ) from error
    faces = [_fans(np.asarray(b.data)) for b in content.cells if b.type in ("triangle", "quad", "polygon")]
    triangles = np.concatenate(faces) if faces else np.empty((0, 3))
    return np.asarray(content.points, dtype=np.float64), triangles.astype(np.int64)


def check_watertight(surface: _TriangleSurface, path: Path) -> None:
    """Raise StudyError unless every edge joins two triangles that turn alike, with the inside within.

    A closed part within another one is a cavity, and must face inwards: Netgen ends the process at one that does not.
    """
    t = surface.triangles
    directed = np.concatenate([t[:, [0, 1]], t[:, [1, 2]], t[:, [2, 0]]])
    edges, inverse, counts = np.unique(np.sort(directed, axis=1), axis=0, return_inverse=True, return_counts=True)

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
    wrong = [part for part in surface_parts(surface.points, t) if part.wrong]
    if any(part.turn < 0 for part in wrong) or np.einsum("ti,ti->", a, np.cross(b, c)) <= 0.0:
        raise StudyError(f"the triangles of {path} face inwards; flip its normals")
    if wrong:
        place = ", ".join(f"{x:.6g}" for x in surface.points[t[wrong[0].faces]].mean(axis=(0, 1)))
        raise StudyError(
            f"a closed part of the surface {path} lies within another one, around ({place}) in file units, and both "
            "face outwards: flip its normals if it is a cavity, or remove it"
        )


def closed_surface(path: Path) -> tuple[_TriangleSurface, dict[str, int]]:
    """Read a surface that bounds a body; one that does not is mended (`repaired_surface`).

    Raises StudyError as `read_surface` does, or if the surface still bounds no volume.

    Returns
    -------
    surface : as the file has it if nothing had to be mended.
    repairs : how often each was done, by its name.
    """
    surface = read_surface(path)
    try:
        check_watertight(surface, path)
        return surface, {}
    except StudyError as error:
        flaw = error
    try:
        points, triangles, repairs = repaired_surface(surface.points, surface.triangles)
    except StudyError:
        raise flaw from None
    mended = _TriangleSurface(points, triangles)
    check_watertight(mended, path)
    return mended, repairs


#: STEP length units as the file names them, by ours.
_STEP_UNITS = {"mm": r"\.MILLI\.", "cm": r"\.CENTI\.", "m": r"\$"}


@contextmanager
def _quiet() -> Iterator[None]:
    """Keep what Netgen's C++ code prints off the terminal."""
    sys.stdout.flush()
    sys.stderr.flush()
    saved = [os.dup(1), os.dup(2)]
    with open(os.devnull, "w", encoding="utf-8") as sink:
        for stream in (1, 2):
            os.dup2(sink.fileno(), stream)
        try:
            yield
        finally:
            for stream, original in enumerate(saved, start=1):
                os.dup2(original, stream)
                os.close(original)


def _volume_mesh(content: Any, path: Path) -> Mesh:
    """A Netgen mesh as ours: cell sets by material name, surfaces "face_1", ... by face number, and `end_surfaces`."""
    elements = content.Elements3D().NumPy()
    if not len(elements):
        raise StudyError(
            f"Netgen could not fill {path}: the surface cuts through itself or is too coarse for "
            "its details; mend it in a modelling program, or choose another cell size"
        )
    nodes = np.array(content.Coordinates(), dtype=np.float64)
    cells = elements["nodes"][:, [0, 2, 1, 3]].astype(np.int64) - 1  # Netgen's tetrahedra are mirrored to VTK's
    mesh = Mesh(nodes, (CellBlock("tet4", cells),))
    skin = content.Elements2D().NumPy()
    faces = find_faces(mesh, skin["nodes"][:, :3].astype(np.int64) - 1)
    surfaces = {f"face_{i}": faces[skin["index"] == i] for i in np.unique(skin["index"])}
    names = {int(i): content.GetMaterial(int(i)) for i in np.unique(elements["index"])}
    cell_sets = {
        name: np.flatnonzero(np.isin(elements["index"], [i for i, other in names.items() if other == name]))
        for name in set(names.values())
        if name and name != "default"
    }
    surfaces |= end_surfaces(mesh)
    return Mesh(nodes, mesh.blocks, cell_sets=cell_sets, surfaces=surfaces).without_unused_nodes()


def mesh_surface_file(path: Path, unit: float, size: float | None) -> Mesh:
    """Fill a closed surface with tetrahedra; the mesh is in metres.

    Raises StudyError if the surface is unreadable, is not closed and cannot be mended (`closed_surface`), or cannot be
    filled, or the size of cells goes with no body of its extent.

    Parameters
    ----------
    path : .stl, .obj or .ply file.
    unit : that of its coordinates, metres.
    size : longest edge of a cell, metres: the surface is meshed anew between its sharp edges. None keeps the
        triangles of the file, as scans and sculpted surfaces want it.

    Returns
    -------
    Mesh
        Surfaces "face_1", ..., one for each smooth part of a surface meshed anew.
    """
    surface, _ = closed_surface(path)
    if size is not None:
        a, b, c = unit * surface.points[surface.triangles].transpose(1, 0, 2)
        volume = float(np.einsum("ti,ti->", a, np.cross(b, c))) / 6.0
        area = 0.5 * float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum())
        _check_cell_size(path, unit * np.ptp(surface.points, axis=0), volume, area, size)
    with _quiet():
        content = _filled(surface) if size is None else _meshed_anew(surface, size / unit)
    return _volume_mesh(content, path).scaled(unit)


def _check_cell_size(path: Path, extent: Array, volume: float, area: float, size: float) -> None:
    """Refuse a size of cells that goes with no body of this extent (3,), volume and area; metres.

    Meshing too many cells would take for ever, and ignore an interrupt.
    """
    check_extent(extent, str(path))
    # Equilateral tetrahedra; in a thin wall one on every two triangles of its two sides.
    count = max(6.0 * np.sqrt(2.0) * volume / size**3, area / (np.sqrt(0.75) * size**2))
    if count > MOST_CELLS:
        raise StudyError(
            f"{path} measures {described_extent(extent)} m: cells of at most size = {1e3 * size:.3g} mm would "
            f"be some {count:.0e}, more than the {MOST_CELLS:.0e} that are meshed; give a larger size, or another unit"
        )


def _filled(surface: _TriangleSurface) -> Any:
    content = meshing.Mesh()
    content.dim = 3
    numbers = [content.Add(meshing.MeshPoint(meshing.Pnt(*point))) for point in surface.points.tolist()]
    face = content.Add(meshing.FaceDescriptor(bc=1, domin=1, domout=0, surfnr=1))
    for a, b, c in surface.triangles.tolist():
        content.Add(meshing.Element2D(face, [numbers[a], numbers[b], numbers[c]]))
    content.GenerateVolumeMesh()
    return content


def _meshed_anew(surface: _TriangleSurface, size: float) -> Any:
    """Netgen reads the surface from a file only; STL is the one format that its mesher takes."""
    content = meshio.Mesh(
        surface.points,
        {"triangle": surface.triangles},
        cell_data={"facet_normals": [np.zeros(surface.triangles.shape)]},
    )
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "surface.stl"
        content.write(file)
        geometry = stl.LoadSTLGeometry(str(file))
    return geometry.GenerateMesh(maxh=size)


def mesh_step_file(path: Path, unit: str, size: float | None) -> Mesh:
    """Mesh the solids of a STEP file with tetrahedra; in millimetres, which the STEP reader converts to.

    Solids that touch share the nodes where they do. Raises StudyError if the file cannot be read or states another
    unit, its solids overlap or cannot be meshed, or the size of cells goes with no body of their extent.

    Parameters
    ----------
    unit : the declared unit; it must be the one that the file itself states.
    size : longest edge of a cell, millimetres; a tenth of the solids' diagonal by default.
    """
    try:
        text = path.read_text(encoding="utf-8", errors="replace")
    except OSError as error:
        raise StudyError(f"cannot read the mesh {path}: {error.strerror}") from error
    if "ISO-10303-21" not in text or "END-ISO-10303-21" not in text:
        raise StudyError(f"{path} is no STEP file, or is cut short: it does not end with END-ISO-10303-21")
    stated = [u for u, prefix in _STEP_UNITS.items() if re.search(rf"SI_UNIT\s*\(\s*{prefix}\s*,\s*\.METRE\.", text)]
    if stated and unit not in stated:
        raise StudyError(f"{path} states that its unit of length is {stated[0]}, but '{unit}' is declared")
    with _quiet(), _step_errors(path):
        geometry = _step_solids(path)
        low, high = geometry.shape.bounding_box
        extent = np.array([high[i] - low[i] for i in range(3)])
        if size is not None:
            area = sum(face.mass for face in geometry.shape.faces)
            _check_cell_size(path, 1e-3 * extent, 1e-9 * geometry.shape.mass, 1e-6 * area, 1e-3 * size)
        content = geometry.GenerateMesh(maxh=size or float(np.linalg.norm(extent)) / 10.0)
    return _volume_mesh(content, path)


def step_volume(path: Path) -> float:
    """Volume of the solids of a STEP file, m3. Raises StudyError if they cannot be read, or overlap."""
    with _quiet(), _step_errors(path):
        return 1e-9 * float(_step_solids(path).shape.mass)


@contextmanager
def _step_errors(path: Path) -> Iterator[None]:
    """Make StudyError of what Netgen and Open CASCADE raise, which is plain Exception."""
    try:
        yield
    except StudyError:
        raise
    except Exception as error:
        raise StudyError(f"Netgen could not mesh the solids of {path}: {error}") from error


def _step_solids(path: Path) -> Any:
    """The solids of a STEP file, joined where they touch; millimetres."""
    with TemporaryDirectory() as folder:
        named = Path(folder) / "solids.step"  # Netgen goes by the name
        named.symlink_to(path.resolve())
        return _joined(occ.OCCGeometry(str(named)), path)


def _joined(geometry: Any, path: Path) -> Any:
    """The geometry with one face where two solids touch, which else has two; StudyError if solids overlap."""
    solids = list(geometry.shape.solids)
    if len(solids) < 2:
        return geometry
    shape = occ.Glue(solids)
    volume = sum(solid.mass for solid in solids)
    if shape.mass < (1.0 - OVERLAP) * volume:
        raise StudyError(
            f"the {len(solids)} solids of {path} overlap by {volume - shape.mass:.3g} mm3, and no material is known "
            "there: cut one out of the other in the modelling program"
        )
    return occ.OCCGeometry(shape)
