"""The paper's cantilever: plane stress, clamped at its left end, a unit force anywhere on its upper face."""

from __future__ import annotations

from dataclasses import dataclass

import ngsolve as ngs
import numpy as np
import scipy.sparse as sp
from ngsolve.meshes import MakeStructured2DMesh
from numpy.typing import NDArray

from morph_dslam.extend.models import cubic_spline_basis
from morph_dslam.extend.reduction import SeparableProblem, collocation_axis, galerkin_axis

Array = NDArray[np.float64]

LENGTH, HEIGHT, THICKNESS = 1.0, 0.1, 0.01  # m
YOUNG, POISSON, FORCE = 1e9, 0.3, 1.0  # Pa, -, N (downwards)
ELEMENTS = (100, 9)  # bilinear quadrilaterals along and across: the load moves from node to node
N_POSITIONS = 100
#: The outer half is this many times as stiff as the inner one.
STIFFNESS_RATIO = (0.2, 5.0)


@dataclass(frozen=True)
class Cantilever:
    """Matrices on the free degrees of freedom, and what is needed to draw a solution.

    Attributes
    ----------
    inner, outer : (n, n) stiffness of the inner and of the outer half, N/m.
    mass : (n, n), of unit density, for the L2 norm.
    loads : (n, N_POSITIONS) for the force at each of the ``positions`` (N_POSITIONS,), m from the clamp.
    vertices : (v, 2) of the mesh, m.
    triangles : (t, 3).
    vertical : (v, n) picks their vertical displacement.
    """

    inner: sp.csc_array
    outer: sp.csc_array
    mass: sp.csc_array
    loads: Array
    positions: Array
    vertices: Array
    triangles: NDArray[np.int64]
    vertical: sp.csr_array

    @property
    def top(self) -> NDArray[np.int64]:
        """Vertices of the upper face from the clamp to the tip."""
        on_top = np.flatnonzero(self.vertices[:, 1] > HEIGHT * (1.0 - 1e-9))
        return on_top[np.argsort(self.vertices[on_top, 0])]


def _matrix(form: ngs.comp.SumOfIntegrals, space: ngs.FESpace, free: NDArray[np.int64]) -> sp.csc_array:
    assembled = ngs.BilinearForm(form).Assemble()  # kept alive: its arrays are views
    values, columns, rows = assembled.mat.CSR()
    whole = sp.csr_array((np.array(values), np.array(columns), np.array(rows)), shape=(space.ndof,) * 2)
    return sp.csc_array(whole[free][:, free])


def _point_load(space: ngs.FESpace, mesh: ngs.Mesh, x: float) -> Array:
    """Consistent load vector of the force at (x, HEIGHT): the shape functions there, in the y component."""
    point = mesh(min(x, LENGTH * (1.0 - 1e-12)), HEIGHT * (1.0 - 1e-12))
    element = ngs.ElementId(ngs.VOL, point.nr)
    scalar = space.components[1]
    vector = np.zeros(space.ndof)
    offset = space.Range(1).start
    vector[offset + np.array(scalar.GetDofNrs(element))] = scalar.GetFE(element).CalcShape(*point.pnt[:2])
    return -FORCE * vector


def build_cantilever() -> Cantilever:
    """Assemble everything with NGSolve."""
    mesh = MakeStructured2DMesh(
        quads=True, nx=ELEMENTS[0], ny=ELEMENTS[1], mapping=lambda x, y: (LENGTH * x, HEIGHT * y)
    )
    space = ngs.VectorH1(mesh, order=1, dirichlet="left")
    u, v = space.TnT()

    def strain(w: ngs.CoefficientFunction) -> ngs.CoefficientFunction:
        return ngs.Sym(ngs.Grad(w))

    shear, lame = YOUNG / (2.0 * (1.0 + POISSON)), YOUNG * POISSON / (1.0 - POISSON**2)
    stress = 2.0 * shear * strain(u) + lame * ngs.Trace(strain(u)) * ngs.Id(2)
    energy = THICKNESS * ngs.InnerProduct(stress, strain(v))
    is_outer = ngs.IfPos(ngs.x - LENGTH / 2.0, 1.0, 0.0)
    free_dofs = space.FreeDofs()
    free = np.array([dof for dof in range(space.ndof) if free_dofs[dof]])
    positions = LENGTH * np.arange(1, N_POSITIONS + 1) / N_POSITIONS
    vertices = np.array([vertex.point for vertex in mesh.vertices])
    quads = np.array([[vertex.nr for vertex in element.vertices] for element in mesh.Elements(ngs.VOL)])
    whole = sp.csr_array(sp.eye_array(space.ndof))
    vertical = whole[space.Range(1).start :][: len(vertices)]
    return Cantilever(
        inner=_matrix((1.0 - is_outer) * energy * ngs.dx, space, free),
        outer=_matrix(is_outer * energy * ngs.dx, space, free),
        mass=_matrix(ngs.InnerProduct(u, v) * ngs.dx, space, free),
        loads=np.column_stack([_point_load(space, mesh, x)[free] for x in positions]),
        positions=positions,
        vertices=vertices,
        triangles=np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]]),
        vertical=sp.csr_array(vertical[:, free]),
    )


def moving_load(beam: Cantilever) -> SeparableProblem:
    """One parameter: the position of the load, at the nodes of hats."""
    axis = collocation_axis(beam.positions)
    whole = sp.csc_array(beam.inner + beam.outer)
    images = axis.multiplied_by(np.ones((1, N_POSITIONS)))
    return SeparableProblem((axis,), (whole,), (images,), beam.loads, (np.eye(N_POSITIONS),), whole)


def moving_load_and_stiffness(beam: Cantilever) -> SeparableProblem:
    """Two parameters: the position and the logarithm of the stiffness ratio (a C2 spline on 15 nodes)."""
    position = collocation_axis(beam.positions)
    softest, stiffest = np.log(STIFFNESS_RATIO)
    ratio = galerkin_axis(cubic_spline_basis(np.linspace(softest, stiffest, 15)))
    n_points = len(ratio.points)
    return SeparableProblem(
        axes=(position, ratio),
        matrices=(beam.inner, beam.outer),
        images=(
            position.multiplied_by(np.ones((2, N_POSITIONS))),
            ratio.multiplied_by([np.ones(n_points), np.exp(ratio.points)]),
        ),
        loads=beam.loads,
        load_functions=(np.eye(N_POSITIONS), np.ones((N_POSITIONS, n_points))),
        metric=sp.csc_array(beam.inner + beam.outer),
    )
