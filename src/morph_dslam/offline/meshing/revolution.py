"""Bodies of revolution: a wall around a midline, thickened outside over some stretches."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import pi

import numpy as np
from numpy.typing import NDArray

from morph_dslam.errors import StudyError
from morph_dslam.offline.meshing.meshes import Mesh
from morph_dslam.offline.meshing.profiles import Profile
from morph_dslam.offline.meshing.structured_grid import (
    SOLIDS,
    check_divisions,
    check_type,
    unit_grid,
    with_surfaces,
)

Array = NDArray[np.float64]
Indices = NDArray[np.int64]


@dataclass(frozen=True)
class Collar:
    """A stretch of a wall of revolution that is thickened on its outer side.

    Attributes
    ----------
    start, stop : where it begins and ends, as fractions of the profile's length; moved to the nearest cells.
    thickness : what it adds to the wall, metres.
    layers : cells through that thickness.
    """

    start: float
    stop: float
    thickness: float
    layers: int = 1

    def columns(self, along: int) -> tuple[int, int]:
        """First and last grid line along the profile; raises StudyError where the collar cannot be."""
        first, last = round(self.start * along), round(self.stop * along)
        if not (0 <= first < last <= along and self.thickness > 0.0 and self.layers >= 1):
            raise StudyError(
                f"the collar from {self.start} to {self.stop}, {self.thickness} m thick "
                f"in {self.layers} layers, cannot be; "
                "give 0 <= start < stop <= 1, at least a cell apart, and a positive thickness"
            )
        return first, last


def _wall_offsets(
    grid: Array, divisions: tuple[int, int, int], wall: Array, collars: Sequence[Collar]
) -> Array:
    """Distance outwards from the midline (n,) of each grid node, given the wall's thickness there (n,)."""
    through = divisions[1]
    offsets = (np.minimum(grid[:, 1], through) / through - 0.5) * wall
    for collar in collars:
        first, last = collar.columns(divisions[0])
        in_collar = (grid[:, 1] > through) & (grid[:, 0] >= first) & (grid[:, 0] <= last)
        offsets[in_collar] += (grid[in_collar, 1] - through) / collar.layers * collar.thickness
    return offsets


def _kept_cells(divisions: tuple[int, int, int], collars: Sequence[Collar]) -> NDArray[np.bool_]:
    """Which cells of the grid exist: those of the wall, and those of the collars outside it."""
    along, through, around = divisions
    layers = max((collar.layers for collar in collars), default=0)
    taken = np.zeros(along + 1, dtype=bool)
    kept = np.zeros((along, through + layers, around), dtype=bool)
    kept[:, :through] = True
    for collar in collars:
        first, last = collar.columns(along)
        if taken[first : last + 1].any():
            raise StudyError(
                f"the collar from {collar.start} to {collar.stop} touches another; keep them apart"
            )
        taken[first : last + 1] = True
        kept[first:last, through : through + collar.layers] = True
    return kept


def _closed(grid: Mesh, around: int) -> tuple[Mesh, Array]:
    """The grid with its last plane around laid on its first; also the nodes' coordinates on the grid."""
    coordinates = grid.nodes.copy()
    coordinates[:, 2] %= around
    merged, numbers = np.unique(coordinates, axis=0, return_inverse=True)
    return grid.renumbered(numbers.ravel(), merged), merged


def _wall_surfaces(grid: Mesh, divisions: tuple[int, int, int], full: bool) -> dict[str, Indices]:
    """Boundary faces of the grid by the side of the wall that they lie on; a closed turn has no ends."""
    faces = grid.boundary_faces()
    points = grid.nodes[grid.face_nodes(faces, corners_only=True)[:, :3]]

    def lie_at(axis: int, value: int) -> NDArray[np.bool_]:
        return (points[:, :, axis] == value).all(axis=1)

    along, _, around = divisions
    sides = {"start": lie_at(2, 0), "end": lie_at(2, around), "inner": lie_at(1, 0)}
    sides |= {"bottom": lie_at(0, 0), "top": lie_at(0, along)}
    sides["outer"] = ~np.any(list(sides.values()), axis=0)
    return {name: faces[on] for name, on in sides.items() if not (full and name in ("start", "end"))}


def _revolved(
    grid: Array,
    divisions: tuple[int, int, int],
    curve: Profile,
    thickness: float | Sequence[float] | Array,
    angles: tuple[float, float],
    collars: Sequence[Collar],
) -> Array:
    """Positions (n, 3) of the nodes at grid coordinates (n, 3); raises StudyError as `revolution`."""
    fractions = grid[:, 0] / divisions[0]
    points, normals = curve.at(fractions)
    wall = curve.spread(thickness, "thickness")(fractions)
    if wall.min() <= 0.0:
        raise StudyError(f"the wall is {wall.min()} m thick somewhere; keep its thickness positive")
    section = points + normals * _wall_offsets(grid, divisions, wall, collars)[:, None]
    if section[:, 0].min() <= 0.0:
        raise StudyError(
            f"the wall reaches past the axis, to radius {section[:, 0].min():.3g} m; "
            "make it thinner or the profile wider"
        )
    angle = angles[0] + (angles[1] - angles[0]) * grid[:, 2] / divisions[2]
    return np.column_stack([section[:, 0] * np.cos(angle), section[:, 0] * np.sin(angle), section[:, 1]])


def revolution(
    profile: Sequence[Sequence[float]] | Array,
    thickness: float | Sequence[float] | Array,
    divisions: tuple[int, int, int],
    cell_type: str = "hex20",
    angles: tuple[float, float] = (0.0, 2.0 * pi),
    collars: Sequence[Collar] = (),
) -> Mesh:
    """A wall of revolution around the z axis.

    Parameters
    ----------
    profile : (p, 2) points (r, z) of the wall's midline from the bottom upwards, metres; see `Profile`.
    thickness : of the wall, metres; one value, or one for each point of the profile.
    divisions : cells along the profile, through the wall and around.
    cell_type : any solid type.
    angles : first and last angle about z, radians; a full turn is closed.
    collars : stretches thickened on the outer side; they must not touch each other.

    Returns
    -------
    Mesh
        Surfaces and node sets "inner", "outer", "bottom", "top" and, unless the turn is full, "start", "end".

    Raises
    ------
    StudyError
        If the profile or a collar cannot be, the wall reaches the axis, or the angles are not in order.
    """
    check_type(cell_type, SOLIDS)
    check_divisions(divisions, 3, "along the profile, through the wall and around")
    turn, around = angles[1] - angles[0], divisions[2]
    full = abs(turn - 2.0 * pi) < 1e-9
    if not (full or 0.0 < turn < 2.0 * pi) or (full and around < 3):
        raise StudyError(
            f"a body of revolution cannot go from {angles[0]} to {angles[1]} rad in {around} cells; "
            "go forwards by a full turn at most, and in 3 cells or more for a full turn"
        )
    curve = Profile(profile)
    grid = unit_grid(_kept_cells(divisions, collars), cell_type)
    surfaces = _wall_surfaces(grid, divisions, full)
    coordinates = grid.nodes
    if full:
        grid, coordinates = _closed(grid, around)
    mesh = replace(grid, nodes=_revolved(coordinates, divisions, curve, thickness, angles, collars))
    return with_surfaces(mesh, surfaces)
