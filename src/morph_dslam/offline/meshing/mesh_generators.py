"""Structured meshes: block, sheet, tube and body of revolution, each with its natural sets named.

Every solid generator meshes a grid of unit cells, gives it middle nodes where the cell type has them, and
only then bends it into shape, so that second-order cells have their middle nodes on the curved surfaces.
"""

from __future__ import annotations

from dataclasses import replace
from math import pi

import numpy as np
from numpy.typing import NDArray

from morph_dslam.errors import StudyError
from morph_dslam.offline.meshing.meshes import CellBlock, Mesh
from morph_dslam.offline.meshing.revolution import Collar, revolution
from morph_dslam.offline.meshing.structured_grid import (
    CUTS,
    SOLIDS,
    check_divisions,
    check_type,
    unit_grid,
    with_surfaces,
)

__all__ = ["Collar", "block", "revolution", "sheet", "tube"]

Indices = NDArray[np.int64]


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
    check_type(cell_type, SOLIDS)
    check_divisions(divisions, 3, "along x, y and z")
    if len(size) != 3 or min(size) <= 0.0:
        raise StudyError(f"the block's size is {tuple(size)} m; give three positive lengths")
    grid = unit_grid(np.ones(divisions, dtype=bool), cell_type)
    names = {f"{axis}_min": (i, 0) for i, axis in enumerate("xyz")}
    names |= {f"{axis}_max": (i, divisions[i]) for i, axis in enumerate("xyz")}
    mesh = replace(grid, nodes=grid.nodes * (np.array(size) / np.array(divisions)))
    return with_surfaces(mesh, _plane_surfaces(grid, names))


def sheet(size: tuple[float, float], divisions: tuple[int, int], cell_type: str = "quad4") -> Mesh:
    """A flat rectangle in the plane z = 0 with one corner at the origin, seen from +z.

    Parameters
    ----------
    size : extents along x and y, metres.
    divisions : cells along x and y; each square is cut in two for "tri3".
    cell_type : "quad4" or "tri3".

    Returns
    -------
    Mesh
        Node sets "x_min", "x_max", "y_min", "y_max" of its edges; surface "top", all of it.

    Raises
    ------
    StudyError
        As `block`.
    """
    check_type(cell_type, ("quad4", "tri3"))
    check_divisions(divisions, 2, "along x and y")
    if len(size) != 2 or min(size) <= 0.0:
        raise StudyError(f"the sheet's size is {tuple(size)} m; give two positive lengths")
    shape = np.array(divisions) + 1
    corners = np.argwhere(np.ones(shape, dtype=bool))
    squares = np.argwhere(np.ones(divisions, dtype=bool))
    numbers = (squares[:, None, :] + np.array([[0, 0], [1, 0], [1, 1], [0, 1]])) @ np.array([shape[1], 1])
    cut = np.array(CUTS[cell_type])
    flat = corners * (np.array(size) / np.array(divisions))
    mesh = Mesh(
        np.column_stack([flat, np.zeros(len(flat))]),
        (CellBlock(cell_type, numbers[:, cut].reshape(-1, cut.shape[1])),),
    )
    edges = {f"{axis}_min": np.flatnonzero(corners[:, i] == 0) for i, axis in enumerate("xy")}
    edges |= {f"{axis}_max": np.flatnonzero(corners[:, i] == divisions[i]) for i, axis in enumerate("xy")}
    return replace(mesh, node_sets=edges, surfaces={"top": mesh.all_faces()})


def tube(
    inner_radius: float,
    outer_radius: float,
    length: float,
    divisions: tuple[int, int, int],
    cell_type: str = "hex20",
    angles: tuple[float, float] = (0.0, 2.0 * pi),
) -> Mesh:
    """A straight tube around the z axis from z = 0 to ``length`` (metres).

    Divisions are along z, through the wall and around; angles, sets and errors are those of `revolution`.
    """
    if not 0.0 < inner_radius < outer_radius or length <= 0.0:
        raise StudyError(
            f"a tube of radii {inner_radius} and {outer_radius} m and length {length} m cannot be; "
            "give 0 < inner_radius < outer_radius and a positive length"
        )
    middle = 0.5 * (inner_radius + outer_radius)
    profile = [(middle, 0.0), (middle, length)]
    return revolution(profile, outer_radius - inner_radius, divisions, cell_type, angles)
