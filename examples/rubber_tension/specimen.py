"""Meshes of the notched rubber specimens: flat, extruded through the thickness, with stiff discs in one of them.

The specimen's frame has its origin in the middle of the front face, x along the load, y downwards in the pictures
and z away from the camera. Only the soft gauge section is meshed: what it is bonded to is stiff.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from netgen.geom2d import Circle, CSG2d, EdgeInfo, Rectangle, Solid2d
from numpy.typing import NDArray

Array = NDArray[np.float64]
#: Length along the load, width and thickness of the gauge section, width of a notch, and length of its tip, mm.
LENGTH, WIDTH, THICKNESS, NOTCH, TAPER = 48.0, 24.0, 2.5, 0.5, 0.54
#: Diameter of a disc, mm.
DISC = 1.8
#: Longest edges of the mesh, mm: in the rubber, on a disc, and at a notch's tip.
SIZE, DISC_SIZE, TIP_SIZE = 1.6, 0.5, 0.15


@dataclass(frozen=True)
class Shape:
    """A specimen's shape in its own plane.

    Attributes
    ----------
    notch : length of both notches with their tips, mm.
    discs : (n, 2) middles of the stiff discs, mm.
    """

    notch: float
    discs: Array = field(default_factory=lambda: np.zeros((0, 2)))


def write_mesh(path: Path, shape: Shape) -> None:
    """Write a specimen's mesh of second-order prisms, in mm, with the sets ``left``, ``right``, ``rubber`` and
    ``discs`` (if it has any)."""
    corners, triangles, in_disc = _flat_mesh(shape)
    nodes, prisms = _extruded(corners, triangles)
    ends = {"left": nodes[:, 0] < -0.5 * LENGTH + 1e-6, "right": nodes[:, 0] > 0.5 * LENGTH - 1e-6}
    regions = {"rubber": np.flatnonzero(~in_disc), "discs": np.flatnonzero(in_disc)}
    lines = ["*NODE"]
    lines += ["{}, {:.9g}, {:.9g}, {:.9g}".format(label, *node) for label, node in enumerate(nodes, 1)]
    for name, cells in regions.items():
        if len(cells):
            lines.append(f"*ELEMENT, TYPE=C3D15, ELSET={name}")
            lines += [f"{cell + 1}, " + ", ".join(map(str, prisms[cell] + 1)) for cell in cells]
    for name, held in ends.items():
        lines += [f"*NSET, NSET={name}", *(str(node + 1) for node in np.flatnonzero(held))]
    path.write_text("\n".join(lines) + "\n")


def _flat_mesh(shape: Shape) -> tuple[Array, NDArray[np.int64], NDArray[np.bool_]]:
    """Corners (n, 2), mm, triangles (m, 3) and which of them (m,) belong to a disc."""
    half, edge, radius = 0.5 * LENGTH, 0.5 * WIDTH, 0.5 * NOTCH
    rubber = Rectangle((-half, -edge), (half, edge), mat="rubber")
    for side in (-1.0, 1.0):
        mouth, shoulder, tip = side * (edge + 1.0), side * (edge - shape.notch + TAPER), side * (edge - shape.notch)
        fine = EdgeInfo(maxh=TIP_SIZE)
        slit = [(-radius, mouth), (-radius, shoulder), fine, (0.0, tip), fine, (radius, shoulder), (radius, mouth)]
        rubber -= Solid2d(slit if side < 0.0 else slit[::-1])
    geometry = CSG2d()
    for x, y in shape.discs:
        disc = Circle((x, y), 0.5 * DISC, mat="disc")
        disc.Maxh(DISC_SIZE)
        rubber -= disc
        geometry.Add(disc)
    geometry.Add(rubber)
    mesh = geometry.GenerateMesh(maxh=SIZE, grading=0.25)
    corners = np.array([point.p[:2] for point in mesh.Points()])
    elements = mesh.Elements2D()
    triangles = np.array([[vertex.nr - 1 for vertex in element.vertices] for element in elements])
    in_disc = np.array([mesh.GetMaterial(element.index) == "disc" for element in elements])
    sides = corners[triangles[:, 1:]] - corners[triangles[:, :1]]
    clockwise = np.linalg.det(sides) < 0.0
    triangles[clockwise] = triangles[clockwise][:, [0, 2, 1]]
    return corners, triangles, in_disc


def _extruded(corners: Array, triangles: NDArray[np.int64]) -> tuple[Array, NDArray[np.int64]]:
    """One layer of prisms of 15 nodes over triangles: nodes (n, 3), mm, and cells (m, 15)."""
    sides = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]], axis=2)
    edges, inverse = np.unique(sides.reshape(-1, 2), axis=0, return_inverse=True)
    middles = inverse.reshape(-1, 3)
    n, m = len(corners), len(edges)
    flat = np.vstack([corners, corners[edges].mean(axis=1)])
    layers = [(flat, 0.0), (flat, THICKNESS), (corners, 0.5 * THICKNESS)]
    nodes = np.vstack([np.column_stack([points, np.full(len(points), z)]) for points, z in layers])
    top, between = n + m, 2 * (n + m)
    prisms = [triangles, triangles + top, middles + n, middles + n + top, triangles + between]
    return nodes, np.hstack(prisms)
