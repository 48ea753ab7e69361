"""Uniaxial tension of an incompressible solid: what a tension test measures, for fits and checks.

At stretch l the sides contract by l^-1/2 whatever the law, and the pressure that frees them is eliminated:
with S1 and S2 the axial and lateral second Piola-Kirchhoff stress of the law's remainder, the nominal stress
is P = l S1 - S2 / l^2. With a Prony series S1 and S2 advance in time by the recurrence of `viscous_history`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import ngsolve as ngs
import numpy as np
from ngsolve.meshes import Make1DMesh
from numba import njit
from numpy.typing import NDArray
from scipy.optimize import least_squares
from tqdm import tqdm

import morph_dslam as md
from morph_dslam.extend.mechanics import Material, Prony

Array = NDArray[np.float64]


@dataclass(frozen=True)
class TensionTest:
    """One test on one specimen.

    Attributes
    ----------
    name : for reports.
    stretch : (n,) deformed over undeformed length.
    stress : (n,) force over undeformed section, Pa.
    time : (n,) s, increasing; the specimen has rested before the first. None: so slow that time is no matter.
    """

    name: str
    stretch: Array
    stress: Array
    time: Array | None = None


class TensionStress:
    """Nominal stress of a law at given stretches; the law's parameters may change between calls.

    Parameters
    ----------
    material : a law whose remainder is its distortional energy, such as the rubber laws.
    stretch : (n,) stretches.
    time : (n,) s, or None for the elastic response alone.
    """

    def __init__(self, material: Material, stretch: Array, time: Array | None = None) -> None:
        self.material, self.time = material, time
        self.stretch = np.asarray(stretch, dtype=float)
        n = len(self.stretch)
        mesh = Make1DMesh(n)
        # One cell for each stretch: a field constant in cells carries them all through one evaluation.
        field = ngs.GridFunction(ngs.L2(mesh, order=0))
        field.vec.FV().NumPy()[:] = self.stretch
        side = 1.0 / ngs.sqrt(field)
        F = ngs.CF((field, 0, 0, 0, side, 0, 0, 0, side), dims=(3, 3)).MakeVariable()
        stress = ngs.Inv(F) * material.parts(F)[0].Diff(F)
        self._components = ngs.CF((stress[0, 0], stress[1, 1])).Compile()
        self._points = mesh((np.arange(n) + 0.5) / n)

    def instantaneous(self) -> Array:
        """(n, 2) axial and lateral second Piola-Kirchhoff stress of the remainder, Pa."""
        return np.asarray(self._components(self._points))

    def __call__(self) -> Array:
        """(n,) nominal stress, Pa."""
        stress = self.instantaneous()
        prony = self.material.prony
        if prony is not None and self.time is not None:
            moduli, times = (
                np.array([ngs.CF(value)(self._points)[0, 0] for value in values])
                for values in (prony.relative_moduli, prony.times)
            )
            stress = relaxed_stress(stress, np.asarray(self.time, dtype=float), moduli, times)
        return self.stretch * stress[:, 0] - stress[:, 1] / self.stretch**2


@njit(cache=True, nogil=True)
def relaxed_stress(instantaneous: Array, time: Array, moduli: Array, times: Array) -> Array:
    """Stress (n, k) with a Prony series, from the instantaneous one (n, k) at ``time`` (n,).

    The exponential midpoint rule of `viscous_history`; the state before the first time is free of stress, and
    the first step is instantaneous.
    """
    n, k = instantaneous.shape
    overstress = np.outer(moduli, instantaneous[0])
    equilibrium = 1.0 - moduli.sum()
    stress = np.empty((n, k))
    stress[0] = instantaneous[0]
    for j in range(1, n):
        step = time[j] - time[j - 1]
        for c in range(k):
            change = instantaneous[j, c] - instantaneous[j - 1, c]
            total = equilibrium * instantaneous[j, c]
            for i in range(len(moduli)):
                decay = np.exp(-0.5 * step / times[i])
                overstress[i, c] = decay * (decay * overstress[i, c] + moduli[i] * change)
                total += overstress[i, c]
            stress[j, c] = total
    return stress


def relative_error(measured: Array, computed: Array) -> float:
    """Root mean square difference over the root mean square of what was measured."""
    difference = np.asarray(computed) - np.asarray(measured)
    return float(np.linalg.norm(difference) / np.linalg.norm(measured))


def evaluate_tests(material: Material, tests: list[TensionTest]) -> list[Array]:
    """Nominal stress (n,), Pa, of a material in each test."""
    return [TensionStress(material, test.stretch, test.time)() for test in tests]


# Fits of material constants to tension tests by least squares from several starts.


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
                raise md.MorphError(f"the bounds of {name} must be increasing, not {low:g}, {high:g}")
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
    md.MorphError : no search found constants with finite stresses.
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
        raise md.MorphError("no constants within the bounds give finite stresses; widen the bounds of the fit")
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
