"""What every material law offers to the solvers, and the registry of laws.

A law is its strain-energy density W(F), in joule per cubic metre of the undeformed solid; stresses and tangents are
derivatives of W and are never written by hand. So that nearly incompressible solids can be solved without locking, W
is split:

    W(F) = remainder(F) + K/2 g(F)^2

with g the volumetric strain and K its modulus. The displacement form uses W; the mixed form uses
remainder(F) + p g(F) - p^2 / (2 K), whose stationary value in the pressure p is W.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, fields, is_dataclass
from functools import cache
from typing import TYPE_CHECKING, Any, ClassVar, Self, TypeVar, dataclass_transform

import ngsolve as ngs
import numpy as np
from ngsolve.meshes import Make1DMesh
from numpy.typing import NDArray

from morph_dslam.errors import ArgumentError, StudyError
from morph_dslam.units import FACTORS

if TYPE_CHECKING:
    from morph_dslam.mechanics.materials.viscoelastic import Prony

Array = NDArray[np.float64]
#: A material constant: a number, or an NGSolve parameter (or an expression of some) that a study varies.
Constant = Any
#: Voigt's order of the components of a symmetric tensor.
VOIGT = ((0, 0), (1, 1), (2, 2), (1, 2), (0, 2), (0, 1))


@dataclass(frozen=True, kw_only=True, eq=False)
class Material(ABC):
    """Base of all laws.

    Attributes
    ----------
    density : kg/m3 in the undeformed solid; weight and inertia need it.
    prony : viscoelasticity over the law, whose constants are then the instantaneous ones.
    """

    density: Constant = 0.0
    prony: Prony | None = None

    #: Name in study files and messages; `register_law` sets it.
    law: ClassVar[str] = ""
    #: What constants measure that are neither stresses nor the density, as in `units.FACTORS`.
    quantities: ClassVar[dict[str, str]] = {}

    @abstractmethod
    def parts(self, F: Any) -> tuple[Any, Any]:
        """Remainder of the energy, Pa, and volumetric strain g (None without a split): the law itself.

        F is a 3x3 coefficient function. Both come from one call so that they share what they have in common:
        NGSolve evaluates a shared expression once.
        """

    @property
    def volumetric_modulus(self) -> Constant | None:
        """Modulus K of the volumetric part, Pa; None for a law that has no such split."""
        return None

    def energy(self, F: Any) -> Any:
        """Strain energy per undeformed volume, Pa; F is a 3x3 coefficient function."""
        remainder, strain = self.parts(F)
        if self.volumetric_modulus is None:
            return remainder
        return remainder + 0.5 * self.volumetric_modulus * strain**2

    def first_piola_kirchhoff(self, F: Any) -> Any:
        """P = dW/dF (3x3), Pa, of the law without its viscosity; F must not be a trial function."""
        F = F.MakeVariable()
        return self.energy(F).Diff(F).Compile()

    @property
    def name(self) -> str:
        """Name in messages."""
        return self.law or type(self).__name__

    def on_mesh(self, cell_field: Callable[[Array], Any]) -> Self:
        """The law with directions given cell by cell as fields of a mesh, which ``cell_field`` makes."""
        return self

    def at_a_point(self) -> Self:
        """The law with any field of directions replaced by constant ones, to examine it without a mesh."""
        return self

    def small_strain_stiffness(self) -> Array:
        """Stiffness (6, 6) at F = 1, Pa, in Voigt's order with engineering shears."""
        F = ngs.Id(3).MakeVariable()
        # Derivatives by the whole of F share their sub-expressions; directional ones grow exponentially.
        slope = evaluate(self.at_a_point().energy(F).Diff(F).Diff(F)).reshape(3, 3, 3, 3)
        symmetric = 0.25 * (slope + slope.swapaxes(0, 1) + slope.swapaxes(2, 3) + slope.swapaxes(0, 1).swapaxes(2, 3))
        rows, columns = np.transpose(VOIGT)
        return symmetric[rows, columns][:, rows, columns]

    @property
    def equivalent_poisson(self) -> float:
        """Poisson's ratio at small strain (Voigt's average over directions for anisotropic laws)."""
        bulk, shear = isotropic_average(self.small_strain_stiffness())
        return float((3.0 * bulk - 2.0 * shear) / (2.0 * (3.0 * bulk + shear)))

    def check(self) -> None:
        """Refuse constants that make the undeformed solid unstable; parameters at their present values.

        Raises StudyError if a constant is not finite, some small strain would lower the energy, or a Prony series has
        moduli for a part that the law has not.
        """
        for name, constant in self.constants().items():
            if not np.all(np.isfinite(evaluate(constant))):
                raise StudyError(f"{self.name}: {name} is not a finite number")
        if evaluate(self.density) < 0.0:
            raise StudyError(f"{self.name}: density = {evaluate(self.density):g} must not be negative")
        self.check_constants()
        if self.prony is not None:
            self.prony.check()
            if self.prony.bulk_moduli is not None and self.volumetric_modulus is None:
                raise StudyError(
                    f"{self.name} has no volumetric part that bulk_moduli could be of: leave them out of its prony, "
                    "so that the whole stress relaxes by relative_moduli"
                )
        stiffness = self.small_strain_stiffness()
        lowest = np.linalg.eigvalsh(0.5 * (stiffness + stiffness.T))[0]
        if not lowest > 0.0:
            raise StudyError(
                f"{self.name} is unstable with these constants: a small strain has the negative stiffness "
                f"{lowest:g} Pa; check their signs, units and Poisson's ratios"
            )

    def check_constants(self) -> None:
        """Refuse single constants that are out of range, with a message that names them (StudyError)."""
        return

    def constants(self) -> dict[str, Constant]:
        """The numbers and parameters of the law by name, density included."""
        assert is_dataclass(self)
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        return {name: value for name, value in values.items() if _is_constant(value)}

    def require_positive(self, *names: str) -> None:
        """Refuse constants that are not above zero (StudyError)."""
        for name in names:
            value = evaluate(getattr(self, name))
            if not value > 0.0:
                raise StudyError(f"{self.name}: {name} = {value:g} must be positive")


_Law = TypeVar("_Law", bound=type[Material])
_LAWS: dict[str, type[Material]] = {}


@dataclass_transform(kw_only_default=True, frozen_default=True)
def register_law(name: str) -> Callable[[_Law], _Law]:
    """Decorator that makes a class a law which studies can name: ``law = "name"``.

    The class derives from `Material`, or from `Rubber` if its bulk modulus is a constant of its own, and becomes a
    frozen dataclass. Its fields are the constants, keyword-only; those that are no stresses are named in `quantities`.

        @register_law("demiray")
        class Demiray(Rubber):
            mu: Constant
            exponent: Constant
            quantities: ClassVar = {"exponent": "ratio"}

            def distortional(self, F, J):
                growth = ngs.exp(self.exponent * (first_invariant(F, J) - 3.0)) - 1.0
                return 0.5 * self.mu / self.exponent * growth

    A law of your own replaces another one of the same name.

    Raises
    ------
    ArgumentError
        If a built-in law has this name, or the class lacks a method of a law or names a quantity that there is not.
    """

    def register(law: _Law) -> _Law:
        _check_law(name, law)
        made = dataclass(frozen=True, kw_only=True, eq=False)(law)
        made.law = name
        _LAWS[name] = made
        return made

    return register


def _check_law(name: str, law: type[Material]) -> None:
    """Raise ArgumentError unless studies can name and make this law."""
    if not _is_built_in(law):
        from morph_dslam.mechanics.materials.library import laws  # which imports this module

        if name in laws() and _is_built_in(laws()[name]):
            raise ArgumentError(f"'{name}' is a built-in law: register yours by another name")
    if missing := sorted(getattr(law, "__abstractmethods__", ())):
        raise ArgumentError(f"the law '{name}' has no method {missing[0]}: define it in the class {law.__name__}")
    for constant, quantity in law.quantities.items():
        if quantity not in FACTORS:
            raise ArgumentError(
                f"the law '{name}' has quantities = {{'{constant}': '{quantity}'}}: give one of {', '.join(FACTORS)}"
            )


def _is_built_in(law: type[Material]) -> bool:
    return law.__module__.startswith(f"{__package__}.")


def registered_laws() -> dict[str, type[Material]]:
    """The laws registered so far, by name; `library.law_named` knows those of this package too."""
    return dict(_LAWS)


def _is_constant(value: Any) -> bool:
    if isinstance(value, ngs.CoefficientFunction):
        return value.dim == 1
    return isinstance(value, (int, float))


def isotropic_average(stiffness: Array) -> tuple[float, float]:
    """Bulk and shear modulus of the average of a stiffness (6, 6) over all orientations (Voigt 1889)."""
    bulk = stiffness[:3, :3].sum() / 9.0
    normal, shear = np.trace(stiffness[:3, :3]), np.trace(stiffness[3:, 3:])
    return float(bulk), float((normal - 3.0 * bulk + 2.0 * shear) / 10.0)


@cache
def _unit_mesh() -> ngs.Mesh:
    return Make1DMesh(1)


def evaluate(coefficient: Any) -> Any:
    """Value of a number or of a coefficient function that is constant in space: a float or an array (k,)."""
    if isinstance(coefficient, (int, float)):
        return float(coefficient)
    # Only the evaluation of many points at once runs compiled code.
    value = ngs.CF(coefficient).Compile()(_unit_mesh()(np.array([0.5])))[0]
    return float(value[0]) if value.size == 1 else value


def positive_or_nan(x: Any) -> Any:
    """x where it is positive, elsewhere not a number, and its derivatives neither.

    The derivative of ln x is finite for negative x too, so an inverted cell would pass for a sound one.
    """
    return ngs.IfPos(x, x, np.nan)


def log_volume(F: Any) -> Any:
    """ln det F; not a number in an inverted cell, nor are its derivatives."""
    return ngs.log(positive_or_nan(ngs.Det(F)))


def right_cauchy_green(F: Any) -> Any:
    """C = F'F."""
    return F.trans * F


def green_lagrange(F: Any) -> Any:
    """E = (F'F - 1)/2."""
    return 0.5 * (F.trans * F - ngs.Id(3))
