"""Structured meshes: block, tube and body of revolution, each with its natural sets named.

Every generator meshes a grid of unit cells, gives it middle nodes where the cell type has them, and only then bends it
into shape, so that second-order cells have their middle nodes on the curved surfaces.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from math import pi

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import Akima1DInterpolator

from morph_dslam.errors import StudyError
from morph_dslam.meshing.meshes import CellBlock, Mesh, end_surfaces
from morph_dslam.meshing.second_order import FIRST_ORDER, to_second_order
from morph_dslam.model.cell_types import cell_type

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
#: Solid cell types, all of which the solid generators make.
SOLIDS = ("hex8", "hex20", "hex27", "tet4", "tet10", "prism6", "prism15", "prism18")
#: How a unit cube, its corners numbered as a hex8's, is cut into cells; cubes side by side match.
CUTS: dict[str, tuple[tuple[int, ...], ...]] = {
    "hex8": ((0, 1, 2, 3, 4, 5, 6, 7),),
    "prism6": ((0, 1, 2, 4, 5, 6), (0, 2, 3, 4, 6, 7)),
    "tet4": (
        (0, 1, 2, 6), (0, 2, 3, 6), (0, 3, 7, 6), (0, 7, 4, 6), (0, 4, 5, 6), (0, 5, 1, 6),
    ),
}  # fmt: skip


def _check(divisions: tuple[int, int, int], names: str, cell_type: str) -> None:
    """Raise StudyError unless divisions are whole and positive, and the cell type is known; ``names`` says of what."""
    if len(divisions) != 3 or any(int(n) != n or n < 1 for n in divisions):
        raise StudyError(f"divisions are {tuple(divisions)}; give 3 whole numbers of at least 1: {names}")
    if cell_type not in SOLIDS:
        raise StudyError(f"'{cell_type}' is not a cell type of this generator; use one of {', '.join(SOLIDS)}")


def _unit_grid(kept: NDArray[np.bool_], name: str) -> Mesh:
    """Unit cubes at whole-number coordinates, where ``kept`` (n, m, l) is true, cut into cells of a type."""
    shape = tuple(n + 1 for n in kept.shape)
    strides = np.array([shape[1] * shape[2], shape[2], 1])
    corners = cell_type("hex8").nodes.astype(np.int64)
    cubes = (np.argwhere(kept)[:, None, :] + corners) @ strides
    first_order = FIRST_ORDER.get(name, name)
    cut = np.array(CUTS[first_order])
    blocks = (CellBlock(first_order, cubes[:, cut].reshape(-1, cut.shape[1])),)
    mesh = Mesh(np.argwhere(np.ones(shape, dtype=bool)).astype(np.float64), blocks).without_unused_nodes()
    return mesh if first_order == name else to_second_order(mesh, name)


def with_surfaces(mesh: Mesh, surfaces: dict[str, Indices]) -> Mesh:
    """Name surfaces, and the set of nodes of each by the same name; empty ones are left out."""
    mesh = replace(mesh, surfaces={name: faces for name, faces in surfaces.items() if len(faces)})
    return replace(mesh, node_sets={name: mesh.surface_nodes(name) for name in mesh.surfaces})


def _plane_surfaces(grid: Mesh, planes: dict[str, tuple[int, int]], rest: str) -> dict[str, Indices]:
    """Boundary faces of a grid in coordinate planes, given as name: (axis, value); all others by the name ``rest``."""
    faces = grid.boundary_faces()
    points = grid.nodes[grid.face_nodes(faces, corners_only=True)[:, :3]]
    on = {name: (points[:, :, axis] == value).all(axis=1) for name, (axis, value) in planes.items()}
    on[rest] = ~np.any(list(on.values()), axis=0)
    return {name: faces[mask] for name, mask in on.items()}


#: Points between two given ones at which arc length is summed; the sum's relative error is about 1e-6.
_SAMPLES = 400


class Profile:
    """A smooth curve (r, z) through given points, from the bottom upwards.

    Akima's interpolation (J. ACM 17, 1970) by chord length: a straight stretch of points stays straight, and the curve
    does not overshoot where it meets a fold. Raises StudyError if there are fewer than two points, two in a row
    coincide, a radius is not positive, or the profile runs downwards.

    Parameters
    ----------
    points : (p, 2) radius and height, metres.
    """

    def __init__(self, points: Sequence[Sequence[float]] | Array):
        try:
            knots = np.array(points, dtype=np.float64)
        except ValueError as error:
            raise StudyError(f"the profile is not a list of points (r, z): {error}") from error
        if knots.ndim != 2 or knots.shape[1] != 2 or len(knots) < 2 or not np.isfinite(knots).all():
            raise StudyError("the profile needs two points (r, z) or more, all of them finite numbers")
        chords = np.linalg.norm(np.diff(knots, axis=0), axis=1)
        if (chords == 0.0).any():
            i = int(np.argmin(chords))
            raise StudyError(f"points {i + 1} and {i + 2} of the profile coincide at {knots[i].tolist()}; drop one")
        if knots[:, 0].min() <= 0.0:
            raise StudyError(f"the profile has radius {knots[:, 0].min()} m; keep every radius positive")
        if knots[-1, 1] < knots[0, 1]:
            raise StudyError("the profile runs downwards; list its points from the bottom upwards")
        self._chord = np.concatenate([[0.0], np.cumsum(chords)])
        self._points_at = self._chord
        if len(knots) == 2:  # Akima's slopes need three points
            knots = np.insert(knots, 1, knots.mean(axis=0), axis=0)
            self._chord = np.insert(self._chord, 1, self._chord[-1] / 2.0)
        self._curve = Akima1DInterpolator(self._chord, knots)
        steps = np.linspace(0.0, 1.0, _SAMPLES, endpoint=False)
        fine = (self._chord[:-1, None] + np.diff(self._chord)[:, None] * steps).ravel()
        self._fine = np.append(fine, self._chord[-1])
        pieces = np.linalg.norm(np.diff(self._curve(self._fine), axis=0), axis=1)
        self._arc = np.concatenate([[0.0], np.cumsum(pieces)])

    @property
    def length(self) -> float:
        """Arc length, metres."""
        return float(self._arc[-1])

    def at(self, fractions: Array) -> tuple[Array, Array]:
        """Points (n, 2) and outward unit normals (n, 2) at fractions (n,) of the arc length.

        Outward is to the right of the way upwards: away from the axis where the profile rises.
        """
        chord = np.interp(fractions * self.length, self._arc, self._fine)
        tangents = self._curve(chord, nu=1)
        tangents /= np.linalg.norm(tangents, axis=1)[:, None]
        return self._curve(chord), np.column_stack([tangents[:, 1], -tangents[:, 0]])

    def spread(self, values: float | Sequence[float] | Array, what: str) -> Callable[[Array], Array]:
        """A function of fractions of the arc length: linear between values given at the profile's points.

        Raises StudyError if there is neither one value nor one for each point; ``what`` names them.
        """
        given = np.atleast_1d(np.asarray(values, dtype=np.float64))
        if given.shape not in ((1,), (len(self._points_at),)):
            raise StudyError(
                f"{what} has {given.size} values for a profile of {len(self._points_at)} points; "
                "give one, or one for each point"
            )
        places = np.interp(self._points_at, self._fine, self._arc) / self.length
        return lambda fractions: np.interp(fractions, places, np.broadcast_to(given, places.shape))


@dataclass(frozen=True)
class Collar:
    """A stretch of a wall of revolution that is thickened on its outer side.

    Attributes
    ----------
    start : where it begins, as a fraction of the profile's length; moved to the nearest cells.
    stop : where it ends, likewise.
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


def _wall_offsets(grid: Array, divisions: tuple[int, int, int], wall: Array, collars: Sequence[Collar]) -> Array:
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
            raise StudyError(f"the collar from {collar.start} to {collar.stop} touches another; keep them apart")
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
    along, _, around = divisions
    planes = {"start": (2, 0), "end": (2, around), "inner": (1, 0), "bottom": (0, 0), "top": (0, along)}
    sides = _plane_surfaces(grid, planes, rest="outer")
    return {name: faces for name, faces in sides.items() if not (full and name in ("start", "end"))}


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

    Raises StudyError if the profile or a collar cannot be, the wall reaches the axis, or the angles are not in order.

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
    """
    _check(divisions, "along the profile, through the wall and around", cell_type)
    turn, around = angles[1] - angles[0], divisions[2]
    full = abs(turn - 2.0 * pi) < 1e-9
    if not (full or 0.0 < turn < 2.0 * pi) or (full and around < 3):
        raise StudyError(
            f"a body of revolution cannot go from {angles[0]} to {angles[1]} rad in {around} cells; "
            "go forwards by a full turn at most, and in 3 cells or more for a full turn"
        )
    curve = Profile(profile)
    grid = _unit_grid(_kept_cells(divisions, collars), cell_type)
    surfaces = _wall_surfaces(grid, divisions, full)
    coordinates = grid.nodes
    if full:
        grid, coordinates = _closed(grid, around)
    mesh = replace(grid, nodes=_revolved(coordinates, divisions, curve, thickness, angles, collars))
    return with_surfaces(mesh, surfaces)


def block(size: tuple[float, float, float], divisions: tuple[int, int, int], cell_type: str = "hex20") -> Mesh:
    """A rectangular block with one corner at the origin.

    Raises StudyError if a size or a division is not positive, or the cell type is unknown.

    Parameters
    ----------
    size : extents along x, y and z, metres.
    divisions : cells along x, y and z; each cube is cut in 2 prisms (standing along z) or 6 tetrahedra.
    cell_type : any solid type.

    Returns
    -------
    Mesh
        Surfaces and node sets "x_min", "x_max", "y_min", "y_max", "z_min", "z_max".
    """
    _check(divisions, "along x, y and z", cell_type)
    if len(size) != 3 or min(size) <= 0.0:
        raise StudyError(f"the block's size is {tuple(size)} m; give three positive lengths")
    grid = _unit_grid(np.ones(divisions, dtype=bool), cell_type)
    mesh = replace(grid, nodes=grid.nodes * (np.array(size) / np.array(divisions)))
    return with_surfaces(mesh, end_surfaces(mesh))


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
