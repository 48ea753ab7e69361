"""Isotropic laws: with Young's modulus and Poisson's ratio, and rubbers with a bulk modulus of their own."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass
from math import sqrt
from typing import Any, ClassVar

import ngsolve as ngs

from morph_dslam.errors import StudyError
from morph_dslam.mechanics.materials.base import (
    Constant,
    Material,
    evaluate,
    green_lagrange,
    log_volume,
    positive_or_nan,
    register_law,
    right_cauchy_green,
)


@dataclass(frozen=True, kw_only=True, eq=False)
class _Lame(Material):
    """A law whose two constants are Young's modulus and Poisson's ratio.

    Attributes
    ----------
    young : Young's modulus at small strain, Pa.
    poisson : Poisson's ratio at small strain.
    """

    young: Constant
    poisson: Constant
    quantities: ClassVar = {"poisson": "ratio"}

    @property
    def shear(self) -> Constant:
        """Shear modulus mu at small strain, Pa."""
        return self.young / (2.0 * (1.0 + self.poisson))

    @property
    def volumetric_modulus(self) -> Constant:
        """Lame's lambda, Pa."""
        return self.young * self.poisson / ((1.0 + self.poisson) * (1.0 - 2.0 * self.poisson))

    def check_constants(self) -> None:
        self.require_positive("young")
        poisson = evaluate(self.poisson)
        if not -1.0 < poisson < 0.5:
            raise StudyError(
                f"{self.name}: poisson = {poisson:g} must lie between -1 and 0.5 "
                "(0.4999 for a nearly incompressible solid, in mixed elements)"
            )


@register_law("neo_hookean")
class NeoHookean(_Lame):
    """Compressible neo-Hookean solid, the paper's law for the boot seal.

    Energy  W = mu/2 (I1 - 3) - mu ln J + lambda/2 (ln J)^2,   I1 = tr F'F, J = det F
    Stress  P = mu (F - F^-T) + lambda ln J F^-T

    Bonet and Wood, Nonlinear Continuum Mechanics for Finite Element Analysis, 2nd ed. 2008, section 6.4.3.
    """

    def parts(self, F: Any) -> tuple[Any, Any]:
        log_J = log_volume(F)
        return self.shear * (0.5 * (ngs.InnerProduct(F, F) - 3.0) - log_J), log_J


@register_law("st_venant_kirchhoff")
class StVenantKirchhoff(_Lame):
    """St Venant-Kirchhoff solid: Hooke's law in the Green-Lagrange strain E = (F'F - 1)/2.

    Energy  W = mu E:E + lambda/2 (tr E)^2
    Stress  P = F S,  S = 2 mu E + lambda tr(E) 1

    For large rotations and small strains: it softens under strong compression and fails at a stretch of 0.58
    (Ciarlet, Mathematical Elasticity I, 1988, section 3.9).
    """

    def parts(self, F: Any) -> tuple[Any, Any]:
        strain = green_lagrange(F)
        return self.shear * ngs.InnerProduct(strain, strain), ngs.Trace(strain)


@register_law("linear_elastic")
class LinearElastic(_Lame):
    """Hooke's law in the small strain e = sym(F - 1), for small strains and small rotations only.

    Energy  W = mu e:e + lambda/2 (tr e)^2
    Stress  P = 2 mu e + lambda tr(e) 1

    A rotation counts as strain here; use `StVenantKirchhoff` where anything turns.
    Timoshenko and Goodier, Theory of Elasticity, 3rd ed. 1970, section 6.
    """

    def parts(self, F: Any) -> tuple[Any, Any]:
        strain = ngs.Sym(F) - ngs.Id(3)
        return self.shear * ngs.InnerProduct(strain, strain), ngs.Trace(strain)


@dataclass(frozen=True, kw_only=True, eq=False)
class Rubber(Material):
    """A law with a volumetric energy kappa/2 (J - 1)^2 beside a distortional one, for mixed elements too.

    Distortional energies are functions of I1~ = J^(-2/3) I1 and I2~ = J^(-4/3) I2. Rubber's bulk modulus is some
    thousand times its shear modulus.

    Attributes
    ----------
    bulk : bulk modulus kappa, Pa.
    """

    bulk: Constant

    @abstractmethod
    def distortional(self, F: Any, J: Any) -> Any:
        """Energy of the change of shape, Pa; J = det F."""

    def parts(self, F: Any) -> tuple[Any, Any]:
        J = ngs.Det(F)
        return self.distortional(F, J), J - 1.0

    @property
    def volumetric_modulus(self) -> Constant:
        return self.bulk

    def check_constants(self) -> None:
        self.require_positive("bulk")


def first_invariant(F: Any, J: Any) -> Any:
    """I1~ = J^(-2/3) tr C, 3 without distortion."""
    return J ** (-2.0 / 3.0) * ngs.InnerProduct(F, F)


def second_invariant(F: Any, J: Any) -> Any:
    """I2~ = J^(-4/3) (tr(C)^2 - C:C)/2, 3 without distortion."""
    C = right_cauchy_green(F)
    return J ** (-4.0 / 3.0) * 0.5 * (ngs.Trace(C) ** 2 - ngs.InnerProduct(C, C))


@register_law("mooney_rivlin")
class MooneyRivlin(Rubber):
    """Mooney-Rivlin rubber; c01 = 0 makes it the volume-split neo-Hookean law.

    Energy  W = c10 (I1~ - 3) + c01 (I2~ - 3) + kappa/2 (J - 1)^2
    Stress  incompressible uniaxial: P = 2 (1 - l^-3) (c10 l + c01)
    Shear modulus 2 (c10 + c01).

    Mooney, J. Appl. Phys. 11, 1940; Rivlin and Saunders, Phil. Trans. R. Soc. A 243, 1951.

    Attributes
    ----------
    c10 : Pa.
    c01 : Pa.
    """

    c10: Constant
    c01: Constant = 0.0

    def distortional(self, F: Any, J: Any) -> Any:
        return self.c10 * (first_invariant(F, J) - 3.0) + self.c01 * (second_invariant(F, J) - 3.0)


@register_law("yeoh")
class Yeoh(Rubber):
    """Yeoh rubber: a cubic in the first invariant, for filled rubbers and large strains.

    Energy  W = sum_i ci0 (I1~ - 3)^i + kappa/2 (J - 1)^2,  i = 1, 2, 3
    Stress  incompressible uniaxial: P = 2 (l - l^-2) (c10 + 2 c20 (I1 - 3) + 3 c30 (I1 - 3)^2)
    Shear modulus 2 c10.

    Yeoh, Rubber Chemistry and Technology 66, 1993.

    Attributes
    ----------
    c10 : Pa.
    c20 : Pa.
    c30 : Pa.
    """

    c10: Constant
    c20: Constant = 0.0
    c30: Constant = 0.0

    def distortional(self, F: Any, J: Any) -> Any:
        x = first_invariant(F, J) - 3.0
        return x * (self.c10 + x * (self.c20 + x * self.c30))


@register_law("gent")
class Gent(Rubber):
    """Gent rubber: neo-Hookean whose chains lock where I1~ - 3 reaches the limit Jm.

    Energy  W = -mu Jm/2 ln(1 - (I1~ - 3)/Jm) + kappa/2 (J - 1)^2
    Stress  incompressible uniaxial: P = mu Jm (l - l^-2) / (Jm - I1 + 3)

    Gent, Rubber Chemistry and Technology 69, 1996. Beyond the limit energy and stress are not a number, and
    the solver shortens its step.

    Attributes
    ----------
    shear : shear modulus mu at small strain, Pa.
    limit : Jm, the value of I1~ - 3 at which the chains are fully stretched.
    """

    shear: Constant
    limit: Constant
    quantities: ClassVar = {"limit": "ratio"}

    def distortional(self, F: Any, J: Any) -> Any:
        left = positive_or_nan(1.0 - (first_invariant(F, J) - 3.0) / self.limit)
        return -0.5 * self.shear * self.limit * ngs.log(left)

    def check_constants(self) -> None:
        self.require_positive("shear", "limit", "bulk")


#: Coefficients of the inverse Langevin function's series, as Abaqus has them.
_CHAIN_SERIES = (1.0 / 2.0, 1.0 / 20.0, 11.0 / 1050.0, 19.0 / 7000.0, 519.0 / 673750.0)


@register_law("arruda_boyce")
class ArrudaBoyce(Rubber):
    """Arruda-Boyce rubber: eight chains of finite length, by five terms of their series.

    Energy  W = mu sum_i Ci / m^(2i - 2) (I1~^i - 3^i) + kappa/2 (J - 1)^2,  m = limit,
            C = 1/2, 1/20, 11/1050, 19/7000, 519/673750
    Stress  incompressible uniaxial: P = 2 mu (l - l^-2) sum_i i Ci / m^(2i - 2) I1^(i - 1)
    Shear modulus mu (1 + 3/5 m^-2 + 99/175 m^-4 + 513/875 m^-6 + 42039/67375 m^-8).

    Arruda and Boyce, J. Mech. Phys. Solids 41, 1993. The series is finite everywhere; it locks less sharply than the
    chains near the limit.

    Attributes
    ----------
    shear : mu, Pa; the shear modulus at small strain is a little larger.
    limit : m, the stretch at which the chains are fully extended, such as 7 for a soft rubber.
    """

    shear: Constant
    limit: Constant
    quantities: ClassVar = {"limit": "ratio"}

    def distortional(self, F: Any, J: Any) -> Any:
        x = first_invariant(F, J)
        energy: Any = 0.0
        for i, factor in enumerate(_CHAIN_SERIES, start=1):
            energy = energy + factor / self.limit ** (2 * i - 2) * (x**i - 3.0**i)
        return self.shear * energy

    def check_constants(self) -> None:
        self.require_positive("shear", "limit", "bulk")


#: Where the series take over: relative size of the deviator, and (q / mean of the pair)^2.
_NEARLY_SPHERICAL = 0.03
_NEARLY_PAIRED = 1e-3
#: Terms that bring the series to double precision at those bounds.
_SPHERICAL_TERMS = 10
_PAIR_TERMS = 5
#: Where the series of (exp(x) - 1) / x takes over, and its terms.
_NEARLY_ZERO = 0.05
_EXPONENTIAL_TERMS = 10
#: Newton steps from a straight line to double precision of a root and its second derivative.
_ROOT_STEPS = 5


class _Spectrum:
    """The eigenvalues of a symmetric positive 3x3 coefficient function, for sums of their powers, tr C^s.

    The formula for the eigenvalues has no derivative where two of them are equal: in every solid at rest and all along
    a uniaxial test. Their power sums do. They are computed from the mean and the deviator's invariants J2 and J3, exact
    to rounding:

    * One eigenvalue is apart from the other two: the largest if J3 >= 0, else the smallest. It is a simple root of its
      cubic, found by Newton's method, through which NGSolve differentiates.
    * The power sum of the other two is even in their half difference q: a series in q^2 if q is small.
    * Where all three are close, the direction of the deviator is lost in rounding: a series in powers of the deviator,
      whose traces follow from Cayley and Hamilton's theorem.

    Parameters
    ----------
    C : symmetric positive definite 3x3 coefficient function.
    """

    def __init__(self, C: Any) -> None:
        self.mean = ngs.Trace(C) / 3.0
        deviator = C / self.mean - ngs.Id(3)
        self.j2 = 0.5 * ngs.InnerProduct(deviator, deviator)
        self.j3 = ngs.Det(deviator)
        self._far = self.j2 - 0.75 * _NEARLY_SPHERICAL**2
        # In the near-spherical branch the general formula is not used; a harmless value keeps it finite.
        j2 = ngs.IfPos(self._far, self.j2, 1.0)
        radius = 2.0 / sqrt(3.0) * ngs.sqrt(j2)
        cosine = 4.0 * ngs.IfPos(self._far, self.j3, 0.0) / radius**3
        side = ngs.IfPos(cosine, 1.0, -1.0)
        root = _isolated_root(side * cosine)
        self.single = 1.0 + side * radius * root
        self.pair_mean = 1.0 - 0.5 * side * radius * root
        self.pair_spread = 0.75 * radius**2 * (1.0 - root**2) / self.pair_mean**2

    def power_sum(self, exponent: Constant) -> Any:
        """tr C^exponent."""
        # Scalars to the power of a coefficient function, so that exponents may be parameters.
        general = _power(self.single, exponent) + _power(self.pair_mean, exponent) * self._pair(exponent)
        return _power(self.mean, exponent) * ngs.IfPos(self._far, general, self._spherical(exponent))

    def _pair(self, exponent: Constant) -> Any:
        """(1 + y)^s + (1 - y)^s with y^2 = pair_spread."""
        apart = self.pair_spread - _NEARLY_PAIRED
        y = ngs.sqrt(ngs.IfPos(apart, self.pair_spread, _NEARLY_PAIRED))
        direct = _power(1.0 + y, exponent) + _power(1.0 - y, exponent)
        binomials = _binomials(exponent, 2 * _PAIR_TERMS)
        series: Any = 0.0
        for k in range(_PAIR_TERMS, 0, -1):
            series = self.pair_spread * (series + 2.0 * binomials[2 * k])
        return ngs.IfPos(apart, direct, 2.0 + series)

    def _spherical(self, exponent: Constant) -> Any:
        """tr (1 + X)^s by the binomial series, X the deviator over the mean."""
        traces: list[Any] = [ngs.CF(3.0), ngs.CF(0.0), 2.0 * self.j2]
        for k in range(3, _SPHERICAL_TERMS + 1):
            # X^3 = j2 X + j3 1, times X^(k-3).
            traces.append(self.j2 * traces[k - 2] + self.j3 * traces[k - 3])
        binomials = _binomials(exponent, _SPHERICAL_TERMS)
        return sum((b * t for b, t in zip(binomials[2:], traces[2:], strict=True)), start=ngs.CF(3.0))


def _isolated_root(cosine: Any) -> Any:
    """x = cos(arccos(c)/3): the root in [0.866, 1] of 4 x^3 - 3 x = c for c in [0, 1], smooth up to c = 1."""
    lowest = sqrt(0.75)
    x = lowest + (1.0 - lowest) * cosine
    for _ in range(_ROOT_STEPS):
        x = x - (x * (4.0 * x * x - 3.0) - cosine) / (12.0 * x * x - 3.0)
    return x


def _power(base: Any, exponent: Constant) -> Any:
    return ngs.exp(exponent * ngs.log(base))


def _binomials(exponent: Constant, highest: int) -> list[Constant]:
    """Binomial coefficients of a real exponent, from the 0th to the highest."""
    values: list[Constant] = [1.0]
    for k in range(highest):
        values.append(values[-1] * (exponent - k) / (k + 1.0))
    return values


@register_law("ogden")
class Ogden(Rubber):
    """Ogden rubber: a sum of powers of the volume-preserving principal stretches.

    Energy  W = sum_p 2 mu_p / alpha_p^2 (l1~^a + l2~^a + l3~^a - 3) + kappa/2 (J - 1)^2,  a = alpha_p
    Stress  incompressible uniaxial: P = sum_p 2 mu_p / alpha_p (l^(a - 1) - l^(-a/2 - 1))
    Shear modulus sum_p mu_p.

    Ogden, Proc. R. Soc. A 326, 1972. The normalisation is Abaqus's; constants mu_p' of Ogden's own form
    mu_p'/alpha_p (...) convert by mu_p = mu_p' alpha_p / 2.

    Attributes
    ----------
    moduli : mu_p, Pa, one for each term.
    exponents : alpha_p, none of them zero.
    """

    moduli: tuple[Constant, ...]
    exponents: tuple[Constant, ...]
    quantities: ClassVar = {"exponents": "ratio"}

    def distortional(self, F: Any, J: Any) -> Any:
        # The volume is taken out of the sums rather than of the tensor, whose entries are then polynomials.
        spectrum = _Spectrum(right_cauchy_green(F))
        energy: Any = ngs.CF(0.0)
        for modulus, exponent in zip(self.moduli, self.exponents, strict=True):
            stretches = _power(J, -exponent / 3.0) * spectrum.power_sum(0.5 * exponent)
            energy += 2.0 * modulus / exponent**2 * (stretches - 3.0)
        return energy

    def constants(self) -> dict[str, Constant]:
        return super().constants() | _listed(moduli=self.moduli, exponents=self.exponents)

    def check_constants(self) -> None:
        super().check_constants()
        _check_terms(self.name, moduli=self.moduli, exponents=self.exponents)


@register_law("hyperfoam")
class Hyperfoam(Material):
    """Compressible foam: a sum of powers of the principal stretches, with a volume change of its own for each.

    Energy  W = sum_p 2 mu_p / alpha_p^2 (l1^a + l2^a + l3^a - 3 + (J^(-a b) - 1) / b),  a = alpha_p, b = beta_p
    Stress  principal: P_i = sum_p 2 mu_p / alpha_p (l_i^(a - 1) - J^(-a b) / l_i)
    with beta_p = nu_p / (1 - 2 nu_p). Shear modulus sum_p mu_p; a single term has Poisson's ratio nu_1 at small strain.

    Storakers, J. Mech. Phys. Solids 34, 1986; the normalisation is Abaqus's. The foam of Blatz and Ko (Trans. Soc.
    Rheol. 6, 1962) has one term, alpha = -2 and nu = 1/4.

    Attributes
    ----------
    moduli : mu_p, Pa, one for each term.
    exponents : alpha_p, none of them zero.
    poissons : nu_p, above -1/3 and below 1/2.
    """

    moduli: tuple[Constant, ...]
    exponents: tuple[Constant, ...]
    poissons: tuple[Constant, ...]
    quantities: ClassVar = {"exponents": "ratio", "poissons": "ratio"}

    def parts(self, F: Any) -> tuple[Any, Any]:
        spectrum, log_J = _Spectrum(right_cauchy_green(F)), log_volume(F)
        energy: Any = ngs.CF(0.0)
        for modulus, exponent, poisson in zip(self.moduli, self.exponents, self.poissons, strict=True):
            beta = poisson / (1.0 - 2.0 * poisson)
            # (J^(-a b) - 1) / b has a limit where b is zero, as in foams that do not widen when they are pressed.
            volume = -exponent * log_J * _mean_exponential(-exponent * beta * log_J)
            energy += 2.0 * modulus / exponent**2 * (spectrum.power_sum(0.5 * exponent) - 3.0 + volume)
        return energy, None

    def constants(self) -> dict[str, Constant]:
        lists = _listed(moduli=self.moduli, exponents=self.exponents, poissons=self.poissons)
        return super().constants() | lists

    def check_constants(self) -> None:
        _check_terms(self.name, moduli=self.moduli, exponents=self.exponents, poissons=self.poissons)
        for poisson in map(evaluate, self.poissons):
            if not -1.0 / 3.0 < poisson < 0.5:
                raise StudyError(f"{self.name}: poissons must lie between -1/3 and 0.5, but one is {poisson:g}")


def _mean_exponential(x: Any) -> Any:
    """(exp(x) - 1) / x, by its series where x is small."""
    small = ngs.IfPos(x * x - _NEARLY_ZERO**2, 0.0, x)
    series: Any = 1.0
    for k in range(_EXPONENTIAL_TERMS, 1, -1):
        series = 1.0 + small / k * series
    large = ngs.IfPos(x * x - _NEARLY_ZERO**2, x, 1.0)
    return ngs.IfPos(x * x - _NEARLY_ZERO**2, (ngs.exp(large) - 1.0) / large, series)


def _listed(**lists: tuple[Constant, ...]) -> dict[str, Constant]:
    """Constants of lists by name and place."""
    return {f"{name}[{i}]": value for name, values in lists.items() for i, value in enumerate(values)}


def _check_terms(law: str, **lists: tuple[Constant, ...]) -> None:
    """Refuse lists of different lengths, and exponents of zero (StudyError)."""
    lengths = [len(values) for values in lists.values()]
    if len(set(lengths)) > 1 or 0 in lengths:
        *names, last = lists
        raise StudyError(
            f"{law}: {', '.join(names)} and {last} must be lists of one length, "
            f"but there are {' and '.join(map(str, lengths))}"
        )
    if any(evaluate(exponent) == 0.0 for exponent in lists["exponents"]):
        raise StudyError(f"{law}: an exponent of 0 leaves its term without stiffness; remove the term")
