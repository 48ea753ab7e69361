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
from pathlib import Path
from typing import Any

import numpy as np
from netgen import meshing, occ, stl
from numpy.typing import NDArray

from morph_dslam.errors import StudyError
from morph_dslam.offline.meshing.face_lookup import find_faces
from morph_dslam.offline.meshing.meshes import CellBlock, Mesh
from morph_dslam.offline.meshing.surface_files import TriangleSurface, check_watertight, read_surface

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

#: STEP length units as the file names them, by ours.
_STEP_UNITS = {"mm": r"\.MILLI\.", "cm": r"\.CENTI\.", "m": r"\$"}


@contextmanager
def _quiet() -> Iterator[None]:
    """Keep what Netgen's C++ code prints off the terminal."""
    sys.stdout.flush()
    sys.stderr.flush()
    saved = [os.dup(1), os.dup(2)]
    with open(os.devnull, "w") as sink:
        for stream in (1, 2):
            os.dup2(sink.fileno(), stream)
        try:
            yield
        finally:
            for stream, original in enumerate(saved, start=1):
                os.dup2(original, stream)
                os.close(original)


def _volume_mesh(content: Any, path: Path) -> Mesh:
    """A Netgen mesh as ours: cell sets by material name, surfaces "face_1", ... by face number."""
    elements = content.Elements3D().NumPy()
    if not len(elements):
        raise StudyError(
            f"Netgen could not fill {path}: the surface cuts through itself or is too coarse for "
            "its details; mend it in a modelling program, or choose another cell size"
        )
    nodes = np.array(content.Coordinates(), dtype=np.float64)
    cells = (
        elements["nodes"][:, [0, 2, 1, 3]].astype(np.int64) - 1
    )  # Netgen's tetrahedra are mirrored to VTK's
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
    return Mesh(nodes, mesh.blocks, cell_sets=cell_sets, surfaces=surfaces).without_unused_nodes()


def mesh_surface_file(path: Path, size: float | None) -> Mesh:
    """Fill a closed surface with tetrahedra; file units.

    Parameters
    ----------
    path : .stl, .obj or .ply file.
    size : longest edge of a cell, file units: the surface is meshed anew between its sharp edges. None keeps
        the triangles of the file, as scans and sculpted surfaces want it.

    Returns
    -------
    Mesh
        Surfaces "face_1", ..., one for each smooth part of a surface meshed anew.

    Raises
    ------
    StudyError
        If the surface is unreadable, not closed, or cannot be filled.
    """
    surface = read_surface(path)
    check_watertight(surface, path)
    with _quiet():
        content = _filled(surface) if size is None else _meshed_anew(surface, size)
    return _volume_mesh(content, path)


def _filled(surface: TriangleSurface) -> Any:
    content = meshing.Mesh()
    content.dim = 3
    numbers = [content.Add(meshing.MeshPoint(meshing.Pnt(*point))) for point in surface.points.tolist()]
    face = content.Add(meshing.FaceDescriptor(bc=1, domin=1, domout=0, surfnr=1))
    for a, b, c in surface.triangles.tolist():
        content.Add(meshing.Element2D(face, [numbers[a], numbers[b], numbers[c]]))
    content.GenerateVolumeMesh()
    return content


def _meshed_anew(surface: TriangleSurface, size: float) -> Any:
    """Netgen reads the surface from a file only; STL is the one format that its mesher takes."""
    corners = surface.points[surface.triangles]
    facets = (
        "facet normal 0 0 0\nouter loop\n"
        + "".join("vertex {!r} {!r} {!r}\n".format(*corner) for corner in triangle)
        + "endloop\nendfacet\n"
        for triangle in corners.tolist()
    )
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "surface.stl"
        file.write_text("solid surface\n" + "".join(facets) + "endsolid surface\n")
        geometry = stl.LoadSTLGeometry(str(file))
    return geometry.GenerateMesh(maxh=size)


def mesh_step_file(path: Path, unit: str, size: float | None) -> Mesh:
    """Mesh the solids of a STEP file with tetrahedra; in millimetres, which the STEP reader converts to.

    Parameters
    ----------
    unit : the declared unit; it must be the one that the file itself states.
    size : longest edge of a cell, millimetres; a tenth of the solids' diagonal by default.

    Raises
    ------
    StudyError
        If the file cannot be read or states another unit, or its solids cannot be meshed.
    """
    try:
        text = path.read_text(encoding="utf-8", errors="replace")
    except OSError as error:
        raise StudyError(f"cannot read the mesh {path}: {error.strerror}") from error
    if "ISO-10303-21" not in text or "END-ISO-10303-21" not in text:
        raise StudyError(f"{path} is no STEP file, or is cut short: it does not end with END-ISO-10303-21")
    stated = [
        u for u, prefix in _STEP_UNITS.items() if re.search(rf"SI_UNIT\s*\(\s*{prefix}\s*,\s*\.METRE\.", text)
    ]
    if stated and unit not in stated:
        raise StudyError(f"{path} states that its unit of length is {stated[0]}, but '{unit}' is declared")
    with _quiet():
        try:
            geometry = occ.OCCGeometry(str(path))
            low, high = geometry.shape.bounding_box
            diagonal = float(np.linalg.norm(np.array([high[i] - low[i] for i in range(3)])))
            content = geometry.GenerateMesh(maxh=size or diagonal / 10.0)
        except Exception as error:  # Netgen and Open CASCADE raise plain Exception
            raise StudyError(f"Netgen could not mesh the solids of {path}: {error}") from error
    return _volume_mesh(content, path)
