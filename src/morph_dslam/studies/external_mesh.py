"""Meshes of another program's solutions: read, checked, and compared from file to file."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import meshio
import numpy as np

from morph_dslam.errors import StudyError
from morph_dslam.meshing.mesh_checks import check_corners, check_mesh, wrong_cells
from morph_dslam.meshing.mesh_repair import reoriented
from morph_dslam.meshing.mesh_summary import described_mesh
from morph_dslam.meshing.meshes import CellBlock, Mesh, parts_of_cells
from morph_dslam.studies.problem import announce
from morph_dslam.studies.solid_sections import check_unit
from morph_dslam.studies.solution_files import SAME, points_in_space
from morph_dslam.units import to_si

#: Cell types by the names that meshio gives them; the order of their nodes is VTK's, or that of linear prisms ours.
_CELL_TYPES = {
    "hexahedron": "hex8",
    "hexahedron20": "hex20",
    "hexahedron27": "hex27",
    "tetra": "tet4",
    "tetra10": "tet10",
    "wedge": "prism6",
    "wedge18": "prism18",
    "triangle": "tri3",
    "quad": "quad4",
}


def mesh_of(content: meshio.Mesh, unit: str, path: Path) -> Mesh:
    """All points and the cells of the highest dimension, metres; StudyError if there are none or other types.

    Linear prisms all of which are mirrored are turned round, for VTK lists them so and Abaqus does not.
    """
    highest = max((block.dim for block in content.cells), default=0)
    blocks = [block for block in content.cells if block.dim == highest > 1]
    unknown = {block.type for block in blocks} - set(_CELL_TYPES)
    if unknown or not blocks:
        raise StudyError(
            f"{path} has {'cells of type ' + ', '.join(sorted(unknown)) if unknown else 'no cells'}; "
            f"known are {', '.join(_CELL_TYPES)}"
        )
    made = tuple(CellBlock(_CELL_TYPES[block.type], np.asarray(block.data, dtype=np.int64)) for block in blocks)
    nodes = points_in_space(content)
    for block in made:
        check_corners(block.connectivity, len(nodes), path, points="points")
    mesh = Mesh(to_si(1.0, unit, "length") * nodes, made)
    turned = zip(made, reoriented(mesh).blocks, strict=True)
    return replace(mesh, blocks=tuple(new if new.cell_type == "prism6" else old for old, new in turned))


def announced_mesh(mesh: Mesh, unit: str, path: Path) -> Mesh:
    """The mesh of the first solution without unused nodes, checked and printed: a wrong unit shows in its size.

    Raises StudyError naming the file, or the key of the unit, if it is wrong.
    """
    mesh = mesh.without_unused_nodes()
    check_unit(mesh, unit, "external.length_unit")
    try:
        for part in _parts(mesh):
            _check_order(part)
            check_mesh(part)
    except StudyError as error:
        raise StudyError(f"{path}: {error}") from error
    announce(f"mesh: {described_mesh(mesh)}")
    return mesh


def _check_order(mesh: Mesh) -> None:
    """Refuse cells all of which are folded: their nodes are in another order."""
    found = wrong_cells(mesh)
    if found is not None and len(found.bad) == found.count and not (found.mirrored or found.flat):
        raise StudyError(
            f"all {found.count} {found.cell_type} cells are inverted or folded: their nodes are listed in another "
            "order than VTK's (that of CalculiX's .frd files has other middle nodes of hex20 cells, say)"
        )


def _parts(mesh: Mesh) -> list[Mesh]:
    """The parts of a mesh that share no node, each by itself: other programs tie them, or let them touch."""
    count, part = parts_of_cells(mesh)
    if count == 1:
        return [mesh]
    return [
        Mesh(
            mesh.nodes,
            tuple(
                CellBlock(block.cell_type, cells)
                for block in mesh.blocks
                if len(cells := block.connectivity[part[block.connectivity[:, 0]] == number])
            ),
        ).without_unused_nodes()
        for number in range(count)
    ]


def check_same(first: Mesh, other: Mesh, path: Path) -> None:
    """Refuse a solution that is not on the mesh of the first (StudyError)."""
    same = len(first.blocks) == len(other.blocks) and first.nodes.shape == other.nodes.shape
    same = same and all(
        np.array_equal(a.connectivity, b.connectivity) for a, b in zip(first.blocks, other.blocks, strict=True)
    )
    if not same or np.abs(first.nodes - other.nodes).max() > SAME * np.ptp(first.nodes, axis=0).max():
        raise StudyError(
            f"{path} has another mesh than the first solution: all need the same undeformed nodes and cells, "
            "with the displacement as point data"
        )
