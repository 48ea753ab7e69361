"""Viscoelasticity over any law: a Prony series.

Finite linear viscoelasticity (Simo, Comput. Methods Appl. Mech. Engrg. 60, 1987; Holzapfel, Nonlinear Solid Mechanics,
2000, section 6.10). The law's constants are the instantaneous ones; with relative moduli g_i and times tau_i the second
Piola-Kirchhoff stress is

    S(t) = g_inf S0(t) + sum_i Q_i(t),   dQ_i/dt + Q_i/tau_i = g_i dS0/dt,   g_inf = 1 - sum_i g_i

with S0 = dW/dE. The volumetric part of W may have relative moduli k_i of its own (0: only the shape relaxes, as in
rubber). `viscous_history` advances the Q_i in time.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import ngsolve as ngs
import numpy as np

from morph_dslam.errors import StudyError
from morph_dslam.mechanics.materials.base import Constant, evaluate


@dataclass(frozen=True, eq=False)
class Prony:
    """A Prony series of relaxation.

    Attributes
    ----------
    relative_moduli : g_i, the parts of the instantaneous stiffness that relax; their sum is below 1.
    times : relaxation times tau_i, s.
    bulk_moduli : k_i, the same of the volumetric part, for laws that have one; None: as g_i, so that the whole law
        relaxes.
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
        """Whether the volumetric part may relax; mixed elements need one that does not, whatever the parameters."""
        return any(not isinstance(k, int | float) or k != 0.0 for k in self.bulk)

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
