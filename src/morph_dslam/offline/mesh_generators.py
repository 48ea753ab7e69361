"""Structured meshes: block, sheet, tube and body of revolution, each with its natural sets named.

Every solid generator meshes a grid of unit cells, gives it middle nodes where the cell type has them, and
only then bends it into shape, so that second-order cells have their middle nodes on the curved surfaces.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from morph_dslam.errors import StudyError
from morph_dslam.offline.cell_types import cell_type
from morph_dslam.offline.mesh_conversion import FIRST_ORDER, to_second_order
from morph_dslam.offline.meshes import CellBlock, Mesh

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

#: How a unit cube, its corners numbered as a hex8's, is cut into cells; cubes side by side match.
_CUTS: dict[str, tuple[tuple[int, ...], ...]] = {
    "hex8": ((0, 1, 2, 3, 4, 5, 6, 7),),
    "prism6": ((0, 1, 2, 4, 5, 6), (0, 2, 3, 4, 6, 7)),
    "tet4": (
        (0, 1, 2, 6), (0, 2, 3, 6), (0, 3, 7, 6), (0, 7, 4, 6), (0, 4, 5, 6), (0, 5, 1, 6),
    ),
    "quad4": ((0, 1, 2, 3),),
    "tri3": ((0, 1, 2), (0, 2, 3)),
}  # fmt: skip


def _check_divisions(divisions: tuple[int, ...], count: int, names: str) -> None:
    if len(divisions) != count or any(int(n) != n or n < 1 for n in divisions):
        raise StudyError(
            f"divisions are {tuple(divisions)}; give {count} whole numbers of at least 1: {names}"
        )


def _check_type(name: str, known: tuple[str, ...]) -> None:
    if name not in known:
        raise StudyError(f"'{name}' is not a cell type of this generator; use one of {', '.join(known)}")


_SOLIDS = ("hex8", "hex20", "hex27", "tet4", "tet10", "prism6", "prism15", "prism18")


def _grid(divisions: tuple[int, int, int], name: str, kept: NDArray[np.bool_] | None = None) -> Mesh:
    """Unit cubes at whole-number coordinates, cut into cells; only the cubes where ``kept`` is true."""
    shape = tuple(n + 1 for n in divisions)
    corner = np.argwhere(np.ones(shape, dtype=bool))
    cubes = np.argwhere(np.ones(divisions, dtype=bool) if kept is None else kept)
    offsets = cell_type("hex8").nodes.astype(np.int64)
    strides = np.array([shape[1] * shape[2], shape[2], 1])
    numbers = (cubes[:, None, :] + offsets) @ strides
    first_order = FIRST_ORDER.get(name, name)
    connectivity = numbers[:, np.array(_CUTS[first_order])].reshape(-1, cell_type(first_order).corners)
    mesh = Mesh(corner.astype(np.float64), (CellBlock(first_order, connectivity),)).without_unused_nodes()
    return mesh if first_order == name else to_second_order(mesh, name)


def _with_surfaces(mesh: Mesh, surfaces: dict[str, Indices]) -> Mesh:
    """Name surfaces, and the set of nodes of each by the same name; empty ones are left out."""
    mesh = replace(mesh, surfaces={name: faces for name, faces in surfaces.items() if len(faces)})
    return replace(mesh, node_sets={name: mesh.surface_nodes(name) for name in mesh.surfaces})


def _plane_surfaces(grid: Mesh, names: dict[str, tuple[int, int]]) -> dict[str, Indices]:
    """Boundary faces of a grid that lie in coordinate planes, given as name: (axis, value)."""
    faces = grid.boundary_faces()
    points = grid.nodes[grid.face_nodes(faces, corners_only=True)[:, :3]]
    return {name: faces[(points[:, :, axis] == value).all(axis=1)] for name, (axis, value) in names.items()}


def block(
    size: tuple[float, float, float], divisions: tuple[int, int, int], cell_type: str = "hex20"
) -> Mesh:
    """A rectangular block with one corner at the origin.

    Parameters
    ----------
    size : extents along x, y and z, metres.
    divisions : cells along x, y and z; each cube is cut in 2 prisms (standing along z) or 6 tetrahedra.
    cell_type : any solid type.

    Returns
    -------
    Mesh
        Surfaces and node sets "x_min", "x_max", "y_min", "y_max", "z_min", "z_max".

    Raises
    ------
    StudyError
        If a size or a division is not positive, or the cell type is unknown.
    """
    _check_type(cell_type, _SOLIDS)
    _check_divisions(divisions, 3, "along x, y and z")
    if len(size) != 3 or min(size) <= 0.0:
        raise StudyError(f"the block's size is {tuple(size)} m; give three positive lengths")
    grid = _grid(divisions, cell_type)
    names = {f"{axis}_min": (i, 0) for i, axis in enumerate("xyz")}
    names |= {f"{axis}_max": (i, divisions[i]) for i, axis in enumerate("xyz")}
    mesh = replace(grid, nodes=grid.nodes * (np.array(size) / np.array(divisions)))
    return _with_surfaces(mesh, _plane_surfaces(grid, names))
