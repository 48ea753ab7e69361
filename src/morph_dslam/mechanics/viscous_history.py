"""Internal variables of a solid's viscous materials, advanced in time at its quadrature points.

The convolution of `materials.viscoelastic` is advanced by the exponential midpoint rule (Holzapfel, Nonlinear Solid
Mechanics, 2000, equation 6.281)

    Q_i = e_i^2 Q_i_old + g_i e_i (S0 - S0_old),   e_i = exp(-dt / (2 tau_i))

which is exact while the strain rests and of second order otherwise. In each step S is then the derivative of an
incremental potential, so that NGSolve differentiates viscous laws as it does elastic ones:

    W_step(F) = (g_inf + sum_i g_i e_i) W(F) + H : E,   H = sum_i e_i^2 Q_i_old - g_i e_i S0_old

The Q_i belong to the g_i and tau_i that they were made with: a path along which these change is refused.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import ngsolve as ngs
import numpy as np
from numpy.typing import NDArray

from morph_dslam.errors import SolverError, StudyError
from morph_dslam.mechanics.materials.base import Material
from morph_dslam.mechanics.materials.viscoelastic import Prony
from morph_dslam.mechanics.ngsolve_mesh import corner_monomials
from morph_dslam.mechanics.parameters import ParameterSymbols, Scalar
from morph_dslam.mechanics.solid_materials import MaterialRegion
from morph_dslam.mechanics.spaces import DisplacementSpace

Array = NDArray[np.float64]
_CORNERS = {ngs.TET: 4, ngs.PRISM: 6, ngs.HEX: 8}


class ViscousHistory:
    """Steps from the last accepted solution to the present parameters.

    Raises StudyError if there is no time, or a material in mixed form relaxes in volume.

    Parameters
    ----------
    space : of the displacements.
    regions : the materials; at least one of them viscous.
    time : expression of the parameters that is the time, s.
    symbols : the parameters.

    Attributes
    ----------
    regions : the same materials, with the stress left from earlier steps.
    rules : quadrature rules that energies must be integrated with.
    """

    def __init__(
        self,
        space: DisplacementSpace,
        regions: Sequence[MaterialRegion],
        time: Scalar | None,
        symbols: ParameterSymbols,
    ) -> None:
        if time is None:
            raise StudyError("a material is viscous: say which parameter is the time")
        series = [region.material.prony for region in regions if region.material.prony]
        for region in regions:
            prony = region.material.prony
            if region.pressures and prony and prony.bulk_relaxes:
                raise StudyError(
                    f"{region.material.name}: in mixed elements only the shape may relax; "
                    "set the Prony bulk_moduli to zeros"
                )
        self._mesh, self._time, self._symbols = space.geometry.ngs, time, symbols
        self._accepted = ngs.Parameter(symbols.value(time))
        self._step = time - self._accepted
        self._points = ngs.comp.IntegrationRuleSpace(self._mesh, order=space.order)
        self.rules = self._points.GetIntegrationRules()
        self._tensors = ngs.MatrixValued(self._points, dim=3)
        # Q_i of each term, then the instantaneous stresses of the remainder and of the volumetric part.
        self._overstress = [self._field() for _ in range(max(len(prony.times) for prony in series))]
        self._instant = [self._field(), self._field()]
        self._constants = [c for prony in series for c in (*prony.relative_moduli, *prony.times, *prony.bulk)]
        self._remembers: list[float] | None = None
        self.regions = [self._with_memory(region) for region in regions]

    def _field(self) -> ngs.GridFunction:
        return ngs.GridFunction(self._tensors)

    def _with_memory(self, region: MaterialRegion) -> MaterialRegion:
        prony = region.material.prony
        if prony is None:
            return region
        remembered = _zero()
        for g, k, decay, overstress in self._terms(prony):
            remembered += decay**2 * overstress - decay * (g * self._instant[0] + k * self._instant[1])
        return replace(region, factors=prony.step_factors(self._step), remembered=remembered)

    def _terms(self, prony: Prony) -> Iterator[tuple[Any, Any, Any, Any]]:
        decays = prony.decays(self._step)
        return zip(prony.relative_moduli, prony.bulk, decays, self._overstress, strict=False)

    def check_time(self) -> None:
        """Refuse to step back in time (SolverError)."""
        step = self._symbols.value(self._time) - self._accepted.Get()
        if step < 0.0:
            raise SolverError(
                f"the time goes back by {-step:g} s from the last accepted solution; "
                "a viscous solid can only be followed forwards"
            )

    def advance(self, F: Any) -> None:
        """Accept the solution with the deformation gradient ``F``, at the present parameters.

        Raises StudyError if a Prony series has changed since the last solution that was accepted.
        """
        constants = [self._symbols.value(constant) for constant in self._constants]
        if self._remembers is not None and self._remembers != constants:
            raise StudyError(
                "a Prony series changes along a path of solutions: begin another path for each series, or lead to its "
                "beginning with remember=False"
            )
        self._remembers = constants
        stresses = {id(region): _instant_stresses(region.material, F) for region in self.regions}
        new = [self._interpolated(lambda region, part=part: stresses[id(region)][part]) for part in (0, 1)]
        count = len(self._overstress)
        updated = [self._interpolated(lambda region, i=i: self._new_overstress(region, i, new)) for i in range(count)]
        for field, values in zip(self._overstress + self._instant, updated + new, strict=True):
            field.vec.data = values.vec
        self._accepted.Set(self._symbols.value(self._time))

    def _new_overstress(self, region: MaterialRegion, i: int, new: list[Any]) -> Any:
        prony = region.material.prony
        if prony is None or i >= len(prony.times):
            return _zero()
        g, k, decay, overstress = list(self._terms(prony))[i]
        change = g * (new[0] - self._instant[0]) + k * (new[1] - self._instant[1])
        return decay**2 * overstress + decay * change

    def _interpolated(self, of_region: Callable[[MaterialRegion], Any]) -> ngs.GridFunction:
        field = self._field()
        by_name = {name: of_region(region) for region in self.regions for name in _names(region.region)}
        field.Interpolate(self._mesh.MaterialCF(by_name))
        return field

    def values(self) -> Array:
        """All internal variables and, last, the time they belong to."""
        fields = self._overstress + self._instant
        return np.append(np.concatenate([field.vec.FV().NumPy() for field in fields]), self._accepted.Get())

    def restore(self, values: Array) -> None:
        """Return to what `values` gave; zeros are the state that has rested for ever, at time 0."""
        fields = self._overstress + self._instant
        for field, part in zip(fields, np.split(np.asarray(values[:-1]), len(fields)), strict=True):
            field.vec.FV().NumPy()[:] = part
        self._accepted.Set(float(values[-1]))
        self._remembers = None

    @contextmanager
    def at_rest(self, mu: Array) -> Iterator[None]:
        """Remember, for a while, a body that has rested for ever until the parameters ``mu`` (d,), which are set."""
        remembered, series = self.values(), self._remembers
        self._symbols.set(mu)
        self.restore(np.append(np.zeros(len(remembered) - 1), self._symbols.value(self._time)))
        try:
            yield
        finally:
            self.restore(remembered)
            self._remembers = series

    def remembered_at(self, points: NDArray) -> Array:
        """Stress left from earlier steps at NGSolve's mesh points: second Piola-Kirchhoff (p, 3, 3), Pa.

        Within each cell, the field with a value for each corner that fits the quadrature points best.
        """
        field = self._interpolated(lambda region: _zero() if region.remembered is None else region.remembered)
        values = field.vec.FV().NumPy().reshape(9, -1).T
        result = np.empty((len(points), 9))
        elements, which = np.unique(points["nr"], return_inverse=True)
        ids = [ngs.ElementId(ngs.VOL, int(e)) for e in elements]
        kinds = np.array([self._mesh[i].type for i in ids])
        dofs = [np.array(self._points.GetDofNrs(i)) for i in ids]
        for kind in set(kinds):
            of_kind = np.flatnonzero(kinds == kind)
            source = np.array(self.rules[kind].points)
            count = _CORNERS[kind] if len(source) > 1 else 1
            fit = np.linalg.pinv(corner_monomials(count, source))
            coefficients = np.einsum("tq,eqc->etc", fit, values[np.array([dofs[e] for e in of_kind])])
            rows = np.flatnonzero(np.isin(which, of_kind))
            target = np.column_stack([points[axis][rows] for axis in "xyz"])
            local = np.searchsorted(of_kind, which[rows])
            result[rows] = np.einsum("pt,ptc->pc", corner_monomials(count, target), coefficients[local])
        return result.reshape(-1, 3, 3)


def _instant_stresses(material: Material, F: Any) -> tuple[Any, Any]:
    """Instantaneous second Piola-Kirchhoff stresses (3x3) of the remainder and of the volumetric part."""
    F = F.MakeVariable()
    remainder, strain = material.parts(F)
    first = (ngs.Inv(F) * remainder.Diff(F)).Compile()
    if material.volumetric_modulus is None:
        return first, _zero()
    return first, (ngs.Inv(F) * (0.5 * material.volumetric_modulus * strain**2).Diff(F)).Compile()


def _zero() -> Any:
    return ngs.CF((0.0,) * 9, dims=(3, 3))


def _names(region: ngs.Region) -> list[str]:
    """NGSolve's names of the materials in a region."""
    inside = np.array(region.Mask(), dtype=bool)
    return [name for name, chosen in zip(region.mesh.GetMaterials(), inside, strict=True) if chosen]
