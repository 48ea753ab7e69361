"""Isotropic laws with Young's modulus and Poisson's ratio."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import ngsolve as ngs

from morph_dslam.offline.materials.base import Constant, Material, green_lagrange, lame, log_volume


@dataclass(frozen=True, kw_only=True, eq=False)
class _Lame(Material):
    """A law whose two constants are Young's modulus and Poisson's ratio.

    Attributes
    ----------
    young : Young's modulus at small strain, Pa.
    poisson : Poisson's ratio at small strain.
    """

    young: Constant
    poisson: Constant

    @property
    def shear(self) -> Constant:
        """Shear modulus mu at small strain, Pa."""
        return lame(self.young, self.poisson)[1]

    @property
    def volumetric_modulus(self) -> Constant:
        """Lame's lambda, Pa."""
        return lame(self.young, self.poisson)[0]

    def check_constants(self) -> None:
        self.require_positive("young")
        self.require_poisson()


@dataclass(frozen=True, kw_only=True, eq=False)
class NeoHookean(_Lame):
    """Compressible neo-Hookean solid, the paper's law for the boot seal.

    Energy  W = mu/2 (I1 - 3) - mu ln J + lambda/2 (ln J)^2,   I1 = tr F'F, J = det F
    Stress  P = mu (F - F^-T) + lambda ln J F^-T

    Bonet and Wood, Nonlinear Continuum Mechanics for Finite Element Analysis, 2nd ed. 2008, section 6.4.3.
    """

    def parts(self, F: Any) -> tuple[Any, Any]:
        log_J = log_volume(F)
        return self.shear * (0.5 * (ngs.InnerProduct(F, F) - 3.0) - log_J), log_J


@dataclass(frozen=True, kw_only=True, eq=False)
class StVenantKirchhoff(_Lame):
    """St Venant-Kirchhoff solid: Hooke's law in the Green-Lagrange strain E = (F'F - 1)/2.

    Energy  W = mu E:E + lambda/2 (tr E)^2
    Stress  P = F S,  S = 2 mu E + lambda tr(E) 1

    For large rotations and small strains: it softens under strong compression and fails at a stretch of 0.58
    (Ciarlet, Mathematical Elasticity I, 1988, section 3.9).
    """

    def parts(self, F: Any) -> tuple[Any, Any]:
        strain = green_lagrange(F)
        return self.shear * ngs.InnerProduct(strain, strain), ngs.Trace(strain)


@dataclass(frozen=True, kw_only=True, eq=False)
class LinearElastic(_Lame):
    """Hooke's law in the small strain e = sym(F - 1), for small strains and small rotations only.

    Energy  W = mu e:e + lambda/2 (tr e)^2
    Stress  P = 2 mu e + lambda tr(e) 1

    A rotation counts as strain here; use `StVenantKirchhoff` where anything turns.
    Timoshenko and Goodier, Theory of Elasticity, 3rd ed. 1970, section 6.
    """

    def parts(self, F: Any) -> tuple[Any, Any]:
        strain = ngs.Sym(F) - ngs.Id(3)
        return self.shear * ngs.InnerProduct(strain, strain), ngs.Trace(strain)
