"""What a user must know of a mesh made from a file: what was mended, how far it is off the file, if its unit is odd."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from morph_dslam.errors import StudyError
from morph_dslam.io.file_kinds import file_kind
from morph_dslam.meshing.mesh_checks import described_extent
from morph_dslam.meshing.meshes import Mesh
from morph_dslam.meshing.netgen_meshing import SURFACES, closed_surface, step_volume
from morph_dslam.meshing.surface_repair import repairs_in_words
from morph_dslam.surface_distances import distances_to_surface
from morph_dslam.units import to_si

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
#: The diagonal of an object that registration would call unusually small, metres.
UNUSUALLY_SMALL = 0.005
#: A mesh is off its file where its volume, or its distance in diagonals, differs by more than this share.
OFF_FILE = 0.005
#: More cells than these are seldom meant: a study is solved dozens of times.
MANY_CELLS = 20_000


@dataclass(frozen=True)
class SurfaceDeviation:
    """How a mesh differs from the closed surface that it was made from.

    Attributes
    ----------
    volume : of the mesh over that of the file, less one.
    largest, mean : distances of the file's vertices from the mesh's surface, metres.
    diagonal : of the file's bounding box, metres.
    """

    volume: float
    largest: float
    mean: float
    diagonal: float

    @property
    def notable(self) -> bool:
        """Whether results will show it."""
        return abs(self.volume) > OFF_FILE or self.largest > OFF_FILE * self.diagonal


def surface_deviation(mesh: Mesh, points: Array, triangles: Indices) -> SurfaceDeviation:
    """Compare the outer surface of a mesh with the closed surface of its file.

    Parameters
    ----------
    mesh : metres; faces of second order count as the triangles through their middle nodes.
    points : (n, 3) of the file, metres.
    triangles : (t, 3) of the file.
    """
    outer = mesh.surface_triangles()
    distances = distances_to_surface(points[np.unique(triangles)], mesh.nodes, outer)
    diagonal = float(np.linalg.norm(np.ptp(points, axis=0)))
    volume = _volume(mesh.nodes[outer]) / _volume(points[triangles]) - 1.0
    return SurfaceDeviation(volume, float(distances.max()), float(distances.mean()), diagonal)


def _volume(corners: Array) -> float:
    """Within outward triangles (t, 3, 3)."""
    about = corners - corners.mean(axis=(0, 1))
    return float(np.einsum("ti,ti->", about[:, 0], np.cross(about[:, 1], about[:, 2]))) / 6.0


def file_notes(mesh: Mesh, path: str | Path, unit: str, size: float | None = None) -> list[str]:
    """Sentences on the mesh of a file; none where there is nothing to say.

    Parameters
    ----------
    mesh : as read or made from the file, metres.
    path : of the file.
    unit : of its coordinates.
    size : longest edge of a cell where its volume was meshed, metres; None if its triangles were kept.
    """
    path = Path(path)
    notes = []
    if not mesh.is_sheet and file_kind(path) in SURFACES:
        notes += _surface_notes(mesh, path, to_si(1.0, unit, "length"), size)
    if not mesh.is_sheet and file_kind(path) == ".step":
        notes += _step_notes(mesh, path)
    return [*notes, *small_extent_note(np.ptp(mesh.nodes, axis=0), path, unit)]


def file_deviation(mesh: Mesh, path: Path, unit: str, size: float | None) -> dict[str, float] | None:
    """How far a mesh is off the surface of its file, for the certificate; None where results do not show it.

    Parameters
    ----------
    mesh, path, unit, size : as of `file_notes`.
    """
    if mesh.is_sheet or size is None or file_kind(path) not in SURFACES:
        return None
    try:
        surface, _ = closed_surface(path)
    except StudyError:  # the file has changed since the mesh was made of it
        return None
    found = surface_deviation(mesh, to_si(1.0, unit, "length") * surface.points, surface.triangles)
    return {"volume": found.volume, "mean_m": found.mean} if found.notable else None


def _surface_notes(mesh: Mesh, path: Path, scale: float, size: float | None) -> Iterator[str]:
    try:
        surface, repairs = closed_surface(path)
    except StudyError:  # the file has changed since the mesh was made of it
        return
    if repairs:
        yield f"the surface of {path.name} was repaired: {', '.join(repairs_in_words(repairs))}"
    if size is None:
        return
    found = surface_deviation(mesh, scale * surface.points, surface.triangles)
    if found.notable:
        volume = _compared(found.volume) if abs(found.volume) > 1e-4 else "as large as"
        yield (
            f"the mesh is {volume} its file, and up to {1e3 * found.largest:.2g} mm away from its surface "
            f"({1e3 * found.mean:.2g} mm on average): take a smaller size, or leave it out to keep the file's triangles"
        )


def _step_notes(mesh: Mesh, path: Path) -> Iterator[str]:
    """On cells with flat sides, which cut the round sides of a solid short (or, of a hole, fill it)."""
    try:
        change = _volume(mesh.nodes[mesh.surface_triangles()]) / step_volume(path) - 1.0
    except StudyError:  # the file has changed since the mesh was made of it
        return
    if abs(change) > OFF_FILE:
        bending = (1.0 + change) ** 2 - 1.0  # the second moment of a round section goes with its area squared
        yield (
            f"the mesh is {_compared(change)} the solids of {path.name}, whose round sides its cells make flat (a rod "
            f"bends {_per_cent(bending)} too {'easily' if bending < 0.0 else 'little'} by that): take a smaller size"
        )


def _compared(change: float) -> str:
    """A volume over another, less one, in words."""
    return f"{_per_cent(change)} {'smaller' if change < 0.0 else 'larger'} than"


def _per_cent(part: float) -> str:
    return f"{100.0 * abs(part):.2g} %"


def small_extent_note(extent: Array, path: Path, unit: str) -> list[str]:
    """A sentence if an object with lengths (3,) along the axes, metres, is so small that its unit may be wrong."""
    if np.linalg.norm(extent) >= UNUSUALLY_SMALL:
        return []
    size = described_extent(1e3 * extent)
    return [f"{path.name} measures {size} mm; if that is not so, '{unit}' is not the unit it was drawn in"]


def many_cells_note(mesh: Mesh) -> list[str]:
    """A sentence if a solid has so many cells that its unit, or the size of its cells, may be wrong."""
    if mesh.n_cells <= MANY_CELLS:
        return []
    size = described_extent(1e3 * np.ptp(mesh.nodes, axis=0))
    return [
        f"{mesh.n_cells} cells take long to solve; if the object does not measure {size} mm, its unit is wrong, else "
        "larger cells may do"
    ]
