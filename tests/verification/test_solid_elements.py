"""Patch tests and convergence rates of every element, Cook's membrane, and what hex8 cells must not do."""

from __future__ import annotations

from dataclasses import replace

import ngsolve as ngs
import numpy as np
import pytest

from morph_dslam.mechanics.loads import BodyForce, DeadTraction, Load
from morph_dslam.mechanics.materials.isotropic import NeoHookean
from morph_dslam.mechanics.solid import SolidOptions, SolidProblem
from morph_dslam.mechanics.solvers.newton import solve
from morph_dslam.mechanics.supports import PrescribedDisplacement, fixed
from morph_dslam.meshing.generators import block
from morph_dslam.model.cell_types import cell_type as type_of
from tests.support.solids import (
    FACES,
    ROLLERS,
    RUBBER,
    SOLID_CELLS,
    AffineSupport,
    distorted,
    load_parameter,
    mapped_block,
    solved,
)

MIXED_CELLS = ("hex8", "hex20", "hex27", "tet10", "prism15", "prism18")
#: None: the default elements of these cells.
VARIANTS = [(name, False) for name in SOLID_CELLS] + [(name, True) for name in MIXED_CELLS] + [("hex8", None)]


@pytest.mark.parametrize(("cell_type", "mixed"), VARIANTS)
def test_patch_of_distorted_cells(cell_type: str, mixed: bool | None) -> None:
    """An affine motion of the outside is that of the inside, with uniform stress."""
    gradient = np.array([[0.2, 0.1, -0.05], [0.03, -0.1, 0.08], [0.06, -0.02, 0.15]])
    symbols = load_parameter(share=0.0)
    mesh = distorted(block((1.0, 1.0, 1.0), (2, 2, 2), cell_type), 0.12, corners_only=True)
    supports = [AffineSupport(face, gradient, symbols["share"]) for face in FACES]
    options = SolidOptions(order=type_of(cell_type).order, mixed=mixed)
    problem = SolidProblem(mesh, {"all": RUBBER}, supports, parameters=symbols, options=options)
    state = solved(problem, 1.0)
    np.testing.assert_allclose(problem.nodal_displacement(state.dofs), mesh.nodes @ gradient.T, atol=1e-10)
    F = np.eye(3) + gradient
    J, lame, shear = np.linalg.det(F), 2.7e6 / 0.29, 3e6 / 2.9
    exact = (shear * (F @ F.T - np.eye(3)) + lame * np.log(J) * np.eye(3)) / J
    stress = problem.sample(state.dofs, state.mu)["stress"]
    voigt = exact[[0, 1, 2, 1, 0, 0], [0, 1, 2, 2, 2, 1]]
    np.testing.assert_allclose(stress, np.tile(voigt, (mesh.n_nodes, 1)), atol=1e-9 * np.abs(voigt).max())


AXES = (ngs.x, ngs.y, ngs.z)


def _gradient(vector: ngs.CF) -> ngs.CF:
    return ngs.CF(tuple(vector[i].Diff(axis) for i in range(3) for axis in AXES), dims=(3, 3))


def _error(cell_type: str, n: int, mixed: bool | None) -> float:
    """Error of the displacement's gradient, relative, against a manufactured solution.

    The displacement is the curl of (0, 0, psi), so that it suits nearly incompressible solids, and vanishes
    at x = 0. A body force and tractions on the other faces keep it there.
    """
    psi = (1.0 - ngs.cos(2.0 * ngs.x)) * ngs.sin(2.0 * ngs.y) * ngs.cos(ngs.z)
    # Near incompressibility so small that ln J, which is of its square, takes no pressure.
    amount = 1e-7 if mixed else 0.02
    exact = ngs.CF((amount * psi.Diff(ngs.y), -amount * psi.Diff(ngs.x), 0.0))
    material = NeoHookean(young=3e6, poisson=0.4999 if mixed else 0.3)
    F = (ngs.Id(3) + _gradient(exact)).MakeVariable()
    stress = material.energy(F).Diff(F)
    force = [-sum(stress[i, j].Diff(axis) for j, axis in enumerate(AXES)) for i in range(3)]
    loads: list[Load] = [BodyForce((force[0], force[1], force[2]))]
    for face in FACES[1:]:
        j, sign = "xyz".index(face[0]), 1.0 if face.endswith("max") else -1.0
        loads.append(DeadTraction(face, (sign * stress[0, j], sign * stress[1, j], sign * stress[2, j])))
    problem = SolidProblem(
        block((1.0, 1.0, 1.0), (n, n, n), cell_type),
        {"all": material},
        [fixed("x_min")],
        loads,
        options=SolidOptions(order=type_of(cell_type).order, mixed=mixed),
    )
    state = solve(problem, np.zeros(0), problem.initial_state())
    solution = ngs.GridFunction(problem.displacements.vector)
    solution.vec.FV().NumPy()[:] = state.dofs[: len(solution.vec)]
    gap, size = ngs.Grad(solution) - _gradient(exact), _gradient(exact)
    squares = [ngs.Integrate(ngs.InnerProduct(a, a), problem.geometry.ngs, order=6) for a in (gap, size)]
    return float(np.sqrt(squares[0] / squares[1]))


@pytest.mark.parametrize(
    ("cell_type", "mixed"),
    [
        pytest.param(*variant, marks=[pytest.mark.slow] if variant in (("tet4", False), ("prism6", False)) else [])
        for variant in VARIANTS
    ],
)
def test_convergence_rate(cell_type: str, mixed: bool | None) -> None:
    """The error of the gradient falls as h^p with p the order of the cells."""
    coarse, fine = (4, 8) if type_of(cell_type).order == 1 else (3, 5)
    rate = np.log(_error(cell_type, coarse, mixed) / _error(cell_type, fine, mixed)) / np.log(fine / coarse)
    assert rate == pytest.approx(type_of(cell_type).order, abs=0.1)


def _tip_of_cooks_membrane(cell_type: str, n: int, load: float, poisson: float) -> float:
    """How far the middle of the loaded end rises, of n x n cells in plane stress with E = 1 and default elements."""

    def place(unit: np.ndarray) -> np.ndarray:
        x, y, z = unit.T
        return np.column_stack([48.0 * x, 44.0 * x + (44.0 - 28.0 * x) * y, z])

    symbols = load_parameter(load=0.0)
    mesh = mapped_block((n, n, 1), cell_type, place)
    problem = SolidProblem(
        mesh,
        {"all": NeoHookean(young=1.0, poisson=poisson)},
        [PrescribedDisplacement("x_min", x=0.0, y=0.0), PrescribedDisplacement("z_min", z=0.0)],
        [DeadTraction("x_max", (0.0, symbols["load"] / 16.0, 0.0))],
        symbols,
    )
    state = solved(problem, load)
    tip = np.argmin(np.linalg.norm(mesh.nodes - [48.0, 52.0, 0.5], axis=1))
    return problem.nodal_displacement(state.dofs)[tip, 1]


@pytest.mark.parametrize(
    ("cell_type", "n"), [("hex8", 16), ("hex20", 10), ("hex27", 10), ("tet10", 10), ("prism18", 10)]
)
def test_cooks_membrane(cell_type: str, n: int) -> None:
    """Linear plane stress, E = 1, nu = 1/3, unit shear load: Simo and Rifai, IJNME 29, 1990."""
    small = 1e-6
    assert _tip_of_cooks_membrane(cell_type, n, small, 1.0 / 3.0) / small == pytest.approx(23.96, rel=0.005)


@pytest.mark.slow
@pytest.mark.parametrize("poisson", [0.45, 0.4999])
def test_cooks_membrane_rises_by_a_third_of_its_end(poisson: float) -> None:
    """Of hexahedra with enhanced strains as of second-order ones, which are within 0.1 % of those on 32 x 32 cells."""
    expected = _tip_of_cooks_membrane("hex27", 16, 0.2, poisson)
    assert expected > 4.0
    assert _tip_of_cooks_membrane("hex8", 16, 0.2, poisson) == pytest.approx(expected, rel=0.01)


def test_a_nearly_incompressible_block_under_a_stamp() -> None:
    """A quarter of the top pressed in, sliding nowhere: volumetric locking leaves 5 % of the depth."""

    def depth(cell_type: str, n: int) -> float:
        mesh = block((1.0, 1.0, 1.0), (n, n, n), cell_type)
        top = mesh.surfaces["z_max"]
        middles = mesh.nodes[mesh.face_nodes(top, corners_only=True)].mean(axis=1)
        mesh = replace(mesh, surfaces={**mesh.surfaces, "stamp": top[(middles[:, :2] < 0.5).all(axis=1)]})
        symbols = load_parameter(load=0.0)
        problem = SolidProblem(
            mesh,
            {"all": NeoHookean(young=1.0, poisson=0.4999)},
            [*ROLLERS, PrescribedDisplacement("z_max", x=0.0, y=0.0)],
            [DeadTraction("stamp", (0.0, 0.0, -symbols["load"]))],
            symbols,
        )
        state = solved(problem, 0.4)
        corner = np.argmin(np.linalg.norm(mesh.nodes - [0.0, 0.0, 1.0], axis=1))
        return problem.nodal_displacement(state.dofs)[corner, 2]

    expected = depth("hex27", 4)
    assert expected < -0.2
    assert depth("hex8", 4) == pytest.approx(expected, rel=0.03)


@pytest.mark.parametrize("cells", [(4, 4, 4), (4, 4, 1), (1, 1, 4)])
@pytest.mark.parametrize("stretch", [0.4, 0.7, 1.5, 2.5])
def test_uniform_states_have_no_spurious_modes(cells: tuple[int, int, int], stretch: float) -> None:
    """A body of a strongly elliptic law held all around is stable in uniform states, flat and long cells or not."""
    gradient = np.diag([stretch**-0.5, stretch**-0.5, stretch]) - np.eye(3)
    mesh = block((1.0, 1.0, 1.0), (4, 4, 4), "hex8")
    mesh = replace(mesh, nodes=mesh.nodes * cells)
    problem = SolidProblem(mesh, {"all": RUBBER}, [AffineSupport(face, gradient, 1.0) for face in FACES])
    dofs = np.zeros(problem.n_dofs)
    dofs[: 3 * mesh.n_nodes] = (problem.displacements.coefficients @ (mesh.nodes @ gradient.T)).T.ravel()
    assert problem.linearise(dofs, np.zeros(0)).negative_pivots == 0
