"""Constants of a law that come closest to material tests, with their standard deviations."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import ngsolve as ngs
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import OptimizeResult, least_squares
from scipy.special import stdtrit

from morph_dslam.errors import IdentificationError
from morph_dslam.material_tests.nominal_stress import MaterialTest, NominalStress, relative_error
from morph_dslam.mechanics.materials.base import Material
from morph_dslam.mechanics.materials.viscoelastic import Prony

Array = NDArray[np.float64]
#: Lowest and highest value of a constant; positive bounds far apart are searched by orders of magnitude.
Bounds = tuple[float, float]
#: A difference, over the test's root mean square stress, that stands for a law beyond its limit.
_FAR = 1e3
#: A constant this close to an end of its bounds, over their distance, is at the end.
_AT_END = 1e-7
#: Neighbouring differences are taken as correlated by no more than this.
_MOST_CORRELATED = 0.95
#: What names of the series' constants begin with: of the two kinds that are searched for, and of what shares make.
_SHARE, _TIME, _MODULUS = "share_", "time_", "relative_modulus_"


@dataclass(frozen=True, eq=False)
class Fit:
    """Result of a fit.

    Attributes
    ----------
    material : the law with the constants found.
    constants : these by name, those of the Prony series included: `relative_modulus_1`, `time_1` (s) and so on.
    deviations : standard deviations of the constants; infinite where the tests do not determine one, or leave nothing
        that tells their scatter; not a number where one is at an end of its bounds.
    halves : half the widths of 95 % intervals, which few points make wider (Student's t); not finite as the deviations.
    errors : root mean square difference over root mean square stress of each test.
    error : the root mean square of `errors`: each test counts alike.
    computed : the nominal stress (n,) of each test, Pa.
    """

    material: Material
    constants: dict[str, float]
    deviations: dict[str, float]
    halves: dict[str, float]
    errors: tuple[float, ...]
    error: float
    computed: tuple[Array, ...]


class _Unknowns:
    """Constants to be found as NGSolve parameters, seen as a vector in [0, 1]^k."""

    def __init__(self, bounds: Mapping[str, Bounds]) -> None:
        for name, (low, high) in bounds.items():
            if not low < high:
                raise IdentificationError(f"the bounds of {name} must be increasing, not {low:g}, {high:g}")
        self.low, self.high = np.array(list(bounds.values()), dtype=float).T
        # Moduli and times span decades: equal steps of their logarithms.
        self.logarithmic = (self.low > 0.0) & (self.high >= 100.0 * self.low)
        self.symbols = {name: ngs.Parameter(0.0) for name in bounds}

    def values(self, unit: Array) -> Array:
        linear = self.low + unit * (self.high - self.low)
        safe = np.where(self.logarithmic, self.low, 1.0), np.where(self.logarithmic, self.high, 1.0)
        return np.where(self.logarithmic, safe[0] * (safe[1] / safe[0]) ** unit, linear)

    def slopes(self, unit: Array) -> Array:
        """(k,) derivatives of the values by the vector."""
        ratio = np.where(self.logarithmic, self.high, 2.0) / np.where(self.logarithmic, self.low, 1.0)
        return np.where(self.logarithmic, self.values(unit) * np.log(ratio), self.high - self.low)

    def set(self, unit: Array) -> None:
        for symbol, value in zip(self.symbols.values(), self.values(unit), strict=True):
            symbol.Set(float(value))


def fit_law(
    law: Callable[..., Material],
    bounds: Mapping[str, Bounds],
    tests: Sequence[MaterialTest],
    prony_bounds: tuple[Sequence[Bounds], Sequence[Bounds]] | None = None,
    starts: int = 8,
    seed: int = 0,
) -> Fit:
    """Constants of an incompressible law that come closest to the measured stresses.

    Every test counts alike: its differences are divided by its root mean square stress and by the root of its
    number of points. Standard deviations take the scatter from the differences that are left, and count points whose
    differences have one sign for longer as fewer (`_effective_shares`). With as many points as
    constants nothing is left.

    Parameters
    ----------
    law : makes the material from its constants by keyword, `functools.partial(Gent, bulk=...)` say.
    bounds : constant -> lowest and highest value.
    tests : what was measured.
    prony_bounds : bounds of the shares of the relaxing stress and of the times (s) of a Prony series of
        relative moduli; share i is what term i takes of the stiffness that terms before it have left, so
        that any shares in [0, 1) make a stable series. None: an elastic law.
    starts : local searches from points spread over the bounds; the best is kept.
    seed : of the starts.

    Raises
    ------
    IdentificationError
        If the bounds do not increase, there are fewer stresses than constants, or no search found constants with finite
        stresses.
    """
    all_bounds, n_terms = dict(bounds), 0
    if prony_bounds is not None:
        n_terms = len(prony_bounds[0])
        for kind, entries in zip((_SHARE, _TIME), prony_bounds, strict=True):
            all_bounds |= {f"{kind}{i + 1}": entry for i, entry in enumerate(entries)}
    unknowns = _Unknowns(all_bounds)
    if (n_stressed := sum(int(np.count_nonzero(test.stress)) for test in tests)) < len(all_bounds):
        raise IdentificationError(f"{n_stressed} stresses do not determine {len(all_bounds)} constants; measure more")
    curves = [NominalStress(assembled(law, unknowns.symbols, n_terms), test) for test in tests]
    weights = [1.0 / np.linalg.norm(test.stress) for test in tests]

    def differences(unit: Array) -> Array:
        unknowns.set(unit)
        parts = [w * (c() - t.stress) for w, c, t in zip(weights, curves, tests, strict=True)]
        # A law beyond its limit (Gent's) is not a number; a large finite difference sends the search back.
        return np.nan_to_num(np.concatenate(parts), nan=_FAR, posinf=_FAR, neginf=-_FAR)

    best = _best_of(differences, len(all_bounds), starts, seed)
    unknowns.set(best.x)
    computed = tuple(curve() for curve in curves)
    errors = tuple(relative_error(t.stress, c) for t, c in zip(tests, computed, strict=True))
    values = dict(zip(all_bounds, unknowns.values(best.x).tolist(), strict=True))
    inside = (best.x > _AT_END) & (best.x < 1.0 - _AT_END)
    deviations, halves = np.full((2, len(best.x)), np.nan)
    slopes = best.jac[:, inside] / unknowns.slopes(best.x)[inside]
    parts, freedom = _covariances(slopes, best.fun, [len(t.stress) for t in tests])
    moved = _series_slopes(values, n_terms)[np.ix_(inside, inside)]
    deviations[inside], halves[inside] = _deviations(moved, parts, freedom)
    moduli = _moduli(values, n_terms)
    names = [_MODULUS + name.removeprefix(_SHARE) if name in moduli else name for name in all_bounds]
    constants = dict(zip(names, (values | moduli).values(), strict=True))
    found = Fit(
        material=assembled(law, values, n_terms),
        constants=constants,
        deviations=dict(zip(names, deviations.tolist(), strict=True)),
        halves=dict(zip(names, halves.tolist(), strict=True)),
        errors=errors,
        error=float(np.sqrt(np.mean(np.square(errors)))),
        computed=computed,
    )
    return found if n_terms == 0 else _in_order_of_time(found)


def _in_order_of_time(fit: Fit) -> Fit:
    """The same with the terms of its series from the shortest time to the longest: the ranges of times overlap."""
    series = fit.material.prony
    assert series is not None
    order = sorted(range(len(series.times)), key=lambda term: fit.constants[f"{_TIME}{term + 1}"])

    def sorted_terms(values: Mapping[str, float]) -> dict[str, float]:
        terms = {
            f"{kind}{place + 1}": values[f"{kind}{term + 1}"]
            for kind in (_MODULUS, _TIME)
            for place, term in enumerate(order)
        }
        return {name: terms.get(name, value) for name, value in values.items()}

    moduli, times = (tuple(part[k] for k in order) for part in (series.relative_moduli, series.times))
    # All terms are alike in that they leave the bulk elastic.
    material = replace(fit.material, prony=replace(series, relative_moduli=moduli, times=times))
    return replace(
        fit,
        material=material,
        constants=sorted_terms(fit.constants),
        deviations=sorted_terms(fit.deviations),
        halves=sorted_terms(fit.halves),
    )


def _best_of(differences: Callable[[Array], Array], size: int, starts: int, seed: int) -> OptimizeResult:
    points = np.random.default_rng(seed).random((starts, size))
    points[0] = 0.5
    results = [
        least_squares(differences, point, bounds=(0.0, 1.0), x_scale="jac", max_nfev=200, xtol=1e-10)
        for point in points
    ]
    best = min(results, key=lambda result: result.cost)
    if not best.cost < _FAR:
        raise IdentificationError("no constants within the bounds give finite stresses; widen the bounds of the fit")
    return best


def _moduli(values: Mapping[str, Any], n_terms: int) -> dict[str, Any]:
    """The relative moduli of a series by the names of the shares that are searched for, in their order."""
    moduli, left = {}, 1.0
    for name in (f"{_SHARE}{i + 1}" for i in range(n_terms)):
        moduli[name] = left * values[name]
        left = left * (1.0 - values[name])
    return moduli


def _series_slopes(values: Mapping[str, float], n_terms: int) -> Array:
    """(k, k) derivatives of a material's constants by those that are searched for, both in the order of ``values``.

    They are the same but for the relative moduli: that of a term is its share of what the terms before it have left.
    """
    slopes, names = np.eye(len(values)), list(values)
    shares = [f"{_SHARE}{i + 1}" for i in range(n_terms)]
    for i, name in enumerate(shares):
        # The modulus is linear in each of the shares up to its own.
        for other in shares[: i + 1]:
            ends = [_moduli({**values, other: end}, n_terms)[name] for end in (0.0, 1.0)]
            slopes[names.index(name), names.index(other)] = ends[1] - ends[0]
    return slopes


def _deviations(slopes: Array, parts: Array, freedom: Array) -> tuple[Array, Array]:
    """Standard deviations (k,) of constants to first order, and half the widths (k,) of their 95 % intervals.

    Both are infinite where the covariances are. The intervals are Student's; tests that each tell their own scatter
    have the degrees of freedom of Satterthwaite (Biometrics Bulletin 2, 1946).

    Parameters
    ----------
    slopes : (k, k) derivatives of the constants by those of the covariances.
    parts : (m, k, k) covariance of those that were searched for, by the scatter of each test.
    freedom : (m,) degrees of freedom of each scatter.
    """
    if not np.all(np.isfinite(parts)):
        return np.full(len(slopes), np.inf), np.full(len(slopes), np.inf)
    variances = np.einsum("ka,mab,kb->mk", slopes, parts, slopes)
    total = np.maximum(variances.sum(axis=0), np.finfo(float).tiny)
    shares = variances / total
    shown = 1.0 / np.maximum(np.sum(shares**2 / freedom[:, None], axis=0), np.finfo(float).tiny)
    deviations = np.sqrt(total)
    return deviations, deviations * stdtrit(shown, 0.975)


def _covariances(jacobian: Array, differences: Array, sizes: Sequence[int]) -> tuple[Array, Array]:
    """Covariance (m, k, k) of constants by the scatter of each test, and the degrees of freedom (m,) that show it.

    Covariances are infinite where the tests do not determine the constants, or leave nothing that shows a scatter.
    Their sum is the sandwich of White (Econometrica 48, 1980) by tests.

    Parameters
    ----------
    jacobian : (n, k) slopes of the differences of all tests.
    differences : (n,) what is left.
    sizes : points of each test.
    """
    k, ends = jacobian.shape[1], np.cumsum(sizes)
    tests = [slice(end - size, end) for size, end in zip(sizes, ends, strict=True)]
    # Where no constant changes the stress, as at a stretch of one, a point tells nothing and nothing is left.
    telling = np.any(jacobian != 0.0, axis=1)
    counts, n = np.array([np.count_nonzero(telling[rows]) for rows in tests]), np.count_nonzero(telling)
    # Constants take degrees of freedom from all tests in proportion to their points.
    freedom = np.where(counts > 0, counts * (1.0 - k / max(n, 1)), np.inf)
    if k == 0:
        return np.zeros((len(sizes), 0, 0)), freedom
    scale = np.linalg.norm(jacobian, axis=0)
    if n <= k or not np.all(scale > 0.0) or np.linalg.matrix_rank(jacobian / scale) < k:
        return np.full((len(sizes), k, k), np.inf), freedom
    scaled = jacobian / scale
    inverse = np.linalg.inv(scaled.T @ scaled)
    parts = np.zeros((len(sizes), k, k))
    for number, rows in enumerate(tests):
        left = differences[rows][telling[rows]]
        of_means, of_scatter = _effective_shares(left)
        variance = left @ left / freedom[number] / of_means
        parts[number] = variance * inverse @ (scaled[rows].T @ scaled[rows]) @ inverse / np.outer(scale, scale)
        freedom[number] *= of_scatter
    return parts, freedom


def _effective_shares(left: Array) -> tuple[float, float]:
    """The shares of points that count as independent: for what is fitted to them, and for their scatter.

    A law that does not fit leaves a smooth curve, whose points are no independent draws. With the correlation r of
    neighbours the shares are (1 - r) / (1 + r) and (1 - r^2) / (1 + r^2) (Bayley and Hammersley, Supplement to the
    J. R. Stat. Soc. 8, 1946).
    """
    energy = float(left @ left)
    if energy == 0.0 or len(left) < 3:
        return 1.0, 1.0
    r = min(max(float(left[1:] @ left[:-1]) / energy, 0.0), _MOST_CORRELATED)
    return (1.0 - r) / (1.0 + r), (1.0 - r * r) / (1.0 + r * r)


def assembled(law: Callable[..., Material], values: Mapping[str, Any], n_terms: int) -> Material:
    """The material of named constants, the ``n_terms`` of the Prony series among them."""
    own = {k: v for k, v in values.items() if not k.startswith((_SHARE, _TIME))}
    material = law(**own)
    if n_terms == 0:
        return material
    times = tuple(values[f"{_TIME}{i + 1}"] for i in range(n_terms))
    return replace(material, prony=Prony(tuple(_moduli(values, n_terms).values()), times, (0.0,) * n_terms))
