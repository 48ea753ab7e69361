"""Flat parts: an outline with notches and round holes, meshed by Netgen in its plane and extruded to a thickness."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from morph_dslam.errors import StudyError
from morph_dslam.meshing.generators import with_surfaces
from morph_dslam.meshing.mesh_checks import MOST_CELLS, described_extent
from morph_dslam.meshing.meshes import CellBlock, Mesh, end_surfaces
from morph_dslam.meshing.second_order import to_second_order

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
#: Cell types that it makes.
PRISMS = ("prism6", "prism15", "prism18")
#: Corners are on a side if they are this part of the outline's extent away from it at most.
ON_SIDE = 1e-9
#: How fast cells grow from fine places, as Netgen counts.
GRADING = 0.25
#: Longest edge of a cell on a hole, in its radii.
HOLE_SIZE = 0.4


@dataclass(frozen=True)
class Hole:
    """A round hole through a flat part.

    Attributes
    ----------
    centre : (2,) metres.
    diameter : metres.
    """

    centre: tuple[float, float]
    diameter: float


def extrusion(
    outline: Sequence[Sequence[float]] | Array,
    thickness: float,
    size: float,
    cell_type: str = "prism15",
    layers: int = 1,
    holes: Sequence[Hole] = (),
    sizes: Sequence[float] | Array | None = None,
) -> Mesh:
    """A flat part, its outline in the plane z = 0 and its other side at z = ``thickness``.

    Parameters
    ----------
    outline : (p, 2) corners in order, either way round, metres; each only once.
    thickness : metres.
    size : longest edge of a cell in the plane, metres.
    cell_type : "prism6", "prism15" or "prism18".
    layers : of cells through the thickness.
    holes : round, inside the outline and apart from each other.
    sizes : (p,) longest edge of a cell at each corner, metres, where it is less than ``size``: at the tip of a notch.

    Returns
    -------
    Mesh
        Surfaces and node sets "z_min", "z_max", "side_1" (from the first corner to the second), "side_2", ...,
        "hole_1", ...; and "x_min", "x_max", "y_min", "y_max" where the outline has sides there.

    Raises
    ------
    StudyError
        If the outline crosses itself, a hole is not inside, or a length is not positive.
    """
    corners, holes = np.array(outline, dtype=np.float64), list(holes)
    _check(corners, thickness, size, cell_type, layers)
    _check_holes(corners, holes)
    at_corners = np.full(len(corners), size) if sizes is None else np.minimum(np.asarray(sizes, dtype=float), size)
    points, triangles = _triangles(corners, holes, size, at_corners)
    mesh = _raised(points, triangles, thickness, layers)
    surfaces = _surfaces(mesh, corners, holes)
    mesh = with_surfaces(mesh if cell_type == "prism6" else to_second_order(mesh, cell_type), surfaces)
    for number, hole in enumerate(holes, 1):
        _round(mesh, mesh.node_sets[f"hole_{number}"], hole)
    return mesh


def _check(corners: Array, thickness: float, size: float, cell_type: str, layers: int) -> None:
    """Raise StudyError unless the outline is a polygon that does not cross itself, and the rest fits."""
    if corners.ndim != 2 or corners.shape[1] != 2 or len(corners) < 3 or not np.isfinite(corners).all():
        raise StudyError("the outline needs three corners [x, y] or more, all of them finite numbers")
    if not (thickness > 0.0 and size > 0.0 and layers >= 1):
        raise StudyError(f"thickness {thickness} m, size {size} m, {layers} layers: give positive ones")
    if cell_type not in PRISMS:
        raise StudyError(f"'{cell_type}' is not a cell type of this generator; use one of {', '.join(PRISMS)}")
    ends, pairs = np.roll(corners, -1, axis=0), list(combinations(range(len(corners)), 2))
    for i, j in pairs:
        if np.array_equal(corners[i], corners[j]):
            raise StudyError(f"corners {i + 1} and {j + 1} of the outline coincide at {_shown(corners[i])}; drop one")
    for i, j in pairs:
        beside = j == i + 1 or (i == 0 and j == len(corners) - 1)
        if not beside and _cross(corners[i], ends[i], corners[j], ends[j]):
            raise StudyError(
                f"sides {i + 1} and {j + 1} of the outline cross or touch, near {_shown(corners[i])}: list the corners "
                "in their order around the part"
            )
    area = 0.5 * abs(float(np.sum(corners[:, 0] * ends[:, 1] - ends[:, 0] * corners[:, 1])))
    count = 2.3 * area / size**2 * layers  # of triangles with equal sides
    if count > MOST_CELLS:
        extent = described_extent(1e3 * np.ptp(corners, axis=0))
        raise StudyError(
            f"the outline measures {extent} mm, and cells of size = {1e3 * size:.3g} mm would be some {count:.1g} "
            f"cells, of {MOST_CELLS} at most: its unit is probably wrong, or the size is too small"
        )


def _shown(point: Array) -> str:
    """A point for a message, in mm."""
    return "({:.4g}, {:.4g}) mm".format(*(1e3 * point))


def _cross(a: Array, b: Array, c: Array, d: Array) -> bool:
    """Whether two segments have a point in common."""

    def side(p: Array, q: Array, r: Array) -> float:
        return float(np.sign((q[0] - p[0]) * (r[1] - p[1]) - (q[1] - p[1]) * (r[0] - p[0])))

    def within(p: Array, q: Array, r: Array) -> bool:
        return bool((np.minimum(p, q) <= r).all() and (r <= np.maximum(p, q)).all())

    turns = side(a, b, c), side(a, b, d), side(c, d, a), side(c, d, b)
    if turns[0] * turns[1] < 0.0 and turns[2] * turns[3] < 0.0:
        return True
    on = zip(turns, ((a, b, c), (a, b, d), (c, d, a), (c, d, b)), strict=True)
    return any(turn == 0.0 and within(*points) for turn, points in on)


def _check_holes(corners: Array, holes: Sequence[Hole]) -> None:
    """Raise StudyError unless all holes are inside the outline and apart."""
    ends = np.roll(corners, -1, axis=0)
    for number, hole in enumerate(holes, 1):
        centre, radius = np.array(hole.centre), 0.5 * hole.diameter
        if not radius > 0.0:
            raise StudyError(f"hole {number} has the diameter {hole.diameter} m; give a positive one")
        above = (corners[:, 1] > centre[1]) != (ends[:, 1] > centre[1])
        with np.errstate(divide="ignore", invalid="ignore"):
            share = (centre[1] - corners[:, 1]) / (ends[:, 1] - corners[:, 1])
            right = corners[:, 0] + share * (ends[:, 0] - corners[:, 0]) > centre[0]
        if int((above & right).sum()) % 2 == 0 or _distances(centre, corners, ends).min() <= radius:
            raise StudyError(f"hole {number} at {_shown(centre)} is not inside the outline")
        for other_number, other in enumerate(holes[: number - 1], 1):
            if np.linalg.norm(centre - other.centre) <= radius + 0.5 * other.diameter:
                raise StudyError(f"holes {other_number} and {number} touch or overlap, at {_shown(centre)}")


def _distances(point: Array, starts: Array, ends: Array) -> Array:
    """From a point (2,), or points (n, 1, 2), to segments (p, 2)."""
    ways = ends - starts
    shares = np.clip(np.sum((point - starts) * ways, axis=-1) / np.sum(ways**2, axis=-1), 0.0, 1.0)
    return np.asarray(np.linalg.norm(starts + shares[..., None] * ways - point, axis=-1))


def _triangles(corners: Array, holes: Sequence[Hole], size: float, sizes: Array) -> tuple[Array, Indices]:
    """Points (n, 2), metres, and triangles (m, 3), anticlockwise."""
    from netgen.geom2d import SplineGeometry

    ends = np.roll(corners, -1, axis=0)
    if np.sum(corners[:, 0] * ends[:, 1] - ends[:, 0] * corners[:, 1]) < 0.0:
        corners, sizes = corners[::-1], sizes[::-1]
    geometry = SplineGeometry()
    # In sizes, because Netgen takes lengths for equal that differ by little.
    numbers = [geometry.AppendPoint(*point / size, maxh=at / size) for point, at in zip(corners, sizes, strict=True)]
    for first, last in zip(numbers, [*numbers[1:], numbers[0]], strict=True):
        geometry.Append(["line", first, last], leftdomain=1, rightdomain=0)
    for hole in holes:
        centre, radius = np.array(hole.centre) / size, 0.5 * hole.diameter / size
        geometry.AddCircle(tuple(centre), radius, leftdomain=0, rightdomain=1, maxh=HOLE_SIZE * radius)
    mesh = geometry.GenerateMesh(maxh=1.0, grading=GRADING)
    points = size * np.array([point.p[:2] for point in mesh.Points()])
    triangles = np.array([[vertex.nr - 1 for vertex in element.vertices] for element in mesh.Elements2D()])
    turned = np.linalg.det(points[triangles[:, 1:]] - points[triangles[:, :1]]) < 0.0
    triangles[turned] = triangles[turned][:, [0, 2, 1]]
    return points, triangles


def _raised(points: Array, triangles: Indices, thickness: float, layers: int) -> Mesh:
    """Layers of prisms of 6 nodes over triangles."""
    heights, n = np.linspace(0.0, thickness, layers + 1), len(points)
    nodes = np.vstack([np.column_stack([points, np.full(n, z)]) for z in heights])
    cells = [np.hstack([triangles + k * n, triangles + (k + 1) * n]) for k in range(layers)]
    return Mesh(nodes, (CellBlock("prism6", np.vstack(cells)),)).without_unused_nodes()


def _surfaces(mesh: Mesh, corners: Array, holes: Sequence[Hole]) -> dict[str, Indices]:
    """Boundary faces by name; see `extrusion`."""
    faces = mesh.boundary_faces()
    nodes = mesh.face_nodes(faces, corners_only=True)
    points = np.where((nodes >= 0)[:, :, None], mesh.nodes[nodes], np.nan)[:, :4]
    ends, tolerance = np.roll(corners, -1, axis=0), ON_SIDE * float(np.ptp(corners, axis=0).max())

    def among(is_on: NDArray[np.bool_]) -> Indices:
        return faces[(is_on | np.isnan(points[:, :, 0])).all(axis=1)]

    found = end_surfaces(mesh)
    away = _distances(points[:, :, None, :2], corners, ends)
    upright = np.nanmax(points[:, :, 2], axis=1) > np.nanmin(points[:, :, 2], axis=1)
    for k in range(len(corners)):
        found[f"side_{k + 1}"] = among((away[:, :, k] <= tolerance) & upright[:, None])
    for number, hole in enumerate(holes, 1):
        radii = np.linalg.norm(points[:, :, :2] - hole.centre, axis=2)
        found[f"hole_{number}"] = among(np.abs(radii - 0.5 * hole.diameter) < 1e-3 * hole.diameter)
    return found


def _round(mesh: Mesh, nodes: Indices, hole: Hole) -> None:
    """Put nodes of a hole's wall on its circle: middle nodes are on chords at first."""
    away = mesh.nodes[nodes, :2] - hole.centre
    mesh.nodes[nodes, :2] = hole.centre + 0.5 * hole.diameter * away / np.linalg.norm(away, axis=1, keepdims=True)
