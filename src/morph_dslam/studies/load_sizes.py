"""Whether loads go with the stiffness of a body: what a message before solving, or on failed solutions, may add."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np

from morph_dslam.errors import SolverError
from morph_dslam.mechanics.loads import Gravity
from morph_dslam.mechanics.materials.base import Material, isotropic_average
from morph_dslam.mechanics.shell_problem import ShellProblem
from morph_dslam.meshing.mesh_summary import faces_figures
from morph_dslam.meshing.meshes import Mesh
from morph_dslam.studies.affine import Variables
from morph_dslam.studies.body_study import numbered
from morph_dslam.studies.solid_sections import (
    CouplingSection,
    ForceLoad,
    MovingLineLoad,
    MovingPatchLoad,
    Value,
    triple,
)

#: Loads of more than so many shear moduli carry no rubber's shape any more: their unit is probably wrong.
MOST_MODULI = 20.0
#: Loads that would move a shell by more than so many times its size, were it linear, have probably a wrong unit.
MOST_SIZES = 20.0
#: Levers are rarely so many times as long as the body that they turn; a point given in metres for millimetres is far
#: beyond that.
MOST_LENGTHS = 10.0


def load_doubt(
    loads: Iterable[Any],
    couplings: Iterable[CouplingSection],
    materials: Iterable[Any],
    mesh: Mesh,
    variables: Variables,
) -> str:
    """A sentence on the first load that is far too large for the stiffest material, or acts far away; else "".

    Parameters
    ----------
    loads, couplings, materials : sections of a study.
    mesh : with the sets that loads and couplings name.
    variables : that they may name; materials count at the defaults, loads where the ranges make them largest.
    """
    shear = max(_shear_modulus(section, variables) for section in materials)
    coupled = numbered("coupling", couplings)
    for where, section in (*numbered("load", loads), *coupled):
        largest = _largest_stress(section, mesh, variables)
        if largest > MOST_MODULI * shear:
            return (
                f"{where.capitalize()} reaches {_shown(largest)}, {largest / shear:.0f} times the shear modulus of the "
                f"stiffest material ({_shown(shear)}): are its unit and that of the modulus right? "
            )
    return "".join(_point_doubt(where, section, mesh, variables) for where, section in coupled)


def _point_doubt(where: str, section: CouplingSection, mesh: Mesh, variables: Variables) -> str:
    """A sentence if a coupling's point is, at the defaults, many lengths of the mesh away from its set; else ""."""
    if section.point is None:
        return ""
    point = np.array(triple(section.point, "length", variables.reader()))
    distance = float(np.linalg.norm(mesh.nodes[mesh.set_nodes(section.on)] - point, axis=1).min())
    length = float(np.linalg.norm(np.ptp(mesh.nodes, axis=0)))
    if distance <= MOST_LENGTHS * length:
        return ""
    return (
        f"{where.capitalize()} has its point {1e3 * distance:.4g} mm from its set, where the mesh is "
        f"{1e3 * length:.4g} mm long: is its unit right? "
    )


def shell_load_doubt(problem: ShellProblem) -> str:
    """A sentence if loads at the end of a range are far too large for a shell as stiff as it is undeformed; else "".

    Gravity is left out: a cloth hangs by what its stiffness does not carry.
    """
    if any(isinstance(load, Gravity) for load in problem.loads):
        return ""
    variables, undeformed = Variables(problem.symbols.parameters), np.zeros(problem.n_dofs)
    try:
        tangent = problem.linearise(undeformed, variables.defaults)
    except SolverError:
        return ""
    for at, mu in variables.range_ends():
        moved = problem.nodal_displacement(tangent.solve(problem.residual(undeformed, mu)))
        sizes = float(np.linalg.norm(moved, axis=1).max()) / problem.length
        if sizes > MOST_SIZES:
            return (
                f"The loads at {variables.text(mu, at)} would move the shell by {sizes:.0f} "
                "times its size if it stayed as stiff as it is undeformed: are their units, and those of modulus and "
                "thickness, right? "
            )
    return ""


def _shear_modulus(section: Any, variables: Variables) -> float:
    """Of a material at small strain, Pa."""
    made = section.make(variables.reader())
    assert isinstance(made, Material)
    return isotropic_average(made.small_strain_stiffness())[1]


def _largest_stress(section: Any, mesh: Mesh, variables: Variables) -> float:
    """The largest pressure, or component of a traction, anywhere in the ranges of the parameters, Pa.

    Forces over a surface count with their mean, those of moving loads with that at their centre on a plane, moments
    with the stress at the edges of a square that they bend.
    """
    over = {"pressure": 1.0, "stress": 1.0} | _areas(section, mesh)
    ends = np.array([[parameter.lower, parameter.upper] for parameter in variables.parameters])
    largest = [0.0]

    def read(value: Value, quantity: str | None) -> float:
        found = variables.read(value, quantity)
        if quantity in over:
            largest.append(float(np.abs(found.extremes(ends)).max()) / over[quantity])
        return found.constant

    section.make(read)
    return max(largest)


def _areas(section: Any, mesh: Mesh) -> dict[str, float]:
    """Area, m2, or width, m, that a force or force per length is spread over, by the quantity; for moments, m3."""
    if isinstance(section, ForceLoad):
        return {"force": faces_figures(mesh, mesh.surface(section.on))[0]}
    if isinstance(section, MovingPatchLoad):
        return {"force": 2.0 * np.pi * section.width**2}
    if isinstance(section, MovingLineLoad):
        return {"force per length": np.sqrt(2.0 * np.pi) * section.width}
    if isinstance(section, CouplingSection):
        # Nodes need not have whole faces between them. Those on a line are refused elsewhere.
        area = float(np.sort(np.ptp(mesh.nodes[mesh.set_nodes(section.on)], axis=0))[1:].prod())
        return {"force": area, "moment": area**1.5 / 6.0} if area else {}
    return {}


def _shown(stress: float) -> str:
    unit, size = next(((unit, size) for unit, size in (("MPa", 1e6), ("kPa", 1e3)) if stress >= size), ("Pa", 1.0))
    return f"{stress / size:.3g} {unit}"
