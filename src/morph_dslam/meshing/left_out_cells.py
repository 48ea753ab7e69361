"""Cells of VTK files that meshio does not know: it warns of them and leaves them out, or refuses the file."""

from __future__ import annotations

import re
from contextlib import redirect_stderr, suppress
from io import StringIO
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
    42: ("polyhedra", "tetrahedra"),
}


def leaves_out_cells(path: Path, content: meshio.Mesh) -> bool:
    """Whether a file has cells that its ``content`` lacks, other than of a lower dimension than the highest in it.

    Of files that are not .vtu or .vtk it has all: meshio refuses what it does not know.
    """
    pattern = _STATED.get(file_kind(path))
    if pattern is None:
        return False
    stated = [int(number) for number in pattern.findall(path.read_bytes())]
    lacking = sum(stated) - sum(len(block) for block in content.cells)
    if not stated or not lacking:
        return False
    types = _types(path)
    highest = max((block.dim for block in content.cells), default=0)
    lower = [number for number, dimension in _DIMENSIONS.items() if dimension < highest]
    return lacking > np.isin(types, lower).sum()


def unread_cells(path: Path, error: Exception | None = None) -> str | None:
    """For messages, which cells a file holds that meshio knows no number of nodes of, and what to save in their place.

    Parameters
    ----------
    path : of the file.
    error : that meshio ended in, if it did.

    Returns
    -------
    None if there are none, or the file is too damaged to tell.
    """
    numbers: list[int] = []
    if isinstance(error, KeyError):  # the name of such a cell
        numbers += [meshio_to_vtk_type[name] for name in error.args if name in meshio_to_vtk_type]
    if file_kind(path) in _STATED:
        with suppress(Exception):  # meshio raises whatever its parsers meet
            known = [k for k, name in vtk_to_meshio_type.items() if name in num_nodes_per_cell]
            numbers += np.setdiff1d(_types(path), known).tolist()
    if not numbers:
        return None
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
    with redirect_stderr(StringIO()):  # it warns once more
        reader = _vtu.VtuReader(str(path))
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
