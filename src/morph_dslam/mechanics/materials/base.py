"""Directions of fibres and material axes: constant, turned by an angle, or one for each cell of a mesh."""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from dataclasses import dataclass, fields, is_dataclass
from functools import cache
from typing import TYPE_CHECKING, Any, Self

import ngsolve as ngs
import numpy as np
from ngsolve.meshes import Make1DMesh
from numpy.typing import NDArray

from morph_dslam.errors import StudyError

if TYPE_CHECKING:
    from morph_dslam.mechanics.materials.viscoelastic import Prony


#: (x, y, z) of any length, a vector coefficient function, or the name of a field that a mesh will give.
Direction = Any


def unit_direction(direction: Direction, law: str) -> Any:
    """The direction as a unit vector coefficient function.

    Raises
    ------
    StudyError : the direction is zero, is not a vector, or is a name that nobody has given a field for.
    """
    if isinstance(direction, str):
        raise StudyError(f"{law} needs the field of directions '{direction}', but the mesh gives none of that name")
    if not isinstance(direction, ngs.CoefficientFunction):
        vector = np.asarray(direction, dtype=float)
        if vector.shape != (3,) or not np.linalg.norm(vector) > 0.0 or not np.all(np.isfinite(vector)):
            raise StudyError(f"{law}: the direction {direction} must be three numbers, not all of them zero")
        return ngs.CF(tuple(vector / np.linalg.norm(vector)))
    return direction / ngs.Norm(direction)


def turned_direction(angle: Constant, start: tuple[float, ...], towards: tuple[float, ...]) -> Any:
    """cos(angle) start + sin(angle) towards, both made orthonormal first; the angle (rad) may be a parameter.

    Raises
    ------
    StudyError : the two directions are zero or parallel.
    """
    a, b = np.asarray(start, dtype=float), np.asarray(towards, dtype=float)
    if a.shape != (3,) or b.shape != (3,) or not np.linalg.norm(np.cross(a, b)) > 1e-9 * (a @ a + b @ b):
        raise StudyError(f"a fibre angle turns from {start} towards {towards}: two directions that differ")
    a = a / np.linalg.norm(a)
    b = b - (a @ b) * a
    b = b / np.linalg.norm(b)
    return ngs.cos(ngs.CF(angle)) * ngs.CF(tuple(a)) + ngs.sin(ngs.CF(angle)) * ngs.CF(tuple(b))


def cell_directions(mesh: ngs.Mesh, directions: NDArray[np.float64]) -> ngs.GridFunction:
    """A field that is constant in each cell, from directions (n_cells, 3) in the mesh's own order of cells.

    Raises
    ------
    StudyError : there is not one direction, other than zero, for each cell.
    """
    directions = np.asarray(directions, dtype=float)
    if directions.shape != (mesh.ne, 3):
        raise StudyError(
            f"fibre directions must be an array ({mesh.ne}, 3), one for each cell, but it is {directions.shape}"
        )
    lengths = np.linalg.norm(directions, axis=1)
    if not np.all(lengths > 0.0):
        raise StudyError(f"the fibre direction of cell {int(np.argmin(lengths))} is zero")
    field = ngs.GridFunction(ngs.L2(mesh, order=0) ** 3)
    for component, values in zip(field.components, (directions / lengths[:, None]).T, strict=True):
        component.vec.FV().NumPy()[:] = values
    return field


# What every material offers to the solvers.
# A material is its strain-energy density W(F), in joule per cubic metre of the undeformed solid; stresses
# and tangents are derivatives of W and are never written by hand. So that nearly incompressible solids can be
# solved without locking, W is split:
#     W(F) = remainder(F) + K/2 g(F)^2
# with g the volumetric strain and K its modulus. The displacement form uses W; the mixed form uses
# remainder(F) + p g(F) - p^2 / (2 K), whose stationary value in the pressure p is W.


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

    @abstractmethod
    def parts(self, F: Any) -> tuple[Any, Any]:
        """Remainder of the energy, Pa, and volumetric strain g (None without a split); the law itself.

        F is a 3x3 coefficient function. Both come from one call so that they share what they have in common:
        NGSolve evaluates a shared expression once.
        """

    def remainder(self, F: Any) -> Any:
        """Strain energy without the volumetric part, Pa; F is a 3x3 coefficient function."""
        return self.parts(F)[0]

    def volumetric(self, F: Any) -> Any:
        """Volumetric strain g(F): zero where the volume is unchanged. Most laws use ln J or J - 1."""
        return self.parts(F)[1]

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
        """The law's name in study files and messages: its class in snake case."""
        return law_name(type(self))

    @property
    def fibres(self) -> tuple[str, ...]:
        """Names of the fibre fields that the law still waits for; `with_fibres` gives them."""
        return ()

    def with_fibres(self, fields: dict[str, Any]) -> Material:
        """The law with the named fields of directions filled in, each a vector coefficient function (3)."""
        return self

    def at_a_point(self) -> Self:
        """The law with any field of directions replaced by constant ones, to examine it without a mesh."""
        return self

    def small_strain_stiffness(self) -> Array:
        """Stiffness (6, 6) at F = 1, Pa, in Voigt's order with engineering shears."""
        F = ngs.Id(3).MakeVariable()
        # Derivatives by the whole of F share their sub-expressions; directional ones grow exponentially.
        slope = evaluate(self.at_a_point().energy(F).Diff(F).Diff(F)).reshape(3, 3, 3, 3)
        stiffness = np.empty((6, 6))
        for row, (i, j) in enumerate(VOIGT):
            for column, (k, m) in enumerate(VOIGT):
                stiffness[row, column] = 0.25 * (
                    slope[i, j, k, m] + slope[j, i, k, m] + slope[i, j, m, k] + slope[j, i, m, k]
                )
        return stiffness

    @property
    def equivalent_poisson(self) -> float:
        """Poisson's ratio at small strain (Voigt's average over directions for anisotropic laws)."""
        bulk, shear = isotropic_average(self.small_strain_stiffness())
        return float((3.0 * bulk - 2.0 * shear) / (2.0 * (3.0 * bulk + shear)))

    def check(self) -> None:
        """Refuse constants that make the undeformed solid unstable; parameters at their present values.

        Raises
        ------
        StudyError : a constant is not finite, or some small strain would lower the energy.
        """
        for name, constant in self.constants().items():
            if not np.all(np.isfinite(evaluate(constant))):
                raise StudyError(f"{self.name}: {name} is not a finite number")
        if evaluate(self.density) < 0.0:
            raise StudyError(f"{self.name}: density = {evaluate(self.density):g} must not be negative")
        self.check_constants()
        if self.prony is not None:
            self.prony.check()
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

    def require_poisson(self, name: str = "poisson") -> None:
        """Refuse an isotropic Poisson's ratio outside of (-1, 0.5), StudyError."""
        value = evaluate(getattr(self, name))
        if not -1.0 < value < 0.5:
            raise StudyError(
                f"{self.name}: {name} = {value:g} must lie between -1 and 0.5 "
                "(0.4999 for a nearly incompressible solid, in mixed elements)"
            )


def law_name(law: type[Material]) -> str:
    """`NeoHookean` is `neo_hookean` in a study file."""
    return re.sub(r"(?<!^)(?=[A-Z])", "_", law.__name__).lower()


def _is_constant(value: Any) -> bool:
    if isinstance(value, ngs.CoefficientFunction):
        return value.dim == 1
    return isinstance(value, (int, float))


def isotropic_average(stiffness: Array) -> tuple[float, float]:
    """Bulk and shear modulus of the average of a stiffness (6, 6) over all orientations (Voigt 1889)."""
    bulk = stiffness[:3, :3].sum() / 9.0
    normal, shear = np.trace(stiffness[:3, :3]), np.trace(stiffness[3:, 3:])
    return float(bulk), float((normal - 3.0 * bulk + 2.0 * shear) / 10.0)


def lame(young: Constant, poisson: Constant) -> tuple[Constant, Constant]:
    """Lame's constants lambda and mu (the shear modulus), Pa, from Young's modulus and Poisson's ratio."""
    shear = young / (2.0 * (1.0 + poisson))
    return young * poisson / ((1.0 + poisson) * (1.0 - 2.0 * poisson)), shear


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
