"""Nominal stress of a law in the tests whose strain is uniform.

The solid is taken as incompressible, as rubber, silicone and gels nearly are. At stretch l its principal stretches are
powers of l whatever the law, and the pressure is eliminated by the direction that is free of stress: with S1 and S3 the
second Piola-Kirchhoff stress of the law's remainder along the pull and along the free direction, the nominal stress
is P = l S1 - S3 l3^2 / l (Holzapfel, Nonlinear Solid Mechanics, 2000, section 6.5). With a Prony series S1 and S3 are
convolved with the relaxation; a test without times is so slow that all has relaxed. The stretch goes straight from row
to row of a test, however far apart they are.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import ngsolve as ngs
import numpy as np
from ngsolve.meshes import Make1DMesh
from numba import njit
from numpy.typing import NDArray

from morph_dslam.errors import IdentificationError
from morph_dslam.mechanics.materials.base import Material

Array = NDArray[np.float64]
#: Between two rows, the instantaneous stress is taken as straight over no more than this change of log stretch. A power
#: a of the stretch is off by (0.01 a)^2 / 8 there: 0.1 % for a law as steep as the tenth power.
_STRAIGHT = 0.01
#: The principal stretches of each kind of test as powers of the measured one; the third direction is free of stress.
KINDS = {"uniaxial": (1.0, -0.5, -0.5), "biaxial": (1.0, 1.0, -2.0), "planar": (1.0, 0.0, -1.0)}


@dataclass(frozen=True, eq=False)
class MaterialTest:
    """One test on one specimen.

    Attributes
    ----------
    name : for reports.
    stretch : (n,) deformed over undeformed length.
    stress : (n,) nominal stress, force over undeformed section, Pa.
    time : (n,) s, increasing; the specimen has rested before the first, and its stretch changes evenly from one to the
        next. None: so slow that a material with a Prony series has relaxed in each row.
    kind : "uniaxial" (tension or compression of a bar), "biaxial" (equal in two directions), or "planar" (tension of
        a wide strip that keeps its width, also called pure shear).

    Raises
    ------
    IdentificationError
        If the arrays do not match, a value is not finite, a stretch is not above zero, the time does not increase,
        nothing is stressed, or there is no such kind.
    """

    name: str
    stretch: Array
    stress: Array
    time: Array | None = None
    kind: str = "uniaxial"

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise IdentificationError(f"{self.name}: '{self.kind}' is no kind of test; give {', '.join(KINDS)}")
        columns = [self.stretch, self.stress] + ([] if self.time is None else [self.time])
        if len({np.shape(column) for column in columns}) > 1 or np.ndim(self.stretch) != 1:
            raise IdentificationError(f"{self.name}: give as many stresses and times as stretches")
        if not all(np.isfinite(column).all() for column in columns):
            raise IdentificationError(f"{self.name}: a value is not a finite number")
        if not np.all(np.asarray(self.stretch) > 0.0):
            raise IdentificationError(
                f"{self.name}: a stretch of {np.min(self.stretch):g} is not above zero; it is deformed over undeformed "
                "length, 1 at rest (a strain is 0 there)"
            )
        if self.time is not None and not np.all(np.diff(self.time) > 0.0):
            raise IdentificationError(f"{self.name}: the time must increase from line to line")
        if not np.any(self.stress):
            raise IdentificationError(f"{self.name}: no stress is other than zero")

    @property
    def principal_stretches(self) -> Array:
        """(n, 3) stretches along the pull, across it, and in the direction that is free."""
        return _principal(self.stretch, self.kind)

    @property
    def first_invariant(self) -> Array:
        """(n,) I1, the sum of the squared principal stretches."""
        return np.square(self.principal_stretches).sum(axis=1)


def _principal(stretch: Array, kind: str) -> Array:
    """(n, 3) principal stretches in that kind of test at each ``stretch`` (n,)."""
    return np.asarray(stretch)[:, None] ** np.array(KINDS[kind])


def fields_in_cells(values: Array) -> tuple[list[Any], Any]:
    """A field for each column of ``values`` (n, k), constant in n cells, and the points of a mesh in these cells.

    So one evaluation of an expression of the fields, at the points, carries all rows through.
    """
    n = len(values)
    mesh = Make1DMesh(n)
    fields = []
    for column in values.T:
        field = ngs.GridFunction(ngs.L2(mesh, order=0))
        field.vec.FV().NumPy()[:] = column
        fields.append(field)
    return fields, mesh((np.arange(n) + 0.5) / n)


def largest_invariant(tests: Sequence[MaterialTest]) -> float:
    """The largest first invariant that was measured."""
    return max(float(test.first_invariant.max()) for test in tests)


class NominalStress:
    """Nominal stress of a law in a test; the law's parameters may change between calls.

    Parameters
    ----------
    material : a law whose remainder is its distortional energy, as the rubber laws are.
    test : its kind, stretches and times; not its stress.
    """

    def __init__(self, material: Material, test: MaterialTest) -> None:
        self.material = material
        self.stretch = np.asarray(test.stretch, dtype=float)
        self._free = test.principal_stretches[:, 2]
        self._time: Array | None = None
        computed = self.stretch
        if test.time is not None and material.prony is not None:
            computed, self._time, self._rows = _with_steps(self.stretch, np.asarray(test.time, dtype=float))
        (first, second, third), self._points = fields_in_cells(_principal(computed, test.kind))
        F = ngs.CF((first, 0, 0, 0, second, 0, 0, 0, third), dims=(3, 3)).MakeVariable()
        stress = ngs.Inv(F) * material.parts(F)[0].Diff(F)
        self._components = ngs.CF((stress[0, 0], stress[2, 2])).Compile()

    def __call__(self) -> Array:
        """(n,) nominal stress, Pa."""
        stress = np.asarray(self._components(self._points))
        prony = self.material.prony
        if prony is not None:
            moduli, times = (
                np.array([ngs.CF(value)(self._points)[0, 0] for value in values])
                for values in (prony.relative_moduli, prony.times)
            )
            if self._time is None:
                stress = (1.0 - moduli.sum()) * stress
            else:
                stress = relaxed_stress(stress, self._time, moduli, times)[self._rows]
        return self.stretch * stress[:, 0] - stress[:, 1] * self._free**2 / self.stretch


def _with_steps(stretch: Array, time: Array) -> tuple[Array, Array, NDArray[np.int64]]:
    """Stretches and times (m,) with steps between rows (n,) that strain much, and the places (n,) of the rows."""
    steps = np.maximum(np.ceil(np.abs(np.diff(np.log(stretch))) / _STRAIGHT), 1.0).astype(np.int64)
    rows = np.concatenate([[0], np.cumsum(steps)])
    at = np.arange(rows[-1] + 1)
    return np.interp(at, rows, stretch), np.interp(at, rows, time), rows


@njit(cache=True, nogil=True)
def relaxed_stress(instantaneous: Array, time: Array, moduli: Array, times: Array) -> Array:
    """Stress (n, k) with a Prony series, from the instantaneous one (n, k) at ``time`` (n,).

    The convolution of `materials.viscoelastic`, exact for an instantaneous stress that is straight from one time to the
    next: where S0 has a constant rate, the solution of dQ/dt + Q/tau = g dS0/dt is
    Q = exp(-dt/tau) Q_old + g (S0 - S0_old) (1 - exp(-dt/tau)) tau/dt. The state before the first time is free of
    stress, and the first step is instantaneous.

    Parameters
    ----------
    instantaneous : (n, k) second Piola-Kirchhoff stress of the law, Pa.
    time : (n,) increasing, s.
    moduli : (m,) relative moduli.
    times : (m,) relaxation times, s.
    """
    n, k = instantaneous.shape
    overstress, stress, viscous = np.empty((len(moduli), k)), np.empty((n, k)), 0.0
    for i in range(len(moduli)):
        viscous += moduli[i]
    for c in range(k):
        stress[0, c] = instantaneous[0, c]
        for i in range(len(moduli)):
            overstress[i, c] = moduli[i] * instantaneous[0, c]
    for j in range(1, n):
        for c in range(k):
            stress[j, c] = (1.0 - viscous) * instantaneous[j, c]
        for i in range(len(moduli)):
            step = (time[j] - time[j - 1]) / times[i]
            decay, kept = math.exp(-step), -math.expm1(-step) / step
            for c in range(k):
                change = instantaneous[j, c] - instantaneous[j - 1, c]
                overstress[i, c] = decay * overstress[i, c] + moduli[i] * kept * change
                stress[j, c] += overstress[i, c]
    return stress


def relative_error(measured: Array, computed: Array) -> float:
    """Root mean square difference over the root mean square of what was measured."""
    difference = np.asarray(computed) - np.asarray(measured)
    return float(np.linalg.norm(difference) / np.linalg.norm(measured))
