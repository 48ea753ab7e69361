"""Mesh files of every kind that is read, by one function."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from morph_dslam.errors import StudyError
from morph_dslam.io.inp_file import InpFile, SurfacePart, read_inp
from morph_dslam.offline.meshing.mesh_repair import reoriented, without_collapsed_cells
from morph_dslam.offline.meshing.meshes import CellBlock, Mesh
from morph_dslam.offline.meshing.meshio_files import read_with_meshio
from morph_dslam.offline.meshing.netgen_meshing import mesh_step_file, mesh_surface_file
from morph_dslam.offline.meshing.surface_files import SURFACES
from morph_dslam.units import to_si

Indices = NDArray[np.int64]

#: Abaqus lists a C3D27's centre before the centres of its faces S1 to S6; VTK has opposite faces, then it.
_HEX27_FROM_ABAQUS = [*range(20), 26, 24, 23, 25, 21, 22, 20]
_VOLUMES = (".inp", ".msh", ".vtk", ".vtu", ".step", ".stp")


def load_mesh(path: Path | str, unit: str, size: float | None = None) -> Mesh:
    """Read a mesh file, or mesh the volume that a surface or a STEP file describes.

    Parameters
    ----------
    path : .inp (Abaqus, CalculiX), .msh (Gmsh), .vtk, .vtu; .stl, .obj, .ply (closed surfaces); .step, .stp.
    unit : the unit of length in which the file was drawn: "m", "cm" or "mm".
    size : longest edge of a cell where Netgen meshes the volume, metres; other files take none.

    Returns
    -------
    Mesh
        In metres, without the nodes that no cell uses; see `mesh_repair` for what is mended. Not yet checked:
        see `check_mesh`.

    Raises
    ------
    StudyError
        If the kind of file or the unit is not known, or the file is damaged.
    """
    path, scale = Path(path), to_si(1.0, unit, "length")
    kind = path.suffix.lower()
    if kind not in _VOLUMES + SURFACES:
        raise StudyError(f"{path} is no mesh file that is read; use {', '.join(_VOLUMES + SURFACES)}")
    if size is not None and size <= 0.0:
        raise StudyError(f"a cell size of {size} m cannot be; give a positive length")
    if size is not None and kind not in (*SURFACES, ".step", ".stp"):
        raise StudyError(f"{path} is meshed already; a cell size is for surfaces and STEP files")
    if kind in SURFACES:
        return mesh_surface_file(path, None if size is None else size / scale).transformed(scale)
    if kind in (".step", ".stp"):
        return mesh_step_file(path, unit, None if size is None else size * 1e3).transformed(1e-3)
    mesh = mesh_from_inp(read_inp(path)) if kind == ".inp" else read_with_meshio(path)
    return reoriented(without_collapsed_cells(mesh)).transformed(scale)


def _positions(labels: Indices, wanted: Indices) -> Indices:
    """Positions of wanted labels in a list that holds them all."""
    order = np.argsort(labels)
    return order[np.searchsorted(labels, wanted, sorter=order)]


def mesh_from_inp(file: InpFile) -> Mesh:
    """The mesh of an input file, in file units; element sets become cell sets.

    Raises
    ------
    StudyError
        If a surface names a face that its elements do not have.
    """
    blocks = []
    for part in file.elements:
        connectivity = _positions(file.node_labels, part.connectivity)
        if part.cell_type == "hex27":
            connectivity = connectivity[:, _HEX27_FROM_ABAQUS]
        blocks.append(CellBlock(part.cell_type, connectivity))
    element_labels = np.concatenate([part.labels for part in file.elements])
    mesh = Mesh(
        nodes=file.nodes,
        blocks=tuple(blocks),
        node_sets={name: _positions(file.node_labels, nodes) for name, nodes in file.node_sets.items()},
        cell_sets={name: _positions(element_labels, cells) for name, cells in file.element_sets.items()},
    )
    surfaces = {
        name: np.concatenate([_part_faces(mesh, part, element_labels) for part in parts])
        for name, parts in file.surfaces.items()
    }
    return replace(mesh, surfaces=surfaces).without_unused_nodes()


def _part_faces(mesh: Mesh, part: SurfacePart, element_labels: Indices) -> Indices:
    cells = _positions(element_labels, part.elements)
    if not part.face:
        boundary = mesh.boundary_faces()
        return boundary[np.isin(boundary[:, 0], cells)]
    starts = mesh.block_starts()
    types = [mesh.blocks[i].type for i in np.unique(np.searchsorted(starts, cells, side="right") - 1)]
    number = int(part.face[1:]) - 1 if part.face[1:].isdigit() else 0
    for cell in types:
        faces = ["SPOS"] if cell.dimension == 2 else [f"S{i + 1}" for i in range(len(cell.faces))]
        if part.face not in faces:
            raise part.line.error(f"a {cell.name} element has no face {part.face}; use {', '.join(faces)}")
    return np.column_stack([cells, np.full(len(cells), number)])
