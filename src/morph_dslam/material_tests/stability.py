"""Where a law is stable: Drucker's inequality for an incompressible solid in the usual tests."""

from __future__ import annotations

import ngsolve as ngs
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import root_scalar

from morph_dslam.material_tests.nominal_stress import KINDS, fields_in_cells
from morph_dslam.mechanics.materials.base import Material

Array = NDArray[np.float64]
#: Stretches of each kind of test that are looked at.
_STRETCHES = 60
#: A stiffness this much below zero, over the largest in the same state, is no rounding.
_ROUNDING = 1e-9


def first_unstable_stretches(material: Material, most: float) -> dict[str, float]:
    """Kind of test -> the stretch nearest to 1 at which a law is unstable; stable kinds are left out.

    A law is stable where every small further strain needs work (Drucker's inequality, as finite element programs check
    it): the Hessian of its energy in two logarithmic principal stretches, the third being minus their sum, is positive
    definite. Compression of a bar is equal tension of a sheet in two directions, so that tension alone is looked at.

    Parameters
    ----------
    material : a law whose remainder is its distortional energy.
    most : the largest first invariant that is looked at.
    """
    found = {}
    for kind, powers in KINDS.items():
        stretch = stretches_up_to(kind, most)
        strains = np.log(stretch)[:, None] * np.array(powers[:2])
        lowest, largest = np.linalg.eigvalsh(_hessians(material, strains)).T
        # Not a number, beyond the limit of a law, is unstable too.
        unstable = ~(lowest > -_ROUNDING * np.abs(largest))
        if unstable.any():
            found[kind] = float(stretch[np.argmax(unstable)])
    return found


def stretches_up_to(kind: str, most: float) -> Array:
    """(n,) stretches of a kind of test, from a little above 1 to a first invariant of ``most``."""
    powers = np.array(KINDS[kind])

    def beyond(logarithm: float) -> float:
        return float(np.sum(np.exp(2.0 * logarithm * powers))) - most

    # I1 is at least the square of the measured stretch.
    largest = np.exp(root_scalar(beyond, bracket=(0.0, 0.5 * np.log(most))).root)
    return np.geomspace(1.0, largest, _STRETCHES + 1)[1:]


def _hessians(material: Material, strains: Array) -> Array:
    """(n, 2, 2) of the energy, Pa, at logarithmic principal stretches (n, 2)."""
    fields, points = fields_in_cells(strains)
    logs = ngs.CF(tuple(fields)).MakeVariable()
    first, second = ngs.exp(logs[0]), ngs.exp(logs[1])
    F = ngs.CF((first, 0, 0, 0, second, 0, 0, 0, 1.0 / (first * second)), dims=(3, 3))
    hessian = material.parts(F)[0].Diff(logs).Diff(logs).Compile()
    return np.asarray(hessian(points)).reshape(-1, 2, 2)
