"""Every law: stress in closed form, tangent by differences, objectivity, small strain, unstable constants."""

from dataclasses import replace

import ngsolve as ngs
import numpy as np
import pytest
from scipy.optimize import brentq

from morph_dslam.errors import StudyError
from morph_dslam.mechanics.materials.anisotropic import HolzapfelGasserOgden, TransverselyIsotropic, turned_direction
from morph_dslam.mechanics.materials.base import evaluate, isotropic_average
from morph_dslam.mechanics.materials.isotropic import (
    ArrudaBoyce,
    Gent,
    Hyperfoam,
    LinearElastic,
    MooneyRivlin,
    NeoHookean,
    Ogden,
    StVenantKirchhoff,
    Yeoh,
)
from morph_dslam.mechanics.materials.user import UserMaterial
from morph_dslam.mechanics.materials.viscoelastic import Prony
from morph_dslam.mechanics.solid import SolidProblem
from morph_dslam.mechanics.supports import fixed
from morph_dslam.meshing.generators import block
from tests.support.closed_form_stress import from_invariants, orthotropic_stiffness, volumetric
from tests.support.material_laws import (
    AXES,
    BULGED,
    LAWS,
    ORTHO,
    energy,
    orthotropic,
    rotation,
    stress,
    tangent,
    tangent_by_differences,
    tensor,
)
from tests.support.solids import AffineSupport

STATES = {
    "uniaxial": np.diag([1.5, 0.85, 0.85]),
    "compressed": np.diag([0.75, 1.1, 1.1]),
    "biaxial": np.diag([1.4, 1.4, 0.6]),
    "shear": np.eye(3) + 0.5 * np.outer([1, 0, 0], [0, 1, 0]),
    "bulged": BULGED,
}
ELASTIC = {name: law for name, (law, _) in LAWS.items()}
laws = pytest.mark.parametrize("name", LAWS)


@laws
@pytest.mark.parametrize("state", STATES)
def test_the_stress_is_that_of_the_closed_form(name, state):
    material, exact = LAWS[name]
    expected = exact(STATES[state])
    np.testing.assert_allclose(stress(material, STATES[state]), expected, rtol=0, atol=1e-12 * abs(expected).max())


@laws
@pytest.mark.parametrize("state", ["uniaxial", "bulged"])
def test_the_tangent_is_the_difference_quotient_of_the_closed_form(name, state):
    material, exact = LAWS[name]
    differences = tangent_by_differences(exact, STATES[state])
    computed = tangent(material, STATES[state])
    np.testing.assert_allclose(computed, differences, rtol=0, atol=1e-7 * abs(differences).max())


@pytest.mark.parametrize("name", [n for n in LAWS if n != "linear_elastic"])
def test_a_rotation_of_the_deformed_solid_turns_the_stress_and_keeps_the_energy(name):
    material, Q = ELASTIC[name], rotation(1.1, -0.7, 2.3)
    assert energy(material, Q @ BULGED) == pytest.approx(energy(material, BULGED), rel=1e-12)
    assert energy(material, Q) == pytest.approx(0.0, abs=1e-14)
    expected = Q @ stress(material, BULGED)
    np.testing.assert_allclose(stress(material, Q @ BULGED), expected, rtol=0, atol=1e-12 * abs(expected).max())


def test_linear_elasticity_takes_a_rotation_for_strain():
    assert energy(ELASTIC["linear_elastic"], rotation(0.3, 0.0, 0.0)) > 1e-4


@pytest.mark.parametrize("name", [n for n, law in ELASTIC.items() if law.volumetric_modulus is not None])
def test_the_energy_is_its_remainder_and_the_volumetric_part(name):
    material, J = ELASTIC[name], np.linalg.det(BULGED)
    E = 0.5 * (BULGED.T @ BULGED - np.eye(3))
    logarithmic = name in ("neo_hookean", "transversely_isotropic")
    own = {"st_venant_kirchhoff": np.trace(E), "linear_elastic": np.trace(BULGED) - 3.0}
    strain = own.get(name, np.log(J) if logarithmic else J - 1.0)
    rest = energy(material, BULGED) - evaluate(material.parts(tensor(BULGED))[0])
    assert rest == pytest.approx(0.5 * evaluate(material.volumetric_modulus) * strain**2, rel=1e-12)


@pytest.mark.parametrize(
    ("name", "bulk", "shear"),
    [
        ("neo_hookean", 2.5, 3.0 / 2.6),
        ("st_venant_kirchhoff", 2.5, 3.0 / 2.6),
        ("linear_elastic", 2.5, 3.0 / 2.6),
        ("mooney_rivlin", 7.0, 0.84),
        ("yeoh", 7.0, 0.8),
        ("gent", 7.0, 0.8),
        (
            "arruda_boyce", 7.0,
            0.8 * (1 + 3 / 5 / 2.5**2 + 99 / 175 / 2.5**4 + 513 / 875 / 2.5**6 + 42039 / 67375 / 2.5**8),
        ),
        ("ogden", 7.0, 0.35),
        ("hyperfoam", 2.0 * (0.4 * (1.0 / 3.0 + 0.5) + 0.1 / 3.0), 0.5),
        ("user_material", 7.0, 0.84),
    ],
)  # fmt: skip
def test_isotropic_laws_become_hookes_law_at_small_strain(name, bulk, shear):
    expected = np.diag([2.0 * shear] * 3 + [shear] * 3)
    expected[:3, :3] += bulk - 2.0 / 3.0 * shear
    np.testing.assert_allclose(ELASTIC[name].small_strain_stiffness(), expected, atol=1e-13)
    poisson = (3 * bulk - 2 * shear) / (6 * bulk + 2 * shear)
    assert ELASTIC[name].equivalent_poisson == pytest.approx(poisson, abs=1e-13)
    ELASTIC[name].check()


def test_five_terms_of_arruda_and_boyce_leave_the_sixth_of_the_inverse_langevin_function():
    def departure(limit):
        chain = np.sqrt(np.trace(F @ F) / 3.0)
        force = brentq(lambda beta: 1.0 / np.tanh(beta) - 1.0 / beta - chain / limit, 1e-3, 100.0, xtol=1e-15)
        law = ArrudaBoyce(shear=1.0, limit=limit, bulk=7.0)
        return abs(from_invariants(F, limit * force / (6.0 * chain), 0.0) - stress(law, F)).max()

    F = np.diag([2.0, 2.0**-0.5, 2.0**-0.5])
    assert np.log2(departure(6.0) / departure(12.0)) == pytest.approx(10.0, abs=0.2)


def test_orthotropy_in_the_axes_of_space_has_the_inverse_of_its_compliance():
    expected = orthotropic_stiffness(**ORTHO)
    np.testing.assert_allclose(orthotropic().small_strain_stiffness(), expected, atol=1e-13)


def test_transverse_isotropy_has_its_five_constants_at_small_strain():
    law = TransverselyIsotropic(
        young_fibre=20.0, young_cross=3.0, poisson_fibre=0.3, poisson_cross=0.45, shear_fibre=1.4
    )
    expected = orthotropic_stiffness((20.0, 3.0, 3.0), (0.3, 0.3, 0.45), (1.4, 1.4, 3.0 / 2.9))
    np.testing.assert_allclose(law.small_strain_stiffness(), expected, atol=1e-13)


def test_fibres_without_dispersion_stiffen_their_own_direction_alone():
    law = HolzapfelGasserOgden(shear=0.5, k1=1.3, k2=0.7, bulk=7.0, fibre=(0.0, 0.0, 2.0))
    # Slightly stretched, since fibres at rest are at the corner where compression would slacken them.
    plain = stress(MooneyRivlin(c10=0.25, bulk=7.0), np.diag([1.0, 1.0, 1.001]))
    added = stress(law, np.diag([1.0, 1.0, 1.001])) - plain
    assert added[2, 2] == pytest.approx(4.0 * 1.3 * 0.001, rel=3e-3)
    assert np.abs(added[:2]).max() == 0.0
    slack = stress(law, np.diag([1.0, 1.0, 0.999]))
    np.testing.assert_array_equal(slack, stress(MooneyRivlin(c10=0.25, bulk=7.0), np.diag([1.0, 1.0, 0.999])))


def test_the_isotropic_average_of_an_isotropic_stiffness_is_itself():
    stiffness = np.diag([2.4] * 3 + [1.2] * 3)
    stiffness[:3, :3] += 5.0
    assert isotropic_average(stiffness) == pytest.approx((5.8, 1.2))


def test_a_constant_may_be_a_parameter_and_is_differentiated():
    young = ngs.Parameter(3.0)
    law = NeoHookean(young=young, poisson=0.3)
    F = tensor(BULGED).MakeVariable()
    slope = evaluate(law.energy(F).Diff(F).Diff(young))
    np.testing.assert_allclose(slope.reshape(3, 3), stress(ELASTIC["neo_hookean"], BULGED) / 3.0, rtol=1e-12)
    young.Set(-1.0)
    with pytest.raises(StudyError, match="young = -1 must be positive"):
        law.check()


def test_ogdens_exponents_may_be_parameters():
    exponent, h = ngs.Parameter(1.6), 1e-5
    law = Ogden(moduli=(1.0,), exponents=(exponent,), bulk=7.0)
    slope = evaluate(law.energy(tensor(BULGED)).Diff(exponent))
    ends = [energy(Ogden(moduli=(1.0,), exponents=(1.6 + s,), bulk=7.0), BULGED) for s in (-h, h)]
    assert slope == pytest.approx((ends[1] - ends[0]) / (2 * h), rel=1e-7)


@pytest.mark.parametrize("stretch", [0.5, 1.0, 1.6])
def test_the_foam_of_blatz_and_ko(stretch):
    """Pulled freely, P = mu (l^(-1/2) - l^-3), and the foam narrows by l^(-1/4) (Trans. Soc. Rheol. 6, 1962)."""
    foam = Hyperfoam(moduli=(0.22,), exponents=(-2.0,), poissons=(0.25,))
    found = stress(foam, np.diag([stretch, stretch**-0.25, stretch**-0.25]))
    expected = np.diag([0.22 * (stretch**-0.5 - stretch**-3), 0.0, 0.0])
    np.testing.assert_allclose(found, expected, atol=1e-13)


def test_poissons_ratio_of_a_foam_may_be_a_parameter_that_passes_zero():
    poisson, h = ngs.Parameter(0.0), 1e-5
    foam = Hyperfoam(moduli=(1.0,), exponents=(4.0,), poissons=(poisson,))
    slope = evaluate(foam.energy(tensor(BULGED)).Diff(poisson))
    ends = [energy(Hyperfoam(moduli=(1.0,), exponents=(4.0,), poissons=(s,)), BULGED) for s in (-h, h)]
    assert slope == pytest.approx((ends[1] - ends[0]) / (2 * h), rel=1e-7)


def test_a_fibre_turned_by_a_parameter_is_the_fibre_at_that_angle():
    angle = ngs.Parameter(0.0)
    turned = turned_direction(angle, (2.0, 0.0, 0.0), (1.0, 1.0, 0.0))
    constants = {"shear": 0.5, "k1": 1.3, "k2": 0.7, "bulk": 7.0}
    law = HolzapfelGasserOgden(**constants, fibre=turned)
    angle.Set(0.5)
    fixed = HolzapfelGasserOgden(**constants, fibre=(np.cos(0.5), np.sin(0.5), 0.0))
    np.testing.assert_allclose(stress(law, BULGED), stress(fixed, BULGED), rtol=1e-13)
    law.check()
    with pytest.raises(StudyError, match="two directions that differ"):
        turned_direction(angle, (1.0, 0.0, 0.0), (-2.0, 0.0, 0.0))


def test_each_cell_has_its_own_fibre():
    mesh = block((1.0, 1.0, 1.0), (1, 1, 1), "tet4")
    directions = np.random.default_rng(3).normal(size=(mesh.n_cells, 3))
    law = HolzapfelGasserOgden(shear=0.5, k1=1.3, k2=0.7, bulk=7.0, fibre=directions)
    supports = [AffineSupport(face, BULGED - np.eye(3), 1.0) for face in ("x_min", "x_max")]
    problem = SolidProblem(mesh, {"all": law}, supports)
    expected = sum(energy(replace(law, fibre=tuple(d)), BULGED) for d in directions) / 6.0
    assert problem.strain_energy(problem.prescribed(np.zeros(0)), np.zeros(0)) == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("directions", [np.ones((2, 3)), np.zeros((6, 3))])
def test_fibres_that_do_not_suit_the_mesh_are_refused(directions):
    law = HolzapfelGasserOgden(shear=0.5, k1=1.3, k2=0.7, bulk=7.0, fibre=directions)
    with pytest.raises(StudyError, match="cell"):
        SolidProblem(block((1.0, 1.0, 1.0), (1, 1, 1), "tet4"), {"all": law}, [fixed("x_min")])


HGO = {"shear": 0.5, "k1": 1.3, "k2": 0.7, "bulk": 7.0}


@pytest.mark.parametrize(
    ("material", "message"),
    [
        (NeoHookean(young=-3.0, poisson=0.3), "neo_hookean: young = -3 must be positive"),
        (NeoHookean(young=3.0, poisson=0.5), "poisson = 0.5 must lie between -1 and 0.5"),
        (StVenantKirchhoff(young=3.0, poisson=-1.2), "st_venant_kirchhoff: poisson = -1.2"),
        (LinearElastic(young=float("nan"), poisson=0.2), "young is not a finite number"),
        (NeoHookean(young=3.0, poisson=0.3, density=-1.0), "density = -1 must not be negative"),
        (MooneyRivlin(c10=0.3, c01=0.1, bulk=-7.0), "mooney_rivlin: bulk = -7 must be positive"),
        (MooneyRivlin(c10=0.1, c01=-0.3, bulk=7.0), "mooney_rivlin is unstable .* -0.8 Pa"),
        (Yeoh(c10=-0.1, bulk=7.0), "yeoh is unstable"),
        (Gent(shear=1.0, limit=-2.0, bulk=7.0), "gent: limit = -2 must be positive"),
        (Ogden(moduli=(0.1, -0.3), exponents=(2.0, 4.0), bulk=7.0), "ogden is unstable"),
        (Ogden(moduli=(0.1,), exponents=(2.0, 4.0), bulk=7.0), "there are 1 and 2"),
        (Ogden(moduli=(0.1,), exponents=(0.0,), bulk=7.0), "exponent of 0"),
        (Hyperfoam(moduli=(0.1,), exponents=(2.0,), poissons=(0.2, 0.3)), "there are 1 and 1 and 2"),
        (Hyperfoam(moduli=(0.1,), exponents=(2.0,), poissons=(0.5,)), "between -1/3 and 0.5, but one is 0.5"),
        (Hyperfoam(moduli=(0.1,), exponents=(0.0,), poissons=(0.2,)), "hyperfoam: an exponent of 0"),
        (Hyperfoam(moduli=(-0.1,), exponents=(2.0,), poissons=(0.2,)), "hyperfoam is unstable"),
        (Ogden(moduli=(float("inf"),), exponents=(2.0,), bulk=7.0), r"moduli\[0\] is not a finite"),
        (orthotropic(shear_13=-1.2), "shear_13 = -1.2 must be positive"),
        (orthotropic(poisson_12=1.6), "poisson_12 = 1.6, .* are unstable"),
        (orthotropic(axis_2=(-1.0, 0.0, 0.0)), "axis_1 and axis_2 are parallel"),
        (
            TransverselyIsotropic(
                young_fibre=2.0, young_cross=4.0, poisson_fibre=0.45, poisson_cross=0.3, shear_fibre=1.0
            ),
            "poisson_fibre = 0.45 and poisson_cross = 0.3 are unstable",
        ),
        (HolzapfelGasserOgden(**HGO, dispersion=0.4), "dispersion = 0.4 must lie between 0 and 1/3"),
        (HolzapfelGasserOgden(**HGO, fibre=(0.0, 0.0, 0.0)), "not all of them zero"),
        (UserMaterial(function=lambda F: ngs.Det(F)), "stress in the undeformed state"),
        (UserMaterial(function=lambda F: F.nonsense), "energy function .* failed"),
        (
            NeoHookean(young=3.0, poisson=0.3, prony=Prony((0.7, 0.4), (1.0, 2.0))),
            "sum below 1 so that some stiffness remains",
        ),
        (orthotropic(prony=Prony((0.5,), (1.0,), (0.0,))), "orthotropic has no volumetric part that bulk_moduli"),
        (
            Hyperfoam(moduli=(0.1,), exponents=(2.0,), poissons=(0.2,), prony=Prony((0.5,), (1.0,), (0.5,))),
            "hyperfoam has no volumetric part",
        ),
        (
            UserMaterial(function=lambda F: ngs.InnerProduct(F, F) - 2.0 * ngs.log(ngs.Det(F)),
                prony=Prony((0.5,), (1.0,), (0.0,))),
            "user_material has no volumetric part",
        ),
    ],
)  # fmt: skip
def test_unstable_constants_are_refused(material, message):
    with pytest.raises(StudyError, match=message):
        material.check()


def test_the_axes_of_orthotropy_are_those_given():
    law, _ = LAWS["orthotropic"]
    stretched = stress(law, np.eye(3) + 1e-7 * np.outer(AXES[:, 2], AXES[:, 2]))
    expected = orthotropic_stiffness(**ORTHO)[2, 2]
    assert AXES[:, 2] @ stretched @ AXES[:, 2] / 1e-7 == pytest.approx(expected, rel=1e-5)


@pytest.mark.parametrize("name", ["neo_hookean", "mooney_rivlin", "gent", "ogden", "transversely_isotropic"])
def test_an_inverted_cell_has_no_stress_that_could_be_taken_for_sound(name):
    assert np.isnan(stress(ELASTIC[name], np.diag([1.0, 1.0, -0.5]))).any()
    assert np.isnan(tangent(ELASTIC[name], np.diag([1.0, 1.0, -0.5]))).any()


def test_chains_beyond_their_limit_have_no_stress():
    # I1~ - 3 = 13.5 at this stretch; the limit is 12.
    assert np.isnan(stress(ELASTIC["gent"], np.diag([4.0, 0.5, 0.5]))).any()


#: Equal and nearly equal eigenvalues, on both sides of every switch between the formulas, and ordinary ones.
EIGENVALUES = [
    (1.0, 1.0, 1.0), (1.0, 1.0, 1.0 + 1e-9), (1.0, 1.001, 1.0011), (1.0, 1.0, 1.04), (1.0, 1.0, 1.05),
    (1.0, 1.05, 1.05), (1.0, 1.0, 1.2), (1.0, 1.07, 1.14), (9.0, 1 / 3, 1 / 3), (9.0, 1 / 3, 0.4),
    (9.0, 9.0, 1 / 81), (9.0, 9.0 + 1e-7, 1 / 81), (4.0, 1.0, 1.06), (4.0, 1.0, 1.07), (1.0, 2.0, 3.0),
    (100.0, 0.1, 0.1),
]  # fmt: skip
TURNED = rotation(0.5, 1.2, -0.4)


@pytest.mark.parametrize("eigenvalues", EIGENVALUES)
@pytest.mark.parametrize("exponent", [1.3, 5.0, -2.0, 7.4])
def test_the_energy_is_a_sum_of_powers_of_the_stretches(eigenvalues, exponent):
    stretches = np.sqrt(eigenvalues)
    J = np.prod(stretches)
    F = rotation(0.1, 0.2, 0.3) @ np.diag(stretches) @ TURNED
    sum_of_powers = np.sum((stretches * J ** (-1 / 3)) ** exponent)
    expected = 2.0 / exponent**2 * (sum_of_powers - 3.0) + 5.0 * (J - 1.0) ** 2
    size = 2.0 / exponent**2 * sum_of_powers
    assert energy(Ogden(moduli=(1.0,), exponents=(exponent,), bulk=10.0), F) == pytest.approx(
        expected, abs=1e-11 * size
    )


def polynomial_stress(F):
    """An Ogden solid of exponents 2, 4 and -2 in invariants: tr C, tr C^2 and tr C^-1 need no eigenvalues."""
    i1 = np.trace(F.T @ F) * np.linalg.det(F) ** (-2 / 3)
    # tr C^2 = I1^2 - 2 I2, tr C^-1 = I2 / I3.
    return from_invariants(F, 0.5 + 2 / 16 * 2 * i1, -2 / 16 * 2 + 0.5) + volumetric(F, 10.0)


@pytest.mark.parametrize("eigenvalues", EIGENVALUES)
def test_stress_and_tangent_are_exact_where_stretches_meet(eigenvalues):
    law = Ogden(moduli=(1.0, 1.0, 1.0), exponents=(2.0, 4.0, -2.0), bulk=10.0)
    F = rotation(0.1, 0.2, 0.3) @ np.diag(np.sqrt(eigenvalues)) @ TURNED
    differences = tangent_by_differences(polynomial_stress, F)
    size = abs(differences).max()
    np.testing.assert_allclose(stress(law, F), polynomial_stress(F), rtol=0, atol=1e-12 * size)
    np.testing.assert_allclose(tangent(law, F), differences, rtol=0, atol=1e-6 * size)
