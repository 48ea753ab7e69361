"""Elastic plane-stress materials of a shell, any of their constants a function of parameters."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import ngsolve as ngs
import numpy as np

from morph_dslam.errors import StudyError
from morph_dslam.mechanics.materials.base import evaluate
from morph_dslam.mechanics.parameters import Scalar

#: A direction whose part along the surface is smaller than this says nothing there.
ALONG = 0.1


@dataclass(frozen=True, eq=False)
class ShellMaterial:
    """Orthotropic plane stress: large rotations, small strains.

    The fibres run along the given direction, projected on the surface. Strains are the compliance times the stresses:

        E11 = S11 / E1 - nu S22 / E1,   E22 = S22 / E2 - nu S11 / E1,   2 E12 = S12 / G

    Jones, Mechanics of Composite Materials, 2nd ed. 1999, section 2.5.

    Attributes
    ----------
    young_fibre : Young's modulus E1 along the fibres, Pa.
    young_cross : Young's modulus E2 across them, Pa.
    poisson : contraction across under tension along the fibres, nu_12.
    shear : shear modulus G_12, Pa.
    density : kg/m3; None where there is no weight.
    fibre : direction of the fibres before it is projected: three numbers, or a vector of expressions.
    fibre_angle : turns the projected direction about the surface's normal, rad, anticlockwise seen from its tip.
    """

    young_fibre: Scalar
    young_cross: Scalar
    poisson: Scalar
    shear: Scalar
    density: Scalar | None = None
    fibre: tuple[float, float, float] = (1.0, 0.0, 0.0)
    fibre_angle: Scalar = 0.0

    def check(self) -> None:
        """Refuse constants that are unstable, or a negative density, at the parameters' present values (StudyError)."""
        names = ("young_fibre", "young_cross", "shear")
        values = {name: evaluate(getattr(self, name)) for name in (*names, "poisson")}
        for name in names:
            if not values[name] > 0.0:
                raise StudyError(f"{name} = {1e-6 * values[name]:.4g} MPa must be positive")
        if values["poisson"] ** 2 * values["young_cross"] >= values["young_fibre"]:
            raise StudyError(
                f"poisson = {values['poisson']:g} is unstable for these moduli: "
                "poisson^2 * young_cross / young_fibre must be below 1"
            )
        if self.density is not None and not (value := evaluate(self.density)) >= 0.0:
            raise StudyError(f"density = {value:g} must not be negative")
        if not np.linalg.norm(self.fibre) > 0.0:
            raise StudyError(f"the fibre {tuple(self.fibre)} has no direction")

    @property
    def next_axis(self) -> int:
        """The axis that takes the place of the given direction where this says nothing on the surface."""
        return (int(np.argmax(np.abs(self.fibre))) + 1) % 3

    def outside(self, normal: Any) -> Any:
        """Positive where the given direction is more than about 6 degrees off this unit ``normal``."""
        return ngs.Norm(_projected(self.fibre, normal)) / float(np.linalg.norm(self.fibre)) - ALONG

    def frame(self, normal: Any) -> tuple[Any, Any]:
        """Unit vectors along and across the fibres on a surface with this unit ``normal``.

        Where the given direction is within about 6 degrees of the normal, it is the next of the axes x, y and z,
        cyclically from its largest component.
        """
        other = np.eye(3)[self.next_axis]
        along = ngs.IfPos(self.outside(normal), _projected(self.fibre, normal), _projected(other, normal))
        along = along / ngs.Norm(along)
        across = ngs.Cross(normal, along)
        if isinstance(self.fibre_angle, (int, float)) and self.fibre_angle == 0.0:
            return along, across
        c, s = ngs.cos(self.fibre_angle), ngs.sin(self.fibre_angle)
        return c * along + s * across, c * across - s * along

    def complementary_energy(self, s11: Any, s22: Any, s12: Any) -> Any:
        """1/2 S : compliance : S of a stress in the frame along and across the fibres."""
        direct = (s11 * s11 - 2.0 * self.poisson * s11 * s22) / self.young_fibre + s22 * s22 / self.young_cross
        return 0.5 * (direct + s12 * s12 / self.shear)


def _projected(direction: Iterable[float], normal: Any) -> Any:
    """The part of a direction (3,) along the surface with this unit normal."""
    given = ngs.CF(tuple(float(x) for x in direction))
    return given - (given * normal) * normal


def isotropic(young: Scalar, poisson: Scalar, **others: Any) -> ShellMaterial:
    """An isotropic material of a shell; ``others`` as `ShellMaterial`.

    Raises StudyError if ``young`` is not positive or ``poisson`` is not above -1 and at most 0.5, at the parameters'
    present values.
    """
    if not (value := evaluate(young)) > 0.0:
        raise StudyError(f"young = {1e-6 * value:.4g} MPa must be positive")
    # 0.5 is no limit of plane stress, where the thickness gives way, but no stable isotropic solid is beyond it.
    if not -1.0 < (value := evaluate(poisson)) <= 0.5:
        raise StudyError(f"poisson = {value:.4g} must be above -1 and at most 0.5")
    return ShellMaterial(young, young, poisson, young / (2.0 * (1.0 + poisson)), **others)


def components(tensor: Any, along: Any, across: Any) -> tuple[Any, Any, Any]:
    """(T11, T22, T12) of a tangential symmetric tensor (3x3) in a local frame."""
    return (tensor * along) * along, (tensor * across) * across, (tensor * along) * across
