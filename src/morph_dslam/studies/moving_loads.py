"""What is checked of the moving loads of a study: their widths, and whether their force lands on the surface."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from morph_dslam.errors import StudyError
from morph_dslam.mechanics.landed_force import (
    distance_from_rim,
    nearest_point,
    share_of_line,
    share_of_patch,
    smallest_cell,
)
from morph_dslam.meshing.meshes import Mesh, faces_of_cells
from morph_dslam.studies.affine import Variables
from morph_dslam.studies.body_study import numbered
from morph_dslam.studies.shape_sections import Shape, moved_nodes
from morph_dslam.studies.solid_sections import MovingLineLoad, MovingPatchLoad

Array = NDArray[np.float64]
Moving = MovingPatchLoad | MovingLineLoad
#: A width in cells below which quadrature misses a density between its points.
NARROWEST = 0.5
#: A part of the force that is worth a warning if it does not land.
LANDED = 0.95
#: A part that rounds to none of it.
NONE = 0.005
#: Widths from a rim within which it is to blame, and from the surface beyond which the centre's place is.
AT_RIM, OFF_SURFACE = 2.0, 0.1
#: States beside the default and the ends of ranges in which a load may come near the object.
TRIED = 64


def check_widths(loads: Sequence[Any], mesh: Mesh) -> None:
    """Refuse moving loads, among the ``loads`` of a study, that are too narrow for the cells (StudyError)."""
    for where, load in _moving(loads):
        size = smallest_cell(mesh, _faces(mesh, load.on))
        if load.width < NARROWEST * size * (1.0 - 1e-6):
            raise StudyError(
                f"{where}: width = {1e3 * load.width:.4g} mm is less than half a cell of '{load.on}', the smallest of "
                f"which measures {1e3 * size:.4g} mm, and the force would be lost between points of integration: make "
                f"it {1e3 * NARROWEST * size:.4g} mm at least, or the cells smaller"
            )


def check_reach(loads: Sequence[Any], mesh: Mesh, variables: Variables) -> None:
    """Refuse moving loads that stay farther from their surface than the mesh is long (StudyError): a wrong unit.

    Looked at are the defaults, the ends of the parameters' ranges and states spread within.
    """
    length = float(np.linalg.norm(np.ptp(mesh.nodes, axis=0)))
    states = [*_spread_states(variables), *(mu for _, mu in variables.range_ends(combined=True))]
    for where, load in _moving(loads):
        nodes = mesh.nodes[np.unique(mesh.face_triangles(_faces(mesh, load.on)))]
        centre = [variables.read(value, "length") for value in load.centre]
        places = np.unique([[c(mu) for c in centre] for mu in states], axis=0)
        distance = min(float(_distances(load, nodes, place).min()) for place in places)
        if distance > length:
            raise StudyError(
                f"{where}: its centre stays {1e3 * distance:.4g} mm or more away from '{load.on}', and the mesh is "
                f"{1e3 * length:.4g} mm long: check the units of the centre and of the mesh"
            )


def _spread_states(variables: Variables) -> list[Array]:
    """The defaults (d,) of the parameters, and states spread within their ranges."""
    within = np.random.default_rng(0).uniform(size=(TRIED, len(variables.parameters)))
    lower, upper = (np.array([getattr(p, end) for p in variables.parameters]) for end in ("lower", "upper"))
    return [variables.defaults, *(lower + within * (upper - lower))]


def _distances(load: Moving, nodes: Array, centre: Array) -> Array:
    """Of nodes (n, 3) from the centre of a patch, or from the line through that of a line."""
    arms = nodes - centre
    if isinstance(load, MovingLineLoad):
        unit = np.array(load.direction) / np.linalg.norm(load.direction)
        arms = arms - np.outer(arms @ unit, unit)
    return np.linalg.norm(arms, axis=1)


def landing_warnings(loads: Sequence[Any], mesh: Mesh, variables: Variables, shape: Shape = ()) -> list[str]:
    """A sentence for each moving load a part of whose force falls beside its surface.

    Looked at are the defaults of the parameters, and the ends of the ranges of those that move the load or the shape.
    Raises StudyError where nothing lands there nor at states spread within the ranges.
    """
    found = []
    for where, load in _moving(loads):
        centre = [variables.read(value, "length") for value in load.centre]
        used = sorted(set[int]().union(*(value.used for value in (*centre, *(moved for moved, _ in shape)))))
        states = [variables.defaults, *(mu for _, mu in variables.range_ends(used, combined=True))]
        faces = mesh.face_triangles(_faces(mesh, load.on))

        def share(mu: Array, load: Moving = load, faces: Any = faces, centre: Any = centre) -> float:
            return _share(load, moved_nodes(mesh, shape, mu)[faces], np.array([c(mu) for c in centre]))

        shares = [share(mu) for mu in states]
        worst = int(np.argmin(shares))
        if shares[worst] >= LANDED:
            continue
        place = np.array([c(states[worst]) for c in centre])
        why = _why_beside(load, moved_nodes(mesh, shape, states[worst]), faces, place)
        if max(shares) <= NONE and not (used and any(share(mu) > NONE for mu in _spread_states(variables))):
            anywhere = " anywhere in the ranges of the parameters" if used else ""
            raise StudyError(f"{where}: nothing of the force lands on '{load.on}'{anywhere}{why}")
        at = f" where {variables.text(states[worst], used)}" if used else ""
        landed = f"only {100.0 * shares[worst]:.0f} %" if shares[worst] > NONE else "nothing"
        found.append(f"{where}: {landed} of the force lands on '{load.on}'{at}{why}")
    return found


def _why_beside(load: Moving, nodes: Array, faces: NDArray[np.int64], centre: Array) -> str:
    """What takes force from a load at ``centre`` (3,), and what to do, to end a sentence.

    A rim does within two widths; farther away a patch is off the surface, or the surface bends away from it.
    """
    rim = ", and the rest falls beside it: keep the centre about two widths away from the rim"
    if isinstance(load, MovingLineLoad):
        return rim
    foot = nearest_point(nodes[faces], centre)
    off = float(np.linalg.norm(foot - centre))
    if distance_from_rim(nodes, faces, foot) < AT_RIM * load.width:
        return rim
    if off < OFF_SURFACE * load.width:
        return ", which bends away from the patch, as at a corner: move its centre, or take a smaller width"
    place = ", ".join(f"{x + 0.0:.4g}" for x in np.round(1e3 * foot, 3))
    return f", for its centre lies {1e3 * off:.2g} mm off the surface: put it on it, at ({place}) mm say"


def _moving(loads: Sequence[Any]) -> Iterator[tuple[str, Moving]]:
    """The moving loads with what messages call them."""
    for where, load in numbered("load", loads):
        if isinstance(load, Moving):
            yield where, load


def _faces(mesh: Mesh, name: str) -> NDArray[np.int64]:
    """Faces (f, 2) of a surface of a solid or of a cell set of a shell."""
    if name in mesh.surfaces:
        return mesh.surface(name)
    return faces_of_cells(mesh.cells(name))


def _share(load: Moving, triangles: Array, centre: Array) -> float:
    if isinstance(load, MovingLineLoad):
        return share_of_line(triangles, centre, np.array(load.direction), load.width)
    return share_of_patch(triangles, centre, load.width)
