"""What the bodies of studies weigh: a density in the wrong unit shows there, and nowhere in a shape."""

from __future__ import annotations

from typing import Any

from morph_dslam.meshing.meshes import Mesh, cell_sizes
from morph_dslam.studies.shell_study import ShellStudy
from morph_dslam.studies.solid_study import SolidStudy

#: Densities from those of the lightest foams to beyond the heaviest metals, kg/m3. None at all is meant.
LIGHTEST, HEAVIEST = 10.0, 25_000.0
#: From kg/m3 to g/cm3.
PER_CM3 = 1e3


def announced_mass(study: SolidStudy | ShellStudy, mesh: Mesh) -> str | None:
    """The body's mass for people; None unless all of it has a density.

    Parameters
    ----------
    study : whose densities and thickness count at the defaults of parameters.
    mesh : of the study.
    """
    densities = _densities(study)
    if not densities or None in densities.values():
        return None
    sizes = cell_sizes(mesh)
    if isinstance(study, ShellStudy):
        thickness = study.shell.make(study.variables().reader())
        return mass_text(float(sizes.sum() * thickness * sum(densities.values())))
    mass = sum(densities[name] * sizes[mesh.cells(part.on)].sum() for name, part in study.materials.items())
    return mass_text(float(mass))


def mass_text(kilograms: float) -> str:
    """With the unit that suits it."""
    unit, size = next(((u, s) for u, s in (("kg", 1.0), ("g", 1e-3)) if kilograms >= s), ("mg", 1e-6))
    return f"{kilograms / size:.3g} {unit}"


def density_doubts(study: SolidStudy | ShellStudy) -> list[str]:
    """A sentence for each material that is lighter or heavier than any, with the unit that may be meant."""
    found = []
    for name, density in _densities(study).items():
        if not density or LIGHTEST <= density <= HEAVIEST:
            continue
        beyond = "less than a foam has" if density < LIGHTEST else "more than a metal has"
        label = f"the material '{name}'" if name else "the material"
        found.append(f"{label} has a density of {density:.4g} kg/m3, {beyond}: {_meant(density)}")
    return found


def _meant(density: float) -> str:
    """What to do about a density, kg/m3, that no material has."""
    if LIGHTEST <= density * PER_CM3 <= HEAVIEST:
        return f'is {density:.4g} g/cm3 meant? Write "{density:.4g} g/cm3"'
    if LIGHTEST <= density / PER_CM3 <= HEAVIEST:
        return f'is {density / PER_CM3:.4g} kg/m3 meant? Write "{density / PER_CM3:.4g} kg/m3"'
    return "check its unit"


def _densities(study: SolidStudy | ShellStudy) -> dict[str, Any]:
    """Density of each material at the defaults, kg/m3, by name (a shell's has none); None of one without."""
    read = study.variables().reader()
    if isinstance(study, ShellStudy):
        return {"": study.material.make(read).density}
    given = {name: "density" in part.constants for name, part in study.materials.items()}
    return {name: part.make(read).density if given[name] else None for name, part in study.materials.items()}
