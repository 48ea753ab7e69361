"""Nonlinear Koiter shell for a flat sheet, on NGSolve.

The formulation is the mixed one of Neunteufel and Schöberl ("The Hellan-Herrmann-Johnson method for
nonlinear shells", Computers & Structures 225, 2019): displacements, bending moments and a hybrid rotation on
the edges are the unknowns, so that ordinary continuous elements suffice. Because the reference is flat, it is
posed on a plane mesh: half the cost of the same elements on a surface in space.

Energy, with F = [a1 a2] the deformed tangents, E = (F'F - 1)/2, nu the deformed unit normal,
kappa_ab = nu . d2u/dX_a dX_b, m the moments (their stationary value is t^3/12 C : kappa) and N the membrane
forces (t C : E), independent unknowns too: Newton's method on a thin sheet then needs a few iterations where
the displacement form needs tens (Magisano, Leonetti, Garcea, IJNME 109, 2017), and membrane locking goes:

    int  N:E - 1/(2t) N:C^-1:N  +  m:kappa - 6/t^3 m:C^-1:m   -   sum_edges int (angle - h.n) m_nn

If the meshed surface lies off the middle of the thickness, m + offset N takes m's place in the fourth term.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import ngsolve as ngs
import numpy as np
from ngsolve.meshes import MakeStructured2DMesh
from numpy.typing import NDArray

from morph_dslam.errors import StudyError

Array = NDArray[np.float64]


@dataclass(frozen=True)
class OrthotropicSheet:
    """Orthotropic plane-stress material of a sheet.

    Attributes
    ----------
    young_fibre : Young's modulus along the fibres, Pa.
    young_cross : Young's modulus across them, Pa.
    poisson : contraction across under tension along the fibres, nu_12.
    shear : shear modulus G_12, Pa.
    thickness : metres.
    fibre_angle : of the fibres from the x axis towards y, rad.
    offset : height of the middle of the thickness above the surface that is meshed and held, m.
    """

    young_fibre: float
    young_cross: float
    poisson: float
    shear: float
    thickness: float
    fibre_angle: float = 0.0
    offset: float = 0.0

    def __post_init__(self) -> None:
        if 1.0 - self.poisson**2 * self.young_cross / self.young_fibre <= 0.0:
            raise StudyError(
                f"poisson = {self.poisson} is unstable for these moduli: "
                "poisson^2 * young_cross / young_fibre must be below 1"
            )

    @property
    def stiffness(self) -> Array:
        """C (3, 3) in Pa: (S11, S22, S12) = C (E11, E22, 2 E12), in the sheet's axes x and y."""
        minor = self.poisson * self.young_cross / self.young_fibre
        det = 1.0 - self.poisson * minor
        coupling = self.poisson * self.young_cross / det
        along_fibres = np.array(
            [[self.young_fibre / det, coupling, 0.0], [coupling, self.young_cross / det, 0.0], [0.0, 0.0, self.shear]]
        )
        c, s = np.cos(self.fibre_angle), np.sin(self.fibre_angle)
        # Strains (E11, E22, 2 E12) in the fibres' axes from those in the sheet's.
        strains = np.array([[c * c, s * s, c * s], [s * s, c * c, -c * s], [-2 * c * s, 2 * c * s, c * c - s * s]])
        return strains.T @ along_fibres @ strains


def rectangle_mesh(x_lines: Array, y_lines: Array) -> ngs.Mesh:
    """Quadrilateral mesh whose lines are at ``x_lines`` and ``y_lines`` (increasing, metres).

    Its boundaries are named bottom, right, top and left.
    """
    nx, ny = len(x_lines) - 1, len(y_lines) - 1

    def place(x: float, y: float) -> tuple[float, float]:
        return float(x_lines[round(x * nx)]), float(y_lines[round(y * ny)])

    return MakeStructured2DMesh(quads=True, nx=nx, ny=ny, mapping=place)


def _bending_compliance(mesh: ngs.Mesh, rigid_elements: list[int]) -> ngs.GridFunction:
    """1 in elements that bend; nearly 0 in rigid ones (not quite: their moments must stay determined)."""
    result = ngs.GridFunction(ngs.L2(mesh, order=0))
    result.Set(ngs.CF(1.0))
    result.vec.FV().NumPy()[rigid_elements] *= 1e-6
    return result


def _unit(vector: Any) -> Any:
    return vector / ngs.Norm(vector)


def _quadratic(matrix: Array, a: Any, b: Any, c: Any) -> Any:
    """Energy that a symmetric 3x3 form takes on the Voigt vector (a, b, c)."""
    return (
        float(matrix[0, 0]) * a * a
        + float(matrix[1, 1]) * b * b
        + float(2.0 * matrix[0, 1]) * a * b
        + float(matrix[2, 2]) * c * c
        + float(2.0 * matrix[0, 2]) * a * c
        + float(2.0 * matrix[1, 2]) * b * c
    )


class KoiterSheet:
    """The discrete shell: spaces, residual, condensed tangent and recovery of stresses.

    Energies are counted in units of the bending stiffness, ``energy_scale``, so that conditioning does not
    depend on the material's units; every public quantity is SI.

    Parameters
    ----------
    mesh : plane mesh in metres.
    material : the sheet.
    order : polynomial degree of the displacements (moments: one less).
    clamped : names of mesh boundaries held in place and direction, "left|right" say, or "".
    dead_load : boundary name -> force per length (3,), N/m; scaled by `load_factor`.
    rigid_elements : elements whose displacements the caller prescribes as rigid. They must not bend at their
        edges either, which the moments would let them.
    """

    def __init__(
        self,
        mesh: ngs.Mesh,
        material: OrthotropicSheet,
        order: int = 3,
        clamped: str = "",
        dead_load: dict[str, Array] | None = None,
        rigid_elements: list[int] | None = None,
    ) -> None:
        self.mesh, self.material, self.order = mesh, material, order
        self.load_factor = ngs.Parameter(1.0)
        scalar = ngs.H1(mesh, order=order, dirichlet=clamped)
        moments = ngs.HDivDiv(mesh, order=order - 1, discontinuous=True)
        hybrid = ngs.HDiv(mesh, order=order - 1, orderinner=0, dirichlet=clamped)
        self.scalar_space = scalar
        force = ngs.L2(mesh, order=order - 1)
        self.space = scalar * scalar * scalar * moments * hybrid * force * force * force
        self.state = ngs.GridFunction(self.space)
        self._normals = _AveragedNormals(mesh, order, clamped, self.state)
        self._bending_compliance = _bending_compliance(mesh, rigid_elements or [])
        self._build_energy(dead_load or {})

    def _build_energy(self, dead_load: dict[str, Array]) -> None:
        material = self.material
        t, stiffness = material.thickness, material.stiffness
        # Bending stiffness sets the unit of energy: conditioning then does not depend on units.
        self.energy_scale = stiffness[0, 0] * t**3 / 12.0
        u1, u2, u3, m, h, *force = self.space.TrialFunction()
        a1, a2 = _tangents((u1, u2, u3))
        normal = _unit(ngs.Cross(a1, a2))
        strain = 0.5 * (a1 * a1 - 1.0), 0.5 * (a2 * a2 - 1.0), a1 * a2
        hessians = [u.Operator("hesse") for u in (u1, u2, u3)]
        kappa = [sum(normal[i] * hessians[i][j, k] for i in range(3)) for j, k in ((0, 0), (1, 1), (0, 1))]
        m11, m22, m12 = m[0, 0], m[1, 1], m[0, 1]

        edge_normal, edge_tangent = ngs.specialcf.normal(2), ngs.specialcf.tangential(2)
        tangent = _unit(a1 * edge_tangent[0] + a2 * edge_tangent[1])
        conormal = ngs.Cross(tangent, normal)
        averaged = self._normals.coefficient
        averaged = _unit(averaged - (tangent * averaged) * tangent)
        m_nn = m11 * edge_normal[0] ** 2 + m22 * edge_normal[1] ** 2 + 2.0 * m12 * edge_normal[0] * edge_normal[1]
        # Forces and moments are carried in units of energy_scale.
        compliance = np.linalg.inv(stiffness) * self.energy_scale
        membrane = sum(n * e for n, e in zip(force, strain, strict=True))
        membrane -= _quadratic(0.5 / t * compliance, *force)
        bending = m11 * kappa[0] + m22 * kappa[1] + 2.0 * m12 * kappa[2]
        bending -= self._bending_compliance * _quadratic(6.0 / t**3 * compliance, *self._middle(m, force))
        hinge = -(ngs.asin(conormal * averaged) - h * edge_normal) * m_nn
        form = ngs.BilinearForm(self.space, symmetric=True, condense=True)
        form += ngs.Variation(membrane.Compile() * ngs.dx)
        form += ngs.Variation(bending.Compile() * ngs.dx)
        form += ngs.Variation(hinge.Compile() * ngs.dx(element_boundary=True))
        for name, force in dead_load.items():
            density = sum(float(f / self.energy_scale) * u for f, u in zip(force, (u1, u2, u3), strict=True))
            form += ngs.Variation(-self.load_factor * density * ngs.ds(name))
        self.form = form

    def _middle(self, moment: Any, force: Any) -> list[Any]:
        """Moments (m11, m22, m12) about the middle of the thickness."""
        about_surface = moment[0, 0], moment[1, 1], moment[0, 1]
        return [m + self.material.offset * n for m, n in zip(about_surface, force, strict=True)]

    def refresh_normals(self) -> None:
        """Average the edge normals of the current state; due before an edge has turned by 90 degrees."""
        self._normals.update()

    def displacement_dofs(self, component: int) -> slice:
        """The part of a state vector that holds one displacement component."""
        dofs = self.space.Range(component)
        return slice(dofs.start, dofs.stop)

    def state_vector(self) -> Array:
        """The unknowns as a numpy view; writing to it changes the state."""
        return self.state.vec.FV().NumPy()

    def sample(self, dofs: Array, points: Array) -> tuple[Array, dict[str, Array]]:
        """Displacement and stress at ``points`` (n, 2); linear in ``dofs``, so it maps derivatives too.

        Returns
        -------
        displacement (n, 3), m; and for the faces "top" (on the side of +z) and "bottom" the second
        Piola-Kirchhoff stress (n, 3) as S11, S22, S12, Pa.
        """
        probe = ngs.GridFunction(self.space)
        probe.vec.FV().NumPy()[:] = dofs
        parts = probe.components
        where = self.mesh(*np.ascontiguousarray(points.T))
        displacement = np.column_stack([part(where).ravel() for part in parts[:3]])
        t = self.material.thickness
        force, moment = np.zeros((2, len(points), 3))
        for where in self._around(points):
            force += np.column_stack([part(where).ravel() for part in parts[5:8]]) / 4.0
            moment += parts[3](where).reshape(len(points), 4)[:, [0, 3, 1]] / 4.0
        membrane = force * self.energy_scale / t
        moment += self.material.offset * force
        # E(z) = E - z kappa, so the moments load the top face with the opposite sign.
        bending = 6.0 / t**2 * self.energy_scale * moment
        return displacement, {"top": membrane - bending, "bottom": membrane + bending}

    def _around(self, points: Array) -> list[Any]:
        """Mesh points beside ``points`` (n, 2), on all four sides: stresses jump between elements."""
        corners = np.array([vertex.point for vertex in self.mesh.vertices])
        low, high = corners.min(axis=0), corners.max(axis=0)
        # NGSolve finds points to a tolerance of some 1e-5 of an element.
        offset = 1e-4 * (high - low)
        sides = [offset * [i, j] for i in (-1.0, 1.0) for j in (-1.0, 1.0)]
        return [self.mesh(*np.ascontiguousarray(np.clip(points + side, low, high).T)) for side in sides]

    def bending_energy(self) -> float:
        """Elastic energy of bending at the current state, joule."""
        t = self.material.thickness
        middle = self._middle(self.state.components[3], self.state.components[5:8])
        compliance = np.linalg.inv(self.material.stiffness) * self.energy_scale**2 * 6.0 / t**3
        density = _quadratic(compliance, *middle)
        return ngs.Integrate(self._bending_compliance * density, self.mesh)


def _tangents(displacements: Any) -> tuple[Any, Any]:
    """Deformed tangents a1, a2 of the flat sheet from the three displacement components."""
    gradients = [ngs.Grad(u) for u in displacements]
    a1 = ngs.CF((1.0 + gradients[0][0], gradients[1][0], gradients[2][0]))
    a2 = ngs.CF((gradients[0][1], 1.0 + gradients[1][1], gradients[2][1]))
    return a1, a2


class _AveragedNormals:
    """Unit normals on the edges, averaged between the two elements and then kept fixed.

    The sum of the two angles that an edge sees does not depend on this field, so freezing it is exact; it
    only keeps the arc sine away from its branch.
    """

    def __init__(self, mesh: ngs.Mesh, order: int, clamped: str, state: ngs.GridFunction) -> None:
        facet = ngs.FacetFESpace(mesh, order=order - 1)
        space = facet * facet * facet
        self._field = ngs.GridFunction(space)
        trial = ngs.CF(tuple(space.TrialFunction()))
        a1, a2 = _tangents(state.components[:3])
        current = _unit(ngs.Cross(a1, a2))
        if clamped:
            held = ngs.GridFunction(ngs.FacetFESpace(mesh, order=0))
            held.Set(ngs.CF(1.0), definedon=mesh.Boundaries(clamped))
            current = (1.0 - held) * current + held * ngs.CF((0.0, 0.0, 1.0))
        self._form = ngs.BilinearForm(space, symmetric=True)
        energy = 0.5 * ngs.InnerProduct(trial, trial) - ngs.InnerProduct(current, trial)
        self._form += ngs.Variation(energy * ngs.dx(element_boundary=True))
        self._form.AssembleLinearization(self._field.vec)
        self._inverse = self._form.mat.Inverse(space.FreeDofs(), inverse="sparsecholesky")
        self.update()

    @property
    def coefficient(self) -> Any:
        return _unit(ngs.CF(tuple(self._field.components)))

    def update(self) -> None:
        vector = self._field.vec
        residual = vector.CreateVector()
        vector[:] = 0.0
        self._form.Apply(vector, residual)
        vector.data -= self._inverse * residual
