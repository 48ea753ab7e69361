"""Cells of VTK files that meshio does not know: it warns of them and leaves them out, or refuses the file."""

from __future__ import annotations

import re
from contextlib import suppress
from pathlib import Path
from xml.etree import ElementTree

import meshio
import numpy as np
from meshio._common import num_nodes_per_cell
from meshio._vtk_common import meshio_to_vtk_type, vtk_to_meshio_type
from meshio.vtu import _vtu
from numpy.typing import NDArray

from morph_dslam.io.file_kinds import file_kind

#: How many cells a file states: once for each piece, or for all.
_STATED = {
    ".vtu": re.compile(rb"""<Piece[^>]*?\sNumberOfCells\s*=\s*["'](\d+)["']"""),
    ".vtk": re.compile(rb"^CELL_TYPES[ \t]+(\d+)[ \t]*\r?\n", re.MULTILINE),
}
#: Dimension, by VTK's number, of cells that meshio leaves out: vertices, lines and triangles that are joined to one.
_DIMENSIONS = {2: 0, 4: 1, 6: 2}
#: What cells are called, by VTK's number, and what can be saved in their place.
_INSTEAD = {
    2: ("polyvertices", "vertices"),
    4: ("polylines", "lines"),
    6: ("triangle strips", "triangles"),
    7: ("polygons", "triangles"),
    8: ("pixels", "quadrilaterals"),
    11: ("voxels", "hexahedra"),
    26: ("prisms of 15 nodes", "prisms of 18 or 6"),
    30: ("quadrilaterals of 6 nodes", "quadrilaterals of 8 or 4"),
    34: ("triangles of 7 nodes", "triangles of 6 or 3"),
    42: ("polyhedra", "tetrahedra"),
}


def left_out_cells(path: Path, content: meshio.Mesh) -> str | None:
    """For messages, which cells a file has that its ``content`` lacks, and what to save in their place.

    Those of a lower dimension than the highest in it do not count. Of files that are not .vtu or .vtk it has all:
    meshio refuses what it does not know.

    Returns
    -------
    None if it lacks none.
    """
    stated = _stated(path)
    lacking = sum(stated) - sum(len(block) for block in content.cells)
    if not stated or not lacking:
        return None
    types = _types(path)
    highest = max((block.dim for block in content.cells), default=0)
    lower = [number for number, dimension in _DIMENSIONS.items() if dimension < highest]
    if lacking <= np.isin(types, lower).sum():
        return None
    if unknown := np.setdiff1d(types, [*vtk_to_meshio_type, *lower]).tolist():
        return _named(unknown)
    return (
        "several pieces, of which only the last is read: merge them" if len(stated) > 1 else "cells that are not known"
    )


def why_unread(path: Path, error: Exception) -> str:
    """What is wrong with a file that meshio refused, and how to mend it: for messages, after the file's name.

    Parameters
    ----------
    path : of the file.
    error : that meshio ended in.
    """
    numbers: list[int] = []
    reason = f"{type(error).__name__}: {error}".removesuffix(": ")
    if isinstance(error, KeyError):  # the name of such a cell
        numbers += [meshio_to_vtk_type[name] for name in error.args if name in meshio_to_vtk_type]
    if stated := _stated(path):
        if not sum(stated):
            return "holds no cells: save the mesh with its cells"
        with suppress(Exception):  # meshio raises whatever its parsers meet
            types, is_old = _types(path), _is_old(path)
            numbers += [number for number in np.unique(types).tolist() if _ends_reading(number, is_old)]
            if not numbers and is_old and _other_sizes(path, types):
                reason = "its cells have other numbers of nodes than cells of their types"
    if numbers:
        return f"holds {_named(numbers)}"
    return f"is damaged, cut short, or no {file_kind(path)} file ({reason})"


def _stated(path: Path) -> list[int]:
    """How many cells a .vtu or .vtk file states that it has, for each place where it does."""
    pattern = _STATED.get(file_kind(path))
    return [] if pattern is None else [int(number) for number in pattern.findall(path.read_bytes())]


def _is_old(path: Path) -> bool:
    """Whether a file is of VTK's legacy format in a version that lists each cell with its number of nodes."""
    return file_kind(path) == ".vtk" and b"\nOFFSETS " not in path.read_bytes()


def _ends_reading(number: int, is_old: bool) -> bool:
    """Whether meshio refuses a file for cells of a type, by VTK's number, rather than read them or leave them out.

    ``is_old`` is as of `_is_old`.
    """
    name = vtk_to_meshio_type.get(number)
    if name is None:
        return is_old
    # Of polygons and Lagrange cells the newer formats state each one's number of nodes.
    is_stated = name == "polygon" or (name.startswith("VTK_LAGRANGE") and not is_old)
    return name not in num_nodes_per_cell and not is_stated


def _other_sizes(path: Path, types: NDArray[np.int64]) -> bool:
    """Whether an old legacy file states another number of nodes than cells of its ``types`` (n,) have."""
    found = re.search(rb"^CELLS[ \t]+\d+[ \t]+(\d+)", path.read_bytes(), re.MULTILINE)
    if found is None:
        return False
    return int(found[1]) != sum(1 + num_nodes_per_cell[vtk_to_meshio_type[number]] for number in types.tolist())


def _named(numbers: list[int]) -> str:
    """Cells by VTK's numbers of their types, and what to save in their place."""
    named = [_INSTEAD.get(number, (f"cells of VTK's type {number}", "linear ones")) for number in numbers]
    cells, instead = (" and ".join(dict.fromkeys(words)) for words in zip(*named, strict=True))
    return f"{cells}, which cannot be read: save {instead} in their place"


def _types(path: Path) -> NDArray[np.int64]:
    """VTK's numbers (n,) of the types of all cells of a .vtu or .vtk file."""
    return _types_of_vtu(path) if file_kind(path) == ".vtu" else _types_of_vtk(path)


def _types_of_vtu(path: Path) -> NDArray[np.int64]:
    """VTK's numbers (n,) of the types of all cells."""
    try:
        root = ElementTree.parse(path).getroot()
    except ElementTree.ParseError:  # data appended as they are in memory
        root = _vtu._parse_raw_binary(str(path))
    arrays = root.iterfind("UnstructuredGrid/Piece/Cells/DataArray[@Name='types']")
    reader = _vtu.VtuReader.__new__(_vtu.VtuReader)  # its constructor reads all of the file, and may refuse it
    reader.compression, reader.byte_order = root.get("compressor"), root.get("byte_order")
    reader.header_type, reader.appended_data = root.get("header_type", "UInt32"), _vtu.get_grid(root)[1]
    return np.concatenate([np.asarray(reader.read_data(array)).ravel() for array in arrays]).astype(np.int64)


def _types_of_vtk(path: Path) -> NDArray[np.int64]:
    """VTK's numbers (n,) of the types of all cells."""
    content = path.read_bytes()
    found = _STATED[".vtk"].search(content)
    assert found is not None
    count, after = int(found[1]), content[found.end() :]
    if content.split(b"\n", 3)[2].strip().upper() == b"ASCII":
        return np.array(after.split(None, count)[:count], dtype=np.int64)
    return np.frombuffer(after, ">i4", count).astype(np.int64)
