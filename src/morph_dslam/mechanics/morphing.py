"""Fields that move a mesh's nodes, for shape parameters: radius and wall thickness.

A field times an amplitude is how far nodes move (`kinematics.ShapeField`); these take it in metres.
"""

from __future__ import annotations

import ngsolve as ngs
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from morph_dslam.errors import StudyError
from morph_dslam.mechanics.ngsolve_mesh import NgsolveMesh
from morph_dslam.mechanics.spaces import DisplacementSpace
from morph_dslam.meshing.meshes import Mesh

Array = NDArray[np.float64]
Indices = NDArray[np.int64]


def radius_field(nodes: Array, point: Array, direction: Array) -> Array:
    """Unit vectors (n, 3) that point away from an axis, zero on it: a larger radius, the same wall.

    Raises StudyError if the axis has no direction.

    Parameters
    ----------
    nodes : (n, 3), m.
    point : on the axis (3,), m.
    direction : of the axis (3,); its length does not matter.
    """
    length = np.linalg.norm(direction)
    if not length > 0.0:
        raise StudyError(f"the axis of the radius has no direction: {tuple(float(x) for x in direction)}")
    unit, arms = np.asarray(direction) / length, nodes - np.asarray(point)
    radial = arms - np.outer(arms @ unit, unit)
    radii = np.linalg.norm(radial, axis=1, keepdims=True)
    return np.divide(radial, radii, out=np.zeros_like(radial), where=radii > 0.0)


def thickness_field(mesh: Mesh, moved: str, kept: str) -> Array:
    """Field (n, 3) that moves one surface along its outward normal by 1 and keeps the opposite one.

    Nodes between them follow in the direction of the nearest moved node's normal, by a share that satisfies Laplace's
    equation, so that layers of cells keep their proportions. Raises StudyError if a surface is unknown, or the two
    share nodes.
    """
    moved_nodes, kept_nodes = mesh.surface_nodes(moved), mesh.surface_nodes(kept)
    shared = np.intersect1d(moved_nodes, kept_nodes)
    if len(shared):
        raise StudyError(f"surfaces '{moved}' and '{kept}' share {len(shared)} nodes; a thickness lies between two")
    space = DisplacementSpace(NgsolveMesh(mesh))
    share = _harmonic(space, space.dofs_on(moved_nodes), space.dofs_on(kept_nodes))
    _, nearest = KDTree(mesh.nodes[moved_nodes]).query(mesh.nodes)
    return (space.node_values @ share)[:, None] * surface_normals(mesh, moved)[moved_nodes][nearest]


def surface_normals(mesh: Mesh, surface: str) -> Array:
    """Outward unit normals (n, 3) at the nodes of a surface; zero at all other nodes.

    Averaged by the angles of the faces at the node, so that it does not matter how faces are cut into
    triangles (Thuermer and Wuethrich, Journal of Graphics Tools 3, 1998).
    """
    triangles = mesh.face_triangles(mesh.surface(surface))
    normals = np.zeros(mesh.nodes.shape)
    for corner in range(3):
        here, following, before = (mesh.nodes[np.roll(triangles, -corner, axis=1)[:, i]] for i in range(3))
        cross = np.cross(following - here, before - here)
        sine = np.linalg.norm(cross, axis=1)
        angle = np.arctan2(sine, np.sum((following - here) * (before - here), axis=1))
        np.add.at(normals, triangles[:, corner], (angle / sine)[:, None] * cross)
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    return np.divide(normals, lengths, out=normals, where=lengths > 0.0)


def _harmonic(space: DisplacementSpace, ones: Indices, zeros: Indices) -> Array:
    """Coefficients (n_scalar,) of the harmonic function that is 1 and 0 at two sets of dofs."""
    trial, test = space.scalar.TnT()
    form = ngs.BilinearForm(ngs.Grad(trial) * ngs.Grad(test) * ngs.dx(bonus_intorder=space.bonus_order))
    form.Assemble()
    constant = space.coefficients @ np.ones(space.geometry.mesh.n_nodes)
    result, residual = ngs.GridFunction(space.scalar), ngs.GridFunction(space.scalar).vec
    values = result.vec.FV().NumPy()
    values[ones] = constant[ones]
    free = ngs.BitArray(space.n_scalar)
    free.Set()
    for dof in np.concatenate([ones, zeros]):
        free.Clear(int(dof))
    residual.data = form.mat * result.vec
    result.vec.data -= form.mat.Inverse(free, inverse="sparsecholesky") * residual
    return values.copy()
