"""Pressures of nearly incompressible solids: the mixed form and the space that makes it stable.

The energy remainder(F) + p g(F) - p^2 / (2 K) (see `materials.base`) needs displacements rich enough for the
pressures (the inf-sup condition of Ladyzhenskaya, Babuska and Brezzi). Pairs used here:

hexahedra, second order   27 nodes with a linear pressure in each cell, discontinuous: stable (Boffi, Brezzi
                          and Fortin, Mixed Finite Element Methods and Applications, 2013, section 8.6), and
                          condensed cell by cell so that it costs next to nothing
tetrahedra and prisms,    Taylor and Hood's: pressures linear in each cell and continuous within a material
second order
hexahedra, first order    one pressure a cell (mean dilatation: Simo, Taylor and Pister, 1985). Displacements
                          are good; neighbouring pressures may alternate, and average out at nodes
"""

from __future__ import annotations

from typing import Any

import ngsolve as ngs
import numpy as np

from morph_dslam.errors import StudyError
from morph_dslam.offline.mechanics.displacement_space import DisplacementSpace
from morph_dslam.offline.meshing.meshes import Mesh


def check_mixed(mesh: Mesh, order: int) -> None:
    """Refuse cells that have no stable mixed element (StudyError)."""
    shapes = {block.type.shape for block in mesh.blocks}
    if order == 1 and shapes != {"hex"}:
        raise StudyError(
            "mixed elements of first order exist for hex8 only: use tet10 or prism18, or order = 2, "
            "for a nearly incompressible material"
        )


class PressureSpace:
    """Pressures on one region, as a combination of scalar unknowns.

    Parameters
    ----------
    space : the displacements, of full order.
    region : where the material is.

    Attributes
    ----------
    spaces : NGSolve spaces of the unknowns; `combine` makes the pressure of their functions.
    """

    def __init__(self, space: DisplacementSpace, region: ngs.Region) -> None:
        geometry = space.geometry
        mesh, ngs_mesh = geometry.mesh, geometry.ngs
        hexahedra = {block.type.shape for block in mesh.blocks} == {"hex"}
        self._offsets: list[Any] = []
        if not hexahedra:
            self.spaces = [ngs.H1(ngs_mesh, order=1, definedon=region)]
            return
        count = 1 if space.order == 1 else 4
        self.spaces = [ngs.L2(ngs_mesh, order=0, definedon=region) for _ in range(count)]
        if count == 4:
            corners = np.concatenate([mesh.nodes[b.connectivity[:, :8]] for b in mesh.blocks])
            centre = geometry.cell_field(corners.mean(axis=1))
            size = geometry.cell_field(np.ptp(corners, axis=1).max(axis=1))
            offset = (ngs.CF((ngs.x, ngs.y, ngs.z)) - centre) / size
            self._offsets = [offset[i] for i in range(3)]

    def combine(self, unknowns: list[Any]) -> Any:
        """Pressure of functions of `spaces`, in their unit."""
        result = unknowns[0]
        for offset, slope in zip(self._offsets, unknowns[1:], strict=True):
            result = result + offset * slope
        return result
