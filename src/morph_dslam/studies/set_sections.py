"""The [sets.NAME] sections of a study: what lies in a region of the mesh, by a name that other sections use."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from morph_dslam.errors import StudyError
from morph_dslam.meshing.hollows import hollow_wall
from morph_dslam.meshing.mesh_summary import faces_figures, unit_normals
from morph_dslam.meshing.meshes import Mesh, faces_of_cells
from morph_dslam.studies.sections import JOINED, Angle, Length, Number, PositiveLength, Section, SetName
from morph_dslam.studies.solid_sections import mesh_fingerprint

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
Mask = NDArray[np.bool_]
#: Normals this far from a direction face it, unless a set says otherwise, rad.
FACING_ANGLE = np.pi / 4.0
#: Whole faces that are a smaller part of what a ball cuts out of a surface are worth a warning, and that of a ball with
#: this part of a disc's area at least: its middle is on the surface.
COARSE, ON_SURFACE = 0.5, 0.5
#: Pieces of a triangle's longest edge for each radius of a ball, and the most of an edge.
PIECES, MOST_PIECES = 10, 60
#: Nodes this far outside of a box, as a part of the mesh's length, still lie in it.
TOLERANCE = 1e-9


class SetSection(Section):
    """What lies in a region: its nodes, the outer faces all of whose nodes lie in it, and the cells whose middles do.

    A ``box`` is given by two opposite corners, a ball by the point ``near`` which it is and its ``radius``. ``facing``
    leaves the faces whose outward normal is at most ``angle`` (45 degrees if absent) from a direction, ``of`` those of
    a surface, or of several listed (of shells: cell sets), ``hollow`` the wall of the hollow of a solid, closed or
    with an inlet, that a point lies in; then the nodes are those of the faces. All that is given holds together.
    ``nearest`` alone is the one node nearest to a point.
    """

    box: tuple[tuple[Length, Length, Length], tuple[Length, Length, Length]] | None = None
    near: tuple[Length, Length, Length] | None = None
    radius: PositiveLength | None = None
    facing: tuple[Number, Number, Number] | None = None
    angle: Annotated[Angle, Field(gt=0.0, le=np.pi)] | None = None
    of: SetName | None = None
    hollow: tuple[Length, Length, Length] | None = None
    nearest: tuple[Length, Length, Length] | None = None

    @model_validator(mode="after")
    def _check(self) -> SetSection:
        regions = (self.box, self.near, self.facing, self.of, self.hollow)
        if (self.nearest is None) == all(region is None for region in regions):
            raise ValueError("give either nearest, or a region: any of box, near with radius, facing, of, hollow")
        if (self.near is None) != (self.radius is None):
            raise ValueError("near and radius belong together: give both, or neither")
        if self.angle is not None and self.facing is None:
            raise ValueError("angle is that between normals and facing: give facing too, a direction")
        if self.facing is not None and not np.any(self.facing):
            raise ValueError("facing has no length: give a direction, [0, 0, 1] say")
        return self

    @property
    def chooses_faces(self) -> bool:
        """Whether it is made of faces, not of all that lies in a part of space."""
        return any(given is not None for given in (self.facing, self.of, self.hollow))

    def holds(self, points: Array, length: float) -> Mask:
        """Which of some points (n, 3), metres, lie in box and ball; ``length`` is the mesh's."""
        inside = np.ones(len(points), dtype=bool)
        if self.box is not None:
            low, high = np.sort(np.array(self.box), axis=0)
            tolerance = TOLERANCE * length
            inside &= ((points >= low - tolerance) & (points <= high + tolerance)).all(axis=1)
        if self.near is not None and self.radius is not None:
            inside &= np.linalg.norm(points - np.array(self.near), axis=1) <= self.radius + TOLERANCE * length
        return inside

    def add_to(self, mesh: Mesh, name: str) -> Mesh:
        """The mesh with this set by a name. Raises StudyError if nothing of the mesh is in it."""
        length = float(np.ptp(mesh.nodes, axis=0).max())
        if self.nearest is not None:
            return _with(mesh, name, nodes=_nearest(mesh.nodes, np.array(self.nearest), length))
        inside = self.holds(mesh.nodes, length)
        if not inside.any():
            raise StudyError(f"no node of the mesh lies in it; move or widen it: {self._missed(mesh.nodes)}")
        faces = self._faces(mesh, inside)
        if self.chooses_faces:
            if not len(faces):
                face = "cell" if mesh.is_sheet else "outer face"
                raise StudyError(f"no {face} of the mesh has all its nodes in there and faces so; widen it")
            nodes = mesh.face_nodes(faces)
            return _with(mesh, name, faces, np.unique(nodes[nodes >= 0]))
        middles = np.concatenate([mesh.nodes[block.connectivity].mean(axis=1) for block in mesh.blocks])
        cells = np.flatnonzero(self.holds(middles, length))
        return _with(mesh, name, faces, np.flatnonzero(inside), cells)

    def _faces(self, mesh: Mesh, inside: Mask) -> Indices:
        """Outer faces (f, 2) all of whose nodes are ``inside`` (n,), and that face as they should."""
        if self.of is None:
            faces = mesh.boundary_faces()
        else:
            faces = np.unique(np.concatenate([_faces_named(mesh, part) for part in self.of.split(JOINED)]), axis=0)
        faces = mesh.faces_within(faces, inside)
        if self.hollow is not None:
            wall = {tuple(face) for face in _wall_around(mesh, self.hollow).tolist()}
            faces = faces[[tuple(face) in wall for face in faces.tolist()]]
        if self.facing is None or not len(faces):
            return faces
        direction = np.array(self.facing) / np.linalg.norm(self.facing)
        angle = FACING_ANGLE if self.angle is None else self.angle
        return faces[unit_normals(mesh, faces) @ direction >= np.cos(angle) - TOLERANCE]

    def _missed(self, nodes: Array) -> str:
        """Where the mesh lies, and how far from a ball, in words."""
        low, high = 1e3 * nodes.min(axis=0), 1e3 * nodes.max(axis=0)
        spans = ", ".join(f"{axis} {a:.4g} to {b:.4g}" for axis, a, b in zip("xyz", low, high, strict=True))
        away = ""
        if self.near is not None:
            away = f", and is {1e3 * np.linalg.norm(nodes - np.array(self.near), axis=1).min():.4g} mm away from near"
        return f"the mesh has {spans} mm{away}"


def with_sets(mesh: Mesh, sets: Mapping[str, SetSection]) -> Mesh:
    """The mesh with the sets of a study, which may replace surfaces that its file does not name.

    Raises StudyError if one of them is empty, or the mesh has one of its name.
    """
    own = mesh.found & sets.keys()
    if own:  # what the study says of a name counts
        kept = {name: faces for name, faces in mesh.surfaces.items() if name not in own}
        mesh = replace(mesh, surfaces=kept, found=mesh.found - own)
    for name in sets:
        if name == "all" or any(name in known for known in (mesh.node_sets, mesh.cell_sets, mesh.surfaces)):
            raise StudyError(f"sets.{name}: the mesh has a set of this name; choose another")
    for name, section in sets.items():
        try:
            mesh = section.add_to(mesh, name)
        except StudyError as error:
            raise StudyError(f"sets.{name}: {error}") from error
    return mesh


def coarse_set_warnings(mesh: Mesh, sets: Mapping[str, SetSection]) -> list[str]:
    """A sentence for each ball whose whole faces are far less than what it cuts out of the outer surface of a solid.

    Looked at are balls alone, about points on the surface: a deeper one is for what lies inside.
    """
    found = []
    for name, section in sets.items():
        if section.radius is None or section.box is not None or section.chooses_faces:
            continue
        disc = np.pi * section.radius**2
        cut = min(_area_within(mesh.nodes[mesh.surface_triangles()], section), disc)  # no back of a thin wall
        covered = faces_figures(mesh, mesh.surfaces[name])[0] if name in mesh.surfaces else 0.0
        if cut > ON_SURFACE * disc and covered < COARSE * cut:
            found.append(
                f"sets.{name}: its whole faces cover {1e6 * covered:.3g} of the {1e6 * cut:.3g} mm2 of the surface "
                "that lie in the ball, for the cells are coarse: take smaller cells, or a larger radius"
            )
    return found


def _area_within(triangles: Array, section: SetSection) -> float:
    """Area, m2, of that part of triangles (t, 3, 3) which lies in the ball of a set; each is cut into equal pieces."""
    assert section.radius is not None
    edges = np.linalg.norm(triangles - np.roll(triangles, 1, axis=1), axis=2).max(axis=1)
    reached = np.linalg.norm(triangles[:, 0] - np.array(section.near), axis=1) <= section.radius + edges
    if not reached.any():
        return 0.0
    corner, sides = triangles[reached, :1], triangles[reached, 1:] - triangles[reached, :1]
    n = int(np.clip(np.ceil(PIECES * edges[reached].max() / section.radius), 1, MOST_PIECES))
    corners = np.stack(np.meshgrid(np.arange(n), np.arange(n)), axis=-1).reshape(-1, 2)
    sums = corners.sum(axis=1)
    middles = np.concatenate([corners[sums < n] + 1.0 / 3.0, corners[sums < n - 1] + 2.0 / 3.0]) / n
    points = corner + np.einsum("pk,tkx->tpx", middles, sides)
    inside = section.holds(points.reshape(-1, 3), section.radius).reshape(len(points), -1).mean(axis=1)
    return float(np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1) @ inside) / 2.0


def _faces_named(mesh: Mesh, name: str) -> Indices:
    """Faces (f, 2) of a surface, of sheets those of a cell set. Raises StudyError if there is none of this name."""
    return faces_of_cells(mesh.cells(name)) if mesh.is_sheet else mesh.faces_in(name)


@dataclass(frozen=True)
class _Body:
    """A mesh that is compared by its nodes and cells alone."""

    fingerprint: str
    mesh: Mesh = field(compare=False)


def _wall_around(mesh: Mesh, point: tuple[float, float, float]) -> Indices:
    """`hollow_wall`, found once for each body; StudyError for sheets, too."""
    if mesh.is_sheet:
        raise StudyError("hollow is for solids: choose the cells of a shell by box, near, facing or of")
    return _found_wall(_Body(mesh_fingerprint(Mesh(mesh.nodes, mesh.blocks)), mesh), point)


@lru_cache(maxsize=16)
def _found_wall(body: _Body, point: tuple[float, float, float]) -> Indices:
    return hollow_wall(body.mesh, np.array(point))


def _nearest(nodes: Array, point: Array, length: float) -> Indices:
    """The node nearest to a point (3,), which StudyError refuses farther away than the mesh is long: a wrong unit."""
    distances = np.linalg.norm(nodes - point, axis=1)
    if distances.min() > length:
        raise StudyError(
            f"nearest is {1e3 * distances.min():.4g} mm away from the mesh, which is {1e3 * length:.4g} mm "
            "long: give a point near it"
        )
    return np.array([np.argmin(distances)])


def _with(
    mesh: Mesh, name: str, faces: Indices | None = None, nodes: Indices | None = None, cells: Indices | None = None
) -> Mesh:
    """The mesh with what a set holds; a sheet's faces are its cells. What is empty is no set."""
    if mesh.is_sheet and cells is None and faces is not None:
        cells = faces[:, 0]
    surfaces = {name: faces} if faces is not None and len(faces) and not mesh.is_sheet else {}
    return replace(
        mesh,
        surfaces={**mesh.surfaces, **surfaces},
        node_sets={**mesh.node_sets, **({name: nodes} if nodes is not None and len(nodes) else {})},
        cell_sets={**mesh.cell_sets, **({name: cells} if cells is not None and len(cells) else {})},
    )
