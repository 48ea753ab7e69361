"""Patch tests and convergence rates of every element, and Cook's membrane."""

from __future__ import annotations

import ngsolve as ngs
import numpy as np
import pytest

from morph_dslam.offline.cell_types import cell_type as type_of
from morph_dslam.offline.loads import BodyForce, DeadTraction
from morph_dslam.offline.materials.isotropic import NeoHookean
from morph_dslam.offline.mesh_generators import block
from morph_dslam.offline.solid import SolidOptions, SolidProblem
from morph_dslam.offline.supports import PrescribedDisplacement, fixed
from tests.support.solids import (
    FACES,
    RUBBER,
    SOLID_CELLS,
    AffineSupport,
    distorted,
    load_parameter,
    mapped_block,
    solved,
)

MIXED_CELLS = ("hex8", "hex20", "hex27", "tet10", "prism15", "prism18")
VARIANTS = [(name, False) for name in SOLID_CELLS] + [(name, True) for name in MIXED_CELLS]


@pytest.mark.parametrize(("cell_type", "mixed"), VARIANTS)
def test_patch_of_distorted_cells(cell_type: str, mixed: bool) -> None:
    """An affine motion of the outside is that of the inside, with uniform stress."""
    gradient = np.array([[0.2, 0.1, -0.05], [0.03, -0.1, 0.08], [0.06, -0.02, 0.15]])
    symbols = load_parameter(share=0.0)
    mesh = distorted(block((1.0, 1.0, 1.0), (2, 2, 2), cell_type), 0.12, corners_only=True)
    supports = [AffineSupport(face, gradient, symbols["share"]) for face in FACES]
    problem = SolidProblem(
        mesh, {"all": RUBBER}, supports, parameters=symbols, options=SolidOptions(mixed=mixed)
    )
    state = solved(problem, 1.0)
    np.testing.assert_allclose(problem.nodal_displacement(state.dofs), mesh.nodes @ gradient.T, atol=1e-10)
    F = np.eye(3) + gradient
    J, lame, shear = np.linalg.det(F), 2.7e6 / 0.29, 3e6 / 2.9
    exact = (shear * (F @ F.T - np.eye(3)) + lame * np.log(J) * np.eye(3)) / J
    stress = problem.sample(state.dofs, state.mu)["stress"]
    voigt = exact[[0, 1, 2, 1, 0, 0], [0, 1, 2, 2, 2, 1]]
    np.testing.assert_allclose(stress, np.tile(voigt, (mesh.n_nodes, 1)), atol=1e-9 * np.abs(voigt).max())


def _manufactured(material: NeoHookean) -> tuple[ngs.CF, tuple[ngs.CF, ...]]:
    """A displacement that vanishes on the unit cube's surface, and the body force that keeps it there."""
    s = ngs.sin(np.pi * ngs.x) * ngs.sin(np.pi * ngs.y) * ngs.sin(np.pi * ngs.z)
    u = ngs.CF((0.05 * s, -0.03 * s, 0.04 * s))
    axes = (ngs.x, ngs.y, ngs.z)
    F = ngs.Id(3) + ngs.CF(tuple(u[i].Diff(axis) for i in range(3) for axis in axes), dims=(3, 3))
    variable = F.MakeVariable()
    stress = material.energy(variable).Diff(variable)
    force = tuple(-sum(stress[i, j].Diff(axis) for j, axis in enumerate(axes)) for i in range(3))
    return u, force


def _error(cell_type: str, n: int, mixed: bool) -> float:
    """L2 norm of the error of the displacement's gradient."""
    exact, force = _manufactured(RUBBER)
    mesh = block((1.0, 1.0, 1.0), (n, n, n), cell_type)
    problem = SolidProblem(
        mesh,
        {"all": RUBBER},
        [fixed(face) for face in FACES],
        [BodyForce(force)],
        options=SolidOptions(mixed=mixed),
    )
    state = solved(problem)
    solution = ngs.GridFunction(problem.displacements.vector)
    solution.vec.FV().NumPy()[:] = state.dofs[: len(solution.vec)]
    axes = (ngs.x, ngs.y, ngs.z)
    gradient = ngs.CF(tuple(exact[i].Diff(axis) for i in range(3) for axis in axes), dims=(3, 3))
    gap = ngs.Grad(solution) - gradient
    return float(np.sqrt(ngs.Integrate(ngs.InnerProduct(gap, gap), problem.geometry.ngs, order=8)))


@pytest.mark.parametrize(("cell_type", "mixed"), VARIANTS)
def test_convergence_rate(cell_type: str, mixed: bool) -> None:
    """The error of the gradient falls as h^p with p the order of the cells."""
    coarse, fine = (5, 10) if type_of(cell_type).order == 1 else (4, 7)
    rate = np.log(_error(cell_type, coarse, mixed) / _error(cell_type, fine, mixed)) / np.log(fine / coarse)
    assert rate == pytest.approx(type_of(cell_type).order, abs=0.1)


@pytest.mark.parametrize("cell_type", ["hex20", "hex27", "tet10", "prism18"])
def test_cooks_membrane(cell_type: str) -> None:
    """Linear plane stress, E = 1, nu = 1/3, unit shear load: Simo and Rifai, IJNME 29, 1990."""

    def place(unit: np.ndarray) -> np.ndarray:
        x, y, z = unit.T
        return np.column_stack([48.0 * x, 44.0 * x + (44.0 - 28.0 * x) * y, z])

    symbols = load_parameter(load=0.0)
    mesh = mapped_block((10, 10, 1), cell_type, place)
    problem = SolidProblem(
        mesh,
        {"all": NeoHookean(young=1.0, poisson=1.0 / 3.0)},
        [
            PrescribedDisplacement("x_min", x=0.0, y=0.0),
            PrescribedDisplacement("z_min", z=0.0),
        ],
        [DeadTraction("x_max", (0.0, symbols["load"] / 16.0, 0.0))],
        symbols,
    )
    small = 1e-6
    state = solved(problem, small)
    tip = problem.recovery.at_points(state.dofs, state.mu, np.array([[48.0, 52.0, 0.5]]))
    assert tip["displacement"][0, 1] / small == pytest.approx(23.96, rel=0.005)
