"""Uniaxial tension of an incompressible solid: what a tension test measures, for fits and checks.

At stretch l the sides contract by l^-1/2 whatever the law, and the pressure that frees them is eliminated:
with S1 and S2 the axial and lateral second Piola-Kirchhoff stress of the law's remainder, the nominal stress
is P = l S1 - S2 / l^2. With a Prony series S1 and S2 advance in time by the recurrence of `viscoelastic`.
"""

from __future__ import annotations

from dataclasses import dataclass

import ngsolve as ngs
import numpy as np
from ngsolve.meshes import Make1DMesh
from numba import njit
from numpy.typing import NDArray

from morph_dslam.offline.materials.base import Material, evaluate

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
        stress = ngs.Inv(F) * material.remainder(F).Diff(F)
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
            moduli = np.array([evaluate(g) for g in prony.relative_moduli])
            times = np.array([evaluate(tau) for tau in prony.times])
            stress = relaxed_stress(stress, np.asarray(self.time, dtype=float), moduli, times)
        return self.stretch * stress[:, 0] - stress[:, 1] / self.stretch**2


@njit(cache=True, nogil=True)
def relaxed_stress(instantaneous: Array, time: Array, moduli: Array, times: Array) -> Array:
    """Stress (n, k) with a Prony series, from the instantaneous one (n, k) at ``time`` (n,).

    The exponential midpoint rule of `viscoelastic`; the state before the first time is free of stress, and
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
