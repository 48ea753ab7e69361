"""Writing a mesh as an Abaqus input file, with the sets that a study names."""

from __future__ import annotations

from pathlib import Path

from morph_dslam.errors import StudyError
from morph_dslam.meshing.meshes import Mesh
from morph_dslam.units import from_si

#: Abaqus's elements by our cell types; the order of their nodes is the same.
_ELEMENTS = {
    "tet4": "C3D4", "tet10": "C3D10", "prism6": "C3D6", "prism15": "C3D15", "hex8": "C3D8", "hex20": "C3D20",
}  # fmt: skip
#: Numbers on a line of labels.
_ON_A_LINE = 12


def save_mesh(path: str | Path, mesh: Mesh, unit: str) -> None:
    """Write a mesh of solids as an .inp file that `load_mesh` reads with the same nodes, cells and sets.

    Parameters
    ----------
    path : .inp file to write.
    mesh : in metres.
    unit : of the coordinates in the file.

    Raises
    ------
    StudyError
        If cells are of a type that is not written: sheets, prisms of 18 and hexahedra of 27 nodes.
    """
    unknown = {block.cell_type for block in mesh.blocks} - set(_ELEMENTS)
    if unknown:
        raise StudyError(f"cells of the type {min(unknown)} are not written as .inp; use {', '.join(_ELEMENTS)}")
    nodes = from_si(1.0, unit, "length") * mesh.nodes
    lines = ["*NODE", *(f"{k}, {x:.12g}, {y:.12g}, {z:.12g}" for k, (x, y, z) in enumerate(nodes, start=1))]
    for block, start in zip(mesh.blocks, mesh.block_starts()[:-1], strict=True):
        lines.append(f"*ELEMENT, TYPE={_ELEMENTS[block.cell_type]}")
        for label, cell in enumerate(block.connectivity + 1, start=int(start) + 1):
            lines += _wrapped([label, *cell.tolist()])
    for name, chosen in mesh.node_sets.items():
        lines += [f"*NSET, NSET={name}", *_wrapped((chosen + 1).tolist(), separate=True)]
    for name, chosen in mesh.cell_sets.items():
        lines += [f"*ELSET, ELSET={name}", *_wrapped((chosen + 1).tolist(), separate=True)]
    for name, faces in mesh.surfaces.items():
        lines += [f"*SURFACE, NAME={name}, TYPE=ELEMENT", *(f"{cell + 1}, S{face + 1}" for cell, face in faces)]
    Path(path).write_text("\n".join(lines) + "\n", encoding="utf-8")


def _wrapped(labels: list[int], separate: bool = False) -> list[str]:
    """Labels on lines of a few; those that belong together end in a comma where more follow."""
    rows = [labels[k : k + _ON_A_LINE] for k in range(0, len(labels), _ON_A_LINE)]
    texts = [", ".join(map(str, row)) for row in rows]
    return texts if separate else [*(f"{text}," for text in texts[:-1]), *texts[-1:]]
