"""Small solids for tests: meshes, supports that tests need and users do not, and the usual solution path."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from morph_dslam.mechanics.materials.base import Material
from morph_dslam.mechanics.materials.isotropic import NeoHookean
from morph_dslam.mechanics.parameters import ParameterSymbols
from morph_dslam.mechanics.solid import SolidProblem
from morph_dslam.mechanics.solvers.continuation import advance
from morph_dslam.mechanics.solvers.newton import State
from morph_dslam.mechanics.supports import AffineMotion, PrescribedDisplacement
from morph_dslam.meshing.generators import block
from morph_dslam.meshing.meshes import CellBlock, Mesh
from morph_dslam.model import Parameter

Array = NDArray[np.float64]
SOLID_CELLS = ("hex8", "hex20", "hex27", "tet4", "tet10", "prism6", "prism15", "prism18")
FACES = ("x_min", "x_max", "y_min", "y_max", "z_min", "z_max")
RUBBER = NeoHookean(young=3e6, poisson=0.45)
#: Symmetry planes of a block that is stretched.
ROLLERS = tuple(PrescribedDisplacement(f"{axis}_min", **{axis: 0.0}) for axis in "xyz")


def load_parameter(**defaults: float) -> ParameterSymbols:
    """Symbols of parameters without units, by name."""
    return ParameterSymbols([Parameter(name, "ratio", "1", -9.0, 9.0, v) for name, v in defaults.items()])


@dataclass(frozen=True, eq=False)
class AffineSupport:
    """Moves a set by u = amount * gradient X, ``amount`` a symbol."""

    on: str
    gradient: Array
    amount: object
    components = (True, True, True)
    centred_on = None

    def motion(self, symbols: ParameterSymbols, centroid: Array, centroid_slopes: Array) -> AffineMotion:
        d = len(symbols)
        return AffineMotion(
            symbols.value(self.amount) * self.gradient,
            np.zeros(3),
            symbols.slopes(self.amount)[:, None, None] * self.gradient,
            np.zeros((d, 3)),
        )


class PrescribedCells:
    """Cells in a row, one for each material, with the same deformation gradient prescribed step by step."""

    def __init__(self, *materials: Material) -> None:
        mesh = block((float(len(materials)), 1.0, 1.0), (len(materials), 1, 1), "hex8")
        mesh = replace(mesh, cell_sets={str(i): np.array([i]) for i in range(len(materials))})
        mesh = replace(mesh, node_sets={"all": np.arange(mesh.n_nodes)})
        self.time, self.support = 0.0, AffineSupport("all", np.zeros((3, 3)), 1.0)
        symbols = load_parameter(time=0.0)
        of_sets = {str(i): material for i, material in enumerate(materials)}
        self.problem = SolidProblem(mesh, of_sets, [self.support], parameters=symbols, time=symbols["time"])

    def step(self, F: Array, duration: float) -> Array:
        """First Piola-Kirchhoff stress (2, 3, 3) of the first and the last cell, deformed to F in so many seconds."""
        self.time += duration
        self.support.gradient[:] = F - np.eye(3)
        mu = np.array([self.time])
        dofs = self.problem.prescribed(mu)
        at_nodes = self.problem.recovery.at_nodes(dofs, mu, ("first_piola_kirchhoff",))["first_piola_kirchhoff"]
        self.problem.advance_history(dofs, mu)
        return at_nodes[[0, -1]].reshape(2, 3, 3)


def distorted(mesh: Mesh, amount: float, seed: int = 0, corners_only: bool = False) -> Mesh:
    """The mesh with the nodes inside of it moved at random by up to ``amount``.

    ``corners_only`` keeps edges straight: middle nodes stay in the middle.
    """
    moves = amount * np.random.default_rng(seed).uniform(-1.0, 1.0, mesh.nodes.shape)
    moves[np.unique(mesh.face_nodes(mesh.boundary_faces()))] = 0.0
    if corners_only:
        for cells in mesh.blocks:
            corners = cells.type.corners
            for i, parents in enumerate(cells.type.parents):
                moves[cells.connectivity[:, corners + i]] = moves[cells.connectivity[:, parents]].mean(axis=1)
    return replace(mesh, nodes=mesh.nodes + moves)


def mapped_block(divisions: tuple[int, int, int], cell_type: str, place: Callable[[Array], Array]) -> Mesh:
    """A unit block with its nodes moved by ``place``, (n, 3) -> (n, 3)."""
    mesh = block((1.0, 1.0, 1.0), divisions, cell_type)
    return replace(mesh, nodes=place(mesh.nodes))


def merged(meshes: list[Mesh]) -> Mesh:
    """Meshes of one cell type that meet at equal nodes, as one; surfaces of the same name are joined."""
    starts = np.cumsum([0] + [mesh.n_nodes for mesh in meshes])
    nodes = np.concatenate([mesh.nodes for mesh in meshes])
    _, first, number = np.unique(np.round(nodes, 9), axis=0, return_index=True, return_inverse=True)
    connectivity = np.concatenate(
        [number.ravel()[mesh.blocks[0].connectivity + start] for mesh, start in zip(meshes, starts, strict=False)]
    )
    cells = np.cumsum([0] + [mesh.n_cells for mesh in meshes])
    surfaces = {}
    for name in meshes[0].surfaces:
        shifted = [m.surfaces[name] + [start, 0] for m, start in zip(meshes, cells, strict=False)]
        surfaces[name] = np.concatenate(shifted)
    return Mesh(nodes[first], (CellBlock(meshes[0].blocks[0].cell_type, connectivity),), surfaces=surfaces)


def solved(problem: SolidProblem, *mu: float) -> State:
    """The solution at ``mu``, along a straight line from the parameters' defaults."""
    return advance(problem, problem.initial_state(), np.array(mu, dtype=float))[-1]
