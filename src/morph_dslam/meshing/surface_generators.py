"""Structured meshes of surfaces for shells: plate, cylinder, part of a sphere, annulus; their edges are named.

Second-order cells have their middle nodes on the true surface. Cells turn anticlockwise as seen from the side that the
normal points to: +z of plates and annuli, outwards of cylinders and spheres.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from math import pi

import numpy as np
from numpy.typing import NDArray

from morph_dslam.errors import StudyError
from morph_dslam.meshing.meshes import CellBlock, Mesh
from morph_dslam.meshing.second_order import FIRST_ORDER, to_second_order

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
SURFACES = ("tri3", "tri6", "quad4", "quad8", "quad9")
FULL_TURN = 2.0 * pi


def _grid(divisions: tuple[int, int], cells: str) -> Mesh:
    """Unit squares at whole-number coordinates (u, v, 0), of first order; sets u_min, u_max, v_min, v_max.

    Squares turn from u to v. Raises StudyError unless divisions are whole and positive, and the cell type is known.
    """
    if len(divisions) != 2 or any(int(n) != n or n < 1 for n in divisions):
        raise StudyError(f"divisions are {tuple(divisions)}; give 2 whole numbers of at least 1")
    if cells not in SURFACES:
        raise StudyError(f"'{cells}' is not a cell type of this generator; use one of {', '.join(SURFACES)}")
    n, m = divisions
    number = np.arange((n + 1) * (m + 1)).reshape(n + 1, m + 1)
    corners = np.stack([number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]], axis=-1).reshape(-1, 4)
    if cells.startswith("tri"):
        corners = corners[:, [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3)
    u, v = np.divmod(np.arange(number.size), m + 1)
    nodes = np.column_stack([u, v, np.zeros(len(u))]).astype(np.float64)
    sets = {"u_min": number[0], "u_max": number[-1], "v_min": number[:, 0], "v_max": number[:, -1]}
    return Mesh(nodes, (CellBlock("tri3" if corners.shape[1] == 3 else "quad4", corners),), sets)


def _finished(mesh: Mesh, cells: str, names: dict[str, str]) -> Mesh:
    """With middle nodes where the cell type has them, and only the sets named, by their new names."""
    if cells in FIRST_ORDER:
        mesh = to_second_order(mesh, cells)
    return replace(mesh, node_sets={new: mesh.node_sets[old] for old, new in names.items()})


def plate(size: tuple[float, float], divisions: tuple[int, int], cells: str = "quad9") -> Mesh:
    """A rectangle from the origin along x and y, metres; sets x_min, x_max, y_min, y_max."""
    names = {"u_min": "x_min", "u_max": "x_max", "v_min": "y_min", "v_max": "y_max"}
    mesh = _finished(_grid(divisions, cells), cells, names)
    return replace(mesh, nodes=mesh.nodes * [size[0] / divisions[0], size[1] / divisions[1], 0.0])


#: Where the points of a surface of revolution are: radius and height at fractions (n,) of its profile.
Placed = Callable[[Array], tuple[Array, Array]]


def _turned(
    profile: Placed,
    divisions: tuple[int, int],
    cells: str,
    angles: tuple[float, float],
    slit: bool,
    names: dict[str, str],
    pole: bool = False,
) -> Mesh:
    """A profile turned about z.

    Parameters
    ----------
    profile : to turn.
    divisions : along the profile and around.
    cells : their type; triangles around a pole.
    angles : first and last, about z from x towards y, rad.
    slit : leave a full turn open, its two ends being edges of their own.
    names : of the profile's two ends by "u_min" and "u_max"; the ends of less than a full turn are start and end.
    pole : whether the profile begins on the axis.
    """
    first, last = angles
    if not 0.0 < last - first <= FULL_TURN * (1.0 + 1e-12):
        raise StudyError("the angles must rise, by a full turn at most: give the first and the last of them")
    closed = not slit and last - first > FULL_TURN * (1.0 - 1e-12)
    if closed and divisions[1] < 3:
        raise StudyError(f"a full turn has {divisions[1]} divisions around; give it 3 or more")
    mesh = _grid(divisions, cells)
    along, angle = mesh.nodes[:, 0], first + (last - first) * mesh.nodes[:, 1] / divisions[1]
    # On this cylinder the middle between two points is that between their directions and their places on the profile.
    unrolled = np.column_stack([np.cos(angle), np.sin(angle), along])
    mesh = replace(mesh, nodes=unrolled)
    target = np.arange(mesh.n_nodes)
    if closed:
        target[mesh.node_sets["v_max"]] = mesh.node_sets["v_min"]
    if pole:
        target[mesh.node_sets["u_min"]] = 0
        mesh = replace(mesh, nodes=np.where(along[:, None] == 0.0, 0.0, unrolled))
    mesh = mesh.renumbered(target, mesh.nodes)
    mesh = _without_collapsed(mesh).without_unused_nodes()
    kept = names if closed else names | {"v_min": "start", "v_max": "end"}
    mesh = _finished(mesh, cells, kept)
    direction = mesh.nodes[:, :2] / np.maximum(np.linalg.norm(mesh.nodes[:, :2], axis=1), 1e-300)[:, None]
    radius, height = profile(mesh.nodes[:, 2] / divisions[0])
    return replace(mesh, nodes=np.column_stack([radius[:, None] * direction, height]))


def _without_collapsed(mesh: Mesh) -> Mesh:
    """Squares with a side of no length made triangles, triangles with one left out."""
    triangles, squares = [], []
    for block in mesh.blocks:
        shared = block.connectivity == np.roll(block.connectivity, -1, axis=1)
        whole = block.connectivity[~shared.any(axis=1)]
        (squares if whole.shape[1] == 4 else triangles).append(whole)
        if block.connectivity.shape[1] == 4:
            triangles.append(block.connectivity[shared.any(axis=1)][~shared[shared.any(axis=1)]].reshape(-1, 3))
    blocks = [CellBlock("quad4", c) for c in squares if len(c)] + [CellBlock("tri3", c) for c in triangles if len(c)]
    return replace(mesh, blocks=tuple(blocks))


def cylinder(
    radius: float,
    length: float,
    divisions: tuple[int, int],
    cells: str = "quad9",
    angles: tuple[float, float] = (0.0, FULL_TURN),
    slit: bool = False,
) -> Mesh:
    """A cylinder around z from z = 0; sets bottom and top, and start and end where it is open, by angle or ``slit``.

    Parameters
    ----------
    radius : m.
    length : m.
    divisions : along z and around.
    cells : their type.
    angles : first and last, rad.
    slit : leave a full turn open.
    """

    def profile(fraction: Array) -> tuple[Array, Array]:
        # Downwards: the cells turn with the normal outwards.
        return np.full(len(fraction), radius), length * (1.0 - fraction)

    return _turned(profile, divisions, cells, angles, slit, {"u_min": "top", "u_max": "bottom"})


def sphere(
    radius: float,
    polar_angles: tuple[float, float],
    divisions: tuple[int, int],
    cells: str = "quad9",
    angles: tuple[float, float] = (0.0, FULL_TURN),
    slit: bool = False,
) -> Mesh:
    """A part of a sphere around the origin; sets top (absent where it is the pole), rim, and start and end as others.

    Parameters
    ----------
    radius : m.
    polar_angles : from the z axis, of top and rim, rad; from 0 it is a cap without a hole.
    divisions : from top to rim and around.
    cells : their type; triangles around the pole.
    angles : first and last around, rad.
    slit : leave a full turn open.
    """
    first, last = polar_angles
    if not 0.0 <= first < last < pi:
        raise StudyError("the polar angles must rise, from 0 at least to less than 180 degrees")

    def profile(fraction: Array) -> tuple[Array, Array]:
        angle = first + (last - first) * fraction
        return radius * np.sin(angle), radius * np.cos(angle)

    pole = first == 0.0
    names = {"u_max": "rim"} if pole else {"u_min": "top", "u_max": "rim"}
    return _turned(profile, divisions, cells, angles, slit, names, pole)


def annulus(
    inner_radius: float,
    outer_radius: float,
    divisions: tuple[int, int],
    cells: str = "quad9",
    angles: tuple[float, float] = (0.0, FULL_TURN),
    slit: bool = False,
) -> Mesh:
    """A flat ring around the origin in the plane z = 0; sets inner and outer, and start and end as others.

    Parameters
    ----------
    inner_radius : m; 0 for a disc.
    outer_radius : m.
    divisions : from inside to outside and around.
    cells : their type; triangles around the middle of a disc.
    angles : first and last around, rad.
    slit : leave a full turn open.
    """
    if not 0.0 <= inner_radius < outer_radius:
        raise StudyError(f"the inner radius {inner_radius:g} m must be below the outer one, {outer_radius:g} m")

    def profile(fraction: Array) -> tuple[Array, Array]:
        return inner_radius + (outer_radius - inner_radius) * fraction, np.zeros(len(fraction))

    pole = inner_radius == 0.0
    names = {"u_max": "outer"} if pole else {"u_min": "inner", "u_max": "outer"}
    return _turned(profile, divisions, cells, angles, slit, names, pole)
