"""Isotropic hyperelastic laws."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import ngsolve as ngs

from morph_dslam.offline.materials.base import Constant, Material, lame


@dataclass(frozen=True, kw_only=True, eq=False)
class NeoHookean(Material):
    """Compressible neo-Hookean solid, the paper's law for the boot seal.

    Energy  W = mu/2 (I1 - 3) - mu ln J + lambda/2 (ln J)^2,   I1 = tr F'F, J = det F
    Stress  P = mu (F - F^-T) + lambda ln J F^-T

    Bonet and Wood, Nonlinear Continuum Mechanics for Finite Element Analysis, 2nd ed. 2008, section 6.4.3.

    Attributes
    ----------
    young : Young's modulus at small strain, Pa.
    poisson : Poisson's ratio at small strain.
    """

    young: Constant
    poisson: Constant

    def remainder(self, F: Any) -> Any:
        _, mu = lame(self.young, self.poisson)
        return 0.5 * mu * (ngs.InnerProduct(F, F) - 3.0) - mu * ngs.log(ngs.Det(F))

    def volumetric(self, F: Any) -> Any:
        return ngs.log(ngs.Det(F))

    @property
    def volumetric_modulus(self) -> Constant:
        return lame(self.young, self.poisson)[0]

    def check_constants(self) -> None:
        self.require_positive("young")
        self.require_poisson()
