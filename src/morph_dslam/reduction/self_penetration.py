"""Where the surface of a deformed solid passes through itself, or lies in an obstacle.

Without contact in the equations of a solid, parts of a surface that meet go through one another. A node of the surface
lies inside another part of the solid where the surface winds around it more often than around a point of itself: its
winding number, the solid angle over 4 pi (van Oosterom & Strackee, The solid angle of a plane triangle, 1983), is that
of its own corner, between 0 and 1, and 1 more for each part that holds it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.spatial import KDTree

from morph_dslam.evaluation.model_summary import describe_point
from morph_dslam.mechanics.contact import RigidObstacle
from morph_dslam.mechanics.contact_passage import core_inside
from morph_dslam.mechanics.parameters import ParameterSymbols
from morph_dslam.model import Parameter
from morph_dslam.small_arrays import cross, dot
from morph_dslam.studies.problem import ModelMesh, Snapshot

Array = NDArray[np.float64]
#: Parts of a surface may touch if they face each other and are nearer than such a part of what they were.
NEARER = 0.5
#: Nodes that are less deep than such a part of the solid's extent only touch.
TOUCHING = 1e-4
#: Contact lets nodes in by such a part of their faces' width where its pressure is Young's modulus, as it must.
GIVING = 0.01
#: A support holds a node in an obstacle where it prescribes more than such a part of the obstacle's normal there.
HOLDING = 0.5
#: What to do about an obstacle inside the solid.
FELT = "contact is felt at points of the surface alone, so make cells finer than the obstacle"


def penetration_report(
    mesh: ModelMesh, parameters: Sequence[Parameter], solutions: Sequence[Snapshot]
) -> dict[str, Any] | None:
    """What a certificate says of solutions whose surface passes through itself, in plain JSON types.

    Returns
    -------
    dict
        "statement", "checked" and "states", the worst first: coordinates (SI), number of nodes inside another part,
        and "depth_mm" of the deepest one. None where the surface is not closed, as that of a sheet.
    """
    sides, uses = np.unique(np.sort(mesh.triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)), axis=0, return_counts=True)
    if not len(sides) or (uses % 2).any():
        return None
    surface, states = SurfaceContact(mesh.nodes, mesh.triangles), []
    for solution in solutions:
        _, depths = surface.find(mesh.nodes + solution.fields["displacement"])
        states += _deep(mesh, solution, depths)
    return _report(
        parameters,
        len(solutions),
        states,
        "the surface passes through itself",
        "only contact that the study names keeps surfaces apart",
    )


def obstacle_report(
    mesh: ModelMesh,
    solutions: Sequence[Snapshot],
    symbols: ParameterSymbols,
    obstacles: Sequence[tuple[RigidObstacle, NDArray[np.int64]]],
    held: Mapping[str, NDArray[np.bool_]] | None = None,
) -> dict[str, Any]:
    """What a certificate says of solutions whose surface is in an obstacle, as `penetration_report`.

    Nodes that were in an obstacle at rest, and that no contact keeps out of it, are not meant to be outside. Nodes that
    a contact names count where they are deeper than contact gives way by itself. A state has "named", whether a contact
    names the deepest node, and "held_by", the set whose support holds this node there, if any does. One in which the
    core of an obstacle lies in the solid, where no contact may see it, has besides "inside", what messages call these
    obstacles; such states come first.

    Parameters
    ----------
    symbols : of the parameters that move the obstacles.
    obstacles : each with the nodes that its contact names.
    held : by set, (n, 3) whether its supports prescribe a node's component; None for no supports.
    """
    named, states = np.unique(np.concatenate([nodes for _, nodes in obstacles])), []
    kept, bodies = _kept_outside(mesh, symbols, obstacles), [obstacle for obstacle, _ in obstacles]
    for solution in solutions:
        symbols.set(solution.coordinates)
        places = mesh.nodes + solution.fields["displacement"]
        entered, inside = _entered(kept, symbols, places), _enclosed(bodies, symbols, places, mesh.triangles)
        states += _in_obstacles(mesh, solution, entered, (named, held or {}), inside)
    # Those that hold an obstacle come first, and stay so where all are sorted by depth.
    holding = [state for state in states if "inside" in state]
    others = [state for state in states if "inside" not in state]
    report = _report(symbols.parameters, len(solutions), others, "the surface enters an obstacle", _remedy(others))
    if not holding:
        return report
    what = f"{holding[0]['inside'][0]} lies inside the solid"
    return _report(symbols.parameters, len(solutions), holding, what, FELT) | {"states": holding + others}


@dataclass(frozen=True)
class _Entered:
    """How deep nodes are in obstacles.

    Attributes
    ----------
    depths : (k,), m; 0 or less outside.
    nodes : (k,) their indices.
    normals : (k, 3) of the obstacle at each.
    """

    depths: Array
    nodes: NDArray[np.int64]
    normals: Array

    def deepest(self, named: NDArray[np.int64], held: Mapping[str, NDArray[np.bool_]]) -> dict[str, Any]:
        """Whether a contact names the deepest node, and the set whose support holds it along the obstacle's normal."""
        at = int(self.depths.argmax())
        node, normal = self.nodes[at], self.normals[at]
        sets = [name for name, components in held.items() if np.linalg.norm(normal[components[node]]) > HOLDING]
        return {"named": bool(node in named)} | ({"held_by": sets[0]} if sets else {})


def _kept_outside(
    mesh: ModelMesh, symbols: ParameterSymbols, obstacles: Sequence[tuple[RigidObstacle, NDArray[np.int64]]]
) -> list[tuple[RigidObstacle, NDArray[np.int64], Array]]:
    """Each obstacle with the nodes (k,) that are meant to be outside, and the depth (k,) that contact lets them in."""
    on_surface, widths, result = np.unique(mesh.triangles), _face_widths(mesh), []
    symbols.set(symbols.default)
    for obstacle, own in obstacles:
        outside = obstacle.touch(symbols, mesh.nodes[on_surface]).gap >= 0.0
        nodes = on_surface[outside | np.isin(on_surface, own)]
        result.append((obstacle, nodes, np.where(np.isin(nodes, own), GIVING * widths[nodes], 0.0)))
    return result


def _entered(
    kept: Sequence[tuple[RigidObstacle, NDArray[np.int64], Array]], symbols: ParameterSymbols, places: Array
) -> _Entered:
    """How deep nodes are in obstacles with nodes at ``places`` (n, 3); as far as contact lets them in is not deep."""
    depths, normals = [], []
    for obstacle, nodes, least in kept:
        touch = obstacle.touch(symbols, places[nodes])
        depth = -touch.gap - obstacle.tolerance
        depths.append(np.where(depth > least, depth, 0.0))
        normals.append(touch.normal)
    return _Entered(np.concatenate(depths), np.concatenate([nodes for _, nodes, _ in kept]), np.concatenate(normals))


def _face_widths(mesh: ModelMesh) -> Array:
    """(n,) mean side of the triangles around each node of the surface, m; 0 inside."""
    sides = np.linalg.norm(mesh.nodes[mesh.triangles] - mesh.nodes[np.roll(mesh.triangles, -1, axis=1)], axis=2)
    total, count = np.zeros(len(mesh.nodes)), np.zeros(len(mesh.nodes))
    np.add.at(total, mesh.triangles, sides.mean(axis=1)[:, None])
    np.add.at(count, mesh.triangles, 1.0)
    return total / np.maximum(count, 1.0)


def _enclosed(
    bodies: Sequence[RigidObstacle], symbols: ParameterSymbols, places: Array, triangles: NDArray[np.int64]
) -> dict[str, float]:
    """Obstacles whose core lies in the solid with nodes at ``places`` (n, 3), and how deep in it, m."""
    found = {}
    for body in bodies:
        inside = core_inside(body, symbols, places, triangles)
        if len(inside):
            away = KDTree(places[np.unique(triangles)]).query(inside)[0]
            found[f"the {body.name} of the contact on '{body.on}'"] = float(np.max(away))
    return found


def _in_obstacles(
    mesh: ModelMesh,
    solution: Snapshot,
    entered: _Entered,
    known: tuple[NDArray[np.int64], Mapping[str, NDArray[np.bool_]]],
    enclosed: dict[str, float],
) -> list[dict[str, Any]]:
    """One state, if nodes are more than touching, or obstacles are ``enclosed``; ``known`` as `_Entered.deepest`."""
    states = [state | entered.deepest(*known) for state in _deep(mesh, solution, entered.depths)]
    if enclosed:
        found = states[0] if states else {"coordinates": solution.coordinates.tolist(), "nodes": 0, "depth_mm": 0.0}
        deepest = max(found["depth_mm"], 1e3 * max(enclosed.values()))
        states = [found | {"depth_mm": deepest, "inside": list(enclosed)}]
    return states


def _remedy(states: Sequence[dict[str, Any]]) -> str:
    """What to do about nodes in an obstacle.

    Those that a support holds stay there whatever the mesh, those that no contact names come in freely, and others as
    cells give way.
    """
    worst = max(states, key=lambda state: state["depth_mm"], default={"named": True})
    if "held_by" in worst:
        return (
            f"the support of '{worst['held_by']}' holds nodes there, and its force is that of the penalty alone: "
            "change the range of what moves the support or the obstacle, so that they do not meet"
        )
    return "make cells finer there" if worst["named"] else "name all surfaces that meet it in [[contacts]]"


def _deep(mesh: ModelMesh, solution: Snapshot, depths: Array) -> list[dict[str, Any]]:
    """One state, if any depth (k,) is more than touching."""
    deep = depths[depths > TOUCHING * np.linalg.norm(np.ptp(mesh.nodes, axis=0))]
    if not len(deep):
        return []
    return [{"coordinates": solution.coordinates.tolist(), "nodes": len(deep), "depth_mm": 1e3 * float(deep.max())}]


def _report(
    parameters: Sequence[Parameter], checked: int, states: list[dict[str, Any]], what: str, remedy: str
) -> dict[str, Any]:
    states.sort(key=lambda state: -state["depth_mm"])
    statement = f"in none of {checked} solutions {what}"
    if states:
        worst = describe_point(parameters, states[0]["coordinates"])
        statement = (
            f"in {len(states)} of {checked} solutions {what}, by {states[0]['depth_mm']:.2g} mm at {worst}; {remedy}"
        )
    return {"statement": statement, "checked": checked, "states": states}


class SurfaceContact:
    """Finds where a closed surface passes through itself.

    Parameters
    ----------
    nodes : (n, 3) undeformed, m.
    triangles : (t, 3) of the surface, outwards.
    """

    def __init__(self, nodes: Array, triangles: NDArray[np.int64]) -> None:
        self._undeformed, self._triangles = np.asarray(nodes, dtype=np.float64), np.asarray(triangles, dtype=np.int64)
        self._on_surface = np.unique(triangles)

    def find(self, deformed: Array) -> tuple[NDArray[np.int64], Array]:
        """The nodes (k,) that lie inside another part of the solid, of nodes (n, 3) where they are now, m.

        With each how far it is from the nearest part of the surface that faces it, (k,), m.
        """
        deformed = np.ascontiguousarray(deformed, dtype=np.float64)
        normals, longest = _normals(deformed, self._triangles), _longest_side(deformed, self._triangles)
        asked = self._touching(deformed, normals, longest)
        known = np.zeros(len(deformed), dtype=bool)
        inside, depths = np.zeros(0, dtype=np.int64), np.zeros(0)
        while len(asked):
            known[asked] = True
            windings, away = winding_numbers(asked, deformed, normals, self._triangles, longest)
            found = windings > 1.0
            inside, depths = np.append(inside, asked[found]), np.append(depths, away[found])
            # Deeper ones are beside those found.
            asked = np.unique(self._triangles[np.isin(self._triangles, asked[found]).any(axis=1)])
            asked = asked[~known[asked]]
        return inside, depths

    def _touching(self, deformed: Array, normals: Array, longest: float) -> NDArray[np.int64]:
        """Nodes that have come near to others that face them, and may have passed them."""
        pairs = KDTree(deformed[self._on_surface]).query_pairs(longest, output_type="ndarray")
        one, other = self._on_surface[pairs].T
        facing = np.einsum("px,px->p", normals[one], normals[other]) < 0.0
        one, other = one[facing], other[facing]
        was = np.linalg.norm(self._undeformed[one] - self._undeformed[other], axis=1)
        between = deformed[one] - deformed[other]
        near = np.linalg.norm(between, axis=1) < NEARER * was
        one_behind = near & (np.einsum("px,px->p", between, normals[other]) < 0.0)
        other_behind = near & (np.einsum("px,px->p", between, normals[one]) > 0.0)
        return np.union1d(one[one_behind], other[other_behind])


def _longest_side(nodes: Array, triangles: NDArray[np.int64]) -> float:
    sides = nodes[triangles] - nodes[np.roll(triangles, -1, axis=1)]
    return float(np.linalg.norm(sides, axis=2).max())


def _normals(nodes: Array, triangles: NDArray[np.int64]) -> Array:
    """Outward normals (n, 3) of a surface at its nodes, of any length."""
    a, b, c = (nodes[triangles[:, corner]] for corner in range(3))
    of_triangles, normals = np.cross(b - a, c - a), np.zeros_like(nodes)
    for corner in range(3):
        np.add.at(normals, triangles[:, corner], of_triangles)
    return normals


@njit(cache=True, nogil=True)
def winding_numbers(asked, nodes, normals, triangles, longest):
    """How often a surface winds around some of its own nodes, and how far its parts that face them are.

    Parameters
    ----------
    asked : (k,) nodes.
    nodes : (n, 3) where all nodes are.
    normals : (n, 3) of the surface at the nodes.
    triangles : (t, 3) of the closed surface.
    longest : side of a triangle.

    Returns
    -------
    Winding numbers (k,), and distances (k,), infinite where nothing faces the node.
    """
    windings, away = np.zeros(len(asked)), np.full(len(asked), np.inf)
    for k in range(len(asked)):
        node, total = asked[k], 0.0
        x, y, z = nodes[node]
        nx, ny, nz = normals[node]
        for t in range(len(triangles)):
            i, j, m = triangles[t]
            if i == node or j == node or m == node:
                continue
            ax, ay, az = nodes[i, 0] - x, nodes[i, 1] - y, nodes[i, 2] - z
            bx, by, bz = nodes[j, 0] - x, nodes[j, 1] - y, nodes[j, 2] - z
            cx, cy, cz = nodes[m, 0] - x, nodes[m, 1] - y, nodes[m, 2] - z
            na, nb = np.sqrt(ax * ax + ay * ay + az * az), np.sqrt(bx * bx + by * by + bz * bz)
            nc = np.sqrt(cx * cx + cy * cy + cz * cz)
            volume = ax * (by * cz - bz * cy) + ay * (bz * cx - bx * cz) + az * (bx * cy - by * cx)
            ab, bc, ca = ax * bx + ay * by + az * bz, bx * cx + by * cy + bz * cz, cx * ax + cy * ay + cz * az
            total += np.arctan2(volume, na * nb * nc + ab * nc + bc * na + ca * nb)
            facing = nx * (normals[i, 0] + normals[j, 0] + normals[m, 0])
            facing += ny * (normals[i, 1] + normals[j, 1] + normals[m, 1])
            facing += nz * (normals[i, 2] + normals[j, 2] + normals[m, 2])
            # No point of a triangle is nearer than its nearest corner less its longest side.
            if facing < 0.0 and min(na, nb, nc) < away[k] + longest:
                away[k] = min(away[k], _distance(nodes[triangles[t]] - nodes[node]))
        windings[k] = total / (2.0 * np.pi)
    return windings, away


@njit(cache=True, nogil=True)
def _distance(corners):
    """Distance of a triangle (3, 3) from the origin: of its plane where the foot is inside, of its sides else."""
    nearest, inside = np.inf, True
    normal = cross(corners[1] - corners[0], corners[2] - corners[0])
    for k in range(3):
        corner, side = corners[k], corners[(k + 1) % 3] - corners[k]
        share = min(max(-dot(corner, side) / max(dot(side, side), 1e-300), 0.0), 1.0)
        foot = corner + share * side
        nearest = min(nearest, np.sqrt(dot(foot, foot)))
        inside = inside and dot(cross(corner, side), normal) > 0.0
    if inside:
        nearest = abs(dot(corners[0], normal)) / np.sqrt(dot(normal, normal))
    return nearest
