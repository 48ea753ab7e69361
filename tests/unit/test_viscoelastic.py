"""Prony series: relaxation in closed form, the same steps in elements and at a material point, checks."""

import ngsolve as ngs
import numpy as np
import pytest
from ngsolve.comp import IntegrationRuleSpace
from ngsolve.meshes import MakeStructured3DMesh

from morph_dslam.errors import StudyError
from morph_dslam.mechanics.materials.fit import TensionStress, relaxed_stress
from morph_dslam.mechanics.materials.isotropic import NeoHookean, Ogden
from morph_dslam.mechanics.materials.viscoelastic import Prony, ViscousState
from tests.support import closed_form_stress as exact

SERIES = Prony((0.3, 0.2), (0.5, 4.0), (0.0, 0.0))


def mesh_of_one():
    return MakeStructured3DMesh(hexes=True, nx=1, ny=1, nz=1)


def at_points(cf, mesh, order=2):
    """Values (n, 3, 3) at integration points, where alone the history is known."""
    field = ngs.GridFunction(ngs.MatrixValued(IntegrationRuleSpace(mesh, order=order), dim=3))
    field.Interpolate(cf)
    return field.vec.FV().NumPy().reshape(9, -1).T.reshape(-1, 3, 3)


class Prescribed:
    """A cell whose deformation gradient is prescribed step by step."""

    def __init__(self, material, mesh=None):
        self.mesh = mesh or mesh_of_one()
        self.state = ViscousState(self.mesh, {"default": material}, order=2)
        self.displacement = ngs.GridFunction(ngs.VectorH1(self.mesh, order=1))
        self.F = ngs.Id(3) + ngs.Grad(self.displacement)
        self.stress = self.state.first_piola_kirchhoff("default", self.F)

    def step(self, F, duration):
        gradient = np.asarray(F) - np.eye(3)
        position = ngs.CF((ngs.x, ngs.y, ngs.z))
        self.displacement.Set(ngs.CF(tuple(gradient.ravel()), dims=(3, 3)) * position)
        self.state.time_step.Set(duration)
        stress = at_points(self.stress, self.mesh)
        self.state.advance(self.F)
        np.testing.assert_allclose(stress, np.broadcast_to(stress[0], stress.shape), atol=1e-12)
        return stress[0]


F_HELD = np.array([[1.3, 0.2, -0.1], [0.05, 0.85, 0.3], [0.15, -0.2, 1.1]])
MATERIAL = NeoHookean(young=3.0, poisson=0.3, prony=SERIES)


def split_stress(F):
    """P of the remainder and of the volumetric part of MATERIAL."""
    lam, _ = exact.lame(3.0, 0.3)
    volumetric = lam * np.log(np.linalg.det(F)) * np.linalg.inv(F).T
    return exact.neo_hookean(F, 3.0, 0.3) - volumetric, volumetric


def remaining(g, times, t):
    return 1.0 - sum(gi * (1.0 - np.exp(-t / tau)) for gi, tau in zip(g, times, strict=True))


@pytest.mark.parametrize("bulk", [(0.0, 0.0), (0.1, 0.4), None])
def test_a_held_deformation_relaxes_as_the_series_says(bulk):
    prony = Prony((0.3, 0.2), (0.5, 4.0), bulk)
    point = Prescribed(NeoHookean(young=3.0, poisson=0.3, prony=prony))
    shape, volume = split_stress(F_HELD)
    np.testing.assert_allclose(point.step(F_HELD, 1e-12), shape + volume, rtol=1e-10)
    for t in (0.3, 0.8, 3.8):
        # Steps of different lengths: the recurrence is exact while the strain rests.
        computed = point.step(F_HELD, {0.3: 0.3, 0.8: 0.5, 3.8: 3.0}[t])
        g, k = (remaining(part, (0.5, 4.0), t) for part in (prony.relative_moduli, prony.bulk))
        np.testing.assert_allclose(computed, g * shape + k * volume, rtol=1e-10, atol=1e-13)


def test_long_after_the_stress_is_that_of_the_long_term_law():
    point = Prescribed(MATERIAL)
    point.step(F_HELD, 1.0)
    shape, volume = split_stress(F_HELD)
    np.testing.assert_allclose(point.step(F_HELD, 1e4), 0.5 * shape + volume, rtol=1e-12, atol=1e-14)


def test_a_state_can_be_restored_and_a_step_repeated():
    point = Prescribed(MATERIAL)
    point.step(F_HELD, 0.2)
    kept = point.state.values()
    first = point.step(np.diag([1.2, 0.9, 1.0]), 0.4)
    point.state.restore(kept)
    np.testing.assert_array_equal(point.step(np.diag([1.2, 0.9, 1.0]), 0.4), first)


def test_regions_relax_each_by_its_own_series():
    mesh = MakeStructured3DMesh(hexes=True, nx=2, ny=1, nz=1)
    list(mesh.ngmesh.Elements3D())[1].index = 2
    mesh.ngmesh.SetMaterial(2, "rigid")
    mesh = ngs.Mesh(mesh.ngmesh)
    elastic = NeoHookean(young=3.0, poisson=0.3)
    state = ViscousState(mesh, {"default": MATERIAL, "rigid": elastic}, order=2)
    F = ngs.CF(tuple(F_HELD.ravel()), dims=(3, 3))
    stress = mesh.MaterialCF({name: state.first_piola_kirchhoff(name, F) for name in state.materials})
    for duration in (1e-12, 1e4):
        state.time_step.Set(duration)
        computed = at_points(stress, mesh)
        state.advance(F)
    shape, volume = split_stress(F_HELD)
    half = len(computed) // 2
    np.testing.assert_allclose(computed[:half], [0.5 * shape + volume] * half, rtol=1e-10, atol=1e-13)
    np.testing.assert_allclose(computed[half:], [shape + volume] * half, rtol=1e-10, atol=1e-13)


def test_a_solid_with_nothing_viscous_has_no_history():
    with pytest.raises(StudyError, match="none of the materials is viscous"):
        ViscousState(mesh_of_one(), {"default": NeoHookean(young=3.0, poisson=0.3)}, order=2)


def test_the_recurrence_converges_to_the_convolution_at_second_order():
    def error(steps):
        time = np.linspace(0.0, 3.0, steps + 1)
        computed = relaxed_stress(np.column_stack([time, 2.0 * time]), time, np.array([0.6]), np.array([0.7]))
        ramp = 0.4 * 3.0 + 0.6 * 0.7 * (1.0 - np.exp(-3.0 / 0.7))
        np.testing.assert_allclose(computed[-1, 1], 2.0 * computed[-1, 0], rtol=1e-14)
        return abs(computed[-1, 0] - ramp)

    assert error(40) < 1e-3
    assert np.log2(error(20) / error(40)) == pytest.approx(2.0, abs=0.02)


def test_a_tension_test_in_elements_and_at_a_point_agree():
    law = Ogden(moduli=(0.4, 0.1), exponents=(0.8, 2.5), bulk=50.0, prony=SERIES)
    time = np.array([0.0, 0.4, 0.9, 1.1, 2.0, 4.0])
    stretch = np.array([1.0, 1.3, 1.9, 2.5, 2.5, 1.4])
    nominal = TensionStress(law, stretch, time)()
    point = Prescribed(law)
    for j in range(1, len(time)):
        lam = stretch[j]
        P = point.step(np.diag([lam, lam**-0.5, lam**-0.5]), time[j] - time[j - 1])
        # The pressure of the incompressible solid frees the sides.
        assert P[0, 0] - P[1, 1] * lam**-1.5 == pytest.approx(nominal[j], rel=1e-11)


def test_an_elastic_tension_test_has_the_closed_form():
    stretch = np.array([0.8, 1.0, 1.7, 3.0])
    law = Ogden(moduli=(0.4, 0.1), exponents=(0.8, 2.5), bulk=50.0)
    expected = sum(2 * m / a * (stretch ** (a - 1) - stretch ** (-a / 2 - 1)) for m, a in ((0.4, 0.8), (0.1, 2.5)))
    np.testing.assert_allclose(TensionStress(law, stretch)(), expected, atol=1e-14)


def test_whether_the_volume_relaxes_is_told():
    assert Prony((0.3,), (1.0,)).bulk_relaxes
    assert not SERIES.bulk_relaxes


@pytest.mark.parametrize(
    ("prony", "message"),
    [
        (Prony((0.3, 0.2), (1.0,)), "as many relative moduli as times"),
        (Prony((), ()), "as many relative moduli as times"),
        (Prony((0.3,), (0.0,)), "times .* must be positive"),
        (Prony((-0.1,), (1.0,)), "relative_moduli .* at least 0"),
        (Prony((0.6, 0.4), (1.0, 2.0)), "sum below 1"),
        (Prony((0.3,), (1.0,), (1.0,)), "bulk_moduli"),
    ],
)
def test_series_that_are_no_relaxation_are_refused(prony, message):
    with pytest.raises(StudyError, match=message):
        prony.check()
