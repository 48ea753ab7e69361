"""Mesh files of every kind that is read: Abaqus, Gmsh, VTK, closed surfaces, STEP; with their named sets."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import replace
from io import StringIO
from itertools import pairwise
from pathlib import Path
from typing import Any

import meshio
import numpy as np
from numpy.typing import NDArray

from morph_dslam.errors import StudyError
from morph_dslam.io.file_kinds import MESHES, file_kind
from morph_dslam.io.inp_file import InpFile, SurfacePart, read_inp
from morph_dslam.meshing.left_out_cells import left_out_cells, why_unread
from morph_dslam.meshing.mesh_checks import check_corners
from morph_dslam.meshing.mesh_repair import reoriented, without_collapsed_cells
from morph_dslam.meshing.meshes import CellBlock, Mesh, find_faces, with_found_surfaces
from morph_dslam.meshing.netgen_meshing import (
    SURFACES,
    check_watertight,
    mesh_step_file,
    mesh_surface_file,
    read_surface,
)
from morph_dslam.model.cell_types import cell_type
from morph_dslam.units import to_si

Indices = NDArray[np.int64]


def load_mesh(path: Path | str, unit: str, size: float | None = None) -> Mesh:
    """Read a mesh file, or mesh the volume that a surface or a STEP file describes.

    Raises StudyError if the kind of file or the unit is not known, the file is damaged, or the size of cells goes with
    no body of its extent.

    Parameters
    ----------
    path : .inp (Abaqus, CalculiX), .msh (Gmsh), .vtk, .vtu; .stl, .obj, .ply (closed surfaces); .step, .stp.
    unit : the unit of length in which the file was drawn: "m", "cm" or "mm".
    size : longest edge of a cell where Netgen meshes the volume, metres; other files take none.

    Returns
    -------
    Mesh
        In metres, without the nodes that no cell uses, mended by `mesh_repair`; `check_mesh` checks it.
    """
    path, scale = Path(path), to_si(1.0, unit, "length")
    kind = file_kind(path)
    if kind not in MESHES:
        raise StudyError(f"{path} is no mesh file that is read; use {', '.join(MESHES)}")
    if size is not None and size <= 0.0:
        raise StudyError(f"a cell size of {size} m cannot be; give a positive length")
    if size is not None and kind not in (*SURFACES, ".step"):
        raise StudyError(f"{path} is meshed already; a cell size is for surfaces and STEP files")
    if kind in SURFACES:
        return with_found_surfaces(mesh_surface_file(path, scale, size))
    if kind == ".step":
        return with_found_surfaces(mesh_step_file(path, unit, None if size is None else size * 1e3).scaled(1e-3))
    mesh = _mesh_from_inp(read_inp(path)) if kind == ".inp" else _read_with_meshio(path)
    return with_found_surfaces(reoriented(without_collapsed_cells(mesh)).scaled(scale))


def load_surface_mesh(path: Path | str, unit: str) -> Mesh:
    """Read a mesh of a surface: of cells in a mesh file, or the triangles of an STL, OBJ or PLY file as they are.

    Raises StudyError as `load_mesh`, and if the file holds solids. ``unit`` is that of its coordinates; the result is
    in metres.
    """
    path = Path(path)
    if file_kind(path) in SURFACES:
        surface = read_surface(path)
        blocks = (CellBlock("tri3", surface.triangles),)
        return Mesh(surface.points, blocks).without_unused_nodes().scaled(to_si(1.0, unit, "length"))
    if file_kind(path) == ".step":
        raise StudyError(f"{path} holds solids; a shell needs a mesh of its middle surface")
    return load_mesh(path, unit)


def load_closed_surface(path: Path | str, unit: str) -> tuple[NDArray[np.float64], Indices]:
    """Points (n, 3), m, and outward triangles (t, 3) of an STL, OBJ or PLY file that bounds a body.

    Raises StudyError if the file cannot be read, or its surface is open, branches or is not turned outwards.
    """
    surface = read_surface(Path(path))
    check_watertight(surface, Path(path))
    return surface.points * to_si(1.0, unit, "length"), surface.triangles


#: Abaqus lists a C3D27's centre before the centres of its faces S1 to S6; VTK has opposite faces, then it.
_HEX27_FROM_ABAQUS = [*range(20), 26, 24, 23, 25, 21, 22, 20]


def _positions(labels: Indices, wanted: Indices) -> Indices:
    """Positions of wanted labels in a list that holds them all."""
    order = np.argsort(labels)
    return order[np.searchsorted(labels, wanted, sorter=order)]


def _mesh_from_inp(file: InpFile) -> Mesh:
    """The mesh of an Abaqus input file, in file units; element sets become cell sets."""
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


#: Our cell types by meshio's names; its node order is VTK's, save that linear prisms are as Abaqus's.
_CELLS = {
    "tetra": "tet4", "tetra10": "tet10",
    "triangle": "tri3", "triangle6": "tri6", "quad": "quad4", "quad8": "quad8", "quad9": "quad9",
    "wedge": "prism6", "wedge18": "prism18",
    "hexahedron": "hex8", "hexahedron20": "hex20", "hexahedron27": "hex27",
}  # fmt: skip
#: Dimension of the cells that may only bound others.
_BOUNDING = {"vertex": 0, "line": 1, "line3": 1}
#: Integer data with more values than this number things rather than group them.
_MOST_GROUPS = 256


def _read_with_meshio(path: Path) -> Mesh:
    """Read a .msh, .vtk or .vtu file; nodes in file units.

    Cells of the highest dimension make the mesh. Gmsh's physical groups of that dimension become cell sets; those of
    faces of solids become surfaces, and all lower ones node sets. In VTK files integer cell data named d with value v
    becomes the cell set "d_v", and integer point data the node set "d_v".
    """
    content = _read(path)
    dimension = max((_dimension(block.type, path) for block in content.cells), default=0)
    if dimension < 2 or all(block.type not in _CELLS for block in content.cells):
        raise StudyError(f"{path} holds no solid or sheet cells; mesh the volume (or the sheet) and save that")
    top = [i for i, block in enumerate(content.cells) if _dimension(block.type, path) == dimension]
    unknown = sorted({content.cells[i].type for i in top} - set(_CELLS))
    if unknown:
        raise StudyError(f"{path} holds {', '.join(unknown)} cells, which are not known; use {', '.join(_CELLS)}")
    blocks = [CellBlock(_CELLS[content.cells[i].type], content.cells[i].data.astype(np.int64)) for i in top]
    groups = content.cell_data.get("gmsh:physical")
    starts = Mesh(content.points, tuple(blocks)).block_starts()
    numbers = [np.arange(start, end) for start, end in pairwise(starts)]
    if groups is not None:
        blocks, numbers = _without_copies(blocks, [groups[i] for i in top])
    nodes = np.zeros((len(content.points), 3))
    nodes[:, : content.points.shape[1]] = content.points
    mesh = Mesh(nodes, tuple(blocks))
    for block in blocks:
        check_corners(block.connectivity, len(nodes), path)
    return _with_groups(mesh, content, dict(zip(top, numbers, strict=True)), dimension, path)


def _without_copies(blocks: list[CellBlock], groups: Sequence[Indices]) -> tuple[list[CellBlock], list[Indices]]:
    """The blocks with each cell once, and for each block as it was the numbers of its cells.

    Gmsh 2 writes a cell once for each physical group that it belongs to; ``groups`` (m,) of each block are their tags.
    Copies in one group are left for `check_mesh` to refuse.
    """
    sizes = [len(block.connectivity) for block in blocks]
    first = np.arange(sum(sizes))
    kind = np.repeat([block.cell_type for block in blocks], sizes)
    for name in set(kind):
        rows = np.flatnonzero(kind == name)
        cells = np.concatenate([block.connectivity for block in blocks if block.cell_type == name])
        tags = np.concatenate([tag for tag, block in zip(groups, blocks, strict=True) if block.cell_type == name])
        _, index, inverse = np.unique(cells, axis=0, return_index=True, return_inverse=True)
        if len(np.unique(np.column_stack([inverse.ravel(), tags]), axis=0)) == len(cells):
            first[rows] = rows[index[inverse.ravel()]]
    kept = first == np.arange(len(first))
    numbers = (np.cumsum(kept) - 1)[first]
    ends = np.cumsum(sizes)[:-1]
    single = [
        CellBlock(block.cell_type, block.connectivity[mask])
        for block, mask in zip(blocks, np.split(kept, ends), strict=True)
        if mask.any()
    ]
    return single, list(np.split(numbers, ends))


def _read(path: Path) -> Any:
    readers = {".msh": meshio.gmsh.read, ".vtk": meshio.vtk.read, ".vtu": meshio.vtu.read}
    kind = file_kind(path)
    try:
        if kind == ".msh":
            _check_gmsh(path)
        with redirect_stdout(StringIO()), redirect_stderr(StringIO()):
            content = readers[kind](str(path))
        left_out = left_out_cells(path, content)
    except OSError as error:
        raise StudyError(f"cannot read the mesh {path}: {error.strerror or error}") from error
    except StudyError:
        raise
    except ValueError as error:
        if "gmsh:physical" in str(error):  # meshio counts the groups wrongly where an entity has none
            raise StudyError(
                f"{path} holds cells of no physical group beside cells of some; put every entity that is "
                "saved into a group, or save the groups alone (Mesh.SaveAll = 0)"
            ) from error
        raise _damaged(path, error) from error
    except KeyError as error:  # a cell type without a place in meshio's tables, or a damaged file
        if "wedge15" in error.args:
            raise StudyError(f"{path} holds prisms of 15 nodes; save it as .inp, or with 18 nodes") from error
        raise _damaged(path, error) from error
    except Exception as error:  # a damaged file ends meshio's readers in errors of every kind
        raise _damaged(path, error) from error
    if left_out:  # voxels, say
        raise StudyError(f"{path} holds {left_out}")
    return content


def _damaged(path: Path, error: Exception) -> StudyError:
    if file_kind(path) == ".msh" and path.read_bytes()[:1] == b"(":
        return StudyError(
            f"{path} is an ANSYS mesh file, which ends in .msh too: save it as Gmsh's, from meshio with "
            'file_format="gmsh" or "gmsh22"'
        )
    return StudyError(f"{path} {why_unread(path, error)}")


def _check_gmsh(path: Path) -> None:
    """Meshio only warns where a Gmsh file ends inside a section, and reads one group of an entity from version 4.0."""
    content = path.read_bytes()
    if re.search(rb"^\$MeshFormat\s+4(\.0)?\s", content, re.MULTILINE):
        raise StudyError(f"{path} is of version 4.0 of Gmsh's format, which is not read: save it as version 4.1 or 2.2")
    for name in re.findall(rb"^\$(MeshFormat|PhysicalNames|Entities|Nodes|Elements)\s*$", content, re.MULTILINE):
        if not re.search(rb"^\$End" + name + rb"\s*$", content, re.MULTILINE):
            line = content[: content.index(b"$" + name)].count(b"\n") + 1
            raise StudyError(f"{path}, line {line}: the section ${name.decode()} is not closed; the file is cut short")


def _dimension(name: str, path: Path) -> int:
    if name in _CELLS or name in _BOUNDING:
        return _any_dimension(name)
    raise StudyError(f"{path} holds {name} cells, which are not known; use {', '.join(_CELLS)}")


def _groups(content: Any) -> Iterator[tuple[str, list[Indices]]]:
    """Names of groups, and for each block of the file the positions of the group's cells in it."""
    physical = content.cell_data.get("gmsh:physical")
    by_name = {name: part for name, part in content.cell_sets.items() if not name.startswith("gmsh:")}
    if by_name:
        for name, parts in by_name.items():
            yield name, [np.asarray([] if part is None else part, dtype=np.int64) for part in parts]
    elif physical is not None:
        dimensions = {name: int(entry[1]) for name, entry in content.field_data.items()}
        for name, entry in content.field_data.items():
            yield (
                name,
                [
                    np.flatnonzero((tags == entry[0]) & (_any_dimension(block.type) == dimensions[name]))
                    for block, tags in zip(content.cells, physical, strict=True)
                ],
            )
    yield from _integer_groups(content.cell_data)


def _integer_groups(data: Mapping[str, Sequence[np.ndarray]]) -> Iterator[tuple[str, list[Indices]]]:
    """Names of groups that integer data make, and for each part of the data the group's positions in it."""
    for name, columns in data.items():
        # Legacy VTK that states its one component, `SCALARS part int 1`, is read as a column (n, 1).
        parts = [part[:, 0] if part.ndim == 2 and part.shape[1] == 1 else part for part in columns]
        is_integer = all(part.ndim == 1 and np.issubdtype(part.dtype, np.integer) for part in parts)
        if name.startswith("gmsh:") or not is_integer:
            continue
        values = np.unique(np.concatenate(parts))
        for value in values if len(values) <= _MOST_GROUPS else ():
            yield f"{name}_{value}", [np.flatnonzero(part == value) for part in parts]


def _any_dimension(name: str) -> int:
    return cell_type(_CELLS[name]).dimension if name in _CELLS else _BOUNDING[name]


def _with_groups(mesh: Mesh, content: Any, numbers: dict[int, Indices], dimension: int, path: Path) -> Mesh:
    """The mesh with the groups of its file; ``numbers`` are those of the cells of each block that it has them from."""
    node_sets: dict[str, Indices] = {}
    cell_sets: dict[str, Indices] = {}
    surfaces: dict[str, Indices] = {}
    for name, parts in _groups(content):
        rows = [(i, part) for i, part in enumerate(parts) if len(part)]
        cells = [numbers[i][part] for i, part in rows if i in numbers]
        if cells:
            cell_sets[name] = np.concatenate(cells)
            continue
        bounding = [content.cells[i].data[part] for i, part in rows]
        if not bounding:
            continue
        node_sets[name] = np.unique(np.concatenate([part.ravel() for part in bounding])).astype(np.int64)
        if dimension == 3 and all(_any_dimension(content.cells[i].type) == 2 for i, _ in rows):
            surfaces[name] = _faces(mesh, content, rows, name, path)
    points = {name: [column] for name, column in content.point_data.items()}
    node_sets |= {name: nodes for name, (nodes,) in _integer_groups(points)}
    return Mesh(mesh.nodes, mesh.blocks, node_sets, cell_sets, surfaces).without_unused_nodes()


def _faces(mesh: Mesh, content: Any, rows: list[tuple[int, Indices]], name: str, path: Path) -> Indices:
    parts = []
    for i, part in rows:
        corners = 3 if content.cells[i].type.startswith("triangle") else 4
        parts.append(find_faces(mesh, content.cells[i].data[part][:, :corners]))
    faces = np.concatenate(parts)
    if (faces < 0).any():
        raise StudyError(f"{path}: {(faces[:, 0] < 0).sum()} faces of group '{name}' are faces of no solid cell")
    return faces
