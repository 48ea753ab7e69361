"""The clock and the internal variables of a solid's viscous materials, at its quadrature points."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import ngsolve as ngs
import numpy as np
from numpy.typing import NDArray

from morph_dslam.errors import SolverError, StudyError
from morph_dslam.offline.materials.viscoelastic import ViscousState
from morph_dslam.offline.mechanics.displacement_space import DisplacementSpace
from morph_dslam.offline.mechanics.parameters import ParameterSymbols, Scalar
from morph_dslam.offline.mechanics.solid_materials import MaterialRegion

Array = NDArray[np.float64]


class SolidHistory:
    """Steps from the last accepted solution to the present parameters.

    Parameters
    ----------
    regions : the materials; at least one of them viscous.
    time : expression of the parameters that is the time, s.

    Attributes
    ----------
    regions : the same materials, with what they remember.
    rules : quadrature rules that energies must be integrated with.

    Raises
    ------
    StudyError
        If there is no time, or a material in mixed form relaxes in volume.
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
        for region in regions:
            prony = region.material.prony
            if region.pressures and prony and prony.bulk_relaxes:
                raise StudyError(
                    f"{region.material.name}: in mixed elements only the shape may relax; "
                    "set the Prony bulk_moduli to zeros"
                )
        self._mesh, self._time, self._symbols = space.geometry.ngs, time, symbols
        names = [_names(region.region) for region in regions]
        materials = {name: r.material for group, r in zip(names, regions, strict=True) for name in group}
        self._state = ViscousState(self._mesh, materials, order=space.order)
        self._accepted = ngs.Parameter(symbols.value(time))
        self._state.time_step = self._time - self._accepted
        self.rules = self._state.rules
        self.regions = [
            self._with_memory(region, group[0]) for region, group in zip(regions, names, strict=True)
        ]
        remembered = {name: self._remembered(name) for name in materials}
        self._all_remembered = self._mesh.MaterialCF(remembered)

    def _with_memory(self, region: MaterialRegion, name: str) -> MaterialRegion:
        if region.material.prony is None:
            return region
        factors = region.material.prony.step_factors(self._state.time_step)
        return replace(region, factors=factors, remembered=self._state.remembered(name))

    def _remembered(self, name: str) -> Any:
        if self._state.materials[name].prony is None:
            return ngs.CF((0.0,) * 9, dims=(3, 3))
        return self._state.remembered(name)

    def check_time(self) -> None:
        """Refuse to step back in time (SolverError)."""
        step = self._symbols.value(self._time) - self._accepted.Get()
        if step < 0.0:
            raise SolverError(
                f"the time goes back by {-step:g} s from the last accepted solution; "
                "a viscous solid can only be followed forwards"
            )

    def advance(self, deformation_gradient: Any) -> None:
        """Accept the solution with this deformation gradient, at the present parameters."""
        self._state.advance(deformation_gradient)
        self._accepted.Set(self._symbols.value(self._time))

    def values(self) -> Array:
        """All internal variables and, last, the time they belong to."""
        return np.append(self._state.values(), self._accepted.Get())

    def restore(self, values: Array) -> None:
        """Return to what `values` gave."""
        self._state.restore(values[:-1])
        self._accepted.Set(float(values[-1]))

    def remembered_at(self, points: NDArray) -> Array:
        """Remembered second Piola-Kirchhoff stress (p, 3, 3), Pa, at NGSolve's mesh points.

        Within each cell, the field with a value for each corner that fits the quadrature points best.
        """
        space = ngs.comp.IntegrationRuleSpace(self._mesh, order=self._state.order)
        field = ngs.GridFunction(ngs.MatrixValued(space, dim=3))
        field.Interpolate(self._all_remembered)
        values = field.vec.FV().NumPy().reshape(9, -1).T
        result = np.empty((len(points), 9))
        elements, which = np.unique(points["nr"], return_inverse=True)
        kinds = np.array([self._mesh[ngs.ElementId(ngs.VOL, int(e))].type for e in elements])
        dofs = [np.array(space.GetDofNrs(ngs.ElementId(ngs.VOL, int(e)))) for e in elements]
        for kind in set(kinds):
            of_kind = np.flatnonzero(kinds == kind)
            source = np.array(self.rules[kind].points)
            fit = np.linalg.pinv(_corner_monomials(kind, source)) if len(source) > 1 else np.ones((1, 1))
            coefficients = np.einsum("tq,eqc->etc", fit, values[np.array([dofs[e] for e in of_kind])])
            rows = np.flatnonzero(np.isin(which, of_kind))
            target = np.column_stack([points[axis][rows] for axis in "xyz"])
            functions = _corner_monomials(kind, target)[:, : coefficients.shape[1]]
            local = np.searchsorted(of_kind, which[rows])
            result[rows] = np.einsum("pt,ptc->pc", functions, coefficients[local])
        return result.reshape(-1, 3, 3)


def _names(region: ngs.Region) -> list[str]:
    """NGSolve's names of the materials in a region."""
    inside = np.array(region.Mask(), dtype=bool)
    return [name for name, chosen in zip(region.mesh.GetMaterials(), inside, strict=True) if chosen]


def _corner_monomials(kind: Any, points: Array) -> Array:
    """As many monomials (p, t) as the reference element of NGSolve's ``kind`` has corners."""
    x, y, z = points.T
    terms = [np.ones_like(x), x, y, z, x * z, y * z, x * y, x * y * z]
    return np.column_stack(terms[: {ngs.TET: 4, ngs.PRISM: 6, ngs.HEX: 8}[kind]])
