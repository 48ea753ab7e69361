"""Homogeneous deformations of one finite element in equilibrium, against closed forms; tangents of all laws.

The free sides are solved for by Newton's method on the assembled element, so that energies, their first and
their second derivatives are checked as the solver uses them.
"""

import ngsolve as ngs
import numpy as np
import pytest
from ngsolve.meshes import MakeStructured3DMesh

from morph_dslam.mechanics.materials.isotropic import NeoHookean, StVenantKirchhoff
from morph_dslam.mechanics.materials.viscoelastic import Prony, ViscousState
from tests.support.material_laws import LAWS, stress

FACES = "back|front"  # x = 0 and x = 1


class Bar:
    """A unit cube between two faces normal to x that slide in their planes; its sides are free."""

    def __init__(self, density, rules=None):
        mesh = MakeStructured3DMesh(hexes=True, nx=1, ny=1, nz=1)
        self.mesh = mesh
        self.space = ngs.VectorH1(mesh, order=1, dirichletx=FACES, dirichlety="left", dirichletz="bottom")
        self.displacement = ngs.GridFunction(self.space)
        options = {"intrules": rules(mesh)} if rules else {}
        self.form = ngs.BilinearForm(self.space, symmetric=True)
        F = ngs.Id(3) + ngs.Grad(self.space.TrialFunction())
        self.form += ngs.Variation(density(mesh, F).Compile() * ngs.dx(**options))

    @property
    def F(self):
        return ngs.Id(3) + ngs.Grad(self.displacement)

    def stretch(self, amount):
        """Nominal stress and lateral stretches at an axial stretch."""
        pulled = ngs.GridFunction(self.space)
        pulled.Set(ngs.CF(((amount - 1.0) * ngs.x, 0, 0)), definedon=self.mesh.Boundaries(FACES))
        free = np.array(list(self.space.FreeDofs()))
        values = self.displacement.vec.FV().NumPy()
        values[~free] = pulled.vec.FV().NumPy()[~free]
        residual = self.displacement.vec.CreateVector()
        for _ in range(25):
            self.form.Apply(self.displacement.vec, residual)
            self.form.AssembleLinearization(self.displacement.vec)
            inverse = self.form.mat.Inverse(self.space.FreeDofs(), inverse="sparsecholesky")
            step = (inverse * residual).Evaluate()
            self.displacement.vec.data -= step
            if ngs.Norm(step) < 1e-13:
                break
        self.form.Apply(self.displacement.vec, residual)
        force = sum(residual.FV().NumPy()[i] for i, v in enumerate(self.mesh.vertices) if v.point[0] > 0.5)
        F = np.array(self.F(self.mesh(0.4, 0.3, 0.2))).reshape(3, 3)
        return force, F[1, 1], F[2, 2]


def elastic_bar(material):
    return Bar(lambda mesh, F: material.energy(F))


@pytest.mark.parametrize(
    ("young", "poisson", "lateral", "nominal"), [(3.0, 0.45, 0.830679, 1.075843), (2.8, 0.4, 0.846028, 1.022825)]
)
def test_uniaxial_neo_hookean(young, poisson, lateral, nominal):
    # mu = 1 and lambda = 4 are E = 2.8 and nu = 0.4.
    force, across, other = elastic_bar(NeoHookean(young=young, poisson=poisson)).stretch(1.5)
    assert across == pytest.approx(lateral, abs=1e-6)
    assert other == pytest.approx(across, abs=1e-12)
    assert force == pytest.approx(nominal, abs=1e-6)


def test_uniaxial_st_venant_kirchhoff():
    # l_2^2 = 1 - nu (l^2 - 1) and S11 = E E11.
    force, across, _ = elastic_bar(StVenantKirchhoff(young=3.0, poisson=0.3)).stretch(1.3)
    assert across == pytest.approx(np.sqrt(1.0 - 0.3 * (1.3**2 - 1.0)), abs=1e-12)
    assert force == pytest.approx(1.3 * 3.0 * 0.5 * (1.3**2 - 1.0), abs=1e-12)


def test_simple_shear_of_neo_hookean():
    F = np.eye(3) + 0.5 * np.outer([1.0, 0.0, 0.0], [0.0, 1.0, 0.0])
    # E = 3, nu = 0.45, and J = 1, so that the Cauchy stress is P F'.
    cauchy = stress(NeoHookean(young=3.0, poisson=0.45), F) @ F.T
    assert cauchy[0, 1] == pytest.approx(0.517241, abs=1e-6)
    assert cauchy[0, 0] == pytest.approx(0.258621, abs=1e-6)


def test_relaxation_of_a_stretched_bar():
    material = NeoHookean(young=3.0, poisson=0.45, prony=Prony((0.6,), (2.0,)))
    states = {}

    def density(mesh, F):
        states["bar"] = ViscousState(mesh, {"default": material}, order=2)
        return states["bar"].energy("default", F)

    bar = Bar(density, rules=lambda mesh: ViscousState(mesh, {"default": material}, order=2).rules)
    state, forces = states["bar"], []
    for duration in (1e-9, 1.0, 1.0, 2.0):
        state.time_step.Set(duration)
        force, across, _ = bar.stretch(1.5)
        state.advance(bar.F)
        forces.append(force)
        assert across == pytest.approx(0.830679, abs=1e-6)
    assert forces[0] == pytest.approx(1.075843, abs=1e-6)
    assert forces[1] / forces[0] == pytest.approx(0.763918, abs=1e-6)
    assert forces[3] / forces[0] == pytest.approx(0.481201, abs=1e-6)


@pytest.mark.parametrize("name", LAWS)
def test_the_assembled_tangent_is_the_difference_of_assembled_forces(name):
    material = LAWS[name][0]
    bar = elastic_bar(material)
    x = bar.displacement.vec
    x.FV().NumPy()[:] = np.random.default_rng(5).uniform(-0.08, 0.08, len(x))
    direction, difference, force = x.CreateVector(), x.CreateVector(), x.CreateVector()
    direction.FV().NumPy()[:] = np.random.default_rng(6).normal(size=len(x))
    bar.form.AssembleLinearization(x)
    slope = (bar.form.mat * direction).Evaluate().FV().NumPy()
    sides, h = [], 1e-6
    for sign in (1.0, -1.0):
        difference.data = x + sign * h * direction
        bar.form.Apply(difference, force)
        sides.append(force.FV().NumPy().copy())
    np.testing.assert_allclose(slope, (sides[0] - sides[1]) / (2 * h), rtol=0, atol=1e-6 * np.abs(slope).max())


def test_forces_of_an_inverted_element_are_not_numbers():
    bar = elastic_bar(LAWS["neo_hookean"][0])
    bar.displacement.Set(ngs.CF((-1.5 * ngs.x, 0, 0)))
    force = bar.displacement.vec.CreateVector()
    bar.form.Apply(bar.displacement.vec, force)
    assert np.isnan(force.FV().NumPy()).any()
