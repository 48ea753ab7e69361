"""Visco-hyperelasticity: a Prony series over any law, with internal variables advanced in time.

Finite linear viscoelasticity (Simo, Comput. Methods Appl. Mech. Engrg. 60, 1987; Holzapfel, Nonlinear Solid
Mechanics, 2000, section 6.10). The law's constants are the instantaneous ones; with relative moduli g_i and
times tau_i the second Piola-Kirchhoff stress is

    S(t) = g_inf S0(t) + sum_i Q_i(t),   dQ_i/dt + Q_i/tau_i = g_i dS0/dt,   g_inf = 1 - sum_i g_i

with S0 = dW/dE. The convolution is advanced by the exponential midpoint rule (Holzapfel, equation 6.281)

    Q_i = e_i^2 Q_i_old + g_i e_i (S0 - S0_old),   e_i = exp(-dt / (2 tau_i))

which is exact while the strain rests and of second order otherwise. In each step S is then the derivative of
an incremental potential, so that NGSolve differentiates viscous laws as it does elastic ones:

    W_step(F) = (g_inf + sum_i g_i e_i) W(F) + H : E,   H = sum_i e_i^2 Q_i_old - g_i e_i S0_old

The volumetric part of W may have relative moduli k_i of its own (0: only the shape relaxes, as in rubber).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import ngsolve as ngs
import numpy as np
from ngsolve.comp import IntegrationRuleSpace
from numpy.typing import NDArray

from morph_dslam.errors import StudyError
from morph_dslam.mechanics.materials.base import Constant, Material, evaluate, green_lagrange

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Prony:
    """A Prony series of relaxation.

    Attributes
    ----------
    relative_moduli : g_i, the parts of the instantaneous stiffness that relax; their sum is below 1.
    times : relaxation times tau_i, s.
    bulk_moduli : k_i, the same of the volumetric part; None: as g_i, so that the whole law relaxes.
    """

    relative_moduli: tuple[Constant, ...]
    times: tuple[Constant, ...]
    bulk_moduli: tuple[Constant, ...] | None = None

    @property
    def bulk(self) -> tuple[Constant, ...]:
        """k_i, whether given or as g_i."""
        return self.relative_moduli if self.bulk_moduli is None else self.bulk_moduli

    @property
    def bulk_relaxes(self) -> bool:
        """Whether the volumetric part relaxes; mixed elements need one that does not."""
        return any(evaluate(k) != 0.0 for k in self.bulk)

    def decays(self, time_step: Any) -> list[Any]:
        """e_i = exp(-dt / (2 tau_i))."""
        return [ngs.exp(-0.5 * time_step / ngs.CF(tau)) for tau in self.times]

    def step_factors(self, time_step: Any) -> tuple[Any, Any]:
        """What multiplies the remainder and the volumetric part in the incremental potential."""
        shear, bulk = ngs.CF(1.0), ngs.CF(1.0)
        for g, k, decay in zip(self.relative_moduli, self.bulk, self.decays(time_step), strict=True):
            shear -= g * (1.0 - decay)
            bulk -= k * (1.0 - decay)
        return shear, bulk

    def check(self) -> None:
        """Refuse a series that is no relaxation.

        Raises
        ------
        StudyError : lists of different lengths, a time or a modulus out of range, or moduli that sum to 1.
        """
        if not len(self.relative_moduli) == len(self.times) == len(self.bulk) > 0:
            raise StudyError(
                "a Prony series needs as many relative moduli as times, but there are "
                f"{len(self.relative_moduli)} and {len(self.times)}"
            )
        if not all(0.0 < evaluate(tau) < np.inf for tau in self.times):
            raise StudyError(f"the Prony times {[evaluate(t) for t in self.times]} must be positive, in seconds")
        for name, moduli in (("relative_moduli", self.relative_moduli), ("bulk_moduli", self.bulk)):
            values = [evaluate(g) for g in moduli]
            if not all(0.0 <= g < 1.0 for g in values) or not sum(values) < 1.0:
                raise StudyError(
                    f"the Prony {name} {values} must be fractions of the instantaneous stiffness, "
                    "at least 0, with a sum below 1 so that some stiffness remains"
                )


class ViscousState:
    """The internal variables of the viscous materials on a mesh, at the points of its integration rules.

    The solver uses it thus: the density of each region is `energy(region, F)`, integrated with `rules`; after
    each converged time step `advance` is called with the deformation gradient of the solution. `time_step`,
    in seconds, may be changed before any step, or be replaced by an expression before energies are made.

    Parameters
    ----------
    mesh : the mesh.
    materials : region (name of the mesh's material) -> law; those without a series stay elastic.
    order : order of the integration rules.
    """

    def __init__(self, mesh: ngs.Mesh, materials: dict[str, Material], order: int) -> None:
        self.mesh, self.materials, self.order = mesh, materials, order
        self.time_step = ngs.Parameter(0.0)
        series = [m.prony for m in materials.values() if m.prony is not None]
        if not series:
            raise StudyError("none of the materials is viscous: give at least one of them a Prony series")
        points = IntegrationRuleSpace(mesh, order=order)
        #: Rules to integrate the energies with: `energy * ngs.dx(region, intrules=state.rules)`.
        self.rules = points.GetIntegrationRules()
        self._values = ngs.MatrixValued(points, dim=3)
        # Q_i of each term, then the instantaneous stresses of the remainder and of the volumetric part.
        self._overstress = [ngs.GridFunction(self._values) for _ in range(max(len(p.times) for p in series))]
        self._instant = [ngs.GridFunction(self._values) for _ in range(2)]

    def energy(self, region: str, F: Any) -> Any:
        """Incremental potential of a region for the present `time_step`, Pa."""
        material = self.materials[region]
        if material.prony is None:
            return material.energy(F)
        shear, bulk = material.prony.step_factors(self.time_step)
        remainder, strain = material.parts(F)
        energy = shear * remainder + ngs.InnerProduct(self.remembered(region), green_lagrange(F))
        if material.volumetric_modulus is not None:
            energy += 0.5 * bulk * material.volumetric_modulus * strain**2
        return energy

    def remembered(self, region: str) -> Any:
        """H (3x3), Pa: the second Piola-Kirchhoff stress that a viscous region keeps from earlier steps."""
        prony = self.materials[region].prony
        assert prony is not None
        remembered = ngs.CF(tuple([0.0] * 9), dims=(3, 3))
        for g, k, decay, overstress in self._terms(prony):
            remembered += decay**2 * overstress - decay * (g * self._instant[0] + k * self._instant[1])
        return remembered

    def first_piola_kirchhoff(self, region: str, F: Any) -> Any:
        """P (3x3), Pa, in the step that ends at F; to be asked before `advance`."""
        F = F.MakeVariable()
        return self.energy(region, F).Diff(F).Compile()

    def advance(self, F: Any) -> None:
        """Accept the step that ends at F, a coefficient function of the solution."""
        instant = {region: _instant_stresses(m, F) for region, m in self.materials.items()}
        new = [self._interpolated(lambda region, part=part: instant[region][part]) for part in (0, 1)]
        updated = []
        for i in range(len(self._overstress)):
            updated.append(self._interpolated(lambda region, i=i: self._new_overstress(region, i, new)))
        for field, values in zip(self._overstress + self._instant, updated + new, strict=True):
            field.vec.data = values.vec

    def _new_overstress(self, region: str, i: int, new: list[Any]) -> Any:
        prony = self.materials[region].prony
        if prony is None or i >= len(prony.times):
            return ngs.CF(tuple([0.0] * 9), dims=(3, 3))
        g, k, decay, overstress = list(self._terms(prony))[i]
        change = g * (new[0] - self._instant[0]) + k * (new[1] - self._instant[1])
        return decay**2 * overstress + decay * change

    def _terms(self, prony: Prony) -> Any:
        decays = prony.decays(self.time_step)
        return zip(prony.relative_moduli, prony.bulk, decays, self._overstress, strict=False)

    def _interpolated(self, of_region: Any) -> ngs.GridFunction:
        field = ngs.GridFunction(self._values)
        values = {region: of_region(region) for region in self.materials}
        field.Interpolate(self.mesh.MaterialCF(values))
        return field

    def values(self) -> Array:
        """A copy of all internal variables, for `restore`."""
        return np.concatenate([f.vec.FV().NumPy() for f in self._overstress + self._instant])

    def restore(self, values: Array) -> None:
        """Return to internal variables that `values` gave; zeros are the state that has rested for ever."""
        fields = self._overstress + self._instant
        for field, part in zip(fields, np.split(np.asarray(values), len(fields)), strict=True):
            field.vec.FV().NumPy()[:] = part


def _instant_stresses(material: Material, F: Any) -> tuple[Any, Any]:
    """Instantaneous second Piola-Kirchhoff stresses (3x3) of the remainder and of the volumetric part."""
    F = F.MakeVariable()
    parts = [material.remainder(F)]
    if material.volumetric_modulus is not None:
        parts.append(0.5 * material.volumetric_modulus * material.volumetric(F) ** 2)
    stresses = [(ngs.Inv(F) * part.Diff(F)).Compile() for part in parts]
    if len(stresses) == 1:
        stresses.append(ngs.CF(tuple([0.0] * 9), dims=(3, 3)))
    return stresses[0], stresses[1]
