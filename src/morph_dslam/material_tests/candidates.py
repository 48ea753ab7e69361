"""Rubber laws that are fitted to material tests, and which of them to take."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from morph_dslam.errors import IdentificationError
from morph_dslam.material_tests.fit import Bounds, Fit, fit_law
from morph_dslam.material_tests.nominal_stress import KINDS, MaterialTest, NominalStress, largest_invariant
from morph_dslam.material_tests.stability import first_unstable_stretches, stretches_up_to
from morph_dslam.mechanics.materials.base import Material
from morph_dslam.mechanics.materials.isotropic import ArrudaBoyce, Gent, MooneyRivlin, Ogden, Yeoh

Array = NDArray[np.float64]
#: A law with fewer constants is taken if its error is at most this many times the smallest, or smaller than `_SMALL`,
#: which no test of rubber repeats.
_ALIKE, _SMALL = 1.1, 0.01
#: Where bars in tension are all that was tested, laws of the first invariant alone are taken up to this many times the
#: smallest error: what tension of a bar tells of the second one rules all else and is mostly error.
_ALIKE_BY_FIRST = 1.5
#: Laws up to this many times the smallest error say how much is open where nothing was measured.
_COMPARED = 2.0
#: Laws of the first invariant alone.
_BY_FIRST = ("neo_hookean", "yeoh", "gent", "arruda_boyce")
#: Moduli are sought within this factor of the shear modulus that a neo-Hookean solid has in the tests.
_FACTOR = 50.0
#: Ogden's exponents are in one of these ranges.
_POSITIVE, _NEGATIVE = (0.2, 15.0), (-6.0, -0.2)
#: Tests with stretches below this say something of compression.
_COMPRESSED = 0.95
#: Stresses whose product with those of a neo-Hookean solid is so far below zero, over both sizes, have the wrong sign.
#: About a stretch of 1 both have errors of measurement: products of errors of 3 % of the ranges are smaller.
_OPPOSED = 0.001
#: A test that pulls by less than this part of what it presses is one of compression, whose rows at rest have errors.
_RESTING = 0.1
#: By this factor the range of a relaxation time reaches into its neighbours'.
_OVERLAP = 5.0
#: The bulk modulus over the shear modulus of what is written: such tests do not measure it.
BULK_OVER_SHEAR = 1000.0


@dataclass(frozen=True)
class Span:
    """What tests span.

    Attributes
    ----------
    shear : shear modulus of the neo-Hookean solid that comes closest, Pa.
    most : the largest first invariant.
    tension_alone : whether bars in tension are all that was tested.
    """

    shear: float
    most: float
    tension_alone: bool

    @classmethod
    def of(cls, tests: Sequence[MaterialTest]) -> Span:
        """That of tests; raises IdentificationError as `neo_hookean_shear`."""
        return cls(
            neo_hookean_shear(tests),
            largest_invariant(tests),
            all(test.kind == "uniaxial" and np.min(test.stretch) > _COMPRESSED for test in tests),
        )


@dataclass(frozen=True)
class Candidate:
    """A law to fit.

    Attributes
    ----------
    name : what users call it.
    law : makes the material from its constants by keyword.
    bounds : of the constants, from what tests span; several sets of bounds are tried one after another.
    starts : searches in each.
    """

    name: str
    law: Callable[..., Material]
    bounds: Callable[[Span], Sequence[Mapping[str, Bounds]]]
    starts: int = 1


@dataclass(frozen=True, eq=False)
class FittedLaw:
    """A law with the constants that come closest to tests.

    Attributes
    ----------
    name : of its `Candidate`.
    fit : constants, deviations and errors.
    shear : shear modulus at small strain, Pa.
    unstable : kind of test -> the stretch nearest to 1 at which the law is unstable there, no farther than the largest
        first invariant of the tests.
    """

    name: str
    fit: Fit
    shear: float
    unstable: Mapping[str, float]

    @property
    def section(self) -> dict[str, Any]:
        """Keys and values of a study's [materials.NAME], SI."""
        material = self.fit.material
        values = {key: getattr(material, key) for key in self._keys}
        section: dict[str, Any] = {"law": material.law, **values, "bulk": BULK_OVER_SHEAR * self.shear}
        if (prony := material.prony) is not None:
            section["prony"] = {
                "relative_moduli": prony.relative_moduli,
                "times": prony.times,
                "bulk_moduli": prony.bulk_moduli,
            }
        return section

    @property
    def _keys(self) -> tuple[str, ...]:
        if isinstance(self.fit.material, Ogden):
            return ("moduli", "exponents")
        return tuple(name for name in self.fit.constants if not name.startswith(("relative_modulus_", "time_")))


def _yeoh_bounds(span: Span) -> list[dict[str, Bounds]]:
    """A positive modulus at rest; the constants of higher powers of the first invariant's growth have either sign."""
    ends = {f"c{i}0": _FACTOR * span.shear / (span.most - 3.0) ** (i - 1) for i in (1, 2, 3)}
    return [{name: (0.0 if name == "c10" else -end, end) for name, end in ends.items()}]


def _ogden_bounds(n_terms: int, span: Span) -> Iterator[dict[str, Bounds]]:
    """Positive moduli, so that each term is stable.

    The last exponent has either sign. A negative one hardly shows in tension of a bar and rules all else: it is left
    out where nothing else was tested.
    """
    modulus = (1e-4 * span.shear, _FACTOR * span.shear)
    for last in (_POSITIVE,) if span.tension_alone else (_POSITIVE, _NEGATIVE):
        exponents = [_POSITIVE] * (n_terms - 1) + [last]
        named = [(f"modulus_{i + 1}", modulus, f"exponent_{i + 1}", e) for i, e in enumerate(exponents)]
        yield {name: bounds for m, b, e, c in named for name, bounds in ((m, b), (e, c))}


def _ogden(**constants: Any) -> Ogden:
    """Ogden's law of constants modulus_1, exponent_1, modulus_2 and so on."""
    return Ogden(
        moduli=tuple(value for name, value in constants.items() if name.startswith("modulus_")),
        exponents=tuple(value for name, value in constants.items() if name.startswith("exponent_")),
        bulk=1.0,
    )


def _gent_bounds(span: Span) -> list[dict[str, Bounds]]:
    """Chains are not yet fully stretched in any test."""
    growth = span.most - 3.0
    return [{"shear": _positive(span), "limit": (1.0001 * growth, 1e4 * growth)}]


def _chain_bounds(span: Span) -> list[dict[str, Bounds]]:
    chain = float(np.sqrt(span.most / 3.0))
    return [{"shear": _positive(span), "limit": (0.3 * chain, 100.0 * chain)}]


def _mooney_bounds(span: Span) -> list[dict[str, Bounds]]:
    """None negative: that fits single tests a little closer, and is unstable in others."""
    return [dict.fromkeys(("c10", "c01"), (0.0, _FACTOR * span.shear))]


def _positive(span: Span) -> Bounds:
    return (span.shear / _FACTOR, span.shear * _FACTOR)


# The bulk modulus plays no part in tests of an incompressible solid.
_LAWS = (
    Candidate("neo_hookean", partial(MooneyRivlin, bulk=1.0), lambda span: [{"c10": _positive(span)}]),
    Candidate("mooney_rivlin", partial(MooneyRivlin, bulk=1.0), _mooney_bounds),
    Candidate("yeoh", partial(Yeoh, bulk=1.0), _yeoh_bounds),
    Candidate("gent", partial(Gent, bulk=1.0), _gent_bounds, starts=4),
    Candidate("arruda_boyce", partial(ArrudaBoyce, bulk=1.0), _chain_bounds, starts=4),
    *(
        Candidate(f"ogden_{n}", _ogden, lambda span, n=n: list(_ogden_bounds(n, span)), starts=2 + 2 * n)
        for n in (1, 2, 3)
    ),
)
CANDIDATES = {candidate.name: candidate for candidate in _LAWS}
#: Those that are fitted where none is named: three terms of Ogden's law follow noise in most tests.
USUAL = tuple(name for name in CANDIDATES if name != "ogden_3")


def fit_candidate(name: str, tests: Sequence[MaterialTest], n_terms: int = 0) -> FittedLaw:
    """A law of `CANDIDATES` fitted to tests, with a Prony series of ``n_terms`` if that is above 0.

    Raises
    ------
    IdentificationError
        If there is no such law, stresses have the sign of the opposite strain, a series is asked for and no test has
        times, or there are too few stresses.
    """
    if name not in CANDIDATES:
        raise IdentificationError(f"'{name}' is no law that can be fitted; give {', '.join(CANDIDATES)}")
    candidate = CANDIDATES[name]
    span = Span.of(tests)
    series = _series_bounds(tests, n_terms) if n_terms else None
    fits = [
        fit_law(candidate.law, bounds, tests, series, candidate.starts if n_terms == 0 else max(candidate.starts, 4))
        for bounds in candidate.bounds(span)
    ]
    fit = min(fits, key=lambda each: each.error)
    stiffness = fit.material.small_strain_stiffness()
    return FittedLaw(name, fit, float(stiffness[3, 3]), first_unstable_stretches(fit.material, span.most))


def neo_hookean_shear(tests: Sequence[MaterialTest]) -> float:
    """Shear modulus, Pa, of the neo-Hookean solid that comes closest to tests.

    Raises
    ------
    IdentificationError
        If stresses of a test have the sign of the opposite strain.
    """
    top = bottom = 0.0
    for test in tests:
        shape = neo_hookean_shape(test)
        both = float(np.linalg.norm(shape) * np.linalg.norm(test.stress))
        for side, word in ((shape > 0.0, "tension"), (shape < 0.0, "compression")):
            strained, found = shape[side], test.stress[side]
            opposed = float(strained @ found) < -_OPPOSED * both
            # Where a stretch is counted from a wrong zero, stresses are of the wrong sign too, but rise with it.
            if opposed and float((strained - strained.mean()) @ found) <= 0.0:
                raise IdentificationError(
                    f"{test.name}: stresses in {word} have the wrong sign; tension is positive, compression negative"
                )
        weight = 1.0 / float(test.stress @ test.stress)
        top += weight * float(shape @ test.stress)
        bottom += weight * float(shape @ shape)
    if not top > 0.0:
        raise IdentificationError("no test strains its specimen; the stretch is 1 at rest")
    return top / bottom


def neo_hookean_shape(test: MaterialTest) -> Array:
    """(n,) nominal stress of a neo-Hookean solid over its shear modulus."""
    stretches = test.principal_stretches
    return stretches[:, 0] - stretches[:, 2] ** 2 / stretches[:, 0]


def _series_bounds(tests: Sequence[MaterialTest], n_terms: int) -> tuple[list[Bounds], list[Bounds]]:
    """Bounds of shares and times of a Prony series: a range of times for each term, as far as tests tell."""
    timed = [test.time for test in tests if test.time is not None and len(test.time) > 1]
    if not timed:
        raise IdentificationError(
            "a Prony series needs tests with times, in two rows at least; give a column such as time_s"
        )
    # A process faster than most intervals of the quickest test does not show.
    shortest = min(float(np.median(np.diff(time))) for time in timed)
    longest = max(float(time[-1] - time[0]) for time in timed)
    edges = np.geomspace(shortest, 2.0 * longest, n_terms + 1)
    # Ranges overlap, for processes do not keep to a grid.
    low, high = np.maximum(edges[:-1] / _OVERLAP, shortest), np.minimum(edges[1:] * _OVERLAP, 2.0 * longest)
    return [(0.0, 0.99)] * n_terms, list(zip(low.tolist(), high.tolist(), strict=True))


def recommended(fitted: Sequence[FittedLaw], tests: Sequence[MaterialTest]) -> FittedLaw:
    """The law with the fewest constants of those that fit nearly as well as the best.

    Where bars in tension are all that was tested, laws of the first invariant alone come first.
    """
    alike = _alike(fitted, _ALIKE)
    if Span.of(tests).tension_alone:
        alike = [each for each in _alike(fitted, _ALIKE_BY_FIRST) if each.name in _BY_FIRST] or alike
    return min(alike, key=lambda each: (len(each.fit.constants), each.fit.error))


def _alike(fitted: Sequence[FittedLaw], factor: float) -> list[FittedLaw]:
    """Laws that are stable where tests have been, with errors up to a factor of the smallest; of all if none is."""
    stable = [each for each in fitted if not each.unstable] or list(fitted)
    limit = max(factor * min(each.fit.error for each in stable), _SMALL)
    return [each for each in stable if each.fit.error <= limit]


def untested_spread(fitted: Sequence[FittedLaw], tests: Sequence[MaterialTest]) -> dict[str, float]:
    """Kind of tension that was not tested -> by how much laws that fit about as well differ there, over their mean.

    It is the largest difference of their nominal stress at stretches up to the largest first invariant of the tests,
    with a Prony series of the instantaneous one: how much relaxes is no question of the kind of test.
    """
    most = largest_invariant(tests)
    made = {kind_in_tension(test) for test in tests}
    spread = {}
    for kind in KINDS:
        if kind in made:
            continue
        stretch = stretches_up_to(kind, most)
        test = MaterialTest(kind, stretch, np.ones(len(stretch)), kind=kind)
        laws = [replace(each.fit.material, prony=None) for each in _alike(fitted, _COMPARED)]
        stresses = np.array([NominalStress(law, test)() for law in laws])
        spread[kind] = float(np.max(np.ptp(stresses, axis=0) / np.abs(stresses.mean(axis=0))))
    return spread


def kind_in_tension(test: MaterialTest) -> str:
    """The kind of tension that strains as a test does: pressing a bar strains it as equal tension in two directions."""
    pressed, pulled = 1.0 - float(np.min(test.stretch)), float(np.max(test.stretch)) - 1.0
    return "biaxial" if test.kind == "uniaxial" and pulled < _RESTING * pressed else test.kind
