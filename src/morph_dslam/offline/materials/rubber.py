"""Rubber laws in the invariants of the volume-preserving deformation.

Each is a distortional energy in I1~ = J^(-2/3) I1 and I2~ = J^(-4/3) I2 plus kappa/2 (J - 1)^2, kappa being
the bulk modulus. The distortional part is the `remainder`, so all of them serve mixed elements. Rubber's bulk
modulus is some thousand times its shear modulus.
"""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass
from typing import Any

import ngsolve as ngs

from morph_dslam.offline.materials.base import Constant, Material, positive_or_nan, right_cauchy_green


@dataclass(frozen=True, kw_only=True, eq=False)
class Rubber(Material):
    """A law with a separate volumetric energy kappa/2 (J - 1)^2.

    Attributes
    ----------
    bulk : bulk modulus kappa, Pa.
    """

    bulk: Constant

    @abstractmethod
    def distortional(self, F: Any, J: Any) -> Any:
        """Energy of the change of shape, Pa; J = det F."""

    def parts(self, F: Any) -> tuple[Any, Any]:
        J = ngs.Det(F)
        return self.distortional(F, J), J - 1.0

    @property
    def volumetric_modulus(self) -> Constant:
        return self.bulk

    def check_constants(self) -> None:
        self.require_positive("bulk")


def first_invariant(F: Any, J: Any) -> Any:
    """I1~ = J^(-2/3) tr C, 3 without distortion."""
    return J ** (-2.0 / 3.0) * ngs.InnerProduct(F, F)


def second_invariant(F: Any, J: Any) -> Any:
    """I2~ = J^(-4/3) (tr(C)^2 - C:C)/2, 3 without distortion."""
    C = right_cauchy_green(F)
    return J ** (-4.0 / 3.0) * 0.5 * (ngs.Trace(C) ** 2 - ngs.InnerProduct(C, C))


@dataclass(frozen=True, kw_only=True, eq=False)
class MooneyRivlin(Rubber):
    """Mooney-Rivlin rubber; c01 = 0 makes it the volume-split neo-Hookean law.

    Energy  W = c10 (I1~ - 3) + c01 (I2~ - 3) + kappa/2 (J - 1)^2
    Stress  incompressible uniaxial: P = 2 (1 - l^-3) (c10 l + c01)
    Shear modulus 2 (c10 + c01).

    Mooney, J. Appl. Phys. 11, 1940; Rivlin and Saunders, Phil. Trans. R. Soc. A 243, 1951.

    Attributes
    ----------
    c10, c01 : Pa.
    """

    c10: Constant
    c01: Constant = 0.0

    def distortional(self, F: Any, J: Any) -> Any:
        return self.c10 * (first_invariant(F, J) - 3.0) + self.c01 * (second_invariant(F, J) - 3.0)


@dataclass(frozen=True, kw_only=True, eq=False)
class Yeoh(Rubber):
    """Yeoh rubber: a cubic in the first invariant, for filled rubbers and large strains.

    Energy  W = sum_i ci0 (I1~ - 3)^i + kappa/2 (J - 1)^2,  i = 1, 2, 3
    Stress  incompressible uniaxial: P = 2 (l - l^-2) (c10 + 2 c20 (I1 - 3) + 3 c30 (I1 - 3)^2)
    Shear modulus 2 c10.

    Yeoh, Rubber Chemistry and Technology 66, 1993.

    Attributes
    ----------
    c10, c20, c30 : Pa.
    """

    c10: Constant
    c20: Constant = 0.0
    c30: Constant = 0.0

    def distortional(self, F: Any, J: Any) -> Any:
        x = first_invariant(F, J) - 3.0
        return x * (self.c10 + x * (self.c20 + x * self.c30))


@dataclass(frozen=True, kw_only=True, eq=False)
class Gent(Rubber):
    """Gent rubber: neo-Hookean whose chains lock where I1~ - 3 reaches the limit Jm.

    Energy  W = -mu Jm/2 ln(1 - (I1~ - 3)/Jm) + kappa/2 (J - 1)^2
    Stress  incompressible uniaxial: P = mu Jm (l - l^-2) / (Jm - I1 + 3)

    Gent, Rubber Chemistry and Technology 69, 1996. Beyond the limit energy and stress are not a number, and
    the solver shortens its step.

    Attributes
    ----------
    shear : shear modulus mu at small strain, Pa.
    limit : Jm, the value of I1~ - 3 at which the chains are fully stretched.
    """

    shear: Constant
    limit: Constant

    def distortional(self, F: Any, J: Any) -> Any:
        left = positive_or_nan(1.0 - (first_invariant(F, J) - 3.0) / self.limit)
        return -0.5 * self.shear * self.limit * ngs.log(left)

    def check_constants(self) -> None:
        self.require_positive("shear", "limit", "bulk")
