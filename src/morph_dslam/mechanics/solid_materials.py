"""Which material each cell has, and in which form its energy is written."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import ngsolve as ngs
import numpy as np
from numpy.typing import NDArray

from morph_dslam.errors import StudyError
from morph_dslam.mechanics.materials.base import Material, evaluate, green_lagrange
from morph_dslam.mechanics.ngsolve_mesh import NgsolveMesh
from morph_dslam.mechanics.spaces import DisplacementSpace, PressureSpace, check_mixed, has_mixed_form
from morph_dslam.meshing.meshes import Mesh

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
    remembered : second Piola-Kirchhoff stress (3x3), Pa, left from earlier steps of a viscous material, at the points
        of its quadrature rules; see `viscous_history`.
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
        if self.remembered is None:
            return energy
        return energy + ngs.InnerProduct(self.remembered, green_lagrange(F))

    def energy_and_strain(self, F: Any, strain: Any) -> tuple[Any, Any]:
        """Energy density (Pa) with the volumetric ``strain`` e given, and g: see `enhanced_assembly`.

        remainder + K (e g - e^2 / 2), whose stationary value in e is the energy; the material must pass `can_be_mixed`.
        """
        remainder, g = self.material.parts(F)
        energy = self.factors[0] * remainder + self.material.volumetric_modulus * strain * (g - 0.5 * strain)
        if self.remembered is not None:
            energy = energy + ngs.InnerProduct(self.remembered, green_lagrange(F))
        return energy, g

    def elastic_energy(self, F: Any, pressure: Any | None) -> Any:
        """`energy` without the stress left from earlier steps."""
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


def owners_of_cells(mesh: Mesh, materials: Mapping[str, Material]) -> NDArray[np.int64]:
    """Position (n_cells,) in ``materials`` of each cell's; "all" takes the cells that no other set names.

    Raises StudyError if a set is unknown, or a cell has no material or two.
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


def can_be_mixed(material: Material) -> bool:
    """Whether the mixed form can take a material: its energy has a volumetric part, which does not relax."""
    relaxes = material.prony is not None and material.prony.bulk_relaxes
    return material.volumetric_modulus is not None and not relaxes


def has_pressure(material: Material) -> bool:
    """Whether the mixed form has a solution for a material: its energy has a volumetric part whose modulus is positive.

    It is the pressure over this modulus that the form contains; Lame's lambda is none where Poisson's ratio is 0, and
    negative below, where nothing locks.
    """
    modulus = material.volumetric_modulus
    return modulus is not None and evaluate(modulus) > 0.0


def mixed_materials(
    geometry: NgsolveMesh, order: int, materials: Mapping[str, Material], mixed: bool | None
) -> set[str]:
    """Cell sets whose materials take the mixed form; with ``mixed`` None, those that would lock without it.

    Raises StudyError if a material is unstable.
    """
    if mixed is False or (mixed is None and not has_mixed_form(geometry.mesh, order)):
        return set()
    placed = {name: _placed(geometry, name, material) for name, material in materials.items()}
    if mixed:
        return {name for name, law in placed.items() if has_pressure(law)}
    soft = [name for name, law in placed.items() if law.equivalent_poisson >= NEARLY_INCOMPRESSIBLE]
    return {name for name in soft if can_be_mixed(placed[name])}


def place_materials(
    space: DisplacementSpace,
    owners: NDArray[np.int64],
    materials: Mapping[str, Material],
    mixed: set[str],
    enhanced: bool = False,
) -> list[MaterialRegion]:
    """A region for each material that has cells, in the order of ``materials``.

    Raises StudyError if a material is unstable, or the cells have no mixed form.

    Parameters
    ----------
    owners : of `owners_of_cells`.
    mixed : cell sets whose materials use the mixed form: `mixed_materials`.
    enhanced : whether the cells have enhanced strains, which no material makes lock.
    """
    regions = space.geometry.partition(owners)
    return [
        _material_region(space, name, material, regions[number], name in mixed, enhanced)
        for number, (name, material) in enumerate(materials.items())
        if number in regions
    ]


def _placed(geometry: NgsolveMesh, name: str, material: Material) -> Material:
    """The material with its directions on the mesh, checked."""
    try:
        material = material.on_mesh(geometry.cell_field)
        material.check()
    except StudyError as error:
        raise StudyError(f"material of '{name}': {error}") from error
    return material


def _material_region(
    space: DisplacementSpace, name: str, material: Material, region: ngs.Region, mixed: bool, enhanced: bool
) -> MaterialRegion:
    material, mesh = _placed(space.geometry, name, material), space.geometry.mesh
    if enhanced:
        return MaterialRegion(material, region)
    if mixed:
        check_mixed(mesh, space.order)
        unit = material.small_strain_stiffness()[3, 3] / float(np.linalg.norm(np.ptp(mesh.nodes, axis=0)))
        return MaterialRegion(material, region, PressureSpace(space, region), unit)
    poisson = material.equivalent_poisson
    if poisson < NEARLY_INCOMPRESSIBLE:
        return MaterialRegion(material, region)
    flag = (
        f"the material of '{name}' is nearly incompressible (Poisson's ratio {poisson:.4f}) "
        "in displacement elements, which lock; use mixed elements, of order 2 on tetrahedra and prisms"
    )
    warnings.warn(flag, NearlyIncompressibleWarning, stacklevel=4)
    return MaterialRegion(material, region, flag=flag)
