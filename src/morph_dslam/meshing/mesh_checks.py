"""Checks of a mesh before anything is solved on it; each message says which cells, where, and what to do."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from morph_dslam.errors import StudyError
from morph_dslam.meshing.meshes import Mesh, jacobian_determinants, parts_of_cells

Indices = NDArray[np.int64]
#: Diagonals of the bounding box (metres) beyond which a length unit was probably mistaken.
LARGEST, SMALLEST = 5.0, 1e-4
#: More cells than a generator is asked for by intention: no memory holds their factorisation.
MOST_CELLS = 5_000_000


def check_mesh(mesh: Mesh, sets: Iterable[str] = (), regions: Iterable[str] = ()) -> None:
    """Raise StudyError at the first thing that would make a solution wrong or impossible.

    Checked in this order: nodes and cells exist and are finite; sets name what exists; the size is plausible
    for metres; no two cells are the same; no cell is inverted, folded or flat; no face has three cells; every
    node belongs to a cell; all is one part; the sets that the study names are there.

    Parameters
    ----------
    mesh : the mesh, metres.
    sets : node sets or surfaces that a study refers to.
    regions : cell sets that a study refers to.
    """
    _check_arrays(mesh)
    check_size(mesh)
    _check_duplicates(mesh)
    _check_orientation(mesh)
    _check_faces(mesh)
    _check_connection(mesh)
    for name in sets:
        if not len(mesh.set_nodes(name)):
            raise StudyError(f"the set '{name}' is empty; name a set that holds nodes")
    for name in regions:
        if not len(mesh.cells(name)):
            raise StudyError(f"the cell set '{name}' is empty; name a set that holds cells")


def check_corners(corners: Indices, n_points: int, path: Path, what: str = "cells", points: str = "nodes") -> None:
    """Raise StudyError unless cells refer to points that a file holds.

    Parameters
    ----------
    corners : of the cells, numbers of points, in any shape.
    n_points : how many the file holds.
    path : of the file.
    what, points : what the message calls the cells and the points.
    """
    if corners.size and not 0 <= corners.min() <= corners.max() < n_points:
        raise StudyError(f"{path} has {what} that refer to {points} which it does not hold ({n_points} are there)")


def _check_arrays(mesh: Mesh) -> None:
    if not mesh.n_nodes or not mesh.n_cells:
        raise StudyError(f"the mesh has {mesh.n_nodes} nodes and {mesh.n_cells} cells; it needs some of both")
    bad = np.flatnonzero(~np.isfinite(mesh.nodes).all(axis=1))
    if len(bad):
        raise StudyError(f"{len(bad)} nodes have coordinates that are not finite, the first at index {bad[0]}")
    if len({block.type.dimension for block in mesh.blocks}) > 1:
        raise StudyError("the mesh mixes solid and sheet cells; keep one kind, in a file of its own")
    named = [("cells", block.cell_type, block.connectivity, mesh.n_nodes) for block in mesh.blocks]
    named += [("node set", name, nodes, mesh.n_nodes) for name, nodes in mesh.node_sets.items()]
    named += [("cell set", name, cells, mesh.n_cells) for name, cells in mesh.cell_sets.items()]
    named += [("surface", name, faces[:, 0], mesh.n_cells) for name, faces in mesh.surfaces.items()]
    for what, name, numbers, count in named:
        if numbers.size and not 0 <= numbers.min() <= numbers.max() < count:
            raise StudyError(f"the {what} '{name}' refer to index {numbers.max()}, but there are {count}")


def check_size(mesh: Mesh) -> None:
    """Refuse a mesh of a size that no object has here: its unit is probably wrong; raises StudyError."""
    check_extent(np.ptp(mesh.nodes, axis=0), "the mesh")


def check_extent(extent: NDArray[np.float64], what: str) -> None:
    """The same of an object's lengths along the axes (3,), metres; ``what`` it is begins the message."""
    diagonal = float(np.linalg.norm(extent))
    if SMALLEST <= diagonal <= LARGEST:
        return
    guess = "smaller one such as mm" if diagonal > LARGEST else "larger one such as m"
    raise StudyError(
        f"{what} measures {described_extent(extent)} m, which is hardly meant: its unit of length is probably wrong; "
        f"declare the unit in which it was drawn (a {guess})"
    )


def described_extent(extent: NDArray[np.float64]) -> str:
    """Lengths along the axes (3,) for people, in their unit."""
    return " x ".join(f"{length:.3g}" for length in extent)


@dataclass(frozen=True)
class WrongCells:
    """Cells of one type that are inverted, folded or flat.

    Attributes
    ----------
    cell_type : of the cells.
    bad : their indices in the mesh.
    count : of all cells of the type.
    mirrored : whether all of them are turned inside out.
    flat : whether none has more than rounding's volume of the wrong sign.
    where : the place of the first, for messages.
    """

    cell_type: str
    bad: Indices
    count: int
    mirrored: bool
    flat: bool
    where: str

    def __str__(self) -> str:
        kind = "flat" if self.flat else "inverted or folded"
        counted = f"{len(self.bad)} of {self.count} {self.cell_type} cells"
        return f"{counted} are {kind}, the first cell {self.bad[0]} {self.where}"


def wrong_cells(mesh: Mesh) -> WrongCells | None:
    """The cells of the first block that has inverted, folded or flat ones; None if all are sound."""
    for block, start in zip(mesh.blocks, mesh.block_starts()[:-1], strict=True):
        determinants = jacobian_determinants(mesh, block)
        # Rounding leaves a flat cell a volume of either sign; its size cubed is what to measure it by.
        corners = mesh.nodes[block.connectivity[:, : block.type.corners]]
        size = np.ptp(corners, axis=1).max(axis=1) ** block.type.dimension
        worst = determinants.min(axis=1)
        bad = np.flatnonzero(worst <= 1e-12 * size)
        if len(bad):
            mirrored = len(bad) == len(worst) and bool((determinants < 0.0).all())
            flat = not worst[bad].min() < -1e-12 * size[bad].max()
            where = place(mesh, block.connectivity[bad[0]])
            return WrongCells(block.cell_type, start + bad, len(worst), mirrored, flat, where)
    return None


def _check_orientation(mesh: Mesh) -> None:
    found = wrong_cells(mesh)
    if found is None:
        return
    if found.mirrored:
        raise StudyError(
            f"every {found.cell_type} cell is inverted: their nodes are listed in mirrored order; "
            "list them as VTK or Abaqus does"
        )
    raise StudyError(f"{found}; mend the mesh there (a wall thicker than its bend's radius folds its cells)")


def _check_duplicates(mesh: Mesh) -> None:
    for block, start in zip(mesh.blocks, mesh.block_starts()[:-1], strict=True):
        ordered = np.sort(block.connectivity, axis=1)
        repeated = np.flatnonzero((ordered[:, 1:] == ordered[:, :-1]).any(axis=1))
        if len(repeated):
            raise StudyError(
                f"{len(repeated)} {block.cell_type} cells use a node twice, the first cell "
                f"{start + repeated[0]} {place(mesh, block.connectivity[repeated[0]])}; "
                "use cells of the shape that is left instead (a prism, say)"
            )
        _, first, counts = np.unique(ordered, axis=0, return_index=True, return_counts=True)
        double = first[counts > 1]
        if len(double):
            raise StudyError(
                f"{len(double)} {block.cell_type} cells are there more than once, the first cell "
                f"{start + double[0]} {place(mesh, block.connectivity[double[0]])}; remove the copies"
            )


def _check_faces(mesh: Mesh) -> None:
    if mesh.blocks[0].type.dimension == 2:
        return
    faces = mesh.all_faces()
    keys, counts = np.unique(np.sort(mesh.face_nodes(faces, corners_only=True), axis=1), axis=0, return_counts=True)
    crowded = np.flatnonzero(counts > 2)
    if len(crowded):
        nodes = keys[crowded[0]]
        raise StudyError(
            f"{len(crowded)} faces have more than two cells, the first {place(mesh, nodes[nodes >= 0])}; "
            "cells overlap there: remove the extra ones"
        )


def _check_connection(mesh: Mesh) -> None:
    loose = np.flatnonzero(~mesh.used)
    if len(loose):
        raise StudyError(
            f"{len(loose)} nodes belong to no cell, the first at {_millimetres(mesh.nodes[loose[0]])}; remove them"
        )
    _, part = parts_of_cells(mesh)
    sizes = np.bincount(part)
    if len(sizes) > 1:
        second = np.flatnonzero(part == np.argsort(-sizes)[1])
        raise StudyError(
            f"the mesh falls into {len(sizes)} parts that share no node; the second largest has "
            f"{len(second)} nodes {place(mesh, second)}: merge coincident nodes, or keep one part"
        )


def _millimetres(point: NDArray[np.float64]) -> str:
    return "(" + ", ".join(f"{1e3 * x:.4g}" for x in point) + ") mm"


def place(mesh: Mesh, nodes: Indices) -> str:
    return f"around {_millimetres(mesh.nodes[nodes].mean(axis=0))}"
