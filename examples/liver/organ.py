"""The liver of the example: where its fine mesh comes from, its named surfaces, and the tumour inside."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from organ_mesh import Patch
from scipy.spatial import ConvexHull

import morph_dslam as md
from morph_dslam.extend.mechanics import Mesh, load_mesh

Array = NDArray[np.float64]

#: Metres to a unit of the file, which states none: the liver is then 185 mm wide, as a small grown-up's is.
FILE_UNIT = 0.03
#: Length of the mesh's edges, metres.
SIZE = 0.012
#: The back around the vena cava, the tip of the left lobe, and the middle of the front.
PATCHES = {
    "held": Patch((0.052, 0.127, 0.085), 0.045),
    "grasped": Patch((0.184, 0.076, 0.122), 0.028),
    "pressed": Patch((0.090, 0.008, 0.095), 0.028),
}
#: The tumour is an ellipsoid: its middle and half axes, metres.
TUMOUR_CENTRE, TUMOUR_AXES = (0.080, 0.060, 0.112), (0.011, 0.009, 0.008)


def fine_liver(path: Path) -> Mesh:
    """The published tetrahedra in metres, turned so that x points to the organ's left, y back and z up.

    Raises
    ------
    MorphError
        If the file is not there or cannot be read.
    """
    if not path.is_file():
        raise md.MorphError(
            f"there is no mesh {path}: it is not part of the project; name the folder that holds "
            "sofa_mor/liverFine.vtu with --data, or the folder above it with MORPH_DATA"
        )
    # The reader takes the file's numbers for metres.
    mesh = load_mesh(path, "m")
    x, y, z = FILE_UNIT * mesh.nodes.T
    nodes = np.column_stack([x, -z, y])
    return replace(mesh, nodes=nodes - nodes.min(axis=0))


def ellipsoid(centre: Array, axes: Array, count: int = 162) -> tuple[Array, NDArray[np.int64]]:
    """An ellipsoid's surface: ``count`` nodes (p, 3) and outward triangles (m, 3).

    The directions are those of a Fibonacci spiral, which cover the sphere evenly.
    """
    number = np.arange(count) + 0.5
    height, turn = 1.0 - 2.0 * number / count, np.pi * (1.0 + np.sqrt(5.0)) * number
    radius = np.sqrt(1.0 - height**2)
    sphere = np.column_stack([radius * np.cos(turn), radius * np.sin(turn), height])
    hull = ConvexHull(sphere)
    corners = sphere[hull.simplices]
    inwards = np.einsum("mx,mx->m", np.cross(corners[:, 0], corners[:, 1]), corners[:, 2]) < 0.0
    triangles = hull.simplices.astype(np.int64)
    triangles[inwards] = triangles[inwards][:, ::-1]
    return np.asarray(centre) + np.asarray(axes) * sphere, triangles
