"""Laws with preferred directions.

A direction is constant, turned by an angle, or one for each cell of the mesh.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, ClassVar, Self

import ngsolve as ngs
import numpy as np

from morph_dslam.errors import StudyError
from morph_dslam.mechanics.materials.base import (
    Array,
    Constant,
    Material,
    evaluate,
    green_lagrange,
    log_volume,
    register_law,
    right_cauchy_green,
)
from morph_dslam.mechanics.materials.isotropic import Rubber, first_invariant

#: (x, y, z) of any length, a vector coefficient function, or an array (n_cells, 3) with a direction for each cell.
Direction = Any


def _numbers(direction: Direction) -> Array:
    """A direction, or one for each cell, that is no coefficient function, as an array; StudyError if it cannot be."""
    try:
        return np.asarray(direction, dtype=float)
    except (TypeError, ValueError) as error:
        given = list(direction) if isinstance(direction, tuple) else direction
        raise StudyError(f"the direction {given} must be three numbers, not all of them zero") from error


def unit_direction(direction: Direction, law: str) -> Any:
    """The direction as a unit vector coefficient function; StudyError if it is zero or no vector."""
    if isinstance(direction, ngs.CoefficientFunction):
        return direction / ngs.Norm(direction)
    vector = _numbers(direction)
    if vector.shape != (3,) or not np.linalg.norm(vector) > 0.0 or not np.all(np.isfinite(vector)):
        raise StudyError(f"{law}: the direction {direction} must be three numbers, not all of them zero")
    return ngs.CF(tuple(vector / np.linalg.norm(vector)))


def turned_direction(angle: Constant, start: tuple[float, ...], towards: tuple[float, ...]) -> Any:
    """cos(angle) start + sin(angle) towards, both made orthonormal first; the angle (rad) may be a parameter.

    Raises StudyError if the two directions are zero or parallel.
    """
    a, b = _numbers(start), _numbers(towards)
    if a.shape != (3,) or b.shape != (3,) or not np.linalg.norm(np.cross(a, b)) > 1e-9 * (a @ a + b @ b):
        raise StudyError(f"a fibre angle turns from {start} towards {towards}: two directions that differ")
    a = a / np.linalg.norm(a)
    b = b - (a @ b) * a
    b = b / np.linalg.norm(b)
    return ngs.cos(ngs.CF(angle)) * ngs.CF(tuple(a)) + ngs.sin(ngs.CF(angle)) * ngs.CF(tuple(b))


def _is_by_cell(direction: Direction) -> bool:
    return not isinstance(direction, ngs.CoefficientFunction) and _numbers(direction).ndim == 2


class Directed(Material):
    """A material with directions; subclasses name the attributes that hold them, orthonormal at a point."""

    #: Attribute of each direction, and what stands for a field where the law is examined without a mesh.
    directions: ClassVar[dict[str, tuple[float, float, float]]]

    def _given(self) -> dict[str, Direction]:
        return {name: getattr(self, name) for name in self.directions if getattr(self, name) is not None}

    def on_mesh(self, cell_field: Callable[[Array], Any]) -> Self:
        by_cell = {name: _numbers(d) for name, d in self._given().items() if _is_by_cell(d)}
        for name, values in by_cell.items():
            if not np.all(np.linalg.norm(values, axis=1) > 0.0):
                raise StudyError(f"{self.name}: the {name} of a cell is zero")
        return replace(self, **{name: cell_field(values) for name, values in by_cell.items()})

    def at_a_point(self) -> Self:
        fields = [n for n, d in self._given().items() if isinstance(d, ngs.CoefficientFunction) or _is_by_cell(d)]
        return replace(self, **{name: self.directions[name] for name in fields})

    def check_constants(self) -> None:
        for direction in self.at_a_point()._given().values():
            unit_direction(direction, self.name)


@register_law("orthotropic")
class Orthotropic(Directed):
    """Orthotropic elasticity in the Green-Lagrange strain: large rotations, small strains.

    Energy  W = 1/2 E : C : E with the nine engineering constants in the axes a1, a2, a3 = a1 x a2
    Stress  P = F S,  S = C : E

    Jones, Mechanics of Composite Materials, 2nd ed. 1999, section 2.4.

    Attributes
    ----------
    young_1 : Young's modulus along the first axis, Pa; young_2 and young_3 likewise.
    poisson_12 : contraction along the second axis under tension along the first; poisson_13 and poisson_23 likewise.
    shear_12 : shear modulus between the first two axes, Pa; shear_13 and shear_23 likewise.
    axis_1 : the first axis.
    axis_2 : the second axis, made orthogonal to the first.
    """

    young_1: Constant
    young_2: Constant
    young_3: Constant
    poisson_12: Constant
    poisson_13: Constant
    poisson_23: Constant
    shear_12: Constant
    shear_13: Constant
    shear_23: Constant
    axis_1: Direction = (1.0, 0.0, 0.0)
    axis_2: Direction = (0.0, 1.0, 0.0)

    directions: ClassVar = {"axis_1": (1.0, 0.0, 0.0), "axis_2": (0.0, 1.0, 0.0)}
    quantities: ClassVar = {"poisson_12": "ratio", "poisson_13": "ratio", "poisson_23": "ratio"}

    def parts(self, F: Any) -> tuple[Any, Any]:
        strain = green_lagrange(F)
        axes = self._axes()
        e = [[a * (strain * b) for b in axes] for a in axes]
        stiffness = self._normal_stiffness()
        normal = sum(stiffness[i][j] * e[i][i] * e[j][j] for i in range(3) for j in range(3))
        shear = self.shear_12 * e[0][1] ** 2 + self.shear_13 * e[0][2] ** 2 + self.shear_23 * e[1][2] ** 2
        return 0.5 * normal + 2.0 * shear, None

    def _axes(self) -> list[Any]:
        first, second = unit_direction(self.axis_1, self.name), unit_direction(self.axis_2, self.name)
        third = ngs.Cross(first, second)
        third = third / ngs.Norm(third)
        return [first, ngs.Cross(third, first), third]

    def _normal_stiffness(self) -> list[list[Constant]]:
        """Inverse of the normal strains' compliance; in closed form, as constants may be parameters."""
        n12, n13, n23 = self.poisson_12, self.poisson_13, self.poisson_23
        young = self.young_1, self.young_2, self.young_3
        n21, n31, n32 = n12 * young[1] / young[0], n13 * young[2] / young[0], n23 * young[2] / young[1]
        det = self._determinant()
        c12, c13, c23 = n21 + n31 * n23, n31 + n21 * n32, n32 + n12 * n31
        c12, c13, c23 = young[0] * c12 / det, young[0] * c13 / det, young[1] * c23 / det
        return [
            [young[0] * (1.0 - n23 * n32) / det, c12, c13],
            [c12, young[1] * (1.0 - n13 * n31) / det, c23],
            [c13, c23, young[2] * (1.0 - n12 * n21) / det],
        ]

    def _determinant(self) -> Constant:
        """Positive for a stable material: 1 - n12 n21 - n23 n32 - n13 n31 - 2 n21 n32 n13."""
        n12, n13, n23 = self.poisson_12, self.poisson_13, self.poisson_23
        ratio_21, ratio_31 = self.young_2 / self.young_1, self.young_3 / self.young_1
        ratio_32 = self.young_3 / self.young_2
        squares = n12**2 * ratio_21 + n23**2 * ratio_32 + n13**2 * ratio_31
        return 1.0 - squares - 2.0 * n12 * n23 * n13 * ratio_31

    def check_constants(self) -> None:
        super().check_constants()
        self.require_positive("young_1", "young_2", "young_3", "shear_12", "shear_13", "shear_23")
        point = self.at_a_point()
        first, second = (unit_direction(axis, self.name) for axis in (point.axis_1, point.axis_2))
        if not evaluate(ngs.Norm(ngs.Cross(first, second))) > 1e-9:
            raise StudyError(f"{self.name}: axis_1 and axis_2 are parallel; give two that span a plane")
        if not evaluate(self._determinant()) > 0.0:
            raise StudyError(
                f"{self.name}: poisson_12 = {evaluate(self.poisson_12):g}, poisson_13 = "
                f"{evaluate(self.poisson_13):g} and poisson_23 = {evaluate(self.poisson_23):g} "
                "are unstable for these Young's moduli; "
                "poisson_ij is the contraction along j under tension along i"
            )


@register_law("transversely_isotropic")
class TransverselyIsotropic(Directed):
    """Neo-Hookean solid with one family of fibres, for finite strains.

    Energy  W = mu/2 (I1 - 3) - mu ln J + lambda/2 (ln J)^2
                + (alpha + beta ln J + gamma (I4 - 1)) (I4 - 1) - alpha/2 (I5 - 1)
            with I4 = a.C a, I5 = a.C^2 a, a the fibre's direction
    Stress  S = mu (1 - C^-1) + (lambda ln J + beta (I4 - 1)) C^-1
                + 2 (alpha + beta ln J + 2 gamma (I4 - 1)) a x a - alpha (a x C a + C a x a)

    Form of Bonet and Burton, Comput. Methods Appl. Mech. Engrg. 162, 1998, who give both Poisson's ratios one
    value; here lambda, mu, alpha, beta, gamma follow from all five small-strain constants. The quadratic
    in I4 takes compression of the fibres too.

    Attributes
    ----------
    young_fibre : Young's modulus along the fibres, Pa.
    young_cross : Young's modulus across them, Pa.
    poisson_fibre : contraction across under tension along the fibres.
    poisson_cross : contraction across under tension across, in the plane of isotropy.
    shear_fibre : shear modulus between the fibres and a direction across, Pa.
    fibre : the fibres' direction.
    """

    young_fibre: Constant
    young_cross: Constant
    poisson_fibre: Constant
    poisson_cross: Constant
    shear_fibre: Constant
    fibre: Direction = (1.0, 0.0, 0.0)

    directions: ClassVar = {"fibre": (1.0, 0.0, 0.0)}
    quantities: ClassVar = {"poisson_fibre": "ratio", "poisson_cross": "ratio"}

    def parts(self, F: Any) -> tuple[Any, Any]:
        mu, alpha, beta, gamma = self._moduli()
        fibre = unit_direction(self.fibre, self.name)
        C, log_J = right_cauchy_green(F), log_volume(F)
        stretched = C * fibre
        i4, i5 = fibre * stretched - 1.0, stretched * stretched - 1.0
        matrix = 0.5 * mu * (ngs.Trace(C) - 3.0) - mu * log_J
        return matrix + (alpha + beta * log_J + gamma * i4) * i4 - 0.5 * alpha * i5, log_J

    @property
    def volumetric_modulus(self) -> Constant:
        return 0.5 * (self.young_cross / self._determinant() - self.young_cross / (1.0 + self.poisson_cross))

    def _determinant(self) -> Constant:
        return 1.0 - self.poisson_cross - 2.0 * self.poisson_fibre**2 * self.young_cross / self.young_fibre

    def _moduli(self) -> tuple[Constant, Constant, Constant, Constant]:
        """mu, alpha, beta, gamma, which give the small-strain stiffness its five independent entries."""
        det, lam = self._determinant(), self.volumetric_modulus
        mu = self.young_cross / (2.0 * (1.0 + self.poisson_cross))
        along = self.young_fibre * (1.0 - self.poisson_cross) / det
        coupling = self.young_cross * self.poisson_fibre / det
        alpha = mu - self.shear_fibre
        beta = 0.5 * (coupling - lam)
        return mu, alpha, beta, (along - lam - 2.0 * mu - 4.0 * beta + 4.0 * alpha) / 8.0

    def check_constants(self) -> None:
        super().check_constants()
        self.require_positive("young_fibre", "young_cross", "shear_fibre")
        if not evaluate(self._determinant()) > 0.0 or not -1.0 < evaluate(self.poisson_cross) < 1.0:
            raise StudyError(
                f"{self.name}: poisson_fibre = {evaluate(self.poisson_fibre):g} and poisson_cross = "
                f"{evaluate(self.poisson_cross):g} are unstable for these moduli: 1 - poisson_cross - "
                "2 poisson_fibre^2 young_cross / young_fibre must be positive"
            )


@register_law("holzapfel_gasser_ogden")
class HolzapfelGasserOgden(Rubber, Directed):
    """Soft tissue: a neo-Hookean matrix with one or two families of dispersed fibres that stiffen in tension.

    Energy  W = mu/2 (I1~ - 3) + sum_f k1/(2 k2) (exp(k2 <E_f>^2) - 1) + kappa/2 (J - 1)^2
            E_f = d I1 + (1 - 3 d) I4_f - 1,  I4_f = a_f.C a_f,  <x> = max(x, 0)
    Stress  fibres: S_f = 2 k1 <E_f> exp(k2 <E_f>^2) (d 1 + (1 - 3 d) a_f x a_f)

    Gasser, Ogden and Holzapfel, J. R. Soc. Interface 3, 2006. The fibres feel the whole deformation rather
    than its volume-preserving part, which would let a nearly incompressible solid swell under fibre tension
    (Nolan, Gower, Destrade, Ogden and McGarry, J. Mech. Behav. Biomed. Mater. 39, 2014).

    Attributes
    ----------
    shear : shear modulus mu of the matrix, Pa.
    k1 : stiffness of the fibres, Pa.
    k2 : how fast they stiffen.
    dispersion : d, 0 for parallel fibres to 1/3 for fibres in all directions alike.
    fibre : direction of the first family.
    fibre_2 : direction of the second, if there is one.
    """

    shear: Constant
    k1: Constant
    k2: Constant
    dispersion: Constant = 0.0
    fibre: Direction = (1.0, 0.0, 0.0)
    fibre_2: Direction | None = None

    directions: ClassVar = {"fibre": (1.0, 0.0, 0.0), "fibre_2": (0.0, 1.0, 0.0)}
    quantities: ClassVar = {"k2": "ratio", "dispersion": "ratio"}

    def distortional(self, F: Any, J: Any) -> Any:
        C = right_cauchy_green(F)
        energy = 0.5 * self.shear * (first_invariant(F, J) - 3.0)
        for direction in self._given().values():
            fibre = unit_direction(direction, self.name)
            stretch = self.dispersion * ngs.Trace(C) + (1.0 - 3.0 * self.dispersion) * (fibre * (C * fibre))
            tension = ngs.IfPos(stretch - 1.0, stretch - 1.0, 0.0)
            energy += 0.5 * self.k1 / self.k2 * (ngs.exp(self.k2 * tension**2) - 1.0)
        return energy

    def check_constants(self) -> None:
        Rubber.check_constants(self)
        Directed.check_constants(self)
        self.require_positive("shear", "k1", "k2")
        if not 0.0 <= evaluate(self.dispersion) <= 1.0 / 3.0:
            raise StudyError(f"{self.name}: dispersion = {evaluate(self.dispersion):g} must lie between 0 and 1/3")
