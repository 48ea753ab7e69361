"""Fits of material constants to tension tests by least squares from several starts."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import ngsolve as ngs
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from tqdm import tqdm

from morph_dslam.errors import StudyError
from morph_dslam.offline.materials.base import Material
from morph_dslam.offline.materials.uniaxial import TensionStress, TensionTest, relative_error
from morph_dslam.offline.materials.viscoelastic import Prony

Array = NDArray[np.float64]
#: Lowest and highest value of a constant; positive bounds far apart are searched by orders of magnitude.
Bounds = tuple[float, float]


@dataclass(frozen=True)
class Fit:
    """Result of a fit.

    Attributes
    ----------
    material : the law with the constants found.
    constants : these by name, those of the Prony series included.
    error : root mean square difference over root mean square stress, of all tests together.
    errors : the same for each test by its name.
    """

    material: Material
    constants: dict[str, float]
    error: float
    errors: dict[str, float]


class _Unknowns:
    """Constants to be found as NGSolve parameters, seen as a vector in [0, 1]^k."""

    def __init__(self, bounds: Mapping[str, Bounds]) -> None:
        for name, (low, high) in bounds.items():
            if not low < high:
                raise StudyError(f"the bounds of {name} must be increasing, not {low:g}, {high:g}")
        self.low, self.high = np.array(list(bounds.values()), dtype=float).T
        # Moduli and times span decades: equal steps of their logarithms.
        self.logarithmic = (self.low > 0.0) & (self.high >= 100.0 * self.low)
        self.symbols = {name: ngs.Parameter(0.0) for name in bounds}

    def values(self, unit: Array) -> Array:
        linear = self.low + unit * (self.high - self.low)
        safe = np.where(self.logarithmic, self.low, 1.0), np.where(self.logarithmic, self.high, 1.0)
        return np.where(self.logarithmic, safe[0] * (safe[1] / safe[0]) ** unit, linear)

    def set(self, unit: Array) -> None:
        for symbol, value in zip(self.symbols.values(), self.values(unit), strict=True):
            symbol.Set(float(value))


def fit_law(
    law: Callable[..., Material],
    bounds: Mapping[str, Bounds],
    tests: list[TensionTest],
    prony_bounds: tuple[list[Bounds], list[Bounds]] | None = None,
    starts: int = 8,
    seed: int = 0,
) -> Fit:
    """Constants of an incompressible law that come closest to the measured stresses.

    Every test counts alike: its differences are divided by its root mean square stress and by the root of its
    number of points.

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
    StudyError : no search found constants with finite stresses.
    """
    all_bounds = dict(bounds)
    n_terms = 0
    if prony_bounds is not None:
        n_terms = len(prony_bounds[0])
        for kind, entries in zip(("share", "time"), prony_bounds, strict=True):
            all_bounds |= {f"{kind}_{i + 1}": entry for i, entry in enumerate(entries)}
    unknowns = _Unknowns(all_bounds)
    material = _assembled(law, unknowns.symbols, n_terms)
    curves = [TensionStress(material, test.stretch, test.time) for test in tests]
    weights = [1.0 / np.linalg.norm(test.stress) for test in tests]

    def differences(unit: Array) -> Array:
        unknowns.set(unit)
        parts = [w * (c() - t.stress) for w, c, t in zip(weights, curves, tests, strict=True)]
        # A law beyond its limit (Gent's) is not a number; a large finite difference sends the search back.
        return np.nan_to_num(np.concatenate(parts), nan=1e3, posinf=1e3, neginf=-1e3)

    best = _best_of(differences, len(all_bounds), starts, seed)
    unknowns.set(best)
    values = dict(zip(all_bounds, unknowns.values(best).tolist(), strict=True))
    found = _assembled(law, values, n_terms)
    computed = [curve() for curve in curves]
    errors = {t.name: relative_error(t.stress, c) for t, c in zip(tests, computed, strict=True)}
    total = relative_error(np.concatenate([t.stress for t in tests]), np.concatenate(computed))
    return Fit(found, values, total, errors)


def _best_of(differences: Callable[[Array], Array], size: int, starts: int, seed: int) -> Array:
    random = np.random.default_rng(seed)
    points = random.random((starts, size))
    points[0] = 0.5
    results = [
        least_squares(differences, point, bounds=(0.0, 1.0), x_scale="jac", max_nfev=200)
        for point in tqdm(points, desc="fitting, starts", leave=False)
    ]
    best = min(results, key=lambda result: result.cost)
    if not best.cost < 1e3:
        raise StudyError("no constants within the bounds give finite stresses; widen the bounds of the fit")
    return best.x


def _assembled(law: Callable[..., Material], values: Mapping[str, Any], n_terms: int) -> Material:
    """The material of named constants, the Prony series among them."""
    own = {k: v for k, v in values.items() if not k.startswith(("share_", "time_"))}
    material = law(**own)
    if n_terms == 0:
        return material
    moduli, left = [], 1.0
    for i in range(n_terms):
        moduli.append(left * values[f"share_{i + 1}"])
        left = left * (1.0 - values[f"share_{i + 1}"])
    times = tuple(values[f"time_{i + 1}"] for i in range(n_terms))
    return replace(material, prony=Prony(tuple(moduli), times, (0.0,) * n_terms))
