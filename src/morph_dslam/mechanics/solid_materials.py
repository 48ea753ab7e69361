"""Which material each cell has, and in which form its energy is written."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import ngsolve as ngs
import numpy as np
from numpy.typing import NDArray

from morph_dslam.errors import SolverError, StudyError
from morph_dslam.mechanics.materials.base import Material, green_lagrange
from morph_dslam.mechanics.materials.viscoelastic import ViscousState
from morph_dslam.mechanics.parameters import ParameterSymbols, Scalar
from morph_dslam.mechanics.spaces import DisplacementSpace, PressureSpace, check_mixed
from morph_dslam.meshing.meshes import Mesh

Array = NDArray[np.float64]

#: Poisson's ratio from which plain displacement elements lock noticeably.
NEARLY_INCOMPRESSIBLE = 0.49


class NearlyIncompressibleWarning(UserWarning):
    """A nearly incompressible material in elements that lock."""


@dataclass(frozen=True)
class MaterialRegion:
    """A material, where it is, and its pressure.

    Attributes
    ----------
    pressures : None in the displacement form.
    pressure_unit : Pa; makes pressure unknowns about as large as displacements in metres.
    flag : what results must be doubted for; empty if nothing.
    factors : of remainder and volumetric part, in a step of a viscous material.
    remembered : second Piola-Kirchhoff stress (3x3), Pa, that a viscous material remembers, at the points of
        its quadrature rules; see `solid_history`.
    """

    material: Material
    region: ngs.Region
    pressures: PressureSpace | None = None
    pressure_unit: float = 0.0
    flag: str = ""
    factors: tuple[Any, Any] = (1.0, 1.0)
    remembered: Any | None = None

    def pressure(self, unknowns: list[Any]) -> Any | None:
        """Pressure (Pa, positive in tension) of the functions of its space; None in the displacement form."""
        return None if self.pressures is None else self.pressure_unit * self.pressures.combine(unknowns)

    def energy(self, F: Any, pressure: Any | None) -> Any:
        """Strain energy density, Pa; in the mixed form, the density whose stationary value it is."""
        energy = self.elastic_energy(F, pressure)
        return energy if self.remembered is None else energy + self.remembered_energy(F)

    def elastic_energy(self, F: Any, pressure: Any | None) -> Any:
        """`energy` without what the material remembers."""
        if pressure is None and self.remembered is None:
            return self.material.energy(F)
        (shear, bulk), modulus = self.factors, self.material.volumetric_modulus
        remainder, g = self.material.parts(F)
        remainder = shear * remainder
        if modulus is None or g is None:
            return remainder
        if pressure is None:
            return remainder + 0.5 * bulk * modulus * g**2
        return remainder + pressure * g - pressure * pressure / (2.0 * modulus)

    def remembered_energy(self, F: Any) -> Any:
        """Work of the remembered stress."""
        return ngs.InnerProduct(self.remembered, green_lagrange(F))


def owners_of_cells(mesh: Mesh, materials: Mapping[str, Material]) -> NDArray[np.int64]:
    """Position (n_cells,) in ``materials`` of each cell's; "all" takes the cells that no other set names.

    Raises
    ------
    StudyError
        If a set is unknown, or a cell has no material or two.
    """
    owners = np.full(mesh.n_cells, -1, dtype=np.int64)
    names = list(materials)
    for name in sorted(names, key=lambda name: name == "all"):
        cells = mesh.cells(name)
        taken = cells[owners[cells] >= 0]
        if name == "all":
            cells = cells[owners[cells] < 0]
        elif len(taken):
            other = names[owners[taken[0]]]
            raise StudyError(f"{len(taken)} cells are in both '{other}' and '{name}', each with a material")
        owners[cells] = names.index(name)
    if (owners < 0).any():
        raise StudyError(
            f"{int((owners < 0).sum())} of {len(owners)} cells have no material; "
            "give one to their cell set, or one to 'all'"
        )
    return owners


def place_materials(
    space: DisplacementSpace,
    owners: NDArray[np.int64],
    materials: Mapping[str, Material],
    directions: Mapping[str, Array],
    mixed: bool,
) -> list[MaterialRegion]:
    """A region for each material that has cells, in the order of ``materials``.

    Parameters
    ----------
    owners : of `owners_of_cells`.
    directions : fibre fields by name, one direction for each cell (n_cells, 3).
    mixed : use the mixed form for materials that have a volumetric part.

    Raises
    ------
    StudyError
        If a material is unstable or lacks its fibres, or the cells have no mixed form.
    """
    geometry = space.geometry
    fields = {name: geometry.cell_field(field) for name, field in directions.items()}
    regions = geometry.partition(owners)
    result = []
    for number, (name, material) in enumerate(materials.items()):
        if number in regions:
            material = material.with_fibres(fields) if material.fibres else material
            result.append(_material_region(space, name, material, regions[number], mixed))
    return result


def _material_region(
    space: DisplacementSpace, name: str, material: Material, region: ngs.Region, mixed: bool
) -> MaterialRegion:
    try:
        material.check()
    except StudyError as error:
        raise StudyError(f"material of '{name}': {error}") from error
    if mixed and material.volumetric_modulus is not None:
        mesh = space.geometry.mesh
        check_mixed(mesh, space.order)
        unit = material.small_strain_stiffness()[3, 3] / float(np.linalg.norm(np.ptp(mesh.nodes, axis=0)))
        return MaterialRegion(material, region, PressureSpace(space, region), unit)
    poisson = material.equivalent_poisson
    if poisson < NEARLY_INCOMPRESSIBLE:
        return MaterialRegion(material, region)
    flag = (
        f"the material of '{name}' is nearly incompressible (Poisson's ratio {poisson:.4f}) "
        "in displacement elements, which lock; use mixed elements"
    )
    warnings.warn(flag, NearlyIncompressibleWarning, stacklevel=4)
    return MaterialRegion(material, region, flag=flag)


# The clock and the internal variables of a solid's viscous materials, at its quadrature points.


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
        self.regions = [self._with_memory(region, group[0]) for region, group in zip(regions, names, strict=True)]
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
